"""The options that say what to run on: shared by the commands that take a protocol, a method and scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ihbench.bounds import IMAGE_SIZES, Within, refuse_repeated

if TYPE_CHECKING:
    from ihbench.scene.protocol import Protocol


@dataclass(frozen=True)
class OcclusionChoice:
    """Another occlusion than the protocol's. Never in one table with the protocol's own."""

    rule: str | None = None
    """none, fixed-strip, strip-generic, central-band, object, side, upper-half, lower-half, blocks, natural."""
    fraction: Annotated[tuple[float, ...], Within(0, 1)] = ()
    """Share of the person to hide in covered frames; several make a sweep."""
    covers: Annotated[float | None, Within(0, 1)] = None
    """Share of the training frames that are covered; all of them where the occluder stands in the scene (natural)."""


@dataclass(frozen=True, kw_only=True)
class ProtocolChanges:
    """What of a protocol can be changed on the command line."""

    occlusion: OcclusionChoice = field(default_factory=OcclusionChoice)
    train_frames: str | None = None
    """Other training frames, START:STOP:STEP."""
    test_frames: str | None = None
    """Other (held-out) test frames, START:STOP:STEP."""
    image_size: Annotated[int | None, Within(*IMAGE_SIZES)] = None
    """Other image size, px of the longer side, for training and test images alike."""

    def apply(self, protocol: Protocol) -> list[Protocol]:
        """The protocols that these options mean: one, or one for each severity. Raises `BadInput`."""
        refuse_repeated(self.occlusion.fraction, "--occlusion.fraction")
        given = {name: value for name, (_, value) in self._short().items() if value is not None}
        flags = {name: flag for name, (flag, _) in self._short().items()}
        sweep = [{"occlusion.fraction": fraction} for fraction in self.occlusion.fraction] or [{}]
        return [protocol.with_fields(given | severity, flags) for severity in sweep]

    def _short(self) -> dict[str, tuple[str, Any]]:
        """Choice of a protocol -> its short flag, and the value that it has."""
        return {
            "train.frames": ("--train-frames", self.train_frames),
            "test.frames": ("--test-frames", self.test_frames),
            "image.size": ("--image-size", self.image_size),
            "occlusion.rule": ("--occlusion.rule", self.occlusion.rule),
            "occlusion.fraction": ("--occlusion.fraction", None),  # several are a sweep
            "occlusion.covers.fraction": ("--occlusion.covers", self.occlusion.covers),
        }


@dataclass(frozen=True, kw_only=True)
class SceneChoice(ProtocolChanges):
    protocol: str
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
    method: str = "inpainthuman"
    """A registered method (`ihbench list methods`)."""
    scene: tuple[str, ...] = ()
    """Scenes; none means all that the protocol names."""
    profile: str = "quick"
    """quick (256 px, for a CPU) or paper (512 px, the paper's settings)."""
    data: Path | None = None
    """Your copy of the data set; without it (and without IHBENCH_DATA) a stand-in."""
    body: Path | None = None
    """SMPL model file for real data (or IHBENCH_BODY)."""
    runs: Path = Path("runs")
    """Where run folders lie."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""
