"""Stage 1: what the loss sees, that fitting works, and that it can be repeated, stopped and gone on with."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.camera import Camera
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.losses import masked_mean, where_known
from ihbench.fit.prior_config import PriorConfig
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.methods.inpainthuman.stages.stage1 import (
    KnownSurface,
    Stage1,
    beside,
    body_window,
    loss_of,
    prepare_target,
)
from ihbench.metrics import psnr
from ihbench.metrics.ssim_torch import ssim_map_torch
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import MaskState
from ihbench.scene.sightings import FINE
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view

from .tiny_fit import (
    SIZE,
    STRIP,
    TINY,
    an_avatar,
    equal_bits,
    fitted,
    parameters_of,
    shaken,
    training_set,
)

BODY = the_body()
BLUE = (0.1, 0.2, 0.9)
NO_PRIOR = PriorConfig(color=0.0, offset=0.0, scale=0.0)
# at 64 px half of the person is rim: the background would win the first steps at its usual weight
QUICKLY = {"background_weight": 0.2, "scale_initial": 0.4, "lr_maps": 3e-2, "lr_decoder": 1e-2, "steps": 36}


def drawn(avatar, view, background=WHITE):
    """[H, W, 3] what the avatar shows of a view, whole image, every point."""
    points = avatar.every_point
    offset, scale, color = avatar.decode(points, avatar.position_map(view.body_pose))
    means = avatar.posed(points, avatar.transforms(view.body_pose)).moved(offset)
    return render_gaussians(means, scale, color, view.camera, background)


def loss_and_gradient(avatar, view, background=WHITE):
    avatar.zero_grad(set_to_none=True)
    loss = loss_of(avatar, prepare_target(avatar, view), background)
    loss.backward()
    gradient = {name: p.grad.clone() for name, p in avatar.named_parameters() if p.grad is not None}
    return loss.item(), gradient


def with_pixels(view, state, value):
    image = view.image.copy()
    chosen = view.mask == state
    image[chosen] = np.random.default_rng(0).integers(0, 256, (int(chosen.sum()), 3)) if value is None else value
    return replace(view, image=image)


# ---------------------------------------------------------------------------------------- what the loss sees


@pytest.mark.parametrize("strict", [False, True])
def test_unknown_pixels_never_influence_the_loss(views, strict):
    """Neither its value nor its gradient; other pixels do."""
    avatar = shaken(an_avatar(paper_strict=strict), 0.05)
    loss, gradient = loss_and_gradient(avatar, views[1])
    other_loss, other_gradient = loss_and_gradient(avatar, with_pixels(views[1], MaskState.UNKNOWN, None))
    assert (views[1].mask == MaskState.UNKNOWN).any()
    assert loss == other_loss
    assert equal_bits(gradient, other_gradient)
    assert loss_and_gradient(avatar, with_pixels(views[1], MaskState.PERSON, None))[0] != loss
    painted = loss_and_gradient(avatar, with_pixels(views[1], MaskState.BACKGROUND, 0))[0]
    assert (painted == loss) == strict


def test_the_strict_loss_is_the_mean_error_of_the_visible_pixels(views):
    avatar = shaken(an_avatar(paper_strict=True, cull=False), 0.05)
    for view in views[:2]:
        person = view.mask == MaskState.PERSON
        rgb = drawn(avatar, view)[0].detach().numpy()
        expected = np.abs(rgb[person] - view.image[person] / 255).mean()
        assert loss_of(avatar, prepare_target(avatar, view), WHITE).item() == pytest.approx(expected, rel=1e-5)


def test_the_loss_is_the_sum_of_its_terms(views):
    """Restated over the whole image: the window and nothing but the window is known background that counts."""
    weights = {"background_weight": 0.7, "offset_weight": 30.0, "scale_weight": 2.0, "feature_weight": 3.0}
    weights |= {"ssim": 0.4, "ssim_every": 3, "background_rim": 0.1}
    avatar = shaken(an_avatar(cull=False, **weights), 0.05)
    view = views[1]
    person, known = view.mask == MaskState.PERSON, view.mask == MaskState.BACKGROUND
    x0, y0, width, height = body_window(view.camera, BODY.pose(view.body_pose))
    window = np.zeros_like(known)
    window[y0 : y0 + height, x0 : x0 + width] = True
    rows, cols = np.nonzero((view.mask == MaskState.UNKNOWN) & window)
    for y, x in np.argwhere(known & window):
        window[y, x] = np.hypot(rows - y, cols - x).min() > 0.1 * max(width, height)
    error = np.abs(drawn(avatar, view, BLUE)[0].detach().numpy() - view.image.astype(np.float64) / 255)
    offset, scale, _ = avatar.decode(avatar.every_point, None)
    expected = (
        error[person].mean()
        + 0.7 * error[known & window].sum() / (3 * person.sum())
        + 30 * offset.square().mean().item()
        + 2 * scale.mean().item()
    )
    target = prepare_target(avatar, view)
    loss, gradient = loss_and_gradient(avatar, view, BLUE)
    assert loss == pytest.approx(expected, rel=1e-5)
    known_all = 1 - target.person - target.background
    similarity = ssim_map_torch(
        *(
            each.permute(2, 0, 1)
            for each in where_known(
                drawn(avatar, view, BLUE)[0][y0 : y0 + height, x0 : x0 + width], target.image, known_all
            )
        )
    )
    missing = masked_mean(1 - similarity.permute(1, 2, 0), target.person).item()
    assert loss_of(avatar, target, BLUE, step=2).item() == pytest.approx(expected + 3 * 0.4 * missing, rel=1e-4)
    # the features' term is in the gradient alone
    with_decay = gradient["features.table"]
    avatar.config = replace(avatar.config, feature_weight=0.0)
    without = loss_and_gradient(avatar, view, BLUE)[1]["features.table"]
    decay = 3 * 2 * avatar.features.table.detach() / avatar.features.table.numel()
    torch.testing.assert_close(with_decay - without, decay, atol=1e-7, rtol=1e-3)


def test_background_is_not_learned_beside_unknown_pixels(views):
    avatar, whole = an_avatar(background_rim=0.05), an_avatar(background_rim=0.0)
    for view in views:
        near, far = (prepare_target(each, view) for each in (avatar, whole))
        assert torch.equal(near.person, far.person)
        if (view.mask == MaskState.UNKNOWN).any():
            assert 0 < near.background.sum() < far.background.sum()
        else:
            assert torch.equal(near.background, far.background)
    assert not beside(np.zeros((4, 4), bool), 3.0).any()
    one = np.zeros((5, 5), bool)
    one[2, 2] = True
    assert beside(one, 1.0).sum() == 5
    assert beside(one, 0.0).sum() == 1


def test_a_window_shows_what_the_whole_image_shows(views):
    avatar = shaken(an_avatar(cull=False, background_rim=0.0), 0.05)
    for view in views[:3]:
        target = prepare_target(avatar, view)
        x0, y0, width, height = body_window(view.camera, BODY.pose(view.body_pose))
        rows, cols = slice(y0, y0 + height), slice(x0, x0 + width)
        assert target.image.shape == (height, width, 3)
        np.testing.assert_allclose(target.image.numpy(), view.image[rows, cols] / 255, atol=1e-6)
        offset, scale, color = avatar.decode(target.points, target.position_map)
        means = target.posed.moved(offset)
        rgb = render_gaussians(means, scale, color, target.camera, WHITE)[0]
        torch.testing.assert_close(rgb, drawn(avatar, view)[0][rows, cols], atol=1e-5, rtol=0)
        states = target.person + target.background + 0
        assert torch.equal(states[..., 0] == 0, torch.from_numpy(view.mask[rows, cols] == MaskState.UNKNOWN))
        assert target.person.sum() == (view.mask == MaskState.PERSON).sum(), "the window cuts the person"
        whole = shaken(an_avatar(cull=False, crop=False, background_rim=0.0), 0.05)
        assert prepare_target(whole, view).image.shape == view.image.shape
        losses = [loss_of(each, prepare_target(each, view), WHITE).item() for each in (avatar, whole)]
        assert losses[1] == pytest.approx(losses[0], rel=1e-3)


@pytest.mark.parametrize(
    "shift", [(0, 0, 0), (0.9, 0, 0), (0, -1.1, 0), (9, 9, 0), (-9, 0, 0), (0, 0, 2.9), (0, 0, 9)]
)
def test_a_window_lies_in_the_image(shift):
    """Also when the body is half outside, all outside, around the camera, or behind it."""
    camera, pose = a_camera(0.0, SIZE), a_pose(transl=shift)
    vertices = BODY.pose(pose)
    x0, y0, width, height = body_window(camera, vertices)
    assert 0 <= x0 < x0 + width <= SIZE
    assert 0 <= y0 < y0 + height <= SIZE
    p = camera.project(vertices)
    inside = (p[:, 2] > 0) & (p[:, :2] >= 0).all(1) & (p[:, :2] < SIZE).all(1)
    if (p[:, 2] > 0).all():
        assert (p[inside, :2] >= [x0, y0]).all()
        assert (p[inside, :2] <= [x0 + width, y0 + height]).all()
    else:
        assert (x0, y0, width, height) == (0, 0, SIZE, SIZE)
    view = replace(train_view(camera, pose), mask=np.full((SIZE, SIZE), MaskState.PERSON, np.uint8))
    assert torch.isfinite(loss_of(an_avatar(), prepare_target(an_avatar(), view), WHITE))


def test_known_background_pulls_in_a_silhouette_that_spills():
    """From Gaussians twice too wide: with the background term the spill goes, without it, it stays."""
    view = train_view(a_camera(0.0, SIZE), a_pose(0, 0.3))
    known = view.mask == MaskState.BACKGROUND
    spill = {}
    for weight in (0.0, 1.0):
        avatar = an_avatar(background_weight=weight, scale_weight=0.0, ssim=0.0, pose_residual=False, steps=25)
        with torch.no_grad():
            avatar.decoder.linear[-1].bias[3] += 0.7
        before = avatar.render(view.camera, view.body_pose)[1][known].sum()
        Stage1(avatar, training_set([view]), 0, Ledger()).run(Progress.silent())
        spill[weight] = avatar.render(view.camera, view.body_pose)[1][known].sum() / before
    assert spill[1.0] < 0.75
    assert spill[0.0] > spill[1.0] + 0.15


# ------------------------------------------------------------------------------------------------ the prior


def test_the_prior_links_what_is_decoded_of_neighbours(views):
    """Restated: weights by the share of views, squared differences in colour, offset and the scale's logarithm."""
    training = training_set(views)
    prior = PriorConfig(color=2.0, offset=300.0, scale=0.5, views=12.0, power=1.5)
    avatar = shaken(an_avatar(prior=prior, offset_weight=0.0, scale_weight=0.0, texels=64), 0.05)
    target = prepare_target(avatar, views[1], KnownSurface.of(avatar, training))
    without = shaken(an_avatar(prior=NO_PRIOR, offset_weight=0.0, scale_weight=0.0, texels=64), 0.05)
    cost = (loss_of(avatar, target, WHITE) - loss_of(without, target, WHITE)).item()
    offset, scale, color = avatar.decode(target.points, target.position_map)
    size = (scale / avatar.base_scale[target.points]).log()
    i, j = target.links.pairs.long().T
    squares = 2 * (color[i] - color[j]).square().sum(1) + 300 * (offset[i] - offset[j]).square().sum(1)
    squares += 0.5 * (size[i] - size[j]).square()
    assert len(i) > len(target.points)
    assert cost == pytest.approx((target.links.weight * squares).sum().item() / len(target.points), rel=1e-3)
    seen = training.sightings[FINE].visibility.seen / len(views)
    least, most = (1 + 12 * seen.max()) ** -1.5, 1.0
    assert target.links.weight.min() >= least * 0.999
    assert target.links.weight.max() == most, "what no view shows"


def test_points_that_face_no_view_are_drawn_for_the_prior_alone(views):
    """So that it reaches them; the body hides them from the loss of the pixels."""
    training = training_set(views[:1])
    avatar = an_avatar(texels=64)
    surface = KnownSurface.of(avatar, training)
    target = prepare_target(avatar, views[0], surface)
    assert len(surface.unfaced) > 200
    assert np.isin(surface.unfaced, target.points.numpy()).all()
    assert not target.evident[torch.from_numpy(np.isin(target.points.numpy(), surface.unfaced))].any()
    assert not len(KnownSurface.of(an_avatar(texels=64, prior=NO_PRIOR), training).unfaced)


def test_hidden_surface_becomes_smooth_and_seen_surface_stays():
    """Behind a strip that is everywhere: jumps between unseen neighbours shrink, those that the views show do not."""
    training = training_set([train_view(a_camera(0.0, SIZE), a_pose(1.05 * k), STRIP, frame=k) for k in range(6)])
    jumps = {}
    for name, prior in (("with", PriorConfig()), ("without", NO_PRIOR)):
        avatar = fitted(training, **{**QUICKLY, "prior": prior, "steps": 60})
        links = KnownSurface.of(avatar, training).prior
        color = avatar.gaussians(a_pose(0.0))[2]
        i, j = links.pairs.long().T
        jump = (color[i] - color[j]).norm(dim=1)
        jumps[name] = [jump[links.weight > 0.5].mean().item(), jump[links.weight < 0.02].mean().item()]
    assert jumps["with"][0] < 0.4 * jumps["without"][0], jumps
    assert jumps["with"][1] > 0.6 * jumps["without"][1], jumps


# ---------------------------------------------------------------------------------------------------- fitting


def mean_loss(avatar, training):
    with torch.no_grad():
        targets = [prepare_target(avatar, view) for view in training.views]
        return float(np.mean([loss_of(avatar, target, training.background).item() for target in targets]))


@pytest.mark.parametrize("change", [{}, {"levels": (32,)}, {"fusion": "concat"}, {"paper_strict": True}], ids=str)
def test_a_short_fit_lowers_the_loss_and_looks_like_the_person(views, change):
    """Also from a camera and in a pose that nobody trained on, and where the strip hid the person."""
    training = training_set(views)
    before, after = an_avatar(**{**QUICKLY, **change}), fitted(training, **{**QUICKLY, **change})
    assert mean_loss(after, training) < 0.65 * mean_loss(before, training)
    new = train_view(a_camera(0.3, SIZE), a_pose(0.5, 0.2))
    behind = train_view(views[1].camera, views[1].body_pose)
    for view, state in ((new, None), (behind, MaskState.UNKNOWN)):
        region = view.mask == MaskState.PERSON
        region &= (views[1].mask == state) | (state is None)
        truth = view.image.astype(np.float32) / 255
        start, end = (psnr(a.render(view.camera, view.body_pose)[0], truth, region) for a in (before, after))
        assert end > start + 2


def test_the_pose_residual_is_trained_once_it_joins(views):
    training = training_set(views)
    early = fitted(training, steps=4, residual_start=1.0)
    late = fitted(training, steps=4, residual_start=0.5)
    assert not early.residual_on
    assert late.residual_on
    assert not early.encoder.last.weight.any()
    assert late.encoder.last.weight.any()
    assert not fitted(training, steps=4, pose_residual=False).residual_on


def test_the_method_reports_its_stages_and_offers_its_avatar(views):
    offered = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append((step, avatar)))
    avatar = InpaintHuman(TINY).fit(
        training_set(views), device="cpu", seed=0, ledger=ledger, progress=Progress.silent()
    )
    assert {"fit", "fit/prepare", "fit/stage1"} <= {row["stage"] for row in ledger.table()}
    assert [(step, which is avatar) for step, which in offered][-1] == (TINY.steps, True)
    assert equal_bits(parameters_of(avatar), parameters_of(fitted(training_set(views))))


def test_the_fitted_shape_is_the_mean_over_the_views(views):
    rng = np.random.default_rng(0)
    shapes = rng.normal(0, 0.5, (2, 10))
    some = [
        replace(view, body_pose=replace(view.body_pose, betas=betas))
        for view, betas in zip(views[:2], shapes, strict=True)
    ]
    avatar = InpaintHuman(replace(TINY, steps=1)).fit(
        training_set(some), device="cpu", seed=0, ledger=Ledger(), progress=Progress.silent()
    )
    np.testing.assert_allclose(avatar.betas, shapes.mean(0))


@pytest.mark.parametrize("n", [1, 4, 7])
def test_every_view_comes_once_an_epoch_in_an_order_of_its_own(views, n):
    stage = Stage1(an_avatar(), training_set(views), 3, Ledger())
    epochs = [[stage._view_of(epoch * n + k, n) for k in range(n)] for epoch in range(4)]
    assert all(sorted(epoch) == list(range(n)) for epoch in epochs)
    assert [[stage._view_of(epoch * n + k, n) for k in range(n)] for epoch in range(4)] == epochs
    other = Stage1(an_avatar(), training_set(views), 4, Ledger())
    if n > 4:
        assert len({tuple(epoch) for epoch in epochs}) > 1
        assert [other._view_of(k, n) for k in range(4 * n)] != [k for epoch in epochs for k in epoch]


def test_step_sizes_fall_along_a_cosine(views):
    stage = Stage1(an_avatar(steps=5, lr_final=0.1), training_set(views[:1]), 0, Ledger())
    rates = []
    step = stage.optimizer.step
    stage.optimizer.step = lambda: rates.append([group["lr"] for group in stage.optimizer.param_groups]) or step()
    stage.run(Progress.silent())
    expected = 0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * np.arange(5) / 5))
    np.testing.assert_allclose(rates, expected[:, None] * [TINY.lr_maps, TINY.lr_decoder, TINY.lr_encoder])


# ----------------------------------------------------------------------------------------- the same again


def test_the_same_seed_gives_the_same_avatar_to_the_bit_and_another_seed_another(views):
    training = training_set(views)
    first, again, other = (fitted(training, seed, steps=5) for seed in (0, 0, 1))
    assert equal_bits(parameters_of(first), parameters_of(again))
    assert not equal_bits(parameters_of(first), parameters_of(other))
    image = [a.render(a_camera(0.5, SIZE), a_pose())[0] for a in (first, again, other)]
    assert np.array_equal(image[0], image[1])
    assert not np.array_equal(image[0], image[2])


class SavesAt(Ledger):
    """Asks for a saved state after some steps only."""

    def __init__(self, *steps):
        super().__init__()
        self.steps, self.seen = steps, 0

    def offer(self, step, avatar, progress=None, force=False):
        self.seen = step
        return False

    def due_to_save(self):
        return self.seen in self.steps


class Killed(Exception):
    pass


def killed_after(avatar, training, ledger, steps):
    stage = Stage1(avatar, training, 0, ledger)
    one_step = stage._one_step

    def counted(k):
        if stage.step == steps:
            raise Killed
        one_step(k)

    stage._one_step = counted
    with pytest.raises(Killed):
        stage.run(Progress.silent())


@pytest.mark.parametrize(("saved", "killed"), [(1, 1), (2, 5), (3, 4), (6, 9), (9, 9)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(views, saved, killed):
    """Killed after `killed` of 10 steps, the last state from step `saved`; the residual joins at step 3."""
    training = training_set(views)
    whole = fitted(training)
    ledger = SavesAt(saved)
    killed_after(an_avatar(), training, ledger, killed)
    resumed = fitted(training, ledger=ledger)
    assert equal_bits(parameters_of(whole), parameters_of(resumed))
    assert resumed.residual_on == whole.residual_on
    assert [event.data for event in ledger.events if event.kind == "resumed"] == [{"stage": "stage1", "step": saved}]


def test_killed_twice_and_on_disk(views, tmp_path):
    """Through the files, as a new process would."""
    training = training_set(views)
    for steps in (4, 8):
        ledger = Ledger(tmp_path, save_every=0.0)
        ledger.due_to_save = lambda: True
        killed_after(an_avatar(), training, ledger, steps)
    resumed = fitted(training, ledger=Ledger(tmp_path))
    assert equal_bits(parameters_of(fitted(training)), parameters_of(resumed))


@pytest.mark.parametrize("start", [0.0, 0.9, 1.0])
def test_a_finished_fit_is_not_done_again(views, start):
    training, ledger = training_set(views), Ledger()
    whole = fitted(training, ledger=ledger, residual_start=start)
    avatar = an_avatar(residual_start=start)
    stage = Stage1(avatar, training, 0, ledger)
    stage._one_step = lambda k: pytest.fail("a step was done again")
    stage.run(Progress.silent())
    assert equal_bits(parameters_of(whole), parameters_of(avatar))
    assert avatar.residual_on == whole.residual_on


# ------------------------------------------------------------------------------------------------- bad outcomes


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_pixel_is_a_divergence_at_the_step_that_met_it(views, bad):
    image = views[2].image.astype(np.float32)
    image[SIZE // 2, np.flatnonzero(views[2].mask[SIZE // 2] == MaskState.PERSON)[0]] = bad
    training = training_set([*views[:2], replace(views[2], image=image), *views[3:]])
    avatar = an_avatar()
    stage = Stage1(avatar, training, 0, Ledger())
    expected = next(step for step in range(6) if stage._view_of(step, 6) == 2)
    with pytest.raises(Diverged, match=r"loss is (nan|inf)") as caught:
        stage.run(Progress.silent())
    assert caught.value.step == expected
    assert all(p.isfinite().all() for p in avatar.parameters()), "bad values went into the parameters"


def test_a_bad_parameter_is_a_divergence_at_once(views):
    """Even one whose Gaussian is dropped as not drawable."""
    avatar = an_avatar()
    with torch.no_grad():
        avatar.features.table[avatar.features.index[100]] = float("nan")
    with pytest.raises(Diverged) as caught:
        Stage1(avatar, training_set(views), 0, Ledger()).run(Progress.silent())
    assert caught.value.step == 0


@pytest.mark.parametrize("factor", [100, 1e4, 1e30])
def test_wild_step_sizes_end_finite_or_diverge(views, factor):
    avatar = an_avatar(steps=6)
    for name in ("lr_maps", "lr_decoder", "lr_encoder"):  # past the switches' bounds
        object.__setattr__(avatar.config, name, factor * getattr(TINY, name))
    with suppress(Diverged):
        Stage1(avatar, training_set(views), 0, Ledger()).run(Progress.silent())
        assert all(p.isfinite().all() for p in avatar.parameters())
        assert np.isfinite(avatar.render(a_camera(0.0, SIZE), a_pose())[0]).all()


def all_hidden(view):
    return replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN))


def test_one_view_that_shows_a_single_pixel_is_enough(views):
    mask = np.full_like(views[0].mask, MaskState.UNKNOWN)
    mask[tuple(np.argwhere(views[0].mask == MaskState.PERSON)[50])] = MaskState.PERSON
    avatar = fitted(training_set([all_hidden(views[1]), replace(views[0], mask=mask)]), steps=6)
    assert all(p.isfinite().all() for p in avatar.parameters())


def test_a_body_behind_the_camera_does_no_harm(views):
    camera, about = views[0].camera, np.diag([-1.0, 1, -1])
    behind = Camera(camera.K, about @ camera.R, about @ camera.t, SIZE, SIZE)
    avatar = fitted(training_set([views[0], replace(views[1], camera=behind)]), steps=6)
    assert all(p.isfinite().all() for p in avatar.parameters())
