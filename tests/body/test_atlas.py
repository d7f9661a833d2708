from dataclasses import replace

import numpy as np
import pytest

from ihbench.body import atlas, load_body, procedural


def signed_area(uv: np.ndarray, uv_faces: np.ndarray) -> np.ndarray:
    a, b, c = (uv[uv_faces[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def surface_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


@pytest.fixture(scope="module", params=["shipped", "coarse", "tall and heavy"])
def case(request):
    body = load_body()
    if request.param == "coarse":
        arrays = procedural.build_body(coarseness=2.5)
        weights = arrays["weights"].astype(np.float64)
        vertices, faces = arrays["v_template"].astype(np.float64), arrays["f"].astype(np.int32)
        joints = arrays["J_regressor"] @ vertices
    else:
        betas = np.zeros(10) if request.param == "shipped" else np.array([3.0, 3, -1, 0, 0, 1, 0, 2, 0, 0])
        vertices, joints = body.shaped(betas)
        weights, faces = body.weights, body.faces
    return vertices, faces, weights, joints, *atlas.part_atlas(vertices, faces, weights, joints)


def test_charts_stay_in_their_rectangles(case):
    *_, uv, uv_faces, chart = case
    rectangles = np.array([part.rectangle for part in atlas.PARTS])
    assert set(chart) == set(range(6))
    for number, (u0, v0, u1, v1) in enumerate(rectangles):
        corners = uv[uv_faces[chart == number]].reshape(-1, 2)
        assert (corners >= [u0 - 1e-9, v0 - 1e-9]).all()
        assert (corners <= [u1 + 1e-9, v1 + 1e-9]).all()
        for other in rectangles[number + 1 :]:
            assert u1 <= other[0] or other[2] <= u0 or v1 <= other[1] or other[3] <= v0


def test_a_texture_vertex_belongs_to_one_vertex(case):
    _, faces, _, _, uv, uv_faces, _ = case
    owner = np.full(len(uv), -1)
    owner[uv_faces] = faces
    np.testing.assert_array_equal(owner[uv_faces], faces)
    assert (owner >= 0).all()


def test_no_chart_is_mirrored_and_hardly_a_face_is_folded(case):
    vertices, faces, _, _, uv, uv_faces, chart = case
    area = signed_area(uv, uv_faces)
    for number in range(6):
        mine = area[chart == number]
        assert -mine[mine < 0].sum() < 0.01 * mine[mine > 0].sum()
    assert (area <= 1e-12).mean() < 0.02  # a coarse mesh folds more: its faces are larger
    assert surface_area(vertices, faces)[area <= 1e-12].sum() < 0.015  # m²


def test_texels_are_spread_evenly_over_the_skin(case):
    vertices, faces, _, _, uv, uv_faces, _ = case
    skin, texture = surface_area(vertices, faces), np.abs(signed_area(uv, uv_faces))
    assert 0.75 < texture.sum() < 0.9  # of the square
    order = np.argsort(texture / skin)
    share = np.cumsum(skin[order]) / skin.sum()
    low, median, high = np.sqrt((texture / skin)[order])[np.searchsorted(share, [0.05, 0.5, 0.95])]
    assert low > 0.4 * median
    assert high < 2.1 * median


def test_neighbours_on_the_skin_are_neighbours_in_a_chart(case):
    """No face is stretched across its chart, as it would be on the wrong side of the seam."""
    *_, uv, uv_faces, _ = case
    corners = uv[uv_faces]
    assert np.ptp(corners, axis=1).max() < 0.2


def test_left_and_right_limbs_get_equal_charts():
    body = load_body()
    uv, uv_faces, chart = atlas.part_atlas(body.v_template, body.faces, body.weights, body.joints)
    area = np.abs(signed_area(uv, uv_faces))
    for left, right in ((2, 3), (4, 5)):
        assert (chart == left).sum() == (chart == right).sum()
        assert area[chart == left].sum() == pytest.approx(area[chart == right].sum(), rel=1e-3)


def test_the_torso_end_of_a_limb_is_on_top_of_its_chart():
    body = replace(load_body())
    vertex_of_uv = np.zeros(len(body.uv), np.int64)
    vertex_of_uv[body.uv_faces] = body.faces
    _, _, chart = atlas.part_atlas(body.v_template, body.faces, body.weights, body.joints)
    for number, coordinate in ((2, 0), (4, 1)):
        table = np.unique(body.uv_faces[chart == number])
        out = np.abs(body.v_template[vertex_of_uv[table], coordinate])  # distance from the torso
        assert np.corrcoef(out, body.uv[table, 1])[0, 1] < -0.9
