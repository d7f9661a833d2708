"""Weight files: found, checked by their hash, fetched whole or not at all; LPIPS through the real loading door."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ihbench.cli import main
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.metrics import evaluate, lpips, weights
from ihbench.metrics.oracles.cases import person_case
from ihbench.metrics.oracles.check import package_distance

SQUEEZE = "lpips-squeeze"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty weights folder; nobody's cache is looked at."""
    monkeypatch.setenv("IHBENCH_WEIGHTS", str(tmp_path / "w"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(lpips, "_loaded", {})
    (tmp_path / "w").mkdir()
    return tmp_path / "w"


def known(monkeypatch, path: Path, url: str = "") -> weights.WeightFile:
    """Make the bytes of a file those that squeeze's weights should have."""
    entry = weights.FILES[SQUEEZE]
    entry = replace(entry, sha256=hashlib.sha256(path.read_bytes()).hexdigest(), url=url or entry.url)
    monkeypatch.setitem(weights.FILES, SQUEEZE, entry)
    return entry


def trunk(path: Path) -> dict:
    """A seeded random SqueezeNet saved as torchvision saves one."""
    from torchvision.models import squeezenet1_1

    torch.manual_seed(3)
    state = squeezenet1_1(weights=None).state_dict()
    torch.save(state, path)
    return state


def test_what_is_missing_is_said_in_a_line_that_helps(folder):
    reason = weights.locate(weights.FILES["lpips-vgg"])
    assert "\n" not in reason
    for word in ("vgg16-397923af.pth", str(folder), "ihbench weights fetch lpips-vgg"):
        assert word in reason
    with pytest.raises(BadInput, match="weights fetch lpips-vgg"):
        lpips.lpips(np.zeros((64, 64, 3)), np.ones((64, 64, 3)))
    case = person_case()
    scores = evaluate(case.pred, case.truth, {"full": None})
    absent = [score for score in scores.values() if score.absent]
    assert [score.identity for score in absent] == ["lpips/vgg-0.1/[-1,1]/full/v1"]
    assert absent[0].reason == reason


def test_the_real_door_gives_the_packages_numbers(folder, monkeypatch):
    state = trunk(folder / weights.FILES[SQUEEZE].file)
    known(monkeypatch, folder / weights.FILES[SQUEEZE].file)
    case = person_case(96, 80)
    ours = lpips.lpips(case.pred, case.truth, net="squeeze")
    with lpips.random_networks() as networks:
        package = networks["squeeze"].package
        names = {name: "features." + name.split(".", 1)[1] for name in package.net.state_dict()}
        package.net.load_state_dict({name: state[source] for name, source in names.items()})
        theirs = package_distance(package, "[-1,1]", case.pred, case.truth)
    assert ours == pytest.approx(theirs, rel=1e-5)
    assert ours > 0


def test_a_wrong_hash_is_never_used(folder):
    path = folder / weights.FILES[SQUEEZE].file
    trunk(path)
    assert "damaged or another file" in lpips.load("squeeze")
    path.write_bytes(path.read_bytes()[:1000])
    assert "damaged or another file" in lpips.load("squeeze")
    assert weights.states([SQUEEZE])[0]["state"] == "damaged"


class Attack:
    def __reduce__(self):
        return (Path.write_text, (Path("pwned"), "x"))


@pytest.mark.parametrize(
    "content", [{"features.0.weight": torch.zeros(2)}, {"a": Attack()}, [1, 2]], ids=["tensors", "attack", "list"]
)
def test_another_architecture_or_a_pickle_that_would_run_code_is_refused(folder, monkeypatch, content, tmp_path):
    monkeypatch.chdir(tmp_path)
    path = folder / weights.FILES[SQUEEZE].file
    torch.save(content, path)
    known(monkeypatch, path)
    assert "not the weights of torchvision" in lpips.load("squeeze")
    assert not (tmp_path / "pwned").exists()


def test_fetch_brings_the_whole_file_or_nothing(folder, monkeypatch, tmp_path):
    source = tmp_path / "source.pth"
    source.write_bytes(b"weights" * 1000)
    entry = known(monkeypatch, source, source.as_uri())
    path = weights.fetch(entry, Progress.silent())
    assert path.read_bytes() == source.read_bytes()
    assert weights.fetch(replace(entry, url="file:///nowhere"), Progress.silent()) == path  # is here already
    path.unlink()
    source.write_bytes(b"something else")
    with pytest.raises(BadInput, match="its hash differs"):
        weights.fetch(entry, Progress.silent())
    with pytest.raises(BadInput, match=r"could not be fetched.*elsewhere and put it into"):
        weights.fetch(replace(entry, url=(tmp_path / "none").as_uri()), Progress.silent())
    assert list(folder.iterdir()) == []


def test_fetch_replaces_no_other_file_of_that_name(folder, monkeypatch, tmp_path):
    source = tmp_path / "source.pth"
    source.write_bytes(b"weights" * 1000)
    entry = known(monkeypatch, source, source.as_uri())
    (folder / entry.file).write_bytes(b"tuned on my own data")
    with pytest.raises(BadInput, match="move it away, then fetch again"):
        weights.fetch(entry, Progress.silent())
    assert (folder / entry.file).read_bytes() == b"tuned on my own data"
    (folder / entry.file).unlink()
    (folder / entry.file).symlink_to(tmp_path / "store" / "weights.pth")  # a shared store, empty yet
    assert weights.fetch(entry, Progress.silent()).is_symlink()
    assert (tmp_path / "store" / "weights.pth").read_bytes() == source.read_bytes()


def test_a_file_that_may_not_be_read_is_named_not_raised(folder, monkeypatch):
    (folder / weights.FILES[SQUEEZE].file).write_bytes(b"x")
    opened = open

    def denied(path, *rest, **more):
        if Path(path).parent == folder:
            raise PermissionError(13, "Permission denied")
        return opened(path, *rest, **more)

    monkeypatch.setattr("builtins.open", denied)
    assert weights.states([SQUEEZE])[0]["state"] == "damaged"


@pytest.fixture
def homeless(monkeypatch):
    """A user that the system knows neither a name nor a home of, as containers have them."""
    import pwd

    for variable in ("HOME", "IHBENCH_CACHE", "IHBENCH_WEIGHTS", "TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)

    def unknown(number):
        raise KeyError(number)

    monkeypatch.setattr(pwd, "getpwuid", unknown)


def test_without_a_home_a_reason_is_given_and_no_run_fails_for_it(homeless, monkeypatch, tmp_path, capsys):
    reason = weights.locate(weights.FILES[SQUEEZE])
    assert isinstance(reason, str)
    assert "name a folder for them with IHBENCH_WEIGHTS" in reason
    monkeypatch.setattr(lpips, "_loaded", {})
    case = person_case()
    (score,) = (score for score in evaluate(case.pred, case.truth, {"full": None}).values() if score.absent)
    assert "IHBENCH_WEIGHTS" in score.reason
    assert main(["weights", "list"]) == 2
    assert main(["run", "--protocol", "zju_occ", "--runs", str(tmp_path / "runs")]) == 2
    assert "IHBENCH_CACHE" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
    monkeypatch.setenv("IHBENCH_WEIGHTS", str(tmp_path))
    assert weights.folders() == [tmp_path]


def test_a_cache_that_may_not_be_written_is_named_with_its_variable(monkeypatch, capsys):
    monkeypatch.setenv("IHBENCH_CACHE", "/proc/nope")
    assert main(["run", "--protocol", "people_snapshot", "--scene", "standin-1"]) == 2
    assert "choose another folder (--out, IHBENCH_CACHE)" in capsys.readouterr().err


def test_the_commands(folder, capsys):
    assert main(["weights", "list", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {row["name"]: row["state"] for row in told["weights"]} == dict.fromkeys(weights.FILES, "missing")
    assert main(["weights", "where"]) == 0
    assert str(folder) in capsys.readouterr().out
    (folder / weights.FILES[SQUEEZE].file).write_bytes(b"x")
    assert main(["weights", "list"]) == 1
    assert "damaged" in capsys.readouterr().out
    assert main(["weights", "fetch", "lpips-vg"]) == 2
    assert "lpips-vgg" in capsys.readouterr().err


def test_listing_imports_neither_torch_nor_lpips():
    code = (
        "import sys; from ihbench.cli import main; main(['weights', 'list'])\n"
        "assert not {'torch', 'lpips', 'torchvision'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


# ------------------------------------------------------------------------------------------------------- LPIPS


@pytest.fixture(scope="module")
def random_trunks():
    with lpips.random_networks() as networks:
        yield networks


@pytest.mark.parametrize("net", lpips.NETS)
def test_tiles_give_the_whole_frames_number(net, random_trunks, monkeypatch):
    case = person_case(330, 203)
    whole = lpips.lpips(case.pred, case.truth, net=net)
    monkeypatch.setattr(lpips, "TILE", 64)
    assert lpips.lpips(case.pred, case.truth, net=net) == pytest.approx(whole, rel=1e-6)


@pytest.mark.parametrize("rubbish", [np.nan, np.inf, 1e30])
def test_nothing_outside_the_mask_leaks_into_lpips(rubbish, random_trunks):
    case = person_case(96, 80)
    mask, box = case.regions["body"], case.regions["box"]
    value = lpips.lpips(case.pred, case.truth, mask, net="alex", crop=box)
    pred, truth = case.pred.copy(), case.truth.copy()
    pred[~mask] = truth[~mask] = rubbish
    assert lpips.lpips(pred, truth, mask, net="alex", crop=box) == value > 0


def test_edges_of_lpips(random_trunks):
    image = person_case(70, 66).truth
    assert lpips.lpips(image, image.copy(), net="alex") == 0.0
    assert np.isnan(lpips.lpips(image, image, np.zeros((70, 66), bool), net="alex"))
    assert np.isnan(lpips.lpips(np.full_like(image, np.nan), image, net="alex"))
    for shape in ((1, 1, 3), (1, 1), (70, 3, 3)):
        assert np.isfinite(lpips.lpips(np.zeros(shape), np.ones(shape), net="alex"))
    assert np.isfinite(lpips.lpips(np.zeros((64, 64, 3)), np.full((64, 64, 3), 1e-3), net="vgg"))
    with pytest.raises(ValueError, match="net in"):
        lpips.lpips(image, image, net="resnet")
