"""HumanNeRF's parts against their formulas: acceptance checks 1 to 8 of its representation, by number."""

import copy
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.clock.ledger import Ledger
from ihbench.fit.rays.ray_target import PosedBox
from ihbench.methods.humannerf import kernel
from ihbench.methods.humannerf.avatar import HumanNerfAvatar, PosedField
from ihbench.methods.humannerf.config import PAPER, SMOKE
from ihbench.methods.humannerf.fitting import HumanNerfFit
from ihbench.methods.humannerf.networks import CanonicalNetwork, NonRigidNetwork
from ihbench.methods.humannerf.stress import TINY
from ihbench.nets.bone_lookups import BoneWeights
from ihbench.nets.motion_weights import BACKGROUND, bone_gaussians, prior_weights
from ihbench.render.volumes.density_laws import relu_density
from ihbench.render.volumes.fast import box_rays, march
from ihbench.render.volumes.field import FieldValues
from ihbench.render.volumes.intervals import even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays
from ihbench.render.volumes.reference import reference_rays
from tests.bench.fake_capture import a_camera, a_pose, the_body

from .tiny_fit import SIZE, training_set, training_views

BODY = the_body()
T_POSE = BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3))


def an_avatar(seed=0, **changes):
    return HumanNerfAvatar(replace(TINY, **changes), BODY, np.zeros(10), seed)


def dense(seed=0, **changes):
    """An avatar that shows something: its density is raised, its weights and offsets are not those of the start."""
    avatar = an_avatar(seed, **changes)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        avatar.canonical.last.bias[3] = 30.0
        avatar.motion.ups[-1].weight.mul_(20)
        if avatar.non_rigid is not None:
            avatar.non_rigid.last.weight.normal_(0, 2e-3, generator=generator)
    avatar.step = avatar.config.full_band
    return avatar


# ----------------------------------------------------------------------------------- checks 1 and 2: motion weights


def test_check_1_the_prior_at_joints():
    """Own weight, sum and background at knee, ankle, elbow and head; more in `tests/nets/test_motion_weights.py`."""
    joints, parents = torch.from_numpy(BODY.joints.copy()), [int(p) for p in BODY.parents]
    gaussians = bone_gaussians(joints, joints, parents)
    weights = prior_weights(gaussians)
    own = [gaussians[4, 4], gaussians[4].sum(), weights[4, BACKGROUND], weights[7, 7], weights[18, 18]]
    own += [weights[18, BACKGROUND], weights[15, 15], weights[15, BACKGROUND]]
    expected = [0.0608, 0.1277, 0.8723, 0.753, 0.337, 0.365, 0.518, 0.0]
    assert [each.item() for each in own] == pytest.approx(expected, abs=1e-3)


def test_check_2_without_corrections_the_weights_are_the_prior():
    avatar = an_avatar()
    prior = avatar.motion.log_prior.exp()
    assert torch.allclose(prior.sum(0), torch.ones(32, 32, 32), atol=1e-6)
    with torch.no_grad():
        avatar.motion.ups[-1].weight.zero_()
    assert torch.allclose(avatar.motion(), prior, atol=1e-6)
    volume = dense().motion()
    assert (volume[avatar.motion.log_prior.isinf()] == 0).all()
    (volume.square().sum()).backward()


# ------------------------------------------------------------------------------------------------- check 3: window


def test_check_3_octaves_come_on_between_kick_in_and_full():
    avatar = an_avatar(kick_in=PAPER.kick_in, full_band=PAPER.full_band, steps=PAPER.steps)
    expected = {
        10_000: [0, 0, 0, 0, 0, 0],
        20_000: [1, 0.5, 0, 0, 0, 0],
        25_000: [1, 1, 0.1464, 0, 0, 0],
        30_000: [1, 1, 1, 0, 0, 0],
        50_000: [1] * 6,
        400_000: [1] * 6,
    }
    for step, window in expected.items():
        avatar.step = step
        assert avatar.window.tolist() == pytest.approx(window, abs=1e-4), step


def test_networks_have_the_released_sizes():
    generator = torch.Generator().manual_seed(0)
    canonical, non_rigid = CanonicalNetwork(generator), NonRigidNetwork(generator)

    def products(network):
        return sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))

    assert products(canonical) == 492_032
    assert products(non_rigid) == 100_352
    assert canonical.hidden[5].in_features == 319
    assert non_rigid.hidden[4].in_features == 164
    spread = canonical.hidden[1].weight.std().item()
    assert spread == pytest.approx(np.sqrt(2 * 2 / 512), rel=0.02)


# --------------------------------------------------------------------------------------------------- check 4: warp


def test_check_4_in_the_t_pose_places_stay_and_root_and_camera_turn_together():
    avatar = dense()
    weights = avatar.posed(T_POSE, corrected=False).weights
    low, high = avatar.motion.low, avatar.motion.high
    points = low + (high - low) * torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    f, places = weights.located(points)
    assert (places - points)[f >= 1e-4].abs().max() < 1e-5
    assert (places[f == 0] == 0).all()

    pose, camera = a_pose(0.4, 0.3), a_camera(0.2, 40)
    drawn = avatar.render(camera, pose)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # a quarter about y, of everything, about the origin
    shift = np.array([0.4, -0.2, 0.7])
    from scipy.spatial.transform import Rotation

    root = Rotation.from_matrix(turn @ Rotation.from_rotvec(np.array(pose.pose[0])).as_matrix()).as_rotvec()
    joint = BODY.joints[0]
    transl = turn @ (joint + pose.transl) + shift - joint
    moved = BodyPose(np.vstack([root, pose.pose[1:]]), pose.betas, transl)
    R = camera.R @ turn.T
    again = avatar.render(Camera(camera.K, R, camera.t - R @ shift, 40, 40), moved)
    assert drawn[1].max() > 0.9
    for one, other in zip(drawn, again, strict=True):
        assert np.abs(one - other).max() < 1e-4  # of float32 rays at 3 m


# ---------------------------------------------------------------------------------------------- check 5: gradients


def gradients(step):
    """Norms of the gradients of a loss in a step, by parameter; None where nothing reached it."""
    fit = HumanNerfFit(an_avatar(non_rigid_width=32), training_set(training_views()), 0, Ledger())
    with torch.no_grad():
        fit.avatar.canonical.last.bias[3] = 5.0
    fit.step = step - 1
    fit.avatar.step = step
    fit._loss(0).backward()
    return {name: None if p.grad is None else p.grad.norm().item() for name, p in fit.avatar.named_parameters()}


def test_check_5_before_kick_in_only_one_offset_learns_and_poses_do_from_the_start():
    before, after = gradients(TINY.kick_in), gradients(TINY.full_band)
    reached = {name for name, norm in before.items() if name.startswith("non_rigid") and norm}
    assert reached == {"non_rigid.last.bias"}
    assert all(norm for name, norm in after.items() if name.startswith("non_rigid"))
    first = gradients(1)
    last = max(name for name in first if name.startswith("pose_correction") and name.endswith("weight"))
    assert first[last] > 0


def test_check_5_a_correction_of_nothing_turns_nothing():
    """Of a zero vector the released formula makes .999995 times the identity; here it is the identity."""
    avatar = an_avatar()
    assert avatar.pose_correction is not None
    with torch.no_grad():
        avatar.pose_correction.layers[-1].weight.zero_()
    turned = avatar.pose_correction(torch.zeros(23, 3))
    assert (turned - 0.999995 * torch.eye(3)).abs().max() < 6e-6


# ------------------------------------------------------------------------------- check 6: compositing and the twin


def test_check_6_constant_density():
    """f = 1 over a length ℓ: α = 1 - e^(-σℓ), colour α c + (1 - α) background."""
    avatar = an_avatar(non_rigid=False)
    with torch.no_grad():
        avatar.canonical.last.weight.zero_()
        avatar.canonical.last.bias.copy_(torch.tensor([0.0, 1.0, -1.0, 1.5]))
    volume = torch.zeros(2, 4, 4, 4)
    volume[0] = 1.0
    low, high = torch.full((3,), -10.0), torch.full((3,), 10.0)
    weights = BoneWeights(volume, low, high, torch.eye(3, 4)[None])
    field = PosedField(avatar, weights, torch.zeros(69))
    rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.6, 0.8]]))
    depths = even_depths(torch.tensor([1.0]), torch.tensor([1.5]), 101)
    lengths = segment_lengths(depths, rays.lengths, last=0.0)
    shown = march(field, rays, depths, lengths).composited
    expected = 1 - np.exp(-1.5 * 0.5)
    assert shown.alpha.item() == pytest.approx(expected, abs=1e-5)
    color = torch.tensor([0.0, 1.0, -1.0]).sigmoid()
    for background in (torch.zeros(3), torch.tensor([0.2, 1.0, 0.5])):
        assert torch.allclose(shown.on(background)[0], expected * color + (1 - expected) * background, atol=1e-5)


def test_pictures_are_the_float64_twins():
    """On a few hundred rays, everything left out that may be, at a pixel error of 1/255."""
    avatar = dense(samples=64, least=1e-3, least_weight=1e-4, stop=1e-3)
    camera, pose = a_camera(0.4, 20), a_pose(0.3, 0.4)
    rgb, alpha = avatar.render(camera, pose, (0.2, 0.5, 0.9))
    exact = copy.deepcopy(avatar).double()
    box = PosedBox.around(BODY, pose, avatar.config.box_margin)
    shown = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64).repeat(400, 1)
    total = torch.zeros(400, dtype=torch.float64)
    with torch.no_grad():
        field = exact.posed(pose)
        for pixels, rays, near, far in box_rays(camera, box.ends(torch.float64, "cpu"), box.frame):
            depths = even_depths(near, far, 64)
            own, through, _ = reference_rays(field, rays, depths, segment_lengths(depths, rays.lengths))
            shown[pixels] = own + (1 - through)[:, None] * shown[pixels]
            total[pixels] = through
    assert np.abs(alpha - total.view(20, 20).numpy()).max() < 1 / 255
    assert np.abs(rgb - shown.view(20, 20, 3).numpy()).max() < 1 / 255
    assert 0.05 < alpha.mean() < 0.9
    assert alpha.max() > 0.99


def test_kernel_rows_are_within_a_grey_level(monkeypatch):
    """Of a small picture; what they take is for `ihbench kernels`."""
    for name, value in (("SAMPLES", 32), ("TWIN_RAYS", 6), ("PATCH", 4)):
        monkeypatch.setattr(kernel, name, value)
    monkeypatch.setattr(kernel, "fitted", lambda: dense(least=1e-3))
    monkeypatch.setattr(kernel, "scene_of", lambda avatar, scene_of=kernel.scene_of: scene_of(avatar, 16))
    rows = kernel.volume_rows(1)
    assert [row.case.split()[0] for row in rows] == ["picture"] * 3 + ["patch"] * 2
    for row in rows:
        assert row.value_error is not None
        assert row.value_error < 1 / 255
        assert row.gradient_error is None or row.gradient_error < 2e-2


# ------------------------------------------------------------------------------------- check 7: the occluded slab


@dataclass
class Slab:
    """Half a metre of the same everywhere, a raw density and a colour to be learned."""

    raw: Tensor
    color: Tensor

    def likelihood(self, rays: Rays, depths: Tensor) -> Tensor:
        return torch.ones_like(depths)

    def values(self, points: Tensor) -> FieldValues:
        return FieldValues(self.color.sigmoid().expand_as(points), relu_density(self.raw.expand(len(points))))


def settled(hidden):
    """Alpha of a slab that a strip hides in a share of ten frames, under squared error on random backgrounds."""
    raw, color = torch.tensor([3.0], requires_grad=True), torch.zeros(3, requires_grad=True)
    adam = torch.optim.Adam([raw, color], lr=0.05)
    rays, rng = Rays(torch.zeros(100, 3), torch.tensor([[0.0, 0.0, 1.0]]).repeat(100, 1)), np.random.default_rng(0)
    depths = torch.linspace(1, 1.5, 6).repeat(100, 1)
    lengths = segment_lengths(depths, rays.lengths)
    covered, person = torch.arange(100)[:, None] < 100 * hidden, torch.tensor([0.8, 0.3, 0.1])
    late = []
    for step in range(300):
        adam.param_groups[0]["lr"] = 0.05 * 0.1 ** (step / 300)
        background = torch.from_numpy(rng.random((100, 3), np.float32))
        shown = march(Slab(raw, color), rays, depths, lengths).composited
        adam.zero_grad()
        (shown.on(background) - torch.where(covered, background, person)).square().mean().backward()
        adam.step()
        late.append(shown.alpha[0].item())
    return float(np.mean(late[-50:]))


@pytest.mark.parametrize("hidden", [0.2, 0.5, 0.8])
def test_check_7_alpha_of_what_is_hidden_in_a_share_p_of_the_frames_is_1_minus_p(hidden):
    assert settled(hidden) == pytest.approx(1 - hidden, abs=0.03)


# ------------------------------------------------------------------------------------------------- check 8: rates


def test_check_8_step_sizes_at_the_end():
    fit = HumanNerfFit(an_avatar(decay_steps=PAPER.decay_steps, steps=PAPER.steps), training_set(), 0, Ledger())
    fit.step = 400_000
    share = fit._rate_share()
    assert PAPER.lr * share == pytest.approx(7.92e-5, rel=1e-3)
    for slow in (PAPER.lr_motion, PAPER.lr_non_rigid, PAPER.lr_poses):
        assert slow * share == pytest.approx(7.92e-6, rel=1e-3)
    assert (PAPER.lpips, PAPER.mse, PAPER.patches, PAPER.patch_px) == (1.0, 0.2, 6, 32)
    assert (PAPER.samples, PAPER.inside, SMOKE.unknown) == (128, 0, "background")


# ------------------------------------------------------------------------------------------------------ the switch


def test_likelihoods_beyond_one_are_held_unless_told_otherwise():
    points = torch.from_numpy(BODY.joints[[3, 6, 9]].copy()).float()
    sums = []
    for clamp in (True, False):
        avatar = an_avatar(clamp=clamp)
        field = avatar.posed(T_POSE)
        doubled = BoneWeights(2 * field.weights.volume, field.weights.low, field.weights.high, field.weights.maps)
        sums.append(PosedField(avatar, doubled, field.pose).values(points).likelihood)
    assert sums[0] is not None
    assert sums[1] is not None
    assert sums[1].max() > 1.2
    assert torch.equal(sums[0], sums[1].clamp(max=1))


def test_a_correction_acts_on_given_poses_only_if_released():
    pictures = []
    for test_poses in ("released", "given"):
        avatar = dense(test_poses=test_poses)
        assert avatar.pose_correction is not None
        with torch.no_grad():
            avatar.pose_correction.layers[-1].bias.fill_(0.3)
        pictures.append(avatar.render(a_camera(0.0, SIZE // 2), a_pose())[1])
    assert np.abs(pictures[0] - pictures[1]).max() > 0.2
