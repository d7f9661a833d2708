"""What a user gives as a number, a name or one of a few words: how it is spelled, and between which bounds it lies.

Fields of options and configurations carry their bounds with their type, `Annotated[int, Within(1, 99)]`; `check`
holds a value against both. A number without bounds of its own must be finite and below 2^63.
"""

from __future__ import annotations

import re
import types
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from ihbench.errors import BadInput

LONGEST_TEXT = 1000  # characters
LARGEST_CAST = 99  # people of a stand-in that can be named, whether a protocol names them or not
IMAGE_SIZES = (8, 8192)  # px of the longer side
LARGEST_SEED = 2**32 - 1  # what every generator of random numbers takes, numpy's old one as well
STEPS = 10_000_000  # of an optimisation, at most
WHOLE = re.compile(r"-?[0-9]{1,19}")
REAL = re.compile(r"-?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[-+]?[0-9]{1,3})?|-?inf|nan", re.IGNORECASE)


@dataclass(frozen=True)
class Within:
    """The numbers from `low` to `high`; with `above`, `low` itself is not one of them."""

    low: float
    high: float
    above: bool = False
    words: str = ""

    def holds(self, number: float) -> bool:
        return self.low <= number <= self.high and not (self.above and number == self.low)  # never for NaN

    def __str__(self) -> str:
        if self.words:
            return self.words
        low, high = (f"{n:d}" if isinstance(n, int) else f"{n:g}" for n in (self.low, self.high))
        return f"above {low}, at most {high}" if self.above else f"{low} to {high}"


@dataclass(frozen=True)
class MultipleOf:
    """Whole numbers that this one divides."""

    divisor: int

    def holds(self, number: float) -> bool:
        return number % self.divisor == 0

    def __str__(self) -> str:
        return f"a multiple of {self.divisor}"


SEEDS = Within(0, LARGEST_SEED)
ANY_NUMBER = Within(-(2**63), 2**63 - 1, words="a finite number, below 2^63")


def whole(text: str) -> int:
    """The number that ASCII digits spell, with a minus at most. Raises `ValueError` for anything else."""
    if not WHOLE.fullmatch(text):
        raise ValueError(f"{text[:40]!r}: expected a whole number in digits 0 to 9, such as 12")
    return int(text)


def real(text: str) -> float:
    """The number that ASCII digits spell, such as -1.5 or 2e-3. Raises `ValueError` for anything else."""
    if not REAL.fullmatch(text):
        raise ValueError(f"{text[:40]!r}: expected a number in digits 0 to 9, such as 0.5 or 2e-3")
    return float(text)


def plain(text: str) -> str:
    """The text itself. Raises `ValueError` when it is very long, or holds signs that a terminal would obey."""
    if len(text) > LONGEST_TEXT:
        raise ValueError(f"{text[:40]!r}…: {len(text)} characters; expected up to {LONGEST_TEXT}")
    if any(unicodedata.category(sign) in ("Cc", "Cs") for sign in text):
        raise ValueError(f"{text[:40]!r}: holds control characters, or is not UTF-8; expected plain text")
    return text


def check(values: Any, prefix: str = "--", only: Collection[str] | None = None) -> None:
    """Hold every field of a dataclass (or some), and of those in it, against its type and bounds.

    `prefix` stands before the field's name in what is said of it; without one that is an argument's. Raises
    `BadInput` for the first that does not fit.
    """
    for name, hint, default in _fields(type(values)):
        if only is not None and name not in only:
            continue
        value, flag = getattr(values, name), (prefix + _flag(name, hint) if prefix else name)
        if is_dataclass(value) and not isinstance(value, type):
            check(value, f"{flag}.")
            continue
        if not fits(value, hint):
            raise BadInput(f"{flag} {shown(value)}: expected {expected(hint)}")
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, str) and not item and default != "":
                raise BadInput(f"{flag} '': expected a name, found no text")
            bounds = tuple(dict.fromkeys(rules(hint))) or (ANY_NUMBER,)
            if isinstance(item, int | float) and not isinstance(item, bool):
                for rule in bounds:
                    if not rule.holds(item):
                        told = " and ".join(str(other) for other in bounds)
                        raise BadInput(f"{flag} {shown(value)}: expected {told}")


def refuse_repeated(values: Sequence[Any], flag: str) -> None:
    """Raise `BadInput` where a list that says what to do has something twice: a slip, and nothing to do twice."""
    for k, value in enumerate(values):
        if value in values[:k]:
            raise BadInput(f"{flag} {shown(tuple(values))}: {shown(value)} stands there twice; name each once")


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a type, as far as options go. A whole number is a real one, a bool is neither."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return fits(value, parts[0])
    if origin in (Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return any(type(value) is type(part) and value == part for part in parts)
    if origin is tuple and len(parts) == 2 and parts[1] is Ellipsis:
        return isinstance(value, tuple) and all(fits(item, parts[0]) for item in value)
    if hint in (int, float):
        return isinstance(value, int if hint is int else int | float) and not isinstance(value, bool)
    return not isinstance(hint, type) or isinstance(value, hint)


def expected(hint: Any) -> str:
    """A type in words."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return ", ".join([expected(parts[0]), *(str(rule) for rule in rules(hint))])
    if origin in (Union, types.UnionType):
        return " or ".join(expected(part) for part in parts)
    if origin is Literal:
        return "one of " + ", ".join(map(str, parts))
    if origin is tuple:
        return f"a tuple, of {expected(parts[0])} each"
    words = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", Path: "a path"}
    return "None" if hint is type(None) else words.get(hint, getattr(hint, "__name__", str(hint)))


def shown(value: Any) -> str:
    """A value as it was written, cut where it is long."""
    items = value if isinstance(value, tuple) and value else (value,)
    text = " ".join(map(repr, items))
    return text if len(text) <= 80 else f"{text[:80]}…"


@cache
def _fields(kind: type) -> tuple[tuple[str, Any, Any], ...]:
    hints = get_type_hints(kind, include_extras=True)
    return tuple((field.name, hints[field.name], field.default) for field in fields(kind))


def _flag(name: str, hint: Any) -> str:
    """How the command line calls a field: tyro's own name for it where it has one."""
    named = (getattr(word, "name", None) for word in getattr(hint, "__metadata__", ()))
    return next((word for word in named if isinstance(word, str)), name.replace("_", "-"))


def rules(hint: Any) -> tuple[Within | MultipleOf, ...]:
    """The bounds that stand beside a type, or inside it."""
    own = [word for word in getattr(hint, "__metadata__", ()) if isinstance(word, Within | MultipleOf)]
    origin, parts = get_origin(hint), get_args(hint)
    inside = () if origin is Literal else parts[:1] if origin is Annotated else parts
    return (*own, *(rule for part in inside for rule in rules(part)))
