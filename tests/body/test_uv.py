from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.body import chart_padding, load_body, position_map, sample_uv, texel_table
from ihbench.body.pose import BodyPose
from ihbench.body.uv import map_coordinates


def padded(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    return np.where(index[..., None] >= 0, values.reshape(-1, values.shape[-1])[index], 0)


@pytest.mark.parametrize("resolution", [1, 7, 64, 128, 256])
def test_a_texel_lies_where_its_face_and_barycentrics_say(resolution):
    body = load_body()
    texels = texel_table(body, resolution)
    corners = body.uv[body.uv_faces[texels.face]]
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", texels.bary, corners), texels.uv, atol=1e-12)
    assert (texels.bary > -1e-9).all()
    np.testing.assert_allclose(texels.bary.sum(1), 1, atol=1e-12)
    row, column = np.divmod(texels.index, resolution)
    np.testing.assert_allclose(map_coordinates(texels.uv, resolution), np.column_stack([column, row]), atol=1e-9)
    assert (np.diff(texels.index) > 0).all()
    np.testing.assert_array_equal(np.flatnonzero(texels.mask), texels.index)


def test_texel_counts_follow_the_area_of_the_charts():
    """About 0.8 of the square, the same share at every resolution (SMPL's own layout has 0.773)."""
    body = load_body()
    shares = [len(texel_table(body, r).index) / r**2 for r in (64, 128, 256, 512)]
    assert 0.75 < shares[-1] < 0.9
    np.testing.assert_allclose(shares, shares[-1], atol=0.03)


def test_no_texel_inside_a_chart_is_missing():
    """Against a brute-force test of every texel centre against every face."""
    body = load_body()
    resolution = 24
    texels = texel_table(body, resolution)
    a, b, c = (body.uv[body.uv_faces[:, k]] for k in range(3))
    inside = np.zeros(resolution**2, bool)
    for i in range(resolution**2):
        p = np.array([(i % resolution + 0.5) / resolution, 1 - (i // resolution + 0.5) / resolution])
        side = [(q - o)[:, 0] * (p - o)[:, 1] - (q - o)[:, 1] * (p - o)[:, 0] for o, q in ((a, b), (b, c), (c, a))]
        inside[i] = ((np.min(side, 0) >= 0) | (np.max(side, 0) <= 0)).any()
    np.testing.assert_array_equal(texels.mask.ravel(), inside)


def test_row_0_is_the_top_of_the_texture():
    """Head texels have high v and must come first; swapped or flipped axes put the feet there."""
    body = load_body()
    texels = texel_table(body, 64)
    height = texels.interpolate(body.v_template, body.faces)[:, 1]
    row, column = np.divmod(texels.index, 64)
    assert height[(row < 26) & (column < 31)].min() > 0.4  # head chart, top left
    assert height[(row > 34) & (column > 33)].max() < 0.1  # legs, bottom right


def test_tables_are_cached_for_each_body_and_resolution():
    body = load_body()
    assert texel_table(body, 32) is texel_table(body, 32)
    assert texel_table(body, 33) is not texel_table(body, 32)
    other = replace(body, uv=body.uv * 0.5)
    assert texel_table(other, 32).mask.sum() == pytest.approx(texel_table(body, 32).mask.sum() / 4, rel=0.1)


def test_interpolation_is_exact_for_linear_fields():
    body = load_body()
    texels = texel_table(body, 100)
    linear = body.v_template @ [[1.0], [2], [3]] + 4
    position = texels.interpolate(body.v_template, body.faces)
    np.testing.assert_allclose(texels.interpolate(linear, body.faces), position @ [[1.0], [2], [3]] + 4, atol=1e-12)


@pytest.mark.parametrize("resolution", [128, 512])
def test_sampling_the_position_map_at_a_vertex_finds_the_vertex(resolution):
    body = load_body()
    positions, mask = position_map(body.v_template, body, resolution)
    assert positions.dtype == np.float32
    assert not positions[~mask].any()
    vertex = np.zeros(len(body.uv), np.int64)
    vertex[body.uv_faces] = body.faces
    found = sample_uv(padded(positions, chart_padding(mask, 2)), body.uv)
    error = np.linalg.norm(found - body.v_template[vertex], axis=1)
    texel = np.sqrt(1.77 / mask.sum())  # m, the mean side of a texel on 1.77 m² of skin
    assert np.percentile(error, 50) < 0.2 * texel
    assert np.percentile(error, 95) < 1.5 * texel
    assert np.percentile(error, 97) < 4 * texel  # the rest: tips of charts, thinner than a texel


def test_sampling_a_texel_centre_returns_the_texel():
    values = np.random.default_rng(0).normal(size=(9, 9, 2))
    row, column = np.mgrid[0:9, 0:9]
    uv = np.stack([(column + 0.5) / 9, 1 - (row + 0.5) / 9], -1).reshape(-1, 2)
    np.testing.assert_allclose(sample_uv(values, uv), values.reshape(-1, 2), atol=1e-14)


def test_sampling_clamps_at_the_edge_and_takes_a_single_texel():
    values = np.arange(4.0).reshape(2, 2, 1)
    np.testing.assert_allclose(sample_uv(values, np.array([[0, 1], [1, 1], [0, 0], [1, 0.0]]))[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(sample_uv(np.full((1, 1, 1), 7.0), np.random.default_rng(0).random((5, 2))), 7)


def test_sampling_equals_torch_grid_sample():
    rng = np.random.default_rng(0)
    values, uv = rng.normal(size=(13, 13, 3)), rng.uniform(0, 1, (500, 2))
    sampled = torch.nn.functional.grid_sample(
        torch.from_numpy(values).permute(2, 0, 1)[None],
        torch.from_numpy((2 * uv - 1) * [1, -1])[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    np.testing.assert_allclose(sample_uv(values, uv), sampled[0, :, 0].T.numpy(), atol=1e-12)


@pytest.mark.parametrize("texels", [0, 1, 2, 5])
def test_padding_copies_from_the_nearest_chart_texel(texels):
    mask = np.random.default_rng(0).random((21, 21)) < 0.02
    index = chart_padding(mask, texels)
    inside = np.argwhere(mask)
    for row, column in np.ndindex(mask.shape):
        offset = np.abs(inside - [row, column])
        if offset.max(1).min() > texels:
            assert index[row, column] == -1
        else:
            source = np.array(divmod(index[row, column], 21))
            assert mask[tuple(source)]
            nearest = (offset**2).sum(1).min()
            assert ((source - [row, column]) ** 2).sum() == nearest
    assert (index[mask] == np.flatnonzero(mask)).all()


def test_padding_of_an_empty_mask_is_empty():
    assert (chart_padding(np.zeros((4, 4), bool), 3) == -1).all()


def test_other_shapes_are_refused():
    body, flat = load_body(), np.zeros((8, 8, 3))
    for wrong in (lambda: sample_uv(flat.transpose(2, 0, 1), np.zeros((2, 2))), lambda: sample_uv(flat, np.zeros(2))):
        with pytest.raises(ValueError, match=r"map \[R, R, C\], channels last, and uv \[N, 2\]"):
            wrong()
    for size in (0, -3, 7.5):
        with pytest.raises(ValueError, match="whole number of texels"):
            texel_table(body, size)
    with pytest.raises(ValueError, match="vertices"):
        position_map(body.v_template.T, body, 8)
    with pytest.raises(ValueError, match="offsets"):
        body.pose(BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3)), offsets=np.zeros(3))


@pytest.mark.parametrize(
    ("pose", "word"),
    [
        (np.zeros(72), "reshape"),
        (np.zeros((24, 3, 3)), "matrix_to_axis_angle"),
        (np.zeros((24, 4)), "quaternions"),
        (np.full((24, 3), 90.0), "np.deg2rad"),
    ],
)
def test_other_poses_are_refused(pose, word):
    with pytest.raises(ValueError, match=word):
        BodyPose(pose, np.zeros(10), np.zeros(3))
    rest = torch.zeros(24, 3, requires_grad=True)
    assert BodyPose(rest, torch.zeros(10).bfloat16(), torch.zeros(3)).pose.dtype == np.float64
