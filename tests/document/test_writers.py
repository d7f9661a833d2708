"""Markdown, LaTeX and HTML of one report: the same numbers, and nothing that a name can break or run."""

from __future__ import annotations

import os
import re
from html import unescape
from html.parser import HTMLParser

import cmarkgfm
import pytest
from cmarkgfm.cmark import Options
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ihbench.document import csv, diagram, html, latex, markdown, terminal
from ihbench.document.document import Bullets, Heading, Paragraph, Table, code, strong
from ihbench.errors import BadInput, Diverged
from ihbench.reports.general import report
from ihbench.reports.general.content import general_report
from tests.reports.made_up_runs import made_up

NASTY = r"""<script>alert(1)</script> & "x" 'y' \write18{rm} $a_b^c$ 100% #1 {~} | `q` ]( ↑ 文"""
BLOCKS = [
    Heading(2, NASTY),
    Paragraph((NASTY, strong(NASTY), code(NASTY))),
    Bullets((NASTY,)),
    Table((NASTY, "n"), ((NASTY, "1"),)),
]
VOID = {"meta", "img", "br"}


class Strict(HTMLParser):
    """Collects tags, attributes and text; fails on tags that do not match."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parsed(text):
    reader = Strict()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return reader


def test_html_shows_every_word_as_it_is_and_runs_none():
    found = parsed(html.write(BLOCKS))
    assert "script" not in found.tags
    assert "".join(found.text).count(NASTY) == 7
    assert not [name for name, _ in found.attributes if name.startswith("on")]


def test_html_is_one_file_that_fetches_nothing(tmp_path):
    text = report.HTML([made_up(tmp_path, scene=NASTY.replace("/", " "))])
    found = parsed(text)
    links = [value for name, value in found.attributes if name in ("src", "href", "srcset", "action")]
    assert len(links) >= 2
    assert all(value.startswith("data:image/png;base64,") for value in links)
    assert "default-src 'none'" in unescape(text)
    assert not re.search(r"url\(|@import", text)


def test_latex_has_no_active_character_of_anybodys():
    text = latex.write(BLOCKS)
    body = text.split(r"\begin{document}")[1]
    assert r"\write18" not in body
    assert r"\textbackslash{}write18\{rm\}" in body
    assert "[U+6587]" in body
    assert r"$\uparrow$" in body
    assert balanced(text)


def balanced(text):
    """Whether braces match, and dollars come in pairs, once escaped ones are gone."""
    bare = re.sub(r"\\[\\{}$&#_%]", "", text)
    depth = 0
    for letter in bare:
        depth += {"{": 1, "}": -1}.get(letter, 0)
        if depth < 0:
            return False
    return depth == 0 and bare.count("$") % 2 == 0


@given(st.text(max_size=30))
@settings(deadline=None, derandomize=True, max_examples=200)
def test_whatever_text_it_is_latex_stays_balanced_and_on_its_line(text):
    out = latex.escape(text)
    assert balanced(out)
    assert "\n" not in out
    assert "\r" not in out
    assert not re.search(r"(?<!\\)[&#_%]", re.sub(r"\\\\", "", out))
    assert all(ord(letter) <= latex.LATIN for letter in out)


@given(st.text(max_size=30))
@settings(deadline=None, derandomize=True, max_examples=200)
def test_whatever_text_it_is_a_markdown_row_keeps_its_cells(text):
    row = markdown.write([Table(("a", "b"), ((text, "1"),))]).splitlines()[2]
    assert len(re.split(r"(?<!\\)\|", row)) == 4
    assert "<" not in row


def test_latex_tables_are_booktabs_with_as_many_cells_as_columns(tmp_path):
    text = report.LATEX([made_up(tmp_path), made_up(tmp_path, "b", seed=1)])
    assert balanced(text)
    tables = re.findall(r"\\begin\{tabular\}\{([lr]+)\}\n(.*?)\\end\{tabular\}", text, re.S)
    assert len(tables) >= 5
    for columns, body in tables:
        assert body.count(r"\toprule") == body.count(r"\midrule") == body.count(r"\bottomrule") == 1
        rows = [line for line in body.splitlines() if line.endswith(r" \\")]
        assert rows
        assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {len(columns)}


def test_all_say_the_same_numbers(tmp_path):
    runs = [made_up(tmp_path, s, psnr=p) for s, p in (("a", 23.456), ("b", 27.891))]
    found = [
        sorted(re.findall(r"\d+\.\d{2,4}(?!\d)", re.sub(r"<style>.*?</style>|src=\"[^\"]*\"", "", text, flags=re.S)))
        for text in (
            report.MARKDOWN(runs),
            report.LATEX(runs),
            html.write(general_report(runs)),
            terminal.write(general_report(runs)),
        )
    ]
    assert all(numbers == found[0] for numbers in found)
    assert "25.67" in found[0]


def test_pictures_are_named_relative_to_where_the_text_lies(tmp_path):
    picture = tmp_path / "out" / "figures" / "a b.png"
    picture.parent.mkdir(parents=True)
    picture.write_bytes(b"\x89PNG")
    shown = {"pictures": [(picture, "What | it <shows>")], "folder": tmp_path / "out"}
    assert "(<figures/a%20b.png>)" in report.MARKDOWN([], **shown)
    assert r"\detokenize{figures/a b.png}" in report.LATEX([], **shown)
    assert "data:image/png;base64,iVBORw==" in report.HTML([], **shown)


LIVELY = [
    "[a](http://x.y)", "![a](http://x.y/z.png)",
    "http://x.y", "www.x.y", "me@x.org", "[a]: http://x.y", "[a][b]", "<b>",
    "&lt;b&gt;", "&#60;b", "a|b", "a\\|b", "*a*", "_a_", "~~a~~", "`a`", "# a", "- a", "1. a", "> a", "[![a](b)](c)",
    "**", "=", "+ a", "a\\", "$a$", "https:/\\/x.y", "zju_occ@1", "[-0.2, +0.3]",
]  # fmt: skip
UNSEEN = "a\x1b[31mb\x07\u202ec\u2066d\u200be\u2028f\x9bg\U000e0041h\ud800"


@pytest.mark.parametrize("text", LIVELY)
def test_markdown_of_any_name_shows_it_and_links_nothing(text):
    source = markdown.write([Paragraph(text), Bullets((text,)), Table(("h",), ((text,),)), Heading(2, text)])
    page = cmarkgfm.github_flavored_markdown_to_html(source, options=Options.CMARK_OPT_UNSAFE)
    allowed = {"p", "ul", "li", "table", "thead", "tbody", "tr", "th", "td", "h2"}
    assert set(parsed(page).tags) == allowed
    cells = [re.sub("<!--.*?-->", "", cell) for cell in re.findall(r"<(?:p|li|td|h2)>(.*?)</(?:p|li|td|h2)>", page)]
    assert [unescape(cell) for cell in cells] == [text] * 4


@pytest.mark.parametrize("write", [markdown.write, latex.write, html.write, csv.write, terminal.write])
def test_unseen_characters_reach_no_report(write):
    text = write(
        [Heading(2, UNSEEN), Paragraph((UNSEEN, strong(UNSEEN), code(UNSEEN))), Table((UNSEEN,), ((UNSEEN,),))]
    )
    assert not set(UNSEEN) & set(text) - set("a[31mbcdefgh")
    text.encode()


@pytest.mark.parametrize("error", [BadInput(UNSEEN), Diverged(3, UNSEEN)])
def test_unseen_characters_of_names_do_not_reach_the_terminal_with_an_error(error):
    assert str(error).isprintable()


@pytest.mark.parametrize("text", ["$\\frac$", "_hidden", "a\x1bb", "$"])
def test_diagrams_take_any_name(text, tmp_path):
    drawn, (panel,) = diagram.figure()
    (line,) = panel.plot([1, 2], [1, 2])
    drawn.legend([line], [diagram.words(text)])
    diagram.place_labels(panel, [diagram.Label((1, 1), text)])
    svg = diagram.files(drawn, [])[".svg"].decode()
    assert text.replace("\x1b", "\\x1b") in svg


def test_the_pages_policy_forbids_forms_and_another_base():
    page = html.write([])
    assert "form-action 'none'" in unescape(page)
    assert "base-uri 'none'" in unescape(page)


def test_the_page_has_the_runs_own_pictures_and_survives_spoiled_ones(tmp_path):
    good, linked, text = (made_up(tmp_path, scene) for scene in "abc")
    Image.new("RGB", (8, 8)).save(good.folder / "contact_sheet.png")
    (linked.folder / "contact_sheet.png").symlink_to(good.folder / "contact_sheet.png")
    (text.folder / "contact_sheet.png").write_text("no picture")
    os.mkfifo(text.folder / "inpainting.png")
    page = report.HTML([good, linked, text])
    assert page.count(": test views (p@1, quick)</figcaption>") == 1
    assert "ours on a, seed 0: test views" in page


def test_a_row_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="rows of 2 cells"):
        Table(("a", "b"), (("1",),))
