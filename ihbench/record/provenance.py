"""Where a result came from: the versions of this bench, of the packages that compute, and of the checkout."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from ihbench import registry
from ihbench.version import __version__

PACKAGES = (
    "numpy",
    "scipy",
    "torch",
    "torchvision",
    "opencv-contrib-python-headless",
    "pillow",
    "h5py",
    "numba",
    "lpips",
    "safetensors",
    "gsplat",
    "diffusers",
    "transformers",
    "peft",
    "accelerate",
)

_words: list[str] = []  # of the command that this process was started for; none from Python


@dataclass(frozen=True)
class GitState:
    """A commit, and whether files differ from it."""

    commit: str
    dirty: bool


@dataclass(frozen=True)
class Provenance:
    """Versions to store with a run."""

    ihbench: str = ""
    git: GitState | None = None  # None outside a checkout
    packages: Mapping[str, str] = field(default_factory=dict)


def provenance() -> Provenance:
    """What computes here. Reads package metadata only; imports none of the packages."""
    return Provenance(__version__, git_state(), package_versions())


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that can move a number, and of those that register something with the bench;
    a package that is not there is left out."""
    versions = {}
    for name in (*PACKAGES, *sorted({*registry.other_packages().values()} - {*PACKAGES})):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def note_command(argv: Sequence[str]) -> None:
    """Keep the words of the command line for the records of its runs."""
    _words[:] = argv


def command() -> tuple[str, ...]:
    """The words of the command line, without folders: run folders are shared. None when called from Python."""
    return tuple(map(_without_folders, _words))


def _without_folders(word: str) -> str:
    flag, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    folder, name = os.path.split(value.rstrip(os.sep))
    return f"{flag}{equals}…/{name}" if folder else word


def description() -> str:
    """What `ihbench --version` says: the version, the commit, and what computes."""
    git, packages = git_state(), package_versions()
    commit = "" if git is None else f", commit {git.commit[:10]}{' with changes' if git.dirty else ''}"
    computing = ", ".join(f"{name} {packages[name]}" for name in ("torch", "numpy", "numba") if name in packages)
    return f"{__version__}{commit} (Python {platform.python_version()}, {computing})"


def git_state(folder: Path | None = None) -> GitState | None:
    """Commit of the checkout this code runs from and whether files differ from it; None outside a checkout."""
    folder = folder if folder is not None else Path(__file__).resolve().parent
    if _git(folder, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None  # installed into some other project's checkout, or into none
    commit = _git(folder, "rev-parse", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return None if commit is None or changed is None else GitState(commit, bool(changed))


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
