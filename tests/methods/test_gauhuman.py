"""GauHuman's fit: the acceptance checks of its schedule, its losses and its failure; resume, and bad input."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.big_pose.fitting import pixel_size, rates
from ihbench.fit.big_pose.target import BLACK, Target, box_loss, prepare_target
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.fit.gaussians.neighbours import distance_to
from ihbench.methods.gauhuman.config import (
    OCCGAUHUMAN_PROFILES,
    OCCLUDED,
    PAPER,
    QUICK,
    SMOKE,
    GauHumanConfig,
    leave_out,
)
from ihbench.methods.gauhuman.fitting import GauHumanFit, density
from ihbench.methods.gauhuman.method import GauHuman
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import MaskState
from ihbench.scene.method_spec import method_spec
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view

from .tiny_fit import SIZE, STRIP, equal_bits, everything, training_set, training_views
from .tiny_gaussians import TINY, SavesAt, an_avatar, events, fitted, killed_after

BODY = the_body()


@cache
def whole(**changes):
    """What a fit to all views ends with, and its degree."""
    avatar = fitted(training_set(training_views()), **changes)
    return everything(avatar), avatar.degree


# ------------------------------------------------------------------------------------------ check 5: the schedule


def learning_rates(fit):
    return {group["name"]: group["lr"] for group in fit.density.adam.optimizer.param_groups}


class Listed(GauHumanFit):
    """Of few Gaussians, with a loss that costs nothing; notes the degree and position rate of every step."""

    def __init__(self, config, background):
        avatar = an_avatar(**vars(config) | {"nearest_every": 1000, "weight_network": False})
        own = avatar.gaussians
        few = {name: p.detach()[::300] for name, p in own.attributes.items()}
        first = [few.pop(name) for name in ("means", "log_scales", "quaternions", "opacity_logits")]
        avatar.gaussians = Gaussians(*first, few, {"vertex": own.carried("vertex")[::300]})
        self.degrees, self.position_rates = [], []
        super().__init__(avatar, training_set(training_views()[:1], background), 0, Ledger())

    def _loss(self, k):
        self.degrees.append(self.avatar.degree)
        self.position_rates.append(learning_rates(self)["means"])
        return 1.0 - 1e-9 * self.avatar.gaussians.opacities.sum()  # none is pruned


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_check_5_events_of_the_released_schedule(background):
    fit = Listed(replace(PAPER, lpips=0.0), background)
    fit.run(Progress.silent())
    happened = events(fit.ledger)
    assert [event["step"] for event in happened if event["step"] != 400] == [500, 600, 700, 800, 900]
    assert [event["step"] for event in happened if event["reset"]] == ([400] if background == WHITE else [])
    degrees = fit.degrees[:1200]  # the last is the guard's look at the end
    assert (degrees.index(1) + 1, max(degrees)) == (1000, 1)
    assert fit.position_rates[-1] == pytest.approx(1.331e-4, rel=1e-3)
    assert rates(PAPER)["means"].at(1200) == pytest.approx(1.331e-4, rel=1e-3)


def test_small_means_a_pixel_where_pixels_are_large(views):
    training = training_set(views)
    camera = views[0].camera
    depth = camera.to_camera(BODY.posed_joints(views[0].body_pose)[0])[2]
    assert pixel_size(training) == pytest.approx(depth / camera.K[0, 0], rel=0.05)
    assert density(PAPER, training, WHITE).size == 0.01
    assert density(QUICK, training, WHITE).size == pixel_size(training) > 0.01


# ------------------------------------------------------------------------------------- check 6: the two-label law


def a_patch_after(hidden, kappa, mask_only):
    """Alpha of one wide Gaussian, which is its opacity, where a share `hidden` of the views calls it background and
    the others see it `kappa` brighter than the black behind it. All views in each step."""
    size = 8
    camera = replace(a_camera(0.0, size), R=np.eye(3), t=np.array([0, 0, 1.0]))
    mean, scale, colour = torch.zeros(1, 3), torch.full((1,), 50.0), torch.full((1, 3), kappa)
    logit = torch.zeros(1, requires_grad=True)
    ones = torch.ones(size, size, 1)
    nowhere: Any = None  # no frame: nothing is posed

    def target(seen):
        image, person = ones.expand(-1, -1, 3) * (kappa * seen), ones * seen
        return Target(
            camera, size, size, nowhere, image, person, ones * (not mask_only), ones, 0 * ones, 0 * ones
        )  # fmt: skip

    shares, config = {0.0: hidden, 1.0: 1 - hidden}, replace(TINY, ssim=0.0)
    optimizer = torch.optim.Adam([logit], lr=0.2)
    for step in range(150):
        rgb, alpha = render_gaussians(mean, scale, colour, camera, BLACK, opacities=logit.sigmoid(), preset="3dgs")
        optimizer.zero_grad()
        sum(share * box_loss(rgb, alpha, target(seen), config) for seen, share in shares.items()).backward()
        optimizer.param_groups[0]["lr"] = 0.2 * 0.98**step
        optimizer.step()
    return logit.sigmoid().item()


@pytest.mark.parametrize("hidden", [0.2, 0.4, 0.6, 0.8])
def test_check_6_the_two_label_law(hidden):
    """The mask alone: alpha is the share of person labels. With the L1: α* = clip((1-h) - 5κ(2h-1), 0, 1)."""
    assert a_patch_after(hidden, 0.3, mask_only=True) == pytest.approx(1 - hidden, abs=0.05)
    expected = np.clip((1 - hidden) - 5 * 0.3 * (2 * hidden - 1), 0, 1)
    assert a_patch_after(hidden, 0.3, mask_only=False) == pytest.approx(expected, abs=0.05)


# ------------------------------------------------------------------------------------------- check 7: blindness


def relabelled(views, old, new):
    return [replace(view, mask=np.where(view.mask == old, new, view.mask).astype(np.uint8)) for view in views]


def test_check_7_an_unknown_pixel_is_background(views):
    """To the bit; with `unknown=ignore` it is not."""
    known = relabelled(views, MaskState.UNKNOWN, MaskState.BACKGROUND)
    for changes, same in (({}, True), ({"unknown": "ignore"}, False)):
        one, other = (fitted(training_set(some), steps=7, **changes) for some in (views, known))
        assert equal_bits(everything(one), everything(other)) == same


def gradients(avatar, target, config):
    posed = avatar.posed(target.frame)
    rgb, alpha = render_gaussians(
        posed.means, avatar.covariances(posed), avatar.sh, target.camera, WHITE,
        opacities=avatar.gaussians.opacities, sh_degree=0, preset="3dgs",
    )  # fmt: skip
    return torch.autograd.grad(box_loss(rgb, alpha, target, config), [rgb, alpha], allow_unused=True)


@pytest.mark.parametrize("change", [{"unknown": "ignore"}, OCCLUDED], ids=["ignore", "occgauhuman"])
def test_no_colour_is_compared_where_nothing_is_known(views, change):
    """Also not through the windows of the SSIM."""
    avatar = an_avatar(**change)
    target = prepare_target(avatar, views[1], WHITE)
    of_colour, of_alpha = gradients(avatar, target, replace(avatar.config, ssim=5.0))
    x0, y0, width, height = window_of(views[1])
    unknown = torch.from_numpy(views[1].mask[y0 : y0 + height, x0 : x0 + width] == MaskState.UNKNOWN)
    assert unknown.sum() > 50
    assert not of_colour[unknown].any()
    held = change == OCCLUDED
    assert bool(of_alpha[unknown].any()) == held, "alpha is held to the silhouette there if that is complete"
    assert of_colour[~unknown].any()
    assert of_alpha[~unknown].any()


def window_of(view):
    from ihbench.fit.body_box import body_box

    return body_box(view.camera, BODY.pose(view.body_pose)).window


def test_the_complete_silhouette_is_the_body_where_pixels_are_hidden(views):
    truth = train_view(views[1].camera, views[1].body_pose)
    avatar = an_avatar(silhouette="complete")
    target = prepare_target(avatar, views[1], WHITE)
    x0, y0, width, height = window_of(views[1])
    cut = np.s_[y0 : y0 + height, x0 : x0 + width]
    person = target.person[..., 0].numpy() > 0
    known = views[1].mask[cut] != MaskState.UNKNOWN
    assert np.array_equal(person[known], (views[1].mask[cut] == MaskState.PERSON)[known])
    whole = truth.mask[cut] == MaskState.PERSON
    assert (person & whole).sum() / (person | whole).sum() > 0.95
    without = prepare_target(an_avatar(), views[1], WHITE)
    assert not without.person[..., 0].numpy()[~known].any()


def test_the_loss_is_the_sum_of_its_terms(views):
    """Restated over the pixels of the box."""
    config = replace(TINY, mask=0.3, ssim=0.0)
    avatar = an_avatar(mask=0.3, ssim=0.0)
    view = views[1]
    rgb, alpha = avatar.render(view.camera, view.body_pose)
    target = prepare_target(avatar, view, WHITE)
    x0, y0, width, height = window_of(view)
    cut = np.s_[y0 : y0 + height, x0 : x0 + width]
    box = target.colours[..., 0].numpy() > 0
    image = np.where((view.mask == MaskState.PERSON)[..., None], view.image / 255, 1.0)[cut]
    error = np.abs(rgb[cut] - image)[box].mean()
    wrong = ((alpha[cut] - (view.mask[cut] == MaskState.PERSON)) ** 2)[box].mean()
    got = box_loss(torch.from_numpy(rgb[cut]), torch.from_numpy(alpha[cut]), target, config)
    assert got.item() == pytest.approx(error + 0.3 * wrong, rel=1e-4)
    assert 0.3 < box.mean() <= 1
    assert (view.mask[cut] == MaskState.PERSON)[box].sum() == (view.mask == MaskState.PERSON).sum()


def test_on_black_nothing_of_the_white_studio_is_left(views):
    target = prepare_target(an_avatar(backdrop="black"), views[1], BLACK)
    assert not target.image[target.person[..., 0] == 0].any()


# ------------------------------------------------------------------------------------------ check 8: the signature


def test_check_8_what_the_strip_hides_turns_transparent():
    """Hidden in every frame but one: alpha there falls far below that of the fit without the strip, and of
    OccGauHuman; the number of Gaussians stays within 3 times its start and all stay near."""
    frames = range(6)
    hidden = [train_view(a_camera(0.0, SIZE), a_pose(0.3 * k), STRIP if k else None, frame=k) for k in frames]
    clear = [train_view(view.camera, view.body_pose) for view in hidden]
    alpha, counts = {}, []
    for name, some, changes in (
        ("strip", hidden, {}), ("clear", clear, {}), ("complete", hidden, OCCLUDED),
    ):  # fmt: skip
        avatar = fitted(training_set(some), steps=30, **changes | {"white_reset": 0, "lr_opacity": 0.4})
        side = a_camera(0.0, SIZE), a_pose(0.75)
        truth = train_view(*side)
        person = (truth.mask == MaskState.PERSON) & (np.arange(SIZE) >= STRIP.start) & (np.arange(SIZE) < STRIP.stop)
        alpha[name] = avatar.render(*side)[1][person].mean()
        counts.append(len(avatar))
    assert alpha["strip"] < 0.5, alpha
    assert min(alpha["clear"], alpha["complete"]) > alpha["strip"] + 0.3, alpha
    assert all(count <= 3 * len(BODY.v_template) for count in counts)


def test_check_8_no_centre_is_far_from_the_body_after_a_change(views):
    fit = GauHumanFit(an_avatar(lr_position=0.02, white_reset=0), training_set(views), 0, Ledger())
    farthest = {}
    rearranged = fit._rearranged

    def look(changed):
        rearranged(changed)
        farthest[changed.step] = distance_to(fit.avatar.gaussians.means, fit.avatar.deformation.vertices)[0].max()

    fit._rearranged = look
    fit.run(Progress.silent())
    assert sorted(farthest) == [6, 9]
    assert all(distance <= 0.05 for distance in farthest.values())
    assert any(event["pruned"] > event["faint"] for event in events(fit.ledger)), "nothing was far: no test"


# ---------------------------------------------------------------------------------------------------- fitting


def test_a_short_fit_looks_like_the_person(views):
    clear = [train_view(view.camera, view.body_pose) for view in views]
    before, after = an_avatar(), fitted(training_set(clear), steps=40, white_reset=0, lr_opacity=0.3, lr_colour=0.05)
    for view in clear[::2]:
        person = view.mask == MaskState.PERSON
        error = [
            np.square(a.render(view.camera, view.body_pose)[0] - view.image / 255)[person].mean()
            for a in (before, after)
        ]
        assert error[1] < 0.4 * error[0]


def test_the_density_changes_and_new_gaussians_have_their_vertex(views):
    ledger = Ledger()
    avatar = fitted(training_set(views), ledger=ledger, white_reset=0, least_px=0.0)
    happened = events(ledger)
    assert [event["step"] for event in happened] == [6, 9]
    assert all(event["split"] > 100 for event in happened)
    assert len(avatar) == happened[-1]["count"] != len(BODY.v_template)
    steps_since = avatar.config.steps - 9
    assert steps_since < avatar.config.nearest_every, "the vertices are those of the last change or refresh"
    distance = torch.cdist(avatar.gaussians.means.detach(), avatar.deformation.vertices).min(1).values
    own = (avatar.gaussians.means - avatar.deformation.vertices[avatar.gaussians.carried("vertex")]).norm(dim=1)
    assert (own - distance).max() < 0.01


def test_the_same_seed_gives_the_same_bits_and_another_another(views):
    assert equal_bits(everything(fitted(training_set(views), weight_network=True)), whole(weight_network=True)[0])
    assert not equal_bits(
        everything(fitted(training_set(views), 1, steps=7)), everything(fitted(training_set(views), steps=7))
    )


@pytest.mark.parametrize(("saved", "killed"), [(2, 5), (6, 8), (7, 10), (10, 11)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(views, saved, killed):
    """Saved before, between and after the changes of the set at 6 and 9."""
    training, on = training_set(views), ({"weight_network": True} if saved == 7 else {})
    ledger = SavesAt(saved)
    killed_after(GauHumanFit(an_avatar(**on), training, 0, ledger), killed)
    resumed = fitted(training, ledger=ledger, **on)
    bits, degree = whole(**on)
    assert equal_bits(bits, everything(resumed))
    assert degree == resumed.degree
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]


def test_the_guard_goes_back_over_a_change_of_the_set(views, monkeypatch):
    """A loss that is not finite once, after a change: the fit goes back to before it, and ends well."""
    monkeypatch.setattr("ihbench.fit.optimisation.GOOD_EVERY", 5)
    ledger = Ledger()
    fit = GauHumanFit(an_avatar(white_reset=0), training_set(views), 0, ledger)
    loss, calls = fit._loss, []

    def spoiled(k):
        calls.append(k)
        return loss(k) * (np.nan if len(calls) == 8 else 1)

    fit._loss = spoiled
    fit.run(Progress.silent())
    (back,) = events(ledger, "rolled_back")
    assert (back["step"], back["bad_step"]) == (5, 7)
    assert [event["step"] for event in events(ledger)] == [6, 6, 9]
    assert learning_rates(fit)["means"] == pytest.approx(0.1 * rates(TINY)["means"].at(12))
    assert all(p.isfinite().all() for p in fit.avatar.parameters())


def test_the_method_reports_its_stages_and_offers_its_avatar(views):
    offered = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append((step, avatar)))
    avatar = GauHuman(TINY).fit(training_set(views), device="cpu", seed=0, ledger=ledger, progress=Progress.silent())
    assert {"fit", "fit/prepare", "fit/gaussians"} <= {row["stage"] for row in ledger.table()}
    assert offered[-1] == (TINY.steps, avatar)
    assert equal_bits(everything(avatar), whole()[0])


def test_lpips_without_its_weights_is_off_and_said_so(views, monkeypatch):
    monkeypatch.setattr("ihbench.fit.big_pose.fitting.perceptual", lambda net, device: f"no weights of {net}")
    ledger = Ledger()
    avatar = fitted(training_set(views), ledger=ledger, lpips=0.01)
    assert events(ledger, "left_out") == [{"what": "lpips term", "reason": "no weights of vgg"}]
    assert equal_bits(everything(avatar), whole()[0])


# --------------------------------------------------------------------------------------------------- bad input


def fit_of(views, **changes):
    return GauHuman(replace(TINY, **changes)).fit(
        training_set(views), device="cpu", seed=0, ledger=Ledger(), progress=Progress.silent()
    )


@pytest.mark.parametrize("change", [{}, {"unknown": "ignore"}, OCCLUDED], ids=["released", "ignore", "occgauhuman"])
def test_frames_without_a_person_and_bodies_beside_the_image_do_not_harm(views, change):
    blank = replace(views[1], mask=np.full_like(views[1].mask, MaskState.UNKNOWN))
    beside = replace(views[2], body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(views[4], body_pose=a_pose(transl=(0, 0, 9)))
    avatar = fit_of([views[0], blank, beside, behind], **change)
    assert all(p.isfinite().all() for p in avatar.parameters())
    assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.005


def test_one_frame_is_enough(views):
    avatar = fit_of(views[:1])
    assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.005


def test_a_nan_pixel_is_a_divergence_with_its_first_step(views):
    image = views[0].image.astype(np.float32)
    image[views[0].mask == MaskState.PERSON] = np.nan
    with pytest.raises(Diverged, match="loss is nan") as caught:
        fit_of([replace(views[0], image=image)])
    assert caught.value.step == 0


def test_a_nan_behind_the_occluder_is_nobodys_business(views):
    image = views[1].image.astype(np.float32)
    image[views[1].mask == MaskState.UNKNOWN] = np.nan
    one, other = (fit_of([view]) for view in (replace(views[1], image=image), views[1]))
    assert equal_bits(everything(one), everything(other))


def test_pruning_every_gaussian_is_a_divergence(views):
    """No picture of nothing."""
    with pytest.raises(Diverged, match="would prune all of"):
        fit_of(views, density=replace(TINY.density, faint=1.0))


def test_shapes_may_differ_by_frame(views):
    betas = [np.array([b, 0.0]) for b in (-1.0, 1.0)]
    some = [replace(v, body_pose=replace(v.body_pose, betas=b)) for v, b in zip(views[:2], betas, strict=True)]
    avatar = fit_of(some)
    areas = [avatar.render(views[0].camera, v.body_pose)[1].sum() for v in some]
    assert areas[0] != areas[1]


def test_every_part_can_be_left_out(views):
    off = {"pose_network": False, "weight_network": False, "sh_degree": 0, "ssim": 0.0, "mask": 0.0}
    avatar = fit_of(views, **off)
    assert not {"pose_correction", "weight_offsets"} & {name.split(".")[0] for name, _ in avatar.named_parameters()}


# -------------------------------------------------------------------------------------------------------- plan


class Scene:
    """A `SceneMeasure` of which the plan reads these."""

    motion_deg, turn_deg, hidden_share = 40.0, 300.0, 0.2


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = Scene()
    base, occluded = QUICK, OCCGAUHUMAN_PROFILES["quick"]
    assert leave_out(base, scene) == leave_out(occluded, scene) == []
    scene.motion_deg = 2.0
    assert [o.field for o in leave_out(base, scene)] == ["pose_network"]
    scene.turn_deg = 3.0
    assert [(o.field, o.value) for o in leave_out(base, scene)] == [("pose_network", False), ("sh_degree", 0)]
    assert leave_out(replace(base, pose_network=False, sh_degree=0), scene) == []
    scene.hidden_share = 0.0
    assert [o.field for o in leave_out(occluded, scene)][-1] == "silhouette"


def test_both_names_are_registered_and_say_what_they_are():
    for name in ("gauhuman", "occgauhuman"):
        spec = method_spec(name)
        assert spec.load(spec.method) is GauHuman
        assert {"smoke", "quick", "paper"} <= set(spec.load(spec.profiles, dict))
    assert method_spec("gauhuman").profile("smoke") is SMOKE
    assert isinstance(method_spec("occgauhuman").profile("paper"), GauHumanConfig)
    assert method_spec("occgauhuman").profile("paper").lpips == 0.1
