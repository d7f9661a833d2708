"""Markdown, LaTeX, HTML, CSV and JSON: the same numbers in each, nothing that breaks out of its cell."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from html.parser import HTMLParser

import pytest

from ihbench.reports.lint.table_files import read_tables
from ihbench.reports.paper.paper_numbers import paper_table
from ihbench.reports.paper.paper_table import build_frame
from ihbench.reports.paper.table_command import written
from tests.reports.fake_runs import SUBJECTS, fake_run

NASTY = '<b>x</b> & 50% | $a_b$ #1 ~^ {c} \\d *e* `f` [g] "h" 人'


def runs():
    made = [
        fake_run(
            s, method, psnr + 5 * k, 0.9 + 0.001 * k, 0.03 + 0.01 * psnr / 20, who={"config": {"levels": [64, 128]}}
        )
        for k, s in enumerate(SUBJECTS)
        for method, psnr in (("good", 22.0), ("middle", 21.01), (NASTY, 20.0))
    ]
    return [
        *made,
        fake_run("a", "real", said={"standin": ""}),
        fake_run("a", "=cmd()", status="failed", reason="no | `x`\n*"),
    ]


@pytest.fixture(scope="module")
def frame():
    return build_frame(paper_table("table1"), runs())


@pytest.fixture(scope="module")
def ablation():
    who = {
        "protocol": "people_snapshot_occ@1",
        "config": {"levels": [64, 128], "inpaint": {"on": True, "ti": False, "sg": True}},
    }
    return build_frame(paper_table("table2"), [fake_run(s, psnr=20.0 + k, who=who) for k, s in enumerate(SUBJECTS)])


def cells_of(frame):
    """(number, mark) of every cell, block by block and row by row."""
    return [[[(c.text, c.mark) for c in t.numbers(k)] for k in range(len(t.rows))] for t in frame.tables]


def read_back(text, suffix, tmp_path):
    file = tmp_path / f"table{suffix}"
    file.write_text(text, encoding="utf-8")
    width = 3  # PSNR, SSIM, LPIPS* of a data set
    return [
        [[(c.shown or "—", c.mark) for c in row[-(len(row) // width * width) :]]
         for row in zip(*(column.cells for column in table.columns), strict=True)]
        for table in read_tables(file)[0]
    ]  # fmt: skip


class Cells(HTMLParser):
    """Texts and marks of the cells with numbers, by table and row; and every tag that was met."""

    def __init__(self):
        super().__init__()
        self.tables, self.tags, self.open, self.cell = [], [], [], None

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open.append(tag)
        if tag == "tbody":
            self.tables.append([])
        elif tag == "tr" and "tbody" in self.open:
            self.tables[-1].append([])
        elif tag == "td" and "title" in dict(attrs):
            self.cell = ["", ""]
            self.tables[-1][-1].append(self.cell)

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass
        if tag == "td":
            self.cell = None

    def handle_data(self, data):
        if self.cell is None or "sup" in self.open or "span" in self.open:
            return
        self.cell[0] += data.strip()
        self.cell[1] = "best" if "strong" in self.open else "second" if "u" in self.open else self.cell[1]


def test_every_format_holds_the_same_numbers_and_marks(frame, ablation, tmp_path):
    for one in (frame, ablation):
        expected = cells_of(one)
        assert read_back(written(one, "md"), ".md", tmp_path) == expected
        assert read_back(written(one, "tex"), ".tex", tmp_path) == expected
        page = Cells()
        page.feed(written(one, "html"))
        assert [[[tuple(c) for c in row] for row in table] for table in page.tables] == expected
        flat = [cell for block in expected for row in block for cell in row]
        lines = list(csv.DictReader(io.StringIO(written(one, "csv"))))
        assert [(line["text"].partition(" ")[0], line["mark"]) for line in lines] == flat
        content = json.loads(written(one, "json"), parse_constant=lambda name: pytest.fail(f"no JSON: {name}"))
        found = [c for b in content["blocks"] for row in b["rows"] for c in row["cells"]]
        assert [(c["text"].partition(" ")[0], c["mark"]) for c in found] == flat


def test_csv_and_json_have_status_interval_and_words_for_every_cell(frame):
    lines = list(csv.DictReader(io.StringIO(written(frame, "csv"))))
    (one,) = [
        line for line in lines
        if (line["row"], line["group"], line["metric"], line["kind"]) == ("good", "ZJU-MoCap", "PSNR", "stand-in")
    ]  # fmt: skip
    assert float(one["value"]) == 29.5
    assert float(one["low"]) < 29.5 < float(one["high"])
    assert (one["scenes"], one["status"], one["mark"], one["unit"]) == ("4", "stand-in", "best", "dB")
    assert one["identity"] == "psnr/pooled/range1/body/v1"
    assert all(line["reason"] and not line["value"] for line in lines if line["status"] == "absent")
    (wrong,) = [line for line in lines if line["row"] == "OccFusion" and "underlines" in line["footnotes"]]
    assert (wrong["metric"], wrong["text"]) == ("SSIM", "0.9548")
    assert {line["status"] for line in lines} >= {
        "reported",
        "quoted",
        "unreliable",
        "stand-in",
        "measured",
        "absent",
    }


def test_names_from_elsewhere_are_no_formulas_and_no_tags(frame):
    text = written(frame, "csv")
    labels = {line["row"] for line in csv.DictReader(io.StringIO(text))}
    assert "'=cmd()" in labels
    assert NASTY in labels
    page = Cells()
    page.feed(written(frame, "html"))
    assert {"b", "script"}.isdisjoint(page.tags)
    assert "&lt;b&gt;x&lt;/b&gt; &amp; 50% |" in written(frame, "html")


def test_a_page_needs_nothing_beside_it_and_is_balanced(frame):
    text = written(frame, "html")
    assert not re.search(r"(src|href)=|<script|<link|@import|url\(", text)
    page = Cells()
    page.feed(text)
    assert [tag for tag in page.open if tag not in ("meta",)] == []


def test_markdown_keeps_its_columns(frame, ablation):
    for one in (frame, ablation):
        for part in written(one, "md").split("### ")[1:]:
            widths = {len(re.findall(r"(?<!\\)\|", line)) for line in part.splitlines() if line.startswith("|")}
            assert len(widths) == 1


def test_stand_in_blocks_say_so_in_every_format(frame):
    assert "### Measured here on STAND-INS, not on real data" in written(frame, "md")
    assert "STAND-INS, not on real data" in written(frame, "tex")
    assert '<section class="stand-in"><h2>Measured here on STAND-INS' in written(frame, "html")


# ---------------------------------------------------------------------------------------------- LaTeX, without TeX


def structure(text):
    """What is wrong with a LaTeX document as far as can be told without TeX."""
    code = re.sub(r"(?<!\\)%.*", "", text)
    problems, stack, depth = [], [], 0
    for token in re.finditer(r"\\(begin|end)\{(\w+\*?)\}|\\.|[{}]", code, re.DOTALL):
        if token[1] == "begin":
            stack.append((token[2], depth))
        elif token[1] == "end":
            if not stack or stack.pop() != (token[2], depth):
                problems.append(f"\\end{{{token[2]}}} does not fit")
        elif token[0] in "{}":
            depth += 1 if token[0] == "{" else -1
            if depth < 0:
                problems.append("a brace too many")
    if depth or stack:
        problems.append(f"left open: {depth} braces, {stack}")
    body = code[code.index(r"\begin{document}") :]
    if len(re.findall(r"(?<!\\)\$", body)) % 2:
        problems.append("a dollar too many")
    outside = re.sub(r"\\(label|cmidrule|begin|end|detokenize)(\(\w+\))?(\{[^{}]*\})+", "", body)
    problems += [
        f"bare {c}" for c in "_^#~" if re.search(rf"(?<!\\){re.escape(c)}", re.sub(r"\\text\w+\{\}", "", outside))
    ]
    problems += [f"no font has {c}" for c in sorted(set(body)) if ord(c) > 0x17F]
    for spec, rows in re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", body, re.DOTALL):
        for row in re.split(r"\\\\", rows)[:-1]:
            spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", row)]
            width = 1 + len(re.findall(r"(?<!\\)&", row)) + sum(spans)
            if width != len(spec):
                problems.append(f"{width} columns in a table of {len(spec)}: {row.strip()[:60]}")
            if re.match(r"\s*[\[*]", row):
                problems.append(f"an argument of the row before: {row.strip()[:60]}")
    return problems


def test_latex_is_well_formed(frame, ablation):
    for one in (frame, ablation):
        text = written(one, "tex")
        assert structure(text) == []
        for rule in (r"\toprule", r"\midrule", r"\bottomrule"):
            assert text.count(rule) >= len(one.tables)
        assert "booktabs" in text
        assert len(set(re.findall(r"\\label\{(.*?)\}", text))) == len(one.tables)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"\end{tabular}", ""),
        (r"\textbf{24.65}", r"\textbf{24.65"),
        ("20.67 &", "20.67"),
        (r"$\uparrow$", r"$\uparrow"),
        ("HumanNeRF", "Human_NeRF"),
        ("GTU", "[GTU"),
        ("GTU", "G人U"),
    ],
)
def test_the_checker_sees_what_tex_would_refuse(frame, old, new):
    text = written(frame, "tex")
    assert old in text
    assert structure(text.replace(old, new, 1)) != []


def test_a_label_is_not_taken_for_the_argument_of_a_row():
    frame = build_frame(paper_table("table1"), [fake_run("a", "[1cm]"), fake_run("a", "*")])
    assert structure(written(frame, "tex")) == []


def test_infinite_and_absent_numbers_are_strings_or_nothing_for_programs(frame):
    content = json.loads(written(frame, "json"))
    truths = [row for block in content["blocks"] for row in block["rows"] if row["row"] == "truth"]
    assert truths[0]["cells"][0]["value"] == "inf"
    lines = [line for line in csv.DictReader(io.StringIO(written(frame, "csv"))) if line["row"] == "truth"]
    assert math.isinf(float(lines[0]["value"]))
