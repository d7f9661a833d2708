"""The wiring of the gsplat back end: a stand-in for the package checks every argument and composites on the CPU.

The shapes and dtypes it insists on are those that gsplat 1.4.0 and 1.5.3 assert or read in their kernels.
"""

import builtins
import re
from types import SimpleNamespace

import pytest
import torch

from ihbench.errors import BadInput
from ihbench.render import splat_gsplat
from ihbench.render.splat import render_gaussians
from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN
from tests.render.test_splat import front_camera, random_gaussians


class FakeGsplat:
    """The three functions, in plain torch, one camera, not packed."""

    def __init__(self, version, two_radii, alpha_max=ALPHA_MAX, alpha_min=ALPHA_MIN):
        self.__version__ = version
        self.two_radii = two_radii
        self.alpha_max, self.alpha_min = alpha_max, alpha_min
        self.pairs = -1

    def isect_tiles(
        self, means2d, radii, depths, tile_size, tile_width, tile_height, sort=True, packed=False, n_cameras=None
    ):
        cameras, n, _ = means2d.shape
        assert cameras == 1
        assert means2d.shape == (1, n, 2)
        assert radii.shape == ((1, n, 2) if self.two_radii else (1, n))
        assert depths.shape == (1, n)
        assert (means2d.dtype, radii.dtype, depths.dtype) == (torch.float32, torch.int32, torch.float32)
        assert sort
        assert not packed
        assert not means2d.requires_grad
        radius = radii[0] if self.two_radii else radii[0][:, None].expand(-1, 2)
        pairs = []
        for i in range(n):
            if (radius[i] <= 0).any():
                continue
            low = torch.floor((means2d[0, i] - radius[i]) / tile_size).long()
            high = torch.ceil((means2d[0, i] + radius[i]) / tile_size).long()
            bits = int(depths[0, i].view(torch.int32))
            for ty in range(max(0, int(low[1])), min(tile_height, int(high[1]))):
                for tx in range(max(0, int(low[0])), min(tile_width, int(high[0]))):
                    pairs.append(((ty * tile_width + tx) << 32 | bits, i))
        pairs.sort(key=lambda pair: pair[0])  # stable, as the radix sort is
        self.pairs = len(pairs)
        ids = torch.tensor([p[0] for p in pairs], dtype=torch.int64)
        return torch.zeros(1, n, dtype=torch.int32), ids, torch.tensor([p[1] for p in pairs], dtype=torch.int32)

    def isect_offset_encode(self, isect_ids, n_cameras, tile_width, tile_height):
        assert n_cameras == 1
        assert isect_ids.dtype == torch.int64
        tiles = torch.arange(tile_width * tile_height)
        return torch.searchsorted(isect_ids >> 32, tiles).int().reshape(1, tile_height, tile_width)

    def rasterize_to_pixels(
        self,
        means2d,
        conics,
        colors,
        opacities,
        image_width,
        image_height,
        tile_size,
        isect_offsets,
        flatten_ids,
        backgrounds=None,
        masks=None,
        packed=False,
        absgrad=False,
    ):
        n, channels = means2d.shape[1], colors.shape[-1]
        tile_height, tile_width = isect_offsets.shape[-2:]
        assert means2d.shape == (1, n, 2)
        assert conics.shape == (1, n, 3)
        assert colors.shape == (1, n, channels)
        assert opacities.shape == (1, n)
        assert backgrounds.shape == (1, channels)
        assert tile_height * tile_size >= image_height
        assert tile_width * tile_size >= image_width
        assert all(x.dtype == torch.float32 for x in (means2d, conics, colors, opacities, backgrounds))
        assert backgrounds.is_contiguous()
        assert not packed
        starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
        rgb_rows, alpha_rows = [], []
        for row in range(image_height):
            for col in range(image_width):
                tile = row // tile_size * tile_width + col // tile_size
                ids = flatten_ids[starts[tile] : starts[tile + 1]].long()
                delta = means2d[0, ids] - torch.tensor([col + 0.5, row + 0.5])
                c = conics[0, ids]
                sigma = 0.5 * (c[:, 0] * delta[:, 0] ** 2 + c[:, 2] * delta[:, 1] ** 2)
                sigma = sigma + c[:, 1] * delta[:, 0] * delta[:, 1]
                alpha = (opacities[0, ids] * torch.exp(-sigma)).clamp(max=self.alpha_max)
                alpha = torch.where(alpha < self.alpha_min, 0.0, alpha)
                behind = torch.cumprod(1 - alpha, 0)
                before = torch.cat([torch.ones(1), behind])[:-1] if len(ids) else behind
                left = behind[-1] if len(ids) else torch.tensor(1.0)
                rgb_rows.append((alpha * before) @ colors[0, ids] + left * backgrounds[0])
                alpha_rows.append(1 - left)
        shape = (1, image_height, image_width)
        return torch.stack(rgb_rows).reshape(*shape, channels), torch.stack(alpha_rows).reshape(*shape, 1)


@pytest.fixture(params=[("1.4.0", False), ("1.5.3", True), ("1.5.10", True)], ids=lambda p: p[0])
def fake(request, monkeypatch):
    package = FakeGsplat(*request.param)
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: package)
    return package


@pytest.mark.parametrize("channels", [3, 5])
def test_image_and_gradients_are_the_twins(fake, channels):
    means, scales, _ = random_gaussians(60)
    means[:5] = means[5:10]  # coincident
    means[10:15, 0] += 40  # outside the image
    means[15:20, 2] *= -1  # behind
    scales[20] = 30.0
    colors = torch.rand(60, channels, generator=torch.Generator().manual_seed(0))
    camera, bg = front_camera(37, 21), torch.linspace(0.1, 0.9, channels)
    pull = torch.randn(21, 37, channels + 1, generator=torch.Generator().manual_seed(1))

    def draw(backend):
        leaves = [x.clone().requires_grad_() for x in (means, scales, colors)]
        image = torch.cat([x.reshape(21, 37, -1) for x in render_gaussians(*leaves, camera, bg, backend)], -1)
        return image.detach(), torch.autograd.grad(image, leaves, pull)

    image, gradients = draw("gsplat")
    true_image, true_gradients = draw("reference")
    assert torch.allclose(image, true_image, atol=1e-4)
    for g, truth in zip(gradients, true_gradients, strict=True):
        assert torch.allclose(g, truth, rtol=1e-3, atol=1e-3 * float(truth.abs().max()))


@pytest.mark.parametrize("preset", ["opaque", "3dgs"])
def test_general_images_and_gradients_are_the_twins(fake, preset):
    """Few and faint enough that no pixel ends early, which the stand-in does not do."""
    g = torch.Generator().manual_seed(2)
    means, _, colors = random_gaussians(25)
    inputs = means, 0.02 + 0.15 * torch.rand(25, 3, generator=g), colors, torch.randn(25, 4, generator=g)
    opacities = 0.01 + 0.5 * torch.rand(25, generator=g)
    pull = torch.randn(21, 37, 4, generator=g)

    def draw(backend):
        leaves = [x.clone().requires_grad_() for x in (*inputs, opacities)]
        image = render_gaussians(
            *leaves[:3], front_camera(37, 21), backend=backend, quaternions=leaves[3], opacities=leaves[4],
            preset=preset,
        )  # fmt: skip
        image = torch.cat([x.reshape(21, 37, -1) for x in image], -1)
        return image.detach(), torch.autograd.grad(image, leaves, pull)

    image, gradients = draw("gsplat")
    true_image, true_gradients = draw("reference")
    assert torch.allclose(image, true_image, atol=1e-4)
    for g, truth in zip(gradients, true_gradients, strict=True):
        assert torch.allclose(g, truth, rtol=1e-3, atol=1e-3 * float(truth.abs().max()))


def test_3dgs_opacities_are_cut_where_an_older_gsplat_would_draw_more(fake):
    _, alpha = render_gaussians(*ONE, front_camera(41, 29), backend="gsplat", preset="3dgs")
    assert float(alpha.max()) == pytest.approx(0.99, abs=1e-6)


def test_a_gsplat_of_the_3dgs_alpha_draws_it(monkeypatch):
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: FakeGsplat("1.6.0", True, 0.99))
    _, alpha = render_gaussians(*ONE, front_camera(41, 29), backend="gsplat", preset="3dgs")
    assert float(alpha.max()) == pytest.approx(0.99, abs=1e-6)


def test_a_splat_far_outside_makes_no_pairs(fake):
    means = torch.tensor([[50.0, 0.0, 2.0], [0.0, -50.0, 2.0]])
    rgb, _ = render_gaussians(means, torch.full((2,), 0.1), torch.zeros(2, 3), front_camera(), backend="gsplat")
    assert (rgb == 1).all()
    assert fake.pairs == 0


def test_no_gaussians(fake):
    empty = torch.zeros(0, 3, requires_grad=True)
    rgb, alpha = render_gaussians(empty, torch.zeros(0), torch.zeros(0, 3), front_camera(), backend="gsplat")
    assert (rgb == 1).all()
    assert (alpha == 0).all()


def test_without_cuda_or_gsplat_one_clear_line(monkeypatch):
    inputs = random_gaussians(3)
    with pytest.raises(RuntimeError, match="expected CUDA tensors, got cpu"):
        render_gaussians(*inputs, front_camera(), backend="gsplat")

    real_import = builtins.__import__

    def without_gsplat(name, *args, **kwargs):
        if name == "gsplat":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_gsplat)
    with pytest.raises(ImportError, match=r"pip install 'ihbench\[cuda\]'"):
        splat_gsplat._gsplat(SimpleNamespace(type="cuda"))


ONE = torch.tensor([[0.0, 0, 2]]), torch.tensor([0.1]), torch.ones(1, 3) / 2


@pytest.mark.parametrize("version", ["1.6.0", "1.6rc1", "1.6.0.dev3+pt24cu121", "v1.7.0", "2.0", "1.10.0"])
@pytest.mark.parametrize("alpha_max", [ALPHA_MAX, 0.99])
def test_a_gsplat_of_another_largest_alpha_is_refused_by_version(monkeypatch, version, alpha_max):
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: FakeGsplat(version, True, alpha_max))
    with pytest.raises(BadInput, match=rf"{re.escape(version)} draws with a largest alpha of 0.99.*gsplat>=1.4,<1.6"):
        render_gaussians(*ONE, front_camera(), backend="gsplat")


@pytest.mark.parametrize("version", ["1.5.3", "1.5.3+pt24cu124", "1.4.0", "unknown", ""])
@pytest.mark.parametrize(
    ("alphas", "word"),
    [((0.99, ALPHA_MIN), "an alpha of 0.99 where 0.999"), ((ALPHA_MAX, 1 / 200), "an alpha of 0 where 0.004118"),
     ((ALPHA_MAX, 1e-4), "an alpha of 0.003725 where 0 belongs"), ((1.0, ALPHA_MIN), "an alpha of 1 where")],
)  # fmt: skip
def test_alphas_that_the_version_does_not_tell_are_measured(monkeypatch, version, alphas, word):
    two_radii = version != "1.4.0"
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: FakeGsplat(version, two_radii, *alphas))
    with pytest.raises(BadInput, match=word):
        render_gaussians(*ONE, front_camera(), backend="gsplat")
    fake = FakeGsplat(version, two_radii)
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: fake)
    rgb, alpha = render_gaussians(*ONE, front_camera(), backend="gsplat")
    torch.testing.assert_close(rgb, render_gaussians(*ONE, front_camera(), backend="reference")[0])
    monkeypatch.setattr(fake, "alpha_max", 0.5)  # measured once a process: training must not pay for it
    assert render_gaussians(*ONE, front_camera(), backend="gsplat")[1].max() < alpha.max()


@pytest.mark.parametrize("version", ["1.3.0", "0.1.11"])
def test_an_older_gsplat_is_refused(monkeypatch, version):
    monkeypatch.setattr(splat_gsplat, "_gsplat", lambda device: FakeGsplat(version, False))
    with pytest.raises(BadInput, match="too old"):
        render_gaussians(*ONE, front_camera(), backend="gsplat")
