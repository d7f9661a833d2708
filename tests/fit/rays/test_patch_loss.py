"""The loss of patches, and what stands for LPIPS where its weights are missing."""

import sys

import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.fit.losses import pyramid_distance
from ihbench.fit.rays import patch_loss as module
from ihbench.fit.rays.patch_loss import LEAST, patch_distance, patch_loss
from ihbench.metrics.lpips import random_networks

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def random_trunks():
    with random_networks() as networks:
        yield networks


def test_squared_error_and_the_mean_distance_of_patches():
    rgb, image = torch.zeros(2, 4, 4, 3), torch.zeros(2, 4, 4, 3)
    image[0] = 0.5
    assert patch_loss(rgb, image, 0.2, None, 1.0).item() == pytest.approx(0.2 * 0.125)
    assert patch_loss(rgb, image, 0.2, pyramid_distance, 3.0).item() == pytest.approx(0.2 * 0.125 + 3 * 0.25)


def test_what_stands_for_lpips_is_said_once(monkeypatch):
    monkeypatch.setattr(module, "perceptual", lambda net, device, least: f"no weights of {net}")
    ledger = Ledger()
    for _ in range(2):
        assert patch_distance("vgg", "pyramid", CPU, ledger) is pyramid_distance
    (event,) = ledger.events
    assert event.data["reason"] == "no weights of vgg; pyramid stands for it"
    assert patch_distance("vgg", "none", CPU, ledger) is None
    assert ledger.events[-1].data["reason"].endswith("nothing stands for it")
    monkeypatch.setattr(module, "perceptual", lambda net, device, least: pyramid_distance)
    assert patch_distance("vgg", "none", CPU, Ledger()) is pyramid_distance


@pytest.mark.parametrize("net", ["vgg", "alex", "squeeze"])
def test_lpips_sees_patches_as_they_are(net, random_trunks, monkeypatch):
    """Unpadded wherever the trunk leaves a pixel of them; where it would not, padded to what it needs."""
    monkeypatch.setattr(sys.modules["ihbench.metrics.lpips"], "load", random_trunks.__getitem__)
    distance = patch_distance(net, "none", CPU, Ledger())
    assert distance is not None
    generator = torch.Generator().manual_seed(0)
    rgb, image = torch.rand(2, 32, 32, 3, generator=generator)
    own, other = (2 * each.permute(2, 0, 1)[None] - 1 for each in (rgb, image))
    expected = random_trunks[net].package(own, other).item()
    assert distance(rgb, image).item() == pytest.approx(expected, rel=1e-6)
    assert 0 < distance(rgb[: LEAST[net] - 1], image[: LEAST[net] - 1]).item() < 10


def test_the_distance_without_weights():
    """0 for the same picture, positive otherwise, with a finite gradient; larger errors cost more."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(32, 32, 3, generator=generator)
    noise = torch.rand(32, 32, 3, generator=generator) - 0.5
    assert pyramid_distance(image, image).item() == pytest.approx(0, abs=1e-6)
    some, more = ((image + size * noise).clamp(0, 1).requires_grad_() for size in (0.1, 0.4))
    assert 0 < pyramid_distance(some, image) < pyramid_distance(more, image)
    pyramid_distance(more, image).backward()
    assert more.grad is not None
    assert more.grad.isfinite().all()
    assert more.grad.norm() > 0


def test_a_blurred_person_costs_less_than_nobody_though_a_strip_hides_half_of_it():
    """On many backgrounds, in half of the views: what a fit starts with must not be better off empty."""
    generator = torch.Generator().manual_seed(0)
    columns = torch.arange(32.0).expand(32, 32)
    person = ((columns - 16).abs() < 8).float()[..., None]
    blurred = torch.sigmoid((8 - (columns - 16).abs()) / 4)[..., None]
    color, costs = torch.tensor([0.6, 0.4, 0.3]), []
    for k in range(40):
        background = torch.rand(3, generator=generator)
        texture = color + 0.2 * (torch.rand(32, 32, 1, generator=generator) - 0.5)
        seen = person * (columns < 16 if k % 2 else torch.ones_like(columns))[..., None]
        image = seen * texture + (1 - seen) * background
        shown = [a * color + (1 - a) * background for a in (0 * blurred, 0.1 * blurred, 0.3 * blurred)]
        costs.append(torch.stack([patch_loss(rgb[None], image[None], 0.2, pyramid_distance, 1.0) for rgb in shown]))
    none, faint, more = torch.stack(costs).mean(0).tolist()
    assert faint < 0.98 * none
    assert more < 0.95 * none
