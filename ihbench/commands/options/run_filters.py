"""The options that choose finished runs in a folder of runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ihbench.record.results import RunResult


@dataclass(frozen=True, kw_only=True)
class RunFilters:
    runs: Path = Path("runs")
    """Folder of run folders."""
    protocol: str | None = None
    """Only runs under this protocol, with or without its @version."""
    method: str | None = None
    """Only runs of this method."""
    scene: str | None = None
    """Only runs on this scene."""
    profile: str | None = None
    """Only runs under this profile."""

    def matches(self, run: RunResult) -> bool:
        """Whether a run is among those that are asked for."""
        who = run.identity
        asked = ((self.method, who.method), (self.scene, who.scene), (self.profile, who.profile))
        return all(word in (None, own) for word, own in asked) and (
            self.protocol in (None, who.protocol, who.protocol_id)
        )


@dataclass(frozen=True, kw_only=True)
class RowOptions:
    """Which rows of a table are shown, and what they are called."""

    rows: tuple[str, ...] = ()
    """Only these rows, in this order: names as in the tables, bounds such as truth, or a method, which stands for all
    of its rows unless one has just that name."""
    names: tuple[str, ...] = ()
    """Other names for rows, OLD=NEW."""
