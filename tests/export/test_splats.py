"""Splat files: turned clouds look as before, harmonics included, and the glTF says what the PLY says."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ihbench.camera import Camera, look_at
from ihbench.export.glb import Glb
from ihbench.export.splat_cloud import harmonics_turn, splat_cloud
from ihbench.export.splat_glb import linear, splat_glb
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.render.spherical_harmonics import basis
from ihbench.render.splat import render_gaussians
from tests.export.glb_reader import GlbFile


def some_gaussians(n=60, degree=2, seed=0):
    rng = np.random.default_rng(seed)

    def tensor(values):
        return torch.from_numpy(np.ascontiguousarray(values))

    quaternions = tensor(rng.normal(size=(n, 4)))
    scales = tensor(rng.uniform(0.02, 0.15, (n, 3)))
    return PosedGaussians(
        tensor(rng.normal((1, 2, 3), 0.4, (n, 3))),
        skinned_covariance(scales, quaternions),
        tensor(rng.normal(0, 0.3, (n, (degree + 1) ** 2, 3))),
        None,
        tensor(rng.uniform(0.2, 0.9, n)),
        degree,
    )


def drawn(means, scales, harmonics, opacities, camera, degree, quaternions=None):
    values = [torch.as_tensor(v) for v in (means, scales, harmonics)]
    turns = None if quaternions is None else torch.as_tensor(quaternions)
    return render_gaussians(
        *values, camera, backend="reference", quaternions=turns, opacities=torch.as_tensor(opacities),
        sh_degree=degree, preset="3dgs",
    )[0].numpy()  # fmt: skip


def test_a_turned_cloud_looks_the_same_from_where_it_was_seen():
    given = some_gaussians()
    cloud, broken = splat_cloud(given)
    assert broken == 0
    K = np.array([[60.0, 0, 20], [0, 60, 16], [0, 0, 1]])
    R, t = look_at(np.array([1.0, 2.2, 6.0]), np.array([1.0, 2, 3]))
    camera = Camera(K, R, t, 40, 32)
    before = drawn(given.means, given.scales, given.colors, given.opacities, camera, 2)
    assert before.std() > 0.05
    turn, origin = Rotation.from_euler("xyz", [170, 25, -60], degrees=True).as_matrix(), np.array([0.5, -1, 2])
    moved = cloud.turned(turn, origin)
    there = Camera(K, R @ turn.T, t + R @ origin, 40, 32)
    after = drawn(moved.means, moved.scales, moved.harmonics, moved.opacities, there, 2, moved.quaternions)
    np.testing.assert_allclose(after, before, atol=1e-5)
    still = drawn(moved.means, moved.scales, cloud.harmonics, moved.opacities, there, 2, moved.quaternions)
    assert np.abs(still - before).max() > 0.02  # the harmonics had to turn


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_turn_with_the_rotation(degree):
    R = Rotation.random(random_state=degree).as_matrix()
    turn = harmonics_turn(R, degree)
    np.testing.assert_allclose(turn @ turn.T, np.eye(len(turn)), atol=1e-9)
    coefficients = np.random.default_rng(0).normal(size=len(turn))
    directions = Rotation.random(20, random_state=9).apply([0, 0, 1])
    before = basis(torch.from_numpy(directions), degree).numpy() @ coefficients
    after = basis(torch.from_numpy(directions @ R.T), degree).numpy() @ (turn @ coefficients)
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_gaussians_of_every_kind_become_scales_and_quaternions():
    given = some_gaussians(degree=0)
    cloud, _ = splat_cloud(given)
    axes = Rotation.from_quat(cloud.quaternions[:, [1, 2, 3, 0]]).as_matrix() * cloud.scales[:, None]
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), given.scales.numpy(), atol=1e-12)
    wide = cloud.widened(0.05)
    axes = Rotation.from_quat(wide.quaternions[:, [1, 2, 3, 0]]).as_matrix() * wide.scales[:, None]
    covariance = given.scales.numpy() + 0.05**2 * np.eye(3)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), covariance, atol=1e-12)
    round_ones = PosedGaussians(
        given.means, torch.full((60,), 0.1), torch.rand(60, 3, generator=torch.manual_seed(0))
    )
    cloud, _ = splat_cloud(round_ones)
    np.testing.assert_allclose(cloud.colors, round_ones.colors, atol=1e-6)
    assert (cloud.scales == np.float32(0.1)).all()
    assert (cloud.opacities == 0.999).all()


def test_broken_gaussians_are_left_out_and_counted():
    given = some_gaussians()
    given.means[3, 1], given.opacities[5], given.colors[7, 2, 0] = torch.nan, torch.inf, torch.nan
    cloud, broken = splat_cloud(given)
    assert (len(cloud), broken) == (57, 3)
    assert np.isfinite(cloud.means).all()


@pytest.mark.parametrize("degree", [0, 3])
def test_the_gltf_has_what_the_extension_asks_for(degree):
    cloud, _ = splat_cloud(some_gaussians(degree=degree))
    file = GlbFile(splat_glb(cloud, Glb("test"), {"pose": "a"}))
    assert file.check_bounds() == 1
    (primitive,) = file.json["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert "KHR_gaussian_splatting" in file.json["extensionsUsed"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    a = file.attributes()
    own = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(a["POSITION"], cloud.means, rtol=1e-6)
    np.testing.assert_allclose(a[own + "SCALE"], cloud.scales, rtol=1e-6)  # linear
    np.testing.assert_allclose(a[own + "OPACITY"][:, 0], cloud.opacities, rtol=1e-6)
    np.testing.assert_allclose(a[own + "ROTATION"], cloud.quaternions[:, [1, 2, 3, 0]], atol=1e-6)
    names = [f"{own}SH_DEGREE_{d}_COEF_{k}" for d in range(degree + 1) for k in range(2 * d + 1)]
    np.testing.assert_allclose(np.stack([a[name] for name in names], 1), cloud.harmonics, rtol=1e-6)
    assert sorted(a) == sorted(["POSITION", "COLOR_0", *(own + n for n in ("SCALE", "OPACITY", "ROTATION")), *names])
    np.testing.assert_allclose(a["COLOR_0"][:, :3], linear(cloud.colors), atol=1e-4)


def test_linear_light():
    np.testing.assert_allclose(linear(np.array([0, 0.04045, 0.5, 1])), [0, 0.0031308, 0.2140411, 1], atol=1e-6)
