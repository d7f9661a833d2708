import numpy as np
import pytest
import trimesh

from ihbench.render.zbuffer import rasterize, vertex_normals


def random_mesh(seed, n=400, faces=900, size=80):
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(-20, size + 20, (n, 2)), rng.uniform(0.3, 4, n)]
    return points, rng.integers(0, n, (faces, 3))


@pytest.mark.parametrize("seed", range(4))
def test_numpy_and_numba_are_equal_to_the_bit(seed):
    points, faces = random_mesh(seed)
    points[:5, 2] = [-1, 0, 1e-4, np.nan, np.inf]  # behind, on and before the near plane, not finite
    points[5:9] = points[9]  # degenerate triangles
    points[10:13, 0] = [1e9, -1e9, 1e300]
    faces[:8] = [[5, 6, 7], [0, 10, 20], [3, 30, 40], [4, 50, 60], [10, 11, 14], [12, 70, 80], [1, 1, 1], [9, 9, 90]]
    slow, fast = (rasterize(points, faces, 64, 80, backend) for backend in ("numpy", "numba"))
    np.testing.assert_array_equal(slow.face, fast.face)
    np.testing.assert_array_equal(slow.depth, fast.depth)
    np.testing.assert_array_equal(slow.bary, fast.bary)
    assert slow.mask.any()


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_a_square_covers_exactly_the_pixels_whose_centres_lie_inside(backend):
    points = np.array([[2, 1, 1.0], [6, 1, 1], [6, 4, 1], [2, 4, 1]])
    raster = rasterize(points, np.array([[0, 1, 2], [0, 2, 3]]), 6, 8, backend)
    expected = np.zeros((6, 8), bool)
    expected[1:4, 2:6] = True
    np.testing.assert_array_equal(raster.mask, expected)
    assert np.isinf(raster.depth[~expected]).all()


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_the_nearer_surface_wins_and_the_lower_index_breaks_a_tie(backend):
    square = np.array([[0, 0, 1.0], [8, 0, 1], [8, 8, 1], [0, 8, 1]])
    points = np.concatenate([square * [1, 1, 2], square, square])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(3)])
    raster = rasterize(points, faces, 8, 8, backend)
    assert set(np.unique(raster.face)) <= {2, 3}
    np.testing.assert_allclose(raster.depth, 1)


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_interpolation_is_perspective_correct(backend):
    """A plane tilted away from the camera: recovered 3-D points lie on it and project back to their pixel."""
    plane = np.array([[-1.0, -1, 2], [1, -1, 5], [1, 1, 5], [-1, 1, 2]])
    focal, centre = 40.0, 20.0
    projected = np.c_[focal * plane[:, :2] / plane[:, 2:] + centre, plane[:, 2]]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    raster = rasterize(projected, faces, 40, 40, backend)
    points = raster.interpolate(plane, faces)[raster.mask]
    np.testing.assert_allclose(points[:, 2], raster.depth[raster.mask], rtol=1e-5)
    rows, cols = np.nonzero(raster.mask)
    np.testing.assert_allclose(focal * points[:, 0] / points[:, 2] + centre, cols + 0.5, atol=1e-4)
    np.testing.assert_allclose(focal * points[:, 1] / points[:, 2] + centre, rows + 0.5, atol=1e-4)


def test_depth_and_face_are_those_of_rays_against_every_triangle():
    """Trimesh intersects the ray of each pixel centre with the plane of each triangle; the nearest hit is drawn."""
    focal, size = 30.0, 16
    ball = trimesh.creation.icosphere(subdivisions=1).apply_translation([0.1, -0.05, 3])
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    points = np.c_[focal * vertices[:, :2] / vertices[:, 2:] + size / 2, vertices[:, 2]]
    raster = rasterize(points, faces, size, size)
    rows, cols = np.mgrid[:size, :size].reshape(2, -1) + 0.5
    rays = np.c_[(cols - size / 2) / focal, (rows - size / 2) / focal, np.ones(size * size)]
    depth, face = np.full(size * size, np.inf), np.full(size * size, -1)
    for k, (triangle, normal) in enumerate(zip(ball.triangles, ball.face_normals, strict=True)):
        hits, valid = trimesh.intersections.planes_lines(
            np.repeat(triangle[:1], len(rays), 0), np.repeat(normal[None], len(rays), 0), 0 * rays, rays
        )
        inside = trimesh.triangles.points_to_barycentric(np.repeat(triangle[None], len(hits), 0), hits).min(1) >= 0
        nearer = np.zeros(len(rays), bool)
        nearer[np.flatnonzero(valid)[inside]] = hits[inside, 2] < depth[valid][inside]
        depth[nearer], face[nearer] = hits[nearer[valid], 2], k
    np.testing.assert_array_equal(raster.face.ravel(), face)
    np.testing.assert_allclose(raster.depth.ravel(), depth, rtol=1e-6)


def test_no_faces_and_unknown_back_end():
    assert not rasterize(np.zeros((0, 3)), np.zeros((0, 3), int), 4, 4).mask.any()
    with pytest.raises(ValueError, match="nunba"):
        rasterize(np.zeros((0, 3)), np.zeros((0, 3), int), 4, 4, "nunba")


def test_vertex_normals_of_a_tetrahedron_point_outwards():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = vertex_normals(vertices, faces)
    assert ((normals * (vertices - vertices.mean(0))).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert not vertex_normals(np.zeros((3, 3)), np.array([[0, 1, 2]])).any()


TRIANGLE = np.array([[1.0, 1, 2], [7, 1, 2], [4, 7, 2]])


@pytest.mark.parametrize(
    ("points", "faces", "word"),
    [
        (TRIANGLE, [[0, 1, 3]], "0 to 2, got 0 to 3"),
        (TRIANGLE, [[1, 2, 3]], "OBJ files count from 1"),
        (TRIANGLE, [[0, 1, -1]], "got -1 to 1"),
        (TRIANGLE, [[0.0, 1, 2]], "whole numbers"),
        (TRIANGLE, [[0, 1, 2, 0]], "faces"),
        (TRIANGLE[:, :2], [[0, 1, 2]], "Camera.project"),
        (TRIANGLE.astype(complex), [[0, 1, 2]], "points"),
        (TRIANGLE[0], [[0, 1, 2]], "points"),
    ],
)
@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_other_meshes_are_refused(points, faces, word, backend):
    with pytest.raises(ValueError, match=word):
        rasterize(points, np.array(faces), 8, 8, backend)
    if "project" not in word:
        with pytest.raises(ValueError, match=word):
            vertex_normals(points, np.array(faces))
    with pytest.raises(ValueError, match="at least 1"):
        rasterize(TRIANGLE, np.array([[0, 1, 2]]), 0, 8, backend)
    drawn = rasterize(TRIANGLE, np.array([[0, 1, 2]]), 8.0, np.int64(8), backend)
    np.testing.assert_array_equal(drawn.face, rasterize(TRIANGLE, np.array([[0, 1, 2]]), 8, 8, backend).face)
