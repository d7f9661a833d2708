"""The avatar: Gaussians at the body's UV texels, decoded from one map, posed by one blend of joint transforms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.uv import position_map, texel_table
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.methods.gaussianavatar.config import GaussianAvatarConfig
from ihbench.methods.gaussianavatar.pose_encoder import PoseEncoder
from ihbench.methods.gaussianavatar.texel_network import TexelDecoder, TexelOutputs, measure_statistics, smoothing
from ihbench.render.splat import render_gaussians

KIND = "gaussianavatar"
CANONICAL_TRANSL = (0.0, 0.3, 0.0)  # m (arguments/__init__.py:44-53)


class TexelAvatar(nn.Module):
    """One isotropic Gaussian of opacity 1 at every texel on the body's charts. N of them; M texels are decoded, the
    same, or all of the grid.

    Points are those of the shaped body in the canonical pose, with its pose blend shapes. A pose moves each by one
    blend of products, M = Σ_j w_j A_j(pose) A_j(canonical)⁻¹; there are no pose blend shapes in it.
    """

    weights: Tensor  # [N, 24]
    points: Tensor  # [N, 3] m, canonical
    of_decoded: Tensor  # [N] the points' numbers among the M decoded texels
    coordinates: Tensor  # [M, 2] row and column over R - 1, in 0..1
    places: Tensor  # [1, 1, M, 2] where the texels read the feature map, for `grid_sample`

    def __init__(self, config: GaussianAvatarConfig, body: Body, betas: NDArray[np.float64], seed: int):
        super().__init__()
        self.config, self.body, self.betas = config, body, np.asarray(betas, np.float64)
        self.scale_share = 1.0  # of the decoded scale, what is drawn
        self._cache: DecodedCache[TexelOutputs] = DecodedCache()
        texels = self.texels = texel_table(body, config.texels)
        canonical = BodyPose(canonical_pose("gaussianavatar"), self.betas, np.array(CANONICAL_TRANSL))
        self._from_canonical = np.linalg.inv(body.joint_transforms(canonical))
        weights = texels.interpolate(body.weights, body.faces)
        decoded = np.arange(config.texels**2) if config.decoded == "all" else texels.index
        # as released: divided by R - 1 and then read with corners not aligned, up to 1/8 feature texel aside
        coordinates = np.stack(np.divmod(decoded, config.texels), 1) / max(config.texels - 1, 1)
        for name, value in (
            ("weights", weights / weights.sum(1, keepdims=True)),
            ("points", texels.interpolate(body.pose(canonical), body.faces)),
            ("coordinates", coordinates),
            ("places", 2 * coordinates[None, None, :, ::-1] - 1),
        ):
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value, np.float32)), persistent=False)
        self.register_buffer("of_decoded", torch.from_numpy(np.searchsorted(decoded, texels.index)), persistent=False)
        side, channels = config.feature_map, config.channels
        generator = torch.Generator().manual_seed(seed)
        self.features = nn.Parameter(config.feature_std * torch.randn(1, channels, side, side, generator=generator))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.smoothing = smoothing(channels)
            self.decoder = TexelDecoder(channels + 2, config.width)
            if config.pose_stage:
                self.pose_encoder = PoseEncoder(channels)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def device(self) -> torch.device:
        return self.points.device

    # --- the network ---

    def position_maps(self, body_poses: Iterable[BodyPose]) -> Tensor:
        """[B, 3, S, S] m: the posed bodies in the world, root and place included, 0 off the charts."""
        side = self.config.feature_map
        posed = [self.body.pose(BodyPose(p.pose, self.betas, p.transl)) for p in body_poses]
        maps = [position_map(vertices, self.body, side)[0].transpose(2, 0, 1) for vertices in posed]
        return torch.from_numpy(np.stack(maps)).to(self.device)

    def texel_inputs(self, pose_features: Tensor | None = None) -> Tensor:  # [B, C, S, S]
        """[B M, C + 2] what the decoder is given; B is 1 without pose features."""
        smooth = self.smoothing(self.features)
        if pose_features is not None:
            smooth = smooth + pose_features
        count = len(smooth)
        read_off = grid_sample(smooth, self.places.expand(count, -1, -1, -1), align_corners=False)
        rows = read_off[:, :, 0].transpose(1, 2)  # [B, M, C]
        return torch.cat([rows, self.coordinates.expand(count, -1, -1)], 2).flatten(0, 1)

    def decode(self, pose_features: Tensor | None = None) -> TexelOutputs:
        """Offset [B M, 3] m in canonical axes, scale [B M] m as drawn, colour [B M, 3] of the decoded texels."""
        raw = self.decoder(self.texel_inputs(pose_features))
        return TexelOutputs(self.config.offset_scale * raw.offset, self.scale_share * raw.scale, raw.color)

    def of_points(self, decoded: TexelOutputs, k: int = 0) -> TexelOutputs:
        """Of item k of a decoded batch, the rows [N] of the texels that are points."""
        rows = self.of_decoded + k * len(self.coordinates)
        return TexelOutputs(decoded.offset[rows], decoded.scale[rows], decoded.color[rows])

    def hold_statistics(self, body_poses: Sequence[BodyPose]) -> None:
        """From here on batch norms use their statistics over these training poses (`batch_norm` "mended")."""
        with torch.no_grad():
            if self.config.pose_stage:
                measure_statistics(self.decoder, (self.texel_inputs(self._pose_features([p])) for p in body_poses))
            else:
                measure_statistics(self.decoder, [self.texel_inputs()])
        self.decoder.eval()
        self._cache = DecodedCache()

    def _pose_features(self, body_poses: Sequence[BodyPose]) -> Tensor:
        return self.pose_encoder(self.position_maps(body_poses))

    # --- posing and drawing ---

    def transforms(self, body_pose: BodyPose) -> Tensor:
        """[24, 3, 4] canonical to this pose, with the avatar's own shape."""
        own = BodyPose(body_pose.pose, self.betas, body_pose.transl)
        moved = (self.body.joint_transforms(own) @ self._from_canonical)[:, :3]
        return torch.from_numpy(np.ascontiguousarray(moved, np.float32)).to(self.device)

    def posed(self, offset: Tensor, transforms: Tensor) -> Tensor:  # [N, 3] m, canonical; [24, 3, 4]
        """World positions [N, 3] m."""
        blended = (self.weights @ transforms.flatten(1)).unflatten(1, (3, 4))
        return (blended[:, :, :3] @ (self.points + offset)[:, :, None])[:, :, 0] + blended[:, :, 3]

    @torch.no_grad()
    def gaussians(self, body_pose: BodyPose) -> tuple[Tensor, Tensor, Tensor]:
        """World means [N, 3] m, scales [N] m and colours [N, 3] in a pose."""
        staged = self.config.pose_stage
        key = body_pose.pose.tobytes() + body_pose.transl.tobytes() if staged else b""
        key += np.float64(self.scale_share).tobytes()

        def decode() -> TexelOutputs:
            return self.of_points(self.decode(self._pose_features([body_pose]) if staged else None))

        outputs = self._cache.get(self, key, decode)
        return self.posed(outputs.offset, self.transforms(body_pose)), outputs.scale, outputs.color

    def posed_gaussians(self, body_pose: BodyPose) -> PosedGaussians:
        """The same as files have them; see `scene.contracts.Avatar`."""
        return PosedGaussians(*self.gaussians(body_pose), weights=self.weights)

    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,  # nothing is learned for single frames
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`."""
        with torch.no_grad():
            rgb, alpha = render_gaussians(*self.gaussians(body_pose), camera, background)
        return rgb.clamp(0, 1).cpu().numpy(), alpha.cpu().numpy()

    # --- on disk ---

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`. Raises `BadInput` when the disk does not take it."""
        more = {"scale_share": self.scale_share, "held_statistics": not self.decoder.training}
        write_avatar(folder, KIND, self, self.config, self.body, self.betas, **more)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> TexelAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            config = read(GaussianAvatarConfig, saved.words["config"], "avatar.json: config")
            avatar = cls(config, body, np.array(saved.words["betas"]), seed=0)
            avatar.load_state_dict(saved.tensors)
            avatar.scale_share = float(saved.words["scale_share"])
            avatar.decoder.train(not saved.words["held_statistics"])
        return avatar.to(device)
