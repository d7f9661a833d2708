"""A method's configuration as flat names: a dataclass in a dataclass has dotted fields, as on the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from ihbench.bounds import check


def flat(config: Any) -> dict[str, Any]:
    """Name -> value; the fields of a nested dataclass come as "outer.inner"."""
    out: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            out |= {f"{field.name}.{name}": inner for name, inner in flat(value).items()}
        else:
            out[field.name] = value
    return out


def with_fields(config: Any, values: Mapping[str, Any]) -> Any:
    """The configuration with some fields, named as `flat` names them, replaced. Raises `TypeError` for others, and
    `BadInput` for values of another type or out of bounds."""
    changed = _replaced(config, values)
    check(changed, "--method.")
    return changed


def _replaced(config: Any, values: Mapping[str, Any]) -> Any:
    own: dict[str, Any] = {name: value for name, value in values.items() if "." not in name}
    for outer in dict.fromkeys(name.partition(".")[0] for name in values if "." in name):
        inner = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(outer + ".")}
        nested = getattr(config, outer, None)
        if not is_dataclass(nested) or isinstance(nested, type):
            raise TypeError(f"no field {outer!r} with fields of its own")
        own[outer] = _replaced(nested, inner)
    return replace(config, **own)
