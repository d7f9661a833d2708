"""GTU: the acceptance checks of its losses, its schedule, its views, its gate and its masks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ihbench.diffusion.score_distillation import Prompts, ScoreDistillation
from ihbench.errors import BadInput
from ihbench.fit.gaussians.adam import GaussianAdam, Rate
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.fit.gaussians.skinned_covariance import quaternion_to_matrix
from ihbench.methods.gtu.avatar import minus_z_to
from ihbench.methods.gtu.config import OWN, PAPER, PROFILES, QUICK, GtuConfig, leave_out
from ihbench.methods.gtu.deformation import Deformation
from ihbench.methods.gtu.fitting import rates
from ihbench.methods.gtu.method import Gtu
from ihbench.methods.gtu.prompts import azimuth_of, caption, prompts_of, side_of
from ihbench.methods.gtu.random_views import EARLY, KINDS, LATE, camera_at, drawn, view_from
from ihbench.methods.gtu.schedule import noise_range, photo_weight, sds_step
from ihbench.methods.gtu.target import grown, left_out, person_box, prepare_target, reconstruction_loss, undecided
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState
from ihbench.scene.method_spec import method_spec
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view
from tests.diffusion.test_score_distillation import MASSES, image, noise, point_mass

from .tiny_fit import training_set, training_views
from .tiny_gtu import an_avatar

BODY = the_body()


# ------------------------------------------------------------------------------------------- checks 1 to 5: losses


def test_check_1_the_term_that_decides():
    for a, value in ((0.0, 0.0), (1.0, 0.0), (0.5, 0.12011), (0.25, 0.08919)):
        assert undecided(torch.tensor(a, dtype=torch.float64)).item() == pytest.approx(
            value, abs=1e-5 if value else 1e-6
        )
    for a, up in ((0.6, True), (0.4, False)):
        alpha = torch.tensor(a, requires_grad=True)
        undecided(alpha).backward()
        assert (-alpha.grad > 0) == up


def test_check_2_of_a_point_mass_the_gradient_leads_there():
    backbone, pixels = point_mass("epsilon"), image()
    distil = ScoreDistillation(backbone, guidance=1.0)
    one, other = (distil(pixels, Prompts("person"), 500, noise(seed)) for seed in (0, 1))
    z, kept = backbone.codec.encode(pixels), backbone.scheduler.alphas_cumprod[500]
    expected = (kept * (1 - kept)).sqrt() * (z.detach() - MASSES["person"])
    assert torch.allclose(one.gradient, expected, atol=1e-6)
    assert torch.allclose(one.gradient, other.gradient, atol=1e-6)
    square = (z - (z - one.gradient).detach()).square().sum() / 2
    (as_released,) = torch.autograd.grad(square, pixels, retain_graph=True)
    (ours,) = torch.autograd.grad(one.loss, pixels)
    assert torch.allclose(ours, as_released, atol=1e-6)
    there = backbone.codec.decode(torch.full_like(z, MASSES["person"])).detach()
    assert distil(there, Prompts("person"), 500, noise()).gradient.abs().max() < 1e-6


def test_check_3_prediction_types_agree():
    pixels = image()
    first, second = (
        ScoreDistillation(point_mass(kind), guidance=1.0)(pixels, Prompts("person"), 500, noise()).gradient
        for kind in ("epsilon", "sample")
    )
    assert torch.allclose(first, second, atol=1e-6)


@pytest.mark.parametrize("guidance", [1.0, 7.5, 50.0])
def test_check_4_guidance_overshoots_by_its_factor(guidance):
    """Where the gradient vanishes: m_neg + s (m_pos - m_neg)."""
    backbone = point_mass("sample")
    end = MASSES["blurry"] + guidance * (MASSES["person"] - MASSES["blurry"])
    distil = ScoreDistillation(backbone, guidance=guidance)
    z = torch.zeros(1, *noise().shape)
    for _ in range(40):  # descent in the latents, whose gradient it is
        pixels = backbone.codec.decode(z)
        z = z - distil(pixels, Prompts("person", "blurry"), 500, noise()).gradient
    assert torch.allclose(z, torch.full_like(z, end), rtol=1e-4, atol=1e-4)


def test_check_5_noise_range_and_the_photos_weight():
    expected = {1: (0.5, 0.98), 1999: (0.5, 0.98), 2000: (0.3, 0.98), 3000: (0.3, 0.64), 4000: (0.02, 0.3)}
    for k, ends in (expected | {9000: (0.02, 0.3)}).items():
        assert noise_range(PAPER, k) == pytest.approx(ends)
        assert sds_step(PAPER, 1000 + k) == k
    for k, weight in ((1999, 9.604e5), (3000, 4.096e5), (4000, 9.0e4)):
        assert photo_weight(PAPER, 1000 + k) == pytest.approx(weight)
    assert sds_step(PAPER, 1000) is None
    assert photo_weight(PAPER, 1000) == 1.0
    assert photo_weight(replace(PAPER, sds=False), 5000) == 1.0
    numbers = [sds_step(QUICK, i) for i in range(1, QUICK.steps + 1)]
    assert [k for k in numbers if k is not None] == list(range(1, 201))


# ------------------------------------------------------------------------------------------ check 6: the view table


@pytest.mark.parametrize(("k", "shares"), [(1, EARLY), (PAPER.second_stage, LATE)])
def test_check_6_the_view_table(k, shares):
    rng = np.random.default_rng(1)
    kinds, azimuths, elevations = zip(*(drawn(rng, PAPER, k) for _ in range(10_000)), strict=True)
    counts = np.array([kinds.count(kind) for kind in KINDS])
    assert np.abs(counts / len(kinds) - shares).max() < 0.015
    assert (min(azimuths), max(azimuths)) == (-180, 179)
    found = np.histogram(azimuths, 36, (-180, 180))[0]
    chi_squared = np.square(found - len(kinds) / 36).sum() / (len(kinds) / 36)
    assert chi_squared < 57.3  # p > .01 of 35 degrees of freedom
    assert max(map(abs, elevations)) <= 30
    assert not any(lift for kind, lift in zip(kinds, elevations, strict=True) if kind in ("head", "upper", "lower"))


def test_check_6_scale_and_sides_of_the_camera():
    camera = camera_at(0, 0, 2.2, 512)
    rod = camera.project(np.array([[-0.5, 0, 0], [0.5, 0, 0]]))
    assert rod[1, 0] - rod[0, 0] == pytest.approx(254.7, abs=0.5)
    standing = a_pose()
    for azimuth, side in ((0, "front"), (90, "side"), (-90, "side"), (180, "back")):
        camera = camera_at(azimuth, 20, 2.2, 64)
        assert side_of(azimuth_of(camera, standing.pose, standing.transl)) == side
    turned = a_pose(yaw=np.pi)
    assert side_of(azimuth_of(camera_at(0, 0, 2.2, 64), turned.pose, turned.transl)) == "back"


def test_close_ups_show_their_part():
    pose = np.random.default_rng(0).normal(0, 0.2, (24, 3))
    inside = {}
    for kind in KINDS:
        view = view_from(kind, 30, 10, BODY, pose, np.zeros(10), 64)
        assert not view.body_pose.pose[0].any()
        p = view.camera.project(BODY.posed_joints(view.body_pose))
        within = ((p[:, :2] > 0) & (p[:, :2] < 64)).all(1)
        inside[kind] = within
    head, knee = 15, 4
    assert inside["head"][head]
    assert not inside["head"][knee]
    assert inside["upper"][18]
    assert not inside["upper"][7]
    assert inside["lower"][[4, 5, 7, 8]].all()
    assert not inside["lower"][head]
    assert inside["entire"].all()
    assert inside["canonical"].all()


# ------------------------------------------------------------------------------------------------ check 7: the gate


def shifts(spread, shared, count=4000, steps=200):
    """[N] how far a constant unit gradient moves parameters whose photos give gradients of this spread."""
    places = []
    for guess in (0.0, 1.0):
        rng = torch.Generator().manual_seed(3)
        own = Gaussians(torch.zeros(count, 3), torch.zeros(count, 3), torch.ones(count, 4), torch.zeros(count))
        rate = {name: Rate(1.0 if name == "means" else 0.0) for name in own.attributes}
        photos = GaussianAdam(own, rate)
        guesses = photos if shared else GaussianAdam(own, rate)
        for step in range(steps):
            own.means.grad = spread * torch.randn(count, 3, generator=rng)
            photos.step(step)
            own.means.grad = torch.full((count, 3), -guess)
            guesses.step(step)
        places.append(own.means.detach()[:, 0].double())
    return (places[1] - places[0]).mean().item()


def test_check_7_the_shared_adam_keeps_guesses_off_what_photos_show():
    unseen = shifts(0.0, shared=True, count=4)
    assert unseen == pytest.approx(282, abs=2)  # √2 steps an iteration
    for spread, ratio in ((10, 10.1), (100, 99), (1000, 993)):
        assert unseen / shifts(spread, shared=True) == pytest.approx(ratio, rel=0.1)
    assert unseen / shifts(1, shared=True) <= 1.5
    apart = shifts(0.0, shared=False, count=4)
    assert apart / shifts(100, shared=False) == pytest.approx(1.0, rel=0.01)


# ------------------------------------------------------------------------------------------------ check 8: the masks


def loss_and_gradients(view, unknown):
    avatar = an_avatar(training_set([view]), unknown=unknown)
    target, backdrop = prepare_target(avatar, view), torch.tensor([0.2, 0.7, 0.4])
    rgb, alpha = avatar.draw(avatar.poses[0], target.joints, target.transl, target.camera, backdrop)
    loss = reconstruction_loss(rgb, target, backdrop, avatar.config) + undecided(alpha * target.keep[..., 0])
    loss.backward()
    parameters = [*avatar.gaussians.attributes.values(), *avatar.poses]
    return loss.item(), [p.grad.clone() for p in parameters if p.grad is not None]


@pytest.mark.parametrize("unknown", ["ignore", "background"])
def test_check_8_nothing_under_the_grown_occluder_counts(unknown):
    view = training_views()[1]
    near = left_out(view, BODY, PAPER)
    assert (near & (view.mask == MaskState.PERSON)).sum() > 20
    painted = replace(view, image=np.where(near[..., None], 255 - view.image, view.image))
    (loss, gradients), (other, others) = (loss_and_gradients(each, unknown) for each in (view, painted))
    same = loss == other and all(torch.equal(a, b) for a, b in zip(gradients, others, strict=True))
    assert same == (unknown == "ignore")


def test_an_occluder_grows_where_it_hides_the_body_and_a_ring_about_the_body_does_not():
    """Restated: within 4 px in both axes of body pixels that are unknown, and what is unknown itself."""
    view = training_views()[1]
    points = view.camera.project(BODY.pose(view.body_pose))
    body = rasterize(points, BODY.faces, view.camera.height, view.camera.width).mask
    ring = grown(body, 9) & ~body
    ringed = replace(view, mask=np.where(ring, MaskState.UNKNOWN, view.mask))
    unknown = ringed.mask == MaskState.UNKNOWN
    expected = unknown | grown(unknown & body, round(PAPER.dilation * 128))
    assert (left_out(ringed, BODY, PAPER) == expected).all()
    person = ringed.mask == MaskState.PERSON
    assert (person & ~left_out(ringed, BODY, PAPER)).sum() > 3 * (person & ~grown(unknown, 4)).sum()
    assert not left_out(view, BODY, replace(PAPER, unknown="background")).any()


def test_without_occluder_masks_a_hidden_pixel_is_background():
    view = training_views()[1]
    known = replace(view, mask=np.where(view.mask == MaskState.UNKNOWN, MaskState.BACKGROUND, view.mask))
    for unknown, same in (("background", True), ("ignore", False)):
        losses = [loss_and_gradients(each, unknown)[0] for each in (view, known)]
        assert (losses[0] == losses[1]) == same


def test_the_loss_is_the_mean_over_the_whole_box():
    """Restated: the person on the backdrop, hidden pixels black in both."""
    view = training_views()[1]
    avatar = an_avatar(training_set([view]), ssim=0.0)
    target, backdrop = prepare_target(avatar, view), torch.tensor([0.2, 0.7, 0.4])
    rows, columns = person_box(view.camera, BODY.pose(view.body_pose), PAPER.box)
    shape = rows.stop - rows.start, columns.stop - columns.start
    own = torch.rand(*shape, 3, generator=torch.Generator().manual_seed(0))
    person = (view.mask == MaskState.PERSON)[rows, columns, None]
    keep = ~left_out(view, BODY, PAPER)[rows, columns, None]
    image = np.where(person, view.image[rows, columns] / 255, backdrop.numpy())
    expected = np.abs((own.numpy() - image) * keep).mean()
    assert reconstruction_loss(own, target, backdrop, avatar.config).item() == pytest.approx(expected, rel=1e-5)
    assert 0 < keep.mean() < 1


# --------------------------------------------------------------------------------------------------- representation


def test_the_canonical_body_is_skinned_as_the_body_is():
    """Up to the grid's coarseness and pose blend shapes; where it stands, exactly."""
    deformation = Deformation(BODY, np.zeros(10), 48)
    pose = a_pose(0.8, 0.5, (0.1, 0.2, 0.3))
    joints, there = deformation.joints(pose.betas), torch.from_numpy(np.array(pose.transl))
    world, linear = deformation(deformation.vertices, torch.from_numpy(np.array(pose.pose)), joints, there)
    error = np.linalg.norm(world.numpy() - BODY.pose(pose), axis=1)
    assert np.median(error) < 0.003
    assert np.quantile(error, 0.95) < 0.02
    assert linear.shape == (len(BODY.v_template), 3, 3)
    weights = deformation.weights(deformation.vertices)
    assert torch.allclose(weights.sum(1), torch.ones(()).double(), atol=1e-9)
    beyond = deformation.low - 0.1 * deformation.side
    assert not deformation.weights(beyond[None]).any()
    assert deformation.outside(beyond[None]).all()
    assert not deformation.outside(deformation.vertices).any()


def test_betas_of_a_frame_move_its_joints_alone():
    deformation = Deformation(BODY, np.zeros(10), 16)
    tall = deformation.joints(np.array([2.0]))
    usual = deformation.joints(np.zeros(10))
    at_rest = torch.zeros(24, 3).double()
    points, there = deformation.vertices[::50], torch.zeros(3).double()
    for joints in (usual, tall):
        world, _ = deformation(points, at_rest, joints, there)
        assert world.isfinite().all()
    assert not torch.allclose(usual, tall)


def test_gaussians_start_on_the_vertices_with_their_back_to_the_normal():
    avatar = an_avatar(training_set(training_views()[:1]))
    gaussians = avatar.gaussians
    assert len(gaussians) == len(BODY.v_template)
    assert torch.equal(gaussians.means, avatar.deformation.vertices)
    assert torch.allclose(gaussians.opacities, torch.tensor(0.9))
    normals = np.array([[0, 0, -1.0], [0, 0, 1], [1, 0, 0], [0.6, 0.8, 0], [0, 0, 0]])
    turned = quaternion_to_matrix(torch.from_numpy(minus_z_to(normals))) @ torch.tensor([0, 0, -1.0]).double()
    assert np.allclose(turned[:4].numpy(), normals[:4], atol=1e-12)


def test_rates_hold_then_fall():
    far = rates(PAPER)["means"]
    assert [far.at(i) for i in (1, 1000, 7000, 12_010)] == pytest.approx([1e-3, 1e-3, 2e-6, 2e-6])
    assert [PAPER.degree_at(i) for i in (1, 1999, 2000, 4000, 12_010)] == [0, 0, 1, 2, 2]


# ------------------------------------------------------------------------------------------------ words and the plan


def test_prompts_say_the_side_but_the_control_never_the_word():
    front, back = (prompts_of("sd2", ["<someone>"], "upper", azimuth) for azimuth in (10, -170))
    assert front.positive.startswith("a photo of a <someone> person, high quality")
    assert "front view" in front.positive
    assert front.negative.endswith(", back view")
    assert back.negative.endswith(", front view")
    assert "<someone>" not in front.control
    small = prompts_of("mini", ["<someone>", "<someone>-1"], "head", 10)
    assert (small.positive, small.control) == ("a photo of <someone> <someone>-1", "a photo of a person")
    words = caption("sd2", ["<someone>"], 1.3, 180, np.random.default_rng(0))
    assert words.split(" photo")[0] in ("zoomed in", "close up")
    assert words.endswith("photo of a <someone> person, back view")


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = SimpleNamespace(
        motion_deg=40.0, turn_deg=300.0, hidden_texels=0.02, never_seen_texels=0.0, hidden_share=0.2
    )  # fmt: skip
    assert leave_out(QUICK, scene) == []
    scene.hidden_texels = 0.001
    assert [(o.field, o.value) for o in leave_out(QUICK, scene)] == [("sds", False)]
    assert leave_out(replace(QUICK, sds=False), scene) == []
    scene.motion_deg = scene.turn_deg = 3.0
    assert [o.field for o in leave_out(QUICK, scene)][-1] == "sh_degree"


def test_it_is_registered_with_its_profiles():
    spec = method_spec("gtu")
    assert spec.load(spec.method) is Gtu
    assert spec.profile("paper") == GtuConfig()
    assert set(PROFILES) == {"smoke", "quick", "paper"}
    assert PAPER.settled() == OWN["mini"]
    assert replace(PAPER, backbone="sd2", weights="x").settled().guidance == 50


def test_missing_weights_are_one_line():
    with pytest.raises(BadInput, match=r"^--method.weights '': expected the folder of Stable Diffusion 2"):
        GtuConfig(backbone="sd2")
    assert GtuConfig(backbone="sd2", sds=False).guesses is False
    config = replace(QUICK, backbone="sd2", weights="/nowhere/at/all")
    with pytest.raises(BadInput, match=r"^--method.weights /nowhere/at/all: no such folder"):
        Gtu(config)._look_at_backbone()
    with pytest.raises(BadInput, match="one word"):
        replace(QUICK.identity, token="two words")
    with pytest.raises(BadInput, match=r"--method.identity.token person: the vocabulary of mini has"):
        Gtu(replace(QUICK, identity=replace(QUICK.identity, token="person")))._look_at_backbone()


def test_boxes_of_bodies_that_are_not_there_are_the_whole_image():
    camera = a_camera(0.0, 64)
    for transl in ((9, 0, 0), (0, 0, 9)):
        rows, columns = person_box(camera, BODY.pose(a_pose(transl=transl)), 1.1)
        assert (rows, columns) == (slice(0, 64), slice(0, 64))
    rows, columns = person_box(camera, BODY.pose(a_pose()), 1.1)
    person = np.argwhere(train_view(camera, a_pose()).mask == MaskState.PERSON)
    assert rows.start <= person[:, 0].min() <= person[:, 0].max() < rows.stop
    assert columns.start <= person[:, 1].min() <= person[:, 1].max() < columns.stop
    assert (rows.stop - rows.start) < 64


def test_harmonics_are_of_the_world():
    """A turn of the body does not turn them, as released: both sides are as bright to one camera."""
    avatar = an_avatar(training_set(training_views()[:1]), sh_every=1)
    avatar.degree = 1
    with torch.no_grad():
        avatar.gaussians.attributes["sh_rest"][:, 1] = 0.6  # along z, towards the camera
    means = []
    for yaw in (0.0, np.pi):
        rgb, alpha = avatar.render(a_camera(0.0, 64), a_pose(yaw))
        means.append(rgb[alpha > 0.9].mean())
    assert means[0] == pytest.approx(means[1], abs=0.02)
    assert abs(means[0] - avatar.config.grey) > 0.2
