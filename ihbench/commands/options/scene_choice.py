"""The options that say what to run on: shared by the commands that take a protocol, a method and scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ihbench import registry
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
        if self.occlusion.rule is not None:
            registry.entry_point("occlusion", self.occlusion.rule)
        protocol = protocol.with_frames(self.train_frames, self.test_frames).with_size(self.image_size)
        refuse_repeated(self.occlusion.fraction, "--occlusion.fraction")
        fractions = self.occlusion.fraction or (None,)
        return [protocol.with_occlusion(self.occlusion.rule, f, self.occlusion.covers) for f in fractions]


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
