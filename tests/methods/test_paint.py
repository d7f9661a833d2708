"""`ihbench paint`: painters side by side, against the truth behind the occluder."""

from __future__ import annotations

import json

import pytest

from ihbench.diffusion.inpaint_config import FULL
from ihbench.diffusion.mini.weights import save_mini
from ihbench.document.document import write
from ihbench.methods.inpainthuman.studies.paint_table import SEEN, TRUTH, summary, table
from tests.diffusion.tiny_diffusion import tiny_backbone


@pytest.fixture(scope="module")
def painted(studio, tmp_path_factory):
    """The command on two scenes, and where it wrote."""
    weights, out = tmp_path_factory.mktemp("mini"), tmp_path_factory.mktemp("paint")
    save_mini(tiny_backbone(), weights)
    words = ["paint", "--protocol", studio.protocol, "--scene", "standin-1", "standin-2", "--frames", "2", "--json"]
    words += ["--rows", "mean", "temporal", "generic+sg", FULL, "--out", out, "--inpaint.weights", weights]
    words += ["--inpaint.ti-steps", "1", "--inpaint.lora-steps", "1", "--inpaint.sampler-steps", "1"]
    outcome = studio(*words)
    assert outcome.status == 0, outcome.err
    return json.loads(outcome.out), out


def test_every_row_is_scored_in_every_scene(painted):
    told, out = painted
    assert set(told["scenes"]) == {"standin-1", "standin-2"}
    for rows in told["scenes"].values():
        assert list(rows) == ["mean", "temporal", "generic+sg", FULL, TRUTH, SEEN]
        assert all(4 < rows[name]["psnr"] < 60 for name in list(rows)[:4])
        bounds = [rows[name].keys() for name in (TRUTH, SEEN)]
        assert bounds == 2 * [{"delta_e", "flicker"}]
        assert all(4 < rows[name]["face"] < 60 for name in list(rows)[:4])
        # most of the hidden surface is shown by another frame
        assert rows["temporal"]["psnr_on_body"] > rows["mean"]["psnr_on_body"] + 1
        assert rows["generic+sg"]["psnr"] != rows[FULL]["psnr"]
    assert json.loads((out / "paint.json").read_text())["summary"].keys() == told["summary"].keys()
    assert (out / "standin-1.png").stat().st_size > 1000


def test_the_table_has_intervals_and_the_full_methods_lead(painted):
    scores = {name: {"psnr": psnr} for name, psnr in (("mean", 10.0), (FULL, 12.0))}
    shifted = {name: {"psnr": row["psnr"] + 1} for name, row in scores.items()}
    result = summary({"a": scores, "b": shifted})
    assert result["mean"]["psnr"]["mean"] == 10.5
    assert result["mean"]["lead"]["mean"] == pytest.approx(2)
    assert "lead" not in result[FULL]
    assert "| mean | 10.50 (" in write(table(result, "two scenes"), "md")
    assert painted[1].joinpath("paint.md").read_text().count("\n| ") == 7


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--rows", "temporel"), "did you mean 'temporal'"),
        (("--frames", "0"), "--frames 0: expected 1 to 100000"),
        (("--occlusion.rule", "none", "--rows", "mean", "--scene", "standin-1"), "no training frame hides anything"),
    ],
)
def test_bad_input(bench, words, complaint):
    outcome = bench("paint", "--protocol", bench.protocol, *words)
    assert outcome.status == 2
    assert complaint in outcome.err
