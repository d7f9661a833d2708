"""The hierarchical pose code (LEAP's encoder, as 3DGS-Avatar has it in models/network_utils.py:119-177)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

PER_JOINT = 6
INPUTS = 13 + PER_JOINT  # rotation 9, joint 3, bone length 1, the parent's code 6


class PoseCode(nn.Module):
    """Rotations and rest joints → 24 codes of 6 numbers, each from its joint and its parent's code.

    The root reads a linear code of everything in place of a parent's. Joints of one depth of the tree are computed
    together; weights of each joint are its own, in PyTorch's initialisation of a linear layer.
    """

    first: nn.Parameter  # [24, 19, 19], output by input
    first_bias: nn.Parameter  # [24, 19]
    second: nn.Parameter  # [24, 6, 19]
    second_bias: nn.Parameter  # [24, 6]

    def __init__(self, parents: Sequence[int]):
        super().__init__()
        joints = len(parents)
        self.whole = nn.Linear(12 * joints, PER_JOINT)
        layers = [(nn.Linear(INPUTS, INPUTS), nn.Linear(INPUTS, PER_JOINT)) for _ in range(joints)]
        for name, k in (("first", 0), ("second", 1)):
            weights = torch.stack([pair[k].weight.detach() for pair in layers])
            biases = torch.stack([pair[k].bias.detach() for pair in layers])
            self.register_parameter(name, nn.Parameter(weights))
            self.register_parameter(f"{name}_bias", nn.Parameter(biases))
        depth = [0] * joints
        for joint, parent in enumerate(parents):
            depth[joint] = 0 if parent < 0 else depth[parent] + 1
        self.parents = list(parents)
        self._floors = [[j for j in range(joints) if depth[j] == d] for d in range(max(depth) + 1)]
        ordered = [joint for floor in self._floors for joint in floor]
        self._place = [ordered.index(joint) for joint in range(joints)]

    @property
    def width(self) -> int:
        return PER_JOINT * len(self.parents)

    def forward(
        self,
        rotations: Tensor,  # [24, 9], the root's the identity
        joints: Tensor,  # [24, 3] normalised
    ) -> Tensor:
        """[144], joint by joint."""
        upwards = [max(parent, 0) for parent in self.parents]
        bone = joints - torch.cat([torch.zeros_like(joints[:1]), joints[upwards[1:]]])
        own = torch.cat([rotations, joints, torch.linalg.vector_norm(bone, dim=1, keepdim=True)], 1)
        parent = self.whole(torch.cat([rotations.flatten(), joints.flatten()]))[None]
        codes: list[Tensor] = []
        for depth, floor in enumerate(self._floors):
            if depth:
                above = self._floors[depth - 1]
                parent = codes[-1][[above.index(self.parents[joint]) for joint in floor]]
            inputs = torch.cat([own[floor], parent], 1)
            hidden = F.relu((self.first[floor] @ inputs[:, :, None])[..., 0] + self.first_bias[floor])
            codes.append((self.second[floor] @ hidden[:, :, None])[..., 0] + self.second_bias[floor])
        return torch.cat(codes)[self._place].flatten()
