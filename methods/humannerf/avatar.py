"""The avatar: a radiance field in the T-pose, motion weights, offsets and corrections by the pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.body.skinning import axis_angle_to_matrix
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.rays.ray_target import PosedBox
from ihbench.methods.humannerf.config import HumanNerfConfig
from ihbench.methods.humannerf.networks import CanonicalNetwork, NonRigidNetwork
from ihbench.nets.bone_lookups import BoneWeights
from ihbench.nets.bone_maps import bone_maps
from ihbench.nets.motion_weights import MotionWeightVolume
from ihbench.nets.pose_correction import PoseCorrection
from ihbench.nets.positional_encoding import band_window
from ihbench.render.volumes.density_laws import relu_density
from ihbench.render.volumes.fast import Drawn, Skipping, draw_image
from ihbench.render.volumes.field import FieldValues
from ihbench.render.volumes.rays import Rays

KIND = "humannerf"
POSE_SHIFT = 0.01  # rad added to every angle that a network reads, as released (train.py:409-412)


@dataclass(frozen=True)
class PosedField:
    """The field as it is seen in one pose, in the root's frame; a `render.volumes.field.Field`."""

    avatar: HumanNerfAvatar = field(repr=False)
    weights: BoneWeights
    pose: Tensor  # [69] rad, for the non-rigid network
    by_torch: bool = False  # look weights up by `grid_sample`, for every bone everywhere

    def likelihood(self, rays: Rays, depths: Tensor) -> Tensor:
        return self.weights.likelihood(rays, depths, self.avatar.config.least_weight)

    def values(self, points: Tensor) -> FieldValues:
        avatar, config = self.avatar, self.avatar.config
        if self.by_torch:
            likelihood, places = self.weights.located_by_torch(points)
        else:
            likelihood, places = self.weights.located(points, config.least_weight)
        if avatar.non_rigid is not None:
            places = places + avatar.non_rigid(places, self.pose, avatar.window)
        rgb, raw = avatar.canonical(places)
        return FieldValues(rgb, relu_density(raw), likelihood.clamp(max=1) if config.clamp else likelihood)


class HumanNerfAvatar(nn.Module):
    """`step` is the number of the last step taken, or of the one that is being taken: which octaves of the non-rigid
    network are on depends on it, so a fit that ended early is drawn as it was fitted."""

    restarts: Tensor  # how often the fit began again

    def __init__(self, config: HumanNerfConfig, body: Body, betas: NDArray[np.float64], seed: int):
        """Raises `BadInput` for shape coefficients that the body does not have."""
        super().__init__()
        self.config, self.body = config, body
        self.betas = np.asarray(betas, np.float64)
        self.step = 0
        self.joints = torch.from_numpy(np.array(body.shaped(self.betas)[1]))  # [24, 3] m, canonical
        self.parents = [int(p) for p in body.parents]
        generator = torch.Generator().manual_seed(seed)
        wide = config.weight_channels
        self.motion = MotionWeightVolume(
            self.joints,
            self.parents,
            generator,
            config.weight_code,
            (wide, wide // 2, wide // 2, wide // 4, wide // 4),
            config.box_margin,
        )
        shape = config.depth, config.width, config.bands
        self.canonical = CanonicalNetwork(generator, *shape, config.first_density)
        self.non_rigid = None
        if config.non_rigid:
            size = config.non_rigid_depth, config.non_rigid_width, config.non_rigid_bands
            self.non_rigid = NonRigidNetwork(generator, *size)
        self.pose_correction = None
        if config.refine_poses:
            self.pose_correction = PoseCorrection(generator, config.pose_depth, config.pose_width)
        self.register_buffer("restarts", torch.zeros((), dtype=torch.int64))
        self._cache: DecodedCache[PosedField] = DecodedCache()

    @property
    def device(self) -> torch.device:
        return self.canonical.last.weight.device

    @property
    def window(self) -> Tensor:
        """[bands] of the non-rigid network's octaves in this step."""
        config = self.config
        bands, span = config.non_rigid_bands, max(config.full_band - config.kick_in, 1)
        return band_window(bands * max(0, self.step - config.kick_in) / span, bands)

    # --- from a pose to a field ---

    def rotations(self, pose: Tensor, corrected: bool = True) -> Tensor:  # [23, 3] rad
        """[23, 3, 3] of the joints other than the root, corrected once that has begun."""
        given = axis_angle_to_matrix(pose)
        if self.pose_correction is None or not corrected or self.step < self.config.poses_from:
            return given
        return given @ self.pose_correction(pose + POSE_SHIFT)

    def posed(self, body_pose: BodyPose, volume: Tensor | None = None, corrected: bool = True) -> PosedField:
        """The field of a pose. `volume` [25, 32, 32, 32] saves decoding the motion weights once more."""
        weight = self.canonical.last.weight
        pose = torch.from_numpy(np.array(body_pose.pose[1:])).to(weight)
        joints = torch.from_numpy(np.array(self.body.shaped(body_pose.betas)[1])).to(weight)
        maps = bone_maps(self.rotations(pose, corrected), joints, self.joints.to(weight), self.parents)
        decoded: Tensor = self.motion() if volume is None else volume
        bones = BoneWeights(decoded, self.motion.low, self.motion.high, maps)
        return PosedField(self, bones, pose.flatten() + POSE_SHIFT)

    # --- drawing ---

    @torch.no_grad()
    def draw(
        self, camera: Camera, body_pose: BodyPose, background: tuple[float, float, float], samples: int = 0
    ) -> Drawn:
        """`samples` of each ray; 0: as the configuration says. Raises `ValueError` for a lens distortion."""
        config = self.config
        corrected = config.test_poses == "released"
        key = body_pose.pose.tobytes() + body_pose.betas.tobytes() + f" {self.step}".encode()
        posed = self._cache.get(self, key, lambda: self.posed(body_pose, corrected=corrected))
        box = PosedBox.around(self.body, body_pose, config.box_margin)
        ends = box.ends(self.canonical.last.weight.dtype, self.device)
        skipping = Skipping(config.least, config.stop)
        return draw_image(posed, camera, ends, samples or config.samples, background, box.frame, skipping)

    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,  # nothing is learned for each frame
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`."""
        drawn = self.draw(camera, body_pose, background)
        return drawn.rgb.clamp(0, 1).cpu().numpy(), drawn.alpha.clamp(0, 1).cpu().numpy()

    # --- on disk ---

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        write_avatar(folder, KIND, self, self.config, self.body, self.betas, step=self.step)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> HumanNerfAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            config = read(HumanNerfConfig, saved.words["config"], "avatar.json: config")
            avatar = cls(config, body, np.array(saved.words["betas"]), seed=0)
            avatar.load_state_dict(saved.tensors)
            avatar.step = int(saved.words["step"])
        return avatar.to(device)
