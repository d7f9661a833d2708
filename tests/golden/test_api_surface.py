"""What code outside the bench may use: names and signatures from Python, entry points of the package."""

from __future__ import annotations

import inspect
import json
from importlib import import_module
from importlib.metadata import distribution
from typing import Any

import pytest

import ihbench
from tests.golden.expected import check

MODULES = {"ihbench": None, "ihbench.metrics": None, "ihbench.body": None}  # what their __all__ names
MODULES |= {"ihbench.camera": ["Camera"], "ihbench.render.splat": ["render_gaussians"]}


def described(value: Any) -> Any:
    """A signature; of a class its constructor's and its public methods'; of anything else the type."""
    if inspect.isclass(value):
        own = {name: getattr(value, name) for name in vars(value) if not name.startswith("_")}
        methods = {name: str(inspect.signature(m)) for name, m in sorted(own.items()) if callable(m)}
        return {"()": str(inspect.signature(value)), **methods, "other": sorted(own.keys() - methods.keys())}
    return str(inspect.signature(value)) if callable(value) else type(value).__name__


def test_the_python_surface_is_as_it_was():
    with pytest.raises(Exception, match="nope"):  # what a call imports must not take a function's place
        ihbench.run("nope")
    surface = {
        name: {public: described(getattr(import_module(name), public)) for public in sorted(only or _all(name))}
        for name, only in MODULES.items()
    }
    check("api_surface.json", json.dumps(surface, indent=1, ensure_ascii=False))


def test_the_entry_points_are_as_they_were():
    groups: dict[str, list[str]] = {}
    for point in sorted(distribution("ihbench").entry_points):
        groups.setdefault(point.group, []).append(point.name)
    check("entry_points.json", json.dumps(groups, indent=1, sort_keys=True))


def _all(module: str) -> list[str]:
    return import_module(module).__all__
