"""Stage 1, canonical initialisation (sec. 3.4): fit the avatar to what the training views show of the person."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.errors import BadInput, Diverged
from ihbench.ledger import Ledger
from ihbench.methods.inpainthuman.avatar import GaussianAvatar
from ihbench.progress import Progress
from ihbench.render.splat import render_gaussians
from ihbench.scene import MaskState, TrainingSet, TrainView
from ihbench.views import LazyViews

MARGIN = 0.15  # of the projected body's box on every side: garments and pose errors stay inside the window
STATE = "stage1"
TARGETS_HELD = 256  # prepared views kept in memory, about 2 MB each in the paper profile


@dataclass(frozen=True)
class Target:
    """What one step needs of a training view, cut to a window around the body."""

    camera: Camera
    image: Tensor  # [h, w, 3]
    person: Tensor  # [h, w, 1] 1 where the visible person is
    background: Tensor  # [h, w, 1] 1 where the background is known
    points: Tensor  # [n] points that the body does not hide
    transforms: Tensor  # [24, 3, 4]
    position_map: Tensor | None


def prepare_target(avatar: GaussianAvatar, view: TrainView) -> Target:
    """Cut a training view to the body's window and find the points it can show."""
    vertices = avatar.body.pose(view.body_pose, blend_shapes=False)
    x0, y0, width, height = body_window(view.camera, vertices)
    camera = view.camera.cropped(x0, y0, width, height)
    rows, cols = slice(y0, y0 + height), slice(x0, x0 + width)
    device = avatar.device
    mask = torch.from_numpy(np.ascontiguousarray(view.mask[rows, cols])).to(device)[..., None]
    return Target(
        camera=camera,
        image=torch.from_numpy(view.image[rows, cols].astype(np.float32) / 255).to(device),
        person=(mask == MaskState.PERSON).float(),
        background=(mask == MaskState.BACKGROUND).float(),
        points=torch.from_numpy(avatar.unhidden(camera, view.body_pose)).to(device),
        transforms=avatar.transforms(view.body_pose),
        position_map=avatar.position_map(view.body_pose),
    )


def body_window(camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """x0, y0, width, height in px of the projected body's box with a margin, inside the image; the whole image when
    the body is not wholly in front of the camera."""
    p = camera.project(vertices)
    if not (p[:, 2] > 0).all():
        return 0, 0, camera.width, camera.height
    low, high = p[:, :2].min(0), p[:, :2].max(0)
    pad = MARGIN * (high - low).max()
    x0, y0 = (
        int(np.clip(np.floor(v - pad), 0, limit - 1))
        for v, limit in zip(low, (camera.width, camera.height), strict=True)
    )
    x1, y1 = (
        int(np.clip(np.ceil(v + pad), 1, limit)) for v, limit in zip(high, (camera.width, camera.height), strict=True)
    )
    return x0, y0, max(x1 - x0, 1), max(y1 - y0, 1)


def loss_of(avatar: GaussianAvatar, target: Target, background: tuple[float, float, float]) -> Tensor:
    """Mean L1 over visible person pixels, plus what the config adds to it. Unknown pixels never count.

    Both L1 terms are divided by the number of visible pixels, so a spill of one pixel into known background weighs
    as much as one wrong person pixel, whatever the window's size.
    """
    config = avatar.config
    offset, scale, color = avatar.decode(target.points, target.position_map)
    means = avatar.pose_points(target.points, offset, target.transforms)
    rgb, _ = render_gaussians(means, scale, color, target.camera, background)
    error = (rgb - target.image).abs()
    visible = target.person.sum().clamp(min=1) * 3
    loss = (error * target.person).sum() / visible
    if config.paper_strict:
        return loss
    loss = loss + config.background_weight * (error * target.background).sum() / visible
    n = max(len(offset), 1)  # a body behind the camera leaves no point
    return (
        loss
        + config.offset_weight * offset.square().sum() / (3 * n)
        + config.scale_weight * scale.sum() / n
        + config.feature_weight * avatar.features.table.square().mean()
    )


class Stage1:
    """The optimisation, step by step, with everything needed to stop after any step and go on later."""

    def __init__(self, avatar: GaussianAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        self.avatar, self.training, self.seed, self.ledger = avatar, training, seed, ledger
        config = avatar.config
        groups = [
            {"params": list(avatar.features.parameters()), "lr": config.lr_maps, "weight_decay": 0.0},
            {"params": list(avatar.decoder.parameters()), "lr": config.lr_decoder, "weight_decay": 0.01},
        ]
        if config.pose_residual:
            groups.append(
                {"params": list(avatar.encoder.parameters()), "lr": config.lr_encoder, "weight_decay": 0.01}
            )
        self.rates = [group["lr"] for group in groups]
        self.optimizer = torch.optim.AdamW(groups, fused=True)
        self.names = {id(p): name for name, p in avatar.named_parameters()}
        self.step = 0
        views = training.views
        self._targets = LazyViews(lambda k: prepare_target(avatar, views[k]), len(views), held=TARGETS_HELD)

    def run(self, progress: Progress) -> None:
        """Optimise to the last step, resuming a saved state if the ledger has one.

        Raises `Diverged` at the first non-finite loss or gradient, `BadInput` when no view shows the person.
        """
        config, views = self.avatar.config, self.training.views
        self._require_visible_pixels()
        self._restore()
        with progress.task("stage 1", config.steps) as task:
            task.advance(self.step)
            while self.step < config.steps:
                self._one_step(self._view_of(self.step, len(views)))
                self.step += 1
                task.advance()
                self.ledger.offer(self.step, self.avatar)
                if self.ledger.due_to_save() and self.step < config.steps:
                    self.save()
        self.ledger.offer(self.step, self.avatar, force=True)
        self.save()

    def _require_visible_pixels(self) -> None:
        shows = any((view.mask == MaskState.PERSON).any() for view in self.training.views)
        if not shows:
            raise BadInput(
                f"scene {self.training.name}: no training view shows a visible person pixel; nothing to fit"
            )

    def _view_of(self, step: int, n: int) -> int:
        """Every view once an epoch, in an order that depends on seed and epoch alone, so a resumed run repeats it."""
        epoch, k = divmod(step, n)
        return int(np.random.default_rng((self.seed, epoch)).permutation(n)[k])

    def _one_step(self, k: int) -> None:
        config = self.avatar.config
        share = self.step / config.steps
        self.avatar.residual_on = config.pose_residual and share >= config.residual_start
        decay = config.lr_final + (1 - config.lr_final) * 0.5 * (1 + math.cos(math.pi * share))
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * decay
        self.optimizer.zero_grad(set_to_none=True)
        loss = loss_of(self.avatar, self._targets[k], self.training.background)
        if not math.isfinite(loss.item()):
            raise Diverged(self.step, f"loss is {loss.item()}")
        loss.backward()
        for group in self.optimizer.param_groups:
            norm = torch.nn.utils.clip_grad_norm_(group["params"], config.clip_gradient)
            if not math.isfinite(norm.item()):
                raise Diverged(self.step, f"gradient norm is {norm.item()}")
        self.optimizer.step()

    def save(self) -> None:
        """Hand parameters, optimiser moments and the step to the ledger."""
        tensors = {f"avatar.{name}": p.detach() for name, p in self.avatar.named_parameters()}
        for p, state in self.optimizer.state.items():
            for key, value in state.items():
                tensors[f"adam.{self.names[id(p)]}.{key}"] = value
        self.ledger.save_state(STATE, tensors, {"step": self.step})

    def _restore(self) -> None:
        saved = self.ledger.load_state(STATE)
        if saved is None:
            return
        tensors, meta = saved
        with torch.no_grad():
            for name, p in self.avatar.named_parameters():
                p.copy_(torch.as_tensor(tensors[f"avatar.{name}"]))
                state = {
                    key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).clone()
                    for key in ("step", "exp_avg", "exp_avg_sq")
                    if f"adam.{name}.{key}" in tensors
                }
                if state:
                    self.optimizer.state[p] = state
        self.step = int(meta["step"])
        config = self.avatar.config
        self.avatar.residual_on = config.pose_residual and (self.step - 1) / config.steps >= config.residual_start
        self.ledger.event("resumed", stage=STATE, step=self.step)
