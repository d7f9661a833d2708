"""The benchmark behind `ihbench kernels`: its rows, its scene, its statistics. No test looks at a clock."""

import csv
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ihbench.body import load_body, position_map, texel_table
from ihbench.clock import machine
from ihbench.clock.machine import Machine
from ihbench.document import diagram
from ihbench.document.document import write
from ihbench.errors import BadInput
from ihbench.kernels import figure, metrics, position_maps, scoring, skinning, splats, table, zbuffers
from ihbench.kernels.measuring import Row, interleave, peak_mib, row_of
from ihbench.render.splat import render_gaussians


@pytest.fixture
def small(monkeypatch):
    cases = (("300@48", 300, 48), ("600@48", 600, 48))
    monkeypatch.setattr(splats, "WINDOW", 32)
    monkeypatch.setitem(table.KERNELS, "splat", lambda repeats: splats.splat_rows(repeats, cases))
    monkeypatch.setitem(table.KERNELS, "zbuffer", lambda repeats: zbuffers.zbuffer_rows(repeats, (("tiny", 8, 32),)))


def shown(rows):
    return write(table.blocks_of(machine.identity(), rows), "terminal")


def test_every_back_end_gets_a_row(small):
    rows = table.run_kernels(["splat", "zbuffer"], repeats=2)
    found = [(r.kernel, r.case, r.backend) for r in rows]
    assert found == [
        ("splat", "300@48", "numba"),
        ("splat", "300@48", "reference"),
        ("splat", "600@48", "numba"),
        ("zbuffer", "tiny", "numpy"),
        ("zbuffer", "tiny", "numba"),
    ]
    for row in rows:
        assert row.forward_ms > 0
        assert row.forward_iqr_ms >= 0
        assert (row.backward_ms is None) == (row.kernel == "zbuffer")
        assert row.value_error < 1e-5
        assert row.gradient_error is None or row.gradient_error < 1e-4
    out = shown(rows)
    assert "numba" in out
    assert "threads" in out
    assert "load" in out


def test_general_splats_get_rows_with_their_processor_time(monkeypatch):
    cases = (("200@48", 200, 48, 0.5, 5.0), ("400@48", 400, 48, 1.0, 1.0))
    monkeypatch.setattr(splats, "WINDOW", 32)
    monkeypatch.setitem(table.KERNELS, "splat-general", lambda repeats: splats.general_splat_rows(repeats, cases))
    rows = table.run_kernels(["splat-general"], repeats=2)
    assert [(r.case, r.backend) for r in rows] == [("200@48", "numba"), ("200@48", "reference"), ("400@48", "numba")]
    for row in rows:
        assert row.processor_ms > 0
        assert row.pairs_per_second > 0
        assert row.value_error < 1e-4
        assert row.gradient_error < 1e-3
    assert "Mpairs/s" in shown(rows)
    assert "splat-large" not in table.KERNELS


def test_pixel_pairs_are_the_area_of_the_footprints():
    scene = splats.general_gaussians(1, 64, 1.0, 1.0)
    scene = replace(scene, means=scene.means * 0, scales=scene.scales * 0 + 0.1)
    (z,) = (scene.camera.R[2] @ np.zeros(3) + scene.camera.t[2],)
    variance = (1.03 * 64 * 0.1 / z) ** 2 + 0.3
    assert splats.pixel_pairs(scene) == pytest.approx(math.pi * 2 * math.log(255) * variance, rel=0.01)


def test_json_is_one_object(small, bench):
    printed = json.loads(bench("kernels", "zbuffer", "--repeats", "1", "--json").out)
    assert [row["backend"] for row in printed["rows"]] == ["numpy", "numba"]
    assert printed["machine"]["cores_usable"] >= 1


def test_bad_input():
    with pytest.raises(
        BadInput, match="kernel 'splatt': expected one of flip, frame, lbs, lpips, position-map, samp"
    ):
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
    calm = row_of("k", "c", "b", [(v, 1.0) for v in (9.9, 10.0, 10.0, 10.1, 40.0)], None, None)
    assert (calm.forward_ms, calm.unstable) == (10.0, False)
    assert calm.forward_iqr_ms == pytest.approx(0.1)
    shaky = row_of("k", "c", "b", [(1.0, v) for v in (8.0, 9.0, 10.0, 12.0, 15.0)], None, None)
    assert shaky.unstable
    assert shaky.backward_iqr_ms == pytest.approx(3.0)
    assert row_of("k", "c", "b", [(1.0, None)], None, None).backward_ms is None


def test_peak_memory_is_what_the_step_needs():
    needed = peak_mib(lambda: np.ones(8 << 20))  # 64 MiB
    assert needed is None or 60 < needed < 80


def test_metric_rows_hold_the_error_of_every_dtype_and_library(capsys, monkeypatch):
    monkeypatch.setattr(metrics, "ERROR_SIZE", (24, 22))
    rows = metrics.ssim_rows(1, size=32) + metrics.flip_rows(1, size=32) + metrics.frame_rows(1, size=64)
    errors = {}
    for row in rows:
        kind = row.backend.rsplit(" ", 1)[-1] if " " in row.backend else "ours"
        errors[kind] = max(errors.get(kind, 0.0), row.value_error)
        assert row.forward_ms > 0
    assert {row.kernel for row in rows} == {"ssim", "flip", "frame"}
    assert {"u8", "f16", "f32", "f64"} <= {row.backend for row in rows}
    assert errors["ours"] < 1e-12
    assert 0 < errors["f32"] < 2e-5  # our loss in torch and, where installed, torchmetrics, kornia and flip-evaluator


def test_lpips_whole_tiled_and_cropped_is_the_packages_up_to_single_precision(monkeypatch):
    monkeypatch.setattr(metrics, "LPIPS_ERROR_SIZE", 192)
    rows = metrics.lpips_rows(1, size=64, nets=["alex"])
    assert [r.backend for r in rows] == [
        "ours f32", "ours f32, tiled", "lpips package f32", "ours f32, crop", "lpips package f32, crop"
    ]  # fmt: skip
    assert all("random trunk" in r.case for r in rows)  # the tests' machine has no weights, and it is said
    assert all(0 <= r.value_error < 1e-6 for r in rows)
    assert any(r.value_error > 0 for r in rows)


def test_too_small_a_halo_would_show_in_the_tiled_row(monkeypatch):
    monkeypatch.setattr("ihbench.metrics.lpips.HALO", 16)
    monkeypatch.setattr(metrics, "LPIPS_ERROR_SIZE", 192)
    (tiled,) = [r for r in metrics.lpips_rows(1, size=64, nets=["alex"]) if r.backend.endswith("tiled")]
    assert tiled.value_error > 1e-6


def test_skinning_loses_digits_with_its_precision_and_only_then():
    rows = {r.backend: r for r in skinning.lbs_rows(1, (("few", 16),))}
    assert list(rows) == ["numpy f64", "torch f64", "torch f32", "torch f16"]
    assert rows["torch f64"].value_error < 1e-14
    assert 1e-9 < rows["torch f32"].value_error < 1e-5
    assert 1e-4 < rows["torch f16"].value_error < 0.05
    assert 0 < rows["torch f32"].gradient_error < 1e-5 < rows["torch f16"].gradient_error < 0.05
    assert rows["numpy f64"].backward_ms is None


def test_position_maps_are_held_against_a_twin_that_asks_every_face(monkeypatch):
    rows = position_maps.position_map_rows(1, (12,))
    errors = {r.backend: r.value_error for r in rows}
    assert errors["table anew f64"] < 1e-12
    assert 0 < errors["cached table f32"] < 1e-6
    monkeypatch.setattr(position_maps, "position_map", lambda v, body, r: position_map(v[::-1], body, r))
    wrong = {r.backend: r.value_error for r in position_maps.position_map_rows(1, (12,))}
    assert wrong["cached table f32"] > 0.1


def test_the_twin_of_a_coarser_look_is_the_finer_one_at_every_nth_texel():
    body = load_body()
    fine, inside = position_maps.brute_force_map(body.v_template, body, 12)
    coarse, some = position_maps.brute_force_map(body.v_template, body, 12, step=3)
    assert (fine[::3, ::3] == coarse).all()
    assert (inside[::3, ::3] == some).all()
    assert inside.sum() == len(texel_table(body, 12).index)


def a_row(**changes):
    return replace(Row("k", "c", "b", 1, False, 1.0, 0.1, None, None, None, 1e-6, None), **changes)


def test_the_diagram_shows_every_row_with_an_error_and_the_csv_has_all(tmp_path):
    rows = [
        a_row(),
        a_row(backend="exact", forward_ms=90.0, value_error=0.0),
        a_row(kernel="wrong", value_error=math.inf),
        a_row(kernel="untimed", value_error=None),
        *(a_row(kernel="sampler", backend=f"{n} steps", forward_ms=float(n), knob="steps") for n in (1, 4)),
    ]
    png = figure.draw(rows, Machine(cpu="p", torch_threads=1, load_average=(0.1,) * 3, cores_usable=2), tmp_path)
    assert png.stat().st_size > 10_000
    svg = png.with_suffix(".svg").read_text()
    for shown in ("b", "exact", "1 steps", "4 steps", "sampler"):
        assert f">{shown}<" in svg
    assert ">wrong<" not in svg
    assert ">untimed<" not in svg
    found = list(csv.DictReader(png.with_suffix(".csv").open()))
    assert [r["kernel"] for r in found] == [r.kernel for r in rows]
    assert [float(r["value_error"] or "nan") for r in found[:3]] == [1e-6, 0.0, math.inf]
    assert found[0]["machine"].startswith("p, 1 threads")


def test_a_table_with_nothing_to_draw_is_still_written(tmp_path):
    assert figure.draw([a_row(value_error=None)], Machine(cpu="p", cores_usable=2), tmp_path).exists()
    assert diagram.round_ticks(1, 10)


def test_a_kernel_that_a_method_registers_is_measured_beside_the_benchs_own(monkeypatch):
    theirs = a_row(kernel="theirs", backward_ms=None, backward_iqr_ms=None, peak_mib=None, gradient_error=None)
    spec = SimpleNamespace(kernels={"theirs": "module:rows"}, load=lambda where: lambda repeats: [theirs])
    monkeypatch.setattr(table, "usable_specs", lambda: [spec])
    (row,) = table.run_kernels(["theirs"], repeats=1)
    assert row.kernel == "theirs"
    assert "theirs" in shown([row])


@pytest.mark.parametrize(("load", "said"), [(9.0, True), (0.5, False)])
def test_a_busy_machine_is_named_below_the_table(load, said):
    here = Machine(load_average=(load, 0.0, 0.0), cores_usable=2)
    assert ("times are unstable" in write(table.blocks_of(here, []), "terminal")) == said


def test_scoring_is_timed_on_a_stand_in(bench, monkeypatch):
    monkeypatch.setattr(scoring, "PROTOCOL", str(bench.protocol))
    with bench.in_its_world():
        rows = scoring.score_rows(1, views=3, profile="quick")
    assert [r.backend for r in rows] == ["psnr+ssim", "psnr+ssim+flip"]
    assert all(r.forward_ms > 0 for r in rows)
    assert rows[0].case.startswith("3 views@")
