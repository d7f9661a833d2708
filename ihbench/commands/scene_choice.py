"""The options that say what to run on: shared by the commands that take a protocol, a method and scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class SceneChoice:
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
