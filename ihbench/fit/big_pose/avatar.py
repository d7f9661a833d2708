"""The avatar: anisotropic Gaussians in the big pose, skinned to a frame and splatted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.big_pose.config import BigPoseConfig
from ihbench.fit.big_pose.deformation import Deformation, Frame, Posed
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.fit.gaussians.harmonics import grey_harmonics, harmonics_in_use
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.nets.pose_correction import PoseCorrection
from ihbench.nets.weight_offsets import WeightOffsets

VERTEX = "vertex"  # what each Gaussian carries: the canonical vertex that it takes its weights from


Config = TypeVar("Config", bound=BigPoseConfig)


class BigPoseAvatar(nn.Module, Generic[Config]):
    """Gaussians that start on the vertices of the big pose at mean shape, grey, round and of opacity .1, with the two
    networks that correct pose and weights. `degree` is that of the spherical harmonics in use. A method's own avatar
    names its `kind` and its configuration."""

    kind: ClassVar[str]
    config_class: ClassVar[type[BigPoseConfig]]

    def __init__(self, config: Config, body: Body, seed: int):
        super().__init__()
        self.config, self.body = config, body
        self.degree = 0
        self.deformation = Deformation(body).float()
        vertices = self.deformation.vertices
        n = len(vertices)
        colours = grey_harmonics(n, config.grey, config.highest_degree)
        self.gaussians = Gaussians.on(vertices, config.opacity, colours, {VERTEX: torch.arange(n)})
        generator = torch.Generator().manual_seed(seed)
        self.pose_correction = PoseCorrection(generator) if config.pose_network else None
        self.weight_offsets = WeightOffsets(seed) if config.weight_network else None
        self._cache: DecodedCache[tuple[Tensor, Tensor | None]] = DecodedCache()

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def device(self) -> torch.device:
        return self.gaussians.means.device

    @property
    def sh(self) -> Tensor:
        """[N, (degree + 1)², 3] the spherical harmonics in use."""
        return harmonics_in_use(self.gaussians, self.degree)

    def posed(self, frame: Frame) -> Posed:
        """The Gaussians in a frame, by the vertices that they carry."""
        return self._skinned(frame, self.gaussians.carried(VERTEX), self._offsets())

    def _skinned(self, frame: Frame, vertex: Tensor, offsets: Tensor | None) -> Posed:  # [N] int64; [N, 24]
        correction = self.pose_correction(frame.pose) if self.pose_correction is not None else None
        return self.deformation(self.gaussians.means, vertex, frame, offsets, correction)

    def _offsets(self) -> Tensor | None:
        return self.weight_offsets(self.gaussians.means) if self.weight_offsets is not None else None

    def covariances(self, posed: Posed) -> Tensor:
        """[N, 3, 3] m², world."""
        return skinned_covariance(self.gaussians.scales, self.gaussians.quaternions, posed.linear)

    def drawn(self, posed: Posed) -> PosedGaussians:
        """Gaussians that are posed, with the attributes that are drawn."""
        covariances, opacities = self.covariances(posed), self.gaussians.opacities
        return PosedGaussians(posed.means, covariances, self.sh, None, opacities, self.degree, posed.weights)

    def draw(
        self,
        posed: Posed,
        camera: Camera,
        background: Sequence[float],
        outputs: Sequence[str] = ("rgb", "alpha"),
    ) -> tuple[Any, ...]:
        """What `render_gaussians` draws of Gaussians that are posed."""
        return self.drawn(posed).draw(camera, background, outputs)

    def refresh_vertices(self) -> None:
        """Let each Gaussian carry the vertex that is nearest to it now."""
        self.gaussians.carried(VERTEX).copy_(self.deformation.nearest(self.gaussians.means))

    @torch.no_grad()
    def posed_gaussians(self, body_pose: BodyPose) -> PosedGaussians:
        """See `scene.contracts.Avatar`. As released, the pose network corrects any pose, also those
        that nobody trained on."""

        def decode() -> tuple[Tensor, Tensor | None]:  # of all poses the same
            return self.deformation.nearest(self.gaussians.means), self._offsets()

        vertex, offsets = self._cache.get(self, b"", decode)
        return self.drawn(self._skinned(self.deformation.frame(body_pose), vertex, offsets))

    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,  # nothing is learned for single frames
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`."""
        with torch.no_grad():
            rgb, alpha = self.posed_gaussians(body_pose).draw(camera, background)
        return rgb.clamp(0, 1).cpu().numpy(), alpha.clamp(0, 1).cpu().numpy()

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        write_avatar(folder, self.kind, self, self.config, self.body, degree=self.degree)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> Self:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, cls.kind, body)
        with saved.put_together():
            tensors = saved.tensors
            avatar = cls(read(cls.config_class, saved.words["config"], "avatar.json: config"), body, seed=0)
            avatar.gaussians = avatar.gaussians.saved(tensors, "gaussians.")
            avatar.load_state_dict(tensors)
            avatar.degree = min(max(int(saved.words["degree"]), 0), avatar.config.highest_degree)
        return avatar.to(device)
