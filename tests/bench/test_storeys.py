"""The order of the storeys, and that no import goes in a circle. Lazy imports and those for types count."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("methods", "datasets", "protocols", "reports")
BELOW = (
    "version",
    "errors",
    "registry",
    "camera",
    "config_fields",
)  # of the root, what every storey may use
STOREYS = (
    *("files", "clock", "render", "body", "nets", "metrics", "document", "scene", "fit", "diffusion"),
    *("scoring", "record", "data", "runner", "show", "export", "kernels", "stress", "commands"),
)
MOST_IN_ROOT, MOST_IN_FOLDER = 10, 17  # modules, `__init__` and `__main__` apart


def modules(root):
    """Dotted name -> file of everything under `ihbench` and the rooms beside it."""
    found = {}
    for room in ("ihbench", *ROOMS):
        for path in sorted((root / room).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            parts = parts if room == "ihbench" else ("ihbench", *parts)
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path, known):
    """Modules among `known` that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in known else node.module for name in whole]
        yield from (name for name in names if name in known)


def graph(root):
    known = modules(root)
    return {name: set(imported(path, known)) - {name} for name, path in known.items()}


def height(name):
    """Number of a module's storey; None for those of the rooms, which are content."""
    parts = name.split(".")[1:]
    if parts[:1] and parts[0] in ROOMS:
        return None
    if parts[:1] and parts[0] in STOREYS:
        return STOREYS.index(parts[0])
    return -1 if parts[:1] and parts[0] in BELOW else len(STOREYS)


def climbs(arrows):
    """Imports of a higher storey, in words."""
    for name, targets in arrows.items():
        for target in sorted(targets):
            here, there = height(name), height(target)
            if here is not None and there is not None and there > here:
                yield f"{name} imports {target}"


def circles(arrows):
    """Groups of modules that import each other (Tarjan's strongly connected components of more than one)."""
    number, lowest, stack, found = {}, {}, [], []

    def visit(name):
        number[name] = lowest[name] = len(number)
        stack.append(name)
        for target in sorted(arrows[name]):
            if target not in number:
                visit(target)
            if target in stack:
                lowest[name] = min(lowest[name], lowest[target])
        if lowest[name] == number[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    for name in arrows:
        if name not in number:
            visit(name)
    return found


@pytest.fixture(scope="module")
def arrows():
    return graph(ROOT)


def test_imports_go_down(arrows):
    assert list(climbs(arrows)) == []


def test_no_import_goes_in_a_circle(arrows):
    assert circles(arrows) == []


def test_folders_stay_small():
    for folder in {path.parent for path in modules(ROOT).values()}:
        names = [path.name for path in folder.glob("*.py") if not path.name.startswith("__")]
        assert len(names) <= (MOST_IN_ROOT if folder == ROOT / "ihbench" else MOST_IN_FOLDER), folder


def test_a_wrong_import_and_a_circle_are_seen(tmp_path):
    for name, text in {
        "files/low.py": "def f():\n    from ihbench.scene import high\n",
        "scene/high.py": "from ihbench.files.low import f\n",
        "files/fine.py": "from ihbench.errors import BadInput\n",
        "errors.py": "",
    }.items():
        (tmp_path / "ihbench" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "ihbench" / name).write_text(text)
    arrows = graph(tmp_path)
    assert list(climbs(arrows)) == ["ihbench.files.low imports ihbench.scene.high"]
    assert circles(arrows) == [["ihbench.files.low", "ihbench.scene.high"]]
