"""The linter: silent on tables that are right, and on every planted fault exactly one line where it stands."""

from __future__ import annotations

import math
import random

import pytest

from ihbench.document.document import write
from ihbench.reports.lint.table_files import read_tables
from ihbench.reports.lint.table_lint import lint
from ihbench.reports.paper.paper_numbers import paper_table
from ihbench.reports.paper.paper_table import build_frame
from tests.reports.fake_runs import SUBJECTS, fake_run

BOLD = {"md": "**{}**", "tex": r"\textbf{{{}}}"}
UNDER = {"md": "<u>{}</u>", "tex": r"\underline{{{}}}"}
HEAD = ["Method", "A PSNR ↑", "A LPIPS* ↓", "B PSNR ↑", "Time (s)"]
# ! is a best mark, _ a second-best one
ROWS = [
    ["One", "20.10", "63.2", "15.10", "9"],
    ["Two", "_22.40", "!41.0", "_15.71", "120"],
    ["Three", "!23.96", "_42.3", "!18.28", "33.5"],
    ["Four", "21.55", "55.9", "--", "1.5"],
]


def text_of(rows, kind, head=HEAD, before=""):
    def cell(word):
        word = (
            BOLD[kind].format(word[1:])
            if word[0] == "!"
            else UNDER[kind].format(word[1:])
            if word[0] == "_"
            else word
        )
        if kind == "md":
            return word.replace("LPIPS*", r"LPIPS\*")
        for sign, command in (("↑", r"$\uparrow$"), ("↓", r"$\downarrow$"), ("±", r"$\pm$"), ("%", r"\%")):
            word = word.replace(sign, command)
        return word

    lines = [[cell(word) for word in row] for row in [head, *rows]]
    if kind == "md":
        told = f"<!-- {before} -->\n" if before else ""
        table = ["| " + " | ".join(line) + " |" for line in lines]
        return told + "\n".join([table[0], "|---" * len(head) + "|", *table[1:]]) + "\n"
    told = f"% {before}\n" if before else ""
    table = [" & ".join(line) + r" \\" for line in lines]
    columns = "l" + "c" * (len(head) - 1)
    return told + "\n".join(
        [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", table[0], r"\midrule", *table[1:], r"\end{tabular}", ""]
    )


def findings(text, kind, tmp_path):
    file = tmp_path / f"table.{kind}"
    file.write_text(text, encoding="utf-8")
    return lint(read_tables(file)[0])


def lines_of(rows, tmp_path, head=HEAD, before=""):
    """Findings as text, the same from Markdown and LaTeX; checks that they point at a line that shows the cell."""
    told = []
    for kind in ("md", "tex"):
        text = text_of(rows, kind, head, before)
        found = findings(text, kind, tmp_path)
        told.append([f"{f.cell}: {f.what}; expected {f.expected}" for f in found])
        for finding in found:
            name = finding.cell.removeprefix("column ").partition(",")[0].split()[0]
            assert name in text.splitlines()[finding.line - 1]
    assert sorted(told[0]) == sorted(told[1])
    return sorted(told[0])


def changed(row, column, word, rows=ROWS):
    copy = [list(line) for line in rows]
    copy[row][column] = word
    return copy


# ----------------------------------------------------------------------------------------------------- the paper's


@pytest.mark.parametrize("ending", ["md", "tex"])
def test_the_papers_own_wrong_underline_is_found_and_nothing_else(ending, tmp_path):
    frame = build_frame(paper_table("table1"), [], as_printed=True)
    (finding,) = findings(write(frame.blocks, ending), ending, tmp_path)
    assert finding.cell == "OccFusion, ZJU-MoCap SSIM ↑"
    assert finding.what == "wrong second-best mark: 0.9548 is 3rd of 9"
    assert finding.expected == "the mark on OccNeRF (0.9562)"


# as in the paper's source, shortened to what is on either side of the mistake
PAPER = r"""\begin{table*}[t]
    \begin{tabular}{l|ccc|ccc}
        \toprule
        \multirow{2}{*}{Method} & \multicolumn{3}{c|}{ZJU-MoCap~\cite{peng2021neural}} & \multicolumn{3}{c}{OcMotion~\cite{h}} \\
        \cline{2-7}
         & PSNR$\uparrow$ & SSIM$\uparrow$ & LPIPS*$\downarrow$ & PSNR$\uparrow$ & SSIM$\uparrow$ & LPIPS*$\downarrow$ \\
        \midrule
        HumanNeRF~\cite{weng2022humannerf}       & 20.67 & 0.9509 & --    & 9.79  & 0.7203 & 189.1 \\
        GauHuman~\cite{hu2024gauhuman}         & 21.55 & 0.9430 & 55.88 & 15.09 & 0.8525 & 107.1 \\
        \midrule
        OccNeRF~\cite{xiang2023rendering}           & 22.40 & 0.9562 & 43.01 & 15.71 & 0.8230 & 82.90 \\
        OccFusion~\cite{sun2024occfusion}       & \underline{23.96} & \underline{0.9548} & \underline{32.34} & \underline{18.28} & \underline{0.8805} & \underline{82.42} \\
        \midrule
        InpaintHuman (Ours)              & \textbf{24.65} & \textbf{0.9614} & \textbf{31.63} & \textbf{19.02} & \textbf{0.8946} & \textbf{81.98} \\
        \bottomrule
    \end{tabular}
    \caption{The \textbf{best} and \underline{second-best} results are highlighted.}
\end{table*}
"""  # noqa: E501


def test_it_is_found_in_latex_as_the_paper_writes_it(tmp_path):
    (finding,) = findings(PAPER, "tex", tmp_path)
    assert str(finding) == (
        "12: OccFusion, ZJU-MoCap SSIM↑: wrong second-best mark: 0.9548 is 3rd of 5; "
        "expected the mark on OccNeRF (0.9562)"
    )


# --------------------------------------------------------------------------------------------------- what is right


def random_runs(seed):
    """Methods over scenes with ties, absent metrics, failed runs and scenes that only some have."""
    chance = random.Random(seed)
    found = []
    for method in ("one", "two", "three", "four"):
        level, absent = chance.choice([20.0, 21.0, 24.0]), chance.random() < 0.2
        for scene in SUBJECTS[: chance.choice([1, 3, 4])]:
            noise = chance.choice([0.0, 0.5]) * chance.gauss(0, 1)
            psnr = math.nan if absent else level + 5 * SUBJECTS.index(scene) + noise
            lpips = chance.choice([math.nan, chance.uniform(0.02, 0.2)])
            kind = {"standin": chance.choice(["", "stand-in v1 seed 0"])}
            found.append(fake_run(scene, method, psnr, chance.uniform(0.9, 1.0), lpips, said=kind))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_tables_of_ours_are_clean(seed, tmp_path):
    frame = build_frame(paper_table("table1"), random_runs(seed))
    assert len(frame.blocks) > 1
    for ending in ("md", "tex"):
        assert findings(write(frame.blocks, ending), ending, tmp_path) == []


def test_a_table_that_is_right_is_clean(tmp_path):
    assert lines_of(ROWS, tmp_path) == []


def test_a_table_without_marks_claims_nothing(tmp_path):
    assert lines_of([[word.lstrip("!_") for word in row] for row in ROWS], tmp_path) == []


def test_columns_that_nobody_knows_are_left_alone(tmp_path):
    assert lines_of([["A", "!1"], ["B", "2"], ["C", "3.55"]], tmp_path, ["Method", "scenes"]) == []


def test_rows_that_only_bound_the_others_are_not_ranked(tmp_path):
    bounds = [["truth", "99.00", "0.0", "99.00", "0"], ["GT pose", "98.00", "0.1", "98.00", "0"]]
    assert lines_of([*ROWS, *bounds], tmp_path) == []


def test_sections_may_be_ranked_apart(tmp_path):
    rows = [["A", "!2.0"], ["B", "1.0"]]
    text = text_of(rows, "tex", ["Method", "PSNR ↑"]).replace(
        r"\end{tabular}", "\\midrule\nC & 9.0 \\\\\nD & \\textbf{9.5} \\\\\n\\end{tabular}"
    )
    assert findings(text, "tex", tmp_path) == []
    # but a section of one row, or one without a mark, is no section
    for dropped in ("D & \\textbf{9.5} \\\\\n", "\\textbf{9.5}"):
        kept = "" if dropped.startswith("D") else "9.5"
        (finding,) = findings(text.replace(dropped, kept), "tex", tmp_path)
        assert finding.what.startswith("wrong best mark")


# ------------------------------------------------------------------------------------------------- planted faults


@pytest.mark.parametrize(
    ("row", "column", "word", "told"),
    [
        (3, 1, "!21.55", "Four, A PSNR ↑: wrong best mark: 21.55 is 3rd of 4; expected the mark on Three (23.96)"),
        (3, 1, "_21.55",
         "Four, A PSNR ↑: wrong second-best mark: 21.55 is 3rd of 4; expected the mark on Two (22.40)"),
        (2, 1, "23.96", "Three, A PSNR ↑: missing best mark; expected 23.96 marked as best"),
        (2, 2, "42.3", "Three, A LPIPS* ↓: missing second-best mark; expected 42.3 marked as second-best"),
        (0, 1, "23.96", "One, A PSNR ↑: tie: 23.96 equals the marked Three; expected the best mark here too"),
        (0, 2, "0.0632",
         "One, A LPIPS* ↓: mixed units: 0.0632 does not fit the rest of the column; expected 1000 times it"),
        (0, 1, "20.10%", "One, A PSNR ↑: mixed units: 20.10 in %; expected without a unit, as most of the column"),
        (0, 1, "20.1", "One, A PSNR ↑: inconsistent decimals: 20.1 has 1; expected 2, as most of the column"),
    ],
)  # fmt: skip
def test_a_planted_fault_in_a_cell_is_the_only_finding(row, column, word, told, tmp_path):
    found = lines_of(changed(row, column, word), tmp_path)
    if word == "23.96":  # two best ones leave no second-best: its mark is no fault
        assert found == [told]
    else:
        assert told in found
        assert len(found) == 1


def test_swapped_marks_are_two_findings(tmp_path):
    rows = changed(1, 1, "!22.40", changed(2, 1, "_23.96"))
    assert lines_of(rows, tmp_path) == [
        "Three, A PSNR ↑: wrong second-best mark: 23.96 is 1st of 4; expected the mark on Two (22.40)",
        "Two, A PSNR ↑: wrong best mark: 22.40 is 2nd of 4; expected the mark on Three (23.96)",
    ]


@pytest.mark.parametrize(
    ("column", "word", "told"),
    [
        (1, "A PSNR", "column A PSNR: missing arrow; expected ↑ beside PSNR: higher is better"),
        (2, "A LPIPS* ↑", "column A LPIPS* ↑: wrong arrow ↑; expected ↓: of LPIPS lower is better"),
    ],
)
def test_arrows(column, word, told, tmp_path):
    head = [*HEAD[:column], word, *HEAD[column + 1 :]]
    assert lines_of(ROWS, tmp_path, head) == [told]


def test_one_metric_in_two_columns_must_be_one_quantity(tmp_path):
    head = ["Method", "A LPIPS ↓", "B LPIPS ↓"]
    rows = [["One", "0.0632", "41.2"], ["Two", "0.0512", "40.1"]]
    (line,) = lines_of(rows, tmp_path, head)
    assert line.startswith("column B LPIPS ↓: mixed units: LPIPS around 40.65 here and around 0.0572 in A LPIPS ↓")
    (line,) = lines_of(
        [["One", "63.2", "41.2"], ["Two", "51.2", "40.1"]], tmp_path, ["Method", "A LPIPS* ↓", "B LPIPS ↓"]
    )
    assert "headed as plain here and as scaled in A LPIPS* ↓" in line
    (line,) = lines_of([["One", "1", "2"], ["Two", "3", "4"]], tmp_path, ["Method", "A time (s)", "B time (min)"])
    assert "TIME in min here and in s" in line


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("!24.31 ± 0.05", "24.27 ± 0.05", True),
        ("!24.31 ± 0.01", "24.27 ± 0.01", False),
        ("!24.31 ± 0.05", "!24.27 ± 0.05", False),  # both marked: no claim of one over the other
        ("24.31 ± 0.05", "24.27 ± 0.05", False),  # no claim
        ("!24.31 [24.10, 24.50]", "24.27 [24.10, 24.40]", True),
        ("!24.31", "24.27", False),  # nothing is known of the noise
    ],
)
def test_claims_within_noise(first, second, told, tmp_path):
    rows = [["One", first], ["Two", second], ["Three", "20.00 ± 0.05"]]
    found = [line for line in lines_of(rows, tmp_path, ["Method", "PSNR ↑"]) if "noise" in line]
    assert bool(found) == told
    if told:
        assert found[0].startswith("One, PSNR ↑: claim within noise: best mark, but Two (24.27) is not further away")
        assert lines_of(rows, tmp_path, ["Method", "PSNR ↑"], before="ihbench lint: paired") == []


@pytest.mark.parametrize(
    ("first", "second", "third", "finding"),
    [
        ("!24.80 ± 0.30", "!24.65 ± 0.30", "22.10 ± 0.30", ""),  # as the linter itself advises
        ("!24.80 ± 0.30", "!24.65 ± 0.30", "_22.10 ± 0.30", ""),
        ("24.80 ± 0.30", "24.65 ± 0.30", "22.10 ± 0.30", ""),  # no claim at all
        ("!24.80 ± 0.30", "!22.10 ± 0.30", "_22.00 ± 0.01", "Two, PSNR ↑: wrong best mark"),
        ("!24.80 ± 0.01", "24.60 ± 0.01", "_22.10 ± 0.01", "Three, PSNR ↑: wrong second-best mark"),
    ],
)
def test_rows_within_noise_may_share_the_best_mark(first, second, third, finding, tmp_path):
    rows = [["One", first], ["Two", second], ["Three", third], ["Four", "20.00 ± 0.01"]]
    lines = lines_of(rows, tmp_path, ["Method", "PSNR ↑"])
    assert bool(lines) == bool(finding)
    assert not finding or any(line.startswith(finding) for line in lines)


def test_a_statement_that_marks_are_paired_excuses_no_wrong_one(tmp_path):
    rows = [["One", "!20.0 ± 0.5"], ["Two", "24.2 ± 0.5"], ["Three", "18.0 ± 0.5"]]
    (line,) = lines_of(rows, tmp_path, ["Method", "PSNR ↑"], before="ihbench lint: paired")
    assert line.startswith("One, PSNR ↑: wrong best mark: 20.0 is 2nd of 3")


@pytest.mark.parametrize("seed", range(8))
def test_every_wrong_mark_in_a_random_table_is_found(seed, tmp_path):
    """A table with distinct numbers and one column marked rightly; marks of another are moved: the linter says to
    whom they belong."""
    chance = random.Random(seed)
    values = chance.sample(range(1000, 4000), 6)
    order = sorted(range(6), key=lambda k: -values[k])
    wrong = chance.choice([k for k in range(6) if k != order[0]])
    rows = []
    for k, value in enumerate(values):
        good = "!" if k == order[0] else "_" if k == order[1] else ""
        rows.append([f"m{k}", f"{good}{value / 100:.2f}", f"{'!' if k == wrong else ''}{value / 100:.2f}"])
    found = [
        line for line in lines_of(rows, tmp_path, ["Method", "A PSNR ↑", "B PSNR ↑"]) if "missing second" not in line
    ]
    assert found == [
        f"m{wrong}, B PSNR ↑: wrong best mark: {values[wrong] / 100:.2f} is "
        f"{['1st', '2nd', '3rd', '4th', '5th', '6th'][order.index(wrong)]} of 6; "
        f"expected the mark on m{order[0]} ({values[order[0]] / 100:.2f})"
    ]
