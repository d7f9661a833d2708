"""Where a result came from: the versions of this bench, of the packages that compute, and of the checkout."""

from __future__ import annotations

import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import ihbench

PACKAGES = (
    "numpy",
    "scipy",
    "torch",
    "opencv-contrib-python-headless",
    "numba",
    "safetensors",
    "gsplat",
    "diffusers",
)


def provenance() -> dict[str, Any]:
    """Versions to store with a run. Reads package metadata only; imports none of the packages."""
    return {"ihbench": ihbench.__version__, "git": git_state(), "packages": package_versions()}


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that can move a number; a package that is not there is left out."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def git_state(folder: Path | None = None) -> dict[str, Any] | None:
    """Commit of the checkout this code runs from and whether files differ from it; None outside a checkout."""
    folder = folder if folder is not None else Path(ihbench.__file__).resolve().parent
    if _git(folder, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None  # installed into some other project's checkout, or into none
    commit = _git(folder, "rev-parse", "HEAD")
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return None if commit is None or changed is None else {"commit": commit, "dirty": bool(changed)}


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
