"""From arguments to a command's options dataclass."""

from __future__ import annotations

from typing import TypeVar

Options = TypeVar("Options")


def options(kind: type[Options], argv: list[str], command: str, description: str) -> Options:
    """Parse `argv` with tyro, whose help goes to stdout with status 0 and whose complaints go to stderr with 2."""
    import tyro

    return tyro.cli(
        kind,
        args=argv,
        prog=f"ihbench {command}",
        description=description,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
