"""Stage 2's personalisation: each switch changes what it should and only that, and a killed one goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.clock.threads import one_torch_thread
from ihbench.diffusion import personalise
from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.personalise import Personaliser, best_seen
from ihbench.diffusion.subject_token import ANYBODY, SubjectToken
from ihbench.errors import BadInput, Diverged
from tests.diffusion.tiny_diffusion import crops, images_equal, same, tiny_backbone, weights

QUIET = Progress.silent()
TINY = InpaintConfig(ti_steps=3, lora_steps=3, batch=2, sampler_steps=2)
HIDE = slice(28, 36)


@pytest.fixture(autouse=True)
def threads():
    with one_torch_thread():
        yield


def learned(config, seed=0, views=None, ledger=None):
    backbone = tiny_backbone()
    painter = DiffusionInpainter(backbone, config, seed, ledger or Ledger())
    painter.learn(views or crops(HIDE), QUIET)
    return painter


def lora_start(config, seed=0):
    """LoRA's first factors as the adaptation finds them."""
    starts = {}

    class Spy(Personaliser):
        def _optimise(self, state, what, named, *rest):
            if state == personalise.ADAPT_STATE:
                starts.update({n: p.detach().clone() for n, p in named.items() if "lora_A" in n})

    Spy(tiny_backbone(), crops(HIDE), config, seed, Ledger()).run(QUIET)
    return starts


class TestSwitches:
    def test_all_off_is_exactly_the_generic_model(self):
        config = replace(TINY, ti=False, lora=False, sg=False)
        painter = learned(config)
        plain = tiny_backbone()
        for part in ("unet", "controlnet", "text_encoder"):
            assert same(weights(getattr(painter.backbone, part)), weights(getattr(plain, part)))
        assert painter.prompt == ANYBODY
        untouched = DiffusionInpainter(plain, config, 0, Ledger())
        assert images_equal(painter.inpaint(crops(HIDE), QUIET), untouched.inpaint(crops(HIDE), QUIET))

    def test_ti_learns_the_word_and_nothing_else(self):
        painter = learned(replace(TINY, lora=False, sg=False))
        plain = tiny_backbone()
        assert same(weights(painter.backbone.unet), weights(plain.unet))
        assert same(weights(painter.backbone.controlnet), weights(plain.controlnet))
        before, after = weights(plain.text_encoder), weights(painter.backbone.text_encoder)
        for name, value in before.items():
            assert torch.equal(after[name][: len(value)], value), name
        assert painter.prompt == "a photo of <someone> <someone>-1 <someone>-2 <someone>-3"
        assert plain.text([ANYBODY]).shape == painter.backbone.text([painter.prompt]).shape

    @pytest.mark.parametrize("tune", ["lora", "all"])
    def test_lora_changes_the_unet_alone(self, tune):
        painter = learned(replace(TINY, ti=False, sg=False, tune=tune))
        plain = tiny_backbone()
        assert same(weights(painter.backbone.controlnet), weights(plain.controlnet))
        assert same(weights(painter.backbone.text_encoder), weights(plain.text_encoder))
        now = weights(painter.backbone.unet)
        if tune == "lora":
            base = {name.replace(".base_layer", ""): value for name, value in now.items() if "lora" not in name}
            assert same(base, weights(plain.unet))
            assert any("lora" in name and value.any() for name, value in now.items())
        else:
            assert not same(now, weights(plain.unet))

    def test_sg_adapts_the_controlnet_alone(self):
        painter = learned(replace(TINY, ti=False, lora=False))
        plain = tiny_backbone()
        assert same(weights(painter.backbone.unet), weights(plain.unet))
        assert not same(weights(painter.backbone.controlnet), weights(plain.controlnet))

    def test_without_sg_the_controlnet_is_never_asked(self):
        config = replace(TINY, sg=False)
        backbone = tiny_backbone()
        backbone.controlnet.forward = None  # calling it would fail
        painter = DiffusionInpainter(backbone, config, 0, Ledger())
        painter.learn(crops(HIDE), QUIET)
        painter.inpaint(crops(HIDE), QUIET)

    def test_lora_starts_alike_whether_or_not_a_word_was_learned(self):
        starts = [lora_start(config) for config in (replace(TINY, tune="lora", ti=ti) for ti in (True, False))]
        assert starts[0]
        assert same(*starts)
        assert not same(starts[0], lora_start(replace(TINY, tune="lora"), seed=7))

    def test_the_text_encoder_learns_with_the_word_and_stops_with_it(self):
        painter = learned(replace(TINY, text_lora=True))
        now, plain = painter.backbone.text_encoder, weights(tiny_backbone().text_encoder)
        after = {name.replace(".base_layer", ""): value for name, value in weights(now).items()}
        added = {name: value for name, value in after.items() if "lora_B" in name}
        assert added
        assert all(value.any() for value in added.values())  # zero before the first step
        assert all(torch.equal(after[name][: len(value)], value) for name, value in plain.items())
        assert not any(p.requires_grad for p in now.parameters())
        without = learned(TINY).inpaint(crops(HIDE), QUIET)
        assert not images_equal(painter.inpaint(crops(HIDE), QUIET), without)

    def test_ti_gives_the_same_word_whether_or_not_lora_follows(self):
        alone = learned(replace(TINY, lora=False))
        with_lora = learned(TINY)
        a, b = alone.curves[personalise.TI_STATE], with_lora.curves[personalise.TI_STATE]
        assert a.losses == b.losses

    @pytest.mark.parametrize("tune", ["lora", "all"])
    def test_is_deterministic_by_seed(self, tune):
        config = replace(TINY, tune=tune)
        a = learned(config)
        torch.rand(7)  # what else draws random numbers does not matter
        b, c = learned(config), learned(config, seed=1)
        assert images_equal(a.inpaint(crops(HIDE), QUIET), b.inpaint(crops(HIDE), QUIET))
        assert not images_equal(a.inpaint(crops(HIDE), QUIET), c.inpaint(crops(HIDE), QUIET))


class TestLearning:
    def test_the_loss_falls(self):
        config = replace(TINY, ti=False, lora_steps=60, lora_lr=2e-3, control_lr=2e-3, batch=4)
        curve = learned(config).curves[personalise.ADAPT_STATE]
        assert np.mean(curve.losses[-15:]) < 0.8 * np.mean(curve.losses[:15])

    def test_unknown_pixels_teach_nothing(self):
        """What the occluder is painted with must not reach the loss."""
        views = crops(HIDE)
        repainted = [replace(v, image=np.where(v.unknown[..., None], np.uint8(7), v.image)) for v in views]
        losses = []
        for given in (views, repainted):
            person = Personaliser(tiny_backbone(), given, TINY, 0, Ledger())
            found = [person.loss(given, np.random.default_rng(k), 4, personalise.SHARES, True) for k in range(4)]
            losses.append([float(loss) for loss in found if loss is not None])
        assert losses[0]
        assert losses[0] == losses[1]

    def test_a_view_that_is_all_hidden_is_left_out(self):
        shown, hidden = crops(HIDE)[:3], crops(slice(0, 64))[3:]
        person = Personaliser(tiny_backbone(), shown + hidden, TINY, 0, Ledger())
        assert person.views == shown
        assert len(learned(TINY, views=shown + hidden).inpaint(hidden, QUIET)) == 3

    def test_nobody_visible_anywhere(self):
        with pytest.raises(BadInput, match="no frame shows a visible pixel"):
            learned(TINY, views=crops(slice(0, 64)))

    def test_best_seen_prefers_views_that_hide_least(self):
        views = crops(HIDE)[:4] + crops()[4:]
        best = best_seen(views, 0.1)
        assert len(best) == 4
        assert {4, 5} <= {view.index for view in best}


def test_in_half_precision_steps_are_taken_in_full(monkeypatch):
    """With AdamW's steps of 1e-5 in bfloat16 only a few weights would move."""
    backbone = tiny_backbone()
    for part in (backbone.unet, backbone.controlnet, backbone.text_encoder):
        part.to(torch.bfloat16)
    before = weights(backbone.controlnet)
    kinds = []
    person = Personaliser(backbone, crops(HIDE), replace(TINY, control_lr=1e-5), 0, Ledger())
    save = person._save
    monkeypatch.setattr(
        person,
        "_save",
        lambda s, n, named, *a: (kinds.append({p.dtype for p in named.values()}), save(s, n, named, *a)),
    )
    person.run(QUIET)
    assert kinds == [{torch.float32}, {torch.float32}]
    after = weights(backbone.controlnet)
    assert {value.dtype for value in after.values()} == {torch.bfloat16}
    assert any(not torch.equal(after[name], before[name]) for name in before)


class TestTrouble:
    def test_a_word_of_the_vocabulary_is_refused(self):
        with pytest.raises(BadInput, match="has 'person' already"):
            SubjectToken(tiny_backbone(), "person", 1)

    def test_a_nonfinite_loss_rolls_back_and_says_so(self, monkeypatch):
        backbone, ledger = tiny_backbone(), Ledger()
        person = Personaliser(backbone, crops(HIDE), replace(TINY, ti=False, lora_steps=30), 0, ledger)
        honest, steps = person.loss, []

        def loss(*args):
            steps.append(0)
            value = honest(*args)
            return value * float("nan") if len(steps) == 26 else value

        monkeypatch.setattr(person, "loss", loss)
        kept = []
        roll_back = person._roll_back
        monkeypatch.setattr(
            person, "_roll_back", lambda named, good, *a: (kept.append(good), roll_back(named, good, *a))
        )
        person.run(QUIET)
        (event,) = [event for event in ledger.events if event.kind == "rolled_back"]
        assert event.data["step"] == 20
        assert "loss nan" in event.data["what"]
        now = dict(backbone.unet.named_parameters())
        assert all(
            torch.equal(now[name.removeprefix("unet.")], v) for name, v in kept[0][1].items() if "unet." in name
        )
        assert len(steps) == 26
        assert max(person.curves[personalise.ADAPT_STATE].steps) == 19

    @pytest.mark.parametrize("spoiled", [20, 25, 30])  # where a copy is due, between two, and by the very last
    def test_a_step_that_spoils_the_parameters_is_undone(self, monkeypatch, spoiled):
        """The parameters that a step left behind count as good only once a loss of theirs was finite."""
        backbone, ledger = tiny_backbone(), Ledger()
        person = Personaliser(backbone, crops(HIDE), replace(TINY, ti=False, lora_steps=30), 0, ledger)
        honest_step, honest_loss, asked = torch.optim.AdamW.step, person.loss, []

        def loss(*args):
            asked.append(0)
            return honest_loss(*args)

        def step(optimizer, *args, **kwargs):
            honest_step(optimizer, *args, **kwargs)
            if len(asked) == spoiled:
                optimizer.param_groups[0]["params"][0].data.fill_(float("nan"))

        monkeypatch.setattr(person, "loss", loss)
        monkeypatch.setattr(torch.optim.AdamW, "step", step)
        person.run(QUIET)
        (event,) = [event for event in ledger.events if event.kind == "rolled_back"]
        assert event.data["step"] == (0 if spoiled == 20 else 20)
        assert all(torch.isfinite(value).all() for value in weights(backbone.unet).values())
        assert all(torch.isfinite(value).all() for value in weights(backbone.controlnet).values())

    def test_optimiser_out_of_memory_is_one_line(self, monkeypatch):
        def step(*args, **kwargs):
            raise torch.OutOfMemoryError("CUDA out of memory")

        monkeypatch.setattr(torch.optim.AdamW, "step", step)
        with pytest.raises(BadInput, match="textual inversion: one crop does not fit into memory"):
            learned(TINY)

    @pytest.mark.parametrize("limit", [2, 0])
    def test_sampling_out_of_memory_halves_the_batch_then_says_what_to_do(self, monkeypatch, limit):
        from ihbench.diffusion import sampling

        honest, sizes = sampling.sample, []

        def sample(backbone, batch, *args, **kwargs):
            if len(batch) > limit:
                raise torch.OutOfMemoryError("out of memory")
            sizes.append(len(batch))
            return honest(backbone, batch, *args, **kwargs)

        config = replace(TINY, ti=False, lora=False, sg=False, batch=4)
        expected = learned(config).inpaint(crops(HIDE), QUIET)
        monkeypatch.setattr(sampling, "sample", sample)
        if limit:
            assert images_equal(learned(config).inpaint(crops(HIDE), QUIET), expected)
            assert max(sizes) == limit
        else:
            with pytest.raises(BadInput, match=r"one crop of .* does not fit into memory"):
                learned(config).inpaint(crops(HIDE), QUIET)

    def test_a_painting_that_is_not_finite_is_a_divergence(self):
        painter = DiffusionInpainter(tiny_backbone(), replace(TINY, ti=False, lora=False, sg=False), 0, Ledger())
        painter.backbone.unet.conv_out.bias.data.fill_(float("inf"))
        with pytest.raises(Diverged, match="not finite"):
            painter.inpaint(crops(HIDE), QUIET)

    def test_out_of_memory_halves_the_batch_then_says_what_to_do(self, monkeypatch):
        ledger = Ledger()
        person = Personaliser(tiny_backbone(), crops(HIDE), replace(TINY, ti=False, batch=4), 0, ledger)
        honest = person.loss

        def loss(views, rng, batch, *rest):
            if batch > limit:
                raise torch.OutOfMemoryError("out of memory")
            return honest(views, rng, batch, *rest)

        monkeypatch.setattr(person, "loss", loss)
        limit = 1
        person.run(QUIET)
        warnings = [event.data["what"] for event in ledger.events if event.kind == "warning"]
        assert [w.split()[-1] for w in warnings] == ["2", "1"]
        limit = 0
        other = Personaliser(tiny_backbone(), crops(HIDE), replace(TINY, ti=False, batch=4), 0, Ledger())
        monkeypatch.setattr(other, "loss", loss)
        with pytest.raises(BadInput, match="does not fit into memory"):
            other.run(QUIET)


class Killed(Exception):
    pass


@pytest.mark.parametrize("at", [2, 5])  # in textual inversion, in the adaptation
def test_killed_and_resumed_ends_the_same(tmp_path, monkeypatch, at):
    config = replace(TINY, ti_steps=4, lora_steps=4)
    whole = learned(config)
    ledger = Ledger(tmp_path, save_every=0.0)
    monkeypatch.setattr(ledger, "due_to_save", lambda: True)
    person = Personaliser(tiny_backbone(), crops(HIDE), config, 0, ledger)
    honest, count = person.loss, [0]

    def loss(*args):
        count[0] += 1
        if count[0] > at:
            raise Killed
        return honest(*args)

    monkeypatch.setattr(person, "loss", loss)
    with pytest.raises(Killed):
        person.run(QUIET)
    resumed = learned(config, ledger=Ledger(tmp_path))
    for part in ("unet", "controlnet"):
        assert same(weights(getattr(resumed.backbone, part)), weights(getattr(whole.backbone, part)))
    assert resumed.curves[personalise.TI_STATE].losses == whole.curves[personalise.TI_STATE].losses
    assert images_equal(resumed.inpaint(crops(HIDE), QUIET), whole.inpaint(crops(HIDE), QUIET))


def test_known_pixels_are_the_original():
    views = crops(HIDE)
    painted = learned(replace(TINY, ti=False)).inpaint(views, QUIET)
    for view, image in zip(views, painted, strict=True):
        assert (image[~view.unknown] == view.image[~view.unknown]).all()
        assert view.unknown.any()
    nothing = [view for view in crops() if not view.unknown.any()]
    assert nothing
    kept = learned(replace(TINY, ti=False)).inpaint(nothing, QUIET)
    assert images_equal(kept, [view.image for view in nothing])
