"""The prior in closed form, the weight volume, and the warp back to the T-pose against their formulas."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from ihbench.body.pose import BodyPose
from ihbench.body.skinning import axis_angle_to_matrix
from ihbench.nets.bone_lookups import BoneWeights
from ihbench.nets.bone_maps import bone_maps, root_frame
from ihbench.nets.motion_weights import (
    BACKGROUND,
    MotionWeightVolume,
    bone_gaussians,
    joint_box,
    lattice,
    prior_weights,
)
from ihbench.render.volumes.intervals import box_interval, even_depths
from ihbench.render.volumes.rays import Rays
from tests.bench.fake_capture import the_body

BODY = the_body()
PARENTS = [int(p) for p in BODY.parents]
JOINTS = torch.from_numpy(BODY.joints.copy())
SMALL = (32, 16, 16, 8, 8)


def a_volume(seed=0):
    return MotionWeightVolume(JOINTS, PARENTS, torch.Generator().manual_seed(seed), 16, SMALL)


def corrected(seed=0):
    """A volume whose decoder says something."""
    volume = a_volume(seed)
    with torch.no_grad():
        volume.ups[-1].weight.mul_(30)
    return volume


def a_frame(seed=0, spread=0.4):
    rotations = axis_angle_to_matrix(torch.from_numpy(np.random.default_rng(seed).normal(0, spread, (23, 3))))
    return bone_maps(rotations, JOINTS, JOINTS, PARENTS)


def some_points(count=3000, seed=0):
    low, high = joint_box(JOINTS)
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return low + (high - low) * share


# ------------------------------------------------------------------------------------------------------- the prior


def test_the_prior_of_bones():
    """1 in the middle of a bone, exp(-(L/2)²/.0144) at either end, exp(-r²/.0036) beside it; the trunk is wider."""
    knee, ankle, wrist = 4, 7, 20
    joints = JOINTS
    middle, half = (joints[knee] + joints[ankle]) / 2, (joints[ankle] - joints[knee]) / 2
    across = torch.linalg.cross(half, torch.tensor([1.0, 0.3, 0.2], dtype=torch.float64))
    across /= across.norm()
    points = torch.stack([middle, joints[knee], joints[ankle], middle + 0.05 * across])
    own = bone_gaussians(points, joints, PARENTS)[:, knee]
    at_end = math.exp(-half.square().sum().item() / 0.0144)
    assert own.tolist() == pytest.approx([1, at_end, at_end, math.exp(-0.0025 / 0.0036)])
    spine = (joints[3] + joints[6]) / 2
    up = joints[6] - joints[3]
    beside = torch.linalg.cross(up, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    point = spine + 0.05 * beside / beside.norm()
    assert bone_gaussians(point, joints, PARENTS)[3].item() == pytest.approx(math.exp(-0.0025 / 0.0081))
    ends = bone_gaussians(joints[[10, 22, 15]] + torch.tensor([0.03, 0, 0]), joints, PARENTS)
    assert ends[0, 10].item() == pytest.approx(math.exp(-0.0009 / 0.0016))
    assert ends[1, 22].item() == pytest.approx(math.exp(-0.0009 / 0.0016))
    assert ends[2, 15].item() == pytest.approx(math.exp(-0.0009 / 0.0144))
    assert bone_gaussians(joints[wrist], joints, PARENTS).shape == (24,)


def test_the_prior_at_joints_of_the_benchs_body():
    """Figures computed when the released code was read."""
    gaussians = bone_gaussians(JOINTS, JOINTS, PARENTS)
    weights = prior_weights(gaussians)
    assert torch.allclose(weights.sum(1), torch.ones(24, dtype=torch.float64))
    assert gaussians[4, 4].item() == pytest.approx(0.0608, abs=5e-4)
    assert gaussians[4].sum().item() == pytest.approx(0.1277, abs=5e-4)
    assert weights[4, BACKGROUND].item() == pytest.approx(0.8723, abs=5e-4)
    assert weights[7, 7].item() == pytest.approx(0.753, abs=1e-3)
    assert weights[18, 18].item() == pytest.approx(0.337, abs=1e-3)
    assert weights[18, BACKGROUND].item() == pytest.approx(0.365, abs=1e-3)
    assert weights[15, 15].item() == pytest.approx(0.518, abs=1e-3)
    assert weights[15, BACKGROUND].item() == 0


def test_a_bone_along_minus_y_is_no_special_case():
    joints = JOINTS.clone()
    joints[7] = joints[4] - torch.tensor([0, 0.4, 0])
    weights = bone_gaussians(some_points(50), joints.requires_grad_(), PARENTS)
    weights.sum().backward()
    assert weights.isfinite().all()
    assert joints.grad is not None
    assert joints.grad.isfinite().all()


# ------------------------------------------------------------------------------------------------------ the volume


def test_a_decoder_that_says_nothing_gives_the_prior():
    volume = a_volume()
    with torch.no_grad():
        volume.ups[-1].weight.zero_()
    points = lattice(volume.low.double(), volume.high.double())
    prior = prior_weights(bone_gaussians(points, JOINTS, PARENTS)).permute(3, 0, 1, 2)
    assert torch.allclose(volume().double(), prior, atol=1e-6)


def test_a_channel_without_prior_stays_empty_and_nothing_is_nan():
    volume = corrected()
    weights = volume()
    empty = volume.log_prior == -math.inf
    assert 0.5 < empty.float().mean() < 0.75
    assert (weights[empty] == 0).all()
    assert torch.allclose(weights.sum(0), torch.ones(32, 32, 32), atol=1e-5)
    assert (weights - volume.log_prior.exp()).abs().max() > 0.1, "the decoder changed nothing: no test"
    weights[:, 5:9].square().sum().backward()
    for p in volume.parameters():
        assert p.grad is not None
        assert p.grad.isfinite().all()
        assert p.grad.abs().max() > 0


def test_the_released_decoder_has_its_size_and_starts_without_a_chequerboard():
    sizes = (1024, 512, 512, 256, 256, 25)
    parameters = 256 + 256 * 1024 + 1024 + sum(64 * a * b + b for a, b in pairwise(sizes))
    assert parameters == pytest.approx(63.6e6, rel=1e-3)
    kernel = a_volume().ups[1].weight
    for axis in (2, 3, 4):
        even, odd = (kernel.narrow(axis, 0, 4).index_select(axis, torch.tensor(k)) for k in ([0, 2], [1, 3]))
        assert torch.equal(even, odd)


# --------------------------------------------------------------------------------------------------------- the warp


def test_bone_maps_bring_posed_points_back():
    """What skinning with one bone alone takes into a pose, that bone's map takes back, in the root's frame."""
    rng = np.random.default_rng(3)
    body_pose = BodyPose(rng.normal(0, 0.4, (24, 3)), np.zeros(10), rng.normal(0, 1, 3))
    R, t = root_frame(body_pose, BODY.joints)
    rotations = axis_angle_to_matrix(torch.tensor(body_pose.pose[1:]))
    shifted = JOINTS + torch.tensor([0.0, 0.02, 0.01])
    maps = bone_maps(rotations, JOINTS, shifted, PARENTS).numpy()
    transforms = BODY.joint_transforms(body_pose)
    for j in range(24):
        point = BODY.joints[j] + rng.normal(0, 0.1, 3)
        posed = R @ (transforms[j, :3, :3] @ point + transforms[j, :3, 3]) + t
        back = maps[j, :, :3] @ posed + maps[j, :, 3]
        assert np.allclose(back - shifted[j].numpy(), point - BODY.joints[j], atol=1e-12)


def test_zero_pose_and_equal_joints_leave_points_where_they_are():
    """x_can = x wherever f ≥ 1e-4, 0 where f = 0, and f = 1 - w_bg to interpolation error."""
    volume = a_volume()
    with torch.no_grad():
        volume.ups[-1].weight.zero_()
    maps = bone_maps(torch.eye(3, dtype=torch.float64).expand(23, 3, 3), JOINTS, JOINTS, PARENTS)
    points = some_points(20_000)
    weights = BoneWeights(volume(), volume.low, volume.high, maps.float())
    f, places = weights.located(points.float())
    sure = f > 1e-4
    assert 0.1 < sure.float().mean() < 0.4
    assert (places - points)[sure].abs().max() < 1e-5
    assert (places[f == 0] == 0).all()
    assert (f == 0).any()
    # on the lattice exactly; between, toes are narrower (4 cm) than its steps (6 to 8 cm)
    points = lattice(volume.low.double(), volume.high.double()).flatten(0, 2)
    background = prior_weights(bone_gaussians(points, JOINTS, PARENTS))[:, BACKGROUND]
    assert (weights.located(points.float())[0] - (1 - background)).abs().max() < 1e-4


def test_outside_the_lattice_there_is_nothing():
    volume = corrected()
    weights = BoneWeights(volume(), volume.low, volume.high, a_frame().float())
    far = volume.high + 1.0 + torch.rand(50, 3)
    f, places = weights.located(far)
    assert (f == 0).all()
    assert (places == 0).all()


@pytest.mark.parametrize("least", [0.0, 1e-4])
def test_the_kernels_are_their_twin_forward_and_back(least):
    volume = corrected()
    points = some_points(4000)
    results = []
    for exact in (False, True):
        where = points if exact else points.float()
        lattice_values = volume().detach().to(where).requires_grad_()
        maps = a_frame().to(where).requires_grad_()
        weights = BoneWeights(lattice_values, volume.low.to(where), volume.high.to(where), maps)
        f, places = weights.located_by_torch(where) if exact else weights.located(where, least)
        firm = f.detach() > 1e-2  # beyond, the mean place is divided by what is cut off
        loss = f.sin().sum() + places[firm].cos().sum()
        loss.backward()
        # what reaches the decoder through the softmax: a weight's gradient counts by the weight
        of_volume = lattice_values.grad * lattice_values.detach()
        results.append((f.detach(), torch.where(firm[:, None], places.detach(), 0), of_volume, maps.grad))
    (f, places, of_volume, of_maps), (f2, places2, of_volume2, of_maps2) = results
    assert (f - f2).abs().max() <= 24 * least + 1e-5
    assert (places - places2).abs().max() <= 2e-5 + 2400 * least
    for one, other in ((of_volume, of_volume2), (of_maps, of_maps2)):
        assert ((one - other).norm() / other.norm()).item() < (1e-4 if least == 0 else 2e-2)
    assert of_maps2.norm() > 0


def test_the_twins_gradient_is_right():
    """Of few points, by differences."""
    values = torch.rand(3, 4, 5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    maps = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
    maps[:, :, 3] = torch.tensor([[0.1, 0, 0], [0, 0.23, 0], [0, 0.1, -0.2]])
    low, high = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def f(values, maps):
        return torch.cat([x.flatten() for x in BoneWeights(values, low, high, maps).located(points)])

    assert torch.autograd.gradcheck(f, (values.requires_grad_(), maps.requires_grad_()))


@pytest.mark.parametrize("least", [0.0, 1e-4])
def test_likelihoods_along_rays_are_those_of_their_points(least):
    volume = corrected()
    maps = a_frame(1).float()
    weights = BoneWeights(volume().detach(), volume.low, volume.high, maps)
    generator = torch.Generator().manual_seed(4)
    origins = torch.tensor([0.2, 0.1, 3.0]).repeat(400, 1)
    directions = torch.cat([0.6 * torch.rand(400, 2, generator=generator) - 0.3, -torch.ones(400, 1)], 1)
    directions[0] = torch.tensor([0.0, 0.0, -1.0])  # along an axis of every bone that is not turned
    rays = Rays(origins, directions)
    near, far = box_interval(rays, volume.low, volume.high)
    depths = even_depths(near, far.maximum(near + 0.1), 64)
    f = weights.likelihood(rays, depths, least)
    exact, _ = weights.located_by_torch(rays.points(depths).flatten(0, 1))
    assert (f - exact.view_as(f)).abs().max() <= 24 * least + 1e-5
    assert (f > 0.5).any()
