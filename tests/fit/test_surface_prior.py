"""The smoothness prior: which points are linked, what a link weighs, what it does to what nobody sees."""

import numpy as np
import pytest
import torch

from ihbench.fit.surface_prior import SurfacePrior, neighbour_pairs

UP = np.array([0.0, 0.0, 1.0])


def a_grid(side=6, spacing=0.01):
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) * spacing
    return points, np.tile(UP, (len(points), 1))


def test_links_join_nearest_neighbours_once():
    points, normals = a_grid()
    pairs = neighbour_pairs(points, normals)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    linked = {(a, b) for a, b in pairs.tolist()}
    for k in range(36):  # of the inner points every neighbour on the grid
        row, column = divmod(k, 6)
        if 0 < row < 5 and 0 < column < 5:
            assert {tuple(sorted((k, k + step))) for step in (-6, -1, 1, 6)} <= linked
    assert np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).max() < 0.0201


def test_sheets_back_to_back_are_not_linked():
    """But a point with nothing else near keeps its nearest neighbour, whichever way that looks."""
    points, normals = a_grid()
    below = points - [0, 0, 0.002]
    pairs = neighbour_pairs(np.concatenate([points, below]), np.concatenate([normals, -normals]))
    assert ((pairs[:, 0] < 36) != (pairs[:, 1] < 36)).sum() == 36  # the nearest alone
    assert neighbour_pairs(points[:2], np.stack([UP, -UP])).tolist() == [[0, 1]]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points(count):
    pairs = neighbour_pairs(*(each[:count] for each in a_grid()))
    assert len(pairs) == count * (count - 1) // 2


def test_coincident_points():
    pairs = neighbour_pairs(np.zeros((9, 3)), np.tile(UP, (9, 1)))
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert set(pairs.ravel().tolist()) == set(range(9))


def test_the_cost_is_the_weighted_sum_of_squares():
    rng = np.random.default_rng(0)
    points, normals = a_grid()
    shown = rng.random(36)
    prior = SurfacePrior.of(points, normals, shown, views=40.0, power=2.0)
    some = torch.tensor(np.sort(rng.choice(36, 20, replace=False)))
    values = torch.tensor(rng.normal(size=(20, 7)), dtype=torch.float64)
    expected, place = 0.0, {int(p): k for k, p in enumerate(some)}
    for i, j in neighbour_pairs(points, normals).tolist():
        if i in place and j in place:
            weight = (1 + 40 * min(shown[i], shown[j])) ** -2
            expected += weight * (values[place[i]] - values[place[j]]).square().sum().item()
    assert prior.among(some, 36).roughness(values).item() == pytest.approx(expected / 20, rel=1e-5)
    assert prior.among(some[:0], 36).roughness(values[:0]) == 0


def test_the_weight_follows_the_share_of_views_not_their_number():
    points, normals = a_grid()
    of_forty = SurfacePrior.of(points, normals, np.full(36, 5 / 40), 40.0, 2.0)
    of_eight = SurfacePrior.of(points, normals, np.full(36, 1 / 8), 40.0, 2.0)
    assert torch.equal(of_forty.weight, of_eight.weight)
    assert SurfacePrior.of(points, normals, np.zeros(36), 40.0, 2.0).weight.eq(1).all()


def test_what_nobody_sees_continues_its_surroundings():
    """Fitted to the rim alone, the unseen middle becomes the harmonic fill of the rim."""
    points, normals = a_grid(9)
    rim = (np.isclose(points[:, :2], 0) | np.isclose(points[:, :2], 0.08)).any(1)
    target, seen = torch.tensor(points[:, :1] * 10), torch.from_numpy(rim)
    prior = SurfacePrior.of(points, normals, rim.astype(float), 40.0, 2.0)
    values = torch.zeros(81, 1, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([values], lr=0.02)
    for _ in range(600):
        optimizer.zero_grad()
        ((values[seen] - target[seen]).square().sum() + prior.roughness(values)).backward()
        optimizer.step()
    torch.testing.assert_close(values.detach(), target, atol=0.05, rtol=0)


def test_arrays_of_different_lengths_are_refused():
    points, normals = a_grid()
    with pytest.raises(ValueError, match="one length, got 36, 36, 35"):
        SurfacePrior.of(points, normals, np.ones(35), 40.0, 2.0)
