"""GauHuman's avatar: the acceptance checks of where it starts and how it is posed, and that it is saved whole."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.errors import BadInput
from ihbench.export.splat_cloud import splat_cloud
from ihbench.fit.big_pose.deformation import Deformation, inverse
from ihbench.fit.gaussians.density import divergence_to_nearest
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.methods.gauhuman.config import OCCGAUHUMAN_PROFILES, PAPER, PROFILES
from ihbench.render.splat import render_gaussians
from tests.bench.fake_capture import a_camera, a_pose, the_body

from .tiny_fit import random_pose
from .tiny_gaussians import an_avatar

BODY = the_body()
BETAS = np.array([0.6, -0.8, 0.3, 0, 0.5, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def exact():
    """The deformation in float64."""
    return Deformation(BODY)


def the_vertices(deformation):
    return deformation.vertices.clone(), torch.arange(len(deformation.vertices))


def with_blend_shapes():
    """The body with pose blend shapes that move vertices by centimetres."""
    posedirs = np.random.default_rng(0).normal(0, 2e-3, (*BODY.v_template.shape, 207))
    return replace(BODY, posedirs=posedirs)


# --------------------------------------------------------------------------------------------- check 1: posing


@pytest.mark.parametrize("body", [with_blend_shapes(), replace(BODY, posedirs=None)], ids=["with", "without"])
def test_check_1_the_first_cloud_stands_on_the_posed_body(body):
    """Without corrections: to 1e-7 in float64, where e^-20.7 for absent weights is left; to 1e-5 in float32."""
    for dtype, tolerance in ((torch.float64, 2e-7), (torch.float32, 1e-5)):
        deformation = Deformation(body).to(dtype)
        pose = random_pose(3, 0.4, BETAS)
        posed = deformation(*the_vertices(deformation), deformation.frame(pose))
        assert np.abs(posed.means.numpy() - body.pose(pose)).max() < tolerance


def test_a_canonical_point_has_its_nearest_vertex(exact):
    points = exact.vertices[::37] + 1e-4
    distance = torch.cdist(points, exact.vertices)
    assert torch.equal(exact.nearest(points), distance.argmin(1))


# --------------------------------------------------------------------------------------- check 2: covariances


def random_gaussians(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    scales = 0.005 + 0.03 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    return scales, torch.randn(n, 4, generator=generator, dtype=torch.float64)


def test_check_2_in_the_big_pose_covariances_stay(exact):
    points, vertex = the_vertices(exact)
    scales, quaternions = random_gaussians(len(points))
    rest = skinned_covariance(scales, quaternions)
    big = canonical_pose("big_pose")
    frame = exact.frame(BodyPose(big, np.zeros(10), np.zeros(3)))
    posed = exact(points, vertex, frame)
    assert (skinned_covariance(scales, quaternions, posed.linear) / rest - 1).abs().max() < 1e-6
    turned = big.copy()
    turned[0] = [0.3, -1.1, 0.4]
    posed = exact(points, vertex, exact.frame(BodyPose(turned, np.zeros(10), np.array([1.0, 2, 3]))))
    R = torch.from_numpy(axis_angle_to_matrix(turned[0]))
    torch.testing.assert_close(
        skinned_covariance(scales, quaternions, posed.linear), R @ rest @ R.T, atol=1e-12, rtol=0
    )


def test_check_2_the_linear_part_is_the_derivative_of_the_centre(exact):
    """Central differences, vertex and weights kept, with offsets and a correction."""
    points, vertex = the_vertices(exact)
    points, vertex = points[::60] + 0.01, vertex[::60]
    generator = torch.Generator().manual_seed(0)
    offsets = 0.3 * torch.randn(len(points), 24, generator=generator, dtype=torch.float64)
    correction = torch.from_numpy(axis_angle_to_matrix(np.random.default_rng(1).normal(0, 0.1, (23, 3))))
    more = (vertex, exact.frame(random_pose(5, 0.4, BETAS)), offsets, correction)
    linear = exact(points, *more).linear
    for axis in range(3):
        step = 1e-5 * torch.eye(3, dtype=torch.float64)[axis]
        difference = (exact(points + step, *more).means - exact(points - step, *more).means) / 2e-5
        torch.testing.assert_close(linear[:, :, axis], difference, atol=1e-8, rtol=0)


def test_inverses_by_cofactors():
    matrices = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(
        inverse(matrices) @ matrices, torch.eye(3).double().expand(50, 3, 3), atol=1e-9, rtol=0
    )


# ------------------------------------------------------------------------------------------- check 3: the start


def test_check_3_the_first_state():
    avatar = an_avatar()
    gaussians = avatar.gaussians
    assert len(avatar) == len(BODY.v_template)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(avatar),), 0.1))
    torch.testing.assert_close(avatar.sh, torch.full((len(avatar), 1, 3), -0.00695), atol=5e-6, rtol=0)
    assert not gaussians.attributes["sh_rest"].any()
    assert torch.equal(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(len(avatar), 4))
    points = gaussians.means.detach().double()[::501]
    distances = torch.cdist(points, gaussians.means.detach().double()).sort(1).values[:, 1:4]
    expected = distances.square().mean(1).sqrt()[:, None].expand(-1, 3)
    torch.testing.assert_close(gaussians.scales.detach().double()[::501], expected, rtol=1e-4, atol=1e-6)
    assert np.allclose(gaussians.means.detach(), BODY.pose(BodyPose(canonical_pose("big_pose"), [0.0], [0.0] * 3)))


def test_the_networks_are_of_the_released_size_and_start_as_released():
    avatar = an_avatar(weight_network=True)
    sizes = [sum(p.numel() for p in n.parameters()) for n in (avatar.pose_correction, avatar.weight_offsets)]
    assert sizes == [34_373, 68_888]
    turned = avatar.pose_correction(torch.full((23, 3), 0.5)) - torch.eye(3)
    assert 0 < turned.abs().max() < 1e-3
    offsets = avatar.weight_offsets(avatar.gaussians.means)
    assert 0.01 < offsets.std() < 0.3
    assert len({avatar.pose_correction.layers[0].weight[0, 0].item() for avatar in map(an_avatar, range(3))}) == 3


def test_no_gradient_goes_to_positions_through_the_weights():
    avatar = an_avatar(weight_network=True)
    avatar.weight_offsets(avatar.gaussians.means).square().sum().backward()
    assert avatar.gaussians.means.grad is None
    assert all(p.grad is not None for p in avatar.weight_offsets.parameters())


# --------------------------------------------------------------------------------------------- check 4: the gate


@pytest.mark.parametrize(
    ("scales", "apart", "divergence"),
    [
        ((0.01, 0.01), 0.0, 0.0),
        ((0.01, 0.01), 0.894, 0.4),
        ((0.01, 0.01), 0.447, 0.1),
        ((0.01, 0.02), 0.0, 0.9544),
        ((0.02, 0.01), 0.0, 2.4206),
    ],
)
def test_check_4_the_divergence_table(scales, apart, divergence):
    """`apart` in standard deviations."""
    means = torch.tensor([[0.0, 0, 0], [apart * 0.01, 0, 0]])
    log_scales = torch.tensor(scales).log()[:, None].expand(2, 3)
    pair = Gaussians(means, log_scales, torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4), torch.zeros(2))
    assert divergence_to_nearest(pair)[0][0].item() == pytest.approx(divergence, abs=5e-4)


# ------------------------------------------------------------------------------------------------ what is kept


def test_an_avatar_is_saved_with_any_number_of_gaussians(tmp_path):
    avatar = an_avatar(seed=3, weight_network=True)
    with torch.no_grad():
        for p in avatar.parameters():
            p += 0.01 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0))
    own = avatar.gaussians
    attributes = {name: p.detach()[::2] for name, p in own.attributes.items()}
    first = [attributes.pop(name) for name in ("means", "log_scales", "quaternions", "opacity_logits")]
    avatar.gaussians = Gaussians(*first, attributes, {"vertex": own.carried("vertex")[::2]})
    avatar.degree = 1
    avatar.save(tmp_path)
    again = type(avatar).load(tmp_path, BODY)
    assert (len(again), again.degree) == (len(own) // 2, 1)
    for expected, got in zip(*(a.render(a_camera(0.4, 48), a_pose(0.5)) for a in (avatar, again)), strict=True):
        assert np.array_equal(expected, got)


def test_what_is_no_avatar_of_this_body_is_refused(tmp_path):
    avatar = an_avatar()
    with pytest.raises(BadInput, match="no readable avatar"):
        type(avatar).load(tmp_path, BODY)
    avatar.save(tmp_path)
    with pytest.raises(BadInput, match="was fitted on another body"):
        type(avatar).load(tmp_path, with_blend_shapes())
    (tmp_path / "avatar.json").write_text((tmp_path / "avatar.json").read_text().replace('"gauhuman"', '"other"'))
    with pytest.raises(BadInput, match="of kind 'other', expected 'gauhuman'"):
        type(avatar).load(tmp_path, BODY)


def test_a_person_behind_the_camera_is_not_drawn():
    avatar = an_avatar()
    rgb, alpha = avatar.render(a_camera(0.0, 32), a_pose(transl=(0, 0, 9.0)), (0.2, 0.4, 0.6))
    assert not alpha.any()
    assert np.allclose(rgb, [0.2, 0.4, 0.6])


def test_the_profiles_keep_the_released_schedule():
    """Five changes between 5/12 and 3/4 of the steps, one reset at a third, the last sixth with directions."""
    for profile in (*PROFILES.values(), *OCCGAUHUMAN_PROFILES.values()):
        changes = [step for step in range(1, profile.steps + 1) if profile.density.changes_at(step)]
        assert [12 * step / profile.steps for step in changes] == pytest.approx([5, 6, 7, 8, 9])
        assert profile.white_reset * 3 == profile.steps
        degrees = [profile.degree_at(step) for step in range(1, profile.steps + 1)]
        assert sum(degrees) == profile.steps // 6 + 1
        assert max(degrees) == profile.highest_degree == 1
    assert (PAPER.steps, changes_of(PAPER)) == (1200, [500, 600, 700, 800, 900])


def changes_of(config):
    return [step for step in range(1, config.steps + 1) if config.density.changes_at(step)]


def test_what_is_exported_of_it_is_what_it_draws():
    """As files keep them: scales and quaternions of skinned covariances, harmonics, opacities."""
    avatar, camera, pose = an_avatar(), a_camera(size=48), a_pose(0.4)
    cloud, broken = splat_cloud(avatar.posed_gaussians(pose))
    assert (len(cloud), broken, cloud.degree) == (len(avatar), 0, avatar.degree)
    drawn = render_gaussians(
        *(
            torch.from_numpy(np.ascontiguousarray(v, np.float32))
            for v in (cloud.means, cloud.scales, cloud.harmonics)
        ),
        camera,
        quaternions=torch.from_numpy(np.float32(cloud.quaternions)),
        opacities=torch.from_numpy(np.float32(cloud.opacities)),
        sh_degree=cloud.degree,
        preset="3dgs",
    )[0]
    shown = avatar.render(camera, pose)[0]
    assert shown.std() > 0.02
    np.testing.assert_allclose(drawn.clamp(0, 1), shown, atol=2e-3)
