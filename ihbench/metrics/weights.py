"""Files of learned weights that metrics and methods use and the bench may not ship.

Nothing is downloaded unless asked for. A file is looked for in the folder that `IHBENCH_WEIGHTS` names, then where
torch keeps its own downloads, and is used only when its hash is right.
"""

from __future__ import annotations

import hashlib
import os
import urllib.error
import urllib.request
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ihbench import registry
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.paths import path_from, users_cache

CHUNK = 2**20  # bytes
PATIENCE = 30  # s without a byte


@dataclass(frozen=True)
class WeightFile:
    """One file, where it comes from, and how to know it."""

    name: str  # what the bench calls it
    file: str  # its file name
    url: str
    sha256: str  # the first hex digits at least; torchvision puts eight of them into the file's name
    size_mb: float
    used_by: str
    licence: str


def _torchvision(name: str, file: str, size_mb: float, net: str) -> WeightFile:
    digits = file.rsplit("-", 1)[1].removesuffix(".pth")
    url = f"https://download.pytorch.org/models/{file}"
    licence = "torchvision, BSD-3-Clause; trained on ImageNet (non-commercial terms of use)"
    return WeightFile(name, file, url, digits, size_mb, f"LPIPS with the {net} trunk", licence)


FILES = {
    weights.name: weights
    for weights in (
        _torchvision("lpips-vgg", "vgg16-397923af.pth", 527.8, "VGG-16"),
        _torchvision("lpips-alex", "alexnet-owt-7be5be79.pth", 233.1, "AlexNet"),
        _torchvision("lpips-squeeze", "squeezenet1_1-b8a52dc0.pth", 4.7, "SqueezeNet 1.1"),
    )
}

_CHECKED: dict[tuple[str, int, int], bool] = {}  # path, size, time of change -> whether the hash was right


def find_weights(name: str) -> WeightFile:
    """The entry of that name. Raises `BadInput` with the nearest known one."""
    if name not in FILES:
        raise BadInput(f"weights {name!r}: not known; {registry.nearest(name, list(FILES))}")
    return FILES[name]


def folders() -> list[Path]:
    """Where weight files are looked for, in order. The last is torch's own, found without importing torch.

    Raises `BadInput` where there is none, and for variables that name no folder.
    """
    own, torch_home, users = path_from("IHBENCH_WEIGHTS"), path_from("TORCH_HOME"), users_cache()
    if torch_home is None and users is not None:
        torch_home = users / "torch"
    folders = [folder for folder in (own, torch_home and torch_home / "hub" / "checkpoints") if folder]
    if not folders:
        raise BadInput("this user has no home folder to keep weights in; name a folder for them with IHBENCH_WEIGHTS")
    return folders


def locate(weights: WeightFile) -> Path | str:
    """The file, or why there is none, in a line: what is missing, where it goes, how to get it."""
    what = "missing; put it"
    try:
        places = folders()
    except BadInput as error:
        return f"{weights.used_by} needs {weights.file}: {error}"
    for folder in places:
        path = folder / weights.file
        if os.path.isfile(path):  # Path's own raises in other users' folders
            if is_right(weights, path):
                return path
            damaged = f"{_short(path)} is damaged or another file (its hash does not begin with {weights.sha256})"
            what = f"{damaged}; move it away, then put the right one"
    return (
        f"{weights.used_by} needs {weights.file}: {what} into {_short(places[0])}, or on a connected machine run: "
        f"ihbench weights fetch {weights.name}"
    )


def _short(path: Path) -> str:
    """A path without the user's name: reasons go into run folders, and those are shared."""
    try:
        return f"~/{path.relative_to(Path.home())}"
    except (ValueError, RuntimeError):
        return str(path)


def is_right(weights: WeightFile, path: Path) -> bool:
    """Whether a file has the hash it should have; read once per process and state of the file. One that may not be
    read is not."""
    try:
        about = path.stat()
        key = str(path.resolve()), about.st_size, about.st_mtime_ns
        if key not in _CHECKED:
            with open(path, "rb") as file:
                _CHECKED[key] = hashlib.file_digest(file, "sha256").hexdigest().startswith(weights.sha256)
        return _CHECKED[key]
    except OSError:
        return False


def fetch(weights: WeightFile, progress: Progress) -> Path:
    """Download a file into the first folder, whole and with the right hash or not at all.

    Raises `BadInput` when the machine is offline, the disk is full, what came is not the file, or another file of
    that name is there.
    """
    there = locate(weights)
    if isinstance(there, Path):
        return there
    target = folders()[0] / weights.file
    by_hand = f"download {weights.url} elsewhere and put it into {target.parent}"
    if os.path.lexists(target) and not (target.is_symlink() and not target.exists()):
        raise BadInput(f"{target}: is damaged or another file (its hash differs); move it away, then fetch again")
    try:
        with (
            urllib.request.urlopen(weights.url, timeout=PATIENCE) as source,
            atomic.replaced(target) as temporary,
            open(temporary, "wb") as file,
            progress.task(f"fetching {weights.file} (MB)", round(weights.size_mb)) as task,
        ):
            while chunk := source.read(CHUNK):
                file.write(chunk)
                task.advance(file.tell() // 10**6 - task.done)
            file.flush()
            if not is_right(weights, temporary):
                raise BadInput(
                    f"{weights.url}: what came is not {weights.file} (its hash differs); try again, or {by_hand}"
                )
    except (OSError, ValueError) as error:  # urllib's own errors are OSErrors
        reason = getattr(error, "reason", error)
        raise BadInput(f"{weights.file} could not be fetched ({reason}); {by_hand}") from error
    return target


def states(names: Iterable[str] = FILES) -> list[dict[str, object]]:
    """What `ihbench weights list` shows: "present", "missing" or "damaged", and where."""
    states = []
    for weights in map(find_weights, names):
        paths = [folder / weights.file for folder in folders()]
        present = [path for path in paths if os.path.isfile(path)]
        right = [path for path in present if is_right(weights, path)]
        state = "present" if right else "damaged" if present else "missing"
        entry: dict[str, object] = {name: getattr(weights, name) for name in ("name", "file", "size_mb")}
        entry |= {"state": state, "path": str((right or present or paths)[0])}
        states.append(entry | {name: getattr(weights, name) for name in ("used_by", "url", "licence")})
    return states
