"""The file beside stand-in subjects that says who made them; real data have none."""

from __future__ import annotations

from pathlib import Path

from ihbench.errors import BadInput
from ihbench.files import atomic

STANDIN_FILE = "STANDIN.json"  # in the folder that holds the subjects


def standin_mark(root: Path) -> dict[str, atomic.Json]:
    """What STANDIN.json in the folder of the subjects says: version, seed and body_sha; empty for real data."""
    path = root / STANDIN_FILE
    if not path.is_file():
        return {}
    mark = atomic.read_json(path)
    if not isinstance(mark, dict) or not {"version", "seed", "body_sha"} <= mark.keys():
        raise BadInput(f"{path}: expected version, seed and body_sha of the stand-in; make the stand-in anew")
    return mark
