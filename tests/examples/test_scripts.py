"""Every numbered script runs as it stands, in an empty folder, and leaves what it says."""

import os
import runpy
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
import trimesh
from PIL import Image

HERE = Path(__file__).parent


@pytest.fixture
def script(bench, tmp_path, monkeypatch, capsys):
    """Run one in a folder of its own: what it prints."""

    def run(name, *words):
        (tmp_path / "here").mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / "here")
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        with bench.in_its_world():
            runpy.run_path(str(HERE / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_all_of_them_are_run_here():
    tested = Path(__file__).read_text(encoding="utf-8")
    names = sorted(path.name for path in HERE.glob("0*.py"))
    assert len(names) == 6
    assert [name for name in names if tested.count(f'"{name}"') != 1] == []


def test_two_images(script, tmp_path):
    out = script("01_score_two_images.py")
    assert "PSNR of the whole image: " in out
    values = dict(line.split(maxsplit=1) for line in out.splitlines()[1:])
    full, body = (float(values[f"psnr/pooled/range1/{region}/v1"]) for region in ("full", "body"))
    assert 25 < body < full < 40  # the noise of 0.05 is clipped where it is white


def test_own_method(script, bench):
    out = script("02_own_method.py", bench.protocol)
    rows = {line.split()[0]: line for line in out.splitlines()}
    assert {"mean-colour", "truth", "mean-colour-body"} <= set(rows)
    own, bound = (float(rows[name].split("PSNR ")[1].split(",")[0]) for name in ("mean-colour", "mean-colour-body"))
    assert abs(own - bound) < 0.6  # the calibration row does the same, with smooth edges


def test_own_protocol(script):
    lines = script("03_own_protocol.py").splitlines()
    assert lines[0].split()[2] != lines[1].split()[2]
    assert "lower-half" in lines[1]
    assert lines[2].startswith("5 training views")
    assert 20 < float(lines[2].split(": ")[1].rstrip("%")) < 60


def test_own_video(script):
    out = script("04_own_video.py")
    assert "5 training and 5 test views" in out
    assert list(Path("data_check").rglob("*.png"))


def test_sweep(script, bench):
    out = script("05_sweep_and_dataframe.py", bench.protocol)
    assert out.count(": done in ") == 2
    table = pandas.read_csv(pandas.io.common.StringIO(out[out.index("region") :]), sep=r"\s+", skiprows=[1])
    assert table["body"].iloc[1] > table["body"].iloc[0]  # more steps, more decibels


def test_render_and_export(script, finished):
    script("06_render_and_export.py", finished.folder)
    assert Image.open("turntable.webp").n_frames == 12
    assert Image.open("march.gif").n_frames > 6
    assert len(trimesh.load("avatar.glb").geometry) == 1
    assert os.path.getsize("avatar.ply") > 10_000
    assert np.load("march.npz")["poses"].shape == (12, 156)
