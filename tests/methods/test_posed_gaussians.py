"""What is exported of an avatar is what it draws: `posed_gaussians` of the methods that have no test of their own."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import torch

from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, look_at
from ihbench.fit.gaussians.view_colours import DEGREE, view_harmonics
from ihbench.render.spherical_harmonics import colors_of
from ihbench.stress.six_views import training_set


@pytest.mark.parametrize("method", ["occgaussian", "occfusion", "gtu", "three_dgs_avatar"])
def test_what_is_exported_is_what_is_drawn(method):
    stress = import_module(f"ihbench.methods.{method}.stress")
    training = training_set()
    pose = training.views[2].body_pose
    avatar = stress.start(stress.TINY, training)
    with torch.no_grad():  # colours that differ from Gaussian to Gaussian
        for name, values in avatar.gaussians.attributes.items():
            if name in ("sh_dc", "feature", "opacity_logits"):
                values += 0.5 * torch.randn(values.shape, generator=torch.Generator().manual_seed(0))
    pelvis = avatar.body.posed_joints(pose)[0]
    R, t = look_at(pelvis + 3 * axis_angle_to_matrix(pose.pose[0])[:, 2], pelvis)
    camera = Camera(np.array([[60.0, 0, 24], [0, 60, 24], [0, 0, 1]]), R, t, 48, 48)
    own = avatar.posed_gaussians(pose)
    rgb, alpha = (x.detach().numpy() for x in own.draw(camera, (1.0, 1.0, 1.0)))
    shown, covered = avatar.render(camera, pose)
    other = replace(pose, pose=pose.pose + 0.2 * np.random.default_rng(0).normal(size=(24, 3)))
    moved = avatar.posed_gaussians(other)
    assert len(own.means) == len(avatar.gaussians)
    assert covered.max() > 0.3
    nearly = 0.02 if method == "three_dgs_avatar" else 2e-5  # a network of the direction of view, as harmonics
    np.testing.assert_allclose(np.clip(rgb, 0, 1), shown, atol=nearly)
    np.testing.assert_allclose(np.clip(alpha, 0, 1), covered, atol=2e-5)
    # what it says that it is skinned with takes its Gaussians from one pose to another
    assert own.weights is not None
    np.testing.assert_allclose(own.weights.sum(1), 1, atol=1e-5)
    if method == "three_dgs_avatar":  # which blends products of transforms, softly before it is trained
        return
    here, there = (own.weights.numpy() @ _flat(avatar.body, p) for p in (pose, other))
    here, there = (blend.reshape(-1, 3, 4) for blend in (here, there))
    rest = np.linalg.solve(here[:, :, :3], (own.means.numpy() - here[:, :, 3])[:, :, None])
    predicted = (there[:, :, :3] @ rest)[:, :, 0] + there[:, :, 3]
    assert np.abs(moved.means.numpy() - own.means.numpy()).max() > 0.05
    np.testing.assert_allclose(predicted, moved.means.numpy(), atol=5e-3)  # poses are corrected a little


def test_colours_of_every_direction_become_harmonics():
    rng = np.random.default_rng(0)
    means = torch.from_numpy(rng.normal((1, 2, 3), 0.4, (20, 3)))
    given = torch.from_numpy(rng.normal(0, 0.05, (20, 16, 3)))

    def seen(camera):
        return colors_of(given, means, torch.from_numpy(camera.center), DEGREE)

    found = view_harmonics(means, np.array([1.0, 2, 3]), seen)
    np.testing.assert_allclose(found, given, atol=1e-6)
    flat = view_harmonics(means, np.array([1.0, 2, 3]), lambda _: torch.full((20, 3), 0.7, dtype=torch.float64))
    np.testing.assert_allclose(flat[:, 0], 0.2 / 0.28209479, atol=1e-6)
    np.testing.assert_allclose(flat[:, 1:], 0, atol=1e-6)


def _flat(body, pose):
    return body.joint_transforms(pose)[:, :3].reshape(24, 12).astype(np.float32)
