"""Finished runs with curves and ledgers that nobody ran, in folders of their own."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

from ihbench.clock.ledger import LedgerState, Stage
from ihbench.clock.machine import Machine
from ihbench.record.results import RunResult
from ihbench.record.schema import About, Outcome, RunIdentity, curve_points
from tests.reports.fake_runs import mean, record

PSNR, FLIP = "psnr/pooled/range1/{}/v1", "flip/ldr-67ppd/srgb/{}/v1"
REGIONS = ("body", "hidden")
QUIET = Machine(cpu="a processor", cores=4, cores_usable=4, load_average=(0.5, 0.5, 0.5))
BEGAN = datetime.fromisoformat("2025-01-01T00:00:00+00:00")


def made_up(
    folder: Path,
    scene="a",
    method="ours",
    seed=0,
    *,
    psnr=25.0,
    fit=40.0,
    changed: Mapping[str, object] | None = None,
    config=None,
    curve=((2.0, 15.0), (4.0, 18.0), (8.0, 21.0), (16.0, 23.0)),  # seconds, PSNR
    stages=None,
    unnamed=0.5,  # s in no stage
    machine=None,
    profile="quick",
    protocol="p@1",
    size=64,
    standin="stand-in v1 seed 0",
    device="cpu",
    events=(),
    views=3,  # test views that the curve stands on
    of=None,  # of how many; None as runs of earlier versions, which do not say
    cpu=None,  # s that the processor worked on the fit; None as runs that do not say
    render_ms=None,  # None as runs of earlier versions, which do not say
    stamped=None,  # s between the record's time stamps; None agrees with the ledger
) -> RunResult:
    """A run whose regions all have the same PSNR, and FLIP = 10 / PSNR. Its folder holds nothing but the curve."""
    name = "-".join(
        [
            scene,
            method,
            str(seed),
            profile,
            str(size),
            *(f"{n}={v}".replace("/", "_") for n, v in (changed or {}).items()),
        ]
    )
    path = folder / name
    path.mkdir(parents=True, exist_ok=True)
    if curve is not None:
        lines, counted = [], {} if of is None else {"of": of}
        for seconds, value in curve:
            scores = {PSNR.format(r): value for r in REGIONS} | {FLIP.format(r): 10 / value for r in REGIONS}
            words = {i: v if math.isfinite(v) else str(v) for i, v in scores.items()}
            lines.append(
                json.dumps({"step": int(seconds), "seconds": seconds, "views": views, "scores": words} | counted)
            )
        (path / "curve.jsonl").write_text("".join(line + "\n" for line in lines))
    means = {}
    for region in REGIONS:
        for identity, value in ((PSNR.format(region), psnr), (FLIP.format(region), 10 / psnr)):
            means |= mean(identity, value, "" if math.isfinite(value) else "nothing there")
    spent = {"load": 1.0, "fit": fit, "fit/stage1": fit - 1.0, "evaluate": 3.0, "score": 2.0, **(stages or {})}
    wall = sum(s for path_, s in spent.items() if "/" not in path_) + unnamed
    costs = {path_: Stage(s, cpu or 0.0 if path_ == "fit" else 0.0) for path_, s in spent.items()}
    took = timedelta(seconds=round(wall if stamped is None else stamped))
    who = RunIdentity(
        protocol, f"{protocol}{profile}{size}", "d", scene, "x", method, config or {}, profile, seed, "0", "1"
    )
    said = About(
        standin=standin, variant="v", headline="body", changed=changed or {}, left_out=(), fit_seconds=fit,
        total_seconds=wall, peak_mb=100.0, render_ms=render_ms, device=device, protocol={"image": {"size": size}},
    )  # fmt: skip
    told = replace(
        record(who, said, machine=replace(QUIET, **(machine or {}))),
        outcome=Outcome("done", "", created=BEGAN.isoformat(), updated=(BEGAN + took).isoformat()),
        ledger=LedgerState(costs, wall, 0.0, tuple(events)),
    )
    points = curve_points(path / "curve.jsonl") if curve is not None else []
    return RunResult(path, told, {method: means}, curve=points)


def sweep(folder: Path, scenes=("a", "b"), seeds=(0,)) -> list[RunResult]:
    """Six configurations: steps 50, 100 (the profile's), 200; 8 and 32 texels; another method."""
    runs = []
    for k, scene in enumerate(scenes):
        for seed in seeds:
            shift = 0.3 * k + 0.1 * seed
            for steps, fit, psnr in ((50, 20, 22), (100, 40, 25), (200, 80, 26)):
                changed = {} if steps == 100 else {"steps": steps}
                runs.append(_one(folder, scene, seed, fit + shift, psnr + shift, changed, steps, 16))
            for texels, fit, psnr in ((8, 25, 21), (32, 95, 25.5)):
                runs.append(_one(folder, scene, seed, fit + shift, psnr + shift, {"texels": texels}, 100, texels))
            runs.append(made_up(folder, scene, "theirs", seed, fit=300 + shift, psnr=24 + shift))
    return runs


def _one(folder, scene, seed, fit, psnr, changed, steps, texels) -> RunResult:
    config = {"steps": steps, "grid": {"on": True}, "texels": texels}
    points = tuple((t, psnr - 10 / t) for t in (2.0, 4.0, 8.0, 16.0, fit))
    return made_up(folder, scene, seed=seed, fit=fit, psnr=psnr, changed=changed, config=config, curve=points)
