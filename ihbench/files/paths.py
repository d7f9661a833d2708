"""A path as a user wrote it, on the command line, in a variable or from Python."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

from ihbench.errors import BadInput

UNSET = re.compile(r"\$(\w+|\{\w+\})")
LONGEST_NAME, LONGEST_PATH = 255, 4095  # bytes; what common file systems and Linux take


def user_path(words: str | os.PathLike[str], what: str = "path") -> Path:
    """The path with `~` and `$VARIABLES` resolved, as a shell does. Raises `BadInput` for one that no file can have,
    for an unknown user's home, and for a variable that is not set, unless the path exists as it stands.

    `what` says where the words come from, such as "IHBENCH_DATA".
    """
    text = os.fspath(words)
    if not text:
        raise BadInput(f"{what} '': expected a path, found no text; leave the option out, or write . for this folder")
    if "\0" in text:
        raise BadInput(f"{what} {text!r}: holds a zero byte, which no path can have")
    sizes = [len(os.fsencode(part)) for part in text.split(os.sep)]
    if max(sizes) > LONGEST_NAME or sum(sizes) + len(sizes) > LONGEST_PATH:
        longest = f"a name of {max(sizes)} bytes in a path of {sum(sizes) + len(sizes) - 1}"
        raise BadInput(
            f"{what} {text[:60]}…: {longest}; expected names up to {LONGEST_NAME}, paths up to {LONGEST_PATH}"
        )
    if "$" in text and not os.path.lexists(text):
        text = os.path.expandvars(text)
        unset = UNSET.search(text)
        if unset and not os.path.lexists(text):
            raise BadInput(f"{what} {text}: the variable {unset[0]} is not set; set it, or write the path in full")
    path = Path(text)
    try:
        path = path.expanduser()
        path.stat()
        return path
    except OSError as error:
        if error.errno == errno.ELOOP:  # pathlib itself raises what nobody expects
            raise BadInput(f"{what} {text}: links that lead in a circle; name the file or folder itself") from error
        return path
    except RuntimeError as error:
        user = path.parts[0].removeprefix("~")
        if user:
            raise BadInput(f"{what} {text}: no user {user!r} here; a folder of that name is ./{text}") from error
        raise BadInput(f"{what} {text}: this user has no home folder; set HOME, or write the path in full") from error


def path_from(variable: str) -> Path | None:
    """The path in an environment variable; None where it is not set or empty. Raises `BadInput` as `user_path`."""
    words = os.environ.get(variable)
    return user_path(words, variable) if words else None


def users_cache() -> Path | None:
    """The folder in which programs keep what can be made again: `XDG_CACHE_HOME`, else ~/.cache; None for a user
    without a home, as containers and batch systems have them."""
    try:
        return path_from("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    except RuntimeError:
        return None


def cache_folder() -> Path:
    """`IHBENCH_CACHE`, or `ihbench` in the user's cache folder. Raises `BadInput` where there is neither."""
    own = path_from("IHBENCH_CACHE")
    if own is not None:
        return own
    users = users_cache()
    if users is None:
        raise BadInput("this user has no home folder to keep stand-ins in; name a folder for them with IHBENCH_CACHE")
    return users / "ihbench"
