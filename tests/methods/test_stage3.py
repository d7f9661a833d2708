"""Stage 3: what the refinement loss sees, that it teaches hidden pixels and keeps visible ones, and that it can be
repeated, stopped and gone on with."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.fit.prior_config import PriorConfig
from ihbench.methods.inpainthuman.config import PAPER, QUICK
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.refine_config import RefineConfig
from ihbench.methods.inpainthuman.stages.refine_loss import (
    PaintedTarget,
    load_perceptual,
    prepare_painted,
    refine_loss,
)
from ihbench.methods.inpainthuman.stages.stage1 import KnownSurface, draw, loss_of, prepare_target
from ihbench.methods.inpainthuman.stages.stage3 import Stage3
from ihbench.metrics import psnr, ssim
from ihbench.metrics.lpips import lpips, random_networks
from ihbench.metrics.ssim import ssim_map
from ihbench.scene.contracts import MaskState, TrainView
from tests.bench.fake_capture import WHITE, a_camera, a_pose, train_view

from .tiny_fit import SIZE, STRIP, an_avatar, equal_bits, fitted, parameters_of, shaken, training_set

door = sys.modules["ihbench.metrics.lpips"]  # the package's `lpips` is the function
REFINE = RefineConfig(steps=10, lpips=0.0)
BLUE = (0.1, 0.2, 0.9)


@pytest.fixture(scope="module")
def random_trunks():
    with pytest.MonkeyPatch.context() as only:
        only.setattr(door, "NETS", ("squeeze",))  # the others are large
        with random_networks() as networks:
            return networks


@pytest.fixture
def networks(random_trunks, monkeypatch):
    """LPIPS with random trunks, as if their weights were here."""
    monkeypatch.setattr(door, "load", random_trunks.__getitem__)
    return random_trunks


@pytest.fixture(scope="module")
def painted(views):
    """The truth behind the strips of views 1, 3 and 5."""
    return [true_painting(k, views[k]) for k in (1, 3, 5)]


def true_painting(k, view):
    truth = train_view(view.camera, view.body_pose)
    hidden = view.mask == MaskState.UNKNOWN
    image = np.where(hidden[..., None], truth.image, view.image)
    return PaintedView(k, replace(view, image=image, mask=np.where(hidden, truth.mask, view.mask)), hidden)


def recoloured(painting, colour):
    """The painting with its generated person in one colour."""
    chosen = painting.generated & (painting.view.mask == MaskState.PERSON)
    image = np.where(chosen[..., None], np.uint8(colour), painting.view.image)
    return replace(painting, view=replace(painting.view, image=image))


def refined(training, painted, seed=0, ledger=None, config=REFINE, **changes):
    """A shaken avatar after stage 3, with the residual on."""
    avatar = shaken(an_avatar(seed, **changes), 0.05)
    avatar.residual_on = True
    Stage3(avatar, training, painted, seed, ledger or Ledger(), config).run(Progress.silent())
    return avatar


# -------------------------------------------------------------------------------------------------- the loss


def a_target(seed=0, height=40, width=32, generated=1.0):
    """A random painted view of which every state occurs, and a random rendering of it."""
    rng = np.random.default_rng(seed)
    mask = rng.choice([MaskState.BACKGROUND, MaskState.PERSON, MaskState.UNKNOWN], (height, width), p=[0.4, 0.5, 0.1])
    mask = mask.astype(np.uint8)
    made = (rng.random((height, width)) < 0.5) & (mask != MaskState.UNKNOWN)
    image = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    view = TrainView(image, mask, a_camera(), a_pose(), 0, "cam0")
    everything = slice(0, height), slice(0, width)
    target = prepare_painted(PaintedView(0, view, made), *everything, BLUE, generated, torch.device("cpu"))
    rgb = torch.from_numpy(rng.random((height, width, 3)).astype(np.float32))
    return target, rgb, image / 255, mask, made


@pytest.mark.parametrize("generated", [1.0, 0.25, 0.0])
def test_the_loss_is_the_sum_of_its_terms(generated):
    """Restated in float64, with the bench's own SSIM."""
    target, rgb, image, mask, made = a_target(generated=generated)
    config = RefineConfig(ssim=0.3, lpips=0.0, background=0.7, generated=generated)
    drawn = rgb.double().numpy()
    weight = np.where(made, generated, 1.0) * (mask == MaskState.PERSON)
    cleared = made & (mask == MaskState.BACKGROUND)
    wanted = np.where(cleared[..., None], BLUE, image)
    wanted = np.where((mask == MaskState.UNKNOWN)[..., None], drawn, wanted)
    error, n = np.abs(drawn - wanted), 3 * weight.sum()
    similarity = ssim_map(drawn, wanted)
    expected = (
        (error * weight[..., None]).sum() / n
        + 0.7 * error[cleared].sum() / n
        + 0.3 * ((1 - similarity) * weight[..., None]).sum() / n
    )
    assert refine_loss(rgb, target, config).item() == pytest.approx(expected, rel=1e-5)


def test_the_ssim_term_is_the_benchs_ssim():
    target, rgb, *_ = a_target()
    whole = replace(
        target, weight=torch.ones(40, 32, 1), unknown=torch.zeros(40, 32, 1), cleared=torch.zeros(40, 32, 1)
    )
    without, alone = (refine_loss(rgb, whole, RefineConfig(ssim=s, lpips=0)).item() for s in (0, 1))
    expected = ssim(rgb.double().numpy(), whole.image.double().numpy())
    assert alone - without == pytest.approx(1 - expected, rel=1e-5)


def test_gradients_agree_with_finite_differences():
    target, rgb, *_ = a_target(height=6, width=5)
    values = {name: getattr(target, name).double() for name in PaintedTarget.__dataclass_fields__}
    # the image stays away from the rendering: L1 has a kink where they meet
    rgb = rgb.double() * 0.2 + 0.4
    values["image"] = torch.where(values["image"] > 0.5, 0.9, 0.1).double()
    rgb.requires_grad_()
    target = PaintedTarget(**values)
    # what nobody knows follows the avatar and has no gradient, which finite differences cannot know
    target = replace(target, unknown=torch.zeros_like(target.unknown))
    assert torch.autograd.gradcheck(lambda x: refine_loss(x, target, RefineConfig(lpips=0)), rgb)


def test_pixels_that_nobody_knows_never_influence_the_loss(networks):
    """Neither its value nor its gradient, not through a window, not through a network."""
    target, rgb, _, mask, _ = a_target(height=70, width=66)
    unknown = torch.from_numpy(mask == MaskState.UNKNOWN)[..., None]
    noise = torch.rand(target.image.shape, generator=torch.Generator().manual_seed(3))
    other = replace(target, image=torch.where(unknown, noise, target.image))
    config = RefineConfig(lpips_net="squeeze")
    perceptual = load_perceptual(config, torch.device("cpu"))
    assert callable(perceptual)
    found = []
    for painting in (target, other):
        image = rgb.clone().requires_grad_()
        loss = refine_loss(image, painting, config, perceptual)
        loss.backward()
        found.append((loss.item(), image.grad))
    assert found[0][0] == found[1][0]
    assert torch.equal(found[0][1], found[1][1])
    assert not found[0][1][unknown.expand_as(noise)].any()
    assert found[0][1][~unknown.expand_as(noise)].any()


def test_generated_pixels_weigh_what_the_config_says(views, painted):
    """At 0 their colour is not learned at all, at 1 as much as an original's."""
    avatar = shaken(an_avatar(), 0.05)
    losses = {}
    for generated in (0.0, 1.0):
        config = replace(REFINE, ssim=0.0, generated=generated)
        for colour in (0, 255):
            painting = recoloured(painted[0], colour)
            stage = Stage3(avatar, training_set(views), [painting], 0, Ledger(), config)
            losses[generated, colour] = stage._loss(1).item()
    assert losses[0.0, 0] == losses[0.0, 255]
    assert losses[1.0, 0] != losses[1.0, 255]


def test_stage_ones_loss_is_kept(views, painted):
    """With weight 0 a step's loss is stage 1's to the bit; else the refinement stands beside it."""
    avatar, training = shaken(an_avatar(), 0.05), training_set(views)
    surface = KnownSurface.of(avatar, training)
    for k in range(6):
        plain = loss_of(avatar, prepare_target(avatar, views[k], surface), WHITE)
        stage = Stage3(avatar, training, painted, 0, Ledger(), replace(REFINE, weight=0.0))
        assert torch.equal(stage._loss(k), plain)
        more = [
            Stage3(avatar, training, painted, 0, Ledger(), replace(REFINE, weight=w))._loss(k) - plain
            for w in (1.0, 2.5)
        ]
        assert more[0] > 0
        assert more[1].item() == pytest.approx(2.5 * more[0].item(), rel=1e-4)


def test_a_perfect_rendering_has_no_refinement_loss():
    target = a_target()[0]
    assert refine_loss(target.image, target, RefineConfig(lpips=0)).item() == pytest.approx(0, abs=1e-6)


def test_the_window_of_a_painting_is_the_views(views, painted):
    avatar = an_avatar()
    stage = Stage3(avatar, training_set(views), painted, 0, Ledger(), REFINE)
    for k in range(6):
        target = stage._targets[k]
        assert target.painted.image.shape == target.original.image.shape
        known = (target.original.person + target.original.background) > 0
        same = torch.where(known, target.painted.image == target.original.image, True)
        assert same.all(), "visible pixels are not the original's"
        if k % 2:
            assert target.painted.cleared.any()
            assert not target.painted.unknown.any()
            behind = (target.painted.weight > 0) & ~known
            assert behind.any()
        else:
            assert torch.equal(target.painted.weight, target.original.person)


def test_a_hidden_view_without_a_painting_enters_with_its_visible_pixels(views):
    avatar = shaken(an_avatar(), 0.05)
    stage = Stage3(avatar, training_set(views), [], 0, Ledger(), REFINE)
    target = stage._targets[1]
    assert torch.equal(target.painted.weight, target.original.person)
    assert target.painted.unknown.any()
    noisy = np.where((views[1].mask == MaskState.UNKNOWN)[..., None], np.uint8(7), views[1].image)
    other = [*views[:1], replace(views[1], image=noisy), *views[2:]]
    again = Stage3(avatar, training_set(other), [], 0, Ledger(), REFINE)
    assert torch.equal(stage._loss(1), again._loss(1))


# --------------------------------------------------------------------------------------------------- fitting


def region_psnr(avatar, views, state):
    """Over pixels of the true person that a strip hides, or that show."""
    scores = []
    for view in views:
        truth = train_view(view.camera, view.body_pose)
        region = (truth.mask == MaskState.PERSON) & (view.mask == state)
        if region.any():
            image = avatar.render(view.camera, view.body_pose)[0]
            scores.append(psnr(image, truth.image.astype(np.float32) / 255, region))
    return float(np.mean(scores))


QUICKLY = {"background_weight": 0.2, "scale_initial": 0.4, "lr_maps": 3e-2, "lr_decoder": 1e-2, "steps": 30}


def test_hidden_pixels_are_learned_and_visible_ones_kept():
    """All views behind one strip: what it hides, no view shows."""
    views = [train_view(a_camera(0.0, SIZE), a_pose(0.15 * k, 0.3 * np.sin(k)), STRIP, frame=k) for k in range(4)]
    training = training_set(views)
    avatar = fitted(training, **QUICKLY)
    hidden, visible = (region_psnr(avatar, views, s) for s in (MaskState.UNKNOWN, MaskState.PERSON))
    painted = [true_painting(k, view) for k, view in enumerate(views)]
    Stage3(avatar, training, painted, 0, Ledger(), replace(REFINE, steps=20, lr_share=1.0)).run(Progress.silent())
    assert region_psnr(avatar, views, MaskState.UNKNOWN) > hidden + 1
    assert region_psnr(avatar, views, MaskState.PERSON) > visible - 0.1


def test_cleared_background_pulls_in_what_spills_behind_the_occluder():
    view = train_view(a_camera(0.0, SIZE), a_pose(0, 0.3), slice(0, SIZE))
    view = replace(
        view, mask=np.where(np.arange(SIZE)[:, None] < 20, train_view(view.camera, view.body_pose).mask, view.mask)
    )
    painting = true_painting(0, view)
    off = painting.generated & (painting.view.mask == MaskState.BACKGROUND)
    spill = {}
    for weight in (0.0, 1.0):
        avatar = an_avatar(background_weight=0.0, scale_weight=0.0, pose_residual=False)
        with torch.no_grad():
            avatar.decoder.linear[-1].bias[3] += 0.7
        before = avatar.render(view.camera, view.body_pose)[1][off].sum()
        config = replace(REFINE, steps=25, background=weight, ssim=0.0, lr_share=1.0, networks=True)
        Stage3(avatar, training_set([view]), [painting], 0, Ledger(), config).run(Progress.silent())
        spill[weight] = avatar.render(view.camera, view.body_pose)[1][off].sum() / before
    assert spill[1.0] < 0.75
    assert spill[0.0] > spill[1.0] + 0.15


def test_views_that_were_never_taken_are_learned_from(views):
    """Their pixels count in the refinement alone; they take turns with the others."""
    back = train_view(a_camera(np.pi, SIZE), a_pose(0.2, 0.1), frame=-1)
    extra = PaintedView(6, back, np.ones(back.mask.shape, bool))
    no_prior = PriorConfig(color=0.0, offset=0.0, scale=0.0)
    quiet = an_avatar(feature_weight=0.0, offset_weight=0.0, scale_weight=0.0, prior=no_prior, ssim_every=1)
    avatar = shaken(quiet, 0.05)
    stage = Stage3(avatar, training_set(views), [extra], 0, Ledger(), REFINE)
    assert {stage._view_of(step, stage.views) for step in range(12)} == set(range(7))
    target = stage._targets[6]
    assert not target.original.person.any()
    assert not target.original.background.any()
    drawn = draw(avatar, target.original, WHITE)
    assert stage._loss(6).item() == pytest.approx(refine_loss(drawn.rgb, target.painted, REFINE).item(), rel=1e-6)
    stage.run(Progress.silent())
    assert all(p.isfinite().all() for p in avatar.parameters())


def test_every_switch_changes_the_result_and_nothing_else_does(views, painted):
    training = training_set(views)
    base = replace(REFINE, steps=4)
    whole = parameters_of(refined(training, painted, config=base))
    assert equal_bits(whole, parameters_of(refined(training, painted, config=replace(base, lpips_net="alex"))))
    for change in (
        {"weight": 0.5}, {"ssim": 0.0}, {"generated": 0.5}, {"background": 0.0}, {"lr_share": 0.5}, {"steps": 5},
    ):  # fmt: skip
        other = parameters_of(refined(training, painted, config=replace(base, **change)))
        assert not equal_bits(whole, other), change


def test_no_steps_leave_the_avatar_as_it_is(views, painted):
    avatar = shaken(an_avatar(), 0.05)
    before = parameters_of(avatar)
    ledger = Ledger()
    Stage3(avatar, training_set(views), painted, 0, ledger, replace(REFINE, steps=0, lpips=0.1)).run(
        Progress.silent()
    )
    assert equal_bits(before, parameters_of(avatar))
    assert ledger.events == []


@pytest.mark.parametrize("on", [False, True])
def test_the_residual_stays_as_stage_one_left_it(views, painted, on):
    avatar = an_avatar(residual_start=0.0)
    avatar.residual_on = on
    before = parameters_of(avatar)
    config = replace(REFINE, steps=2, networks=True)
    Stage3(avatar, training_set(views), painted, 0, Ledger(), config).run(Progress.silent())
    assert avatar.residual_on is on
    changed = any(not torch.equal(before[name], p) for name, p in avatar.named_parameters() if "encoder" in name)
    assert changed is on


def test_the_configuration_is_the_avatars_own(views, painted):
    avatar = an_avatar(refine=replace(REFINE, steps=3))
    assert Stage3(avatar, training_set(views), painted, 0, Ledger()).steps == 3


def test_step_sizes_are_a_share_of_stage_ones_rise_and_fall_along_a_cosine(views):
    avatar = an_avatar(steps=7, lr_final=0.1)
    chosen = replace(REFINE, steps=4, lr_share=0.3, warm_up=0.5, networks=True)
    stage = Stage3(avatar, training_set(views[:1]), [], 0, Ledger(), chosen)
    rates = []
    step = stage.optimizer.step
    stage.optimizer.step = lambda: rates.append([group["lr"] for group in stage.optimizer.param_groups]) or step()
    stage.run(Progress.silent())
    config = avatar.config
    assert config.pose_residual
    expected = 0.3 * (0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * np.arange(4) / 4))) * [0.5, 1, 1, 1]
    np.testing.assert_allclose(rates, expected[:, None] * [config.lr_maps, config.lr_decoder, config.lr_encoder])


@pytest.mark.parametrize("networks", [False, True])
def test_the_maps_alone_are_refined_unless_the_networks_are_too(views, painted, networks):
    avatar = shaken(an_avatar(), 0.05)
    before = {name: p.detach().clone() for name, p in avatar.named_parameters()}
    Stage3(avatar, training_set(views), painted, 0, Ledger(), replace(REFINE, steps=3, networks=networks)).run(
        Progress.silent()
    )
    changed = {name.partition(".")[0] for name, p in avatar.named_parameters() if not torch.equal(p, before[name])}
    assert changed - {"encoder"} == ({"features", "decoder"} if networks else {"features"})
    assert all(p.requires_grad for p in avatar.parameters())


# ---------------------------------------------------------------------------------------------------- LPIPS


@pytest.mark.parametrize("shape", [(70, 66), (40, 90)], ids=str)
def test_the_lpips_term_is_the_benchs_lpips_over_the_complete_mask(networks, shape):
    target, rgb, _, mask, _ = a_target(height=shape[0], width=shape[1])
    inside = (mask == MaskState.PERSON) & (target.weight.numpy()[..., 0] > 0)
    config = RefineConfig(ssim=0.0, lpips=0.5, lpips_net="squeeze")
    perceptual = load_perceptual(config, torch.device("cpu"))
    assert callable(perceptual)
    image = rgb.clone().requires_grad_()
    loss = refine_loss(image, target, config, perceptual)
    alone = refine_loss(rgb, target, replace(config, lpips=0.0))
    whole = np.ones_like(inside)
    expected = lpips(rgb.numpy(), target.image.numpy(), inside, net="squeeze", background=BLUE, crop=whole)
    assert loss.item() - alone.item() == pytest.approx(0.5 * expected, rel=1e-4)
    loss.backward()
    assert image.grad is not None
    assert image.grad.isfinite().all()
    assert image.grad[torch.from_numpy(inside)].any()


def test_the_metrics_network_is_not_touched(networks):
    parameters = list(networks["squeeze"].package.parameters())
    before = [p.requires_grad for p in parameters]
    perceptual = load_perceptual(RefineConfig(lpips_net="squeeze"), torch.device("cpu"))
    assert perceptual is not None
    assert not isinstance(perceptual, str)
    image = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    perceptual(image, torch.zeros(64, 64, 3)).backward()
    assert [p.requires_grad for p in parameters] == before
    assert all(p.grad is None for p in parameters)


def test_without_lpips_weights_the_term_is_off_and_said_so(views, painted, monkeypatch, tmp_path):
    monkeypatch.setenv("IHBENCH_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    training, ledger = training_set(views), Ledger()
    config = replace(REFINE, steps=3)
    without = refined(training, painted, config=config)
    for _ in range(2):  # the second finds the first one's work, and has nothing new to say
        wanted = refined(training, painted, ledger=ledger, config=replace(config, lpips=0.1))
        assert equal_bits(parameters_of(without), parameters_of(wanted))
    (event,) = (event for event in ledger.events if event.kind != "resumed")
    assert event.kind == "left_out"
    assert event.data["what"] == "lpips term"
    assert "vgg16-397923af.pth" in event.data["reason"]


@pytest.mark.parametrize("change", [{"lpips": 0.0}, {"weight": 0.0}])
def test_no_trunk_is_loaded_for_a_weight_of_nothing(views, painted, monkeypatch, change):
    monkeypatch.setattr(door, "load", lambda net: pytest.fail("loaded a trunk"))
    ledger = Ledger()
    refined(training_set(views), painted, ledger=ledger, config=replace(REFINE, steps=1, **{"lpips": 0.1} | change))
    assert ledger.events == []


def test_with_lpips_weights_the_term_changes_the_result(views, painted, networks):
    training, config = training_set(views), replace(REFINE, steps=2, lpips=0.1, lpips_net="squeeze")
    without, ledger = refined(training, painted, config=replace(config, lpips=0.0)), Ledger()
    wanted = refined(training, painted, ledger=ledger, config=config)
    assert not equal_bits(parameters_of(without), parameters_of(wanted))
    assert ledger.events == []


# ------------------------------------------------------------------------------------------- the same again


def test_the_same_seed_gives_the_same_avatar_to_the_bit(views, painted):
    training = training_set(views)
    first, again, other = (refined(training, painted, seed, config=replace(REFINE, steps=5)) for seed in (0, 0, 1))
    assert equal_bits(parameters_of(first), parameters_of(again))
    assert not equal_bits(parameters_of(first), parameters_of(other))


def test_the_order_of_the_paintings_does_not_matter(views, painted):
    training = training_set(views)
    assert equal_bits(parameters_of(refined(training, painted)), parameters_of(refined(training, painted[::-1])))


class SavesAt(Ledger):
    """Asks for a saved state after some steps only."""

    def __init__(self, *steps):
        super().__init__()
        self.steps, self.offered = steps, []

    def offer(self, step, avatar, progress=None, force=False):
        self.offered.append(step)
        return False

    def due_to_save(self):
        return self.offered[-1] in self.steps


class Killed(Exception):
    pass


def killed_after(avatar, training, painted, ledger, steps):
    avatar = shaken(avatar, 0.05)
    avatar.residual_on = True
    stage = Stage3(avatar, training, painted, 0, ledger, REFINE)
    one_step = stage._one_step

    def counted(k):
        if stage.step == steps:
            raise Killed
        one_step(k)

    stage._one_step = counted
    with pytest.raises(Killed):
        stage.run(Progress.silent())


@pytest.mark.parametrize(("saved", "killed"), [(1, 1), (2, 5), (9, 9)])
def test_a_resumed_refinement_equals_an_uninterrupted_one_to_the_bit(views, painted, saved, killed):
    """Killed after `killed` of 10 steps, the last state from step `saved`."""
    training = training_set(views)
    whole = refined(training, painted)
    ledger = SavesAt(whole.config.steps + saved)
    killed_after(an_avatar(), training, painted, ledger, killed)
    resumed = refined(training, painted, ledger=ledger)
    assert equal_bits(parameters_of(whole), parameters_of(resumed))
    assert [event.data for event in ledger.events if event.kind == "resumed"] == [{"stage": "stage3", "step": saved}]


def test_killed_on_disk_behind_a_finished_stage_one(views, painted, tmp_path):
    """Through the files, as a new process would: both stages run again, stage 1 does nothing."""
    training = training_set(views)

    def both(ledger, until=None):
        avatar = fitted(training, ledger=ledger)
        stage = Stage3(avatar, training, painted, 0, ledger, REFINE)
        one_step = stage._one_step

        def counted(k):
            if stage.step == until:
                raise Killed
            one_step(k)

        stage._one_step = counted
        stage.run(Progress.silent())
        return avatar

    for steps in (4, 8):
        ledger = Ledger(tmp_path, save_every=0.0)
        ledger.due_to_save = lambda: True
        with pytest.raises(Killed):
            both(ledger, steps)
    resumed, whole = both(Ledger(tmp_path)), both(Ledger())
    assert equal_bits(parameters_of(whole), parameters_of(resumed))
    assert resumed.residual_on is whole.residual_on is True


def test_a_finished_refinement_is_not_done_again(views, painted):
    training, ledger = training_set(views), Ledger()
    whole = refined(training, painted, ledger=ledger)
    avatar = an_avatar()
    stage = Stage3(avatar, training, painted, 0, ledger, REFINE)
    stage._one_step = lambda k: pytest.fail("a step was done again")
    stage.run(Progress.silent())
    assert equal_bits(parameters_of(whole), parameters_of(avatar))


def test_steps_are_counted_on_from_stage_one(views, painted):
    ledger = SavesAt()
    avatar = fitted(training_set(views), ledger=ledger)
    Stage3(avatar, training_set(views), painted, 0, ledger, replace(REFINE, steps=4)).run(Progress.silent())
    assert ledger.offered == sorted(ledger.offered)
    assert sorted(set(ledger.offered)) == list(range(1, avatar.config.steps + 5))


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_pixel_is_a_divergence_at_the_step_that_met_it(views, painted, bad):
    image = painted[1].view.image.astype(np.float32)
    chosen = painted[1].generated & (painted[1].view.mask == MaskState.PERSON)
    image[tuple(np.argwhere(chosen)[0])] = bad
    paintings = [painted[0], replace(painted[1], view=replace(painted[1].view, image=image)), painted[2]]
    avatar = an_avatar()
    stage = Stage3(avatar, training_set(views), paintings, 0, Ledger(), REFINE)
    expected = avatar.config.steps + next(step for step in range(6) if stage._view_of(step, 6) == 3)
    with pytest.raises(Diverged) as caught:
        stage.run(Progress.silent())
    assert caught.value.step == expected
    assert all(p.isfinite().all() for p in avatar.parameters())


def test_paintings_that_do_not_fit_are_refused(views, painted):
    training = training_set(views)
    with pytest.raises(BadInput, match=r"one painted view per training view, got \[1, 1\]"):
        Stage3(an_avatar(), training, [painted[0], painted[0]], 0, Ledger(), REFINE)
    with pytest.raises(BadInput, match=r"one painted view per training view, got \[-1\]"):
        Stage3(an_avatar(), training, [replace(painted[0], index=-1)], 0, Ledger(), REFINE)
    view = painted[0].view
    small = replace(view, image=view.image[1:], mask=view.mask[1:])
    stage = Stage3(an_avatar(), training, [PaintedView(1, small, painted[0].generated[1:])], 0, Ledger(), REFINE)
    with pytest.raises(BadInput, match=r"painted view 1: has shape \(63, 64, 3\), expected \(64, 64, 3\)"):
        stage.run(Progress.silent())


def test_no_visible_pixel_is_said(views, painted):
    hidden = [replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN)) for view in views]
    with pytest.raises(BadInput, match="nothing to fit"):
        refined(training_set(hidden), painted)


@pytest.mark.parametrize(
    "change",
    [
        {"steps": -1}, {"weight": -1.0}, {"ssim": -0.1}, {"lpips": float("nan")}, {"lpips_net": "vgg19"},
        {"generated": float("inf")}, {"background": -1.0}, {"lr_share": 0.0}, {"lr_share": float("nan")},
        {"warm_up": 1.5},
    ],
    ids=str,
)  # fmt: skip
def test_values_that_cannot_work_are_refused_by_flag_and_value(change):
    ((name, value),) = change.items()
    with pytest.raises(BadInput) as caught:
        RefineConfig(**change)
    assert str(caught.value).startswith(f"--method.refine.{name.replace('_', '-')} {value!r}: expected ")
    assert "\n" not in str(caught.value)


def test_the_profiles_have_the_papers_weights():
    for config in (QUICK.refine, PAPER.refine):
        assert (config.weight, config.ssim, config.lpips) == (1.0, 0.2, 0.1)
    assert (QUICK.refine.steps, PAPER.refine.steps) == (200, 2000)
