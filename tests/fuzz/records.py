"""Every field of every JSON of a run folder, damaged in every way, and every file replaced by something else."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ihbench.cli import main
from ihbench.clock.events import Inpainted, Resumed
from ihbench.clock.ledger import Ledger
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.record.finished_run import FinishedRun, earlier_runs
from ihbench.record.index import Index
from ihbench.record.results import read_result
from ihbench.record.schema import CurvePoint, PredictionFiles, PresetHead, ScoreLine
from ihbench.record.store import RunFolder
from ihbench.reports.general import ablation
from ihbench.runner.ablation import AblationSuite, Comparison, Variant
from ihbench.runner.executor import Cell, CellOutcome
from ihbench.runner.shared_states import reusable_run, reuse_state
from ihbench.scene.plan import Omission
from tests.reports.fake_runs import LPIPS, about, identity, means

MISSING = object()
HUGE = "9" * 400
VALUES: dict[str, Any] = {
    "missing": MISSING,
    "null": None,
    "text": "\x1b]0;text\x07\u202e",
    "list": [[], {}],
    "object": {"": []},
    "number": 1234567.5,
    "negative": -1,
    "10^400": int(HUGE),
    "true": True,
    "nan": "nan",  # as the bench writes it
}


@dataclass(frozen=True)
class Case:
    """One damage: `apply` does it to a copy of the run folder."""

    name: str
    apply: Callable[[Path], None]


def cases(folder: Path) -> Iterator[Case]:
    """All damages of a run folder, which is only read: field by field, then file by file."""
    for file in sorted([folder / "run.json", *folder.rglob("*.jsonl")]):
        name = file.relative_to(folder)
        documents = [json.loads(line) for line in _texts(file)]
        for number, document in enumerate(documents):
            for path in _paths(document):
                for kind, value in VALUES.items():
                    where = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
                    yield Case(f"{name} line {number} {where}: {kind}", _edit(name, number, path, value))
        for kind, content in _contents(file).items():
            yield Case(f"{name}: {kind}", _replace(name, content))
        for kind, make in PLACES.items():
            yield Case(f"{name}: {kind}", _put(name, make))


def _texts(file: Path) -> list[str]:
    text = file.read_text(encoding="utf-8")
    return text.splitlines() if file.suffix == ".jsonl" else [text]


def _paths(value: Any, before: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The way to every value inside a JSON value, and to itself."""
    yield before
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for step, item in inner:
        yield from _paths(item, (*before, step))


def _edit(name: Path, number: int, path: tuple[str | int, ...], value: Any) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        texts = _texts(folder / name)
        texts[number] = _dumped(_with(json.loads(texts[number]), path, value))
        (folder / name).write_text("".join(text + "\n" for text in texts if text), encoding="utf-8")

    return apply


def _with(document: Any, path: tuple[str | int, ...], value: Any) -> Any:
    if not path:
        return value
    *way, last = path
    target = document
    for step in way:
        target = target[step]
    if value is MISSING:
        del target[last]
    else:
        target[last] = value
    return document


def _dumped(value: Any) -> str:
    return "" if value is MISSING else json.dumps(value)


def _contents(file: Path) -> dict[str, bytes]:
    """Other contents of a file."""
    data = file.read_bytes()
    return {
        "empty": b"",
        "cut": data[: len(data) // 2],
        "twice": data * 2,
        "lines dropped": b"".join(data.splitlines(keepends=True)[:-1]),
        "not UTF-8": data.replace(b'"', b"\xff", 1),
        "byte-order mark": b"\xef\xbb\xbf" + data,
        "NUL": data.replace(b'"', b"\0", 1),
        "a key twice": data.replace(b"{", b'{"row": "x", "status": "done", "row": "y", "status": "failed",', 1),
        "nested without end": b"[" * 200_000,
        "nested deeply": b'{"a":' * 900 + b"1" + b"}" * 900,
        "endless digits": b'{"schema_version": ' + b"9" * 10_000 + b"}",
        "NaN": data.replace(b": ", b': NaN, "x": ', 1),
        "overflow": data.replace(b": ", b': 1e999, "x": ', 1),
        "lone surrogate": data.replace(b'": "', b'": "\\ud800', 1),
        "a newer version": data.replace(b'"schema_version": 2', b'"schema_version": 99', 1) + b" ",
    }


def _replace(name: Path, content: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content) and None


def _put(name: Path, make: Callable[[Path], Any]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / name).unlink()
        make(folder / name)

    return apply


def _sparse(file: Path) -> None:
    with file.open("wb") as stream:
        stream.truncate(2**40)  # takes no room


PLACES: dict[str, Callable[[Path], Any]] = {
    "gone": lambda file: None,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to nothing": lambda file: file.symlink_to("nothing"),
    "a link to itself": lambda file: file.symlink_to(file.name),
    "a link to a device": lambda file: file.symlink_to("/dev/zero"),
    "a terabyte": _sparse,
}


# ------------------------------------------------------------------------------------------------- what must hold


GOOD, VICTIM = "good", "victim"  # methods
LEVELS = MappingProxyType({"levels": (16, 64)})


def make_run(runs: Path, method: str, scene: str = "a", seed: int = 0, changed: Mapping[str, Any] = LEVELS) -> Path:
    """A finished run that has everything a run folder may hold, but pictures and an avatar."""
    left_out = Omission("steps", 5, "still", {"fit/stage1": 0.5}), Omission("hidden", None, "none")
    files = PredictionFiles(missing=(), surplus=(), notes=("odd",), doubts=("BGR",), alpha="straight", views=4)
    told = about(
        changed=dict(changed), left_out=left_out, device="cpu", hidden_share=0.5, measure={"pixel_mm": 4.0},
        body="procedural", predictions=files,
    )  # fmt: skip
    content = {**(told.protocol or {}), "id": "zju_occ", "image": {"size": 64, "background": [1.0, 1.0, 1.0]}}
    told = replace(told, protocol=content)
    config = {
        "levels": [16, 64],
        "grid": {"on": True},
        "rate": 1e-3,
        "keep": ["steps"],
        "set": [*map(str, changed.items())],
    }
    own = identity(scene, method, config=config, seed=seed)
    run = RunFolder.create(runs, own, told)
    ledger = Ledger()
    with ledger.stage("fit"), ledger.stage("stage1"):
        pass
    painted = {"views": 3, "of": 4, "pixels": 100, "flicker": {"deviation": 0.1, "deviation_floor": 0.05}}
    drift = {"delta_e": 3.0, "delta_e_floor": 1.0, "texture": 0.2, "texture_floor": float("nan")}
    ledger.event(Inpainted(**painted, identity_drift=drift))
    ledger.event(Resumed("stage1", 4))
    run.note_machine(replace(run.record.machine, load_average=(0.5, 0.5), load_average_end=(0.7, 0.5)))
    rows = {row: [_line(row, frame) for frame in (0, 1)] for row in (method, f"{method} [novel]", "truth")}
    rows["truth [novel]"] = [_line("truth [novel]", frame) for frame in (0, 1)]
    run.write_scores([*rows[method], *rows[f"{method} [novel]"]])
    calibration = [*rows["truth"], *rows["truth [novel]"]]
    atomic.write_json_lines(run.path / "calibration.jsonl", as_json(calibration))
    preset = as_json([PresetHead(("lpips",), "1"), *rows[method], *rows["truth"]])
    atomic.write_json_lines(run.path / "presets" / "gauhuman.jsonl", preset)
    for step in (2, 4):
        scores = {i: m.value for i, m in means(10.0 + step, 0.5, 0.1).items()}
        run.add_curve_point(CurvePoint(step, float(step), scores, views=2))
    run.set_status("done", ledger=ledger)
    return run.path


def _line(row: str, frame: int) -> ScoreLine:
    value = float("inf") if row.startswith("truth") else 20.0 + frame
    scores = {identity: mean.value for identity, mean in means(value, 0.9).items()}
    return ScoreLine(row, "c", frame, scores, {LPIPS.format("body"): "no weights"})


def faults(store: Path, limit: int | None = None, seed: int = 0) -> Iterator[str]:
    """Damage a run in `store`, an empty folder, beside a good one, in every way or in `limit` ways drawn at random;
    what went wrong then, one line each."""
    runs = store / "runs"
    good, victim = (make_run(runs, method) for method in (GOOD, VICTIM))
    kept = store / "kept"
    shutil.copytree(victim, kept)
    every = list(cases(victim))
    chosen = every if limit is None or limit >= len(every) else random.Random(seed).sample(every, limit)
    for k, case in enumerate(chosen):
        case.apply(victim)
        try:
            for fault in _attacked(runs, good, victim, figures=store / "figures" if k % 50 == 0 else None):
                yield f"{case.name}: {fault}"
        finally:
            shutil.rmtree(victim)
            shutil.copytree(kept, victim)


def _attacked(runs: Path, good: Path, victim: Path, figures: Path | None) -> Iterator[str]:
    try:
        read_result(victim)
        damaged = False
    except BadInput as error:
        damaged = True
        if "\n" in str(error) or victim.name not in str(error):
            yield f"not one line with its name: {str(error)!a}"
    words = [
        ["report", "--runs", runs],
        ["report", "table1", "--runs", runs],
        ["report", good, victim, "--format", "tex"],
    ]
    words += [["report", "--runs", runs, "--figures", figures, "--format", "html"]] if figures else []
    for command in words:
        out, err = io.StringIO(), io.StringIO()
        try:
            with redirect_stdout(out), redirect_stderr(err):
                status = main([str(word) for word in command])
        except BaseException as error:
            yield f"{' '.join(map(str, command[:2]))}: {type(error).__name__}: {error}"
            continue
        text = out.getvalue()
        if status != 0:
            yield f"{command[1]}: status {status}: {err.getvalue()}"
        elif GOOD not in text or "20.5" not in text:
            yield f"{command[1]}: the good run is not there"
        elif damaged and victim.name not in err.getvalue():
            yield f"{command[1]}: the damaged run is not named on stderr: {err.getvalue()}"
        elif damaged and victim.name not in text.replace("\\_", "_"):
            yield f"{command[1]}: the damaged run is not named in the report"
    for name, reader in READERS.items():
        try:
            reader(runs, good, victim)
        except BadInput:
            pass
        except Exception as error:
            yield f"{name}: {type(error).__name__}: {error}"


def _ablation(runs: Path, good: Path, victim: Path) -> None:
    from ihbench.runner.run_loop import RunRequest
    from tests.bench.fake_capture import fake_protocol

    suite = AblationSuite("t", (Variant("a"), Variant("b")), (Comparison("b", "a", "b"),))
    request = RunRequest(fake_protocol(), "m", None)
    cell = Cell("c", request, None, "a")  # type: ignore[arg-type]
    ablation.write(
        suite, [(variant, CellOutcome(cell, read_result(folder))) for variant, folder in (("a", good), ("b", victim))]
    )


def _borrow(runs: Path, good: Path, victim: Path) -> None:
    borrower, here = RunFolder.open(good), RunFolder.open(good).record.machine
    other = reusable_run(runs, borrower, "stage1", ["levels"], here)
    if other is not None:
        reuse_state(other, borrower, "stage1")


def _go_on(runs: Path, good: Path, victim: Path) -> None:
    run = RunFolder.open(victim)
    Ledger(state=run.record.ledger).table()
    run.curve()


READERS: dict[str, Callable[[Path, Path, Path], Any]] = {
    "index": lambda runs, good, victim: Index(runs).query(),
    "earlier runs": lambda runs, good, victim: earlier_runs(runs, VICTIM, "zju_occ@1", "quick", "x", "1"),
    "ablation": _ablation,
    "borrow": _borrow,
    "go on": _go_on,
    "protocol": lambda runs, good, victim: FinishedRun(victim).protocol,
    "body": lambda runs, good, victim: FinishedRun(victim).body,
    "capture": lambda runs, good, victim: FinishedRun(victim, runs).capture,
}
