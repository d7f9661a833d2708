"""The avatar: Gaussians on the vertices of the canonical body, skinned to a pose and splatted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.gaussians.gaussian_set import Carried, Gaussians
from ihbench.fit.gaussians.harmonics import grey_harmonics, harmonics_in_use
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.methods.gtu.config import GtuConfig
from ihbench.methods.gtu.deformation import Deformation
from ihbench.render.zbuffer import vertex_normals

KIND = "gtu"
VERTEX = "vertex"  # what each Gaussian carries: the vertex that it is, -1 for one that was made later
NONE = -1


class GtuAvatar(nn.Module):
    """Gaussians that start on the vertices, grey and of opacity .9, their -z along the normal; and the training
    frames' poses, which are refined and drawn with in training alone. `degree` is that of the harmonics in use."""

    def __init__(
        self,
        config: GtuConfig,
        body: Body,
        betas: NDArray[np.float64],  # [B] the person's shape
        poses: Sequence[NDArray[np.float64]] = (),  # each [24, 3] rad, of the training frames
    ):
        super().__init__()
        self.config, self.body, self.betas = config, body, np.asarray(betas, np.float64)
        self.degree = 0
        self.deformation = Deformation(body, self.betas, config.grid)
        turns = minus_z_to(vertex_normals(self.deformation.vertices.numpy(), body.faces))
        self.deformation.float()
        vertices = self.deformation.vertices
        n = len(vertices)
        self.gaussians = Gaussians.on(
            vertices,
            config.opacity,
            grey_harmonics(n, config.grey, config.highest_degree),
            {VERTEX: Carried(torch.arange(n), NONE)},
        )
        self.gaussians.quaternions.data.copy_(torch.from_numpy(turns))
        self.poses = nn.ParameterList([nn.Parameter(torch.from_numpy(np.array(pose)).float()) for pose in poses])

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def device(self) -> torch.device:
        return self.gaussians.means.device

    def draw(
        self,
        pose: Tensor,  # [24, 3] rad
        joints: Tensor,  # [24, 3] m
        transl: Tensor,  # [3] m
        camera: Camera,
        background: Sequence[float] | Tensor,
        outputs: Sequence[str] = ("rgb", "alpha"),
    ) -> tuple:
        """What `render_gaussians` gives of the body in a pose. The harmonics see the direction in the world, so the
        same surface has other directions where the root does not turn; as released."""
        return self.posed(pose, joints, transl).draw(camera, background, outputs)

    def posed(self, pose: Tensor, joints: Tensor, transl: Tensor) -> PosedGaussians:
        """As they are drawn; arguments of `draw`."""
        means, turns = self.deformation(self.gaussians.means, pose, joints, transl)
        covariances = skinned_covariance(self.gaussians.scales, self.gaussians.quaternions, turns)
        harmonics = harmonics_in_use(self.gaussians, self.degree)
        return PosedGaussians(means, covariances, harmonics, None, self.gaussians.opacities, self.degree)

    @torch.no_grad()
    def posed_gaussians(self, body_pose: BodyPose) -> PosedGaussians:
        """See `scene.contracts.Avatar`."""
        pose, transl = (torch.from_numpy(np.array(x)) for x in (body_pose.pose, body_pose.transl))
        joints = self.deformation.joints(body_pose.betas)
        posed = self.posed(pose.to(joints), joints, transl.to(joints))
        return replace(posed, weights=self.deformation.weights(self.gaussians.means))

    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,  # poses that were refined are for training alone
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`."""
        with torch.no_grad():
            rgb, alpha = self.posed_gaussians(body_pose).draw(camera, background)
        return rgb.clamp(0, 1).cpu().numpy(), alpha.clamp(0, 1).cpu().numpy()

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        write_avatar(folder, KIND, self, self.config, self.body, self.betas, degree=self.degree)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> GtuAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            tensors = saved.tensors
            config = read(GtuConfig, saved.words["config"], "avatar.json: config")
            frames = sum(name.startswith("poses.") for name in tensors)
            betas = np.array(saved.words["betas"], np.float64)
            avatar = cls(config, body, betas, [np.zeros((24, 3))] * frames)
            avatar.gaussians = avatar.gaussians.saved(tensors, "gaussians.")
            avatar.load_state_dict(tensors)
            avatar.degree = min(max(int(saved.words["degree"]), 0), config.highest_degree)
        return avatar.to(device)


def minus_z_to(
    normals: NDArray[np.float64],  # [N, 3] of length 1, or 0
) -> NDArray[np.float64]:
    """[N, 4] quaternions, w first, of the shortest turn that takes (0, 0, -1) to each; about x where it is half a
    turn, none where there is no normal."""
    x, y, z = normals.T
    out = np.stack([1 - z, y, -x, np.zeros_like(x)], 1)  # (1 + cosine, cross product)
    out[(1 - z) < 1e-12] = (0, 1, 0, 0)
    out[~normals.any(1)] = (1, 0, 0, 0)
    return out / np.linalg.norm(out, axis=1, keepdims=True)
