"""What a notebook shows of runs: the headline, the contact sheet, the means; no more than it should."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pandas
import pytest
from PIL import Image

import ihbench
from ihbench.record.notebook import means_of
from ihbench.record.results import read_result
from tests.reports.fake_runs import fake_run


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.opened, self.closed, self.words = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.opened.append(tag)

    def handle_endtag(self, tag):
        self.closed.append(tag)

    def handle_data(self, data):
        self.words += data.split()


def whole(text):
    """The parsed page, if every tag that is opened is closed."""
    tags = Tags(text)
    assert sorted(t for t in tags.opened if t not in ("img", "br")) == sorted(tags.closed)
    return tags


def test_a_run_shows_its_headline_and_its_contact_sheet(finished):
    run = read_result(finished.folder)
    text = run._repr_html_()
    tags = whole(text)
    (psnr,) = [mean.value for i, mean in run.own.items() if (i.metric, i.region) == ("psnr", run.headline)]
    assert f"{psnr:.2f}" in tags.words
    assert {"inpainthuman", "nearest-frame", "standin-1,"} <= set(tags.words)
    (data,) = re.findall(r"data:image/jpeg;base64,([^\"]+)", text)
    shown, sheet = Image.open(io.BytesIO(base64.b64decode(data))), Image.open(finished.folder / "contact_sheet.png")
    assert shown.width == min(900, sheet.width)
    small = np.asarray(sheet.convert("RGB").resize(shown.size), int)
    assert np.abs(np.asarray(shown, int) - small).mean() < 12


def test_a_run_that_failed_says_so_and_escapes_what_it_quotes():
    run = fake_run(scene="<b>x", status="failed", reason="a <script> & a leg")
    text = run._repr_html_()
    whole(text)
    assert "failed: a &lt;script&gt; &amp; a leg" in text
    assert "<b>" not in text
    assert "script>" not in text


def test_without_a_contact_sheet_there_is_none():
    text = fake_run(psnr=23.456)._repr_html_()
    assert "23.46" in whole(text).words
    assert "img" not in whole(text).opened


def test_the_frame_shows_means_first_and_its_parts_are_ordinary(finished):
    table = ihbench.frame([finished.folder])
    assert isinstance(table, pandas.DataFrame)
    text = table._repr_html_()
    tags = whole(text)
    assert f"{len(table)} lines of 1 run" in text
    own = read_result(finished.folder).own
    for i, mean in own.items():
        if np.isfinite(mean.value):
            assert f"{mean.value:.4g}" in tags.words, i
    assert str(finished.folder) not in text  # long, and the same in every line
    part = table[table["metric"] == "psnr"]
    assert type(part) is pandas.DataFrame
    assert "lines of" not in part._repr_html_()
    assert table.attrs["left_out"] == []


def test_means_are_over_views_then_over_runs():
    lines = [("a", 1.0), ("a", 3.0), ("b", 10.0)]
    table = pandas.DataFrame(
        [
            {"row": "ours", "metric": "psnr", "region": "body", "identity": "psnr/x/body", "digest": d, "value": v}
            for d, v in lines
        ]
    )
    assert means_of(table).loc["ours", ("psnr", "body")] == pytest.approx(6)  # (2 + 10) / 2
    other = table.assign(identity="psnr/y/body", value=table["value"] + 1)
    both = means_of(pandas.concat([table, other]))
    assert both.loc["ours", ("psnr/y/body", "body")] == pytest.approx(7)
