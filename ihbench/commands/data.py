"""`ihbench data check DIR` and `ihbench data standin`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ihbench import registry
from ihbench.commands.options.parse import subcommand
from ihbench.commands.options.printing import Printing
from ihbench.config_fields import LARGEST_CAST, SEEDS, Within
from ihbench.document.document import Block, Heading, Table
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.scene.copy_report import CopyReport


@dataclass(frozen=True)
class Check(Printing):
    """Name the layout and variant found in a folder, what is missing (problems) and what is suspicious (warnings).

    Changes nothing. Status 0 also with warnings, 1 with problems."""

    folder: Annotated[Path, tyro.conf.Positional]
    """The data folder."""
    body: Path | None = None
    """SMPL model file for real data (or IHBENCH_BODY): poses are then held against the masks."""
    overlays: Path | None = None
    """Folder for a picture of each subject with the body's outline on its images; by default data_check."""


@dataclass(frozen=True)
class Standin:
    """Write a stand-in capture in a data set's own layout."""

    out: Path
    """Folder to write into; images that are already there are kept."""
    dataset: str = "zju_mocap"
    """Whose layout."""
    seed: Annotated[int, SEEDS] = 0
    """Another seed is another cast: other bodies, clothes and motions."""
    subjects: Annotated[int, Within(1, LARGEST_CAST)] = 1
    """How many people."""
    protocol: str | None = None
    """Which images: those that this protocol reads; by default the one that the stand-in is made for."""
    profile: str = "paper"
    """Profile of that protocol."""


def main(argv: list[str]) -> int:
    chosen = subcommand(
        {"check": Check, "standin": Standin}, argv, "data", "Check a data folder, or write a stand-in capture."
    )
    return _check(chosen) if isinstance(chosen, Check) else _standin(chosen)


def _check(chosen: Check) -> int:
    from ihbench.body import load_body
    from ihbench.data.data_check import add_fitness
    from ihbench.data.mesh_check import look_at_mesh
    from ihbench.scene.data_source import body_file, folder_nearby, is_about_a_file, own_body, own_data

    folder = own_data(chosen.folder)
    assert folder is not None
    named = own_body(chosen.body)
    body = None if named is None else load_body(body_file(named, "neutral"))
    complaints = []
    for name in registry.names("dataset"):
        try:
            report = registry.load("dataset", name).check(folder, body)
        except BadInput as error:
            if is_about_a_file(error, folder):
                raise
            complaints.append(f"{name}: {error}")
            continue
        add_fitness(report, folder, body, chosen.overlays)
        if body is not None:
            mesh, warnings = look_at_mesh(body)
            report = replace(report, body_mesh=mesh, warnings=warnings)
        report_json = report.as_json()
        chosen.show(report_json, _blocks(report), "\n".join(_lines(report_json)))
        return 0 if report.ok else 1
    other = folder_nearby(folder, registry.names("dataset"))
    if other is not None:
        raise BadInput(f"data folder {folder}: no known layout; did you mean {other}?")
    raise BadInput(f"data folder {folder}: no known layout ({'; '.join(complaints)})")


def _blocks(report: CopyReport) -> list[Block]:
    """A table of what is said of the copy, and one for each subject."""
    blocks: list[Block] = [Heading(1, f"Data check: {report.root}")]
    whole = {key: item for key, item in report.as_json().items() if key != "subjects"}
    for about in (whole, *(subject.as_json() for subject in report.subjects)):
        blocks.append(Heading(2, str(about.get("subject", report.dataset))))
        rows: list[tuple[str, str]] = []
        for key, item in about.items():
            several = {f"{key}: {k}": v for k, v in item.items()} if isinstance(item, dict) else {key: item}
            rows += [(k, "; ".join(map(str, v)) if isinstance(v, list) else str(v)) for k, v in several.items()]
        blocks.append(Table(("what", "found"), tuple(rows), left=2))
    return blocks


def _lines(value: Any, indent: str = "") -> Iterator[str]:
    """Nested plain data as indented "key: value" lines."""
    for key, item in value.items():
        if isinstance(item, dict):
            yield f"{indent}{key}:"
            yield from _lines(item, indent + "  ")
        elif isinstance(item, list) and any(isinstance(entry, dict) for entry in item):
            for entry in item:
                yield f"{indent}{key.removesuffix('s')}:"
                yield from _lines(entry, indent + "  ")
        elif key in ("problems", "warnings") and item:
            yield from (f"{indent}{key.removesuffix('s')}: {line}" for line in item)
        elif isinstance(item, list):
            yield f"{indent}{key}: {', '.join(map(str, item)) or 'none'}"
        else:
            yield f"{indent}{key}: {item if item != '' else '-'}"


def _standin(chosen: Standin) -> int:
    from ihbench.clock.progress import Progress
    from ihbench.scene.data_source import wanted_frames
    from ihbench.scene.protocol import load_protocol

    standin = registry.load("stand-in", chosen.dataset)
    protocol = load_protocol(chosen.protocol or standin.protocol, chosen.profile)
    if protocol.dataset != chosen.dataset:
        raise BadInput(f"protocol {protocol.name} is about {protocol.dataset!r}, not {chosen.dataset!r}")
    names = standin.subjects(chosen.subjects)
    standin.ensure(chosen.out, chosen.seed, names, wanted_frames(protocol, standin), Progress())
    print(f"{', '.join(names)} (seed {chosen.seed}) written to {chosen.out}; run with --data {chosen.out}")
    return 0
