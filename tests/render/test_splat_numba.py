"""The numba renderer against the float64 twin: images to 1e-3, gradients to 1e-3, on everyday and extreme scenes."""

import math
import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from ihbench.kernels.splats import Gaussians, body_gaussians, compare_with_twin
from ihbench.render import splat_compositing, splat_numba, splat_reference
from ihbench.render.splat import render_gaussians
from ihbench.render.splat_tiles import depth_order
from ihbench.render.splats import Splats
from tests.render.test_splat import front_camera, random_gaussians


def scene(n, seed, width, height, scale=(0.02, 0.1), depth=(1.0, 3.0), focal=60.0):
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    x, y = (rng.uniform(-0.7, 0.7, n) * side / focal * z for side in (width, height))
    scales = np.exp(rng.uniform(np.log(scale[0]), np.log(scale[1]), n))
    tensors = (np.stack([x, y, z], -1), scales, rng.uniform(size=(n, 3)))
    return Gaussians(*(torch.tensor(a, dtype=torch.float32) for a in tensors), front_camera(width, height, focal))


def coincident():
    """All at one depth and many at one place: only the index orders them."""
    s = scene(300, 4, 40, 33)
    s.means[:, 2] = 2.0
    s.means[:150] = s.means[150:].clone()
    return s


def behind():
    """Half behind the camera or near the near plane."""
    s = scene(400, 5, 50, 40)
    s.means[::2, 2] = torch.linspace(-1.0, 0.03, 200)
    return s


def stack(n):
    """n big splats behind one another: the transmittance falls below what float32 holds."""
    s = scene(n, 6, 48, 48, scale=(0.2, 0.3))
    s.means[:, :2] *= 0.2
    return s


def border():
    """Centres on the edges and corners of the image and of the tiles."""
    s = scene(0, 0, 48, 32)
    columns, rows = (-0.5, 0, 0.5, 15.5, 16, 16.5, 47.5, 48, 50), (-2, 0, 15.99, 31.5, 32)
    pixels = np.array([(x, y) for x in columns for y in rows])
    z = np.linspace(1, 3, len(pixels))
    means = np.column_stack([(pixels - (24, 16)) / 60 * z[:, None], z])
    colors = np.random.default_rng(0).uniform(size=(len(z), 3))
    tensors = (torch.tensor(a, dtype=torch.float32) for a in (means, 0.04 * z, colors))
    return Gaussians(*tensors, s.camera)


SCENES = {
    "random": lambda: scene(600, 0, 64, 64),
    "no multiple of 16": lambda: scene(400, 1, 53, 37),
    "sub-pixel": lambda: scene(2000, 2, 64, 64, scale=(1e-6, 3e-3)),
    "huge": lambda: scene(40, 3, 40, 40, scale=(0.3, 1e5)),
    "mixed sizes": lambda: scene(300, 7, 64, 48, scale=(1e-4, 30.0)),
    "coincident": coincident,
    "behind": behind,
    "stack": lambda: stack(300),
    "border": border,
    "one": lambda: scene(1, 8, 40, 30),
    "one pixel": lambda: scene(30, 9, 1, 1),
    "one row": lambda: scene(60, 10, 70, 1),
    "one column": lambda: scene(60, 11, 1, 70),
    "body": lambda: body_gaussians(3000, 96),
}


@pytest.fixture(params=["vectors", "plain"])
def kernels(request, monkeypatch):
    """The kernels with explicit vectors, and those for processors that have none worth it."""
    monkeypatch.setattr(splat_numba, "vectors", lambda: request.param == "vectors")


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_twin(name, kernels):
    # a wide splat is nearly flat where it is clamped: only a narrow tolerance leaves pixels to compare
    tolerance = 1e-5 if name in ("huge", "mixed sizes") else 1e-4
    errors = compare_with_twin(SCENES[name](), "numba", background=(0.9, 0.4, 0.1), tolerance=tolerance)
    assert errors.image < 2e-5
    assert errors.image_at_threshold < 2e-5
    assert errors.at_threshold < 0.2
    for tensor in ("means", "scales", "colors"):
        assert errors.gradient[tensor] < 1e-4, tensor
        assert errors.gradient_element[tensor] < 1e-3, tensor


def test_one_enormous_splat():
    """Its gradients are beyond float32; its picture is not."""
    color = torch.tensor([[0.1, 0.2, 0.3]])
    s = Gaussians(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([1e6]), color, front_camera())
    errors = compare_with_twin(s, "numba")
    assert errors.image < 1e-6
    assert errors.gradient["colors"] < 1e-5


@pytest.mark.parametrize("opacity", [None, 1.0])
def test_huge_splats_do_not_fill_the_memory(monkeypatch, opacity):
    """What lies behind splats that cover a tile is not listed: 20 000 × 32 tiles would be 640 000 entries."""
    n = 20_000
    s = scene(n, 3, 256, 256, scale=(50.0, 60.0))
    listed = []
    fill = splat_numba.fill_tiles

    def spy(*args):
        listed.append(len(args[-1]))
        return fill(*args)

    monkeypatch.setattr(splat_numba, "fill_tiles", spy)
    with torch.no_grad():
        rgb, alpha = render_gaussians(
            s.means, s.scales, s.colors, s.camera, backend="numba",
            opacities=None if opacity is None else torch.full((n,), opacity),
        )  # fmt: skip
    assert 32 <= listed[0] < 50 * 32
    assert (alpha > 0.998).all()
    front = int(s.means[:, 2].argmin())
    assert torch.allclose(rgb[128, 128], s.colors[front], atol=2e-3)


def test_dropped_alphas_hide_nothing():
    """Thousands of wide splats whose alpha in a corner is under the threshold: what is behind shows there."""
    n = 30_000
    xy = torch.tensor([[-31.7, -31.7]], dtype=torch.float64).repeat(n + 1, 1)
    variance = torch.full((n + 1,), 20.0**2, dtype=torch.float64)
    xy[n], variance[n] = torch.tensor([15.5, 15.5], dtype=torch.float64), 1.0
    farthest = math.exp(-float((xy[n] - xy[0]).square().sum()) / (2 * 20.0**2))
    assert 0.0037 < farthest < 1 / 255
    colors = torch.zeros(n + 1, 3)
    colors[n, 1] = 1.0
    rgb, _ = splat_numba.composite(Splats(xy, variance, torch.linspace(1, 2, n + 1), colors), 16, 16, torch.zeros(3))
    assert rgb[15, 15].tolist() == pytest.approx([0, 0.999, 0], abs=1e-6)


def test_no_grad_stores_no_transmittances(monkeypatch):
    s = body_gaussians(500, 48)
    kept = []
    draw = splat_compositing.composite_tiles

    def spy(*args):
        state, part, _ = args[-3:]
        if part == 0:  # once per image, not once per part
            kept.append(state.size)
        return draw(*args)

    monkeypatch.setattr(splat_compositing, "composite_tiles", spy)
    leaves = [x.clone().requires_grad_() for x in (s.means, s.scales, s.colors)]
    with torch.no_grad():
        render_gaussians(*leaves, s.camera, backend="numba")
    render_gaussians(*leaves, s.camera, backend="numba")
    render_gaussians(s.means, s.scales, s.colors, s.camera, backend="numba")
    assert kept[0] == kept[2] == 0 < kept[1]


@pytest.mark.parametrize("opacity", [None, 0.5])
def test_the_thread_count_changes_nothing(opacity, kernels):
    s = body_gaussians(4000, 128)
    opacities = None if opacity is None else torch.full((4000,), opacity)

    def draw():
        leaves = [x.clone().requires_grad_() for x in (s.means, s.scales, s.colors)]
        rgb, alpha = render_gaussians(*leaves, s.camera, backend="numba", opacities=opacities)
        (rgb.square().sum() + alpha.sum()).backward()
        return [rgb.detach(), alpha.detach(), *(x.grad for x in leaves)]

    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(draw())
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_few_splats_follow_the_depth():
    for n in (1, 2, 7, 8, 9, 63):
        errors = compare_with_twin(scene(n, n, 40, 24, scale=(0.1, 0.3)), "numba")
        assert errors.image < 2e-5


def test_depth_order_is_stable_and_complete():
    rng = np.random.default_rng(0)
    for spread in (0.0, 1e-6, 1.0, 1e6):
        depth = (1 + spread * rng.uniform(size=3000).round(2)).astype(np.float32)
        keys = depth.view(np.uint32)
        order = depth_order(np.arange(3000, dtype=np.int32), keys.copy(), keys.min(), keys.max())
        assert (order == np.argsort(depth, kind="stable")).all()


def test_an_error_in_a_thread_is_raised():
    def kernel(part, parts):
        if part == min(17, parts - 1):
            raise RuntimeError("part 17")

    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with pytest.raises(RuntimeError, match="part 17"):
                splat_numba._run(kernel)
    finally:
        torch.set_num_threads(before)


def test_every_part_runs_once_on_any_number_of_threads():
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 7):
            torch.set_num_threads(threads)
            done = []
            splat_numba._run(lambda part, parts, done=done: done.append((part, parts)))
            parts = done[0][1]
            assert sorted(done) == [(part, parts) for part in range(parts)]
            assert parts == (1 if threads == 1 else splat_numba.PARTS)
    finally:
        torch.set_num_threads(before)


def test_drawing_goes_on_after_a_fork():
    """A data loader's forked worker has none of the parent's threads and must not wait for them."""
    s = body_gaussians(500, 48)
    here, _ = render_gaussians(s.means, s.scales, s.colors, s.camera, backend="numba")
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_draw_and_put, args=(queue, s))
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert np.array_equal(queue.get(), here.numpy())


def _draw_and_put(queue, s):
    # torch's own OpenMP threads do not survive the fork either
    torch.set_num_threads(1)
    rgb, _ = render_gaussians(s.means, s.scales, s.colors, s.camera, backend="numba")
    splat_numba._run(lambda part, parts: None)
    queue.put(rgb.numpy())


def test_the_gradient_survives_the_clamp(kernels):
    """Alpha next to ALPHA_MAX in front, where 1 / (1 - alpha) is 1000: both splats' gradients stay right."""
    xy = torch.tensor([[8.5 + 0.05, 8.5], [9.0, 8.2], [8.0, 8.9]], dtype=torch.float64)
    variance = torch.tensor([1.2, 6.0, 9.0], dtype=torch.float64)
    colors = torch.tensor([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.4, 0.5, 0.9]], dtype=torch.float64)
    gradients = []
    for module in (splat_reference, splat_numba):
        leaves = [x.clone().requires_grad_() for x in (xy, variance, colors)]
        splats = Splats(leaves[0], leaves[1], torch.tensor([1.0, 2.0, 3.0]), leaves[2])
        rgb, _ = module.composite(splats, 17, 17, torch.zeros(3))
        gradients.append(torch.autograd.grad(rgb[8, 8].double().sum(), leaves))
    for truth, value in zip(*gradients, strict=True):
        assert torch.allclose(truth, value.double(), rtol=1e-4, atol=1e-9)


def test_the_comparison_sees_a_wrong_back_end(monkeypatch):
    """The helper behind these tests reports each kind of error where it is."""
    s = Gaussians(*random_gaussians(100), front_camera())
    original = splat_numba.draw_isotropic

    def with_image_error(*args):
        rgb, alpha = original(*args)
        return rgb + 3e-3, alpha

    def with_gradient_error(means, scales, colors, *args):
        return original(means, scales, colors * 1.01 - colors.detach() * 0.01, *args)

    def with_one_wrong_element(means, scales, colors, *args):
        factor = torch.ones(len(scales))
        factor[40] = 1.5
        return original(means, scales * factor - scales.detach() * (factor - 1), colors, *args)

    monkeypatch.setattr(splat_numba, "draw_isotropic", with_image_error)
    assert compare_with_twin(s, "numba").image == pytest.approx(3e-3, rel=0.01)
    monkeypatch.setattr(splat_numba, "draw_isotropic", with_gradient_error)
    errors = compare_with_twin(s, "numba")
    assert errors.gradient["colors"] == pytest.approx(0.01, rel=0.01)
    assert errors.gradient["means"] < 1e-4
    assert errors.image < 2e-5
    monkeypatch.setattr(splat_numba, "draw_isotropic", with_one_wrong_element)
    errors = compare_with_twin(s, "numba")
    assert errors.gradient_element["scales"] > 0.05
    assert errors.image < 2e-5


def test_the_comparison_allows_only_the_threshold():
    """At a pixel where an alpha lies on the threshold, one ALPHA_MIN per such splat is allowed, and no more."""
    s = Gaussians(*random_gaussians(400), front_camera())
    loose = compare_with_twin(s, "numba", tolerance=0.2)
    tight = compare_with_twin(s, "numba")
    assert loose.at_threshold > 0.2 > tight.at_threshold
    assert loose.image_at_threshold == tight.image_at_threshold == 0


def test_the_process_that_compiles_and_those_that_load_the_code_agree_to_the_last_bit(tmp_path):
    code = """
import hashlib, torch
from ihbench.kernels.splats import body_gaussians
from ihbench.render.splat import render_gaussians
torch.set_num_threads(1)
scene = body_gaussians(2000, 64)
leaves = [x.clone().requires_grad_() for x in (scene.means, scene.scales, scene.colors)]
rgb, _ = render_gaussians(*leaves, scene.camera, backend="numba")
general, _ = render_gaussians(*leaves, scene.camera, backend="numba", opacities=torch.full((2000,), 0.5))
((rgb + general) * torch.randn(rgb.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
results = (rgb, general, *[leaf.grad for leaf in leaves])
print(*[hashlib.sha256(x.detach().numpy().tobytes()).hexdigest() for x in results])
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    )
    assert first == second
