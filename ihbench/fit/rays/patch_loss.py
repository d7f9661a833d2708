"""What HumanNeRF and OccNeRF compare patches by: squared error and a perceptual distance."""

from __future__ import annotations

import torch
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.fit.losses import Perceptual, perceptual, pyramid_distance

LEAST = {"vgg": 16, "alex": 31, "squeeze": 20}  # px, of which a trunk's poolings leave a pixel


def patch_distance(net: str, instead: str, device: torch.device, ledger: Ledger) -> Perceptual | None:
    """LPIPS with one of its networks, of patches as they are: padded to the metric's 64² a patch of 32² is three
    quarters grey. Where its weights are missing `pyramid_distance`, or None where another name than `pyramid` is to
    stand for it, and the ledger has an event that says so."""
    distance = perceptual(net, device, LEAST[net])
    if not isinstance(distance, str):
        return distance
    words = f"{instead} stands for it" if instead == "pyramid" else "nothing stands for it"
    ledger.event_once(LeftOut("lpips term", f"{distance}; {words}"))
    return pyramid_distance if instead == "pyramid" else None


def patch_loss(
    rgb: Tensor,  # [P, h, w, 3]
    image: Tensor,  # [P, h, w, 3]
    mse: float,  # weight of the mean squared error over all pixels and channels
    distance: Perceptual | None,
    weight: float,  # of the mean of the patches' perceptual distances
) -> Tensor:
    """Scalar; differentiable in the rendering."""
    loss = mse * (rgb - image).square().mean()
    if distance is None:
        return loss
    return loss + weight * torch.stack([distance(*each) for each in zip(rgb, image, strict=True)]).mean()
