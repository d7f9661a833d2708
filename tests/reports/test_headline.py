"""The headline table: the first thing on a terminal, never wider than 80 columns, with the pictures' paths below."""

from __future__ import annotations

import pytest
from rich.cells import cell_len

from ihbench.document.document import Heading, plain_text
from ihbench.reports.general.headline import headline_section, write
from ihbench.reports.general.report import HTML
from tests.reports.fake_runs import fake_run, write_run
from tests.reports.test_report_verbs import ihbench  # noqa: F401 (a fixture)


def lines_of(*runs, **more):
    return write(list(runs), **more).splitlines()


def test_methods_come_first_then_what_bounds_them():
    lines = lines_of(fake_run("a", psnr=20.0), fake_run("b", psnr=21.0), fake_run("a", "other", psnr=19.0))
    assert lines[0] == "zju_occ@1, quick profile, stand-in v1 seed 0: made by the bench, not real data"
    head, rule, ours, other, truth = (line.split() for line in lines[2:7])
    assert other.pop(1) == "†"
    assert head == ["region", "body", "PSNR", "↑", "SSIM", "↑", "fit", "s"]
    assert set("".join(rule)) == {"-"}
    assert ours == ["ours", "20.50", "0.9000", "10"]
    assert other == ["other", "19.00", "0.9000", "10"]
    assert truth == ["truth", "∞", "1.0000"]
    about = lines.index("mean over test views of a, b; not shown: LPIPS*")
    assert lines[about + 1 : about + 3] == ["† other: over 1 of 2 scenes, without b", "weights are not there"]
    assert lines[-1].endswith("--full")


def test_what_drawing_takes_is_shown_where_there_is_room():
    runs = [fake_run(k, psnr=20.0, said={"render_ms": ms}) for k, ms in (("a", 100.0), ("b", 25.5))]
    runs.append(fake_run("a", "other", psnr=19.0))
    lines = lines_of(*runs)
    assert lines[2].split()[-4:] == ["fit", "s", "render", "ms"]
    assert lines[4].split() == ["ours", "20.00", "0.9000", "10", "62.8"]
    assert lines[5].split() == ["other", "†", "19.00", "0.9000", "10"]
    (head,) = (line for line in lines_of(*runs, width=46) if line.startswith("region"))
    assert head.split()[-2:] == ["fit", "s"]
    assert "SSIM" in head  # it goes before a metric does


def test_a_page_begins_with_the_same_tables():
    runs = [fake_run("a", psnr=20.0), fake_run("b", psnr=21.0), fake_run("c", status="failed", reason="fell")]
    heading, note, table = headline_section(runs)
    assert heading == Heading(2, "Headline")
    assert "a, b." in plain_text(note.words)
    assert table.head == ("method", "PSNR ↑", "SSIM ↑", "fit s")
    assert table.rows[0] == ("ours", "20.50", "0.9000", "10")
    page = HTML(runs)
    assert page.index(">Headline<") < page.index(">zju_occ@1, quick profile<")
    assert headline_section(runs[2:]) == []


def test_a_row_over_fewer_scenes_or_seeds_is_marked_however_long_its_name_is():
    named = {"changed": {f"s{k}": k for k in range(40)}}
    runs = [fake_run(scene, who={"seed": seed}) for scene in "ab" for seed in (0, 1)]
    runs += [fake_run("a", "long", said=named), fake_run("a", "long", said=named, who={"seed": 1})]
    runs += [fake_run("a", "once"), fake_run("b", "once")]
    for width in (40, 80):
        lines = lines_of(*runs, width=width)
        names = [line.split(" 20.00")[0].strip() for line in lines if " 20.00" in line]
        assert [name.split()[0] for name in names if name.endswith("†")] == ["long", "once"]
        assert len(names) == 3
        assert "over 1 of 2 scenes, without b † once: without seed 1 on a, b" in " ".join(lines)
    *_, said = headline_section(runs)
    assert said.items[1] == "† once: without seed 1 on a, b"
    assert "once †" in HTML(runs)


@pytest.mark.parametrize("width", [10, 40, 61, 80, 200])
def test_no_line_is_wider_than_the_terminal_or_80_columns(width):
    long = "日本語" * 40
    changes = {"changed": {f"s{k}": k for k in range(40)}}
    runs = [
        fake_run(long, long, said=changes),
        fake_run("b", "x" * 300, lpips=0.12345, views={"novel " + long: (20.0, 0.5)}),
        fake_run("c", "failing", status="failed", reason="\x1b[31mError: " + "no blanks" * 30),
        fake_run("d", who={"protocol": "p" * 200 + "@1"}),
    ]
    lines = lines_of(*runs, width=width, left_out=["x"])
    room = max(40, min(width, 80))
    assert [line for line in lines if cell_len(line) > room] == []
    assert any("…" in line for line in lines)
    assert not any("\x1b" in line for line in lines)
    assert "left out: 1 folder; --full says which and why" in " ".join(lines)


def test_pictures_are_named_whole_and_not_by_the_thousand(tmp_path):
    runs = [fake_run(scene) for scene in "abcdefghij"]
    runs = [type(run)(tmp_path / ("long" * 30) / run.scene, run.record, run.rows) for run in runs]
    for run in runs[:8]:
        run.folder.mkdir(parents=True)
        (run.folder / "contact_sheet.png").write_bytes(b"png")
    lines = lines_of(*runs)
    assert f"contact sheet: {runs[5].folder / 'contact_sheet.png'}" in lines
    assert "contact sheet: 2 more in the run folders" in lines
    assert len([line for line in lines if line.startswith("contact sheet")]) == 7


def test_a_report_is_short_on_a_terminal_and_whole_elsewhere(ihbench, tmp_path, monkeypatch):  # noqa: F811
    write_run(tmp_path / "runs", "a", "mine", 20.0, 0.9)
    whole = ihbench("report").out
    assert whole.startswith("## zju_occ@1")
    monkeypatch.setattr("ihbench.commands.report._on_terminal", lambda: True)
    for words in (["--full"], ["--format", "md"], ["--target", "psnr=20"]):
        assert ihbench("report", *words).out.startswith("## zju_occ@1"), words
    short = ihbench("report").out
    assert short.startswith("zju_occ@1, quick profile")
    assert max(map(len, short.splitlines())) <= 80
