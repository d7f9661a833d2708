"""OccNeRF's parts: acceptance checks 1, 2, 4 and 5, the counters of check 3, the search for neighbours."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from ihbench.methods.occnerf.canonical_surface import CanonicalSurface, farthest_points, vertex_normals
from ihbench.methods.occnerf.completeness import completeness, sample_costs
from ihbench.methods.occnerf.decoder import SurfaceDecoder
from ihbench.methods.occnerf.nearest_vertices import NearestVertices, nearest_by_torch
from ihbench.methods.occnerf.projection import grid_place, projected, signed_distance
from ihbench.methods.occnerf.visibility import count_seen, ends_of_rays, neighbour_weights
from tests.bench.fake_capture import the_body

BODY = the_body()


@cache
def surface():
    return CanonicalSurface(BODY, np.zeros(10), seed=0)


# ---------------------------------------------------------------------------------------------- check 1: completeness


def prior(sigma, inside, samples=None, origin=None):
    sigma = torch.tensor(sigma, dtype=torch.float64, requires_grad=True)
    own = completeness(sigma, torch.tensor(inside), len(inside) if samples is None else samples, origin)
    (gradient,) = torch.autograd.grad(own.total, sigma)
    return own.total.item(), gradient


def test_check_1_the_completeness_prior():
    n = 600
    outside = [False] * n
    assert prior([2.0] * n, outside)[0] == 0
    assert prior([2.0] * n, [True, *outside[1:]])[0] == pytest.approx(1.353 / n, rel=1e-3)
    assert prior([12.0] * n, [True] * n)[0] == pytest.approx(4.54e-4, rel=1e-3)
    value, gradient = prior([-1.0] * n, [True] * n)
    assert value == pytest.approx(10)
    assert not gradient.any()
    _, gradient = prior([1.0, *[12.0] * (n - 1)], [True] * n)
    assert gradient[0] == pytest.approx(-3.68 / n, rel=1e-3)
    assert not gradient[1:].any(), "solid enough"


def test_samples_that_are_not_evaluated_count_as_nothing_or_as_the_origin():
    """Trap 3 of the released code: 100 evaluated samples, 900 that its warp drops onto the origin."""
    evaluated, inside = [2.0] * 100, [True] * 100
    assert prior(evaluated, inside, 1000)[0] == pytest.approx(0.1353, rel=1e-3)
    origin = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    own = completeness(torch.tensor(evaluated).double(), torch.tensor(inside), 1000, (origin, torch.tensor(True)))
    assert own.collapsed.item() == pytest.approx(0.9 * 10 * math.exp(-1))
    assert own.total.item() == pytest.approx(0.1353 + 0.9 * 3.6788, rel=1e-3)
    own.total.backward()
    assert origin.grad == pytest.approx(-0.9 * 3.6788, rel=1e-3)
    away = completeness(torch.tensor(evaluated), torch.tensor(inside), 1000, (origin.detach(), torch.tensor(False)))
    assert away.collapsed == 0


def test_an_infinite_density_costs_as_little_as_any_solid_one():
    costs = sample_costs(torch.tensor([math.inf, 1e30, 10.0]), torch.ones(3, dtype=torch.bool))
    assert costs.tolist() == pytest.approx([4.54e-4] * 3, rel=1e-3)


# ---------------------------------------------------------------------------------- check 2: what neighbours lend


def test_check_2_weights_by_counters():
    equal, variance = neighbour_weights(torch.full((1, 40), 7.0))
    assert equal.tolist()[0] == pytest.approx([1 / 40] * 40)
    assert variance == 0
    ratios = []
    for most in (10, 1000, 1e6):
        weights, variance = neighbour_weights(torch.tensor([[1.0] * 20 + [most] * 20], dtype=torch.float64))
        ratios.append(float(weights[0, -1] / weights[0, 0]))
        if most == 1000:
            assert float(variance) == pytest.approx(0.2559, abs=1e-4)
    assert ratios[1] == pytest.approx(2.716, abs=1e-3)
    assert ratios == sorted(ratios)
    assert ratios[-1] == pytest.approx(math.e, abs=1e-4)
    assert weights.sum() == pytest.approx(1)


# ------------------------------------------------------------------------------------- check 3: who ends a ray


def test_check_3_a_vertex_gains_at_most_one_a_step():
    counters = torch.ones(50)
    ten = torch.arange(10)[None]
    count_seen(counters, ten)
    assert counters.tolist() == [2.0] * 10 + [1.0] * 40
    count_seen(counters, ten.expand(1000, 10))
    assert counters.tolist() == [3.0] * 10 + [1.0] * 40
    count_seen(counters, torch.empty(0, 10, dtype=torch.int64))
    assert counters.sum() == 70


def test_check_3_a_ray_ends_at_its_largest_alpha_and_not_before_half_a_metre():
    """By alpha, not by weight: the second sample's alpha is larger, the first one's weight. The depth is not divided
    by the accumulated alpha: a faint person far away ends rays, too, one near and faint does not."""
    alpha = torch.tensor([[0.5, 0.9], [0.1, 0.05], [0.0, 0.0], [0.3, 0.1]])
    depths = torch.tensor([[3.0, 3.1], [3.0, 3.1], [3.0, 3.1], [1.0, 1.1]])
    weights = torch.stack([alpha[:, 0], (1 - alpha[:, 0]) * alpha[:, 1]], 1)
    ends, at = ends_of_rays(alpha, weights, depths)
    assert ends.tolist() == [True, False, False, False]
    assert at[0] == 1
    assert weights[0, 0] > weights[0, 1]


# ------------------------------------------------------------------------------------- check 5: signed distance


def against(places):
    places = torch.as_tensor(places, dtype=torch.float32)
    near = surface().neighbours(places)[:, :10]
    apart = places[:, None] - surface().vertices[near]
    return signed_distance(apart, surface().normals[near])


def test_check_5_signed_distance():
    """2 cm inside and outside of the body it has the right sign; it is never near 0."""
    vertices, normals = surface().vertices, surface().normals
    signs = [(against(vertices + by * normals)[0].sign() == np.sign(by)).float().mean() for by in (-0.02, 0.02)]
    assert min(signs) >= 0.98
    near = against(vertices - 0.0005 * normals)[0].abs()
    assert float(near.median()) == pytest.approx(0.016, abs=1.5e-3)
    assert near.min() > 0.003
    distance, inside = against(vertices)
    assert torch.equal(distance < 0, inside)


def test_inside_asks_more_than_half_of_the_neighbours():
    normals = torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 4, 1)
    apart = torch.zeros(2, 4, 3)
    apart[..., 2] = torch.tensor([[-1.0, -1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, 1.0]])
    distance, inside = signed_distance(apart, normals)
    assert inside.tolist() == [False, True]
    assert distance.tolist() == [1.0, -1.0]
    three = signed_distance(apart[:, :3], normals[:, :3])[1]
    assert three.tolist() == [True, True], "two of three are enough"


def test_a_place_is_projected_between_the_vertices_that_it_lies_over():
    """Straight over a vertex only that one counts; in all tangent planes all alike; no NaN on a vertex."""
    vertices = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]).repeat(3, 1, 1)
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(3, 3, 3)
    places = torch.tensor([[0.0, 0.0, 1e-3], [0.3, 0.3, 0.0], [0.0, 0.0, 0.0]], requires_grad=True)
    points = projected(places[:, None] - vertices, normals, vertices)
    assert points[0].tolist() == pytest.approx([0, 0, 0], abs=2e-3)
    assert points[1].tolist() == pytest.approx([1 / 3, 1 / 3, 0], abs=1e-6)
    (gradient,) = torch.autograd.grad(points.sum(), places)
    assert points.isfinite().all()
    assert gradient.isfinite().all()


def test_samples_and_vertices_have_two_addresses_in_the_grid():
    """As released: the same distance is another coordinate for a vertex than for a sample."""
    point, distance = torch.tensor([[-1.2, 0.0, 0.6]]), torch.tensor([0.05])
    sample, vertex = (grid_place(point, distance, 1.2, span) for span in (0.5, 0.8))
    assert sample[0].tolist() == pytest.approx([0, 0.5, 0.75, 0.5])
    assert vertex[0].tolist() == pytest.approx([0, 0.5, 0.75, 0.3125])
    far = grid_place(point.repeat(2, 1), torch.tensor([-0.5, 0.9]), 1.2, 0.5)
    assert far[:, 3].tolist() == [0, 1]


# ------------------------------------------------------------------------------------------------- the surface


def test_normals_point_outwards_and_have_length_one():
    vertices, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]]), np.array([[0, 1, 2]], np.int32)
    assert vertex_normals(vertices, faces).tolist() == [[0, 0, 1]] * 3 + [[0, 0, 0]]
    center = BODY.v_template[BODY.parts == 15].mean(0)
    head = surface().vertices[BODY.parts == 15] - torch.tensor(center, dtype=torch.float32)
    assert (surface().normals[BODY.parts == 15] * head).sum(1).median() > 0.05


def test_coarser_sets_are_farthest_point_subsets():
    """2131, 533 and 134 of 8522 vertices; each next point is the farthest from those before; another seed, another
    start; the same one, the same sets."""
    sets = [surface().subset(level) for level in (1, 2, 3)]
    assert [len(each) for each in sets] == [2131, 533, 134]
    assert torch.equal(sets[0][:134], sets[2])
    points = np.random.default_rng(0).normal(size=(60, 3))
    order = farthest_points(points, 20, start=5)
    assert order[0] == 5
    for k in range(1, 20):
        apart = np.linalg.norm(points[:, None] - points[order[:k]], axis=2).min(1)
        assert apart[order[k]] == pytest.approx(apart.max())
    again, other = (CanonicalSurface(BODY, np.zeros(10), seed).subset(1) for seed in (0, 1))
    assert torch.equal(again, sets[0])
    assert not torch.equal(other[:1], again[:1])


def test_the_neighbours_are_the_ten_nearest_of_each_set():
    rng = np.random.default_rng(3)
    places = BODY.v_template[rng.integers(len(BODY.v_template), size=400)] + rng.normal(0, 0.04, (400, 3))
    places = places.astype(np.float32)
    near = surface().neighbours(torch.from_numpy(places))
    vertices = surface().vertices.numpy()
    for level in range(4):
        numbers = np.arange(len(vertices)) if level == 0 else surface().subset(level).numpy()
        expected = KDTree(vertices[numbers]).query(places, 10)[0]
        own = near[:, 10 * level : 10 * level + 10].numpy()
        assert np.isin(own, numbers).all()
        given = np.linalg.norm(places[:, None] - vertices[own], axis=2)
        assert given == pytest.approx(expected, abs=1e-6)
    assert torch.equal(surface().nearest_three(torch.from_numpy(places)), near[:, :3])


def test_cells_share_the_neighbours_of_their_centre():
    """A place at a centre has its own ten nearest; others of the cell the same ones; on a body, places within 4 cm of
    the surface keep nine of ten of the nearest vertices with cells of 1 cm, and nearly all of the coarser sets'."""
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.1, 0.1, (60, 3)).astype(np.float32)
    box = np.full(3, -0.2, np.float32), np.full(3, 0.2, np.float32)
    shared = NearestVertices(points, [np.arange(60)], 7, box, cell=0.05)
    center = torch.tensor([[-0.175, 0.025, 0.075]])
    own = KDTree(points).query(center.numpy(), 7)[1]
    assert shared(center).tolist() == own.tolist()
    assert shared(center + torch.tensor([[0.02, -0.02, 0.02]])).tolist() == own.tolist()
    outside = shared(torch.tensor([[9.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]]))
    assert ((outside >= 0) & (outside < 60)).all()
    coarse = CanonicalSurface(BODY, np.zeros(10), 0, cell=0.01)
    places = surface().vertices[::20] + torch.from_numpy(rng.normal(0, 0.04, (427, 3)).astype(np.float32))
    exact, near = surface().neighbours(places), coarse.neighbours(places)
    kept = [
        np.mean([np.isin(a, b).mean() for a, b in zip(exact[:, k : k + 10], near[:, k : k + 10], strict=True)])
        for k in (0, 10, 20, 30)
    ]
    assert kept[0] > 0.87
    assert kept == sorted(kept)
    assert kept[3] > 0.97
    assert torch.equal(coarse.neighbours(places), near), "filled once"


def test_the_search_is_its_twin_and_takes_few_places_and_bad_ones():
    rng = np.random.default_rng(5)
    points = rng.uniform(-0.1, 0.1, (40, 3)).astype(np.float32)
    sets = [np.arange(40), np.arange(0, 40, 2)]
    box = np.full(3, -1, np.float32), np.full(3, 1, np.float32)
    search = NearestVertices(points, sets, 7, box, cell=0)
    places = torch.from_numpy(rng.uniform(-0.5, 0.5, (200, 3)).astype(np.float32))
    given = nearest_by_torch(places, torch.from_numpy(points), [torch.from_numpy(each) for each in sets], 7)
    assert torch.equal(search(places), given)
    assert (given[:, 7:] % 2 == 0).all()
    assert search(places[:0]).shape == nearest_by_torch(places[:0], places, [given[0]] * 2, 7).shape == (0, 14)
    assert ((search(torch.full((1, 3), math.nan)) >= 0) & (search(torch.full((1, 3), math.inf)) < 40)).all()
    with pytest.raises(ValueError, match="cells"):
        NearestVertices(points, sets, 7, box, cell=1e-4)


# ------------------------------------------------------------------------------------------------- the networks


def test_the_released_networks():
    """68 → 4 × 256 → 65 and 131 → 4 × 256 → 3: 230 656 and 230 912 products; gain √2 but for last layers."""
    decoder = SurfaceDecoder(35, 32, 256, 4, torch.Generator().manual_seed(0))
    products = [sum(layer.weight.numel() for layer in part) for part in (decoder.density, decoder.color)]
    assert products == [230_656, 230_912]
    assert all(not layer.bias.any() for part in (decoder.density, decoder.color) for layer in part)
    hidden, last = decoder.density[1].weight, decoder.density[-1].weight
    assert hidden.std().item() == pytest.approx(math.sqrt(2 * 2 / 512), rel=0.02)
    assert last.std().item() == pytest.approx(math.sqrt(2 / (256 + 65)), rel=0.03)
    raw, rgb = decoder(torch.zeros(2, 35), torch.zeros(2), torch.zeros(2, 32))
    assert raw.tolist() == [0, 0]
    assert (rgb == 0.5).all()
