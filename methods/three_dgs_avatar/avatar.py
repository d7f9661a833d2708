"""The avatar: Gaussians in the star pose, deformed, skinned by a learned field, coloured by a network."""

from __future__ import annotations

from dataclasses import dataclass
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
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.gaussians.gaussian_set import SHAPES, Carried, Gaussians
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.gaussians.skinned_covariance import blended_linear, skinned_covariance
from ihbench.fit.gaussians.view_colours import DEGREE, view_harmonics
from ihbench.fit.training_poses import PoseTables, TrainingPoses, latent_codes
from ihbench.methods.three_dgs_avatar.colours import FEATURE, LATENT, ColourNetwork, canonical_directions
from ihbench.methods.three_dgs_avatar.config import ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.isometry import NEIGHBOURS
from ihbench.methods.three_dgs_avatar.non_rigid import NonRigid, turned
from ihbench.methods.three_dgs_avatar.skinning_field import SkinningField
from ihbench.methods.three_dgs_avatar.star_body import Frame, StarBody
from ihbench.render.splat import render_gaussians

KIND = "three-dgs-avatar"
COLOUR = "feature"  # attribute
NEAREST, SEEN = "nearest", "seen"  # what each carries: numbers of its neighbours; whether a known pixel showed it


@dataclass(frozen=True)
class Posed:
    """Gaussians in a frame."""

    means: Tensor  # [N, 3] m, world
    covariances: Tensor  # [N, 3, 3] m², world
    linear: Tensor  # [N, 3, 3] T of the skinning: a blend, no rotation
    weights: Tensor  # [N, 24] of the skinning
    codes: Tensor | None  # [N, 16]; None before the non-rigid deformation begins


class ThreeDgsAvatar(nn.Module):
    """Gaussians that start at places drawn from the star-posed surface, round, of opacity .1 and without a feature.

    `step` is the number of the last step taken, or of the one that is being taken: the non-rigid deformation and the
    fitted poses have no effect before their first.
    """

    def __init__(
        self,
        config: ThreeDgsAvatarConfig,
        body: Body,
        betas: NDArray[np.float64],
        training: TrainingPoses,
        seed: int,
    ):
        super().__init__()
        self.config, self.body, self.training_poses = config, body, training
        self.betas = np.asarray(betas, np.float64)
        self.step = 0
        exact = StarBody(body, self.betas)
        points = exact.surface(np.random.default_rng((seed, 0)), config.points)[0].float()
        self.star = exact.float()
        generator = torch.Generator().manual_seed(seed)
        parents = self.star.parents
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.skinning = SkinningField(parents)
            self.colours = ColourNetwork()
            self.non_rigid = None
            if config.non_rigid:
                self.non_rigid = NonRigid(parents, generator, config.hash_size, config.hash_finest, config.last_layer)
        self.latents = nn.Parameter(latent_codes(len(training.frames), LATENT, generator))
        self.poses = PoseTables(training, self.betas) if config.refine_poses else None
        n = len(points)
        carried = {
            NEAREST: Carried(torch.zeros(n, min(NEIGHBOURS, n - 1), dtype=torch.int64)),
            SEEN: Carried(torch.zeros(n, dtype=torch.bool), of_new=0),
        }
        self.gaussians = Gaussians.on(points, config.opacity, {COLOUR: torch.zeros(n, FEATURE)}, carried)
        self._cache: DecodedCache[Posed] = DecodedCache()

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def device(self) -> torch.device:
        return self.gaussians.means.device

    @property
    def deforms(self) -> bool:
        """Whether the non-rigid deformation has begun."""
        return self.non_rigid is not None and self.step >= self.config.non_rigid_from

    @property
    def fits_poses(self) -> bool:
        return self.poses is not None and self.step >= self.config.poses_from

    # --- from a pose to Gaussians ---

    def training_frame(self, row: int) -> Frame:
        """A training frame by its row in the tables: as fitted once poses are fitted, else as given."""
        if self.poses is not None and self.fits_poses:
            return self.star.frame_of(self.poses.poses[row], self.poses.transl[row], self.poses.betas)
        given = self.training_poses
        return self.star.frame(BodyPose(given.poses[row], self.betas, given.transl[row]))

    def posed(
        self,
        frame: Frame,
        noise: Tensor | None = None,  # [24, 9] added to the rotations that the pose code reads
    ) -> Posed:
        gaussians, star = self.gaussians, self.star
        means, log_scales, quaternions, codes = gaussians.means, gaussians.log_scales, gaussians.quaternions, None
        if self.non_rigid is not None and self.deforms:
            rotations = frame.rotations.flatten(1)
            rotations = torch.cat([torch.eye(3).flatten()[None].to(rotations), rotations[1:]])
            rotations = rotations if noise is None else rotations + noise
            moved = self.non_rigid(star.normalised(means), rotations, frame.joints)
            means, log_scales = means + moved.offset, log_scales + moved.growth
            quaternions, codes = turned(quaternions, moved.turn), moved.code
        weights = self.skinning(star.normalised(means))
        linear = blended_linear(weights, frame.bones)
        shift = weights @ frame.bones[:, :3, 3]
        world = (linear @ means[:, :, None])[..., 0] + shift
        return Posed(world, skinned_covariance(log_scales.exp(), quaternions, linear), linear, weights, codes)

    def colours_of(
        self,
        posed: Posed,
        camera: Camera,
        row: int | None,
        turn: Tensor | None = None,  # [3, 3] of the directions of view
    ) -> Tensor:
        """[N, 3] as this camera sees them, with the latent code of a training frame, or the last one's for None."""
        directions = None
        if self.config.view_colours:
            center = torch.from_numpy(camera.center).to(posed.means)
            directions = canonical_directions(posed.means, posed.linear, center, turn)
        latent = self.latents[-1 if row is None else row]
        return self.colours(self.gaussians.attributes[COLOUR], directions, posed.codes, latent)

    def canonical_covariances(self) -> Tensor:
        """[N, 3, 3] m², in the star pose, undeformed."""
        return skinned_covariance(self.gaussians.scales, self.gaussians.quaternions)

    # --- drawing ---

    @torch.no_grad()
    def posed_gaussians(self, body_pose: BodyPose) -> PosedGaussians:
        """See `scene.contracts.Avatar`. Colours depend on the direction of view: these are the harmonics nearest to
        them, with the last latent code."""
        posed = self.posed(self.star.frame(body_pose))
        pelvis = self.body.posed_joints(body_pose)[0]
        colours = view_harmonics(posed.means, pelvis, lambda camera: self.colours_of(posed, camera, None))
        opacities = self.gaussians.opacities
        return PosedGaussians(posed.means, posed.covariances, colours, None, opacities, DEGREE, posed.weights)

    @torch.no_grad()
    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        frame: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] on `background` and alpha [H, W]; see `scene.contracts.Avatar`. A training frame has its own
        latent code and, unless `test_poses` is "given", its fitted pose; others the last code and the pose given."""
        row = self.training_poses.row(frame)
        fitted = row if self.config.test_poses == "released" and self.fits_poses else None

        def decode() -> Posed:
            return self.posed(self.star.frame(body_pose) if fitted is None else self.training_frame(fitted))

        own = body_pose.pose.tobytes() + body_pose.transl.tobytes() if fitted is None else b"frame"
        posed = self._cache.get(self, own + f" {fitted} {self.step} {len(self)}".encode(), decode)
        rgb, alpha = render_gaussians(
            posed.means,
            posed.covariances,
            self.colours_of(posed, camera, row),
            camera,
            background,
            opacities=self.gaussians.opacities,
            preset="3dgs",
        )
        return rgb.clamp(0, 1).cpu().numpy(), alpha.clamp(0, 1).cpu().numpy()

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
            step=self.step,
            frames=list(given.frames),
            poses=given.poses.tolist(),
            transl=given.transl.tolist(),
        )

    @classmethod
    def load(cls, folder: Path, body: Body, device: str = "cpu") -> ThreeDgsAvatar:
        """Read what `save` wrote. Raises `BadInput` for a missing or foreign file or another body."""
        saved = read_avatar(folder, KIND, body)
        with saved.put_together():
            words, tensors = saved.words, saved.tensors
            config = read(ThreeDgsAvatarConfig, words["config"], "avatar.json: config")
            training = TrainingPoses(
                tuple(int(frame) for frame in words["frames"]), np.array(words["poses"]), np.array(words["transl"])
            )
            avatar = cls(config, body, np.array(words["betas"]), training, seed=0)
            own = "gaussians.attributes."
            learned = {name: tensors[own + name] for name in avatar.gaussians.attributes}
            carried = {
                name: Carried(tensors[f"gaussians.carried_{name}"], of_new)
                for name, of_new in avatar.gaussians.of_new.items()
            }
            means, log_scales, quaternions, opacity_logits = (learned.pop(name) for name in SHAPES)
            avatar.gaussians = Gaussians(means, log_scales, quaternions, opacity_logits, learned, carried)
            avatar.load_state_dict(tensors)
            avatar.step = int(words["step"])
        return avatar.to(device)
