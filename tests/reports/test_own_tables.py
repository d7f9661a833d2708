"""What our own writers write: the linter finds nothing in it, LaTeX could set it, readers choose what is in it."""

from __future__ import annotations

import random
import re
from dataclasses import replace

import pytest

from ihbench.document.document import write, write_fragment
from ihbench.document.short_names import split_label, with_short_names
from ihbench.errors import BadInput
from ihbench.record.row_choice import Choice
from ihbench.record.schema import PredictionFiles
from ihbench.reports.general.report import HTML, LATEX, MARKDOWN
from ihbench.reports.lint.metric_names import head_metric
from ihbench.reports.lint.table_files import read_tables
from ihbench.reports.lint.table_lint import lint
from ihbench.reports.paper.paper_numbers import paper_table
from ihbench.reports.paper.paper_table import build_frame
from tests.reports.fake_runs import SUBJECTS, fake_run, with_about
from tests.reports.made_up_runs import FLIP, PSNR, made_up, sweep
from tests.reports.test_ablation import told, variant
from tests.reports.test_table_formats import structure

TABLE1, TABLE2 = paper_table("table1"), paper_table("table2")


def linted(text, kind, tmp_path):
    file = tmp_path / f"own.{kind}"
    file.write_text(text, encoding="utf-8")
    tables, notes = read_tables(file)
    assert tables
    assert not notes
    return lint(tables)


def fragment(frame, kind):
    return write_fragment([*frame.tables, *frame.below], kind)


def random_runs(seed):
    """Three rows on four scenes of two protocols, now and then alike, absent or within noise."""
    rng = random.Random(seed)
    found = []
    for protocol in ("zju_occ@1", "people_snapshot_occ@1"):
        for method, changed in (("ours", {}), ("ours", {"levels": (64, 128), "inpaint.on": False}), ("theirs", {})):
            base, spread = rng.choice((20.0, 20.004, 27.5)), rng.choice((0.0, 0.01, 1.0))
            for scene in SUBJECTS:
                psnr, ssim = base + rng.gauss(0, spread), min(0.999, 0.9 + rng.gauss(0, spread / 100))
                lpips = rng.choice((float("nan"), 0.04 + rng.random() / 100))
                found.append(
                    fake_run(scene, method, psnr, ssim, lpips, who={"protocol": protocol}, said={"changed": changed})
                )
    return found


# --------------------------------------------------------------------------------------------------- the linter


@pytest.mark.parametrize("scenes", ["a", "abc"])
@pytest.mark.parametrize("psnr", [17.8, 23.0, 120.0])
def test_the_general_report_passes(tmp_path, scenes, psnr):
    runs = sweep(tmp_path / "runs", scenes, (0, 1))
    runs += [made_up(tmp_path / "more", s, "third", psnr=psnr, of=55, views=6) for s in scenes]
    many = [made_up(tmp_path / "more", s, "long", changed={f"a.b{k}": k for k in range(12)}) for s in scenes]
    for report in (LATEX, MARKDOWN):
        for fragment in (False, True):
            text = report([*runs, *many], fragment=fragment)
            assert linted(text, "tex" if report is LATEX else "md", tmp_path) == []


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("table", [TABLE1, TABLE2], ids=["table1", "table2"])
def test_the_papers_tables_pass_with_measured_rows(tmp_path, table, seed):
    rng = random.Random(seed)
    runs = random_runs(seed) * bool(seed)
    names = [row.name for row in table.rows]
    choice = (
        Choice()
        if seed < 4
        else Choice(tuple(rng.sample(names, 3)) + ("ours",) * bool(runs), rng.choice(((), ("psnr",))))
    )
    frame = build_frame(table, runs, choice=choice)
    for kind in ("tex", "md"):
        for text in (write(frame.blocks, kind), fragment(frame, kind)):
            assert linted(text, kind, tmp_path) == []


def test_the_ablations_table_passes(tmp_path):
    runs = {name: variant(tmp_path / "runs", 20 + k) for k, name in enumerate(("low", "mid", "high"))}
    text, _ = told(runs, (("first", "low", "mid"), ("both", "low", "high")))
    assert linted(text, "md", tmp_path) == []


@pytest.mark.parametrize(
    ("head", "metric"),
    [
        ("PSNR ≥ 25 dB", None),
        ("FLIP ≤ .5", None),
        ("SSIM > 0.9", None),
        ("IoU > 0.5 ↑", "iou"),
        ("PSNR ↑ (dB)", "psnr"),
    ],
)
def test_a_threshold_is_no_metric(head, metric):
    found = head_metric(head)
    assert (found.name if found else None) == metric


# -------------------------------------------------------------------------------------------------- what LaTeX sees


@pytest.mark.parametrize("seed", range(4))
def test_fragments_and_documents_are_well_formed(tmp_path, seed):
    runs = random_runs(seed)
    frame = build_frame(TABLE1, runs, choice=Choice(regions=("body", "hidden")))
    own = [*sweep(tmp_path), made_up(tmp_path, "a", "x_y & z", changed={"p%": 1, "q": "$2"})]
    begin, end = "\\begin{document}\n", "\n\\end{document}\n"
    for text in (LATEX(own), write(frame.blocks, "tex")):
        assert structure(text) == []
    for text in (LATEX(own, fragment=True), fragment(frame, "tex")):
        assert not re.search(r"\\(documentclass|fitted|begin\{(table|document)\})", text)
        assert structure(begin + text + end) == []
        columns_are_as_declared(text)


def columns_are_as_declared(text):
    """Every row of every tabular has as many cells as its specification has columns, spans counted."""
    found = re.findall(r"\\begin\{tabular\}\{([lcr]+)\}\n(.*?)\\end\{tabular\}", text, re.DOTALL)
    assert found
    for spec, body in found:
        for line in body.splitlines():
            if line.endswith(r"\\"):
                cells = re.split(r"(?<!\\)&", line)
                spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
                assert len(cells) + sum(spans) == len(spec), line


# ------------------------------------------------------------------------------------------------------ row names


@pytest.mark.parametrize(
    ("label", "name", "switches"),
    [
        ("ours", "ours", ""),
        ("ours (steps=50)", "ours", "steps=50"),
        ("ours (levels=(64, 128), inpaint.on=False) on A", "ours on A", "levels=(64, 128), inpaint.on=False"),
        ("ours (a=1) [train = test]", "ours [train = test]", "a=1"),
        ("mine (predictions, only 3 of 4 views)", "mine (predictions, only 3 of 4 views)", ""),
        ("ours (a=1, code 0.1+2)", "ours (code 0.1+2)", "a=1"),
    ],
)
def test_switches_leave_the_name_and_nothing_else_does(label, name, switches):
    assert split_label(label) == (name, switches)


def test_a_fragment_says_what_its_letters_mean():
    frame = build_frame(TABLE1, random_runs(1), choice=Choice(("ours", "ours (levels=(64, 128), inpaint.on=False)")))
    for kind in ("tex", "md", "html"):
        text = fragment(frame, kind)
        for letter, words in frame.footnotes.items():
            assert re.search(rf"(<sup>|superscript{{){letter}(</sup>|}}) {words.split()[0][:6]}", text)


def test_rows_are_short_in_latex_and_the_switches_stand_below(tmp_path):
    text = LATEX(sweep(tmp_path))
    rows = [line for line in text.splitlines() if line.endswith(r"\\") and line.startswith("ours")]
    assert rows
    assert not any("=" in line.partition("&")[0] for line in rows)
    assert r"ours\textsuperscript{a} &" in text
    assert r"\textsuperscript{a} steps=50; \textsuperscript{b} steps=200" in text
    frame = build_frame(TABLE1, random_runs(1))
    for kind in ("tex", "md", "html"):
        text = write(frame.blocks, kind).replace("<tr>", "\n<tr>")
        assert "levels=(64, 128), inpaint.on=False" in text  # in a footnote
        rows = [line for line in text.splitlines() if re.match(r"\|? ?(<tr><td class=.left.>)?ours", line)]
        assert len(rows) == 2
        assert sum("sup" in re.split(r"&|\| |</td>", row.removeprefix("| "))[0] for row in rows) == 1
        assert not any("levels" in row for row in rows)


def test_in_markdown_and_on_pages_only_long_names_are_cut(tmp_path):
    long = made_up(tmp_path, changed={f"switch{k}": k for k in range(8)})
    for report in (MARKDOWN, HTML):
        text = report([*sweep(tmp_path), long])
        assert "ours (steps=50)" in text
        assert "ours<sup>a</sup>" in text
        assert "<sup>a</sup> switch0=0, switch1=1" in text


def test_one_text_has_one_letter_in_a_document():
    from ihbench.document.document import Table

    tables = [Table(("method",), (("m (a=1)",), ("n (b=2)",))), Table(("method",), (("n (b=2)",), ("m (c=3)",)))]
    found = with_short_names(tables)
    letters = [row[0][1].text for table in (found[0], found[2]) for row in table.rows]
    assert letters == ["a", "b", "b", "c"]


# ------------------------------------------------------------------------------------------------------- choices


WRITERS = {"md": MARKDOWN, "tex": LATEX, "html": HTML}


@pytest.mark.parametrize("kind", WRITERS)
def test_rows_metrics_regions_and_names_are_chosen(tmp_path, kind):
    runs = sweep(tmp_path, "a")
    choice = Choice(("theirs", "ours (steps=50)"), ("psnr",), ("hidden",), ("ours (steps=50)=Half as long",))
    text = WRITERS[kind](choice.applied(runs), fragment=True)
    assert [name for name in re.findall(r"theirs|Half as long|ours|truth", text)] == ["theirs", "Half as long"]
    assert "PSNR" in text
    assert "hidden" in text
    assert not re.search("FLIP|body", re.sub("</?tbody>", "", text))
    whole = WRITERS[kind](choice.applied(runs))
    assert not re.search(r"FLIP|ours", re.sub(r"src=\S+", "", whole))
    others = [run for run in runs if run.about.changed]
    every = WRITERS[kind](
        Choice(("ours",)).applied([*others, runs[-1]]), fragment=True
    )  # a method is all of its rows
    assert "theirs" not in every
    assert every.count("ours") == 4
    assert (
        WRITERS[kind](Choice(("ours",)).applied(runs), fragment=True).count("ours") == 1
    )  # but this is a row's name


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (Choice(rows=("thiers",)), r"--rows thiers: .*did you mean 'theirs'"),
        (Choice(metrics=("psrn",)), r"--metrics psrn: .*did you mean 'psnr'"),
        (Choice(regions=("boddy",)), r"--regions boddy: .*did you mean 'body'"),
        (Choice(names=("their=x",)), r"--names their=x: .*did you mean 'theirs'"),
        (Choice(names=("theirs",)), "expected OLD=NEW"),
        (Choice(names=("theirs=",)), "expected a name after"),
        (Choice(names=("theirs=ours",)), "two rows would be called 'ours'"),
        (Choice(names=("theirs=truth",)), "expected a name after"),
        (Choice(names=("truth=GT",)), "keeps its name"),
    ],
)
def test_unknown_words_are_answered_with_the_nearest(tmp_path, choice, message):
    with pytest.raises(BadInput, match=message):
        choice.applied(sweep(tmp_path, "a"))
    if not choice.regions:
        with pytest.raises(BadInput, match=message):
            build_frame(TABLE1, [fake_run(s, m) for s in SUBJECTS for m in ("ours", "theirs")], choice=choice)


def test_marks_are_those_among_the_rows_that_are_shown():
    frame = build_frame(TABLE1, [], choice=Choice(("OccNeRF", "GauHuman", "HumanNeRF"), ("psnr",)))
    (table,) = frame.tables
    assert [label.name for label in table.labels] == ["OccNeRF", "GauHuman", "HumanNeRF"]
    assert [row[2].mark for row in table.rows] == ["best", "second", ""]
    assert {column.key for column in table.head[2:]} == {"psnr"}


def test_measured_blocks_are_there_for_every_region():
    runs = [fake_run(s, m, 20.0 + k) for s in SUBJECTS for k, m in enumerate(("ours", "theirs"))]
    frame = build_frame(TABLE1, runs, choice=Choice(regions=("body", "hidden"), names=("ours=We",)))
    measured = [table for table in frame.tables if not table.kind.startswith("quoted")]
    titles = [table.title for table in measured]
    assert [title.rpartition(", ")[2] for title in titles] == ["region body", "region hidden"]
    assert {label.name for label in measured[0].labels} >= {"We", "theirs", "truth"}
    assert len(build_frame(TABLE1, runs, choice=Choice(regions=("body", "body"))).tables) == 3
    only = build_frame(TABLE1, runs, choice=Choice(("theirs",)))
    assert [[label.name for label in table.labels] for table in only.tables] == [["theirs"]]


def test_a_run_with_a_name_of_its_own_keeps_the_mark_of_missing_views(tmp_path):
    files = PredictionFiles(missing=("x",), surplus=(), notes=(), views=4)
    run = with_about(made_up(tmp_path), predictions=files)
    named = Choice(names=("ours (predictions)=Mine",)).applied([run])
    text = MARKDOWN(named)
    assert "| Mine (only 3 of 4 views) |" in text


def test_a_curve_is_chosen_like_the_table(tmp_path):
    run = made_up(tmp_path)
    (chosen,) = Choice(metrics=("flip",), regions=("hidden",)).applied([run])
    assert {str(i) for point in chosen.curve for i in point.scores} == {FLIP.format("hidden")}
    assert PSNR.format("hidden") in map(str, run.curve[0].scores)
    assert replace(chosen).headline == "hidden"
