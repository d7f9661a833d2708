"""The avatar: the person's fields, and what was before and behind the person while fitting, which is never drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.training_poses import PoseTables, TrainingPoses
from ihbench.methods.wild2avatar.config import Wild2AvatarConfig
from ihbench.methods.wild2avatar.person.body_fit import fit_to_body
from ihbench.methods.wild2avatar.person.canonical_body import CanonicalBody
from ihbench.methods.wild2avatar.person.human_field import HumanField
from ihbench.methods.wild2avatar.person.human_rays import HumanMarch, march_human
from ihbench.methods.wild2avatar.person.inverse_skinning import PosedBody
from ihbench.methods.wild2avatar.person.near_body import near_body, unit_rays
from ihbench.methods.wild2avatar.person.ray_samples import SampleCounts
from ihbench.methods.wild2avatar.person.sdf_network import SdfNetwork
from ihbench.methods.wild2avatar.scene_network import SceneNetwork

KIND = "wild2avatar"
RAYS_AT_ONCE = 4096  # when drawing
LEAST_DRAWN = 1e-3  # share of a ray's largest weight below which a sample has no colour in a picture


class Wild2AvatarAvatar(nn.Module):
    """Starts as a sphere; `fit_to_body` makes it the body."""

    outline: Tensor  # [P] the signed distance network's parameters when its surface was last looked at

    def __init__(
        self,
        config: Wild2AvatarConfig,
        body: Body,
        betas: NDArray[np.float64],
        training: TrainingPoses,
        seed: int,
    ):
        """Raises `BadInput` for shape coefficients that the body does not have."""
        super().__init__()
        self.config, self.body, self.training_poses = config, body, training
        self.betas = np.asarray(betas, np.float64)
        self.seed = seed
        self.canonical = CanonicalBody(body, self.betas)
        generator = torch.Generator().manual_seed(seed)
        self.field = HumanField(config, generator)
        self.scene = None
        if config.occlusion or config.scene == "network":
            frames = len(training.frames)
            self.scene = SceneNetwork(
                generator,
                config.scene_width,
                config.scene_depth,
                config.scene_skip,
                config.scene_frequencies,
                frames,
            )
        self.poses = PoseTables(training, self.betas) if config.refine_poses else None
        self.register_buffer("outline", parameters_to_vector(self.field.sdf.parameters()).detach().clone())

    @property
    def device(self) -> torch.device:
        return self.outline.device

    @property
    def counts(self) -> SampleCounts:
        config = self.config
        return SampleCounts(config.even_samples, config.sample_rounds, config.samples_by_weight, config.samples_extra)

    def fit_to_body(self) -> None:
        """The start: the body's own surface."""
        fit_to_body(self.field.sdf, self.canonical, self.seed, self.config.body_fit)
        self.look_at_outline()

    def look_at_outline(self) -> None:
        """What is beside the surface is from now on beside the one of now."""
        self.outline.copy_(parameters_to_vector(self.field.sdf.parameters()).detach())

    def outline_network(self) -> SdfNetwork:
        """The signed distance of the surface last looked at; not part of this module."""
        config = self.config
        network = SdfNetwork(
            torch.Generator(),
            config.sdf_width,
            config.sdf_depth,
            config.sdf_skip,
            config.sdf_frequencies,
            config.pose_conditioning,
        ).to(self.device)
        vector_to_parameters(self.outline, network.parameters())
        return network.requires_grad_(False)

    def bones(self, row: int) -> Tensor:
        """[24, 4, 4] of a training frame by its row in the tables: as fitted, or as given where poses are not."""
        if self.poses is not None:
            return self.canonical.bones(self.poses.poses[row], self.poses.transl[row], self.poses.betas)
        given = self.training_poses
        return self.canonical.bones_of(BodyPose(given.poses[row], self.betas, given.transl[row]))

    def followed(self, body_pose: BodyPose, frame: int | None) -> Tensor | None:
        """[69] rad of the pose that shape and colour follow when drawing; None for none."""
        if not self.config.pose_conditioning:
            return None
        if self.config.pose_at_test == "trained" and self.training_poses.row(frame) is None:
            return None
        return torch.from_numpy(body_pose.pose[1:].reshape(-1).astype(np.float32)).to(self.device)

    # --- drawing ---

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`. The person alone, in the pose
        given and the shape fitted, within .1 m of the posed body."""
        shape = None if self.poses is None else self.poses.betas
        posed = PosedBody(self.canonical, self.canonical.bones_of(body_pose, shape))
        near, far = near_body(camera, posed.vertices.double().cpu().numpy(), self.device)
        rgb = near.new_tensor(background).repeat(len(near), 1)
        alpha = torch.zeros_like(near)
        how = HumanMarch(self.counts, max(self.config.least_weight, LEAST_DRAWN))
        followed = self.followed(body_pose, frame)
        for pixels in (near < far).nonzero()[:, 0].split(RAYS_AT_ONCE):
            rays = unit_rays(camera, pixels)
            human = march_human(self.field, posed, rays, near[pixels], far[pixels], followed, how)
            rgb[pixels] = human.rgb + (1 - human.alpha)[:, None] * rgb[pixels]
            alpha[pixels] = human.alpha
        size = camera.height, camera.width
        return (
            rgb.clamp(0, 1).reshape(*size, 3).cpu().numpy(),
            alpha.clamp(0, 1).reshape(size).cpu().numpy(),
        )

    # --- on disk ---

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        given = self.training_poses
        write_avatar(
            folder,
            KIND,
            self,
            self.config,
            self.body,
            self.betas,
            frames=list(given.frames),
            poses=given.poses.tolist(),
            transl=given.transl.tolist(),
        )

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> Wild2AvatarAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            words = saved.words
            config = read(Wild2AvatarConfig, words["config"], "avatar.json: config")
            training = TrainingPoses(
                tuple(int(frame) for frame in words["frames"]), np.array(words["poses"]), np.array(words["transl"])
            )
            avatar = cls(config, body, np.array(words["betas"]), training, seed=0)
            avatar.load_state_dict(saved.tensors)
        return avatar.to(device)
