"""3DGS-Avatar's parts: the acceptance checks of weights, warp, isometry and covariance, and its networks."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.errors import BadInput
from ihbench.fit.gaussians.neighbours import distance_to, nearest, spacing
from ihbench.fit.gaussians.skinned_covariance import quaternion_to_matrix
from ihbench.fit.training_poses import TrainingPoses
from ihbench.methods.three_dgs_avatar.avatar import ThreeDgsAvatar
from ihbench.methods.three_dgs_avatar.colours import ColourNetwork, canonical_directions, random_turn
from ihbench.methods.three_dgs_avatar.isometry import six_entries, stretching
from ihbench.methods.three_dgs_avatar.non_rigid import NonRigid, turned
from ihbench.methods.three_dgs_avatar.pose_code import PoseCode
from ihbench.methods.three_dgs_avatar.skinning_field import SkinningField, Tree
from ihbench.methods.three_dgs_avatar.star_body import StarBody
from ihbench.methods.three_dgs_avatar.stress import TINY
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view

from .tiny_fit import random_pose

BODY = the_body()
PARENTS = [int(p) for p in BODY.parents]
BETAS = np.array([0.6, -0.8, 0.3, 0, 0.5, 0, 0, 0, 0, 0])
STAR_POSE = BodyPose(canonical_pose("vitruvian"), BETAS, np.zeros(3))


def an_avatar(seed=0, betas=BETAS, frames=3, **changes):
    views = [train_view(a_camera(0.0, 32), a_pose(0.5 * k, 0.3), frame=10 * k) for k in range(frames)]
    return ThreeDgsAvatar(replace(TINY, **changes), BODY, betas, TrainingPoses.of(views), seed)


def shaken(avatar, by=0.3):
    """With noise on all parameters but the Gaussians'."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, p in avatar.named_parameters():
            if not name.startswith(("gaussians", "poses")):
                p += by * torch.randn(p.shape, generator=generator)
    return avatar


class Fixed(nn.Module):
    """A skinning field that is the same everywhere."""

    def __init__(self, weights):
        super().__init__()
        self.weights = torch.as_tensor(weights, dtype=torch.float32)

    def forward(self, places):
        return self.weights.expand(len(places), -1)


# --------------------------------------------------------------------------------- check 1: hierarchical softmax


def test_check_1_of_zero_logits():
    weights = Tree(PARENTS)(torch.zeros(2, 25, dtype=torch.float32))[0].double()
    shares = {0: 2, **dict.fromkeys((1, 2, 3), 12), **dict.fromkeys((4, 5, 6), 24), **dict.fromkeys(range(7, 12), 48),
              **dict.fromkeys(range(12, 16), 288), 16: 576, 17: 576, 18: 1152, 19: 1152,
              **dict.fromkeys(range(20, 24), 2304)}  # fmt: skip
    expected = torch.tensor([1 / shares[j] for j in range(24)], dtype=torch.float64)
    torch.testing.assert_close(weights, expected, rtol=1e-6, atol=0)
    assert weights.sum().item() == pytest.approx(1, abs=1e-6)
    assert (weights - torch.eye(24)[0]).square().sum().item() == pytest.approx(0.2783, abs=5e-5)


def test_shares_go_down_the_tree_as_said():
    """Against the rule written out: the parent's share is split between what it keeps and what it hands on."""
    logits = 3 * torch.randn(50, 25, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    has = torch.zeros(50, 24, dtype=torch.float64)
    has[:, 0] = 1
    for j in range(24):
        children = [k for k in range(24) if PARENTS[k] == j]
        if children:
            gate = logits[:, {0: 0, 9: 24}.get(j, children[0])].sigmoid()
            split = logits[:, children].softmax(1)
            has[:, children] = (gate * has[:, j])[:, None] * split
            has[:, j] = has[:, j] * (1 - gate)
    weights = Tree(PARENTS).double()(logits)
    torch.testing.assert_close(weights, has, atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(weights.sum(1), torch.ones(50, dtype=torch.float64))


def test_huge_logits_give_weights_and_gradients_that_are_finite():
    logits = (1e4 * torch.randn(20, 25, generator=torch.Generator().manual_seed(0))).requires_grad_()
    weights = Tree(PARENTS)(logits)
    weights.square().sum().backward()
    assert weights.isfinite().all()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()


# ---------------------------------------------------------------------------------------- check 2: the star pose


def test_check_2_in_the_star_pose_nothing_moves_whatever_the_weights():
    avatar = shaken(an_avatar(), 1.0)
    frame = avatar.star.frame(STAR_POSE)
    torch.testing.assert_close(frame.bones, torch.eye(4).expand(24, 4, 4), atol=1e-6, rtol=0)
    avatar.step = avatar.config.non_rigid_from - 1
    posed = avatar.posed(frame)
    weights = avatar.skinning(avatar.star.normalised(avatar.gaussians.means))
    assert weights.std(0).max() > 0.05, "weights that differ by place"
    torch.testing.assert_close(posed.means, avatar.gaussians.means, atol=1e-6, rtol=0)
    torch.testing.assert_close(posed.covariances, avatar.canonical_covariances(), atol=1e-8, rtol=1e-5)
    assert posed.codes is None
    avatar.step += 1
    assert (avatar.posed(frame).means - avatar.gaussians.means).abs().max() > 1e-3


def test_with_the_bodys_own_weights_bones_are_linear_blend_skinning():
    star = StarBody(BODY, BETAS)
    pose = random_pose(3, 0.4, BETAS)
    bones = star.frame(pose).bones
    blended = (star.weights @ bones.flatten(1)).unflatten(1, (4, 4))
    posed = (blended[:, :3, :3] @ star.vertices[:, :, None])[..., 0] + blended[:, :3, 3]
    expected = BODY.pose(pose, blend_shapes=False)
    # a point of the star pose is itself a blend: they agree where one bone moves it, and nearly elsewhere
    alone = BODY.weights.max(1) > 1 - 1e-9
    assert alone.mean() > 0.2
    assert np.abs(posed.numpy() - expected)[alone].max() < 1e-9
    assert np.abs(posed.numpy() - expected).max() < 0.1


def test_a_fitted_shape_moves_joints_and_star_pose_together():
    star, other = StarBody(BODY, np.zeros(10)), StarBody(BODY, BETAS)
    pose = random_pose(2, 0.3)
    betas = torch.from_numpy(BETAS).requires_grad_()
    got = star.frame_of(torch.tensor(pose.pose), torch.tensor(pose.transl), betas)
    torch.testing.assert_close(got.bones, other.frame(pose).bones, atol=1e-12, rtol=0)
    got.bones.sum().backward()
    assert betas.grad is not None
    assert betas.grad.isfinite().all()


# ------------------------------------------------------------------------------------------- check 3: isometry


def some_points(n=60):
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return points, nearest(points, 4)


def a_rotation(angle=1.1):
    return torch.from_numpy(axis_angle_to_matrix(angle * np.array([0.36, 0.48, 0.8])))


def test_check_3_of_positions():
    points, (distance, neighbours) = some_points()
    rigid = points @ a_rotation().T + torch.tensor([1.0, -2.0, 0.5])
    assert stretching(points, rigid, neighbours).item() < 1e-12
    grown = stretching(points, 1.1 * points, neighbours).item()
    assert grown == pytest.approx(0.1 * distance.mean().item(), rel=1e-9)
    avatar = shaken(an_avatar())
    own = nearest(avatar.gaussians.means, 4)[1]
    posed = avatar.posed(avatar.star.frame(STAR_POSE))
    assert stretching(avatar.gaussians.means, posed.means, own).item() < 1e-6
    bent = avatar.posed(avatar.star.frame(random_pose(1, 0.5, BETAS)))
    assert stretching(avatar.gaussians.means, bent.means, own).item() > 1e-4


def test_check_3_of_covariances():
    """Two covariances that differ by diag(-3, 3, 8)e-6 are 9.055e-6 apart, turned by 45° 8.544e-6."""
    pair = torch.diag_embed(torch.tensor([[4.0, 1.0, 1.0], [1.0, 4.0, 9.0]], dtype=torch.float64)) * 1e-6
    each_other = torch.tensor([[1], [0]])

    def changed(R, how="released"):
        return stretching(six_entries(pair, how), six_entries(R @ pair @ R.mT, how), each_other).item()

    def about_z(degrees):
        return torch.from_numpy(axis_angle_to_matrix(np.deg2rad([0, 0, degrees])))

    assert torch.linalg.vector_norm(six_entries(pair)[0] - six_entries(pair)[1]).item() == pytest.approx(
        9.055e-6, rel=1e-4
    )
    assert changed(torch.eye(3, dtype=torch.float64)) == 0  # a translation
    assert changed(about_z(90)) < 1e-18
    assert changed(about_z(45)) == pytest.approx(0.511e-6, abs=0.5e-9)
    assert changed(about_z(45), "invariant") < 1e-18
    assert changed(a_rotation(), "invariant") < 1e-18


def test_coinciding_neighbours_and_none_at_all_do_no_harm():
    """Clones lie where their source is."""
    points = torch.zeros(3, 3, requires_grad=True)
    loss = stretching(points, 2 * points + 1, torch.tensor([[1, 2], [0, 2], [0, 1]]))
    loss.backward()
    assert points.grad is not None
    assert points.grad.isfinite().all()
    assert stretching(points, points, torch.zeros(3, 0, dtype=torch.int64)).item() == 0


# ------------------------------------------------------------------------------------------ check 4: covariances


def test_check_4_what_skinning_makes_of_covariances():
    avatar = an_avatar()
    with torch.no_grad():
        avatar.gaussians.log_scales.add_(
            0.5 * torch.randn(len(avatar), 3, generator=torch.Generator().manual_seed(2))
        )
    rest = avatar.canonical_covariances()
    frame = avatar.star.frame(STAR_POSE)
    R = torch.from_numpy(axis_angle_to_matrix(np.array([0, 0, np.pi / 2]))).float()
    bones = torch.eye(4).repeat(24, 1, 1)
    bones[5, :3, :3] = R
    frame = replace(frame, bones=bones)
    avatar.skinning = Fixed(torch.eye(24)[5])
    torch.testing.assert_close(avatar.posed(frame).covariances, R @ rest @ R.T, atol=1e-9, rtol=1e-4)
    avatar.skinning = Fixed((torch.eye(24)[5] + torch.eye(24)[0]) / 2)
    blended = avatar.posed(frame).covariances
    ratio = torch.linalg.det(blended.double()) / torch.linalg.det(rest.double())
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.25), atol=1e-3, rtol=0)


# ------------------------------------------------------------------------------------------------- the networks


def test_the_networks_are_of_the_released_size():
    avatar = an_avatar(hash_size=16, hash_finest=2048)
    assert avatar.non_rigid is not None

    def weights(network):
        return sum(p.numel() for name, p in network.named_parameters() if not name.endswith("bias"))

    # what the facts count as multiplications for each Gaussian
    assert weights(avatar.non_rigid.layers) == 58_624
    assert weights(avatar.skinning) == 52_736
    assert weights(avatar.colours) == 9_344
    assert weights(avatar.non_rigid.pose_code) == 288 * 6 + 24 * (19 * 19 + 19 * 6)
    assert avatar.non_rigid.grid.table.numel() == 1_796_048
    assert tuple(avatar.latents.shape) == (3, 16)


def test_the_pose_code_goes_down_the_tree():
    """Joint by joint, each with its parent's code."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = PoseCode(PARENTS)
    generator = torch.Generator().manual_seed(1)
    rotations, joints = torch.randn(24, 9, generator=generator), torch.randn(24, 3, generator=generator)
    codes = {}
    whole = network.whole(torch.cat([rotations.flatten(), joints.flatten()]))
    for j, parent in enumerate(PARENTS):
        bone = joints[j] - joints[parent] if parent >= 0 else joints[j]
        inputs = torch.cat([rotations[j], joints[j], bone.norm()[None], codes[parent] if parent >= 0 else whole])
        hidden = F.relu(network.first[j] @ inputs + network.first_bias[j])
        codes[j] = network.second[j] @ hidden + network.second_bias[j]
    expected = torch.cat([codes[j] for j in range(24)])
    torch.testing.assert_close(network(rotations, joints), expected, atol=1e-5, rtol=1e-5)


def test_the_non_rigid_network_reads_grid_and_code_side_by_side():
    network = NonRigid(PARENTS, torch.Generator().manual_seed(0), 8, 32, 0.0)
    places = 2 * torch.rand(7, 3, generator=torch.Generator().manual_seed(1)) - 1
    rotations, joints = torch.eye(3).flatten().expand(24, 9), torch.rand(24, 3)
    x = torch.cat([network.grid((places + 1) / 2), network.pose_code(rotations, joints).expand(7, -1)], 1)
    layers = [network.layers.first, *network.layers.hidden, network.layers.last]
    assert [layer.out_features for layer in layers] == [128, 128, 128, 26]
    for layer in layers[:-1]:
        x = F.leaky_relu(layer(x), 0.01)
    x = layers[-1](x)
    got = network(places, rotations, joints)
    for own, columns in (
        (got.offset, x[:, :3]),
        (got.growth, x[:, 3:6]),
        (got.turn, x[:, 7:10]),
        (got.code, x[:, 10:]),
    ):
        torch.testing.assert_close(own, columns, atol=1e-5, rtol=1e-5)
    quiet = NonRigid(PARENTS, torch.Generator().manual_seed(0), 8, 32, 1e-5)(places, rotations, joints)
    assert quiet.offset.abs().max() < 1e-3 < got.offset.abs().max()


def test_a_turn_comes_before_the_gaussians_own():
    generator = torch.Generator().manual_seed(0)
    q, v = torch.randn(20, 4, generator=generator), torch.randn(20, 3, generator=generator)
    first = quaternion_to_matrix(torch.cat([torch.ones(20, 1), v], 1))
    torch.testing.assert_close(quaternion_to_matrix(turned(q, v)), first @ quaternion_to_matrix(q), atol=1e-5, rtol=0)


def test_absent_parts_of_a_colour_are_zeros():
    network = ColourNetwork()
    features, latent = torch.randn(5, 32), torch.randn(16)
    whole = torch.cat([features, torch.zeros(5, 15 + 16), latent.expand(5, -1)], 1)
    layers = [network.layers.first, *network.layers.hidden, network.layers.last]
    assert [(layer.in_features, layer.out_features) for layer in layers] == [(79, 64), (64, 64), (64, 3)]
    for layer in layers[:-1]:
        whole = F.leaky_relu(layer(whole), 0.01)
    torch.testing.assert_close(network(features, None, None, latent), layers[-1](whole).sigmoid())
    torch.testing.assert_close(
        network(features, None, torch.zeros(5, 16), latent), network(features, None, None, latent)
    )


def test_directions_turn_back_with_the_body():
    """A camera that turns with the body sees it from the same canonical direction."""
    generator = torch.Generator().manual_seed(0)
    means, center = torch.randn(9, 3, generator=generator), torch.tensor([0.0, 1.0, 4.0])
    R = a_rotation().float()
    still = canonical_directions(means, torch.eye(3).expand(9, 3, 3), center)
    moved = canonical_directions(means @ R.T, R.expand(9, 3, 3), center @ R.T)
    torch.testing.assert_close(moved, still, atol=1e-6, rtol=0)
    torch.testing.assert_close(still.norm(dim=1), torch.ones(9))
    turn = a_rotation(0.4).float()
    torch.testing.assert_close(
        canonical_directions(means, torch.eye(3).expand(9, 3, 3), center, turn), still @ turn.T
    )


def test_random_turns_are_of_the_released_kind():
    """x and z normal of 45°, cut at 90°; y even from 0° to 45° as released."""
    turns = {
        how: np.stack([random_turn(np.random.default_rng(k), how) for k in range(600)])
        for how in ("released", "normal")
    }
    for some in turns.values():
        assert np.abs(some @ some.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    about_y = {how: np.rad2deg(np.arcsin(some[:, 0, 2])) for how, some in turns.items()}  # of R_x R_y R_z
    assert about_y["released"].min() >= 0
    assert about_y["released"].max() <= 45
    assert about_y["released"].mean() == pytest.approx(22.5, abs=2)
    assert about_y["normal"].std() == pytest.approx(43, abs=4)
    about_x = np.rad2deg(np.arctan2(-turns["released"][:, 1, 2], turns["released"][:, 2, 2]))
    assert np.abs(about_x).max() <= 90 + 1e-9
    assert abs(about_x.mean()) < 5


# --------------------------------------------------------------------------------------------- where it starts


def test_gaussians_start_on_the_surface_evenly():
    star = StarBody(BODY, BETAS)
    points, weights = star.surface(np.random.default_rng(0), 4000)
    corners = star.vertices.numpy()[BODY.faces]
    assert distance_to(points, star.vertices)[0].max() < 0.05
    torch.testing.assert_close(weights.sum(1), torch.ones(4000, dtype=torch.float64))
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    high = corners.mean(1)[:, 1] > np.median(star.vertices[:, 1])
    share = areas[high].sum() / areas.sum()
    assert (points[:, 1] > np.median(star.vertices[:, 1])).double().mean().item() == pytest.approx(share, abs=0.03)
    # weights are those of the place: a nearby vertex has about the same
    number = distance_to(points, star.vertices)[1]
    assert (weights - star.weights[number]).abs().sum(1).median() < 0.05


def test_the_first_state():
    avatar = an_avatar()
    gaussians = avatar.gaussians
    assert len(avatar) == TINY.points
    torch.testing.assert_close(gaussians.opacities, torch.full((len(avatar),), 0.1))
    assert not gaussians.attributes["feature"].any()
    assert torch.equal(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(len(avatar), 4))
    torch.testing.assert_close(gaussians.scales, spacing(gaussians.means)[:, None].expand(-1, 3), rtol=1e-5, atol=0)
    places = avatar.star.normalised(gaussians.means)
    extent = np.ptp(avatar.star.vertices.numpy(), axis=0)
    bounds = (avatar.star.high - avatar.star.low).numpy()
    assert bounds == pytest.approx(extent * [1.2, 1.2, 1.8], rel=1e-5)
    assert places.abs().max() < 1
    torch.testing.assert_close(an_avatar(1).latents.std(), torch.tensor(1.0), atol=0.3, rtol=0)
    assert all(not torch.equal(a.latents, b.latents) for a, b in pairwise(map(an_avatar, range(3))))


def test_joints_are_normalised_by_the_shapes_range():
    star = StarBody(BODY, BETAS)
    shaped, joints = BODY.shaped(BETAS)
    centred = shaped - shaped.mean(0)
    low, span = centred.min(), centred.max() - centred.min()
    u = (joints - shaped.mean(0) - low + 0.05 * span) / span / 1.1
    torch.testing.assert_close(star.frame(STAR_POSE).joints, torch.from_numpy(2 * u - 1))


# ----------------------------------------------------------------------------------------------- test time, disk


def pictures(avatar, pose, frame=None):
    return avatar.render(a_camera(0.4, 32), pose, frame=frame)[0]


def opaque(avatar):
    with torch.no_grad():
        avatar.gaussians.opacity_logits.fill_(3.0)
    return avatar


def test_a_training_frame_has_its_own_code_and_pose_and_others_the_last():
    avatar = opaque(an_avatar())
    avatar.step = avatar.config.poses_from
    pose = replace(a_pose(0.5, 0.3), betas=BETAS)
    as_given = pictures(avatar, pose, 10)
    assert (as_given < 0.9).any(), "somebody is there"
    assert not np.array_equal(as_given, pictures(avatar, pose)), "the last frame's code"
    assert np.array_equal(pictures(avatar, pose), pictures(avatar, pose, 999)), "an unknown frame"
    assert not np.array_equal(pictures(avatar, pose), pictures(avatar, pose, 20)), "another frame's pose"
    with torch.no_grad():
        avatar.poses.poses[1, 0] += torch.tensor([0.0, 0.5, 0.0])
    refined = pictures(avatar, pose, 10)
    assert np.abs(refined - as_given).max() > 0.05
    avatar.config = replace(avatar.config, test_poses="given")
    np.testing.assert_allclose(pictures(avatar, pose, 10), as_given, atol=1e-4)
    avatar.config = replace(avatar.config, test_poses="released")
    avatar.step -= 1
    np.testing.assert_allclose(pictures(avatar, pose, 10), as_given, atol=1e-4, err_msg="not fitted yet")


def test_an_avatar_is_saved_whole(tmp_path):
    avatar = opaque(an_avatar(seed=3))
    avatar.step = avatar.config.steps
    avatar.gaussians = type(avatar.gaussians)(
        *(
            avatar.gaussians.attributes[name][::2]
            for name in ("means", "log_scales", "quaternions", "opacity_logits")
        ),
        {"feature": torch.randn(len(avatar) // 2, 32)},
        {name: avatar.gaussians.carried(name)[::2] for name in ("nearest", "seen")},
    )
    avatar.save(tmp_path)
    again = ThreeDgsAvatar.load(tmp_path, BODY)
    assert (len(again), again.step) == (TINY.points // 2, TINY.steps)
    for frame in (10, None):
        expected = pictures(avatar, a_pose(0.5, 0.3), frame)
        assert (expected < 0.9).any()
        assert np.array_equal(pictures(again, a_pose(0.5, 0.3), frame), expected)
    with pytest.raises(BadInput, match="was fitted on another body"):
        ThreeDgsAvatar.load(tmp_path, replace(BODY, weights=np.roll(BODY.weights, 1, 1)))
    words = (tmp_path / "avatar.json").read_text()
    (tmp_path / "avatar.json").write_text(words.replace('"frames": [', '"frames": ["x", '))
    with pytest.raises(BadInput, match="do not belong together"):
        ThreeDgsAvatar.load(tmp_path, BODY)


def test_a_body_without_blend_shapes_of_the_pose_and_without_uv_is_enough():
    bare = replace(BODY, posedirs=None, uv=np.zeros((0, 2)), uv_faces=np.zeros((0, 3), np.int32))
    views = [train_view(a_camera(0.0, 32), a_pose())]
    avatar = opaque(ThreeDgsAvatar(TINY, bare, BETAS, TrainingPoses.of(views), 0))
    assert avatar.render(a_camera(0.0, 32), a_pose())[1].max() > 0.5


def test_a_person_behind_the_camera_is_not_drawn():
    rgb, alpha = opaque(an_avatar()).render(a_camera(0.0, 32), a_pose(transl=(0, 0, 9.0)), (0.2, 0.4, 0.6))
    assert not alpha.any()
    assert np.allclose(rgb, [0.2, 0.4, 0.6])


def test_the_field_learns_the_bodys_weights():
    """Some steps on the surface: most of the error of the first state goes."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        field, star = SkinningField(PARENTS), StarBody(BODY, np.zeros(10)).float()
    optimizer = torch.optim.Adam(field.parameters(), lr=5e-3)
    losses = []
    for step in range(70):
        points, wanted = star.surface(np.random.default_rng(step), 256)
        loss = (field(star.normalised(points)) - wanted).square().sum(1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-10:]) < 0.5 * losses[0]
