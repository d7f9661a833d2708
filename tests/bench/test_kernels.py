"""The benchmark behind `ihbench kernels`: its rows, its scene, its statistics. No test looks at a clock."""

import json

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.kernels import metrics, scoring, splats, table, zbuffers
from ihbench.kernels.measuring import interleave, peak_mib, summary
from ihbench.render.splat import render_gaussians


@pytest.fixture
def small(monkeypatch):
    cases = (("300@48", 300, 48), ("600@48", 600, 48))
    monkeypatch.setattr(splats, "WINDOW", 32)
    monkeypatch.setitem(table.KERNELS, "splat", lambda repeats: splats.splat_rows(repeats, cases))
    monkeypatch.setitem(table.KERNELS, "zbuffer", lambda repeats: zbuffers.zbuffer_rows(repeats, (("tiny", 8, 32),)))


def test_every_back_end_gets_a_row(small, capsys):
    rows = table.run_kernels(["splat", "zbuffer"], repeats=2)
    found = [(r["kernel"], r["case"], r["backend"]) for r in rows]
    assert found == [
        ("splat", "300@48", "numba"),
        ("splat", "300@48", "reference"),
        ("splat", "600@48", "numba"),
        ("zbuffer", "tiny", "numpy"),
        ("zbuffer", "tiny", "numba"),
    ]
    for row in rows:
        assert row["forward_ms"] > 0
        assert row["forward_iqr_ms"] >= 0
        assert (row["backward_ms"] is None) == (row["kernel"] == "zbuffer")
        assert row["value_error"] < 1e-5
        assert row["gradient_error"] is None or row["gradient_error"] < 1e-4
    out = capsys.readouterr().out
    assert "numba" in out
    assert "threads" in out
    assert "load" in out


def test_json_is_one_object(small, capsys):
    rows = table.run_kernels(["zbuffer"], as_json=True, repeats=1)
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] == rows
    assert printed["machine"]["cores_usable"] >= 1


def test_bad_input():
    with pytest.raises(BadInput, match="kernel 'splatt': expected one of flip, frame, lpips, score"):
        table.run_kernels(["splatt"])
    with pytest.raises(BadInput, match="at least 1, got 0"):
        table.run_kernels(repeats=0)


def test_the_figure_is_seeded_and_covers_a_sixth_of_the_image():
    scene, again, other = splats.body_gaussians(4000, 96), splats.body_gaussians(4000, 96), None
    assert (scene.means == again.means).all()
    other = splats.body_gaussians(4000, 96, seed=1)
    assert not (scene.means == other.means).all()
    _, alpha = render_gaussians(scene.means, scene.scales, scene.colors, scene.camera)
    covered = float((alpha > 0.5).double().mean())
    assert 0.12 < covered < 0.25
    assert alpha[0].max() == alpha[-1].max() == alpha[:, 0].max() == 0


def test_the_steps_are_interleaved_after_a_warm_up():
    calls = []
    steps = {name: lambda name=name: (calls.append(name), (float(len(calls)), None))[1] for name in "ab"}
    timings = interleave(steps, repeats=3, warm_up=2)
    assert "".join(calls) == "aabb" + "ababab"
    assert [sample[0] for sample in timings["a"]] == [5, 7, 9]


def test_the_spread_decides_what_is_unstable():
    calm = summary([(v, 1.0) for v in (9.9, 10.0, 10.0, 10.1, 40.0)])
    assert (calm["forward_ms"], calm["unstable"]) == (10.0, False)
    assert calm["forward_iqr_ms"] == pytest.approx(0.1)
    shaky = summary([(1.0, v) for v in (8.0, 9.0, 10.0, 12.0, 15.0)])
    assert shaky["unstable"]
    assert shaky["backward_iqr_ms"] == pytest.approx(3.0)
    assert summary([(1.0, None)])["backward_ms"] is None


def test_peak_memory_is_what_the_step_needs():
    needed = peak_mib(lambda: np.ones(8 << 20))  # 64 MiB
    assert needed is None or 60 < needed < 80


def test_metric_rows_hold_the_error_of_every_dtype_and_library(capsys, monkeypatch):
    monkeypatch.setattr(metrics, "ERROR_SIZE", (24, 22))
    rows = metrics.ssim_rows(1, size=32) + metrics.flip_rows(1, size=32) + metrics.frame_rows(1, size=64)
    errors = {}
    for row in rows:
        kind = row["backend"].rsplit(" ", 1)[-1] if " " in row["backend"] else "ours"
        errors[kind] = max(errors.get(kind, 0.0), row["value_error"])
        assert row["forward_ms"] > 0
    assert {row["kernel"] for row in rows} == {"ssim", "flip", "frame"}
    assert {"u8", "f16", "f32", "f64"} <= {row["backend"] for row in rows}
    assert errors["ours"] < 1e-12
    assert 0 < errors["f32"] < 2e-5  # our loss in torch and, where installed, torchmetrics, kornia and flip-evaluator


def test_lpips_rows_compare_with_the_package():
    rows = metrics.lpips_rows(1, size=64)
    assert [r["backend"] for r in rows] == ["ours", "lpips package"] * 3
    assert all(r["value_error"] < 1e-6 for r in rows)


def test_scoring_is_timed_on_a_stand_in(bench, monkeypatch):
    monkeypatch.setattr(scoring, "PROTOCOL", str(bench.protocol))
    with bench.in_its_world():
        rows = scoring.score_rows(1, views=3, profile="quick")
    assert [r["backend"] for r in rows] == ["psnr+ssim", "psnr+ssim+flip"]
    assert all(r["forward_ms"] > 0 for r in rows)
    assert rows[0]["case"].startswith("3 views@")
