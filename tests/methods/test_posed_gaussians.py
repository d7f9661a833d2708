"""What is exported of an avatar is what it draws: `posed_gaussians` of the methods that have no test of their own."""

from importlib import import_module

import numpy as np
import pytest
import torch

from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, look_at
from ihbench.clock.threads import one_torch_thread
from ihbench.stress.six_views import training_set


@pytest.mark.parametrize("method", ["occgaussian", "occfusion", "gtu", "three_dgs_avatar"])
def test_what_is_exported_is_what_is_drawn(method):
    stress = import_module(f"ihbench.methods.{method}.stress")
    training = training_set()
    pose = training.views[2].body_pose
    with one_torch_thread():
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
    assert len(own.means) == len(avatar.gaussians)
    assert covered.max() > 0.3
    np.testing.assert_allclose(np.clip(rgb, 0, 1), shown, atol=2e-5)
    np.testing.assert_allclose(np.clip(alpha, 0, 1), covered, atol=2e-5)
