"""3DGS-Avatar's fit: the acceptance checks of its schedule, its losses and its failure; resume, and bad input."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.gaussians.adam import GaussianAdam, Rate
from ihbench.fit.gaussians.density import DensityControl
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.methods.three_dgs_avatar.config import PAPER, PROFILES, QUICK, SMOKE, leave_out
from ihbench.methods.three_dgs_avatar.fitting import ThreeDgsAvatarFit, rates, skinning_weight
from ihbench.methods.three_dgs_avatar.method import ThreeDgsAvatarMethod
from ihbench.methods.three_dgs_avatar.stress import TINY, start
from ihbench.methods.three_dgs_avatar.target import BLACK, Target, image_loss, perceptual_loss, prepare_target
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import MaskState
from ihbench.scene.method_spec import method_spec
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view

from .tiny_fit import SIZE, STRIP, equal_bits, everything, training_set, training_views
from .tiny_gaussians import SavesAt, events, killed_after

BODY = the_body()
# Gaussians join in step 2, the deformation in 4, poses in 7; the set changes after 9
SMALL = replace(
    TINY,
    points=300,
    steps=12,
    non_rigid_from=4,
    poses_from=7,
    neighbours_every=4,
    density=replace(TINY.density, after=6, before=12, every=9),
)


def a_fit(training, seed=0, ledger=None, **changes):
    avatar = start(replace(SMALL, **changes), training)
    return ThreeDgsAvatarFit(avatar, training, seed, ledger or Ledger())


def fitted(training, seed=0, ledger=None, **changes):
    fit = a_fit(training, seed, ledger, **changes)
    fit.run(Progress.silent())
    return fit.avatar


@cache
def whole():
    """What a fit to all views ends with."""
    ledger = Ledger()
    return everything(fitted(training_set(training_views()), ledger=ledger)), ledger


# ------------------------------------------------------------------------------------------ check 5: who joins when


def test_check_5_gaussians_deformation_and_poses_join_one_after_the_other(views):
    """Gaussians are the same to the bit before their first step and change in it; poses likewise; codes come with the
    non-rigid deformation. Networks and latent codes learn from the first step."""
    assert (PAPER.gaussians_from, PAPER.non_rigid_from, PAPER.poses_from) == (1000, 3000, 5000)
    fit = a_fit(training_set(views), steps=7, gaussians_from=3, non_rigid_from=5, poses_from=6)
    states, codes, posed = [everything(fit.avatar)], [], fit.avatar.posed

    def watched(frame, noise=None):
        out = posed(frame, noise)
        codes.append(out.codes is not None)
        return out

    fit.avatar.posed = watched
    update = fit._update

    def noted():
        update()
        states.append(everything(fit.avatar))

    fit._update = noted
    fit.run(Progress.silent())
    changed = {
        part: [
            step
            for step in range(1, 8)
            if any(
                not torch.equal(states[step][n], states[step - 1][n])
                for n in states[0]
                if n.startswith(part) and "carried" not in n
            )
        ]
        for part in ("gaussians", "non_rigid", "poses", "skinning", "colours", "latents")
    }
    assert changed["gaussians"] == [3, 4, 5, 6, 7]
    assert changed["non_rigid"] == [5, 6, 7]
    assert changed["poses"] == [6, 7]
    assert changed["skinning"] == changed["colours"] == changed["latents"] == list(range(1, 8))
    assert codes == [False] * 4 + [True] * 4  # the last is the guard's look at the end


# --------------------------------------------------------------------------------------------- check 6: schedules


def test_check_6_weights_and_rates():
    assert [skinning_weight(PAPER, number) for number in (1, 999, 1000, 15_000)] == [10, 10, 0.1, 0.1]
    assert rates(PAPER)["means"].at(0) == pytest.approx(5.55e-4, rel=1e-3)
    assert rates(PAPER)["means"].at(15_000) == pytest.approx(5.55e-5, rel=1e-3)
    density = PAPER.density
    changes = [step for step in range(1, 15_001) if density.changes_at(step)]
    assert (changes[0], changes[-1], len(changes)) == (1100, 9900, 89)
    assert density.resets == (3000, 6000, 9000)
    assert (density.faint, density.size, density.largest) == pytest.approx((0.05, 0.0347, 0.347), rel=1e-2)


def test_check_6_network_rates_fall_to_a_tenth_and_gradients_are_clipped_together(views):
    fit = a_fit(training_set(views), clip=0.1, latent_decay=0.0)
    norms, first = [], {}
    update = fit._update

    def noted():
        learned = [p for group in fit.optimizer.param_groups for p in group["params"] if p.grad is not None]
        norms.append(torch.stack([p.grad.norm() for p in learned]).norm().item())
        first.setdefault(0, [group["lr"] for group in fit.optimizer.param_groups])
        update()

    fit._update = noted
    fit.run(Progress.silent())
    assert len(norms) == SMALL.steps
    assert max(norms) <= 0.1 * (1 + 1e-5)
    assert max(norms) == pytest.approx(0.1, rel=1e-4), "nothing was clipped: no test"
    assert fit._rate_share() == pytest.approx(0.1)
    assert first[0] == fit.rates == [SMALL.lr_skinning, SMALL.lr_colour, SMALL.lr_non_rigid, SMALL.lr_poses]


def test_latent_codes_without_a_gradient_shrink_by_about_a_rate_a_step(views):
    """Through Adam, whatever their size: the decay is no share of them."""
    training = training_set(views)
    fit = a_fit(training, steps=6, lr_colour=0.01)
    before = fit.avatar.latents.detach().clone()
    visited = {fit._view_of(step, 6) for step in range(2)}
    for step in range(2):
        fit._one_step(fit._view_of(step, 6))
        fit.step += 1
    others = [row for row in range(6) if row not in visited]
    moved = (before - fit.avatar.latents.detach())[others] * before[others].sign()
    assert moved.median().item() == pytest.approx(0.01 * (1 + 0.1 ** (1 / 6)), rel=0.02)


# ------------------------------------------------------------------------------------- check 7: alpha, background


def test_check_7_alpha_and_the_mask_loss_do_not_see_the_background(views):
    view = views[1]
    alphas, losses = [], []
    for background in (BLACK, WHITE):
        fit = a_fit(training_set([view], background))
        avatar, target = fit.avatar, fit._targets[0]
        alphas.append(avatar.render(view.camera, view.body_pose, background)[1])
        rgb, alpha = (torch.from_numpy(x) for x in avatar.render(view.camera, view.body_pose, background))
        losses.append(image_loss(rgb, alpha, target, replace(SMALL, l1=0.0)).item())
        assert (target.image[target.person == 0] == torch.tensor(background)).all()
    assert np.array_equal(*alphas)
    assert losses[0] == losses[1] > 0


def test_the_loss_is_the_sum_of_its_terms(views):
    view, config = views[1], replace(SMALL, l1=0.7, mask=0.3)
    fit = a_fit(training_set([view]), l1=0.7, mask=0.3)
    rgb, alpha = fit.avatar.render(view.camera, view.body_pose)
    person = view.mask == MaskState.PERSON
    image = np.where(person[..., None], view.image / 255, 1.0)
    expected = 0.7 * np.abs(rgb - image).mean() + 0.3 * np.abs(alpha - person).mean()
    both = torch.from_numpy(rgb), torch.from_numpy(alpha)
    assert image_loss(*both, fit._targets[0], config).item() == pytest.approx(expected, rel=1e-5)
    ignoring = prepare_target(view, 0, WHITE, replace(config, unknown="ignore"), torch.device("cpu"))
    known = view.mask != MaskState.UNKNOWN
    expected = 0.7 * np.abs(rgb - image)[known].mean() + 0.3 * np.abs(alpha - person)[known].mean()
    assert not known.all()
    assert image_loss(*both, ignoring, config).item() == pytest.approx(expected, rel=1e-5)


def test_the_whole_loss_has_every_regulariser(views):
    """Each term alone, by switching the others off, adds up to all of them."""
    training = training_set(views[:1])

    def loss(**changes):
        off = {"l1": 0.0, "mask": 0.0, "skinning": 0.0, "skinning_first": 0.0, "isometry": 0.0, "isometry_shape": 0.0}
        fit = a_fit(training, gaussians_from=1, **(off | changes))
        fit.step = 1
        fit.avatar.step = 2
        fit._find_neighbours()
        with torch.no_grad():
            return fit._loss(0).item()

    parts = {"l1": 1.0, "mask": 0.1, "skinning": 0.1, "isometry": 1.0, "isometry_shape": 100.0}
    alone = {name: loss(**{name: weight}) for name, weight in parts.items()}
    assert all(value > 0 for value in alone.values()), alone
    assert loss(**parts) == pytest.approx(sum(alone.values()), rel=1e-5)


# ------------------------------------------------------------------------------- check 8: reset, prune, the hole


def left_after(hidden, evidence=True, gap=100):
    """Two wide Gaussians side by side, opaque and reset at step `gap`: the steps until both are above the pruning
    limit again, None for never, and how many are left at twice that. The left one is behind a strip in a share
    `hidden` of the views."""
    size = 12
    camera = replace(a_camera(0.0, size), R=np.eye(3), t=np.zeros(3))
    means, turns = torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    gaussians = Gaussians(means, torch.full((2, 3), np.log(0.15)), turns, torch.full((2,), 2.0))
    colours = torch.tensor([[0.2, 0.5, 0.3], [0.7, 0.1, 0.4]])

    def drawn(opacities):
        own = gaussians.means, gaussians.scales, colours, camera, WHITE
        return render_gaussians(*own, quaternions=gaussians.quaternions, opacities=opacities, preset="3dgs")

    with torch.no_grad():
        image, alpha = drawn(torch.ones(2))
    person, left = alpha > 0.4, torch.arange(size)[None, :] < size / 2
    shown = []
    for visible in (person, person & ~left):
        painted = torch.where(visible[..., None], image, torch.ones(3))
        shown.append(Target(camera, 0, painted, visible.float(), None, None))
    still = {name: Rate(0.0) for name in ("means", "log_scales", "quaternions")}
    adam = GaussianAdam(gaussians, still | {"opacity_logits": rates(PAPER)["opacity_logits"]})
    density = replace(
        PAPER.density, after=gap, before=2 * gap + 1, every=gap, resets=(gap,), clone="off", split=False
    )
    control, back = DensityControl(adam, density, 0), None
    for step in range(1, 2 * gap + 1):
        rgb, alpha = drawn(gaussians.opacities)
        adam.zero_grad()
        image_loss(rgb, alpha, shown[(step * 7) % 10 < 10 * hidden], PAPER).backward()
        if not evidence and step > gap:
            gaussians.opacity_logits.grad[0] = 0
        control.after_step(step)
        adam.step(step)
        if back is None and step > gap and bool((gaussians.opacities > 0.05).all()):
            back = step - gap
    return back, len(gaussians)


def test_check_8_a_supported_gaussian_comes_back_and_one_without_evidence_is_gone():
    back, left = left_after(0.0)
    assert left == 2
    assert 7 <= back <= 33
    assert left_after(0.0, evidence=False)[1] == 1


@pytest.mark.parametrize(("hidden", "left"), [(0.2, 2), (0.8, 1)])
def test_check_8_the_majority_of_the_frames_decides(hidden, left):
    """L1 takes a side: hidden in a fifth of the frames the patch survives the reset, in four fifths it is cut out."""
    assert left_after(hidden)[1] == left


SIDE = a_camera(0.0, SIZE), a_pose(0.75)


@cache
def longer(hidden):
    """A fit to a turning person, with a reset and a change after it, without the strip or with it in every frame but
    the first; and the views."""
    strips = [STRIP if hidden and k else None for k in range(6)]
    views = [train_view(a_camera(0.0, SIZE), a_pose(0.3 * k), strip, frame=k) for k, strip in enumerate(strips)]
    avatar = fitted(
        training_set(views),
        steps=45,
        points=600,
        warm_up=150,
        lr_warm_up=4e-3,
        lr_feature=0.05,
        lr_colour=0.02,
        density=replace(SMALL.density, after=20, before=45, every=14, resets=(28,)),
    )
    return avatar, views


def test_check_8_the_signature_of_the_strip():
    """Hardly a Gaussian is left where the strip hides the person in most frames, and nothing is drawn there. Without
    the strip it is, and beside the strip more than there."""
    truth = train_view(*SIDE)
    person, behind = truth.mask == MaskState.PERSON, (np.arange(SIZE) >= STRIP.start) & (np.arange(SIZE) < STRIP.stop)
    strip, clear = (longer(hidden)[0].render(*SIDE)[1] for hidden in (True, False))
    assert strip[person & behind].mean() < 0.1
    assert strip[person & ~behind].mean() > 0.3
    assert clear[person].mean() > 0.6
    assert 3 * len(longer(True)[0]) < len(longer(False)[0])


def test_a_short_fit_looks_like_the_person():
    avatar, views = longer(False)
    before = start(avatar.config, training_set(views))
    for view in views[::2]:
        person = view.mask == MaskState.PERSON
        error = [
            np.square(a.render(view.camera, view.body_pose, frame=view.frame)[0] - view.image / 255)[person].mean()
            for a in (before, avatar)
        ]
        assert error[1] < 0.3 * error[0]


# ---------------------------------------------------------------------------------------------------- fitting


def relabelled(views, old, new):
    return [replace(view, mask=np.where(view.mask == old, new, view.mask).astype(np.uint8)) for view in views]


def test_an_unknown_pixel_is_background(views):
    """To the bit; with `unknown=ignore` it is not."""
    known = training_set(relabelled(views, MaskState.UNKNOWN, MaskState.BACKGROUND))
    assert equal_bits(everything(fitted(known)), whole()[0])
    some = {"steps": 4, "gaussians_from": 1}
    ignoring = [everything(fitted(t, unknown="ignore", **some)) for t in (known, training_set(views))]
    assert not equal_bits(*ignoring)


def test_the_set_changes_and_the_ledger_says_so(views):
    bits, ledger = whole()
    happened = events(ledger)
    assert [event["step"] for event in happened] == [9]
    assert happened[-1]["count"] == len(bits["gaussians.attributes.means"]) != SMALL.points
    assert bits["gaussians.carried_nearest"].max() < happened[-1]["count"]
    (refined,) = events(ledger, "poses_refined")
    assert refined["frames"] == 6
    assert 0 < refined["mean_deg"] < 1


def test_the_same_seed_gives_the_same_bits_and_another_another(views):
    some = [everything(fitted(training_set(views), seed, steps=4)) for seed in (0, 0, 1)]
    assert equal_bits(*some[:2])
    assert not equal_bits(*some[1:])


@pytest.mark.parametrize(("saved", "killed"), [(1, 2), (5, 6), (8, 10), (10, 11)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(views, saved, killed):
    """Saved before Gaussians join, after the deformation, after poses and before the change, and after it: always
    between two searches for neighbours."""
    training, ledger = training_set(views), SavesAt(saved)
    killed_after(a_fit(training, ledger=ledger), killed)
    resumed = fitted(training, ledger=ledger)
    assert equal_bits(whole()[0], everything(resumed))
    assert resumed.step == SMALL.steps
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]


def test_ignoring_is_resumed_to_the_bit_too(views):
    training, ledger = training_set(views), SavesAt(7)
    some = {"unknown": "ignore", "steps": 10, "points": 200}
    killed_after(a_fit(training, ledger=ledger, **some), 8)
    resumed = fitted(training, ledger=ledger, **some)
    assert resumed.gaussians.carried("seen").any()
    assert equal_bits(everything(fitted(training, **some)), everything(resumed))


def test_the_guard_goes_back_over_a_change_of_the_set(views, monkeypatch):
    """A loss that is not finite once, after a change: the fit goes back to before it, and ends well."""
    monkeypatch.setattr("ihbench.fit.optimisation.GOOD_EVERY", 8)
    ledger = Ledger()
    fit = a_fit(training_set(views), ledger=ledger)
    loss, calls = fit._loss, []

    def spoiled(k):
        calls.append(k)
        return loss(k) * (np.nan if len(calls) == 11 else 1)

    fit._loss = spoiled
    fit.run(Progress.silent())
    (back,) = events(ledger, "rolled_back")
    assert (back["step"], back["bad_step"]) == (8, 10)
    assert [event["step"] for event in events(ledger)] == [9, 9]
    assert all(p.isfinite().all() for p in fit.avatar.parameters())


def test_the_method_reports_its_stages_and_offers_its_avatar(views):
    offered = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append((step, avatar)))
    avatar = ThreeDgsAvatarMethod(SMALL).fit(
        training_set(views), device="cpu", seed=0, ledger=ledger, progress=Progress.silent()
    )
    assert {"fit", "fit/prepare", "fit/gaussians"} <= {row["stage"] for row in ledger.table()}
    assert offered[-1] == (SMALL.steps, avatar)
    assert equal_bits(everything(avatar), whole()[0])


# ------------------------------------------------------------------------------------------------------- lpips


def test_lpips_without_its_weights_is_off_and_said_so(views, monkeypatch):
    monkeypatch.setattr(
        "ihbench.methods.three_dgs_avatar.fitting.perceptual", lambda net, device: f"no weights of {net}"
    )
    ledger = Ledger()
    avatar = fitted(training_set(views), ledger=ledger, lpips=0.01)
    assert events(ledger, "left_out") == [{"what": "lpips term", "reason": "no weights of vgg"}]
    assert equal_bits(everything(avatar), whole()[0])


def test_lpips_is_taken_around_the_visible_person_in_some_steps(views, monkeypatch):
    """In windows of the wanted size within the rectangle; never where nobody is visible."""
    sizes = []

    def distance(own, image):
        sizes.append(tuple(own.shape[:2]))
        return (own - image).square().mean()

    monkeypatch.setattr("ihbench.methods.three_dgs_avatar.fitting.perceptual", lambda net, device: distance)
    nobody = replace(views[2], mask=np.full_like(views[2].mask, MaskState.UNKNOWN))
    a_fit(training_set([views[0], nobody]), lpips=0.5, lpips_every=4, lpips_px=9, steps=16).run(Progress.silent())
    assert 1 <= len(sizes) <= 4
    assert set(sizes) == {(9, 9)}
    target = prepare_target(views[0], 0, WHITE, SMALL, torch.device("cpu"))
    assert target.rectangle is not None
    y0, y1, x0, x1 = target.rectangle
    person = views[0].mask == MaskState.PERSON
    assert person[y0:y1, x0:x1].sum() == person.sum()
    assert all(edge.any() for edge in (person[y0], person[y1 - 1], person[:, x0], person[:, x1 - 1]))
    sizes.clear()
    perceptual_loss(torch.zeros(SIZE, SIZE, 3), target, distance, 0, np.random.default_rng(0))
    assert sizes == [(y1 - y0, x1 - x0)]


# --------------------------------------------------------------------------------------------------- bad input


def fit_of(views, ledger=None, **changes):
    return ThreeDgsAvatarMethod(replace(SMALL, **changes)).fit(
        training_set(views), device="cpu", seed=0, ledger=ledger or Ledger(), progress=Progress.silent()
    )


@pytest.mark.parametrize("unknown", ["background", "ignore"])
def test_frames_without_a_person_and_bodies_beside_the_image_do_not_harm(views, unknown):
    blank = replace(views[1], mask=np.full_like(views[1].mask, MaskState.UNKNOWN))
    beside = replace(views[2], body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(views[4], body_pose=a_pose(transl=(0, 0, 9)))
    avatar = fit_of([views[0], blank, beside, behind], unknown=unknown)
    assert all(p.isfinite().all() for p in avatar.parameters())
    assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.005


def test_one_frame_is_enough_and_two_views_of_one_frame_share_its_row(views):
    avatar = fit_of(views[:1])
    assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.005
    assert len(fit_of([views[0], replace(views[2], frame=0)], steps=2).latents) == 1


def test_a_nan_pixel_is_a_divergence_and_one_behind_the_occluder_is_nobodys_business(views):
    image = views[0].image.astype(np.float32)
    image[views[0].mask == MaskState.PERSON] = np.nan
    with pytest.raises(Diverged, match="loss is nan") as caught:
        fit_of([replace(views[0], image=image)])
    assert caught.value.step == 0
    image = views[1].image.astype(np.float32)
    image[views[1].mask == MaskState.UNKNOWN] = np.nan
    for unknown in ("background", "ignore"):
        some = (replace(views[1], image=image), views[1])
        one, other = (fit_of([view], unknown=unknown, steps=2) for view in some)
        assert equal_bits(everything(one), everything(other))


def test_pruning_every_gaussian_is_a_divergence(views):
    """No picture of nothing."""
    with pytest.raises(Diverged, match="would prune all of"):
        fit_of(views, density=replace(SMALL.density, faint=1.0, after=1, every=2))


def test_every_part_can_be_left_out(views):
    off = {"non_rigid": False, "refine_poses": False, "view_colours": False, "mask": 0.0, "isometry": 0.0,
           "isometry_shape": 0.0, "skinning": 0.0, "skinning_first": 0.0, "latent_decay": 0.0}  # fmt: skip
    avatar = fit_of(views, **off)
    assert not {"non_rigid", "poses"} & {name.split(".")[0] for name, _ in avatar.named_parameters()}


# -------------------------------------------------------------------------------------------------------- plan


class Scene:
    """A `SceneMeasure` of which the plan reads these."""

    motion_deg, turn_deg = 40.0, 300.0


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = Scene()
    assert leave_out(QUICK, scene) == []
    scene.motion_deg = 2.0
    assert [(o.field, o.value) for o in leave_out(QUICK, scene)] == [("non_rigid", False)]
    scene.turn_deg = 3.0
    assert [o.field for o in leave_out(QUICK, scene)] == ["non_rigid", "view_colours"]
    assert leave_out(replace(QUICK, non_rigid=False, view_colours=False), scene) == []


def test_it_is_registered_and_its_profiles_keep_the_released_order():
    spec = method_spec("three-dgs-avatar")
    assert spec.load(spec.method) is ThreeDgsAvatarMethod
    assert spec.profile("smoke") is SMOKE
    for profile in PROFILES.values():
        joins = (profile.gaussians_from, profile.non_rigid_from, profile.poses_from, profile.density.before)
        assert [15 * step / profile.steps for step in joins] == pytest.approx([1, 3, 5, 10])
        for reset in profile.density.resets:
            later = [step for step in range(reset + 1, profile.steps) if profile.density.changes_at(step)]
            assert not later or later[0] - reset >= 50
