"""Motion weights: how much a place of the canonical T-pose belongs to each bone, on a lattice, from a prior in closed
form and a decoder that corrects it (HumanNeRF, CVPR 2022, sec. 3.3; OccNeRF has the same).

Lattices are indexed [z, y, x], as torch's volumes are, and hold both faces of their box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SIDE = 32  # lattice points along a side
BACKGROUND = 24  # channel
SLOPE = 0.2  # of LeakyReLU
# m at which a bone's weight falls to 1/e: across it, across it for bones that start in the trunk, along it
ACROSS, TRUNK_ACROSS, ALONG = 0.06, 0.09, 0.12
TRUNK = (0, 3, 6, 9, 13, 14)
END, HEAD_END = 0.04, 0.12  # m, the same around a joint without children, and around the head
HEAD = 15
MARGIN = 0.3  # m around the joints, of the boxes


def joint_box(joints: Tensor, margin: float = MARGIN) -> tuple[Tensor, Tensor]:  # [24, 3] m
    """Low and high corner [3] m of the box around joints: of the canonical lattice, and of a posed person."""
    return joints.amin(0) - margin, joints.amax(0) + margin


def bone_gaussians(
    points: Tensor,  # [..., 3] m, canonical
    joints: Tensor,  # [24, 3] m, canonical
    parents: Sequence[int],  # [24]
) -> Tensor:
    """[..., 24] g_j: of a joint with children the sum over its bones of exp(-across²/.06² - along²/.12²) about the
    bone's middle, whatever its length; of others exp(-r²/.04²) about the joint, of the head with .12
    (core/utils/body_util.py:274-350). Round about the bone, so no rotation is needed, and none can fail."""
    children: list[list[int]] = [[] for _ in parents]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(joint)
    weights = []
    for joint, of in enumerate(children):
        if not of:
            r = (points - joints[joint]).square().sum(-1)
            weights.append(torch.exp(-r / (HEAD_END if joint == HEAD else END) ** 2))
            continue
        across = TRUNK_ACROSS if joint in TRUNK else ACROSS
        total = torch.zeros_like(points[..., 0])
        for child in of:
            bone = joints[child] - joints[joint]
            apart = points - (joints[child] + joints[joint]) / 2
            along = (apart @ (bone / bone.norm().clamp(min=1e-12))).square()
            beside = (apart.square().sum(-1) - along).clamp(min=0)
            total = total + torch.exp(-beside / across**2 - along / ALONG**2)
        weights.append(total)
    return torch.stack(weights, -1)


def prior_weights(gaussians: Tensor) -> Tensor:  # [..., 24]
    """[..., 25] w_j = g_j / max(1, Σg), and last the background's max(0, 1 - Σg). They sum to 1."""
    total = gaussians.sum(-1, keepdim=True)
    return torch.cat([gaussians / total.clamp(min=1), (1 - total).clamp(min=0)], -1)


def lattice(low: Tensor, high: Tensor, side: int = SIDE) -> Tensor:
    """[side, side, side, 3] m, the points of a lattice, indexed [z, y, x]."""
    share = torch.linspace(0, 1, side, dtype=low.dtype, device=low.device)
    x, y, z = (low[k] + (high[k] - low[k]) * share for k in range(3))
    grid = torch.meshgrid(z, y, x, indexing="ij")
    return torch.stack(grid[::-1], -1)


class MotionWeightVolume(nn.Module):
    """softmax over 25 channels of (decoder + log prior), on a lattice of 32³.

    The decoder: a learned constant vector, a linear layer, five transposed convolutions (kernel 4, stride 2). A
    channel whose prior is 0 in float32 stays 0 whatever the decoder says. As released: `code` 256, `channels` 1024,
    512, 512, 256, 256 (63.6 M parameters).
    """

    log_prior: Tensor  # [25, 32, 32, 32]
    low: Tensor  # [3] m, corners of the lattice
    high: Tensor  # [3] m

    def __init__(
        self,
        joints: Tensor,  # [24, 3] m, canonical, float64
        parents: Sequence[int],
        generator: torch.Generator,
        code: int = 256,
        channels: Sequence[int] = (1024, 512, 512, 256, 256),  # of the linear layer, then of all but the last
        margin: float = MARGIN,
    ):
        super().__init__()
        low, high = joint_box(joints.double(), margin)
        prior = prior_weights(bone_gaussians(lattice(low, high), joints.double(), parents)).float()
        self.register_buffer("log_prior", prior.permute(3, 0, 1, 2).log().contiguous(), persistent=False)
        self.register_buffer("low", low.float(), persistent=False)
        self.register_buffer("high", high.float(), persistent=False)
        self.code = nn.Parameter(torch.randn(code, generator=generator))
        self.first = nn.Linear(code, channels[0])
        started(self.first.weight, code, channels[0], math.sqrt(2 / (1 + SLOPE**2)), generator)
        ups = [nn.ConvTranspose3d(a, b, 4, 2, 1) for a, b in pairwise([*channels, BACKGROUND + 1])]
        for up in ups:
            gain = 1.0 if up is ups[-1] else math.sqrt(2 / (1 + SLOPE**2))
            phase = up.weight.detach()[:, :, :2, :2, :2].clone()
            started(phase, 8 * up.in_channels, 8 * up.out_channels, gain, generator)
            with torch.no_grad():  # every phase of the stride starts as a copy of the first: no chequerboard
                up.weight.copy_(phase.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4))
        for layer in (self.first, *ups):
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
        self.ups = nn.ModuleList(ups)

    def corrections(self) -> Tensor:
        """[25, 32, 32, 32] what is added to the log prior."""
        x = F.leaky_relu(self.first(self.code), SLOPE).view(1, -1, 1, 1, 1)
        for up in self.ups[:-1]:
            x = F.leaky_relu(up(x), SLOPE)
        return self.ups[-1](x)[0]

    def forward(self) -> Tensor:
        """[25, 32, 32, 32] weights, bones first, background last; they sum to 1."""
        return torch.softmax(self.corrections() + self.log_prior, 0)


def started(weight: Tensor, inputs: int, outputs: int, gain: float, generator: torch.Generator) -> None:
    """Xavier's even start: standard deviation gain · √(2 / (inputs + outputs)). As HumanNeRF starts every layer; its
    gain is √2 before ReLU, √(2/1.04) before LeakyReLU(.2), 1 in last layers (core/utils/network_util.py:164-291)."""
    bound = math.sqrt(3) * gain * math.sqrt(2 / (inputs + outputs))
    nn.init.uniform_(weight, -bound, bound, generator)
