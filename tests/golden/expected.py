"""The files of expected output beside this, and the one switch that writes them again.

    GOLDEN_WRITE=1 python -m pytest -n 0 tests/golden        # then read `git diff tests/golden`

What varies from machine to machine or run to run is replaced by a word, by the patterns of `VARIES` and no others.
Scores are compared as printed, at two to four decimals; in JSON, where they stand in full, at four digits, because
other processors may differ in the last ones. A run's clock is stopped (`stop_clock`) before it is reported, so that
printed seconds are compared too.
"""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
WRITE = bool(os.environ.get("GOLDEN_WRITE"))
VARIES = [
    (r"base64,[A-Za-z0-9+/=]+", "base64,PICTURE"),
    (r"(__s\d+__)[0-9a-f]{10}", r"\1DIGEST"),  # a run folder's name ends with the digest of code and data
    (r"age +size +folder", "age  size  folder"),  # of `runs list`, whose columns are as wide as what is in them
    (r"\d+ \w+ +[\d.]+ [kM]B +", "AGE  SIZE  "),
    (r'"bytes": \d+', '"bytes": SIZE'),
    # of a stand-in, the pictures that this or an earlier test has had made
    (r'(\b(?:image|mask|mask_cihp|new_vertices|sampled_images)"?: )\d+', r"\1NUMBER"),
    (r"\d+( of \d+ views missing)", r"NUMBER\1"),
    (r'((?:mask_on_body|vertices_in_mask)"?: \d\.\d)\d+', r"\1"),
    (r"\d+\.\d{5,}(?:e-?\d+)?", lambda digits: f"{float(digits[0]):.4g}"),
]
OPEN = ("provenance.packages", "provenance.git", "machine.gpu", "ledger.events")  # what is in them depends


def check(name: str, text: str, **replaced: object) -> None:
    """Hold a text against the file of that name; `replaced`: word -> the path or name that stands for it."""
    for word, value in sorted(replaced.items(), key=lambda item: -len(str(item[1]))):
        text = text.replace(str(value), word)
    for pattern, word in VARIES:
        text = re.sub(pattern, word, text)
    path = FOLDER / name
    if WRITE:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    before = path.read_text(encoding="utf-8").splitlines()
    changes = list(difflib.unified_diff(before, text.splitlines(), str(path), "now", lineterm="", n=1))
    assert not changes, "\n".join([*changes[:60], "GOLDEN_WRITE=1 takes what is now as expected"])


def stop_clock(folder: Path) -> str:
    """Give a run folder round seconds and megabytes, one date and a machine of four cores. Returns its processor."""
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    stages = record["ledger"]["stages"]
    for path, stage in stages.items():
        stage |= {"seconds": 0.5 if "/" in path else 2.0, "cpu_seconds": 1.5, "peak_mb": 100.0}
    total = sum(stage["seconds"] for path, stage in stages.items() if "/" not in path) + 0.25
    record["ledger"] |= {"seconds": total, "events": []}
    record["about"] |= {"fit_seconds": stages["fit"]["seconds"], "total_seconds": total}
    record["about"] |= {"peak_mb": 100.0, "render_ms": 5.0}
    record["outcome"] |= {"created": "2025-01-01T00:00:00+00:00", "updated": "2025-01-01T00:00:22+00:00"}
    record["machine"] |= {"cores": 4, "cores_usable": 4, "gpu": None}
    record["machine"] |= {"load_average": [0.5, 0.5, 0.5], "load_average_end": [0.5, 0.5, 0.5]}
    (folder / "run.json").write_text(json.dumps(record), encoding="utf-8")
    points = [json.loads(line) for line in (folder / "curve.jsonl").read_text(encoding="utf-8").splitlines()]
    # a slow machine offers more checkpoints than the last
    lines = [json.dumps(point | {"seconds": point["step"] / 8}) + "\n" for point in points[-1:]]
    (folder / "curve.jsonl").write_text("".join(lines), encoding="utf-8")
    return record["machine"]["cpu"]


def structure(value: Any, path: str = "") -> Iterator[str]:
    """A line for every key path of a JSON value, with its type: `about.changed[]: str`."""
    if path in OPEN:
        return
    if isinstance(value, dict):
        for key, inside in value.items():
            yield from structure(inside, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        yield f"{path}: list"
        for inside in value:
            yield from structure(inside, f"{path}[]")
    else:
        yield f"{path}: {type(value).__name__}"


def structure_text(value: Any) -> str:
    return "".join(line + "\n" for line in sorted(set(structure(value))))
