"""The two stages of a fit: the map and its network; and, if asked for, features of the pose."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.losses import Perceptual, perceptual
from ihbench.fit.optimisation import Optimisation, ParameterGroup
from ihbench.methods.gaussianavatar.avatar import TexelAvatar
from ihbench.methods.gaussianavatar.losses import Target, image_loss, target_image
from ihbench.methods.gaussianavatar.schedule import (
    epoch_of,
    lpips_weight,
    offset_weight,
    rate_share,
    scale_share,
    steps_of,
)
from ihbench.methods.gaussianavatar.spec import POSE_STAGE, STAGE1
from ihbench.methods.gaussianavatar.texel_network import TexelOutputs
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 256  # prepared views kept in memory, about 3 MB each at 512 px


class TexelStage(Optimisation[TexelAvatar]):
    """Batches of whole views. What `Optimisation` calls a view is a batch here; an epoch shuffles views into batches
    and leaves out those that fill none, as released; fewer views than a batch are one."""

    def __init__(
        self,
        avatar: TexelAvatar,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        groups: Sequence[ParameterGroup],
        steps: int,
        first_step: int = 0,
    ):
        self.config, self.count = avatar.config, len(training.views)
        self.batch = min(self.config.batch, self.count)
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups,
            steps=steps,
            views=self.count // self.batch,
            lr_final=1.0,  # see `_rate_share`
            clip_gradient=math.inf,
            first_step=first_step,
        )
        self._targets = LazyViews(self._target, self.count, held=TARGETS_HELD)
        self._distance: Perceptual | None = None

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        if lpips_weight(self.config, epoch_of(self.config, self.steps - 1, self.steps)) > 0:
            distance = perceptual("alex", self.avatar.device)
            if isinstance(distance, str):
                self.ledger.event_once(LeftOut("lpips term", distance))
            else:
                self._distance = distance
        super().run(progress)

    def batch_of(self, k: int) -> list[int]:
        """Numbers of the views in batch k of this step's epoch."""
        order = np.random.default_rng((self.seed, self.step // self.views, 1)).permutation(self.count)
        return [int(view) for view in order[k * self.batch : (k + 1) * self.batch]]

    def _target(self, k: int) -> Target:
        view, device = self.training.views[k], self.avatar.device
        image, known = target_image(view, self.training.background, self.config.unknown)
        return Target(
            camera=view.camera,
            image=image.to(device),
            known=None if known is None else known.to(device),
            transforms=self.avatar.transforms(view.body_pose),
            position_map=self.avatar.position_maps([view.body_pose])[0] if self.config.pose_stage else None,
        )

    @property
    def epoch(self) -> int:
        return epoch_of(self.config, min(self.step, self.steps - 1), self.steps)

    def _rate_share(self) -> float:
        return rate_share(self.config, self.step, self.steps)

    def _images_loss(self, targets: Sequence[Target], decoded: TexelOutputs, one: bool) -> Tensor:
        """Mean over a batch; `one` decoded map for all of its views, or one each."""
        weight = lpips_weight(self.config, self.epoch)
        losses = []
        for k, target in enumerate(targets):
            points = self.avatar.of_points(decoded, 0 if one else k)
            means = self.avatar.posed(points.offset, target.transforms)
            rgb = render_gaussians(means, points.scale, points.color, target.camera, self.training.background)[0]
            losses.append(image_loss(rgb, target, self.config, weight, self._distance))
        return sum(losses[1:], losses[0]) / len(losses)

    @abstractmethod
    def _loss(self, k: int) -> Tensor: ...


class Stage1(TexelStage):
    """Feature map, smoothing and decoder; what they give does not depend on the view, so a step decodes once."""

    name, title = STAGE1, "stage 1"

    def __init__(self, avatar: TexelAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config, count = avatar.config, len(training.views)
        networks = [*avatar.smoothing.parameters(), *avatar.decoder.parameters()]
        groups = [ParameterGroup(networks, config.lr_network), ParameterGroup([avatar.features], config.lr_features)]
        steps = steps_of(config, count // min(config.batch, count))
        super().__init__(avatar, training, seed, ledger, groups, steps)

    def _before_step(self) -> None:
        self.avatar.scale_share = scale_share(self.config, self.step)

    def _restored(self) -> None:
        self.avatar.scale_share = scale_share(self.config, self.step - 1)  # as the last step had it

    def _loss(self, k: int) -> Tensor:
        config, decoded = self.config, self.avatar.decode()
        loss = self._images_loss([self._targets[view] for view in self.batch_of(k)], decoded, one=True)
        return (
            loss
            + config.scale_weight * self.avatar.of_points(decoded).scale.mean()
            + offset_weight(config, self.epoch) * decoded.offset.square().mean()
            + config.feature_weight * self.avatar.features.square().mean()
        )


class PoseStage(TexelStage):
    """The pose encoder, and the networks of stage 1 at a share of their step size; the feature map is frozen."""

    name, title = POSE_STAGE, "stage 2"

    def __init__(self, avatar: TexelAvatar, training: TrainingSet, seed: int, ledger: Ledger, first_step: int):
        config = avatar.config
        networks = [*avatar.smoothing.parameters(), *avatar.decoder.parameters()]
        groups = [
            ParameterGroup(list(avatar.pose_encoder.parameters()), config.lr_network),
            ParameterGroup(networks, config.network_rate_share * config.lr_network),
        ]
        super().__init__(avatar, training, seed, ledger, groups, config.pose_steps or first_step, first_step)

    def _loss(self, k: int) -> Tensor:
        targets = [self._targets[view] for view in self.batch_of(k)]
        maps = torch.stack([target.position_map for target in targets if target.position_map is not None])
        features = self.avatar.pose_encoder(maps)
        decoded = self.avatar.decode(features)
        return (
            self._images_loss(targets, decoded, one=False)
            + offset_weight(self.config, self.epoch) * decoded.offset.square().mean()
            + self.config.pose_feature_weight * features.square().mean()
        )
