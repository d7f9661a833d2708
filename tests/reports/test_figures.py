"""`ihbench figures`: what is drawn, in which order, with which numbers, and what is refused."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from ihbench.commands.pages.figures import FiguresOptions, _folders
from ihbench.document.picture_sheet import LETTERS, Panel, PictureSheet, _heads
from ihbench.errors import BadInput
from ihbench.files.images import read_image
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.studies.inpaint_figure import inpaint
from ihbench.methods.inpainthuman.studies.multi_scale_figure import (
    HIDDEN,
    NEVER_SEEN,
    SIDE,
    feature_maps,
    multi_scale,
    outlined,
    principal_colours,
)
from ihbench.metrics.eight_bit import displayed
from ihbench.record.finished_run import FinishedRun
from ihbench.record.schema import score_lines
from ihbench.record.store import RunFolder
from ihbench.reports.figures.side_by_side import ablation, occluded_views, visual
from ihbench.reports.figures.teaser import teaser
from ihbench.scene.sightings import FINE
from ihbench.scoring.contact_sheet import OCCLUDER
from tests.reports.fake_runs import write_run


def plain(*size: int) -> np.ndarray:
    return np.full((*size, 3), 90, np.uint8)


def test_a_sheet_keeps_every_pixel_and_is_the_same_file_twice():
    chequered = (np.indices((20, 10)).sum(0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, 2)
    sheet = PictureSheet(("one", "two"), [("row", [Panel(chequered, "20.00 dB"), None])], "Two people, seed 0.")
    files = sheet.files()
    assert files == sheet.files()
    assert files[".txt"] == b"Two people, seed 0.\n"
    assert files[".pdf"].startswith(b"%PDF-")
    picture = np.asarray(Image.open(io.BytesIO(files[".png"])).convert("L"))
    black = (picture < 40).sum() / picture.size
    assert 0.05 < black < 0.5, "the chequers are there, and the empty place is white"


def test_long_heads_take_lines_instead_of_running_into_each_other():
    long = "levels=(128,), inpaint.on=False, " * 3

    def height(head: str) -> int:
        sheet = PictureSheet((head, "b", "c", "d", "e", "f"), [("row", [Panel(plain(60, 30))] * 6)], "")
        return Image.open(io.BytesIO(sheet.files()[".png"])).height

    assert height(long) > height("short") + 60


def test_heads_of_columns_have_one_size_and_whole_words():
    names = ("training input image", "GaussianAvatar", "3DGS-Avatar", "GTU")
    heads = _heads(names, 0.55)
    assert len({head.size for head in heads}) == 1
    assert [head.text for head in heads] == ["training input\nimage", "GaussianAvatar", "3DGS-Avatar", "GTU"]
    assert {head.size for head in _heads(("a", "b"), 0.55)} == {LETTERS}
    assert "".join(_heads(["a_name_of_very_many_letters" * 3], 0.55)[0].text.split()).count("letters") == 3


@pytest.mark.parametrize("rows", [[], [("row", [Panel(plain(4, 4))])]])
def test_a_sheet_of_other_rows_than_columns_is_refused(rows):
    with pytest.raises(ValueError, match="row"):
        PictureSheet(("a", "b"), rows, "")


def test_a_panel_is_a_picture():
    with pytest.raises(ValueError, match="uint8"):
        Panel(np.zeros((4, 4, 3)))


def test_visual_shows_the_renders_with_the_numbers_of_the_record(bench, finished):
    with bench.in_its_world():
        sheet = visual([FinishedRun(finished.folder)], views=2)
    label = finished_label(finished)
    assert label.startswith("inpainthuman")
    assert sheet.columns == ("training input", "ground truth", "InpaintHuman" + label.removeprefix("inpainthuman"))
    assert len(sheet.rows) == 2
    known = {
        (str(line.camera), line.frame): next(
            value for i, value in line.scores.items() if (i.metric, i.region) == ("psnr", "body")
        )
        for line in score_lines(finished.folder / "scores.jsonl")
    }
    for head, panels in sheet.rows:
        scene, view = head.split(", ")
        camera, frame = view.rsplit("/", 1)
        assert scene == "standin-1"
        assert panels[2].note == f"{known[camera, int(frame)]:.2f} dB"
        render = displayed(read_image(finished.folder / "renders" / camera / f"{frame}.png", (1.0, 1.0, 1.0)))
        shown = panels[2].image
        assert shown.shape == panels[1].image.shape
        assert any(
            np.array_equal(render[y : y + shown.shape[0], x : x + shown.shape[1]], shown)
            for y in range(render.shape[0] - shown.shape[0] + 1)
            for x in range(render.shape[1] - shown.shape[1] + 1)
        ), "the panel is a part of the render, pixel by pixel"
    assert "standin-1" in sheet.caption
    assert "Seed 0" in sheet.caption


def finished_label(finished) -> str:
    from ihbench.record.results import read_result
    from ihbench.record.row_labels import by_label

    return next(iter(by_label([read_result(finished.folder)])))


def test_an_ablation_has_the_error_below_and_one_method(bench_with_run, mannequin):
    with bench_with_run.in_its_world():
        run = FinishedRun(bench_with_run.folders()[0])
        sheet = ablation([run], views=1)
        assert [head for head, _ in sheet.rows][1] == "error x 4"
        (_, drawn), (_, wrong) = sheet.rows
        assert wrong[0] is None
        assert drawn[1].image.shape == wrong[1].image.shape
        assert not sheet.columns[1].startswith("inpainthuman")
    assert bench_with_run.run(method=mannequin).status == 0
    with bench_with_run.in_its_world():
        both = [FinishedRun(folder) for folder in bench_with_run.folders()]
        assert len(visual(both, views=1).columns) == 4
        with pytest.raises(BadInput, match="variants of one"):
            ablation(both, views=1)
        for figure in (multi_scale, inpaint):
            with pytest.raises(BadInput, match="mannequin"):
                figure(both[::-1], 1)


def test_multi_scale_marks_hidden_and_never_seen_surface(bench, finished):
    with bench.in_its_world():
        run = FinishedRun(finished.folder)
        sheet = multi_scale([run], 1)
        seen = run.scene.training.sightings[FINE].visibility
    assert sheet.columns == ("surface", "16 x 16", "256 x 256", "decoded colour")
    ((_, panels),) = sheet.rows
    region = panels[0].image
    per_texel = (SIDE // FINE) ** 2
    for colour, where in ((HIDDEN, seen.hidden), (NEVER_SEEN, seen.never_seen)):
        assert (region == np.array(colour)).all(-1).sum() == where.sum() * per_texel
        drawn = (panels[-1].image == np.array(colour)).all(-1)
        assert bool(drawn.any()) == bool(where.any())
        assert drawn.sum() <= where.sum() * per_texel


def test_a_teaser_has_inputs_sides_and_poses_for_any_method(bench, mannequin):
    assert bench.run(method=mannequin).status == 0
    with bench.in_its_world():
        run = FinishedRun(bench.folders()[0])
        sheet = teaser([run], views=2)
        occluded = occluded_views(run.scene)
    assert sheet.columns == ("training input",) * 2 + ("front", "left", "back", "right", "march", "lunge")
    ((head, panels),) = sheet.rows
    assert head == "standin-1"
    assert len(occluded) >= 2
    assert all((panel.image == OCCLUDER).all(-1).any() for panel in panels[:2])
    sides = [panel.image for panel in panels[2:]]
    assert len({side.tobytes() for side in sides}) == len(sides), "every picture is another one"


def test_each_levels_map_is_its_own(bench, finished):
    with bench.in_its_world():
        avatar = GaussianAvatar.load(finished.folder / "avatar", FinishedRun(finished.folder).body)
        before = feature_maps(avatar)
        with torch.no_grad():
            avatar.features.table[: 16 * 16] += torch.randn(16 * 16, avatar.features.table.shape[1])
        after = feature_maps(avatar)
    assert not np.array_equal(before[16], after[16])
    assert np.array_equal(before[256], after[256])


def test_principal_colours_find_the_axis_and_settle_its_sign():
    along = torch.linspace(-1, 1, 50).double()
    features = torch.stack([3 * along, 0.001 * torch.sin(9 * along), torch.zeros(50)], 1)
    colours = principal_colours(features)
    assert colours.shape == (50, 3)
    assert (colours[1:, 0] >= colours[:-1, 0]).all()
    assert torch.equal(colours, principal_colours(features.clone()))
    assert torch.isfinite(principal_colours(torch.zeros(4, 2).double())).all()


def test_an_outline_leaves_the_inside():
    region = np.zeros((20, 20, 3), np.uint8)
    region[4:16, 4:16] = HIDDEN
    drawn = outlined(np.full((20, 20, 3), 7, np.uint8), region)
    assert tuple(drawn[4, 8]) == HIDDEN
    assert (drawn[8:12, 8:12] == 7).all()
    assert (drawn[:3] == 7).all()


def test_what_no_figure_shows_is_named(tmp_path, capsys):
    runs = tmp_path / "runs"
    done, damaged, failed, other = (
        write_run(runs, scene, method, 20.0, 0.9)
        for scene, method in (("a", "m"), ("b", "m"), ("c", "m"), ("d", "n"))
    )
    (damaged / "scores.jsonl").write_text("{}\n")
    RunFolder.open(failed).set_status("failed", "it fell")
    assert _folders(FiguresOptions("visual", (runs,), method=("m",))) == [done]
    said = capsys.readouterr().err.splitlines()
    assert [f"left out: {folder}" in line for folder, line in zip((damaged, failed), said, strict=True)] == [
        True,
        True,
    ]
    assert "it fell" in said[1]
    assert _folders(FiguresOptions("visual", (runs,), scene=("d",))) == [other]


def test_the_command_writes_three_files_and_refuses_what_it_cannot_draw(bench_with_run, tmp_path):
    outcome = bench_with_run("figures", "visual", bench_with_run.runs, "--views", 1, "--out", tmp_path / "f")
    assert outcome.status == 0, outcome.err
    assert {path.suffix for path in (tmp_path / "f").glob("visual.*")} == {".png", ".pdf", ".txt"}
    assert (tmp_path / "f" / "visual.txt").read_text().strip() in outcome.out
    for words, told in (
        (("viusal",), "did you mean 'visual'"),
        (("visual", tmp_path / "nothing"), "nothing"),
        (("visual", bench_with_run.runs, "--views", 0), "--views"),
        (("visual", bench_with_run.runs, "--scene", "standin-7"), "--scene standin-7: no run here has it"),
        (("visual", bench_with_run.runs, "--method", "inpainthumann"), "did you mean 'inpainthuman'?"),
        (("inpaint", bench_with_run.runs), "no saved state"),
    ):
        outcome = bench_with_run("figures", *words, "--out", tmp_path / "g")
        assert outcome.status == 2, words
        assert told in outcome.err
        assert len(outcome.err.splitlines()) == 1
    assert not (tmp_path / "g").exists()
    assert "multi-scale" in bench_with_run("figures", "list").out
