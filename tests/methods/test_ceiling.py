"""`ihbench ceiling`: stage 3 from paintings that know the truth."""

from __future__ import annotations

import hashlib
import json
import math

import numpy as np
import pytest

from ihbench.document.document import write
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.studies.ceiling import CeilingRow, painted_psnr, with_truth
from ihbench.methods.inpainthuman.studies.ceiling_command import table
from ihbench.methods.inpainthuman.studies.grid import HIDDEN
from ihbench.methods.inpainthuman.studies.inpaint_figure import inpaint
from ihbench.metrics import Identity
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scoring.contact_sheet import OCCLUDER
from tests.bench.fake_capture import a_camera, a_pose
from tests.conftest import TINY_SWITCHES

PAINTS = [*TINY_SWITCHES[:-1], "--method.inpaint.filler", "mirror", "--method.inpaint.key-views", "2"]
PAINTS += ["--method.refine.steps", "6"]


def a_view(colour: int, mask: np.ndarray) -> TrainView:
    image = np.full((*mask.shape, 3), colour, np.uint8)
    return TrainView(image, mask.astype(np.uint8), a_camera(), a_pose(), 0, "c")


def two_views() -> tuple[PaintedView, TrainView]:
    """Four pixels: visible person; generated and truly person; generated, person in the painting only; background."""
    P, B = MaskState.PERSON, MaskState.BACKGROUND
    painted = a_view(100, np.array([[P, P, P, B]]))
    true = a_view(130, np.array([[P, P, B, B]]))
    return PaintedView(0, painted, np.array([[False, True, True, True]])), true


def test_paintings_move_towards_the_truth_where_they_were_made():
    painted, true = two_views()
    half = with_truth(painted, true, 0.5)
    assert half.view.image[0, :, 0].tolist() == [100, 115, 115, 115]
    assert half.view.mask[0].tolist() == true.mask[0].tolist()
    assert with_truth(painted, true, 1).view.image[0, :, 0].tolist() == [100, 130, 130, 130]


def test_the_paintings_psnr_is_over_generated_person_pixels():
    painted, true = two_views()
    true.image[0, 0], true.image[0, 3] = 0, 0  # visible, and background in both
    assert painted_psnr([painted], [true]) == pytest.approx(20 * math.log10(255 / 30))
    assert painted_psnr([with_truth(painted, true, 1)], [true]) == math.inf
    nothing = PaintedView(0, painted.view, np.zeros((1, 4), bool))
    assert math.isnan(painted_psnr([nothing], [true]))


def files_of(folder):
    return {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_run_between_its_first_stage_and_its_ceiling(bench, tmp_path):
    """One test, because its runs are dear: what is not fitted again, what is, and that the run stays as it was."""
    words = ["run", "--protocol", bench.protocol, "--runs", bench.runs, "--scene", "standin-1"]
    assert bench(*words, *PAINTS).status == 0
    assert bench(*words, *PAINTS, "--method.inpaint.no-on").status == 0
    run, plain = bench.folders()
    before = files_of(run)
    out = tmp_path / "out"
    outcome = bench("ceiling", run, "--truth", "1", "--json", "--out", out)
    assert outcome.status == 0, outcome.err
    assert files_of(run) == before
    (told,) = json.loads(outcome.out)["runs"]
    rows = {row["paintings"]: row for row in told["rows"]}
    assert list(rows) == ["stage 1 alone", "as painted", "true images"]
    for name, folder in (("stage 1 alone", plain), ("as painted", run)):
        own = read_result(folder).rows["inpainthuman"]
        for identity, value in rows[name]["scores"].items():
            if value is not None:
                assert value == pytest.approx(own[Identity.parse(identity)].value, abs=1e-6), (name, identity)
    assert rows["true images"]["painted_psnr"] == "inf"
    assert 3 < rows["as painted"]["painted_psnr"] < 40
    with bench.in_its_world():
        sheet = inpaint([FinishedRun(run)], views=1)
    assert files_of(run) == before
    ((head, panels),) = sheet.rows
    assert head.startswith("standin-1, frame ")
    filmed, asked, painted, truth = (panel.image.astype(int) for panel in panels)
    made = (asked == HIDDEN).all(-1)
    assert made.any()
    assert (filmed[made] == OCCLUDER).all(), "painted where something is hidden"
    assert (painted[made] != OCCLUDER).any()
    assert np.array_equal(painted[~made], filmed[~made])
    assert panels[3].note.startswith("painted: ")
    assert not np.array_equal(truth[made], painted[made])
    hidden = [
        identity for identity in rows["as painted"]["scores"] if identity.startswith("psnr/pooled/range1/hidden")
    ]
    assert rows["true images"]["scores"][hidden[0]] > rows["as painted"]["scores"][hidden[0]]
    assert "| true images | ∞ |" in (out / "ceiling.md").read_text(encoding="utf-8")
    complains(bench, ("ceiling", plain), "has no saved state stage2-painted")


def test_the_table_has_gains_paired_over_scenes():
    def rows(base: float) -> list[CeilingRow]:
        def scores(value: float) -> dict[Identity, float]:
            values = {"hidden": value, "visible": math.nan}
            return {Identity.parse(f"psnr/pooled/range1/{region}/v1"): score for region, score in values.items()}

        return [
            CeilingRow("stage 1 alone", None, math.nan, scores(base)),
            CeilingRow("as painted", 0.0, 20.0, scores(base + 1)),
            CeilingRow("true images", 1.0, math.inf, scores(base + 3)),
        ]

    text = write(table([("a", rows(18.0)), ("b", rows(20.0)), ("b", rows(22.0))], "three runs"), "md")
    assert "| stage 1 alone | — | 19.50 |  |" in text
    assert "| as painted | 20.00 | 20.50 | +1.00 [+1.00, +1.00] |" in text
    assert "| true images | ∞ | 22.50 | +3.00 [+3.00, +3.00] |" in text
    assert "visible" not in text


def complains(bench, words, complaint):
    outcome = bench(*words)
    assert outcome.status == 2
    assert complaint in outcome.err
    assert outcome.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((), "ceiling: of which run?"),
        (("--truth", "2"), "expected above 0, at most 1"),
        (("--truth", "0"), "expected above 0, at most 1"),
    ],
)
def test_bad_words_are_refused_in_one_line(bench_with_run, words, complaint):
    folders = [] if not words else bench_with_run.folders()
    complains(bench_with_run, ("ceiling", *folders, *words), complaint)
