"""The avatar: features on the body's surface, their counters, two networks, and motion weights."""

from __future__ import annotations

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
from ihbench.methods.occnerf.canonical_surface import CanonicalSurface
from ihbench.methods.occnerf.config import OccNerfConfig
from ihbench.methods.occnerf.decoder import SurfaceDecoder
from ihbench.methods.occnerf.field import PosedField, vertex_features
from ihbench.nets.bone_lookups import BoneWeights
from ihbench.nets.bone_maps import bone_maps
from ihbench.nets.hash_grid_4d import HashGrid4d
from ihbench.nets.motion_weights import MotionWeightVolume
from ihbench.render.volumes.fast import Skipping, draw_image

KIND = "occnerf"
DISPLACED = 1e-4  # m: bound of the first displacements


class OccNerfAvatar(nn.Module):
    """Pose-independent in the T-pose: as released neither the non-rigid field nor the correction of poses ever acts,
    so there is none."""

    counters: Tensor  # [V] how many steps each vertex ended a ray in, and 1

    def __init__(self, config: OccNerfConfig, body: Body, betas: NDArray[np.float64], seed: int):
        super().__init__()
        self.config, self.body = config, body
        self.betas = np.asarray(betas, np.float64)
        self.surface = CanonicalSurface(body, self.betas, seed, config.neighbour_cell)
        generator = torch.Generator().manual_seed(seed)
        joints = torch.from_numpy(np.array(body.shaped(self.betas)[1]))
        self.joints = joints  # m, canonical
        wide = config.weight_channels
        self.motion = MotionWeightVolume(
            joints,
            [int(p) for p in body.parents],
            generator,
            config.weight_code,
            (wide, wide // 2, wide // 2, wide // 4, wide // 4),
        )
        self.grid = HashGrid4d(
            generator,
            levels=config.levels,
            log2_size=config.hash_size,
            finest=max(round(config.hash_finest * self.surface.bound), 16),
        )
        self.decoder = SurfaceDecoder(self.grid.width + 3, self.grid.width, config.width, config.depth, generator)
        vertices = len(self.surface.vertices)
        self.displacement = nn.Parameter((2 * torch.rand(vertices, generator=generator) - 1) * DISPLACED)
        self.register_buffer("counters", torch.ones(vertices))
        self._cache: DecodedCache[tuple[Tensor, Tensor]] = DecodedCache()

    @property
    def device(self) -> torch.device:
        return self.displacement.device

    def displaced(self) -> Tensor:
        """[V, 3] m: the base vertices, moved."""
        surface, amount = self.surface, self.displacement[:, None]
        return surface.vertices + amount * (surface.normals if self.config.displacement == "normal" else 1)

    # --- from a pose to a field ---

    def bones(self, body_pose: BodyPose, volume: Tensor) -> BoneWeights:
        """Motion weights in a pose, in the frame fixed to its root."""
        own = self.body.shaped(body_pose.betas)[1]
        joints, canonical = (self._tensor(each) for each in (own, self.joints.numpy()))
        rotations = axis_angle_to_matrix(self._tensor(body_pose.pose[1:]))
        maps = bone_maps(rotations, joints, canonical, [int(p) for p in self.body.parents])
        return BoneWeights(volume, self.motion.low, self.motion.high, maps)

    def decode(self) -> tuple[Tensor, Tensor]:
        """What does not depend on the pose: motion weights [25, 32, 32, 32] and vertex features [V, 35]."""
        return self.motion(), vertex_features(self)

    def posed(self, body_pose: BodyPose, volume: Tensor, features: Tensor) -> PosedField:
        """The field of a pose, from what `decode` gave."""
        return PosedField(self, self.bones(body_pose, volume), features)

    # --- drawing ---

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`. `frame` changes nothing."""
        volume, features = self._cache.get(self, self.counters.cpu().numpy().tobytes(), self.decode)
        box = PosedBox.around(self.body, body_pose)
        drawn = draw_image(
            self.posed(body_pose, volume, features),
            camera,
            box.ends(features.dtype, features.device),
            self.config.samples,
            background,
            box.frame,
            Skipping(self.config.least, self.config.stop),
        )
        return drawn.rgb.clamp(0, 1).cpu().numpy(), drawn.alpha.clamp(0, 1).cpu().numpy()

    def _tensor(self, value: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(np.array(value)).to(self.displacement)

    # --- on disk ---

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        write_avatar(folder, KIND, self, self.config, self.body, self.betas)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> OccNerfAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            config = read(OccNerfConfig, saved.words["config"], "avatar.json: config")
            avatar = cls(config, body, np.array(saved.words["betas"]), seed=0)
            avatar.load_state_dict(saved.tensors)
        return avatar.to(device)
