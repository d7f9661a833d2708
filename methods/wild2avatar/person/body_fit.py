"""The start of a fit: the signed distance network is fitted to the body in its canonical pose.

Vid2Avatar ships such weights for one body (assets/smpl_init.pth); here they are fitted to the person's own shape, by
the distance at places near the surface and around it, its normals, and the eikonal term.
"""

from __future__ import annotations

import hashlib

import numpy as np
import torch
from torch import Tensor

from ihbench.methods.wild2avatar.person.canonical_body import BodySurface, CanonicalBody
from ihbench.methods.wild2avatar.person.sdf_network import SdfNetwork

RATE, LAST_SHARE = 5e-3, 0.02  # of Adam, and what is left of it at the end
POINTS = 512  # of each kind in a step
POOL = 32_768  # places off the surface whose distances are looked up once, and drawn from in every step
NEAR, AROUND = 0.05, 0.3  # m, standard deviations of places from the surface
FARTHEST = 0.3  # m: beyond, distances count less
KEPT = 4  # fitted networks
DISTANCE, NORMAL, EIKONAL = 1.0, 0.5, 1.0  # weights; distances in units of `NEAR`

_kept: dict[bytes, dict[str, Tensor]] = {}


def fit_to_body(network: SdfNetwork, body: CanonicalBody, seed: int, steps: int) -> None:
    """Change the network's parameters; what is drawn at random depends on the seed alone. The last few are kept: a
    network that starts as one of them did ends as that one did."""
    digest = hashlib.sha256(f"{seed} {steps} {network.frequencies} {network.skip} {body.vertices.device}".encode())
    for tensor in (body.vertices, *network.state_dict().values()):
        digest.update(tensor.detach().cpu().numpy().tobytes())
    key = digest.digest()
    if key not in _kept:
        if len(_kept) >= KEPT:
            _kept.pop(next(iter(_kept)))
        _fit(network, body, seed, steps)
        _kept[key] = {name: value.detach().clone() for name, value in network.state_dict().items()}
    network.load_state_dict(_kept[key])


def _fit(network: SdfNetwork, body: CanonicalBody, seed: int, steps: int) -> None:
    rng = np.random.default_rng((seed, 0))
    surface = BodySurface(body, rng)
    pool = min(POOL, steps * POINTS)
    spread = np.where(np.arange(pool) % 3 > 0, NEAR, AROUND)[:, None]
    places = surface.points[rng.integers(len(surface.points), size=pool)] + spread * rng.standard_normal((pool, 3))
    away = surface.distance(places)
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE, fused=True)
    device = body.vertices.device
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * LAST_SHARE ** (step / max(steps, 1))
        of, off = rng.integers(len(surface.points), size=POINTS), rng.integers(pool, size=POINTS)
        with torch.enable_grad():
            wanted = torch.from_numpy(np.concatenate([np.zeros(POINTS), away[off]])).float().to(device)
            points = torch.from_numpy(np.concatenate([surface.points[of], places[off]])).float().to(device)
            normals = torch.from_numpy(surface.normals[of]).float().to(device)
            optimizer.zero_grad()
            loss(network, points, wanted, normals).backward()
            optimizer.step()


def loss(
    network: SdfNetwork,
    points: Tensor,  # [N, 3] m, of which the first are on the surface
    wanted: Tensor,  # [N] m
    normals: Tensor,  # [n, 3] of those on the surface
) -> Tensor:
    distance, _, gradient = network.with_gradient(points)
    error = (distance - wanted).abs() / (wanted.abs() / FARTHEST).clamp(min=1)
    normal = (gradient[: len(normals)] - normals).square().sum(1)
    eikonal = (gradient.norm(dim=1) - 1).square()
    return DISTANCE * error.mean() / NEAR + NORMAL * normal.mean() + EIKONAL * eikonal.mean()
