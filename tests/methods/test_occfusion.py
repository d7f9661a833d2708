"""OccFusion: its acceptance checks by number, that a killed run goes on as it would have, and bad input.

One fit with painting and distillation, by a small untrained backbone, is shared by what only looks at it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.mini.weights import load_mini
from ihbench.diffusion.score_distillation import falling_timestep
from ihbench.errors import BadInput, Diverged
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.occfusion import method as occfusion
from ihbench.methods.occfusion.alpha_score import AlphaScore, alpha_picture
from ihbench.methods.occfusion.avatar import SIDES, OccFusionAvatar, big_pose_camera
from ihbench.methods.occfusion.complete_masks import CompleteMasks, asked, complete_masks
from ihbench.methods.occfusion.config import (
    PAPER,
    PROFILES,
    QUICK,
    SMOKE,
    InpaintConfig,
    OccFusionConfig,
    RefineConfig,
    ScoreConfig,
    leave_out,
    outside_files,
)
from ihbench.methods.occfusion.fits import Stage1, Stage3
from ihbench.methods.occfusion.hidden import frames_to_paint, may_hide, visible
from ihbench.methods.occfusion.in_context import canvas_of, generated_images
from ihbench.methods.occfusion.method import OccFusion
from ihbench.methods.occfusion.target import prepare_target, refine_loss, visible_loss
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scene.method_spec import method_spec
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view
from tests.diffusion.sd2_miniature import make_miniature
from tests.diffusion.tiny_diffusion import tiny_backbone

from .tiny_fit import SIZE, STRIP, equal_bits, everything, training_set

BODY = the_body()
TINY = replace(
    SMOKE,
    steps=6,
    refine=RefineConfig(steps=8, lpips=0.0, moments="rescaled"),
    density=DensityConfig(after=7, before=14, every=3),
    inpaint=InpaintConfig(key_frames=2, mask_steps=2, steps=2, batch=1),
    score=ScoreConfig(canonical=0.5, size=32),
    sh_every=4,
    weight_network=False,
)
ALONE = replace(TINY.refine, steps=0)  # stage 1 without what follows


@pytest.fixture(scope="module")
def backbone():
    return tiny_backbone()


@pytest.fixture
def small(monkeypatch, backbone):
    """The method paints with the small backbone."""
    monkeypatch.setattr(occfusion, "load_chosen", lambda config, device: backbone)


def fitted(training: TrainingSet, ledger: Ledger | None = None, seed: int = 0, **changes: Any) -> OccFusionAvatar:
    return OccFusion(replace(TINY, **changes)).fit(
        training, device="cpu", seed=seed, ledger=ledger or Ledger(), progress=Progress.silent()
    )


def an_avatar(**changes: Any) -> OccFusionAvatar:
    return OccFusionAvatar(replace(TINY, **changes), BODY, 0)


def events(ledger: Ledger, kind: str) -> list[Any]:
    return [event.data for event in ledger.events if event.kind == kind]


@pytest.fixture(scope="module")
def whole(views):
    """An uninterrupted fit: its bits, its ledger, and what was offered."""
    offered: list[Any] = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append(step))
    with pytest.MonkeyPatch.context() as patch:
        small_one = tiny_backbone()
        patch.setattr(occfusion, "load_chosen", lambda config, device: small_one)
        avatar = fitted(training_set(views), ledger)
    return avatar, everything(avatar), ledger, offered


def after_stage_1(whole: Any) -> torch.Tensor:
    """[N, 3] centres."""
    saved = whole[2].load_state("occfusion-stage1")
    assert saved is not None
    return torch.as_tensor(saved[0]["gaussians.means"])


# ----------------------------------------------------------------------------------------- check 1: the schedule


def test_check_1_the_set_changes_in_stage_3_alone(whole):
    avatar, _, ledger, _ = whole
    changes = events(ledger, "density")
    assert [change["step"] for change in changes] == [9, 12]
    assert changes[0]["before"] == len(BODY.v_template), "constant over stage 1"
    assert len(avatar) == changes[-1]["count"] != len(BODY.v_template)


def changes_of(config: OccFusionConfig) -> list[int]:
    return [step for step in range(1, config.last_step + 1) if config.density.changes_at(step)]


def test_check_1_released_events():
    """And the same shares of fewer steps, statistics from the first step of stage 3."""
    assert changes_of(PAPER) == [1400, 1600, 1800, 2000, 2200]
    assert PAPER.density.after == PAPER.steps == 1200
    assert not PAPER.density.resets
    assert changes_of(QUICK) == [420, 480, 540, 600, 660]
    assert changes_of(SMOKE) == [35, 40, 45, 50, 55]
    assert (PAPER.last_step, QUICK.last_step) == (3000, 900)
    degrees = [PAPER.degree_at(step) for step in (999, 1000, 1200, 1999, 2000, 2999, 3000)]
    assert degrees == [0, 1, 1, 1, 2, 2, 3]


def test_steps_and_the_degree_count_on(whole):
    avatar, _, ledger, offered = whole
    assert offered[-1] == TINY.last_step == 14
    assert avatar.degree == 3
    assert {"fit/stage0", "fit/stage1", "fit/stage2", "fit/stage3"} <= {row["stage"] for row in ledger.table()}


def test_adam_goes_on_in_stage_3(views, backbone):
    """Its moments as they were, or in the scale of the new loss; its count of steps in both."""
    training, masks = training_set(views), CompleteMasks({}, BODY, TINY)
    for moments, scale in (("released", 1.0), ("rescaled", 1e-4)):
        avatar = an_avatar(refine=replace(TINY.refine, moments=moments), steps=3)
        first = Stage1(avatar, training, masks, None, 0, Ledger())
        first.run(Progress.silent())
        before = {name: value.clone() for name, value in first._tensors().items()}
        after = Stage3(avatar, training, masks, {}, 0, Ledger())
        after.go_on_from(first)
        now = after._tensors()
        assert before.keys() == now.keys()
        for name, value in before.items():
            power = 1 if name.endswith("exp_avg") else 2 if name.endswith("exp_avg_sq") else 0
            expected = value * scale**power if power else value
            assert torch.allclose(now[name], expected, rtol=1e-5, atol=0), name
        assert now["adam.means.step"] == 3
        assert now["adam.means.exp_avg_sq"].any()


# ------------------------------------------------------------------------------- check 2: where the distillation acts


@pytest.fixture(scope="module")
def score(views, backbone):
    return AlphaScore(an_avatar(), training_set(views), backbone, 0)


@pytest.mark.parametrize("picture", ["silhouette", "composite"])
def test_check_2_posed_no_visible_pixel_has_a_gradient(views, backbone, picture):
    avatar = an_avatar(score=replace(TINY.score, picture=picture))
    score = AlphaScore(avatar, training_set(views), backbone, 0)
    loss, alpha = score.posed(0, 1, avatar.posed(avatar.deformation.frame(views[1].body_pose)))
    (gradient,) = torch.autograd.grad(loss, alpha)
    seen = score.views[1].crop.crop.cut(visible(views[1])) > 1e-6
    assert loss.item() == 0, "only what the avatar can change counts"
    assert seen.sum() > 20
    assert not gradient.numpy()[seen].any()
    assert np.abs(gradient.numpy()[~seen]).max() > 0


def test_with_unknown_only_hidden_pixels_have_one(views, backbone):
    avatar = an_avatar(hidden="unknown")
    score = AlphaScore(avatar, training_set(views), backbone, 0)
    loss, alpha = score.posed(0, 1, avatar.posed(avatar.deformation.frame(views[1].body_pose)))
    (gradient,) = torch.autograd.grad(loss, alpha)
    unknown = score.views[1].crop.unknown
    assert not gradient.numpy()[~unknown].any()
    assert gradient.numpy()[unknown].any()


def test_check_2_canonical_the_networks_learn_nothing_and_nothing_moves_as_a_whole(score):
    avatar = score.avatar
    for p in avatar.parameters():
        p.grad = None
    score.canonical(1).backward()
    assert all(p.grad is None for p in avatar.pose_correction.parameters())
    attributes = avatar.gaussians.attributes
    learning = {name for name, p in attributes.items() if p.grad is not None and p.grad.any()}
    assert {"means", "log_scales", "quaternions", "opacity_logits"} >= learning >= {"means", "opacity_logits"}
    gradient = attributes["means"].grad
    assert gradient.mean(0).abs().max() < 1e-4 * gradient.abs().max()


def test_three_of_four_are_posed_and_the_last_one_is(views, backbone):
    avatar = an_avatar(steps=2000, score=ScoreConfig(size=32))
    score = AlphaScore(avatar, training_set(views), backbone, 0)
    canonical = [score.is_canonical(step) for step in range(2000)]
    assert 0.22 < np.mean(canonical) < 0.28
    always = AlphaScore(an_avatar(score=ScoreConfig(canonical=1.0, size=32)), training_set(views), backbone, 0)
    assert [always.is_canonical(step) for step in (3, 4, 5)] == [True, True, False]


def test_the_big_pose_is_seen_from_the_released_sides():
    """f 1000 px, 4.5 m, 512 px; 0 is the front, from +z, and y is up."""
    front, quarter = big_pose_camera(0, 512), big_pose_camera(SIDES // 2, 128)
    assert np.allclose(front.project(np.zeros((1, 3)))[0], [256, 256, 4.5])
    assert np.allclose(front.project(np.array([[0.45, 0.9, 0.0]]))[0, :2], [256 + 100, 256 - 200])
    assert front.project(np.array([[0, 0, 1.0]]))[0, 2] == pytest.approx(3.5)
    assert quarter.project(np.array([[0, 0, 1.0]]))[0, 2] == pytest.approx(5.5)
    assert np.allclose(quarter.project(np.array([[0.45, 0.9, 0.0]]))[0, :2], [64 - 25, 64 - 50])


def test_a_composite_is_geometry_only():
    """α c + (1 - α) b: the picture as it is, whose gradient by alpha is the contrast and by colours none."""
    rgb = torch.rand(2, 2, 3, requires_grad=True)
    alpha = torch.tensor([[1.0, 0.8], [0.6, 0.0]], requires_grad=True)
    background, spare = torch.tensor([0.2, 0.2, 0.2]), torch.tensor([0.9, 0.1, 0.4])
    colour = torch.rand(2, 2, 3)
    drawn = alpha.detach()[..., None] * colour + (1 - alpha.detach()[..., None]) * background
    image = alpha_picture(drawn.requires_grad_(), alpha, "composite", background, spare)
    assert torch.allclose((image[0].movedim(0, -1) + 1) / 2, drawn, atol=1e-6)
    gradient = torch.autograd.grad(image.sum(), [alpha, rgb], allow_unused=True)
    contrast = torch.cat([(colour.reshape(-1, 3)[:3]), spare[None]]) - background
    assert torch.allclose(gradient[0].reshape(-1), 2 * contrast.sum(1), atol=1e-5)
    assert gradient[1] is None
    assert torch.equal(alpha_picture(rgb, alpha, "silhouette", background, spare)[0, 2], 2 * alpha - 1)


# ------------------------------------------------------------------------------------------- check 3: the prompts


def test_check_3_the_positive_prompt_changes_nothing_the_negative_does(whole, views, small):
    same = fitted(training_set(views), score=replace(TINY.score, positive="skin"))
    assert equal_bits(everything(same), whole[1])
    other = fitted(training_set(views), refine=ALONE, score=replace(TINY.score, negative="skin"))
    assert not torch.equal(other.gaussians.means, after_stage_1(whole))


# -------------------------------------------------------------------------------------- check 4: noise and gradient


def test_check_4_the_noise_falls_with_the_steps(score, monkeypatch):
    """At r = 0, .5 and 1: 980, 500 and 20. That ∂L/∂z is m (1 - ᾱ)(ε̂ - ε), for models that predict noise, velocity or
    clean latents, is checked in tests/diffusion/test_score_distillation.py."""
    assert [falling_timestep(r) for r in (0, 0.5, 1)] == [980, 500, 20]
    seen = []
    monkeypatch.setattr(score, "distil", Noted(score.distil, seen))
    monkeypatch.setattr(score, "steps", 9)
    for step in (0, 4, 8):
        score.canonical(step)
    assert seen == [980, 500, 20]


class Noted:
    def __init__(self, distil, seen):
        self.distil, self.seen, self.latent_shape = distil, seen, distil.latent_shape

    def __call__(self, images, prompts, timestep, *rest, **more):
        self.seen.append(timestep)
        return self.distil(images, prompts, timestep, *rest, **more)


# --------------------------------------------------------------------------------------- check 5: blind to colours


def of_colours(avatar: OccFusionAvatar, view, complete, **changes: Any) -> torch.Tensor:
    """Stage 1's loss without the term of alpha, over a rendering of random colours; and its gradient by them."""
    config = replace(avatar.config, mask=0.0, ssim=5.0, **changes)
    target = prepare_target(avatar, view, WHITE, complete)
    height, width = target.image.shape[:2]
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(height, width, 3, generator=generator, requires_grad=True)
    loss = visible_loss(rgb, torch.zeros(height, width), target, config, lambda a, b: (a - b).abs().sum())
    return torch.cat([loss[None], torch.autograd.grad(loss, rgb)[0].flatten()])


@pytest.mark.parametrize("pixels", ["fixed", "released"])
def test_check_5_colours_of_pixels_that_are_not_visible_count_nowhere(views, pixels):
    avatar, view = an_avatar(), views[1]
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, view.image.shape, dtype=np.uint8)
    other = replace(view, image=np.where(visible(view)[..., None], view.image, noise))
    complete = visible(view) | (may_hide(view, avatar.config) & (rng.random(view.mask.shape) > 0.5))
    one, same = (of_colours(avatar, each, complete, ssim_pixels=pixels) for each in (view, other))
    assert torch.equal(one, same)
    changed = replace(view, image=np.where(visible(view)[..., None], noise, view.image))
    assert not torch.equal(one, of_colours(avatar, changed, complete, ssim_pixels=pixels))
    target = prepare_target(avatar, view, WHITE, complete)
    gradient = one[1:].reshape(target.image.shape)
    assert not gradient[target.visible[..., 0] == 0].any()
    assert gradient[target.visible[..., 0] > 0].any()


def test_the_losses_are_the_sums_of_their_terms(views):
    """Restated over the pixels of the box, for both stages."""
    avatar, view = an_avatar(ssim=0.0), views[1]
    rng = np.random.default_rng(1)
    body = rasterize(view.camera.project(BODY.pose(view.body_pose)), BODY.faces, SIZE, SIZE).mask
    complete = visible(view) | (body & (view.mask == MaskState.UNKNOWN))
    made = rng.integers(0, 256, view.image.shape, dtype=np.uint8)
    target = prepare_target(avatar, view, WHITE, complete, made)
    shape = target.image.shape[:2]
    rgb, alpha = (torch.from_numpy(rng.random(size).astype(np.float32)) for size in ((*shape, 3), shape))
    seen, whole, box = (each[..., 0].numpy() > 0 for each in (target.visible, target.complete, target.box))
    image, generated = target.image.numpy(), target.generated.numpy()
    colours, alphas = rgb.numpy(), alpha.numpy()
    error = np.abs(colours - image)
    wrong = ((alphas - whole) ** 2)[box].mean()
    first = error[seen].mean() + 2 * wrong
    assert visible_loss(rgb, alpha, target, avatar.config).item() == pytest.approx(first, rel=1e-4)
    known = box & ~(whole & ~seen)
    second = 2 * error[known].mean() + 0.1 * wrong + 0.1 * np.abs(colours - generated).mean()
    assert refine_loss(rgb, alpha, target, avatar.config).item() == pytest.approx(second, rel=1e-4)
    assert (generated[~whole] == 1).all(), "on the background"
    assert (whole & ~seen).sum() > 40
    nothing = prepare_target(avatar, view, WHITE, complete)
    assert nothing.generated is None
    third = 2 * error[known].mean() + 0.1 * wrong
    assert refine_loss(rgb, alpha, nothing, avatar.config).item() == pytest.approx(third, rel=1e-4)
    clear = prepare_target(avatar, views[0], WHITE, visible(views[0]))
    assert clear.generated is not None
    assert torch.equal(clear.generated, clear.image)


# ------------------------------------------------------------------------------------------ check 6: in context


def test_check_6_the_canvas_of_stage_2(views):
    """Left the rendering, of which nothing is asked; right the visible person, asked where alpha is above .65 and the
    person is not visible."""
    avatar, view = an_avatar(opacity=0.9), views[1]
    canvas = canvas_of(view, 1, avatar, WHITE, 32)
    left, right = np.s_[:, :16], np.s_[:, 16:]
    assert canvas.image.shape == (32, 32, 3)
    rgb, alpha = avatar.render(canvas.camera, view.body_pose, WHITE)
    assert np.array_equal(canvas.image[left], np.rint(255 * rgb).astype(np.uint8))
    assert not canvas.unknown[left].any()
    half = replace(canvas.crop, width=16)
    seen = half.cut(visible(view)) >= 0.5
    assert np.array_equal(canvas.unknown[right], (alpha > 0.65) & ~seen)
    assert canvas.unknown.sum() > 10
    assert np.array_equal(canvas.person[right], seen)
    assert (canvas.image[right][~seen] == 255).all()
    assert np.array_equal(canvas.parts[left], canvas.parts[right])
    assert (canvas.parts != 255).any()
    assert canvas.crop.width == 32


def test_stage_2_keeps_what_is_visible_and_leaves_the_background(views, backbone):
    avatar, training = an_avatar(opacity=0.9), training_set(views)
    made = generated_images(avatar, training, backbone, 0, Ledger(), Progress.silent())
    assert sorted(made) == frames_to_paint(training, avatar.config)
    for k, image in made.items():
        seen = visible(views[k])
        assert np.array_equal(image[seen], views[k].image[seen])
        corner = np.ones((SIZE, SIZE), bool)
        corner[4:-4, 4:-4] = False
        assert (image[corner & ~seen] == 255).mean() > 0.9
        assert (image[~seen] != 255).any()


# --------------------------------------------------------------------------------------------- check 7: no leak


def iou(one, other) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_check_7_complete_masks_know_nothing_but_the_masks():
    """What the method may see holds no true silhouette; what it makes of it is far nearer to it than what is visible,
    although this person, unlike those that the painter knows, wears nothing. Of a stand-in it is .93 (METHOD.md)."""
    larger = [
        train_view(a_camera(0.0, 128), a_pose(1.05 * k, 0.3 * np.sin(k)), slice(56, 70) if k else None, frame=k)
        for k in range(3)
    ]
    masks = complete_masks(training_set(larger), TINY, load_mini(), 0, Ledger(), Progress.silent())
    assert sorted(masks.painted) == [1, 2]
    for k in masks.painted:
        complete, seen = masks.of(k, larger[k]), visible(larger[k])
        truth = train_view(larger[k].camera, larger[k].body_pose).mask == MaskState.PERSON
        assert iou(complete, truth) > 0.8 > iou(seen, truth) + 0.4
        assert not (seen & ~complete).any()
        assert (truth & ~complete).sum() < 10
    assert np.array_equal(masks.of(0, larger[0]), visible(larger[0])), "nothing stands before it"


def test_beside_the_body_of_an_unpainted_view_nothing_is_decided(views):
    """Where some views are painted, another one's clothes are not cut to its body."""
    config = replace(TINY, hidden="unknown")
    view, hidden = views[1], views[1].mask == MaskState.UNKNOWN
    covered = rasterize(view.camera.project(BODY.pose(view.body_pose)), BODY.faces, SIZE, SIZE).mask
    painted = CompleteMasks({2: visible(views[2])}, BODY, config)
    undecided = painted.undecided(1, view)
    assert undecided.any()
    assert not (undecided & (covered | ~hidden)).any()
    distance = distance_transform_edt(~covered)
    rows = np.flatnonzero(covered.any(1))
    assert distance[undecided].max() <= max(config.inpaint.reach * (rows[-1] - rows[0] + 1), 1)
    assert not painted.undecided(2, views[2]).any(), "it was painted"
    assert np.array_equal(CompleteMasks({}, BODY, config).undecided(1, view), undecided), "nothing was painted"
    avatar = OccFusionAvatar(config, BODY, 0)
    given = avatar, view, WHITE, painted.of(1, view), None
    plain, open_rim = prepare_target(*given), prepare_target(*given, undecided)
    left_out = (plain.box - open_rim.box)[..., 0] > 0
    assert left_out.any()
    rgb, alpha = torch.zeros(*left_out.shape, 3), torch.zeros(left_out.shape)
    alpha[left_out] = 1.0
    for loss in (visible_loss, refine_loss):
        assert loss(rgb, alpha, open_rim, config) == loss(rgb, alpha * 0, open_rim, config)
        assert loss(rgb, alpha, plain, config) > loss(rgb, alpha * 0, plain, config)


def test_without_a_painter_the_body_completes(views):
    masks = CompleteMasks({}, BODY, replace(TINY, hidden="unknown"))
    complete, view = masks.of(1, views[1]), views[1]
    body = rasterize(view.camera.project(BODY.pose(view.body_pose)), BODY.faces, SIZE, SIZE).mask
    assert np.array_equal(complete, visible(view) | (body & (view.mask == MaskState.UNKNOWN)))


def test_stage_0_paints_all_that_is_not_visible(views):
    """Released: known background as well, here near the body; with `unknown` only what is hidden."""
    for hidden in ("not_visible", "unknown"):
        config = replace(TINY, hidden=hidden)
        crop = asked(views[1], 1, BODY, config, 64, False)
        assert not (crop.unknown & crop.person).any()
        known = crop.crop.cut(views[1].mask == MaskState.UNKNOWN) == 0
        assert bool((crop.unknown & known).any()) == (hidden == "not_visible")
        assert crop.unknown.any()
        everywhere = replace(config, inpaint=replace(config.inpaint, reach=100.0))
        far = asked(views[1], 1, BODY, everywhere, 64, False)
        assert far.unknown.sum() > crop.unknown.sum()
    assert np.array_equal(far.unknown, far.crop.cut(views[1].mask == MaskState.UNKNOWN) > 1e-6)


def relabelled(view):
    return replace(
        view, mask=np.where(view.mask == MaskState.UNKNOWN, MaskState.BACKGROUND, view.mask).astype(np.uint8)
    )


def test_of_a_frame_with_something_before_it_two_states_are_known(views):
    """Where a frame hides something at all, it does not matter which of its other pixels are unknown."""
    mask = views[1].mask.copy()
    mask[mask == MaskState.BACKGROUND] = MaskState.UNKNOWN
    other = replace(views[1], mask=mask)
    assert np.array_equal(may_hide(views[1], TINY), may_hide(other, TINY))
    one, same = (asked(view, 1, BODY, TINY, 64, False) for view in (views[1], other))
    assert np.array_equal(one.unknown, same.unknown)
    assert not may_hide(relabelled(views[1]), TINY).any()


# ---------------------------------------------------------------------------------------------- check 8: effect


def test_check_8_what_the_strip_hides_stays_opaque():
    """Hidden in every frame but one, seen from the side, without painting and distillation. METHOD.md has the whole
    check on a stand-in."""
    frames = range(6)
    hidden = [train_view(a_camera(0.0, SIZE), a_pose(0.3 * k), STRIP if k else None, frame=k) for k in frames]
    avatar = fitted(
        training_set(hidden), steps=24, inpaint=InpaintConfig(on=False), lr_opacity=0.4,
        density=DensityConfig(after=24, before=34, every=4),
    )  # fmt: skip
    side = a_camera(0.0, SIZE), a_pose(0.75)
    truth = train_view(*side)
    person = (truth.mask == MaskState.PERSON) & (np.arange(SIZE) >= STRIP.start) & (np.arange(SIZE) < STRIP.stop)
    assert avatar.render(*side)[1][person].mean() > 0.85


def test_distillation_changes_the_avatar(whole, views, small):
    for changes in ({"score": replace(TINY.score, weight=0.0)}, {"inpaint": InpaintConfig(on=False)}):
        other = fitted(training_set(views), refine=ALONE, **changes)
        assert not torch.equal(other.gaussians.means, after_stage_1(whole))


# ------------------------------------------------------------------------------------------- killed and gone on with


class Killed(Exception):
    pass


class SavesAlways(Ledger):
    @property
    def on_disk(self) -> bool:
        return True

    def due_to_save(self) -> bool:
        return True


def after_calls(function, count):
    """The function, killed when it is called once more than `count` times."""
    calls = []

    def counted(*arguments, **named):
        if len(calls) == count:
            raise Killed
        calls.append(1)
        return function(*arguments, **named)

    return counted


def kill(monkeypatch, stage: str) -> None:
    if stage in ("stage 0", "stage 2"):  # after the first of two crops, each a batch of its own
        from ihbench.diffusion import sampling

        monkeypatch.setattr(sampling, "sample", after_calls(sampling.sample, 1 if stage == "stage 0" else 3))
    else:
        kind = {"stage 1": Stage1, "stage 3": Stage3, "stage 3's start": Stage3}[stage]
        steps = {"stage 1": 4, "stage 3": 5, "stage 3's start": 0}[stage]
        monkeypatch.setattr(kind, "_one_step", after_calls_of(kind._one_step, steps))


def after_calls_of(method, count):
    counted = after_calls(method, count)
    return lambda self, k: counted(self, k)


@pytest.mark.parametrize("stage", ["stage 0", "stage 1", "stage 2", "stage 3's start", "stage 3"])
def test_a_killed_fit_goes_on_to_the_same_bits(whole, views, small, monkeypatch, stage):
    ledger = SavesAlways()
    monkeypatch.setattr(Ledger, "artifact", lambda self, name, data: None)
    with monkeypatch.context() as patch:
        kill(patch, stage)
        with pytest.raises(Killed):
            fitted(training_set(views), ledger)
    again = fitted(training_set(views), ledger)
    assert equal_bits(everything(again), whole[1])
    resumed = [event["stage"] for event in events(ledger, "resumed")]
    wanted = {
        "stage 0": "stage0-sampled", "stage 1": "occfusion-stage1", "stage 2": "stage2-sampled",
        "stage 3": "occfusion-stage3", "stage 3's start": "stage2-generated",
    }  # fmt: skip
    assert wanted[stage] in resumed


def test_another_seed_is_another_avatar(whole, views, small):
    other = fitted(training_set(views), seed=1, refine=ALONE)
    assert not torch.equal(other.gaussians.means, after_stage_1(whole))


# --------------------------------------------------------------------------------------------------- bad input


def test_frames_without_a_person_and_bodies_beside_the_image_do_no_harm(views, small):
    blank = replace(views[1], mask=np.full_like(views[1].mask, MaskState.UNKNOWN))
    empty = replace(views[3], mask=np.zeros_like(views[3].mask))
    beside = replace(views[5], body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(views[4], body_pose=a_pose(transl=(0, 0, 9)))
    avatar = fitted(training_set([views[0], blank, empty, beside, behind]), hidden="not_visible")
    assert all(p.isfinite().all() for p in avatar.parameters())
    assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.05


def test_one_frame_and_shapes_by_frame(views, small):
    assert fitted(training_set(views[1:2])).render(views[1].camera, views[1].body_pose)[1].max() > 0.05
    some = [
        replace(v, body_pose=replace(v.body_pose, betas=np.array([b, 0.0])))
        for v, b in zip(views, (-1.0, 1.0), strict=False)
    ]
    body = replace(BODY, posedirs=None)
    fitted(TrainingSet(some, body, WHITE, "tiny"), inpaint=InpaintConfig(on=False), refine=ALONE)


def test_nan_is_a_divergence_where_it_is_seen_and_nothing_where_it_is_not(views):
    off = {"inpaint": InpaintConfig(on=False), "refine": ALONE}
    image = views[1].image.astype(np.float32)
    bad = {state: np.where((views[1].mask == state)[..., None], np.nan, image) for state in MaskState}
    with pytest.raises(Diverged, match="loss is nan"):
        fitted(training_set([replace(views[1], image=bad[MaskState.PERSON])]), **off)
    one, other = (
        fitted(training_set([replace(views[1], image=each)]), **off) for each in (bad[MaskState.UNKNOWN], image)
    )
    assert equal_bits(everything(one), everything(other))


def test_pruning_every_gaussian_is_a_divergence(views):
    with pytest.raises(Diverged, match="would prune all of"):
        fitted(training_set(views), inpaint=InpaintConfig(on=False), density=replace(TINY.density, faint=1.0))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"backbone": "sd2"}, "--method.inpaint.weights '': expected the folder of Stable Diffusion 2 inpainting"),
        ({"silhouette": "sam"}, "--method.inpaint.sam-weights '': expected the folder of HQ-SAM"),
        ({"key_frames": -1}, "--method.inpaint.key-frames -1: expected 0 to 100000"),
    ],
)
def test_switches_that_do_not_go_together_are_one_line(changes, words):
    with pytest.raises(BadInput) as caught:
        InpaintConfig(**changes)
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_there_are_one_line_before_anything_is_fitted(views, tmp_path):
    for missing in (
        InpaintConfig(weights=str(tmp_path / "none")),
        InpaintConfig(backbone="sd2", weights=str(tmp_path / "none")),
        InpaintConfig(silhouette="sam", sam_weights=str(tmp_path / "none")),
    ):
        ledger = Ledger()
        with pytest.raises(BadInput, match="none"):
            fitted(training_set(views), ledger, inpaint=missing)
        assert "fit/stage0" not in {row["stage"] for row in ledger.table()}


def test_stable_diffusion_goes_the_same_way(views, tmp_path):
    """With weights of its layers in miniature: guidance, the negative prompt, guess mode, silhouettes in grey."""
    inpaint = replace(
        TINY.inpaint, backbone="sd2", weights=str(make_miniature(tmp_path)), key_frames=1, mask_steps=1, steps=1
    )
    ledger = Ledger()
    avatar = fitted(
        training_set(views), ledger, inpaint=inpaint, steps=4, refine=replace(TINY.refine, steps=2),
        score=ScoreConfig(size=64, canonical=0.5),
    )  # fmt: skip
    assert all(p.isfinite().all() for p in avatar.parameters())
    assert [event["what"] for event in events(ledger, "painted")] == ["silhouettes", "images"]


def test_lpips_without_its_weights_is_off_and_said_so(views, monkeypatch):
    monkeypatch.setattr("ihbench.fit.big_pose.fitting.perceptual", lambda net, device: f"no weights of {net}")
    ledger = Ledger()
    fitted(training_set(views), ledger, lpips=0.1, inpaint=InpaintConfig(on=False), refine=RefineConfig(steps=2))
    assert events(ledger, "left_out") == [{"what": "lpips term", "reason": "no weights of vgg"}]


# -------------------------------------------------------------------------------- saved, planned, and registered


def test_a_saved_avatar_draws_the_same(whole, views, tmp_path):
    avatar = whole[0]
    avatar.save(tmp_path)
    again = OccFusion(TINY).load(tmp_path, BODY)
    for one, other in zip(*(a.render(views[2].camera, views[2].body_pose) for a in (avatar, again)), strict=True):
        assert np.array_equal(one, other)
    from ihbench.methods.gauhuman.avatar import GauHumanAvatar

    with pytest.raises(BadInput, match="holds an avatar of kind 'occfusion'"):
        GauHumanAvatar.load(tmp_path, BODY)


class Scene:
    """A `SceneMeasure` of which the plan reads these."""

    motion_deg, turn_deg, hidden_share = 40.0, 300.0, 0.2


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = Scene()
    assert leave_out(QUICK, scene) == []
    scene.hidden_share = 0.0
    assert [(o.field, o.value) for o in leave_out(QUICK, scene)] == [("inpaint.on", False)]
    scene.motion_deg, scene.turn_deg = 2.0, 3.0
    assert [o.field for o in leave_out(QUICK, scene)] == ["pose_network", "sh_degree", "inpaint.on"]
    bare = replace(QUICK, pose_network=False, sh_degree=0, inpaint=InpaintConfig(on=False))
    assert leave_out(bare, scene) == []


def test_profiles_and_the_entry_point():
    spec = method_spec("occfusion")
    assert spec.load(spec.method) is OccFusion
    assert {"smoke", "quick", "paper"} <= set(PROFILES)
    assert (PAPER.mask, PAPER.ssim, PAPER.lpips, PAPER.pixels) == (2.0, 0.1, 0.1, 1e4)
    assert (PAPER.refine.colour, PAPER.refine.mask, PAPER.refine.lpips, PAPER.refine.generated) == (
        2.0,
        0.1,
        0.2,
        0.1,
    )
    released = replace(PAPER, inpaint=InpaintConfig(backbone="sd2", weights="somewhere"))
    score, painting = released.settled_score(), released.inpaint.settled()
    assert (score.weight, score.picture, score.context, score.size) == (20.0, "silhouette", "nothing", 256)
    assert (painting.mask_steps, painting.steps, painting.guidance) == (15, 35, 7.5)
    assert (painting.control, painting.guess) == (0.3, True)
    assert PAPER.score.guidance == 0
    assert outside_files(replace(PAPER, lpips=0.0, refine=RefineConfig(lpips=0.0))) == []
