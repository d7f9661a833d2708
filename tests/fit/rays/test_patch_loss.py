"""The loss of patches, and what stands for LPIPS where its weights are missing."""

import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.fit.losses import absolute_distance
from ihbench.fit.rays import patch_loss as module
from ihbench.fit.rays.patch_loss import patch_distance, patch_loss

CPU = torch.device("cpu")


def test_squared_error_and_the_mean_distance_of_patches():
    rgb, image = torch.zeros(2, 4, 4, 3), torch.zeros(2, 4, 4, 3)
    image[0] = 0.5
    assert patch_loss(rgb, image, 0.2, None, 1.0).item() == pytest.approx(0.2 * 0.125)
    assert patch_loss(rgb, image, 0.2, absolute_distance, 3.0).item() == pytest.approx(0.2 * 0.125 + 3 * 0.25)


def test_what_stands_for_lpips_is_said_once(monkeypatch):
    monkeypatch.setattr(module, "perceptual", lambda net, device: f"no weights of {net}")
    ledger = Ledger()
    for _ in range(2):
        assert patch_distance("vgg", "l1", CPU, ledger) is absolute_distance
    (event,) = ledger.events
    assert event.data["reason"] == "no weights of vgg; l1 stands for it"
    assert patch_distance("vgg", "none", CPU, ledger) is None
    assert ledger.events[-1].data["reason"].endswith("nothing stands for it")
    monkeypatch.setattr(module, "perceptual", lambda net, device: absolute_distance)
    assert patch_distance("vgg", "none", CPU, Ledger()) is absolute_distance
