"""What stand-ins of every data set share: the cast's names, its mark on the folder, and writing what is missing."""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from ihbench.body import Body, load_body
from ihbench.clock.progress import Progress
from ihbench.datasets.reading.standin_mark import STANDIN_FILE
from ihbench.datasets.standin.subject import Subject
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.locks import locked
from ihbench.files.paths import user_path

NAME_PREFIX = "standin-"
WAITING_THREADS = 2  # beyond one a core: they wait for the disk while the others draw
Item = TypeVar("Item")
ADVICE = "choose another folder (--out, IHBENCH_CACHE)"


class StandIn(ABC):
    """Makes captures of procedural people in a data set's own layout, so that the real loader reads them.

    A file depends on (version, seed, subject, camera, frame) only.
    """

    version: int  # of the generator; a change that moves a pixel raises it
    protocol: str  # what it is made for
    n_frames: int
    n_cameras = 1
    folder_prefix = ""

    @staticmethod
    def subjects(count: int) -> list[str]:
        """The names of the first `count` people of a cast."""
        return [f"{NAME_PREFIX}{number}" for number in range(1, count + 1)]

    @staticmethod
    @abstractmethod
    def camera_ids(subject: str) -> tuple[str, ...]:
        """The cameras of a subject as its capture will name them."""

    @classmethod
    def ensure(
        cls,
        root: Path,
        seed: int,
        subjects: list[str],
        needed: Mapping[int, Iterable[int]],  # camera -> frames; what comes in one piece is made whole
        progress: Progress | None = None,
    ) -> Path:
        """Write what is needed and not yet there below `root`, and return `root`.

        Interrupted, the same call goes on where it stopped. Raises `BadInput` for an unknown subject, camera or
        frame, a negative seed, and when `root` holds something else.
        """
        frames_of = {camera: sorted(set(frames)) for camera, frames in sorted(needed.items())}
        for camera, frames in frames_of.items():
            if not 0 <= camera < cls.n_cameras:
                raise BadInput(f"stand-in camera {camera}: expected 0 to {cls.n_cameras - 1}")
            for frame in frames:
                if not 0 <= frame < cls.n_frames:
                    raise BadInput(f"stand-in frame {frame}: expected 0 to {cls.n_frames - 1}")
        root = user_path(root)
        if seed < 0:
            raise BadInput(f"stand-in seed {seed}: expected 0 or more")
        numbers = [member_number(subject) for subject in subjects]
        body = load_body()
        claim(root, cls.version, seed, body)
        progress = progress or Progress.silent()
        for name, number in zip(subjects, numbers, strict=True):
            folder = root / f"{cls.folder_prefix}{name}"
            if cls.missing(folder, frames_of):
                # a second process waits, then finds the files there
                with locked(root / f".{name}.lock", ADVICE, wait=math.inf, on_wait=progress.say):
                    if missing := cls.missing(folder, frames_of):
                        cls.make(folder, name, Subject(seed, number, body), missing, progress)
        return root

    @staticmethod
    @abstractmethod
    def missing(folder: Path, frames_of: dict[int, list[int]]) -> Any:
        """What is to be made of a subject; something false for nothing."""

    @staticmethod
    @abstractmethod
    def make(folder: Path, name: str, subject: Subject, missing: Any, progress: Progress) -> None:
        """Write it."""


def in_threads(write: Callable[[Item], None], items: list[Item], label: str, progress: Progress) -> None:
    """`write` every item, the first one alone: it computes what the threads share."""
    with progress.task(label, total=len(items)) as task:
        write(items[0])
        task.advance()
        pool = ThreadPoolExecutor((os.cpu_count() or 1) + WAITING_THREADS)
        try:
            for _ in pool.map(write, items[1:]):
                task.advance()
        finally:
            pool.shutdown(cancel_futures=True)


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
        present = atomic.read_json(path)
        if present != mark:
            raise BadInput(f"{root}: holds another stand-in ({_differences(present, mark)}); choose another folder")
        return
    litter = (f".{STANDIN_FILE}", f".{NAME_PREFIX}", ".DS_Store", "Thumbs.db", "thumbs.db")  # of locks, file browsers
    if root.exists() and (not root.is_dir() or any(not entry.name.startswith(litter) for entry in root.iterdir())):
        raise BadInput(f"{root}: not an empty folder and not a stand-in; choose another folder")
    with locked(root / f".{STANDIN_FILE}.lock", ADVICE):
        if not path.is_file():
            atomic.write_json(path, mark)
    claim(root, version, seed, body)  # somebody else may have been quicker


def _differences(present: object, asked: dict[str, object]) -> str:
    if not isinstance(present, dict):
        return "no readable mark"
    differing = [key for key in asked if present.get(key) != asked[key]]
    return ", ".join(f"{key} {present.get(key)!r}, asked for {asked[key]!r}" for key in differing) or "other keys"
