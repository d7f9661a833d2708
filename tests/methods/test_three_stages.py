"""InpaintHuman whole: fit, paint, refine; with either backbone, switched off, killed and resumed."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.mini.weights import save_mini
from ihbench.diffusion.personalise import ADAPT_STATE, TI_STATE
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.config import QUICK, InpaintHumanConfig, outside_files
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.methods.inpainthuman.stages.stage1 import Stage1
from ihbench.runner.run_loop import RunRequest, _outside
from ihbench.scene.protocol import load_protocol
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view
from tests.diffusion.sd2_miniature import make_miniature
from tests.diffusion.tiny_diffusion import tiny_backbone
from tests.methods.tiny_fit import SIZE, TINY, equal_bits, parameters_of, training_set

QUIET = Progress.silent()


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mini")
    save_mini(tiny_backbone(), folder)
    return folder


def config(weights, **inpaint) -> InpaintHumanConfig:
    small = dict(ti_steps=3, lora_steps=3, batch=2, sampler_steps=2, key_views=2)
    stage2 = replace(QUICK.inpaint, weights=str(weights), **small | inpaint)
    return replace(TINY, inpaint=stage2, refine=replace(QUICK.refine, steps=4, lpips=0.0))


def hidden_person():
    """A strip that never moves, before a person who turns a little."""
    views = [train_view(a_camera(0.0, SIZE), a_pose(0.1 * k, 0.1 * k), slice(28, 36), frame=k) for k in range(4)]
    return training_set(views)


def fit(config, ledger=None, seed=0):
    return InpaintHuman(config).fit(
        hidden_person(), device="cpu", seed=seed, ledger=ledger or Ledger(), progress=QUIET
    )


def test_off_is_stage_1_exactly(mini):
    ledger = Ledger()
    off = fit(replace(TINY), ledger)
    assert set(ledger.state().stages) == {"fit", "fit/prepare", "fit/stage1", "checkpoint"}
    on = fit(config(mini))
    assert not equal_bits(parameters_of(on), parameters_of(off))
    unrefined = fit(replace(config(mini), refine=replace(QUICK.refine, steps=0)))
    assert equal_bits(parameters_of(unrefined), parameters_of(off))


def test_all_three_stages_are_in_the_ledger_and_repeat_bit_for_bit(mini):
    ledger = Ledger()
    first = fit(config(mini), ledger)
    stages = set(ledger.state().stages)
    inside = ("look", "load", "textual-inversion", "adapt", "inpaint", "silhouette", "measure")
    assert {f"fit/stage2/{name}" for name in inside} | {"fit/stage3"} <= stages
    kinds = [event.kind for event in ledger.events]
    assert "inpainted" in kinds
    curves = {event.data["stage"] for event in ledger.events if event.kind == "loss_curve"}
    assert curves == {TI_STATE, ADAPT_STATE}
    assert equal_bits(parameters_of(first), parameters_of(fit(config(mini))))
    assert not equal_bits(parameters_of(first), parameters_of(fit(config(mini), seed=1)))


def test_always_personalises_for_a_person_whom_nothing_hides(mini):
    """What `ihbench ablate --ladder plan` compares with; the avatar is the same without it."""
    views = [train_view(a_camera(0.0, SIZE), a_pose(0.1 * k, 0.1 * k), slice(0, 0), frame=k) for k in range(4)]
    learned = {"fit/stage2/textual-inversion", "fit/stage2/adapt"}
    avatars = []
    for always in (False, True):
        ledger, method = Ledger(), InpaintHuman(config(mini, always=always))
        avatars.append(method.fit(training_set(views), device="cpu", seed=0, ledger=ledger, progress=QUIET))
        done = set(ledger.state().stages)
        assert learned & done == (learned if always else set())
        assert "fit/stage2/inpaint" not in done
        assert "fit/stage3" in done
    assert equal_bits(*(parameters_of(avatar) for avatar in avatars))


def test_one_fit_is_stage_1_with_ssim_and_more_steps(mini):
    ledger = Ledger()
    given = replace(config(mini), one_fit=True, steps=20)
    unfitted = GaussianAvatar(given, the_body(), np.zeros(10), 0)
    assert Stage1(unfitted, hidden_person(), 0, Ledger()).steps == given.fit_steps == 24
    fit(given, ledger)
    assert set(ledger.state().stages) == {"fit", "fit/prepare", "fit/stage1", "checkpoint"}
    assert outside_files(given) == []


@pytest.mark.parametrize("filler", ["mean", "telea", "navier-stokes", "push-pull", "mirror", "temporal"])
def test_every_simple_filler_runs_without_diffusers(filler, monkeypatch):
    from ihbench.methods.inpainthuman.stages.stage2 import Stage2

    painters = []
    honest = Stage2._inpainter
    monkeypatch.setattr(Stage2, "_inpainter", lambda self: painters.append(honest(self)) or painters[-1])
    fit(config("", filler=filler))
    assert [painter[0].name for painter in painters] == [filler]


WHAT_IS_IMPORTED = """
import sys
from dataclasses import replace
from ihbench.clock.ledger import Ledger
from ihbench.methods.inpainthuman.config import QUICK
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.methods.inpainthuman.stages.stage1 import Stage1
from ihbench.clock.progress import Progress
from tests.bench.fake_capture import a_camera, a_pose, train_view
from tests.methods.tiny_fit import SIZE, TINY, training_set

def told(when):
    modules = ("ihbench.methods.inpainthuman.stages.stage2", "diffusers", "transformers")
    print(when, *(name.rpartition(".")[2] for name in modules if name in sys.modules))

honest = Stage1.run
Stage1.run = lambda *a: (honest(*a), told("fitted"))
views = [train_view(a_camera(0.0, SIZE), a_pose(0.1 * k, 0.1 * k), slice(28, 36), frame=k) for k in range(2)]
for word in sys.argv[1:]:  # each may import more than those before it
    one_fit = word == "one fit"
    inpaint = replace(InpaintConfig(), filler="diffusion" if one_fit else word, key_views=1, turntable=1)
    if inpaint.filler == "diffusion":
        inpaint = replace(inpaint, ti=False, lora=False, sg=False)
    refine = replace(QUICK.refine, steps=1, lpips=0.0)
    config = replace(TINY, steps=2, one_fit=one_fit, inpaint=inpaint, refine=refine)
    InpaintHuman(config).fit(training_set(views), device="cpu", seed=0, ledger=Ledger(), progress=Progress.silent())
    told("painted")
"""


def test_diffusers_is_imported_by_the_painter_that_needs_it():
    words = [sys.executable, "-c", WHAT_IS_IMPORTED, "one fit", "temporal", "diffusion"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, cwd=Path(__file__).parents[2])
    assert done.stdout.splitlines() == [
        *("fitted", "painted"),
        *("fitted", "painted stage2"),
        *("fitted stage2", "painted stage2 diffusers transformers"),
    ], done.stderr


def test_looking_at_mini_weights_imports_no_diffusers(mini):
    code = (
        "import sys; from pathlib import Path\n"
        "from ihbench.diffusion.mini.folder import check_mini\n"
        f"check_mini(Path({str(mini)!r})); print('diffusers' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout == "False\n", done.stderr


class Killed(BaseException):
    pass


@pytest.fixture(scope="module")
def uninterrupted(mini):
    """A configuration, and the parameters that a fit with it ends with."""
    given = config(mini, batch=1)
    return given, parameters_of(fit(given))


@pytest.mark.parametrize("state", [TI_STATE, ADAPT_STATE, "stage2-sampled", "stage2-painted", "stage3"])
def test_killed_in_any_stage_and_resumed_ends_the_same(tmp_path, uninterrupted, state, monkeypatch):
    """Killed right after that state was saved; everything before it is not done again."""
    given, whole = uninterrupted
    ledger = Ledger(tmp_path)
    monkeypatch.setattr(ledger, "due_to_save", lambda: True)
    honest = ledger.save_state

    def save(name, tensors, meta):
        honest(name, tensors, meta)
        if name == state:
            raise Killed

    monkeypatch.setattr(ledger, "save_state", save)
    with pytest.raises(Killed):
        fit(given, ledger)
    again = Ledger(tmp_path)
    resumed = fit(given, again)
    assert equal_bits(parameters_of(resumed), whole)
    assert state in [event.data["stage"] for event in again.events if event.kind == "resumed"]
    assert sum(event.kind == "inpainted" for event in again.events) == 1  # nothing that was measured is lost
    curves = [event.data["stage"] for event in again.events if event.kind == "loss_curve"]
    assert sorted(curves) == sorted([TI_STATE, ADAPT_STATE])


def test_the_miniature_of_stable_diffusion_2_goes_the_whole_way(tmp_path):
    make_miniature(tmp_path)
    given = config(tmp_path, backbone="sd2", token="<someone>")
    ledger = Ledger()
    avatar = fit(given, ledger)
    (event,) = [event for event in ledger.events if event.kind == "inpainted"]
    assert event.data["pixels"] > 0
    assert np.isfinite(avatar.render(a_camera(0.0, SIZE), a_pose(0.0, 0.0))[0]).all()
    curve = next(e.data for e in ledger.events if e.kind == "loss_curve" and e.data["stage"] == ADAPT_STATE)
    assert np.isfinite(curve["losses"]).all()
    assert given.inpaint.settled().vectors == 1


def test_an_avatar_remembers_its_whole_configuration(tmp_path, mini):
    given = config(mini, tune="lora")
    avatar = fit(replace(given, refine=replace(given.refine, steps=1)))
    avatar.save(tmp_path)
    assert InpaintHuman(QUICK).load(tmp_path, avatar.body).config == avatar.config


def test_wrong_weights_are_named_before_anything_is_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr(Stage1, "run", None)
    with pytest.raises(BadInput, match="lacks unet, controlnet"):
        fit(config(tmp_path))
    with pytest.raises(BadInput, match="lacks unet/, vae/"):
        fit(config(tmp_path, backbone="sd2"))
    with pytest.raises(BadInput, match="sam-weights ''"):
        config(tmp_path, silhouette="sam")
    config(tmp_path, silhouette="sam", on=False)  # nobody needs them
    with pytest.raises(BadInput, match=r"lacks config\.json"):
        fit(config("", filler="mean", silhouette="sam", sam_weights=str(tmp_path)))
    make_miniature(tmp_path / "sd2")
    with pytest.raises(BadInput, match=r"control-weights .*no such folder"):
        fit(config(tmp_path / "sd2", backbone="sd2", control_weights=str(tmp_path / "nowhere")))
    for word, backbone, weights in (("person", "mini", ""), ("photo", "sd2", tmp_path / "sd2")):
        with pytest.raises(BadInput, match=f"has '{word}' already"):
            fit(config(weights, backbone=backbone, token=word))
    for rate in ("ti_lr", "lora_lr", "control_lr"):
        for value in (-1.0, 0.0, float("nan"), float("inf")):
            with pytest.raises(BadInput, match=f"{rate.replace('_', '-')} .*: expected above 0"):
                config("", **{rate: value})
    with pytest.raises(BadInput, match="weights ''"):
        config("", backbone="sd2")


def test_other_content_at_the_same_path_is_another_run(tmp_path):
    save_mini(tiny_backbone(), tmp_path)
    request = RunRequest(load_protocol("zju_occ"), "inpainthuman", config(tmp_path))
    first = _outside(request)
    assert first == _outside(request)
    save_mini(tiny_backbone(seed=3), tmp_path)
    assert first["outside"] != _outside(request)["outside"]
    assert _outside(replace(request, config=QUICK)) == {}


def test_weights_outside_the_package_are_part_of_a_runs_identity(mini):
    assert outside_files(config(mini)) == [mini]
    assert outside_files(config(mini, filler="mean")) == []
    assert outside_files(QUICK) == []


def test_lpips_weights_that_come_later_make_another_run(mini, tmp_path, monkeypatch):
    from ihbench.metrics import weights

    given = config(mini)
    given = replace(given, refine=replace(given.refine, lpips=0.1))
    request = RunRequest(load_protocol("zju_occ"), "inpainthuman", given)
    monkeypatch.setattr(weights, "folders", lambda: [tmp_path])
    before = _outside(request)
    trunk = weights.FILES["lpips-vgg"]
    (tmp_path / trunk.file).write_bytes(b"a trunk")
    monkeypatch.setattr(weights, "is_right", lambda *_: True)
    assert outside_files(given) == [mini, tmp_path / trunk.file]
    assert _outside(request)["outside"] != before["outside"]
    assert outside_files(replace(given, refine=replace(given.refine, lpips=0.0))) == [mini]


def test_a_hub_id_is_the_snapshot_it_stands_for(tmp_path, monkeypatch):
    from ihbench.diffusion import checkpoint

    given = replace(QUICK, inpaint=replace(QUICK.inpaint, backbone="sd2", weights="someone/sd2-inpainting"))
    assert outside_files(given) == []  # not in the cache: the run says so
    monkeypatch.setattr(checkpoint, "find_folder", lambda name, _: tmp_path)
    assert outside_files(given) == [tmp_path]


@pytest.mark.parametrize("wanted", ["float32", "bfloat16"])
def test_the_precision_stands_in_the_record_and_a_resumed_run_keeps_it(wanted):
    """Whatever the configuration or a measurement would say now."""
    given = replace(TINY, precision=wanted, steps=2)
    ledger = Ledger()
    avatar = fit(given, ledger)
    (said,) = [event.data for event in ledger.events if event.kind == "precision"]
    assert (said["precision"], avatar.fit_dtype) == (wanted, getattr(torch, wanted))
    again = Ledger(state=ledger.state())
    assert fit(replace(given, precision="auto"), again).fit_dtype == avatar.fit_dtype
    assert [event.kind for event in again.events].count("precision") == 1
    assert all(p.dtype == torch.float32 for p in avatar.parameters())
