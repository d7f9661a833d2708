"""Removing and replacing: the one place where files go. Nothing goes that the bench did not write itself."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from ihbench.errors import BadInput

Ours = Callable[[Path], bool]  # whether the bench wrote what lies at this path, relative to the folder asked about


def discard(folder: Path) -> None:
    """Remove a folder that this process has made, under a name that nobody else can have taken."""
    shutil.rmtree(folder, ignore_errors=True)


def discard_file(file: Path) -> None:
    """Remove one file that the bench wrote. One that is gone already, or may not be removed, is no error."""
    with suppress(OSError):
        file.unlink()


def discard_empty(folder: Path) -> None:
    """Remove a folder with nothing in it. One that holds somebody's files, or is gone already, is no error."""
    with suppress(OSError):
        folder.rmdir()


def remove_written(folder: Path, ours: Ours) -> None:
    """Remove what the bench wrote below `folder`, and folders that this empties. The rest stays where it is; links
    are neither removed nor followed."""
    touched: set[Path] = set()
    for path in _from_below(folder):
        mine = ours(path.relative_to(folder))
        if not path.is_dir():
            if mine:
                path.unlink()
                touched.add(path.parent)
        elif mine or path in touched:
            with suppress(OSError):  # somebody else's files are in it
                path.rmdir()
                touched.add(path.parent)


def move_written(source: Path, target: Path, ours: Ours, last: str) -> None:
    """Move what the bench wrote from one folder into another, file by file. `last` goes last: who has it is whole."""
    files = [path.relative_to(source) for path in _from_below(source) if not path.is_dir()]
    for file in sorted(filter(ours, files), key=lambda file: (file.as_posix() == last, file)):
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / file, target / file)
        for folder in (source / file).parents:
            if folder == source:
                break
            with suppress(OSError):  # not empty yet
                folder.rmdir()
    remove_written(source, lambda path: ours(path) and not (source / path).is_file())  # folders that were empty


def foreign(folder: Path, ours: Ours) -> Path | None:
    """The first thing below `folder` that the bench did not write there, a link or an empty folder for instance, or
    None."""
    for path, kind in _walk(folder):
        if kind == "folder" and any(os.scandir(path)):
            continue
        if kind == "link" or not ours(path.relative_to(folder)):
            return path
    return None


def _from_below(folder: Path) -> Iterator[Path]:
    """Files and folders, what is inside before what it is in; no links."""
    return reversed([path for path, kind in _walk(folder) if kind != "link"])  # type: ignore[return-value]


def _walk(folder: Path) -> Iterator[tuple[Path, str]]:
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name) if folder.is_dir() else ():
        kind = "link" if entry.is_symlink() else "folder" if entry.is_dir() else "file"
        yield Path(entry.path), kind
        if kind == "folder":
            yield from _walk(Path(entry.path))


# --- places ---


def check_apart(target: Path, places: Iterable[Path], what: str) -> None:
    """Raise `BadInput` where `target` is, holds, or lies in one of `places`, whatever links lead there.

    `what` says what would be written, such as "the training set". Of places that do not exist nothing is said.
    """
    for place in places:
        if holds(place, target) or holds(target, place):
            raise BadInput(
                f"{target}: {what} may not go where {place} is, which is only read; name another folder with --out"
            )


def check_no_home(target: Path) -> None:
    """Raise `BadInput` where replacing `target` would take away the current folder, the home, or the root."""
    homes = [Path.cwd(), Path("/")]
    with suppress(RuntimeError):  # a user without a home
        homes.append(Path.home())
    for place in homes:
        if holds(target, place):
            raise BadInput(f"{target}: holds {place}; name another folder with --out")


def holds(outer: Path, inner: Path) -> bool:
    """Whether `inner` is `outer` or lies in it: the same folder is found through links, other mounts of it, and names
    that differ in case only. `outer` must exist; of `inner` the part that does counts."""
    try:
        here = os.stat(outer)
    except OSError:
        return False
    path = Path(os.path.realpath(inner))
    for step in (path, *path.parents):
        with suppress(OSError):
            if os.path.samestat(here, os.stat(step)):
                return True
    return False
