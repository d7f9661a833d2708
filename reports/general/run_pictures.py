"""The pictures that runs have left: contact sheets, and what was painted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ihbench.clock.ledger import ARTIFACTS
from ihbench.record.results import RunResult, by_group
from ihbench.record.row_labels import by_label

PICTURES = {"contact_sheet.png": "test views", **ARTIFACTS}
SIGNATURE = b"\x89PNG\r\n\x1a\n"
LARGEST_FILE = 16 * 2**20  # bytes; a page of pictures must still open
LARGEST_PAGE = 48 * 2**20  # bytes of all pictures


def run_pictures(results: Sequence[RunResult]) -> list[tuple[Path, str]]:
    """(file, caption) of every row's and scene's first seed, in the order of the tables, while they fit on a page.

    What is missing, no PNG or no plain file is passed over: a report does not depend on it.
    """
    groups = by_group(result for result in results if result.status == "done")
    pictures: list[tuple[Path, str]] = []
    size = 0
    for (protocol, _, profile, _), runs in groups.items():
        for label, row in by_label(runs).items():
            first = {run.scene: run for run in reversed(row)}
            for run in sorted(first.values(), key=lambda run: run.scene):
                for name, what in PICTURES.items():
                    file = run.folder / name
                    bytes_ = _size(file)
                    if bytes_ and size + bytes_ <= LARGEST_PAGE:
                        size += bytes_
                        where = f"{run.scene}, seed {run.seed}"
                        pictures.append((file, f"{label} on {where}: {what} ({protocol}, {profile})"))
    return pictures


def _size(file: Path) -> int:
    """Bytes of a PNG that may be shown, else 0."""
    try:
        if file.is_symlink() or not file.is_file() or not 0 < file.stat().st_size <= LARGEST_FILE:
            return 0
        with file.open("rb") as opened:
            return file.stat().st_size if opened.read(len(SIGNATURE)) == SIGNATURE else 0
    except OSError:
        return 0
