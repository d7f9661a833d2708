"""Finding registered things (methods, data sets, protocols, …) by name, without importing them until asked.

Everything is a Python entry point, so a third-party package registers its own the same way this one does.
"""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput

GROUPS = {
    "method": "ihbench.methods",
    "dataset": "ihbench.datasets",
    "stand-in": "ihbench.standins",
    "training layout": "ihbench.training_layouts",
    "people": "ihbench.people",
    "motion": "ihbench.motions",
    "table": "ihbench.tables",
    "protocol": "ihbench.protocols",
    "occlusion": "ihbench.occlusions",
    "report": "ihbench.reports",
    "report verb": "ihbench.report_verbs",
    "figure": "ihbench.figures",
    "paper figure": "ihbench.paper_figures",
    "site": "ihbench.sites",
    "metric preset": "ihbench.presets",
}

ROOMS = ("methods", "datasets", "protocols", "reports")  # of the bench: content, found by name
NEEDS = {  # attributes of what is registered
    "report verb": ("main",),
    "site": ("build", "write_folder", "write_single", "serve"),
    "dataset": ("check",),
    "stand-in": ("version", "protocol", "subjects", "ensure", "n_frames", "n_cameras"),
    "metric preset": ("about", "source", "measures"),
    "motion": ("seconds", "motion"),
}


@cache
def _found(kind: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in sorted(entry_points(group=GROUPS[kind]), key=lambda p: p.name)}


@cache
def clashes(kind: str) -> dict[str, str]:
    """Names that several distributions give to different things -> one line: which, and what to do.

    None of them is taken: which one came last would depend on the order of installation. A distribution that lies in
    several places of the path counts once, as for Python, and so do several names of one object.
    """
    by_name: dict[str, dict[str, str]] = {}
    for point in entry_points(group=GROUPS[kind]):
        by_name.setdefault(point.name, {})[point.value] = point.dist.name if point.dist is not None else point.module
    return {
        name: f"registered by {' and by '.join(f'{who} ({what})' for what, who in sorted(makers.items()))}; "
        "uninstall all but one of these packages, or have theirs renamed"
        for name, makers in sorted(by_name.items())
        if len(makers) > 1
    }


def names(kind: str) -> list[str]:
    """Registered names of a kind, sorted."""
    return list(_found(kind))


def nearest(name: str, known: list[str]) -> str:
    """The end of an unknown-name message: "did you mean 'x'? known: x, y"."""
    close = get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}known: {', '.join(known) or 'none'}"


def entry_point(kind: str, name: str) -> EntryPoint:
    """The entry point itself. Raises `BadInput` for a name of several, and with the nearest known name."""
    points = _found(kind)
    if name in clashes(kind):
        raise BadInput(f"{kind} {name!r} is {clashes(kind)[name]}")
    if name not in points:
        raise BadInput(f"unknown {kind} {name!r}: {nearest(name, list(points))}")
    return points[name]


def load(kind: str, name: str) -> Any:
    """Import and return the registered object.

    Raises `BadInput` for an unknown name, and for an object that cannot be imported, whatever its import raises, or
    lacks what its kind needs.
    """
    point = entry_point(kind, name)
    try:
        registered = point.load()
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{error if isinstance(error, ImportError) else repr(error)}".split())
        raise BadInput(f"{kind} {name!r} cannot be loaded{_of(point)}: {reason}") from error
    for attribute in NEEDS.get(kind, ()):
        if not hasattr(registered, attribute):
            raise BadInput(f"{kind} {name!r} cannot be used{_of(point)}: {point.value} has no {attribute}")
    return registered


def _of(point: EntryPoint) -> str:
    return f" (package {point.dist.name})" if point.dist is not None else ""


def other_packages() -> dict[str, str]:
    """Importable package -> distribution, of everything registered that is not the bench's own."""
    points = [point for kind in GROUPS for point in _found(kind).values()]
    modules = {point.module.partition(".")[0]: point for point in points}
    return {
        module: module if point.dist is None else point.dist.name
        for module, point in modules.items()
        if module != "ihbench"
    }


def package_folder(kind: str, name: str) -> Path:
    """The folder of the package that registers a name, found without importing the registered module itself."""
    module = entry_point(kind, name).module
    for candidate in filter(None, (module, module.rpartition(".")[0])):
        if (spec := find_spec(candidate)) and spec.submodule_search_locations:
            return Path(next(iter(spec.submodule_search_locations)))
    raise BadInput(f"{kind} {name!r}: its package {module!r} cannot be found")


def room(name: str) -> Path:
    """The folder of one of `ROOMS`."""
    return Path(import_module(f"ihbench.{name}").__path__[0])


def source(kind: str, name: str) -> Path:
    """The folder or file with the code behind a name: of another distribution its top package or module, whole; of
    one of the bench's rooms the package that registers the name; else the bench. Imports none of them."""
    module = entry_point(kind, name).module
    top, *inner = module.split(".")
    if top == "ihbench":
        return _deepest(room(inner[0]), inner[1:]) if inner and inner[0] in ROOMS else Path(__file__).parent
    spec = find_spec(top)
    if spec is not None and spec.origin is not None:
        origin = Path(spec.origin)
        return origin.parent if spec.submodule_search_locations else origin
    for place in (spec.submodule_search_locations or ()) if spec is not None else ():  # folders without __init__.py
        inner_folder = _deepest(Path(place), inner)
        if inner_folder != Path(place):
            return inner_folder
    raise BadInput(f"{kind} {name!r}: the source of {module!r} cannot be found")


def _deepest(folder: Path, inner: list[str]) -> Path:
    """The innermost package on the way to a module; the module's own file where none is inside."""
    for part in inner:
        if not (folder / part).is_dir():
            file = folder / f"{part}.py"
            return file if file.is_file() and not (folder / "__init__.py").is_file() else folder
        folder = folder / part
    return folder
