"""What pages and reports say of runs names no place of a machine, wherever it stood in the record."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from ihbench import registry
from ihbench.record.results import read_result
from ihbench.record.row_labels import by_label
from ihbench.record.schema import PredictionFiles
from ihbench.record.shareable import shareable, without_places
from ihbench.reports.site import build
from ihbench.scene.plan import Omission
from tests.reports.fake_runs import LPIPS, SSIM, fake_run, write_run

RUN = Path("/tmp/r/zju_occ@1__a__ours__d1")
HERE = "/home/jane"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{HERE}/zju/CoreView_377/annots.npy: missing key 'cams'", "…/annots.npy: missing key 'cams'"),
        ("No such file: '/home/Jane Doe/x y/a.npz'", "No such file: '…/a.npz'"),
        ("/home/Jane Doe/data/x.npy: is gone", "…/x.npy: is gone"),
        (f"compare {HERE}/a with {HERE}/b", "compare …/a with …/b"),
        (f"--data={HERE}/zju", "--data=…/zju"),
        (f"file://{HERE}/x.npy", "…/x.npy"),
        ("C:\\Users\\jane\\x.npy: is bad", "…/x.npy: is bad"),
        ("\\\\server\\share\\x.npy", "…/x.npy"),
        ("/data: no such folder", "…/data: no such folder"),
        # inside the run folder, where it lies and where it lay
        (f"see {RUN}/traceback.txt", "see traceback.txt"),
        (f"/else/{RUN.name}/checkpoints/a.pt: is cut off", "checkpoints/a.pt: is cut off"),
        (f"{RUN}: is damaged", f"{RUN.name}: is damaged"),
        (
            f"{HERE}/runs/zju_occ@1__a__b__quick__s0__4e0f/scores.jsonl: x",
            "…/zju_occ@1__a__b__quick__s0__4e0f/scores.jsonl: x",
        ),
    ],
)
def test_paths_are_cut_down_to_their_names(text, expected):
    assert without_places(text, RUN) == expected
    assert without_places(expected, RUN) == expected


@pytest.mark.parametrize(
    "text",
    ["m/s, and/or 3/4 of 7 /s", "https://example.org/a/b.html", "psnr/pooled/range1/hidden/v1", "a / b",
     "../x/y, ./a, ~/z", "<b>x</b></script>", "5 of 12: fine", "stage1/step: 3"],
)  # fmt: skip
def test_what_is_no_absolute_path_stays(text):
    assert without_places(text, RUN) == text


def test_a_run_folder_named_from_here():
    folder = Path("runs/zju_occ@1__a__ours__d1")
    assert without_places(f"{folder}/avatar: cannot be read: {folder}/avatar/a.json", folder) == (
        "avatar: cannot be read: avatar/a.json"
    )


def told_everywhere(said: str):
    """A run whose record names a place wherever it has words of its own."""
    files = PredictionFiles((said,), (said,), (said,), (said,), said)
    run = fake_run(
        said={
            "command": ("run", "--data", said), "changed": {"weights": said}, "predictions": files,
            "left_out": (Omission("inpaint", said, said),),
        },
        who={"config": {"weights": said, "more": [{"of": said}]}},
    )  # fmt: skip
    record = replace(run.record, outcome=replace(run.record.outcome, reason=said), warnings=(said,))
    rows = {run.method: {i: replace(mean, reason=said) for i, mean in run.own.items()}}
    return replace(run, record=record, rows=rows, presets={"p": rows}, damage=(said,))


def test_every_text_of_a_record():
    run = told_everywhere(f"{HERE}/data/x.npy: is gone")
    (shown,) = shareable([run])
    assert run.reason.startswith(HERE)  # the record itself knows
    own = replace(shown, record=replace(shown.record, identity=replace(shown.identity, config={})))
    assert HERE not in repr(own)
    assert "…/x.npy" in repr(own)
    assert (shown.own.keys(), shown.about.fit_seconds) == (run.own.keys(), run.about.fit_seconds)


def test_switches_that_differ_name_different_rows():
    runs = [fake_run(said={"changed": {"weights": f"{HERE}/{k}/sd2", "steps": 7}}) for k in "abb"]
    assert {label: len(row) for label, row in by_label(shareable(runs)).items()} == {
        "ours (weights=…/sd2, steps=7)": 1,
        "ours (weights=…/sd2 (2), steps=7)": 2,
    }


@pytest.fixture
def folders(tmp_path):
    """A finished run and a failed one, with places in every file that a page reads."""
    said = f"{HERE}/data/x.npy: is gone"
    done = write_run(tmp_path / "runs", "a", "mine", 20.0, 0.9, config={"weights": said})
    failed = write_run(tmp_path / "runs", "b", "mine", 20.0, 0.9)
    for folder, status in ((done, "done"), (failed, "failed")):
        record = json.loads((folder / "run.json").read_text())
        record["outcome"] |= {
            "status": status,
            "reason": "" if status == "done" else f"BadInput: {said} (see {folder}/x)",
        }
        record["warnings"] = [said]
        event = {"kind": "left_out", "data": {"what": "a term", "reason": f"in its fit, {said}"}}
        record["ledger"] = {"stages": {}, "seconds": 1.0, "cpu_seconds": 1.0, "events": [event]}
        record["about"] |= {"command": ["run", "--data", HERE], "changed": {"weights": said}}
        (folder / "run.json").write_text(json.dumps(record))
        lines = [json.loads(line) for line in (folder / "scores.jsonl").read_text().splitlines()]
        for line in lines:
            line["scores"][SSIM.format("body")] = "nan"
            line["absent"] = {LPIPS.format("body"): said, SSIM.format("body"): said}
        (folder / "scores.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return [done, failed]


def test_no_page_and_no_report_names_a_place(folders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = [read_result(folder) for folder in folders]
    left_out = [f"{tmp_path}/runs/other: run.json is cut off"]
    texts = {"site": build.build(results, left_out).html(single=True)}
    for form in ("md", "tex", "html"):
        texts[form] = registry.load("report", form)(results, folder=tmp_path, left_out=left_out)
    for name, text in texts.items():
        assert HERE not in text, name
        assert str(tmp_path) not in text, name
        assert "x.npy" in text, name
        assert "is cut off" in text, name
        assert "in its fit" in text, name
