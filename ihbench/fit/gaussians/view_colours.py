"""Colours that a method computes for each direction of view, as spherical harmonics that files and pages can have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.render.spherical_harmonics import basis

DEGREE = 3
EYES = 48  # places on a sphere; 16 unknowns
AWAY = 3.0  # m


def view_harmonics(
    means: Tensor,  # [N, 3] m
    around: np.ndarray,  # [3] m, what is looked at
    colours_from: Callable[[Camera], Tensor],  # [N, 3] as a camera at its place sees them
) -> Tensor:
    """[N, 16, 3] coefficients whose sum plus 0.5 is nearest to the colours seen from all sides, by least squares over
    places spread evenly on a sphere."""
    turns = np.arange(EYES) * np.pi * (3 - np.sqrt(5))  # a Fibonacci lattice
    heights = 1 - 2 * (np.arange(EYES) + 0.5) / EYES
    flat = np.sqrt(1 - heights**2)
    eyes = np.asarray(around) + AWAY * np.stack([flat * np.cos(turns), heights, flat * np.sin(turns)], 1)
    seen = torch.stack([colours_from(Camera(np.eye(3), np.eye(3), -eye, 1, 1)) for eye in eyes], 1)
    toward = means[:, None].double() - torch.from_numpy(eyes).to(means.device)
    directions = toward / toward.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    values = basis(directions.reshape(-1, 3), DEGREE).reshape(len(means), EYES, -1)
    across = values.transpose(1, 2)
    normal = across @ values + 1e-9 * torch.eye(values.shape[-1]).to(values)
    return torch.linalg.solve(normal, across @ (seen.double() - 0.5)).to(means.dtype)
