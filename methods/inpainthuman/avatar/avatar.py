"""The avatar: Gaussians at the body's UV texels, decoded from UV features, posed by skinning, splatted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.uv import chart_padding, texel_table
from ihbench.camera import Camera
from ihbench.config_fields import read
from ihbench.fit.avatar_files import read_avatar, write_avatar
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.precision import autocast
from ihbench.methods.inpainthuman.avatar.decoder import GaussianDecoder, scale_factor
from ihbench.methods.inpainthuman.avatar.pose_residual import ResidualEncoder, root_free_position_map
from ihbench.methods.inpainthuman.avatar.uv_features import UVFeatures, bilinear_corners
from ihbench.methods.inpainthuman.config import InpaintHumanConfig
from ihbench.nets.positional_encoding import positional_encoding
from ihbench.nets.weighted_rows import weighted_rows
from ihbench.render.splat import render_gaussians
from ihbench.render.triangles import triangle_areas, triangle_crosses
from ihbench.render.zbuffer import rasterize

CULL_SLACK = 0.04  # m behind the nearest body surface; garments and offsets stay well within it
CULL_BACK_SLACK = 0.012  # m, for points whose normal is turned well away: the far side of an arm, not of a finger
CULL_FACING = -0.3  # cosine below which a normal is turned well away, beyond the silhouette's rim


@dataclass(frozen=True)
class PosedPoints:
    """Points of the body in one pose."""

    surface: Tensor  # [n, 3] m, world, without an offset
    turn: Tensor  # [n, 3, 3] canonical offsets to world

    def moved(self, offset: Tensor) -> Tensor:  # [n, 3] m, canonical
        """World positions [n, 3] m."""
        return self.surface + (self.turn @ offset[:, :, None])[:, :, 0]


class GaussianAvatar(nn.Module):
    """Canonical representation of one person (sec. 3.2). Opacity 1, isotropic scale, identity rotation.

    Points live on the shaped body in the canonical pose; `rest` holds them in the skinning rest pose, where blend
    weights apply, and `to_rest` turns canonical offsets into rest-pose ones. With a zero offset the posed points lie
    on the posed body (pose blend shapes aside, which the paper's eq. 2 does not have): exactly where the corners of a
    face move together, within a few mm where a joint bends it.
    """

    weights: Tensor
    rest: Tensor
    to_rest: Tensor
    encoded: Tensor
    residual_index: Tensor
    residual_weight: Tensor
    base_scale: Tensor
    normals: Tensor  # [N, 3] in the canonical pose, of any length

    def __init__(self, config: InpaintHumanConfig, body: Body, betas: NDArray[np.float64], seed: int):
        super().__init__()
        self.config, self.body, self.betas = config, body, np.asarray(betas, np.float64)
        self.residual_on = False
        self.fit_dtype = torch.float32  # of the networks while they learn
        self._decoded_cache: DecodedCache[tuple[Tensor, Tensor, Tensor]] = DecodedCache()  # by pose
        generator = torch.Generator().manual_seed(seed)
        texels = texel_table(body, config.texels)
        self.texels = texels

        vertices, _ = body.shaped(self.betas)
        weights = texels.interpolate(body.weights, body.faces)
        weights /= weights.sum(1, keepdims=True)
        rest = texels.interpolate(vertices, body.faces)
        canonical = BodyPose(canonical_pose(config.canonical_pose), self.betas, np.zeros(3))
        blended = np.einsum("nk,kab->nab", weights, body.joint_transforms(canonical)[:, :3])
        points = np.einsum("nab,nb->na", blended[:, :, :3], rest) + blended[:, :, 3]

        face_area = triangle_areas(vertices[body.faces])
        per_face = np.bincount(texels.face, minlength=len(body.faces))
        spacing = np.sqrt(_smoothed_area(texels.face, face_area, per_face, body.faces))

        normals = triangle_crosses(vertices[body.faces[texels.face]])
        for name, value in (
            ("weights", weights),
            ("rest", rest),
            ("to_rest", np.linalg.inv(blended[:, :, :3])),
            ("normals", np.einsum("nab,nb->na", blended[:, :, :3], normals)),
            ("base_scale", np.minimum(config.scale_initial * spacing, config.scale_limit)),
        ):
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value, np.float32)), persistent=False)
        encoded = positional_encoding(torch.from_numpy(points), config.encoding_frequencies).float()
        self.register_buffer("encoded", encoded, persistent=False)

        self.features = UVFeatures(
            [self._corners(r) for r in config.levels],
            config.levels,
            config.channels,
            config.feature_std,
            config.fusion,
            generator,
        )
        width = self.features.out_channels
        self.decoder = GaussianDecoder(
            width + encoded.shape[1], config.decoder_width, config.decoder_layers, generator
        )
        if config.pose_residual:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed)
                self.encoder = ResidualEncoder(config.residual_channels, width)
            index, weight = self._corners(config.position_map)
            self.register_buffer("residual_index", torch.from_numpy(index.astype(np.int32)), persistent=False)
            self.register_buffer("residual_weight", torch.from_numpy(weight), persistent=False)

    def _corners(self, resolution: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        inside = texel_table(self.body, resolution).mask
        return bilinear_corners(self.texels.uv, chart_padding(inside, resolution))

    @property
    def canonical_points(self) -> Tensor:
        """[N, 3] m"""
        return self.encoded[:, :3]

    @property
    def device(self) -> torch.device:
        return self.rest.device

    def __len__(self) -> int:
        return len(self.rest)

    @cached_property
    def every_point(self) -> Tensor:
        return torch.arange(len(self), device=self.device)

    def position_map(self, body_pose: BodyPose) -> Tensor | None:
        """[3, R, R] input of the residual encoder, or None for an avatar without one."""
        if not self.config.pose_residual:
            return None
        positions = root_free_position_map(self.body, body_pose, self.config.position_map)
        return torch.from_numpy(positions).to(self.device)

    def decode(
        self, points: Tensor, position_map: Tensor | None, decay: float = 0.0
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Offset [n, 3] m (canonical axes), scale [n] m and colour [n, 3] of some points (eq. 1). `decay`: see
        `UVFeatures`."""
        with autocast(self.device.type, self.fit_dtype if torch.is_grad_enabled() else torch.float32):
            feature = self.features(points, decay)
            if self.residual_on and position_map is not None:
                # contiguous: the encoder hands out a transposed map, whose rows are slow to read
                residual = self.encoder(position_map).to(self.residual_weight.dtype).contiguous()
                feature = feature + weighted_rows(residual, self.residual_index, self.residual_weight, points)
            raw_offset, raw_scale, color = self.decoder(feature, self.encoded[points])
        config = self.config
        raw_offset, raw_scale, color = (out.to(self.base_scale.dtype) for out in (raw_offset, raw_scale, color))
        offset = config.offset_scale * (torch.tanh(raw_offset) if config.offset == "tanh" else raw_offset)
        scale = self.base_scale[points] * scale_factor(raw_scale, config.scale_activation)
        return offset, scale.clamp(max=config.scale_limit), color

    def posed(self, points: Tensor, transforms: Tensor) -> PosedPoints:  # transforms [24, 3, 4]
        """Where points stand in a pose, and how their offsets turn with it, by linear blend skinning (eq. 2)."""
        blended = (self.weights[points] @ transforms.reshape(24, 12)).reshape(-1, 3, 4)
        turn = blended[:, :, :3] @ self.to_rest[points]
        surface = (blended[:, :, :3] @ self.rest[points][:, :, None])[:, :, 0] + blended[:, :, 3]
        return PosedPoints(surface, turn)

    def transforms(self, body_pose: BodyPose) -> Tensor:
        """[24, 3, 4] rest pose to this pose, with the avatar's own shape."""
        own = BodyPose(body_pose.pose, self.betas, body_pose.transl)
        return torch.from_numpy(self.body.joint_transforms(own)[:, :3].astype(np.float32)).to(self.device)

    def unhidden(self, camera: Camera, body_pose: BodyPose) -> NDArray[np.int64]:
        """Numbers of the points that the posed body itself does not hide from this camera, with slack for offsets:
        those that a step of fitting draws.

        With opacity 1 whatever lies behind the first surface contributes next to nothing, so it need not be decoded.
        """
        if not self.config.cull:
            return np.arange(len(self))
        from scipy.ndimage import maximum_filter

        vertices = self.body.pose(BodyPose(body_pose.pose, self.betas, body_pose.transl), blend_shapes=False)
        depth = rasterize(camera.project(vertices), self.body.faces, camera.height, camera.width).depth
        # the farthest depth around a pixel: near a silhouette nothing is culled by a neighbour
        depth = maximum_filter(depth, size=3, mode="nearest")
        corners = vertices[self.body.faces[self.texels.face]]
        points = np.einsum("nk,nkd->nd", self.texels.bary, corners)
        normals = triangle_crosses(corners)
        view = camera.center - points
        away = (normals * view).sum(1) < CULL_FACING * np.linalg.norm(normals, axis=1) * np.linalg.norm(view, axis=1)
        p = camera.project(points)
        column = np.clip(np.nan_to_num(p[:, 0]), 0, camera.width - 1).astype(int)
        row = np.clip(np.nan_to_num(p[:, 1]), 0, camera.height - 1).astype(int)
        slack = np.where(away, CULL_BACK_SLACK, CULL_SLACK)
        return np.flatnonzero((p[:, 2] > 0) & (p[:, 2] <= depth[row, column] + slack))

    @torch.no_grad()
    def gaussians(self, body_pose: BodyPose) -> tuple[Tensor, Tensor, Tensor]:
        """World means [n, 3] m, scales [n] m and colours [n, 3] in a pose."""
        offset, scale, color = self._decoded(body_pose)
        return self.posed(self.every_point, self.transforms(body_pose)).moved(offset), scale, color

    def _decoded(self, body_pose: BodyPose) -> tuple[Tensor, Tensor, Tensor]:
        """`decode` of every point, kept for the next camera: it depends on the pose of the joints at most."""
        key = body_pose.pose[1:].tobytes() + body_pose.betas.tobytes() if self.residual_on else b""

        def decode() -> tuple[Tensor, Tensor, Tensor]:
            return self.decode(self.every_point, self.position_map(body_pose) if self.residual_on else None)

        return self._decoded_cache.get(self, key, decode)

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
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`.

        Draws every point: where the first surface has a gap, what is behind it is nearer to the truth than the
        background.
        """
        with torch.no_grad():
            rgb, alpha = render_gaussians(*self.gaussians(body_pose), camera, background)
        return rgb.clamp(0, 1).cpu().numpy(), alpha.cpu().numpy()

    def save(self, folder: Path) -> None:
        """Write `avatar.safetensors` and `avatar.json`: enough to load it again beside the same body.

        Raises `BadInput` when the disk does not take it.
        """
        more = {"residual_on": self.residual_on}
        write_avatar(folder, "inpainthuman", self, self.config, self.body, self.betas, **more)

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> GaussianAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, "inpainthuman", body)
        words = saved.words
        with saved.put_together():
            config = read(InpaintHumanConfig, words["config"], "avatar.json: config")
            avatar = cls(config, body, np.array(words["betas"]), seed=0)
            avatar.load_state_dict(saved.tensors)
            avatar.residual_on = bool(words["residual_on"])
        return avatar.to(device)


def _smoothed_area(
    face_of_texel: NDArray[np.int32],  # [N]
    face_area: NDArray[np.float64],  # [F] m²
    texels_per_face: NDArray[np.int64],  # [F]
    faces: NDArray[np.int32],  # [F, 3]
) -> NDArray[np.float64]:
    """[N] m² of body surface per texel. Small faces hold zero to two texels, so area and count are pooled over the
    faces around each vertex before they are divided."""
    area, count = np.zeros(faces.max() + 1), np.zeros(faces.max() + 1)
    for corner in range(3):
        area += np.bincount(faces[:, corner], face_area, minlength=len(area))
        count += np.bincount(faces[:, corner], texels_per_face, minlength=len(count))
    per_vertex = area / np.maximum(count, 0.5)
    return per_vertex[faces[face_of_texel]].mean(1)
