"""Frozen dataclasses from JSON and back, and whether a value that a file holds has the shape that a type says.

Types are what annotations are made of: `str`, `int`, `float`, `bool`, `None`, unions, `Literal`, `tuple[X, ...]`,
`Mapping[X, ...]`, dataclasses, classes that `parse` a text (metric identities), `Any` for JSON of any kind, and
`Annotated` with a `Within` or a `Matches`. A whole number is a float too, and true is no number. A dataclass's fields
without default must be there; its further keys may hold any JSON, and are kept where it has a field `more`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

LARGEST = 1e15  # of a number without bounds of its own: far from where sums overflow or doubles skip whole numbers
WHOLE = 2**63 - 1  # the largest whole number that databases and arrays hold
LONGEST = 100_000  # letters of a text
DEEPEST = 40  # of values within values

MORE = "more"  # the field of a dataclass for keys that it does not know

Check = Callable[[Any], str]  # "" where the shape is right, else where and what is wrong
Make = Callable[[Any], Any]


@dataclass(frozen=True)
class Within:
    """Bounds of a number, both allowed. NaN and +infinity only where they are named."""

    low: float = -LARGEST
    high: float = LARGEST
    nan: bool = False
    infinite: bool = False

    def fault(self, value: float) -> str:
        try:
            number = float(value)
        except OverflowError:
            number = math.inf if value > 0 else -math.inf
            return f"is a number of {value.bit_length()} bits"  # type: ignore[attr-defined]  (only int overflows)
        if math.isnan(number):
            return "" if self.nan else "is not a number (nan)"
        if (number == math.inf and self.infinite) or self.low <= number <= self.high:
            return ""
        return f"is {number:.6g}, expected {self.low:.6g} to {self.high:.6g}"


@dataclass(frozen=True)
class Matches:
    """A pattern that the whole text must match; `what` says so in words."""

    pattern: re.Pattern[str]
    what: str

    def fault(self, value: str) -> str:
        return "" if self.pattern.fullmatch(value) else f"is {value[:60]!a}, expected {self.what}"


def fault(value: Any, kind: Any) -> str:
    """Where and how `value` differs from the type `kind`, such as "events[3].kind is missing"; "" where it does
    not. Raises `TypeError` for a type that this module does not know."""
    return _check(kind)(value).lstrip(". ")


def from_json(value: Any, kind: Any) -> Any:
    """The value as the type `kind`. For a value without `fault`; what there is else is not looked at."""
    return _maker(kind)(value)


def as_json(value: Any) -> Any:
    """The inverse of `from_json`. None is left out where it is a field's default."""
    if isinstance(value, str | int | float | None):
        return value
    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        known = {field: getattr(value, field.name) for field in fields(value) if field.name != MORE}
        made = {f.name: as_json(item) for f, item in known.items() if item is not None or f.default is not None}
        return made | as_json(getattr(value, MORE, {}))
    return value


@cache
def _check(kind: Any) -> Check:
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return lambda value: _any(value, DEEPEST)
    if hasattr(kind, "parse"):
        return lambda value: _text(value) or _parsed(kind, value)
    if is_dataclass(kind):
        return _fields(kind)
    if origin is Annotated:
        return _annotated(inner[0], inner[1:])
    if origin is Literal:
        return lambda value: "" if type(value) is str and value in inner else f"is {_told(value)}, expected {inner}"
    if origin in (Union, UnionType):
        return _either(inner)
    if origin is tuple:
        return _items(_check(inner[0]))
    if origin in (dict, Mapping):
        return _mapping(_check(inner[0]), _check(inner[1]))
    return _plain(kind)


NUMBER = Within()
INTEGER = Within(-WHOLE - 1, WHOLE)


def _plain(kind: Any) -> Check:
    match kind:
        case _ if kind is float:
            return _annotated(float, (NUMBER,))
        case _ if kind is int:
            return _annotated(int, (INTEGER,))
        case _ if kind is str:
            return _text
        case _ if kind is bool:
            return lambda value: "" if type(value) is bool else f"is {_told(value)}, expected true or false"
        case _ if kind is NoneType:
            return lambda value: "" if value is None else f"is {_told(value)}, expected null"
    raise TypeError(f"shape: no check for {kind!r}")


def _text(value: Any) -> str:
    if type(value) is not str:
        return f"is {_told(value)}, expected text"
    return "" if len(value) <= LONGEST else f"is a text of {len(value)} letters"


def _annotated(kind: Any, marks: tuple[Any, ...]) -> Check:
    """A number within bounds, or a text that matches."""
    kinds = (int, float) if kind is float else (kind,)
    word = {float: "a number", int: "a whole number"}.get(kind, "text")

    def check(value: Any) -> str:
        if type(value) not in kinds:
            return f"is {_told(value)}, expected {word}"
        return next((found for mark in marks if (found := mark.fault(value))), "")

    return check


def _either(kinds: tuple[Any, ...]) -> Check:
    checks = [(kind, _check(kind)) for kind in kinds]

    def check(value: Any) -> str:
        faults = []
        for kind, inner in checks:
            found = inner(value)
            if not found:
                return ""
            if kind is not NoneType:
                faults.append(found)
        return faults[0]

    return check


def _items(inner: Check) -> Check:
    def check(value: Any) -> str:
        if type(value) is not list:
            return f"is {_told(value)}, expected a list"
        for k, item in enumerate(value):
            if found := inner(item):
                return f"[{k}]{_joined(found)}"
        return ""

    return check


def _mapping(of_key: Check, inner: Check) -> Check:
    def check(value: Any) -> str:
        if type(value) is not dict:
            return f"is {_told(value)}, expected an object"
        for key, item in value.items():
            if found := of_key(key):
                return f": a key {found}"
            if found := inner(item):
                return f".{_key(key)}{_joined(found)}"
        return ""

    return check


def _fields(kind: Any) -> Check:
    checks = {name: _check(hint) for name, hint in _hints(kind).items()}
    required = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]

    def check(value: Any) -> str:
        if type(value) is not dict:
            return f"is {_told(value)}, expected an object"
        for name in required:
            if name not in value:
                return f".{name} is missing"
        for name, item in value.items():
            inner = checks.get(name)
            if found := inner(item) if inner is not None else _any(item, DEEPEST):
                return f".{_key(name)}{_joined(found)}"
        return ""

    return check


def _parsed(kind: Any, value: str) -> str:
    try:
        kind.parse(value)
    except ValueError as error:
        return f"is {value[:80]!a}, {str(error).partition(', got')[0].partition(': ')[2]}"
    return ""


@cache
def _hints(kind: Any) -> dict[str, object]:
    return {name: hint for name, hint in get_type_hints(kind, include_extras=True).items() if name != MORE}


@cache
def _maker(kind: Any) -> Make:
    origin, inner = get_origin(kind), get_args(kind)
    if hasattr(kind, "parse"):
        return kind.parse
    if is_dataclass(kind):
        return _dataclass(kind)
    if origin in (Union, UnionType):
        (make,) = [_maker(option) for option in inner if option is not NoneType][:1]
        return _same if make is _same else lambda value: None if value is None else make(value)
    if origin is tuple:
        item = _maker(inner[0])
        return tuple if item is _same else lambda value: tuple(map(item, value))
    if origin in (dict, Mapping):
        key, item = map(_maker, inner)
        return _same if key is item is _same else lambda value: {key(k): item(v) for k, v in value.items()}
    return _same


def _same(value: Any) -> Any:
    return value


def _dataclass(kind: Any) -> Make:
    makers = {name: _maker(hint) for name, hint in _hints(kind).items()}
    keeps = any(field.name == MORE for field in fields(kind))

    def make(value: Mapping[str, Any]) -> Any:
        known = {name: makers[name](item) for name, item in value.items() if name in makers}
        if keeps and len(known) < len(value):
            known[MORE] = {name: item for name, item in value.items() if name not in makers}
        return kind(**known)

    return make


def _any(value: Any, room: int) -> str:
    kind = type(value)
    if kind is str:
        return _text(value)
    if kind is float or kind is bool or value is None:
        return ""
    if kind is int:
        return INTEGER.fault(value)
    if not room:
        return "is nested too deeply"
    if kind is list:
        for k, item in enumerate(value):
            if found := _any(item, room - 1):
                return f"[{k}]{_joined(found)}"
        return ""
    if kind is dict:
        for key, item in value.items():
            if found := _text(key) or _any(item, room - 1):
                return f".{_key(key)}{_joined(found)}"
        return ""
    return f"is {_told(value)}, expected JSON"


def _joined(found: str) -> str:
    return found if found[0] in ".[:" else f" {found}"


def _key(name: Any) -> str:
    """A key as part of a path, with nothing unseen in it."""
    return ascii(name)[1:-1][:60]


def _told(value: Any) -> str:
    """A value in a few words."""
    if value is None:
        return "null"
    if type(value) in (bool, float):
        return str(value).lower()
    if type(value) is int:
        return "a whole number"
    return {str: "text", list: "a list", dict: "an object"}.get(type(value), f"a {type(value).__name__}")
