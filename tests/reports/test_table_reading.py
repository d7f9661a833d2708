"""Reading tables back: what real LaTeX and Markdown hold, and what no file may do to the reader."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.errors import BadInput
from ihbench.reports.lint.latex_reading import latex_grids
from ihbench.reports.lint.metric_names import head_metric
from ihbench.reports.lint.table_files import markdown_grids, read_tables
from ihbench.reports.lint.table_reading import tables_of


def latex(body, spec="lcc", before="", after=""):
    """(table, notes) of one tabular."""
    grids, notes = latex_grids(f"{before}\\begin{{tabular}}{{{spec}}}\n{body}\n\\end{{tabular}}{after}")
    (table,) = [table for grid in grids for table in tables_of(grid)]
    return table, [text for _, text in notes]


def markdown(text):
    grids, _ = markdown_grids(text)
    (table,) = [table for grid in grids for table in tables_of(grid)]
    return table


def one(cell, **more):
    """The cell of a table with one number, written in LaTeX."""
    table, _ = latex(rf"\toprule M & PSNR $\uparrow$ & x \\ \midrule A & {cell} & y \\ \bottomrule", **more)
    return table.columns[0].cells[0]


# ----------------------------------------------------------------------------------------------------------- cells


@pytest.mark.parametrize(
    ("source", "value", "mark"),
    [
        ("24.65", 24.65, ""),
        (r"\textbf{24.65}", 24.65, "best"),
        (r"{\bf 24.65}", 24.65, "best"),
        (r"\bfseries 24.65", 24.65, "best"),
        (r"$\mathbf{24.65}$", 24.65, "best"),
        (r"\underline{24.65}", 24.65, "second"),
        (r"\textbf{\underline{24.65}}", 24.65, "best"),
        (r"\best{24.65}", 24.65, "best"),
        (r"\second{24.65}", 24.65, "second"),
        (r"\cellcolor[HTML]{AABBCC}24.65", 24.65, ""),
        (r"\textcolor{red}{24.65}", 24.65, ""),
        (r"\rowcolor{gray!10} 24.65", 24.65, ""),
        (r"24.65\textsuperscript{a}", 24.65, ""),
        (r"24.65$^{\dagger}$", 24.65, ""),
        (r"$24.65^*$\footnote{x & y}", 24.65, ""),
        (r"\phantom{0}9.79", 9.79, ""),
        (r"\multirow{2}{*}{24.65}", 24.65, ""),
        (r"\multicolumn{1}{c|}{\textbf{24.65}}", 24.65, "best"),
        (r"\num{24.65}", 24.65, ""),
        (r"~24.65\%", 24.65, ""),
        (r"1{,}234.5", 1234.5, ""),
        (r"$-0.5$", -0.5, ""),
        (r".9548", 0.9548, ""),
        (r"3.2$\times$", 3.2, ""),
        (r"$1.5\times10^{-3}$", None, ""),
        (r"--", None, ""),
        (r"\textbf{--}", None, ""),
        (r"N/A", None, ""),
        (r"24.65/0.95", None, ""),
        (r"", None, ""),
    ],
)
def test_numbers_and_marks_of_latex_cells(source, value, mark):
    cell = one(source)
    assert (cell.value if cell.shown else None) == value
    assert cell.mark == mark


@pytest.mark.parametrize(
    ("source", "low", "high"),
    [
        (r"24.65 $\pm$ 0.10", 24.55, 24.75),
        (r"24.65 {\scriptsize $\pm$0.10}", 24.55, 24.75),
        (r"\textbf{24.65}$_{\pm 0.10}$", 24.55, 24.75),
        (r"24.65 [23.90, 25.40]", 23.90, 25.40),
    ],
)
def test_intervals_of_latex_cells(source, low, high):
    number = one(source)
    assert number.shown == "24.65"
    assert (number.low, number.high) == pytest.approx((low, high))


def test_decimals_and_digits_are_those_that_are_written():
    number = one("0.0950")
    assert (number.decimals, number.significant) == (4, 3)


def test_the_files_own_macros_are_replaced():
    before = r"""
    \newcommand{\ours}{Ours}
    \newcommand{\loud}[2]{\textbf{#2}}
    \renewcommand{\quiet}[1]{\underline{#1}}
    \newcommand\up{$\uparrow$}
    \newcommand{\winner}[1]{\cellcolor{green!20}\textbf{#1}}
    """
    table, notes = latex(
        r"\toprule M & PSNR\up & SSIM\up \\ \midrule \ours{} (full) & \loud{x}{1.0} & \quiet{2.0} \\"
        r"B & \winner{1.5} & 3.0 \\",
        before=before,
    )
    assert notes == []
    assert [column.metric.arrow for column in table.columns] == ["↑", "↑"]
    assert table.columns[0].cells[0].label == "Ours (full)"
    assert [[cell.mark for cell in column.cells] for column in table.columns] == [["best", "best"], ["second", ""]]


# ---------------------------------------------------------------------------------------------------------- layout


def test_groups_of_columns_rules_comments_and_wrapped_rows():
    table, notes = latex(
        r"""\toprule[1pt]
\multirow{2}{*}{Method} & \multicolumn{2}{c|}{A \& B~\cite{x}} & \multicolumn{1}{c}{C} \\ % & no cell
\cmidrule(lr){2-3} \cline{4-4}
 & PSNR$\uparrow$ & \makecell{LPIPS*\\$\downarrow$} & PSNR
   $\uparrow$ \\ \midrule[.5pt]
\rowcolor{gray!10} Foo~\cite{a,b} & 1 & 2
   & 3 \\[2pt]
% Hidden & 9 & 9 & 9 \\
\addlinespace
Bar 50\% & 4 & 5 & 6 \\ \bottomrule""",
        spec="l|cc|c",
    )
    assert notes == []
    assert [column.title for column in table.columns] == ["A & B PSNR↑", "A & B LPIPS* ↓", "C PSNR ↑"]
    assert [cell.label for cell in table.columns[0].cells] == ["Foo", "Bar 50%"]
    assert [[cell.text for cell in column.cells] for column in table.columns] == [["1", "4"], ["2", "5"], ["3", "6"]]
    assert table.columns[0].cells[1].line == 11
    assert table.columns[2].cells[0].line == 8


def test_a_label_that_reaches_over_rows_names_all_of_them():
    table, _ = latex(
        r"""Data & M & PSNR $\uparrow$ \\ \hline
\multirow{2}{*}{ZJU} & A & 1 \\ & B & 2 \\ \hline
\multirow{2}{*}{Oc} & A & 3 \\ & B & 4 \\"""
    )
    assert [cell.label for cell in table.columns[0].cells] == ["ZJU / A", "ZJU / B", "Oc / A", "Oc / B"]
    assert len({cell.section for cell in table.columns[0].cells}) == 2


def test_metric_names_after_numbers_begin_another_table():
    grids, _ = latex_grids(
        r"\begin{tabular}{lc} M & PSNR \\ \hline A & 1 \\ \hline M & SSIM \\ \hline A & 0.5 \\ \end{tabular}"
    )
    tables = [table for grid in grids for table in tables_of(grid)]
    assert [table.columns[0].metric.name for table in tables] == ["psnr", "ssim"]


@pytest.mark.parametrize(
    "opening", [r"\begin{tabular*}{\linewidth}{@{\extracolsep{\fill}}lc}", r"\begin{tabularx}{\linewidth}[t]{lX}"]
)
def test_other_environments_are_tables_too(opening):
    name = opening.split("{")[1].split("}")[0]
    grids, _ = latex_grids(opening + r" M & PSNR $\uparrow$ \\ \hline A & 1.5 \\ \end{" + name + "}")
    (table,) = [table for grid in grids for table in tables_of(grid)]
    assert [table.columns[0].metric.name, table.columns[0].cells[0].value] == ["psnr", 1.5]


def test_what_is_hidden_is_not_read():
    hidden = r"\begin{tabular}{lc} M & PSNR \\ A & 1 \\ \end{tabular}"
    for before, after in (("\\begin{comment}\n", "\n\\end{comment}"), ("\\iffalse\n", "\n\\fi"), ("% ", "")):
        assert latex_grids(before + hidden + after)[0] == []


# -------------------------------------------------------------------------------------------------------- Markdown


@pytest.mark.parametrize(
    ("source", "mark"),
    [
        ("24.65", ""),
        ("**24.65**", "best"),
        ("__24.65__", "best"),
        ("<b>24.65</b>", "best"),
        ("<u>24.65</u>", "second"),
        ("<ins>24.65</ins>", "second"),
        ("**<u>24.65</u>**", "best"),
        ("***24.65***", "best"),
        ("*24.65*", ""),
        (r"$\mathbf{24.65}$", "best"),
        ("**24.65**<sup>a, b</sup>", "best"),
        ("**24.65** [23.90, 25.40]", "best"),
        (r"**24.65** ± 0.1", "best"),
        ("[**24.65**](http://x/a_b_c)", "best"),
    ],
)
def test_marks_of_markdown_cells(source, mark):
    table = markdown(f"| M | PSNR ↑ |\n|---|---:|\n| A | {source} |\n")
    assert table.columns[0].cells[0].value == 24.65
    assert table.columns[0].cells[0].mark == mark


def test_pipes_fences_comments_and_missing_edges():
    text = """
```
| M | PSNR |
|---|---|
| no | 1 |
```
<!-- | M | PSNR |
|---|---|
| no | 1 | -->
M | PSNR&uarr; | LPIPS\\*<br>$\\downarrow$
:--|--:|:-:
a\\|b | **1** | 2
short | 3
"""
    table = markdown(text)
    assert [column.title for column in table.columns] == ["PSNR↑", "LPIPS* ↓"]
    assert [cell.label for cell in table.columns[0].cells] == ["a|b", "short"]
    assert [[cell.text for cell in column.cells] for column in table.columns] == [["1", "3"], ["2", ""]]
    assert table.columns[0].cells[0].line == 12


# ----------------------------------------------------------------------------------------------------------- heads


@pytest.mark.parametrize(
    ("text", "name", "arrow", "scaled", "unit"),
    [
        ("PSNR↑", "psnr", "↑", False, ""),
        ("PSNR ↑ (dB)", "psnr", "↑", False, "db"),
        ("LPIPS* ↓", "lpips", "↓", True, ""),
        ("LPIPS ↓ (× 1000)", "lpips", "↓", True, ""),
        ("LPIPS (×10-3)", "lpips", "", True, ""),
        ("MS-SSIM", "ms-ssim", "", False, ""),
        ("ZJU-MoCap SSIM ↑", "ssim", "↑", False, ""),
        ("Time (s)", "time", "", False, "s"),
        ("Smoothness ↓", "smoothness", "↓", False, ""),
    ],
)
def test_heads_name_a_metric(text, name, arrow, scaled, unit):
    metric = head_metric(text)
    assert (metric.name, metric.arrow, metric.scaled, metric.unit) == (name, arrow, scaled, unit)


@pytest.mark.parametrize("text", ["Method", "", "scenes", "Lifetime", "2024"])
def test_other_heads_do_not(text):
    assert head_metric(text) is None


# -------------------------------------------------------------------------------------------------- bad input, abuse


def test_files_without_a_table_are_refused_in_one_line(tmp_path):
    cases = {
        "none.tex": None,
        "prose.tex": b"no table here",
        "prose.md": b"a | b",
        "picture.md": b"\xff\xd8\xff",
        "table.docx": b"x",
        "empty.tex": b"",
    }
    for name, content in cases.items():
        file = tmp_path / name
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(BadInput, match=name) as refused:
            read_tables(file)
        assert "\n" not in str(refused.value)


def test_what_is_not_understood_is_noted_with_its_line():
    grids, notes = latex_grids("\\begin{tabular}{lc}\nM & PSNR \\\\ \\hline\nA & \\sparkle{2} \\\\")
    assert len(grids) == 1
    assert notes == [
        (1, "\\begin{tabular} without \\end{tabular}"),
        (3, "\\sparkle is not known: its braces are read as text"),
    ]
    assert markdown_grids("<table><tr><td>1</td></tr></table>")[1] == [(1, "tables in HTML are not read")]


PIECES = st.sampled_from(
    [
        *(
            r"\begin{tabular}{lc}",
            r"\end{tabular}",
            "&",
            r"\\",
            r"\hline",
            "{",
            "}",
            r"\textbf{",
            "1.5",
            "$",
            "^",
            "_",
        ),
        *("%", "\n", "[", "]", r"\multicolumn{2}{c}{", r"\multirow{3}{*}{", "PSNR", r"\newcommand{\a}{\a\a}", r"\a"),
        *("#1", "\\", "|", "---", "**", "<u>", "</u>", "| a | b |\n|---|---|\n", "|---|", "↑", "±", "~", "`", "<!--"),
    ]
)


@settings(max_examples=150, deadline=None)
@given(st.lists(PIECES, max_size=40).map("".join))
def test_no_text_breaks_the_readers(text):
    for grids, notes in (latex_grids(text), markdown_grids(text)):
        for table in (table for grid in grids for table in tables_of(grid)):
            assert len({len(column.cells) for column in table.columns}) <= 1
        assert all(1 <= line <= text.count("\n") + 1 for line, _ in notes)


@pytest.mark.parametrize(
    "cell",
    ["{" * 5000, "\\textbf{" * 3000, "\\a", "**" * 3000, "<u>" * 3000, "$" * 3001, "9" * 400, "[" * 3000, "^" * 3000],
)
def test_deep_long_and_endless_cells_end(cell):
    latex_grids(
        "\\newcommand{\\a}{\\a\\a}\n\\begin{tabular}{lc} M & PSNR \\\\ \\hline A & " + cell + " \\\\ \\end{tabular}"
    )
    markdown_grids(f"| M | PSNR |\n|---|---|\n| A | {cell} |\n")


def test_infinity_is_a_number():
    assert math.isinf(one(r"$\infty$").value)
