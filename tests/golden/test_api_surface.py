"""What code outside the bench may use: ihbench/API.md, made from signatures and docstrings, and the entry points.

GOLDEN_WRITE=1 python -m pytest -n 0 tests/golden/test_api_surface.py        # writes both again
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from importlib import import_module
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

import ihbench
from tests.golden.expected import WRITE, check

PAGE = Path(ihbench.__file__).with_name("API.md")
MODULES = {  # what their __all__ names, or these
    "ihbench": None,
    "ihbench.metrics": None,
    "ihbench.body": None,
    "ihbench.camera": ["Camera"],
    "ihbench.render.splat": ["render_gaussians"],
    "ihbench.render.zbuffer": ["rasterize", "Raster"],
    "ihbench.scene.contracts": ["TrainView", "TrainingSet", "TestView", "MaskState", "Avatar", "Method"],
    "ihbench.scene.method_spec": ["MethodSpec", "Paper", "Command"],
    "ihbench.clock.ledger": ["Ledger"],
    "ihbench.errors": ["BadInput", "BadValue", "MissingPrerequisite", "Diverged"],
}
HEAD = """# Python reference

Generated from signatures and docstrings. Arrays are numpy's unless a tensor is named; shapes stand in brackets.
"""


def signature(function: Any) -> str:
    """The head of a function as its source has it, with the comments of its arguments."""
    source = textwrap.dedent(inspect.getsource(function))
    node: Any = ast.parse(source).body[0]
    lines = source.splitlines()[node.lineno - 1 : max(node.body[0].lineno - 1, node.lineno)]
    return "\n".join(lines).removesuffix(" ...")


def fields_of(cls: type) -> str:
    """The lines of a dataclass's fields as its source has them, with their comments: shapes and units."""
    source = inspect.getsource(cls)
    names = "|".join(field.name for field in dataclasses.fields(cls))
    return "\n".join(line.strip() for line in source.splitlines() if re.match(rf"    ({names}): ", line))


def described(name: str, value: Any, level: int = 3) -> str:
    """A heading, what is called or held, and the docstring."""
    parts = [f"{'#' * level} {name}"]
    if not callable(value):
        return "\n\n".join(parts)
    is_class = inspect.isclass(value)
    held = fields_of(value) if dataclasses.is_dataclass(value) and is_class else ""
    plain = is_class and issubclass(value, BaseException | int)
    if not plain and not getattr(value, "_is_protocol", False):
        parts.append(f"```python\n{held or signature(value.__init__ if is_class else value)}\n```")
    parts.append(inspect.cleandoc(value.__doc__ or ""))
    if is_class:
        own = {k: getattr(value, k) for k in vars(value) if not k.startswith("_")}
        methods = [(k, m) for k, m in own.items() if inspect.isroutine(m) and m.__doc__]
        parts += [described(k, method, level + 1) for k, method in methods if not plain]
    return "\n\n".join(part for part in parts if part)


def reference() -> str:
    blocks = [HEAD.strip()]
    for module, only in MODULES.items():
        room = import_module(module)
        blocks += [f"## {module}", inspect.cleandoc(room.__doc__ or "")]
        blocks += [described(name, getattr(room, name)) for name in sorted(only or room.__all__)]
    return "\n\n".join(blocks) + "\n"


def test_the_reference_is_as_the_code_is():
    with pytest.raises(Exception, match="nope"):  # what a call imports must not take a function's place
        ihbench.run("nope")
    text = reference()
    if WRITE:
        PAGE.write_text(text, encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == text, "GOLDEN_WRITE=1 writes it again"


def test_the_entry_points_are_as_they_were():
    groups: dict[str, list[str]] = {}
    for point in sorted(distribution("ihbench").entry_points):
        groups.setdefault(point.group, []).append(point.name)
    check("entry_points.json", json.dumps(groups, indent=1, sort_keys=True))
