"""Where compiled kernels are kept in places that may not be written: a read-only installation, no home folder.

numba keeps them beside the sources, else in the user's cache folder, and fails where it may write to neither.
"""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path


def choose_kernel_cache() -> None:
    """Set NUMBA_CACHE_DIR where numba would find no place: to `IHBENCH_CACHE`, or a private folder for temporary
    files. Call it before numba is imported."""
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    if os.environ.get("NUMBA_CACHE_DIR") or os.access(Path(__file__).parent, os.W_OK) or _may_write(users):
        return
    own = os.path.expanduser(os.path.expandvars(os.environ.get("IHBENCH_CACHE", "")))
    if own and _may_write(Path(own)):
        os.environ["NUMBA_CACHE_DIR"] = str(Path(own).absolute() / "kernels")
        return
    with suppress(OSError):  # no place at all: numba will say so
        os.environ["NUMBA_CACHE_DIR"] = str(_private_folder())


def _may_write(folder: Path) -> bool:
    """Whether files may be made in a folder, or the folder itself where it is missing."""
    folder = folder.absolute()
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):  # root's permissions do not tell of read-only file systems
            return True
    except OSError:
        return False


def _private_folder() -> Path:
    """The user's own folder for kernels among the temporary files; kernels are code, so nobody else's is taken."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"ihbench-kernels-{user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    state = folder.lstat()
    own = not hasattr(os, "getuid") or (state.st_uid == user and not state.st_mode & 0o077)
    return folder if stat.S_ISDIR(state.st_mode) and own else Path(tempfile.mkdtemp(prefix="ihbench-kernels-"))
