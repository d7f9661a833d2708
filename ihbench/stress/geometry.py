"""Extreme rotations, blends, triangles, texture coordinates and cameras.

Expected numbers are closed forms, or exact rational arithmetic over the very floats that go in, rounded once.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import JOINT_INDEX, PARENTS, chart_padding, load_body, sample_uv, skinning_numpy, texel_table
from ihbench.body.pose import BodyPose
from ihbench.body.root_convention import from_zju_root, zju_root
from ihbench.camera import Camera, distort, look_at
from ihbench.errors import BadInput
from ihbench.render.zbuffer import NEAR, rasterize, vertex_normals
from ihbench.scene.regions import projected_box
from ihbench.stress.case import Answer, Case, words_of

ROTATION = "entries are at most 1 and take about 4 roundings; the angle's own rounding counts |angle| times"
CHAIN = "a chain of up to 9 products of 3×3 matrices, some 5 roundings each"
LINEAR = "one product and one sum a coefficient"
RATIONAL = "one product, one quotient and one sum, each rounded once, times the condition number"
BITS = "both are defined to the bit"
EXACT = "the definition gives this and nothing else"
FLOAT32 = "depth and barycentrics are stored in float32"


def about_z(angle: float) -> NDArray[np.float64]:
    """[3, 3] by the library's sine and cosine."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _torch_rotation(rotation: NDArray, dtype: str = "float64") -> NDArray[np.float64]:
    import torch

    from ihbench.body.skinning import axis_angle_to_matrix

    return axis_angle_to_matrix(torch.tensor(rotation, dtype=getattr(torch, dtype))).double().numpy()


def _rotations(rotation: NDArray) -> NDArray[np.float64]:
    """Of both twins, [2, ..., 3, 3]."""
    return np.stack([skinning_numpy.axis_angle_to_matrix(rotation), _torch_rotation(rotation)])


# ----------------------------------------------------------------------------------------------------
# Rotations


def _turn(angle: float) -> Answer:
    """Both twins about z, in ulps of 1. A relative change of the vector moves the matrix |angle| times as much."""
    return Answer(_rotations(np.array([0, 0, angle])), about_z(angle), abs(angle), scale=max(1.0, abs(angle)))


def _orthonormal() -> Answer:
    axes = np.random.default_rng(0).normal(size=(400, 3))
    axes *= (np.geomspace(1e-9, 30, 400) / np.linalg.norm(axes, axis=1))[:, None]
    got = _rotations(axes)
    return Answer(got @ got.swapaxes(-1, -2), np.eye(3), scale=1.0)


def _gradient(angle: float) -> Answer:
    """d R / d v at v = (0, 0, angle): the derivative along z is closed, the generators at 0."""
    import torch

    from ihbench.body.skinning import axis_angle_to_matrix

    v = torch.tensor([0.0, 0.0, angle], dtype=torch.float64)
    jacobian: Any = torch.autograd.functional.jacobian(axis_angle_to_matrix, v)
    c, s = math.cos(angle), math.sin(angle)
    along_z = [-s, -c, 0, c, -s, 0, 0, 0, 0]
    along_x = [0, 0, (1 - c) / angle if angle else 0, 0, 0, -s / angle if angle else -1.0]
    got = np.concatenate([jacobian[..., 2].numpy().ravel(), jacobian[:2, :, 0].numpy().ravel()])
    return Answer(got, along_z + along_x, max(1.0, angle), scale=max(1.0, angle))


def _chain(angle: float) -> Answer:
    """Every joint turned as far: the world rotations stay rotations."""
    pose = np.zeros((24, 3))
    pose[:, 0] = angle
    rotation = skinning_numpy.joint_transforms(pose, load_body().joints, PARENTS)[:, :3, :3]
    return Answer(rotation @ rotation.swapaxes(-1, -2), np.eye(3), 24 * abs(angle), scale=1.0)


def _opposing(short_of: float) -> Answer:
    """Two joints turned apart by 180° about z: the even blend is singular, and points collapse on the axis."""
    half = math.pi / 2 - short_of / 2
    transforms, weights = np.tile(np.eye(4), (24, 1, 1)), np.zeros((1, 24))
    for joint, angle in enumerate((half, -half)):
        transforms[joint, :3, :3] = skinning_numpy.axis_angle_to_matrix(np.array([0, 0, angle]))
        weights[0, joint] = 0.5
    moved = skinning_numpy.lbs(np.array([[0.3, -0.2, 0.7]]), weights, transforms)[0]
    left = math.cos(half)  # what the blend leaves of lengths across the axis
    return Answer(moved, [0.3 * left, -0.2 * left, 0.7], math.inf if short_of == 0 else 1 / left, scale=1.0)


def _zju_root(angle: float) -> Answer:
    pose, body = np.zeros((24, 3)), load_body()
    pose[0] = angle * np.array([0.6, 0.8, 0])
    given = BodyPose(pose, np.zeros(10), np.array([1.0, -2.0, 300.0]))
    back = from_zju_root(np.zeros(72), given.betas, *zju_root(given, body), body)
    return Answer([back.pose[0], back.transl], [pose[0], given.transl], scale=300.0)


# ----------------------------------------------------------------------------------------------------
# The body


def _extreme_betas(size: float) -> Answer:
    """Vertices and joints are linear in the coefficients; every 200th vertex by exactly rounded sums."""
    body = load_body()
    betas = size * np.where(np.arange(body.shapedirs.shape[2]) % 2, -1.0, 1.0)
    chosen = slice(None, None, 200)
    terms = np.concatenate([body.v_template[chosen, :, None], body.shapedirs[chosen] * betas], -1)
    expected = np.apply_along_axis(math.fsum, -1, terms)
    condition = float((np.abs(terms).sum(-1) / np.maximum(np.abs(expected), 1e-300)).max())
    return Answer(body.shaped(betas)[0][chosen], expected, condition, scale=float(np.abs(terms).sum(-1).max()))


def _surplus_betas() -> Answer:
    known = load_body().shapedirs.shape[2]
    words = words_of(BadInput, lambda: load_body().shaped(np.ones(known + 1)))
    return Answer(words, f"has {known} shape coefficients")


def _nan_pose() -> Answer:
    vertices = load_body().pose(BodyPose(np.full((24, 3), math.nan), np.zeros(10), np.zeros(3)))
    return Answer(int(_drawn(front_camera().project(vertices)[load_body().faces]).mask.sum()), 0)


# ----------------------------------------------------------------------------------------------------
# Triangles


def front_camera(focal: float = 40.0, size: int = 32) -> Camera:
    return Camera(
        np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), np.eye(3), np.zeros(3), size, size
    )


def _drawn(triangles: Any, backend: str = "auto", size: int = 32) -> Any:
    points = np.asarray(triangles, np.float64).reshape(-1, 3)
    return rasterize(points, np.arange(len(points)).reshape(-1, 3), size, size, backend)


BIG = [[-100, -100, 2], [300, -100, 2], [-100, 300, 2]]  # covers a 32² image


def _pixels(triangle: Any, expected: int) -> Answer:
    return Answer([int(_drawn([triangle], backend).mask.sum()) for backend in ("numpy", "numba")], expected)


def _sliver(width: float) -> Answer:
    """A triangle of this many pixels across and 64 along: the weight of its tip is exact arithmetic's."""
    a, b, c = (0.5, 0.5 - width, 2.0), (64.5, 0.5, 2.0), (0.5, 0.5 + width, 2.0)
    raster = _drawn([[a, b, c]])
    columns = np.flatnonzero(raster.mask[0])
    x0, y0, x1, y1, x2, y2 = (Fraction(v) for p in (a, b, c) for v in p[:2])
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    tip = [((Fraction(int(j)) + Fraction(1, 2) - x0) * (y2 - y0) - (x2 - x0) * (Fraction(1, 2) - y0)) / area
           for j in columns]  # fmt: skip
    condition = 64.0**2 / float(abs(area))
    got = np.append(raster.bary[0, columns, 1], len(columns))
    return Answer(got, [*map(float, tip), 32], condition, scale=1.0, precision=np.float32)


def _shared_edge() -> Answer:
    """Two triangles share a diagonal: no crack, and each of its pixels has one owner."""
    raster = _drawn([[[0, 0, 2], [32, 0, 2], [32, 32, 2]], [[0, 0, 2], [32, 32, 2], [0, 32, 2]]])
    return Answer([int(raster.mask.sum()), int((raster.face.diagonal() == 0).sum())], [32 * 32, 32])


def _twins_on_noise() -> Answer:
    """2000 random triangles, some of them degenerate, cut or not finite: differing pixels of the two back ends."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 42, (600, 3))
    points[:, 2] = 10.0 ** rng.uniform(-4, 1, 600)
    points[::97] = math.nan
    points[::83, 0] = 1e12
    faces = rng.integers(0, 600, (2000, 3))
    a, b = (rasterize(points, faces, 32, 32, backend) for backend in ("numpy", "numba"))
    return Answer(int(((a.face != b.face) | (a.depth != b.depth) | (a.bary != b.bary).any(-1)).sum()), 0)


# ----------------------------------------------------------------------------------------------------
# Texture coordinates


def _texel_coordinates() -> Answer:
    """Interpolated by its barycentrics, every texel lies at its own centre; slivers of the atlas included."""
    body = load_body()
    texels = texel_table(body, 128)
    corners = body.uv[body.uv_faces[texels.face]]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.maximum(np.square(e1).sum(1), np.square(e2).sum(1))
    condition = float((longest / np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])).max())
    return Answer(np.einsum("nk,nkc->nc", texels.bary, corners), texels.uv, condition, scale=1.0)


def _constant_map() -> Answer:
    uv = np.array([[0, 0], [1, 1], [0, 1], [-3, 7], [0.5, 0.5], [1 / 3, 1e-300], [1 - 1e-16, 0.999999]])
    return Answer([sample_uv(np.full((r, r, 1), 0.7), uv)[:, 0] for r in (1, 2, 64)], 0.7)


# ----------------------------------------------------------------------------------------------------
# Cameras


def _projected(camera: Camera, point: tuple[float, float, float]) -> Answer:
    """Against exact rational arithmetic. The depth is a sum whose terms may cancel."""
    K, R, t, p = (np.vectorize(Fraction, otypes=[object])(a) for a in (camera.K, camera.R, camera.t, np.array(point)))
    c = R @ p + t
    u, v = (K[0, 0] * c[0] + K[0, 1] * c[1]) / c[2] + K[0, 2], K[1, 1] * c[1] / c[2] + K[1, 2]
    terms = np.abs(camera.R * np.asarray(point)).sum(1) + np.abs(camera.t)
    condition = float((terms / np.maximum(np.abs(c.astype(float)), 1e-300)).max())
    # every ratio carries the condition number of the sum it divides by
    pixels = max(abs(float(x)) for x in (u - K[0, 2], v - K[1, 2], u, v))
    sizes = np.array([pixels, pixels, abs(float(c[2]))])
    exact = np.array([float(u), float(v), float(c[2])])
    return Answer(camera.project(np.array(point)) / sizes, exact / sizes, condition, scale=condition)


def _far_world() -> Answer:
    K = np.array([[500.0, 0, 256], [0, 500, 256], [0, 0, 1]])
    R, _ = look_at(np.array([0.0, 0.0, 3.0]), np.zeros(3))
    return _projected(Camera(K, R, np.array([0.1, 1e6, 1e6 + 3]), 512, 512),
                      (0.2, 1e6 + 0.25, 1e6 - 0.5))  # fmt: skip


def _on_the_plane() -> Answer:
    """They have no pixel, and say so without a warning."""
    p = front_camera().project(np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))
    return Answer([bool(np.isfinite(p[:, :2]).any()), *p[:, 2]], [0, 0, 0])


def _behind() -> Answer:
    """The depth tells; nothing is drawn."""
    p = front_camera().project(np.array([[-1, -1, -2.0], [1, -1, -2.0], [0, 2, -2.0]]))
    return Answer([int(_drawn(p).mask.sum()), *p[:, 2]], [0, -2, -2, -2])


def _strong_lens() -> Answer:
    """Terms of the sixth power rule."""
    coefficients, x, y = [-0.24, 0.08, 2e-3, -1.5e-3, 0.01], 3.0, -4.0
    k1, k2, p1, p2, k3, fx, fy = (Fraction(v) for v in (*coefficients, x, y))
    r2 = fx * fx + fy * fy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    exact = [
        float(fx * radial + 2 * p1 * fx * fy + p2 * (r2 + 2 * fx * fx)),
        float(fy * radial + p1 * (r2 + 2 * fy * fy) + 2 * p2 * fx * fy),
    ]
    size = x * (1 + 25 * (0.24 + 25 * (0.08 + 25 * 0.01)))
    return Answer(distort(np.array(x), np.array(y), np.array(coefficients)), exact, size / abs(exact[0]), scale=size)


def _resampled() -> Answer:
    camera = Camera(np.array([[1e5, 0, 511.7], [0, 1e5, 300.1], [0, 0, 1]]), np.eye(3), np.zeros(3), 1024, 768)
    points = np.random.default_rng(0).uniform(1, 2, (50, 3))
    return Answer(camera.scaled(512, 384).project(points)[:, :2], camera.project(points)[:, :2] / 2)


def _wrist_twist() -> Answer:
    """Vertices of the forearm move towards the bone, no farther than it is thick."""
    body, pose, joint = load_body(), np.zeros((24, 3)), JOINT_INDEX["left_wrist"]
    bone = body.joints[joint] - body.joints[PARENTS[joint]]
    pose[joint] = math.pi * bone / np.linalg.norm(bone)
    axis = bone / np.linalg.norm(bone)
    moved = body.pose(BodyPose(pose, np.zeros(10), np.zeros(3)), blend_shapes=False)

    def distance(points: NDArray) -> NDArray:
        offset = points - body.joints[joint]
        return np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1)

    return Answer(float((distance(moved) - distance(body.v_template)).max()), 0.0)


_geometry = partial(Case, group="geometry")
_exact = partial(_geometry, unit="absolute", tolerance=0, why=EXACT)
_refused = partial(_geometry, unit="words", tolerance=0, why="it must be refused")
_rotation = partial(_geometry, unit="ulp", tolerance=4, why=ROTATION)
_camera = partial(_geometry, unit="ulp", tolerance=8, why=RATIONAL)


UP = np.array([0.0, 1.0, 0.0])
PI = float(np.float32(math.pi))
ANGLES = {
    "zero": 0.0, "1e-160": 1e-160, "1e-8": 1e-8, "series-edge": 0.01, "pi": math.pi, "pi-1e-9": math.pi - 1e-9,
    "two-pi": 2 * math.pi, "two-pi+1e-9": 2 * math.pi + 1e-9, "hundred": 100.0,
}  # fmt: skip

CASES = [
    *(
        _rotation(f"rotation-{name}", f"about z by {angle:g} rad", partial(_turn, angle))
        for name, angle in ANGLES.items()
    ),
    *(
        _geometry(f"rotation-sine-{angle:g}", f"the sine of a turn by {angle:g} rad",
                  lambda angle=angle: Answer(_rotations(np.array([0, 0, angle]))[:, 1, 0], math.sin(angle), 1.0),
                  "ulp", 2, "two or three roundings of a number that has lost nothing to 1", known=known)
        for angle, known in (
            (1e-300, "the numpy twin squares the vector, which is 0 below 1e-162: the turn is then none at all"),
            (1e-12, ""),
            (1e-5, ""),
        )
    ),
    _rotation("rotation-float32-pi", "about z by π in single precision",
              lambda: Answer(_torch_rotation(np.array([0, 0, PI]), "float32"), about_z(PI), math.pi, scale=math.pi,
                             precision=np.float32)),
    _geometry("rotation-orthonormal", "R Rᵀ of 400 turns by 1e-9 to 30 rad", _orthonormal, "ulp", 8,
              "two matrices with errors of 2 ulp, and their product"),
    *(
        _geometry(f"rotation-gradient-{name}", f"d R / d v at {angle:g} rad", partial(_gradient, angle), "ulp",
                  tolerance, why)
        for name, angle, tolerance, why in (
            ("zero", 0.0, 0, "the generators, exactly"),
            ("pi", math.pi, 8, ROTATION),
            ("two-pi", 2 * math.pi, 8, ROTATION),
        )
    ),
    _geometry("chain-pi", "every joint turned by π", partial(_chain, math.pi), "ulp", 64, CHAIN),
    _geometry("chain-hundred", "every joint turned by 100 rad", partial(_chain, 100.0), "ulp", 64, CHAIN),
    _geometry("blend-opposing", "an even blend of two joints 180° apart: points collapse on the axis",
              partial(_opposing, 0.0), "ulp", 2, "a mean of two numbers"),
    _geometry("blend-nearly-opposing", "the same, 1e-6 rad short of 180°", partial(_opposing, 1e-6), "ulp", 2,
              "a mean of two numbers"),
    _geometry("wrist-180", "a wrist turned by 180°: no vertex moves away from the bone", _wrist_twist, "at most",
              1e-12, "m; a mean of points on a circle lies inside it, up to rounding"),
    _geometry("zju-root-pi", "ZJU-MoCap's root and back, turned by π, 300 m away", partial(_zju_root, math.pi), "ulp",
              4, "two sums and a product, at 300 m"),
    *(
        _geometry(f"betas-{size:g}", f"shape coefficients of ±{size:g}", partial(_extreme_betas, size), "ulp", 16,
                  LINEAR)
        for size in (10.0, 1e4)
    ),
    _refused("betas-surplus", "one coefficient more than the body has", _surplus_betas),
    _exact("pose-nan", "a pose of NaN", _nan_pose),
    _exact("triangle-no-area", "three corners on a line", partial(_pixels, [[0, 0, 2], [16, 16, 2], [32, 32, 2]], 0)),
    _exact("triangle-nan", "a corner of NaN", partial(_pixels, [[math.nan, 0, 2], *BIG[1:]], 0)),
    _exact("triangle-inf", "a corner at infinity", partial(_pixels, [[math.inf, 0, 2], *BIG[1:]], 0)),
    _exact("triangle-on-near", "a corner on the near plane",
           partial(_pixels, [[-100, -100, NEAR], *BIG[1:]], 32 * 32)),
    _exact("triangle-behind-near", "a corner just behind the near plane",
           partial(_pixels, [[-100, -100, float(np.nextafter(NEAR, 0))], *BIG[1:]], 0)),
    _geometry("triangle-sliver", "2e-9 px across, 64 px along", partial(_sliver, 1e-9), "ulp", 1, FLOAT32),
    _geometry("triangle-huge", "corners 1e9 px away",
              lambda: Answer(_drawn([[[-1e9, -1e9, 2.5], [3e9, -1e9, 2.5], [-1e9, 3e9, 2.5]]]).depth, 2.5,
                             precision=np.float32), "ulp", 1, FLOAT32),
    _exact("triangle-coincident", "two faces in one place",
           lambda: Answer([_drawn([BIG, BIG], backend).face for backend in ("numpy", "numba")], 0)),
    _exact("triangle-shared-edge", "an edge through pixel centres", _shared_edge),
    _geometry("triangle-twins", "numpy against numba on 2000 wild triangles", _twins_on_noise, "absolute", 0, BITS),
    _exact("normals-no-area", "vertices whose faces have no area",
           lambda: Answer(vertex_normals(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1e-12, 1e-12, 0.0]]),
                                         np.array([[0, 1, 2], [3, 3, 3]])), 0.0)),
    _geometry("uv-texel-centres", "where barycentrics put every texel", _texel_coordinates, "ulp", 64,
              "a sliver of the atlas has a condition number of hundreds; most is lost and found again in the sum"),
    _geometry("uv-seams", "barycentrics at the seams lie in 0..1",
              lambda: Answer([float((s * texel_table(load_body(), 128).bary).max()) for s in (-1, 1)], [0.0, 1.0]),
              "at most", 1e-9,
              "the z-buffer decides on inside in px of 1/128, the barycentrics are taken in uv"),
    _geometry("uv-constant-map", "a map of one value, sampled on and beyond the edges", _constant_map, "ulp", 2,
              "weights that sum to 1 within an ulp"),
    _exact("uv-empty-atlas", "padding of charts that are not there",
           lambda: Answer(chart_padding(np.zeros((8, 8), np.bool_), 3), -1)),
    _camera("camera-focal-1e5", "a focal length of 1e5 px at 150 m",
            partial(_projected, Camera(np.array([[1e5, 0.5, 512], [0, 1e5, 512], [0, 0, 1]]), np.eye(3),
                                       np.array([0.1, -0.2, 150]), 1024, 1024), (0.3, 0.9, 0.25))),
    _camera("camera-far-world", "a studio 1000 km from the origin", _far_world),
    _camera("camera-grazing", "a point 1 µm before the camera plane",
            partial(_projected, front_camera(500.0), (1e-7, -2e-7, 1e-6))),
    _exact("camera-on-plane", "points of depth 0", _on_the_plane),
    _exact("camera-behind", "a triangle behind the camera", _behind),
    _exact("camera-inside-box", "the camera inside the body's box",
           lambda: Answer(int(projected_box(np.array([[-1, -1, -1], [1, 1, 1.0]]), front_camera(), 0.05).sum()),
                          32 * 32)),
    _geometry("camera-strong-lens", "distortion at 5 focal lengths off the axis", _strong_lens, "ulp", 8,
              "a polynomial of degree 7, in ulps of the sum of its terms' sizes"),
    _geometry("camera-resampled", "half the image size at a focal length of 1e5 px", _resampled, "ulp", 0,
              "powers of two commute with rounding"),
    _refused("camera-straight-down", "looking along its own up",
             lambda: Answer(words_of(ValueError, lambda: look_at(3 * UP, np.zeros(3), UP)), "look_at")),
    _refused("camera-nan", "an intrinsic matrix of NaN",
             lambda: Answer(words_of(ValueError, lambda: Camera(np.full((3, 3), math.nan), np.eye(3), UP, 8, 8)),
                            "camera K: expected finite values")),
]  # fmt: skip
