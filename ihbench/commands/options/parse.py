"""From arguments to a command's options dataclass, checked."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union

from ihbench import config_fields
from ihbench.clock import streams
from ihbench.errors import BadInput
from ihbench.files.paths import user_path

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry

Options = TypeVar("Options")

BORDER = re.compile(r"\x1b\[[0-9;]*m|[│╰╯─]")  # and colours of the box that tyro draws
RULE = re.compile(r"\W*[─-]{3}[\W]*")
UNION = re.compile(r"no type matching .* Got errors: .*- (?:<class '[\w.]+'>|tuple\[.*\]): (?!\[.*\] does not match)")
TUPLE = re.compile(
    r"Could not find valid parse for arguments: (\[.*?\]); (Argument helptext: \S+ \[?(INT|FLOAT|STR|PATH))\b"
)
KINDS = {"STR": "plain text", "PATH": "possible paths"}  # what else is told of: numbers
NAMED = {"method": "config", "protocol": "choices"}  # outer part of a flag -> field of the options
SHELLS = ("bash", "zsh", "tcsh")


def options(kind: type[Options], argv: list[str], command: str, description: str) -> Options:
    """Parse `argv` with tyro, whose help goes to stdout with status 0.

    Raises `BadInput` for what cannot be parsed, numbers out of bounds and paths that cannot be.
    """
    import tyro

    _refuse_tyros_own(argv)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint), _spelling(), streams.styled():
            chosen = tyro.cli(
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
    _refuse_empty(chosen, argv)
    config_fields.check(chosen)
    return chosen


def subcommand(kinds: Mapping[str, type], argv: list[str], command: str, description: str) -> Any:
    """`options` of the one of several subcommands that is called; their docstrings are their help."""
    import tyro

    parts = [Annotated[kind, tyro.conf.subcommand(name, description=kind.__doc__)] for name, kind in kinds.items()]
    return options(Union[tuple(parts)], argv, command, description)  # type: ignore[arg-type]  # noqa: UP007


def _refuse_empty(chosen: Any, argv: list[str]) -> None:
    """An option that takes several values and was given none (`--keep`, and no name) must not pass for one that was
    left out."""
    for word, following in pairwise([*argv, "--"]):
        if word.startswith("--") and following.startswith("--"):
            value = chosen
            for name in word.removeprefix("--").replace("-", "_").split("."):
                value = getattr(value, NAMED.get(name, name) if "." in word else name, None)
            if value == ():
                raise BadInput(f"{word}: expected one value or more, or leave it out")


def _refuse_tyros_own(argv: list[str]) -> None:
    """tyro can print a script that completes words in a shell, and write it over any file: the latter is refused."""
    first = argv[0].replace("_", "-") if argv else ""
    if first == "--tyro-print-completion" and len(argv) == 2 and argv[1] not in SHELLS:
        raise BadInput(f"{first} {argv[1]}: expected one of {', '.join(SHELLS)}")
    if first == "--tyro-write-completion":
        raise BadInput(f"{first}: would replace a file; send what --tyro-print-completion SHELL prints into one")


def _spelling() -> ConstructorRegistry:
    """How numbers, texts and paths are read: as strictly for one option as for every other."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

    readers: dict[type, tuple[str, Callable[[str], Any], type | tuple[type, ...]]] = {
        int: ("INT", config_fields.whole, int),
        float: ("FLOAT", config_fields.real, (int, float)),
        str: ("STR", config_fields.plain, str),
        Path: ("PATH", _path, Path),
    }
    rules = ConstructorRegistry()

    @rules.primitive_rule
    def strict(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type not in readers:
            return None
        metavar, read, kinds = readers[info.type]
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=metavar,
            instance_from_str=lambda words: read(words[0]),
            is_instance=lambda value: isinstance(value, kinds) and not isinstance(value, bool),
            str_from_instance=lambda value: [str(value)],
        )

    return rules


def _path(text: str) -> Path:
    try:
        return user_path(text)
    except BadInput as error:  # tyro names the option
        raise ValueError(str(error)) from error


def _in_one_line(box: str) -> str:
    """The words of tyro's box, its parts joined by semicolons, without the title and the hint at --help."""
    words = "".join("\n" if RULE.fullmatch(line) else f"{line} " for line in box.splitlines()[1:])
    parts = [" ".join(BORDER.sub("", part).split()).rstrip(".") for part in words.splitlines()]
    line = "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
    line = re.sub(r"\[/?bold\]", "", line)  # tyro leaves its own markup in some
    return TUPLE.sub(_of_several, UNION.sub("", line))


def _of_several(found: re.Match[str]) -> str:
    """What is wrong with one of several values: tyro itself says only that something is."""
    expected = KINDS.get(found[3], "numbers in digits 0 to 9, such as 12")
    return f"{found[1].strip('[]')}: expected {expected}; {found[2]}"
