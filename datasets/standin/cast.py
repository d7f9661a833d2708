"""The names of stand-in people, and the mark on the folder that holds a cast."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ihbench.body import Body, load_body
from ihbench.clock.progress import Progress
from ihbench.datasets.reading.standin_mark import STANDIN_FILE
from ihbench.datasets.standin.subject import Subject
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.locks import locked
from ihbench.files.paths import user_path

NAME_PREFIX = "standin-"
ADVICE = "choose another folder (--out, IHBENCH_CACHE)"


def cast_names(count: int) -> list[str]:
    """The names of the first `count` people of a cast."""
    return [f"{NAME_PREFIX}{number}" for number in range(1, count + 1)]


def open_cast(root: Path, version: int, seed: int, subjects: list[str]) -> tuple[Path, list[Subject]]:
    """The folder, marked as this cast's, and the people asked for.

    Raises `BadInput` for an unknown subject, a negative seed, and a folder that holds something else.
    """
    root = user_path(root)
    if seed < 0:
        raise BadInput(f"stand-in seed {seed}: expected 0 or more")
    numbers = [member_number(subject) for subject in subjects]
    body = load_body()
    claim(root, version, seed, body)
    return root, [Subject(seed, number, body) for number in numbers]


def member_number(subject: str) -> int:
    number = subject.removeprefix(NAME_PREFIX)
    if not subject.startswith(NAME_PREFIX) or not number.isdecimal() or int(number) < 1 or number != str(int(number)):
        raise BadInput(f"stand-in subject {subject!r}: expected {NAME_PREFIX}1, {NAME_PREFIX}2, …")
    return int(number)


def claim(root: Path, version: int, seed: int, body: Body) -> None:
    """Mark the folder as this cast's, unless it belongs to something else."""
    mark = {
        "generator": "ihbench",
        "version": version,
        "seed": seed,
        "body": body.name,
        "body_sha": body.content_sha(),
    }
    path = root / STANDIN_FILE
    if path.is_file():
        found = atomic.read_json(path)
        if found != mark:
            raise BadInput(f"{root}: holds another stand-in ({_differences(found, mark)}); choose another folder")
        return
    if root.exists() and (not root.is_dir() or any(not _is_litter(entry.name) for entry in root.iterdir())):
        raise BadInput(f"{root}: not an empty folder and not a stand-in; choose another folder")
    with locked(root / f".{STANDIN_FILE}.lock", ADVICE):
        if not path.is_file():
            atomic.write_json(path, mark)
    claim(root, version, seed, body)  # somebody else may have been quicker


def _is_litter(name: str) -> bool:
    """Whether a name is of those that locks, halves of files and file browsers leave."""
    return name.startswith((f".{STANDIN_FILE}", f".{NAME_PREFIX}", ".DS_Store")) or name.lower() == "thumbs.db"


@contextmanager
def alone_with(root: Path, name: str, progress: Progress) -> Iterator[None]:
    """Hold one person of a cast while the files are made. A second process waits, then finds them there."""
    with locked(root / f".{name}.lock", ADVICE, wait=math.inf, on_wait=progress.say):
        yield


def _differences(found: object, asked: dict[str, object]) -> str:
    if not isinstance(found, dict):
        return "no readable mark"
    differing = [key for key in asked if found.get(key) != asked[key]]
    return ", ".join(f"{key} {found.get(key)!r}, asked for {asked[key]!r}" for key in differing) or "other keys"
