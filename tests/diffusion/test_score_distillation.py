"""Score distillation against denoisers whose answer is known in closed form."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.mini.block_transform import BlockTransform
from ihbench.diffusion.score_distillation import (
    Prompts,
    ScoreDistillation,
    drawn_timestep,
    falling_timestep,
    part_guide,
)
from tests.diffusion.sd2_miniature import make_miniature
from tests.diffusion.tiny_diffusion import tiny_backbone

MASSES = {"": -0.3, "person": 0.7, "blurry": 0.2}  # the point mass that a prompt names
KINDS = ("epsilon", "sample", "v_prediction")
SHAPE = (24, 4, 4)


class PointMass(nn.Module):
    """The exact denoiser of one image, whose latents are all what the prompt says."""

    def __init__(self, kind: str, kept: Tensor):
        super().__init__()
        self.kind, self.kept, self.anchor = kind, kept, nn.Parameter(torch.zeros(1))
        self.asked: list[float] = []
        self.conditions: list[Tensor] = []

    def forward(self, given: Tensor, timesteps: Tensor, encoder_hidden_states: Tensor, **residuals: object) -> object:
        noisy, condition = given.split([24, 25], 1)
        self.conditions.append(condition)
        self.asked.append(encoder_hidden_states[0, 0, 0].item())
        mass = encoder_hidden_states[:, :1, :1, None]
        kept = self.kept[timesteps][:, None, None, None]
        noise = (noisy - kept.sqrt() * mass) / (1 - kept).sqrt()
        velocity = kept.sqrt() * noise - (1 - kept).sqrt() * mass
        answer = {"epsilon": noise, "sample": mass.expand_as(noisy), "v_prediction": velocity}[self.kind]
        return SimpleNamespace(sample=answer)


class ByTable(Backbone):
    def text(self, prompts: list[str]) -> Tensor:
        return torch.tensor([MASSES[prompt] for prompt in prompts])[:, None, None]


def point_mass(kind: str = "epsilon") -> Backbone:
    from diffusers import DDIMScheduler

    scheduler = DDIMScheduler(beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012, prediction_type=kind)
    unet = PointMass(kind, scheduler.alphas_cumprod)
    return ByTable("toy", unet, None, None, None, BlockTransform(), scheduler, 16, square=False)


def image(seed: int = 0, count: int = 1) -> Tensor:
    return (2 * torch.rand(count, 3, 16, 16, generator=torch.Generator().manual_seed(seed)) - 1).requires_grad_()


def noise(seed: int = 0) -> Tensor:
    return torch.randn(SHAPE, generator=torch.Generator().manual_seed(seed))


def by_latents(backbone: Backbone, pixels: Tensor, loss: Tensor) -> Tensor:
    """∂L/∂z from ∂L/∂image: the block transform's rows are orthonormal."""
    (gradient,) = torch.autograd.grad(loss, pixels, retain_graph=True)
    codec = backbone.codec
    raw = nn.functional.conv2d(gradient, codec.kernel, stride=codec.block)
    return raw * codec.scale[:, None, None]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("t", [20, 500, 980])
def test_of_a_point_mass_the_gradient_leads_there_whatever_the_noise(kind, t):
    backbone, pixels = point_mass(kind), image()
    distil = ScoreDistillation(backbone, guidance=1.0)
    one, other = (distil(pixels, Prompts("person"), t, noise(seed)) for seed in (0, 1))
    kept = backbone.scheduler.alphas_cumprod[t]
    z = backbone.codec.encode(pixels).detach()
    expected = (kept * (1 - kept)).sqrt() * (z - MASSES["person"])
    assert torch.allclose(one.gradient, expected, atol=2e-6)
    assert torch.allclose(one.gradient, other.gradient, atol=2e-6)
    assert torch.allclose(one.clean, torch.full_like(z, MASSES["person"]), atol=2e-4)
    assert torch.allclose(by_latents(backbone, pixels, one.loss), one.gradient, atol=1e-6)
    assert one.loss.item() == pytest.approx((one.gradient**2).sum().item() / 2, rel=1e-6)


def test_at_the_mass_the_gradient_is_zero():
    backbone = point_mass("epsilon")
    there = torch.full((1, *SHAPE), MASSES["person"])
    pixels = backbone.codec.decode(there).requires_grad_()
    distilled = ScoreDistillation(backbone, guidance=1.0)(pixels, Prompts("person"), 400, noise())
    assert distilled.gradient.abs().max() < 2e-6


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_gradient_of_the_released_square(kind):
    """½ Σ m (z - stop(z - g))², with m and with several images at once."""
    backbone, pixels = point_mass(kind), image(count=3)
    weight = torch.rand(3, 1, 4, 4)
    distil = ScoreDistillation(backbone, guidance=7.5)
    prompts, times = Prompts("person", "blurry"), torch.tensor([30, 400, 900])
    g = distil(pixels, prompts, times, noise()).gradient
    masked = distil(pixels, prompts, times, noise(), weight=weight)
    z = backbone.codec.encode(pixels)
    square = (weight * (z - (z - g).detach()) ** 2).sum() / 2
    assert masked.loss.item() == pytest.approx(square.item(), rel=1e-4)
    expected, got = (torch.autograd.grad(loss, pixels, retain_graph=True)[0] for loss in (square, masked.loss))
    assert torch.allclose(got, expected, atol=1e-5)
    assert torch.equal(masked.gradient, weight * g)


def test_prediction_types_agree_under_guidance():
    pixels, gradients = image(), []
    for kind in KINDS:
        distil = ScoreDistillation(point_mass(kind), guidance=7.5)
        gradients.append(distil(pixels, Prompts("person", "blurry"), 500, noise()).gradient)
    assert torch.allclose(gradients[0], gradients[1], atol=1e-5)
    assert torch.allclose(gradients[0], gradients[2], atol=1e-5)


@pytest.mark.parametrize("guidance", [1.0, 7.5, 50.0])
def test_descent_ends_where_guidance_points(guidance):
    """The fixed point is m_neg + s (m_pos - m_neg): guidance overshoots by its factor."""
    backbone = point_mass("sample")
    distil = ScoreDistillation(backbone, guidance=guidance)
    pixels, generator = image(), torch.Generator().manual_seed(0)
    for _ in range(60):
        t = drawn_timestep(0.3, 0.6, generator)
        distilled = distil(pixels, Prompts("person", "blurry"), t, torch.randn(SHAPE, generator=generator))
        (step,) = torch.autograd.grad(distilled.loss, pixels)
        pixels = (pixels - step).detach().requires_grad_()
    end = MASSES["blurry"] + guidance * (MASSES["person"] - MASSES["blurry"])
    assert torch.allclose(backbone.codec.encode(pixels), torch.full((1, *SHAPE), end), rtol=1e-3, atol=1e-3)


def test_guidance_0_and_1_ask_once_and_for_one_prompt():
    for guidance, asked in ((0.0, ["blurry"]), (1.0, ["person"]), (2.0, ["person", "blurry"])):
        backbone = point_mass()
        ScoreDistillation(backbone, guidance=guidance)(image(), Prompts("person", "blurry"), 500, noise())
        assert backbone.unet.asked == pytest.approx([MASSES[prompt] for prompt in asked])


def test_the_factor_is_of_the_scheduler():
    """1 - ᾱ of Stable Diffusion's schedule, computed beforehand; another factor scales the gradient."""
    backbone, pixels = point_mass(), image()
    for t, share in ((980, 0.9942), (750, 0.9438), (500, 0.7237), (250, 0.3262), (20, 0.0187)):
        as_released = ScoreDistillation(backbone, guidance=1.0)(pixels, Prompts("person"), t, noise()).gradient
        plain = ScoreDistillation(backbone, guidance=1.0, factor=torch.ones_like)
        error = plain(pixels, Prompts("person"), t, noise()).gradient
        assert (as_released / error).median().item() == pytest.approx(share, abs=1e-4)


def test_an_answer_that_is_not_finite_moves_nothing():
    backbone = point_mass()
    backbone.text = lambda prompts: torch.full((len(prompts), 1, 1), torch.nan)  # type: ignore[method-assign]
    distilled = ScoreDistillation(backbone, guidance=1.0)(image(), Prompts("person"), 500, noise())
    assert not distilled.gradient.any()
    assert distilled.loss.item() == 0


def test_the_model_is_shown_nothing_unless_told():
    backbone, pixels = point_mass(), image()
    distil = ScoreDistillation(backbone, guidance=1.0)
    distil(pixels, Prompts("person"), 500, noise())
    hidden = torch.zeros(1, 1, 16, 16)
    distil(pixels, Prompts("person"), 500, noise(), condition=backbone.condition(pixels.detach(), hidden))
    blind, seeing = backbone.unet.conditions
    assert torch.equal(blind, distil.nothing_known(image(5)))
    assert (blind[:, 0] == 1).all()
    assert (seeing[:, 0] == 0).all()
    assert torch.equal(seeing[:, 1:], backbone.codec.encode(pixels))


def test_timesteps():
    assert [falling_timestep(r) for r in (0, 0.25, 0.5, 1)] == [980, 750, 500, 20]
    generator = torch.Generator().manual_seed(0)
    drawn = [drawn_timestep(0.02, 0.03, generator) for _ in range(400)]
    assert set(drawn) == set(range(20, 31))
    assert drawn_timestep(1, 1, generator) == 999


def networks(tmp_path: Path, kind: str) -> Backbone:
    if kind == "sample":
        return tiny_backbone()
    from ihbench.diffusion.sd2_weights import load_sd2

    folder = make_miniature(tmp_path / kind, prediction_type=kind)
    backbone = load_sd2(str(folder), device="cpu")
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # a new ControlNet says nothing
        for p in backbone.controlnet.parameters():
            if not p.any():
                p += 0.05 * torch.randn(p.shape, generator=generator)
    return backbone


@pytest.mark.parametrize("kind", KINDS)
def test_with_real_networks(tmp_path, kind):
    """Both backbones through the same code: the gradient is w times the difference of noises of what the network says
    by itself, the prompts and the part map count, and nothing of the model learns."""
    backbone = networks(tmp_path, kind)
    side = 8 * backbone.codec.block
    pixels = (2 * torch.rand(1, 3, side, side, generator=torch.Generator().manual_seed(0)) - 1).requires_grad_()
    distil = ScoreDistillation(backbone, guidance=0.0, control_scale=0.7)
    own = torch.randn(distil.latent_shape(side, side), generator=torch.Generator().manual_seed(1))
    guide = part_guide(torch.rand(1, 3, side, side, generator=torch.Generator().manual_seed(2)))
    prompts = Prompts("a photo of a person", "skin")
    got = distil(pixels, prompts, 300, own, guide=guide)
    got.loss.backward()
    assert pixels.grad is not None
    assert pixels.grad.abs().max() > 0

    scheduler, t = backbone.scheduler, torch.tensor([300])
    with torch.no_grad():
        z = backbone.codec.encode(pixels)
        noisy = scheduler.add_noise(z, own[None], t)
        said = backbone.predict(
            noisy, t, distil.nothing_known(pixels), backbone.text(["skin"]), guide, control_scale=0.7
        )
    kept = scheduler.alphas_cumprod[300]
    signal, spread = kept.sqrt(), (1 - kept).sqrt()
    predicted_noise = {
        "epsilon": said,
        "sample": (noisy - signal * said) / spread,
        "v_prediction": signal * said + spread * noisy,
    }[kind]
    assert torch.allclose(got.gradient, (1 - kept) * (predicted_noise - own), atol=1e-5)

    def again(prompts: Prompts, guide: Tensor | None, **options: float) -> Tensor:
        chosen = {"guidance": 0.0, "control_scale": 0.7} | options
        return ScoreDistillation(backbone, **chosen)(pixels, prompts, 300, own, guide=guide).gradient

    assert torch.equal(again(Prompts("of with", "skin"), guide), got.gradient)
    assert not torch.equal(again(Prompts("a photo of a person", "with"), guide), got.gradient)
    assert not torch.equal(again(prompts, None), got.gradient)
    assert not torch.equal(again(prompts, guide, control_scale=0.2), got.gradient)
    one = again(prompts, guide, guidance=1.0)
    assert not torch.equal(one, got.gradient)
    two = again(Prompts("a photo of a person", "skin", control="skin"), guide, guidance=1.0)
    assert not torch.equal(two, one)
    parts = (backbone.unet, backbone.controlnet, backbone.text_encoder)
    assert all(p.grad is None for part in parts for p in part.parameters())


def test_guess_mode_counts_less_at_fine_levels():
    backbone = tiny_backbone()
    shape = (1, 24, 8, 8)
    noisy, t = torch.randn(shape, generator=torch.Generator().manual_seed(0)), torch.tensor([300])
    condition, text = torch.zeros(1, 25, 8, 8), backbone.text(["a person"])
    guide = part_guide(torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(2)))
    with torch.no_grad():
        without = backbone.predict(noisy, t, condition, text, None)
        whole = backbone.predict(noisy, t, condition, text, guide)
        guessed = backbone.predict(noisy, t, condition, text, guide, control_scale=0.3, guess=True)
        none = backbone.predict(noisy, t, condition, text, guide, control_scale=0.0)
    assert torch.allclose(none, without, atol=1e-6)
    assert 0 < (guessed - without).abs().mean() < (whole - without).abs().mean()
