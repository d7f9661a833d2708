"""From arguments to a command's options dataclass."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stderr
from typing import TypeVar

from ihbench.errors import BadInput

Options = TypeVar("Options")

BORDER = re.compile(r"\x1b\[[0-9;]*m|[│╰╯─]")  # and colours of the box that tyro draws


def options(kind: type[Options], argv: list[str], command: str, description: str) -> Options:
    """Parse `argv` with tyro, whose help goes to stdout with status 0. Raises `BadInput` for what it cannot parse."""
    import tyro

    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(
                kind,
                args=argv,
                prog=f"ihbench {command}",
                description=description,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise BadInput(f"{_in_one_line(complaint.getvalue())}; see ihbench {command} --help") from end


def _in_one_line(box: str) -> str:
    """The words of tyro's box, its parts joined by semicolons, without the title and the hint at --help."""
    words = "".join("\n" if "───" in line else f"{line} " for line in box.splitlines() if "╭" not in line)
    parts = [" ".join(BORDER.sub("", part).split()).rstrip(".") for part in words.splitlines()]
    return "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
