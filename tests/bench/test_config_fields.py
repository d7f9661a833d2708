"""Dotted names for the fields of a configuration in a configuration."""

from dataclasses import dataclass, field

import pytest

from ihbench.config_fields import flat, with_fields


@dataclass(frozen=True)
class Inner:
    a: int = 1
    b: str = "x"


@dataclass(frozen=True)
class Outer:
    c: float = 2.0
    inner: Inner = field(default_factory=Inner)


def test_nested_fields_come_dotted_and_go_back():
    assert flat(Outer()) == {"c": 2.0, "inner.a": 1, "inner.b": "x"}
    changed = with_fields(Outer(), {"inner.b": "y", "c": 3.0})
    assert changed == Outer(3.0, Inner(1, "y"))
    assert with_fields(Outer(), flat(changed)) == changed
    assert with_fields(Outer(), {}) == Outer()


@pytest.mark.parametrize("name", ["other", "c.a", "inner.other"])
def test_unknown_fields_are_refused(name):
    with pytest.raises(TypeError):
        with_fields(Outer(), {name: 1})
