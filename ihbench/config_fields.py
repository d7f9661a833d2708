"""The fields of options, configurations, protocols and records: how values are spelled, which fit, and their names
and tables.

Fields carry their bounds with their type, `Annotated[int, Within(1, 99)]`; `check` holds a value against both, `read`
makes a typed value of what a TOML or JSON file has. A number without bounds of its own must be finite and below 2^63.
A dataclass in a dataclass has dotted names, as on the command line (`flat`), and is a table of its own in files.
"""

from __future__ import annotations

import math
import re
import types
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ihbench.errors import BadInput
from ihbench.registry import nearest

LONGEST_WORD = 1000  # characters of one value on the command line
LARGEST_CAST = 99  # people of a stand-in that can be named, whether a protocol names them or not
IMAGE_SIZES = (8, 8192)  # px of the longer side
LARGEST_SEED = 2**32 - 1  # what every generator of random numbers takes, numpy's old one as well
STEPS = 10_000_000  # of an optimisation, at most
WHOLE = re.compile(r"-?[0-9]{1,19}")
REAL = re.compile(r"-?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[-+]?[0-9]{1,3})?|-?inf|nan", re.IGNORECASE)
LONGEST_NAME, LONGEST_TEXT = 80, 2000  # characters
LARGEST = 1e15  # of a measured number: far from where sums overflow or doubles skip whole numbers
MORE = "more"  # the field of a dataclass for keys that it does not know

Kind = TypeVar("Kind")
Values = dict[str, Any]  # a field, named as `flat` names it -> its value, of any type


@dataclass(frozen=True)
class Within:
    """The numbers from `low` to `high`; with `above`, `low` itself is not one of them. NaN and +infinity only where
    they are named."""

    low: float = -LARGEST
    high: float = LARGEST
    above: bool = False
    words: str = ""
    nan: bool = False
    infinite: bool = False

    def holds(self, number: float) -> bool:
        if self.low <= number <= self.high:
            return not (self.above and number == self.low)
        return (self.nan and number != number) or (self.infinite and number == math.inf)

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


@dataclass(frozen=True)
class Entries:
    """Lists of `least` to `most` entries."""

    least: int = 0
    most: int = 10_000


@dataclass(frozen=True)
class TextRule:
    """Texts for which `holds` does; in words."""

    words: str
    holds: Callable[[str], object]


def _is_folder_name(text: str) -> bool:
    unfit = any(sign in "/\\" or unicodedata.category(sign)[0] == "C" for sign in text)
    return bool(text.strip()) and len(text) <= LONGEST_NAME and not (unfit or text.startswith("."))


NAME_WORDS = f"a name of 1 to {LONGEST_NAME} characters, no slash, no dot in front, no control character"
TEXT_WORDS = f"a text of up to {LONGEST_TEXT} characters"
SEEDS = Within(0, LARGEST_SEED)
ANY_NUMBER = Within(-(2**63), 2**63 - 1, words="a finite number, below 2^63")
Name = Annotated[str, TextRule(NAME_WORDS, _is_folder_name)]  # may become a folder: a subject, a protocol's id
Text = Annotated[str, TextRule(TEXT_WORDS, lambda text: len(text) <= LONGEST_TEXT)]


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
    if len(text) > LONGEST_WORD:
        raise ValueError(f"{text[:40]!r}…: {len(text)} characters; expected up to {LONGEST_WORD}")
    if any(unicodedata.category(sign) in ("Cc", "Cs") for sign in text):
        raise ValueError(f"{text[:40]!r}: holds control characters, or is not UTF-8; expected plain text")
    return text


def check(values: Any, prefix: str = "--", only: Collection[str] | None = None) -> None:
    """Hold every field of a dataclass (or some), and of those in it, against its type and bounds.

    `prefix` stands before the field's name in what is said of it; without one that is an argument's. Raises
    `BadInput` for the first that does not fit.
    """
    for field in fields(values):
        name, hint, default = field.name, _hints(type(values))[field.name], field.default
        if only is not None and name not in only:
            continue
        value, flag = getattr(values, name), (prefix + _flag(name, hint) if prefix else name)
        if is_config(value):
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
                        limits = " and ".join(str(other) for other in bounds)
                        raise BadInput(f"{flag} {shown(value)}: expected {limits}")


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
    if hint is Any:
        return True
    if origin is Literal:
        return any(type(value) is type(part) and value == part for part in parts)
    if origin is tuple and len(parts) == 2 and parts[1] is Ellipsis:
        return isinstance(value, tuple) and all(fits(item, parts[0]) for item in value)
    if hint in (int, float):
        return isinstance(value, int if hint is int else int | float) and not isinstance(value, bool)
    return isinstance(value, origin or hint)


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


def _flag(name: str, hint: Any) -> str:
    """How the command line calls a field: tyro's own name for it where it has one."""
    named = (getattr(word, "name", None) for word in getattr(hint, "__metadata__", ()))
    return next((word for word in named if isinstance(word, str)), name.replace("_", "-"))


@cache
def rules(hint: Any) -> tuple[Within | MultipleOf, ...]:
    """The bounds that stand beside a type, or inside it."""
    own = [word for word in getattr(hint, "__metadata__", ()) if isinstance(word, Within | MultipleOf)]
    origin, parts = get_origin(hint), get_args(hint)
    inside = () if origin is Literal else parts[:1] if origin is Annotated else parts
    return (*own, *(rule for part in inside for rule in rules(part)))


def flat(config: Any) -> Values:
    """Name -> value of a dataclass or a table; the fields of a nested one come as "outer.inner"."""
    out: Values = {}
    table = isinstance(config, Mapping)
    for name, value in (config if table else _members(config)).items():
        if isinstance(value, Mapping) if table else is_config(value):
            out |= {f"{name}.{inner}": leaf for inner, leaf in flat(value).items()}
        else:
            out[name] = value
    return out


def with_fields(config: Any, values: Mapping[str, Any]) -> Any:
    """The configuration with some fields, named as `flat` names them, replaced. Raises `TypeError` for others, and
    `BadInput` for values of another type or out of bounds."""
    changed = replaced(config, values)
    check(changed, "--method.")
    return changed


def replaced(config: Kind, values: Mapping[str, Any]) -> Kind:
    """As `with_fields`, values unchecked."""
    own: Values = {name: value for name, value in values.items() if "." not in name}
    for outer in dict.fromkeys(name.partition(".")[0] for name in values if "." in name):
        inner = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(outer + ".")}
        nested = getattr(config, outer, None)
        if not is_config(nested):
            raise TypeError(f"no field {outer!r} with fields of its own")
        own[outer] = replaced(nested, inner)
    return replace(config, **own)  # type: ignore[type-var]


def is_config(value: Any) -> bool:
    """Whether a value is a dataclass's (and not a dataclass)."""
    return is_dataclass(value) and not isinstance(value, type)


def hints(kind: type) -> dict[str, object]:
    """Name -> type of every field of a dataclass, nested ones as in `flat`; what is written as a text is a value."""
    out: dict[str, object] = {}
    own = _hints(kind)
    for field in fields(kind):
        hint = own[field.name]
        if isinstance(hint, type) and is_dataclass(hint) and not has_text(hint):
            out |= {f"{field.name}.{inner}": its for inner, its in hints(hint).items()}
        else:
            out[field.name] = hint
    return out


def has_text(hint: Any) -> bool:
    """Whether a type's values can be written as a text, which its `parse` reads (raising `ValueError`)."""
    return getattr(hint, "HAS_TEXT", hasattr(hint, "parse"))


def as_table(value: Any, kind: type | None = None) -> Any:
    """A value as TOML and JSON have it: dataclasses (as if of `kind`, a parent) and mappings as tables, tuples as
    lists; a field that has its default is left out."""
    if is_config(value):
        own = [(field.name, getattr(value, field.name), field.default) for field in fields(kind or value)]
        return {name: as_table(item) for name, item, default in own if default is MISSING or item != default}
    if isinstance(value, Mapping):
        return {name: as_table(item) for name, item in value.items()}
    return [as_table(item) for item in value] if isinstance(value, tuple | list) else value


def as_json(value: Any) -> Any:
    """A value as a record has it: as `as_table`, but of fields that have their default only None is left out."""
    if is_config(value):
        known = [(field, getattr(value, field.name)) for field in fields(value) if field.name != MORE]
        made = {f.name: as_json(item) for f, item in known if item is not None or f.default is not None}
        return made | as_json(getattr(value, MORE, {}))
    if isinstance(value, Mapping):
        return {str(name): as_json(item) for name, item in value.items()}
    return [as_json(item) for item in value] if isinstance(value, tuple | list) else value


def read(hint: Any, value: Any, where: str, key: str = "", strict: bool = True) -> Any:
    """A value of a type from what TOML or JSON has of it; a dataclass from a table, or a text if it has one.

    Raises `BadInput` for the first part that is not of its type or out of bounds, named by its key: "where:
    image.size: expected …". `strict` refuses keys that a dataclass does not have; off for files that another version
    may have written: there a field `more` takes them.
    """
    if value is None and fits(value, hint):
        return None
    plain, origin, parts, marks, bounds = _taken_apart(hint)
    if has_text(plain) and isinstance(value, str):
        try:
            return plain.parse(value)
        except ValueError as error:
            raise BadInput(f"{_at(where, key)}: {error}, found {shown(value)}") from error
    if isinstance(plain, type) and is_dataclass(plain):
        return _read_fields(plain, value, where, key, strict)
    if origin in (dict, Mapping):
        named = f"{key}, the name of an entry"
        return {
            read(parts[0], name, where, named): read(parts[1], item, where, f"{key}.{name[:LONGEST_NAME]}", strict)
            for name, item in _table(value, where, key).items()
        }
    if origin is tuple:
        free = parts[-1] is Ellipsis
        sizes = next((mark for mark in marks if isinstance(mark, Entries)), Entries())
        least, most = (sizes.least, sizes.most) if free else (len(parts), len(parts))
        if not isinstance(value, list | tuple) or not least <= len(value) <= most:
            count = f"{least} to {most}" if free else least
            raise BadInput(f"{_at(where, key)}: expected a list of {count} entries, found {_shown(value)}")
        kinds = parts[:1] * len(value) if free else parts
        entries = enumerate(zip(kinds, value, strict=True), 1)
        return tuple(read(kind, item, where, f"{key}, entry {k}", strict) for k, (kind, item) in entries)
    words: list[Any] = [mark for mark in marks if isinstance(mark, TextRule)]
    limits = () if isinstance(value, bool) or not isinstance(value, int | float) else bounds
    if not (fits(value, hint) and all(rule.holds(value) for rule in (*limits, *words))):
        wanted = words[0].words if words else expected(hint)
        raise BadInput(f"{_at(where, key)}: expected {wanted}, found {_shown(value)}")
    return value


@cache
def _taken_apart(hint: Any) -> tuple[Any, Any, tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """A type without None and marks, its origin and parameters; its marks; the bounds of its numbers."""
    some = [part for part in get_args(hint) if part is not type(None)]
    own = some[0] if get_origin(hint) in (Union, types.UnionType) and len(some) == 1 else hint
    plain, marks = (get_args(own)[0], own.__metadata__) if get_origin(own) is Annotated else (own, ())
    return plain, get_origin(plain), get_args(plain), marks, rules(own) or (() if own is Any else (ANY_NUMBER,))


def _at(where: str, key: str) -> str:
    return ": ".join(filter(None, (where, key)))


def _read_fields(kind: type[Kind], value: Any, where: str, key: str, strict: bool) -> Kind:
    table, inside = _table(value, where, key), f"{key}." if key else ""
    known = {field.name: field for field in fields(kind) if field.name != MORE}  # type: ignore[arg-type]
    for name in table:
        if strict and name not in known:
            raise BadInput(f"{where}: unknown key {inside + name!r}: {nearest(name, list(known))}")
    for name, field in known.items():
        if name not in table and field.default is field.default_factory is MISSING:
            raise BadInput(f"{_at(where, f'key {inside + name!r}')} is missing")
    own = _hints(kind)
    given = {name: read(own[name], table[name], where, inside + name, strict) for name in known if name in table}
    if MORE in own:
        given[MORE] = {name: item for name, item in table.items() if name not in known}
    try:
        return kind(**given)
    except ValueError as error:
        raise BadInput(f"{where}: {key + ': ' if key else ''}{error}") from error


@cache
def _hints(kind: type) -> dict[str, object]:
    return get_type_hints(kind, include_extras=True)


def _table(value: Any, where: str, key: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise BadInput(f"{_at(where, key or 'the file')}: expected a table, found {_shown(value)}")
    return value


def _members(config: Any) -> Values:
    return {field.name: getattr(config, field.name) for field in fields(config)}


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a table"
    return f"a list of {len(value)}" if isinstance(value, list | tuple) and len(value) > 3 else shown(value)
