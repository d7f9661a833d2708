"""Studio light: a key lamp, a fill lamp and ambient light, fixed in the world while the person turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Lighting:
    """Directional lamps over ambient light. A surface with unit normal n shows

        albedo · (ambient + Σ_k colour_k · (½ + ½ n·towards_k)²)

    per channel: squared half-Lambert shading (Mitchell et al., "Shading in Valve's Source Engine", 2006), which keeps
    the unlit side readable.
    """

    ambient: NDArray[np.float64]  # [3] RGB
    towards: NDArray[np.float64]  # [L, 3] unit directions from the surface to the lamps, world
    colours: NDArray[np.float64]  # [L, 3] RGB

    def shade(self, normals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normals [..., 3], world -> light [..., 3] to multiply the albedo with. The renderer's slow twin."""
        facing = 0.5 + 0.5 * normals @ self.towards.T
        return self.ambient + facing**2 @ self.colours


def studio_lighting(rng: np.random.Generator) -> Lighting:
    """A warm key lamp from one side and above, a cooler and weaker fill from the other, z up."""
    key_azimuth = rng.uniform(0, 2 * np.pi)
    fill_azimuth = key_azimuth + np.pi * rng.uniform(0.6, 0.9) * rng.choice([-1, 1])
    towards = np.stack([_direction(key_azimuth, rng.uniform(40, 60)), _direction(fill_azimuth, rng.uniform(20, 40))])
    warm, cool = np.array([1.0, 0.97, 0.92]), np.array([0.93, 0.97, 1.0])
    return Lighting(
        ambient=0.42 * np.ones(3),
        towards=towards,
        colours=np.stack([rng.uniform(0.56, 0.66) * warm, rng.uniform(0.20, 0.28) * cool]),
    )


def _direction(azimuth: float, elevation_deg: float) -> NDArray[np.float64]:
    elevation = np.deg2rad(elevation_deg)
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
