"""Wild2Avatar's fit: the acceptance checks of its three layers, ablations and drawing; resume, and bad input."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.methods.wild2avatar.config import PAPER, PROFILES, QUICK, leave_out
from ihbench.methods.wild2avatar.fitting import Wild2AvatarFit
from ihbench.methods.wild2avatar.method import Wild2Avatar
from ihbench.methods.wild2avatar.stress import CASES, TINY, begun, start
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scene.method_spec import method_spec
from ihbench.stress.run import run_cases
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body

from .box_before_person import CAMERA, RED, SIZE, boxed_set, shots
from .tiny_fit import equal_bits, everything, training_set, training_views
from .tiny_gaussians import SavesAt, events, killed_after

BODY = the_body()
# the person behind the box, in as few steps as part the layers
BOXED = replace(
    TINY,
    scene="network",
    steps=280,
    rays=64,
    sdf_width=32,
    sdf_depth=3,
    body_fit=400,
    beta=0.001,
    colour_width=32,
    scene_width=64,
    scene_depth=3,
    scene_frequencies=6,
    scene_samples=6,
    refresh_epochs=10,
    completeness=0.15,
    lr=0.01,
    lr_sdf=1e-4,
    lr_beta=1e-5,
)


def fit_to(training, config, seed=0, ledger=None):
    return Wild2Avatar(config).fit(
        training, device="cpu", seed=seed, ledger=ledger or Ledger(), progress=Progress.silent()
    )


@cache
def boxed(hidden=True, **changes):
    """A fit to the person behind the box, or to the same without it."""
    return fit_to(boxed_set(hidden), replace(BOXED, **changes))


@cache
def layers(k, hidden=True, **changes):
    """Each layer of frame k alone: colour and alpha [H, W] of person and occluder, colour of the background; where
    a ray comes near the body or meets the box, 0 elsewhere."""
    avatar, training = boxed(hidden, **changes), boxed_set(hidden)
    fit = Wild2AvatarFit(avatar, training, 0, Ledger())
    target, box = fit._targets[k], torch.from_numpy(shots(hidden)[k].boxed.reshape(-1))
    pixels = ((target.near < target.far) | box).nonzero()[:, 0]
    with torch.no_grad():
        human, occlusion, background = fit._layers(k, target, pixels, None)
    out = {"human": human.alpha, "human_rgb": human.rgb, "background": background.expand(len(pixels), 3)}
    if occlusion is not None:
        out |= {"occluder": occlusion.alpha, "occluder_rgb": occlusion.rgb}
    every = {name: value.new_zeros(SIZE * SIZE, *value.shape[1:]) for name, value in out.items()}
    return {
        name: value.index_copy(0, pixels, out[name]).numpy().reshape(SIZE, SIZE, *value.shape[1:])
        for name, value in every.items()
    }


def overlap(alpha, complete):
    own = alpha > 0.5
    return (own & complete).sum() / (own | complete).sum()


def own_colour(rgb, alpha):
    return rgb / np.maximum(alpha, 1e-3)[..., None]


def red_excess(drawn, truth, where):
    error = (drawn - truth)[where]
    return float((error[:, 0] - error[:, 1:].mean(1)).mean())


def without_the_box(k):
    """[H, W, 3] the person of frame k in full."""
    return shots(False)[k].view.image / 255


BEHIND = [k for k, shot in enumerate(shots()) if shot.boxed.any()]


# ------------------------------------------------------------------------------------------- check 5: three layers


def test_check_5_the_occluders_layer_has_its_colour_where_it_hides_the_person():
    for k in BEHIND:
        shot, own = shots()[k], layers(k)
        hidden = shot.boxed & shot.complete
        assert own["occluder"][hidden].mean() > 0.85
        colour = own_colour(own["occluder_rgb"], own["occluder"])[hidden]
        assert np.abs(colour - RED / 255).mean() < 0.1
        assert own["occluder"][shot.complete & ~shot.boxed].mean() < 0.15


def test_check_5_the_persons_layer_is_complete():
    overlaps = [overlap(layers(k)["human"], shots()[k].complete) for k in BEHIND]
    shown = [overlap(shots()[k].complete & ~shots()[k].boxed, shots()[k].complete) for k in BEHIND]
    assert np.mean(overlaps) >= 0.95, overlaps
    assert np.mean(shown) < 0.85
    for k in BEHIND:
        assert layers(k)["human"][shots()[k].boxed & shots()[k].complete].mean() > 0.9


def test_check_5_the_background_shows_no_box():
    for k in BEHIND:
        shot, own = shots()[k], layers(k)
        for where in (shot.boxed, shot.boxed & shot.complete):
            assert np.abs(own["background"] - shot.wall / 255)[where].mean() < 0.1


# --------------------------------------------------------------------------------------------- check 6: ablations


def test_check_6_without_completeness_the_hidden_body_vanishes():
    """Soon, where the surface learns fast; with the term it stands there, and in the long fit."""
    fast, means = {"lr_sdf": 2e-3, "steps": 80}, []
    for changes in ({}, fast, fast | {"completeness": 0.0}):
        hidden = [layers(k, **changes)["human"][shots()[k].boxed & shots()[k].complete].mean() for k in BEHIND[:2]]
        means.append(np.mean(hidden))
    assert means[0] >= 0.9, means
    assert means[1] > 0.8, means
    assert means[2] < 0.6, means


def test_check_6_without_the_occluders_loss_the_person_is_painted_in_its_colour():
    excess = []
    for changes in ({}, {"occlusion_loss": 0.0, "sparsity": 0.0, "steps": 60}):
        each = []
        for k in BEHIND[:2]:
            own = layers(k, **changes)
            drawn, hidden = own_colour(own["human_rgb"], own["human"]), shots()[k].boxed & shots()[k].complete
            each.append(red_excess(drawn, without_the_box(k), hidden))
        excess.append(np.mean(each))
    assert excess[0] < 0.03, excess
    assert excess[1] > 0.06, excess


# --------------------------------------------------------------------------------------- check 7: nothing is hidden


def test_check_7_with_nothing_hidden_the_layer_is_empty_and_the_fit_is_that_of_two_parts():
    some = {"steps": 90, "lr": 5e-3}
    seen = [layers(k, hidden=False, **some)["occluder"] for k in (0, 3)]
    assert all(alpha.max() > 0 for alpha in seen)
    shown = [alpha[shots(False)[k].complete].mean() for alpha, k in zip(seen, (0, 3), strict=True)]
    assert np.mean(shown) < 0.01, shown
    psnr = []
    for changes in ({}, {"occlusion": False}):
        avatar = boxed(False, **some, **changes)
        errors = []
        for shot in shots(False)[:4]:
            rgb, _ = avatar.render(CAMERA, shot.view.body_pose)
            errors.append(np.square(rgb - shot.view.image / 255)[shot.complete])
        psnr.append(-10 * np.log10(np.concatenate(errors).mean()))
    assert abs(psnr[0] - psnr[1]) < 0.2, psnr


# ------------------------------------------------------------------------------------------------ check 8: drawing


def test_check_8_drawing_sees_neither_occluder_nor_background():
    view = shots()[0].view
    avatar = fit_to(boxed_set(), replace(TINY, steps=2, scene="network", body_fit=10))
    before = avatar.render(view.camera, view.body_pose)
    with torch.no_grad():
        for parameter in avatar.scene.parameters():
            parameter += torch.randn(parameter.shape)
    for a, b in zip(before, avatar.render(view.camera, view.body_pose), strict=True):
        assert np.array_equal(a, b)


@cache
def tiny():
    return begun(TINY, training_set(training_views()))


def test_the_background_asked_for_is_behind_the_person():
    camera, pose = a_camera(0.0, 64), a_pose(0.3)
    (white, alpha), (black, same) = (tiny().render(camera, pose, colour) for colour in (WHITE, (0.0, 0.0, 0.0)))
    assert np.array_equal(alpha, same)
    assert alpha.max() > 0.9
    assert np.allclose(white - black, (1 - alpha)[..., None], atol=1e-6)


def test_drawing_takes_the_pose_given_whatever_the_frame():
    """Fitted poses are those of training frames alone, and never of a test view."""
    training = training_set(training_views())
    avatar = begun(replace(TINY, refine_poses=True), training)
    camera, pose = a_camera(0.0, 64), training.views[2].body_pose
    before = avatar.render(camera, pose, frame=2)
    with torch.no_grad():
        avatar.poses.poses += 0.3
    for a, b in zip(before, avatar.render(camera, pose, frame=2), strict=True):
        assert np.array_equal(a, b)
    assert not torch.equal(avatar.bones(2), begun(TINY, training).bones(2))
    with torch.no_grad():  # the shape is the person's, whatever the pose
        avatar.poses.betas += 2.0
    assert not np.array_equal(before[1], avatar.render(camera, pose, frame=2)[1])


def test_pose_conditioning_at_test_time():
    training = training_set(training_views())
    config = replace(TINY, pose_conditioning=True, body_fit=0)
    poses = {name: start(replace(config, pose_at_test=name), training) for name in ("all", "trained")}
    pose = training.views[1].body_pose
    assert poses["all"].followed(pose, None) is not None
    assert poses["trained"].followed(pose, None) is None
    assert torch.equal(poses["trained"].followed(pose, 1), poses["all"].followed(pose, 1))
    assert tiny().followed(pose, 1) is None


def test_saved_and_loaded_it_draws_the_same(tmp_path, views):
    avatar = fit_to(training_set(views), replace(TINY, steps=2, refine_poses=True))
    avatar.save(tmp_path)
    again = Wild2Avatar(TINY).load(tmp_path, BODY)
    assert equal_bits(everything(avatar), everything(again))
    view = views[1]
    for a, b in zip(*(x.render(view.camera, view.body_pose, frame=1) for x in (avatar, again)), strict=True):
        assert np.array_equal(a, b)


# ------------------------------------------------------------------------------------------------------- the loss


def test_every_term_changes_the_loss():
    """Each one alone, by switching the others off, adds up to all of them."""
    weights = {
        "colours": 1.0,
        "eikonal": 0.1,
        "entropy": 0.005,
        "beside": 0.3,
        "inside": 0.01,
        "completeness": 0.1,
        "background_alpha": 0.1,
        "around": 0.1,
        "occlusion_loss": 1.0,
        "sparsity": 0.01,
    }
    training = boxed_set()
    avatar = begun(replace(TINY, scene="network", rays=512), training)

    def loss(**changes):
        avatar.config = replace(avatar.config, **(dict.fromkeys(weights, 0.0) | changes))
        fit = Wild2AvatarFit(avatar, training, 0, Ledger())
        return fit._loss(0).item()

    alone = {name: loss(**{name: weight}) for name, weight in weights.items()}
    assert all(value > 0 for value in alone.values()), alone
    assert loss(**weights) == pytest.approx(sum(alone.values()), rel=1e-4)


def test_hidden_pixels_have_a_colour_only_where_they_were_filmed():
    """Without photographs what lies behind the occluder moves nothing."""
    training = boxed_set()
    plain = [replace(view, filmed=None) for view in training.views]
    repainted = []
    for view in plain:
        image = view.image.copy()
        image[view.mask == MaskState.UNKNOWN] = 90
        repainted.append(replace(view, image=image))
    avatar = begun(replace(TINY, scene="network", rays=512), training)
    losses = [
        Wild2AvatarFit(avatar, TrainingSet(shown, BODY, WHITE, "x"), 0, Ledger())._loss(0).item()
        for shown in (training.views, plain, repainted)
    ]
    assert losses[0] != losses[1] == losses[2]


def test_a_layer_before_the_visible_person_moves_no_colour():
    """While the layer lies over everybody, colours fitted through it would answer to it and not to the person."""
    training = boxed_set()
    plain = TrainingSet([replace(view, filmed=None) for view in training.views], BODY, WHITE, "x")
    off = dict.fromkeys(("completeness", "background_alpha", "occlusion_loss", "sparsity", "eikonal"), 0.0)

    def pulls(layer_over):
        """Of the colours alone, on the layer and on the person. The background is one colour, and no network."""
        avatar = begun(replace(TINY, scene="constant", rays=512), training)
        avatar.config = replace(avatar.config, **off, layer_over=layer_over)
        Wild2AvatarFit(avatar, plain, 0, Ledger())._loss(BEHIND[0]).backward()
        return [
            sum(p.grad.abs().sum().item() for p in part.parameters() if p.grad is not None)
            for part in (avatar.scene, avatar.field.colour)
        ]

    on_layer, through_it = pulls("all")
    assert on_layer > 0
    none, on_person = pulls("unknown")
    assert none == 0
    assert on_person > through_it > 0


def test_schedules():
    training = boxed_set()
    fit = Wild2AvatarFit(
        start(replace(TINY, decay="halves", warm_up=0.0, pose_conditioning=True), training), training, 0, Ledger()
    )
    shares, counted, followed = [], [], []
    for epoch in (0, 1, 2, 20, 21, 199, 200, 500, 700):
        fit.step = epoch * 5
        shares.append(fit._rate_share())
        counted.append(fit.counted)
        followed.append(fit._followed(0) is not None)
    assert shares == [1, 1, 1, 1, 1, 1, 0.5, 0.25, 0.25]
    assert counted == [0, 10, 20, 200, 200, 200, 200, 200, 200]  # ramp of 20 epochs
    assert followed == [False, False, True, False, True, True, False, False, False]
    fit.step, fit.warm_up = 0, 1.0
    assert fit._rate_share() == 1 / fit.steps
    assert (PAPER.ramp_epochs, PAPER.refresh_epochs, PAPER.rays) == (200, 20, 512)


def test_the_surface_that_rays_pass_beside_is_looked_at_again_after_some_epochs():
    training = training_set(training_views())
    fit = Wild2AvatarFit(begun(replace(TINY, refresh_epochs=2), training), training, 0, Ledger())
    changed, before = [], fit.avatar.outline.clone()
    for step in range(14):
        fit._one_step(fit._view_of(step, 6))
        fit.step += 1
        if not torch.equal(before, fit.avatar.outline):
            changed.append(step)
            before = fit.avatar.outline.clone()
    assert changed == [12]


# ------------------------------------------------------------------------------------------------------- resuming


@cache
def whole():
    return everything(fit_to(training_set(training_views()), replace(TINY, steps=12, refine_poses=True)))


@pytest.mark.parametrize(("saved", "killed"), [(1, 2), (5, 7), (9, 11)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(views, saved, killed):
    """Saved before and after the surface was looked at again."""
    config, training, ledger = replace(TINY, steps=12, refine_poses=True), training_set(views), SavesAt(saved)
    killed_after(Wild2AvatarFit(start(config, training), training, 0, ledger), killed)
    resumed = fit_to(training, config, ledger=ledger)
    assert equal_bits(whole(), everything(resumed))
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]
    (refined,) = events(ledger, "poses_refined")
    assert 0 < refined["mean_deg"] < 1


def test_the_same_seed_gives_the_same_bits_and_another_another(views):
    some = [everything(fit_to(training_set(views), replace(TINY, steps=2, body_fit=10), seed)) for seed in (0, 0, 1)]
    assert equal_bits(*some[:2])
    assert not equal_bits(*some[1:])


def test_a_start_that_is_kept_is_the_start_that_is_fitted(views, monkeypatch):
    """The body fit is done once for the same network and body; the next has its result, to the bit."""
    from ihbench.methods.wild2avatar.person import body_fit

    config = replace(TINY, body_fit=10)
    kept = everything(begun(config, training_set(views)))
    monkeypatch.setattr(body_fit, "_kept", {})
    assert equal_bits(kept, everything(begun(config, training_set(views))))


def test_the_method_reports_its_stages_and_offers_its_avatar(views):
    offered = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append((step, avatar)))
    avatar = fit_to(training_set(views), replace(TINY, steps=2), ledger=ledger)
    assert {"fit", "fit/prepare", "fit/fields"} <= {row["stage"] for row in ledger.table()}
    assert offered[-1] == (2, avatar)


# ------------------------------------------------------------------------------------------------------ bad input


def test_a_pixel_that_is_not_finite_is_a_divergence(views):
    image = views[0].image.astype(np.float32)
    image[views[0].mask == MaskState.PERSON] = np.nan
    with pytest.raises(Diverged, match="frame 0 has a pixel that is not finite"):
        fit_to(training_set([replace(views[0], image=image)]), TINY)


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = SceneOf(hidden_share=0.0, in_scene=False, motion_deg=1.0)
    left = {o.field: o.value for o in leave_out(PAPER, scene)}
    assert left == {"occlusion": False, "scene": "constant", "pose_conditioning": False}
    scene = SceneOf(hidden_share=0.3, in_scene=True, motion_deg=40.0)
    assert leave_out(PAPER, scene) == []


class SceneOf:
    """What `leave_out` asks of a `SceneMeasure`."""

    def __init__(self, **measured):
        vars(self).update(measured)


def test_profiles_and_spec():
    spec = method_spec("wild2avatar")
    assert spec.profile("quick") is QUICK
    assert spec.footnote == "reimplementation on Vid2Avatar; L_occ, L_comp inferred"
    assert set(PROFILES) == {"smoke", "quick", "paper"}


@pytest.mark.parametrize("name", ["rate-100", "one-frame", "nan-hidden", "vanished"])
def test_stress_cases(name):
    (case,) = [case for case in CASES if case.name == f"wild2avatar-{name}"]
    (outcome,) = run_cases([case])
    assert outcome.verdict == "passed", (outcome.reason, outcome.value, outcome.note)
