"""The folders of weights that a configuration names. Imports nothing heavy: plans and identities of runs ask it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ihbench.errors import BadInput


def cached_folders(names: Iterable[str]) -> list[Path]:
    """A folder, or the cached snapshot of a hub id, for each name. An empty name, and one that the run will complain
    of by itself, has none."""
    return [path for name in names if name and (path := _cached_folder(name)) is not None]


def _cached_folder(name: str) -> Path | None:
    from ihbench.diffusion.checkpoint import find_folder

    try:
        return find_folder(name, "")
    except BadInput:
        return None
