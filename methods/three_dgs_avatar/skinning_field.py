"""Skinning weights as a field: a network of the place, whose outputs are shared out down the kinematic tree.

3DGS-Avatar, models/deformer/rigid.py:84-237; the hierarchical softmax is from SNARF.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ihbench.methods.three_dgs_avatar.leaky_layers import LeakyLayers

WIDTH, HIDDEN = 128, 4


class SkinningField(nn.Module):
    """ξ → 4 × 128 LeakyReLU → one logit a joint, and one more for each joint of several children but the root."""

    def __init__(self, parents: Sequence[int]):
        super().__init__()
        self.tree = Tree(parents)
        self.layers = LeakyLayers([3, *[WIDTH] * HIDDEN, self.tree.logits])

    def forward(
        self,
        places: Tensor,  # [N, 3] ξ
    ) -> Tensor:
        """[N, 24] weights, rows sum to 1."""
        return self.tree(self.layers(places))


class Tree(nn.Module):
    """The hierarchical softmax: the root has all, and every joint hands a share of what it has to its children.

    A joint of one child hands over sigmoid(ℓ_child). A joint of several hands over sigmoid(gate), split among them by
    the softmax of their logits; the gate is ℓ_root at the root and an extra logit elsewhere (SMPL: the upper spine's,
    number 24). Computed as exp of sums of logarithms along each joint's path, one matrix product for all joints.
    """

    paths: Tensor  # [2 L + S, J] 0/1: rows are ln s(ℓ), ln (1 - s(ℓ)) and ln softmax of siblings

    def __init__(self, parents: Sequence[int]):
        super().__init__()
        joints = len(parents)
        children = [[k for k in range(joints) if parents[k] == j] for j in range(joints)]
        self.siblings = [each for each in children if len(each) > 1]
        gates: dict[int, int] = {}
        self.logits = joints
        for j in range(joints):
            if parents[j] < 0:
                gates[j] = j
            elif len(children[j]) > 1:
                gates[j], self.logits = self.logits, self.logits + 1
            elif children[j]:
                gates[j] = children[j][0]
        shared = [k for each in self.siblings for k in each]
        paths = torch.zeros(2 * self.logits + len(shared), joints)
        for j, parent in enumerate(parents):
            if parent >= 0:
                # what the parent had before it kept its own share; parents come first
                paths[:, j] = paths[:, parent]
                paths[self.logits + gates[parent], j] = 0
                paths[gates[parent], j] = 1
                if j in shared:
                    paths[2 * self.logits + shared.index(j), j] = 1
            if children[j]:
                paths[self.logits + gates[j], j] = 1
        self.register_buffer("paths", paths, persistent=False)

    def forward(
        self,
        logits: Tensor,  # [N, J + extra]
    ) -> Tensor:
        """[N, J]."""
        yes = F.logsigmoid(logits)
        parts = [yes, yes - logits, *(logits[:, each].log_softmax(1) for each in self.siblings)]
        return (torch.cat(parts, 1) @ self.paths).exp()
