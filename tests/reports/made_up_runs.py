"""Finished runs with curves and ledgers that nobody ran, in folders of their own."""

from __future__ import annotations

import json
import math
from datetime import datetime, timedelta
from pathlib import Path

from ihbench.metrics import Mean
from ihbench.record.results import RunResult
from ihbench.record.schema import curve_points

PSNR, FLIP = "psnr/pooled/range1/{}/v1", "flip/ldr-67ppd/srgb/{}/v1"
REGIONS = ("body", "hidden")
QUIET = {"cpu": "a processor", "cores": 4, "cores_usable": 4, "gpu": None, "load_average": [0.5, 0.5, 0.5]}
BEGAN = datetime.fromisoformat("2025-01-01T00:00:00+00:00")


def made_up(
    folder: Path,
    scene="a",
    method="ours",
    seed=0,
    *,
    psnr=25.0,
    fit=40.0,
    changed=(),
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
    stamped=None,  # s between the record's time stamps; None agrees with the ledger
) -> RunResult:
    """A run whose regions all have the same PSNR, and FLIP = 10 / PSNR. Its folder holds nothing but the curve."""
    name = "-".join([scene, method, str(seed), profile, str(size), *(c.replace("/", "_") for c in changed)])
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
            means[identity] = Mean(value, identity, "" if math.isfinite(value) else "nothing there", n=4)
    spent = {"load": 1.0, "fit": fit, "fit/stage1": fit - 1.0, "evaluate": 3.0, "score": 2.0, **(stages or {})}
    wall = sum(s for path_, s in spent.items() if "/" not in path_) + unnamed
    took = timedelta(seconds=round(wall if stamped is None else stamped))
    record = {
        "status": "done",
        "reason": "",
        "created": BEGAN.isoformat(),
        "updated": (BEGAN + took).isoformat(),
        "machine": QUIET | (machine or {}),
        "identity": {
            "protocol": protocol, "protocol_digest": f"{protocol}{profile}{size}", "profile": profile, "scene": scene,
            "method": method, "seed": seed, "code": "1", "config": config or {},
        },
        "about": {
            "standin": standin, "variant": "v", "headline": "body", "changed": list(changed), "left_out": [],
            "fit_seconds": fit, "total_seconds": wall, "peak_mb": 100.0, "device": device,
            "protocol": {"image": {"size": size}},
        },
        "ledger": {
            "seconds": wall, "events": list(events),
            "stages": {k: {"seconds": s, "entered": 1, "peak_device_mb": 0.0} for k, s in spent.items()},
        },
    }  # fmt: skip
    points = curve_points(path / "curve.jsonl") if curve is not None else []
    return RunResult(path, record, {method: means}, curve=points)


def sweep(folder: Path, scenes=("a", "b"), seeds=(0,)) -> list[RunResult]:
    """Six configurations: steps 50, 100 (the profile's), 200; 8 and 32 texels; another method."""
    runs = []
    for k, scene in enumerate(scenes):
        for seed in seeds:
            shift = 0.3 * k + 0.1 * seed
            for steps, fit, psnr in ((50, 20, 22), (100, 40, 25), (200, 80, 26)):
                changed = () if steps == 100 else (f"steps={steps}",)
                runs.append(_one(folder, scene, seed, fit + shift, psnr + shift, changed, steps, 16))
            for texels, fit, psnr in ((8, 25, 21), (32, 95, 25.5)):
                runs.append(_one(folder, scene, seed, fit + shift, psnr + shift, (f"texels={texels}",), 100, texels))
            runs.append(made_up(folder, scene, "theirs", seed, fit=300 + shift, psnr=24 + shift))
    return runs


def _one(folder, scene, seed, fit, psnr, changed, steps, texels) -> RunResult:
    config = {"steps": steps, "grid": {"on": True}, "texels": texels}
    points = tuple((t, psnr - 10 / t) for t in (2.0, 4.0, 8.0, 16.0, fit))
    return made_up(folder, scene, seed=seed, fit=fit, psnr=psnr, changed=changed, config=config, curve=points)
