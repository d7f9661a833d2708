"""What a method does to a pose before it skins, as far as a page can carry it.

A network that corrects poses, or offsets that depend on the pose, put Gaussians where the body's own joints would not
take them. Given where they are in a pose, the affine maps of the joints' rest frames that bring skinned Gaussians
nearest to them are a linear least-squares problem: exact for whatever turns joints, an approximation for what bends
surface. Sampled along motions they travel with the avatar.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOINTS = 24
MOST = 8_000  # Gaussians that the maps are fitted to
RIDGE = 1e-4  # m², what a joint's linear part pays for leaving the identity, beside an even share of the Gaussians
STEP = 2  # frames of a motion between two samples
LEVELS = 32767


def corrected(
    transforms: Array,  # [24, 3, 4] rest to world
    correction: Array | None,  # [24, 3, 4] M and s: a joint at J first takes x to J + M (x - J) + s
    joints: Array,  # [24, 3] m, J
) -> Array:
    """[24, 3, 4] rest to world."""
    if correction is None:
        return transforms
    turn, shift = transforms[:, :, :3] @ correction[:, :, :3], correction[:, :, 3] + joints
    moved = np.einsum("jab,jb->ja", transforms[:, :, :3], shift) + transforms[:, :, 3]
    return np.concatenate([turn, (moved - np.einsum("jab,jb->ja", turn, joints))[:, :, None]], 2)


@dataclass(frozen=True, eq=False)
class Corrector:
    """Finds the corrections of N Gaussians at rest."""

    rest: Array  # [N, 3] m
    weights: Array  # [N, 24]
    joints: Array  # [24, 3] m
    importance: Array  # [N], such as opacities

    @cached_property
    def _some(self) -> NDArray[np.intp]:
        return np.unique(np.linspace(0, len(self.rest) - 1, MOST).round().astype(np.intp))

    @cached_property
    def _design(self) -> Array:
        """[n, 96]: weights times (x - J, 1)."""
        from_joints = self.rest[self._some, None] - self.joints
        there = np.concatenate([from_joints, np.ones((*from_joints.shape[:2], 1))], 2)
        return (self.weights[self._some][:, :, None] * there).reshape(len(there), -1)

    @cached_property
    def _solver(self) -> Array:
        """[96, n]: from what is left of the means to what is added to the transforms."""
        share = self.importance[self._some] / max(self.importance[self._some].sum(), 1e-12)
        weighted = self._design.T * share
        ridge = np.tile([RIDGE, RIDGE, RIDGE, RIDGE / 100], JOINTS) / JOINTS
        return np.linalg.solve(weighted @ self._design + np.diag(ridge), weighted)

    def of(
        self,
        means: Array,  # [N, 3] m, where the method puts them in a pose
        transforms: Array,  # [24, 3, 4] of the body in that pose, rest to world
    ) -> Array:
        """[24, 3, 4] as `corrected` takes it. A joint that moves nothing has no correction."""
        turn = transforms[:, :, :3]
        at_joints = np.einsum("jab,jb->ja", turn, self.joints) + transforms[:, :, 3]
        centred = np.concatenate([turn, at_joints[:, :, None]], 2)
        left = means[self._some] - self._design @ centred.transpose(0, 2, 1).reshape(-1, 3)
        added = (self._solver @ left).reshape(JOINTS, 4, 3).transpose(0, 2, 1)
        own = np.asarray(np.linalg.solve(turn, centred + added), np.float64)
        own[:, :, 3] -= np.linalg.solve(turn, at_joints[:, :, None])[:, :, 0]
        return own


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections at the samples of some clips, by name, as they travel: 16 bits a number."""

    clips: Mapping[str, tuple[int, int]]  # the first sample and how many
    levels: NDArray[np.int16]  # [F, 24, 3, 4] what is beyond the identity
    largest: float  # what LEVELS stands for

    @classmethod
    def of(cls, samples: Mapping[str, Array]) -> Corrections:  # [F, 24, 3, 4] each
        clips, begun = {}, 0
        for name, values in samples.items():
            clips[name] = begun, len(values)
            begun += len(values)
        beyond = np.concatenate(list(samples.values())) - np.eye(3, 4)
        largest = float(max(np.abs(beyond).max(), 1e-6))
        return cls(clips, np.rint(beyond / largest * LEVELS).astype(np.int16), largest)

    def at(self, name: str, frame: int = 0) -> Array:
        """[24, 3, 4] at a frame of a clip: between two samples it lies on a line, as in the page."""
        begin, count = self.clips[name]
        low, share = begin + min(frame // STEP, count - 1), frame % STEP / STEP
        high = min(low + 1, begin + count - 1)
        levels = self.levels[low] * (1 - share) + self.levels[high] * share
        return np.eye(3, 4) + levels / LEVELS * self.largest

    def packed(self) -> bytes:
        """One number of all samples after the other, each as the difference from the one before (wrapped around), low
        bytes and high bytes apart; deflated."""
        plane = self.levels.reshape(len(self.levels), -1).T.ravel().view(np.uint16)
        steps = np.diff(plane, prepend=np.uint16(0)).astype(np.uint16)
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        data = (steps & 255).astype(np.uint8).tobytes() + (steps >> 8).astype(np.uint8).tobytes()
        return packer.compress(data) + packer.flush()

    @property
    def about(self) -> dict[str, Any]:
        """What a page must know to unpack them."""
        return {
            "clips": {name: list(span) for name, span in self.clips.items()},
            "largest": self.largest,
            "step": STEP,
        }


def samples_of(frames: int, cyclic: bool) -> list[int]:
    """Frames of a motion whose corrections travel: every STEP-th and one beyond the last."""
    every = range(0, frames + STEP, STEP)
    return [frame % frames if cyclic else min(frame, frames - 1) for frame in every]
