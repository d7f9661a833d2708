import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ihbench.body import JOINT_INDEX, load_body, procedural
from ihbench.body.pose import BodyPose
from ihbench.body.procedural_surface import signed_distance
from ihbench.body.smpl_file import PROCEDURAL_FILE

MIRROR = np.array([-1, 1, 1])


@pytest.fixture(scope="module")
def coarse():
    """The same body with edges 2.5 times as long: quick to build."""
    return procedural.build_body(coarseness=2.5)


def directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def assert_closed_genus_0(vertices: np.ndarray, faces: np.ndarray) -> None:
    """One closed, consistently oriented surface without handles that encloses a positive volume."""
    V, F = len(vertices), len(faces)
    edges = directed_edges(faces)
    forward, backward = edges[:, 0] * V + edges[:, 1], edges[:, 1] * V + edges[:, 0]
    assert len(np.unique(forward)) == len(forward)  # no edge twice in one direction
    assert set(forward.tolist()) == set(backward.tolist())  # and each once in the other
    assert np.unique(faces).size == V
    n_components, _ = connected_components(coo_matrix((np.ones(len(edges)), edges.T), (V, V)))
    assert n_components == 1
    assert V - len(edges) // 2 + F == 2  # Euler characteristic
    # a single fan of faces around every vertex: the edges opposite to it form one ring
    a = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]]).astype(np.int64)
    opposite = np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]).astype(np.int64)
    key, node = np.unique(np.column_stack([np.repeat(a, 2), opposite.ravel()]), axis=0, return_inverse=True)
    node = node.reshape(-1, 2)
    rings, _ = connected_components(coo_matrix((np.ones(len(node)), node.T), (len(key), len(key))))
    assert rings == V
    volume = np.einsum("fi,fi->", vertices[faces[:, 0]], np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]])) / 6
    assert volume > 0


def test_the_shipped_mesh_is_closed_and_has_no_handles():
    body = load_body()
    assert_closed_genus_0(body.v_template, body.faces)


def test_a_coarser_mesh_is_closed_and_has_no_handles(coarse):
    assert_closed_genus_0(coarse["v_template"].astype(np.float64), coarse["f"])


def test_the_shipped_body_has_human_proportions():
    body = load_body()
    vertices = body.v_template
    assert 1.70 < np.ptp(vertices[:, 1]) < 1.80
    assert 1.65 < np.ptp(vertices[:, 0]) < 1.80
    a, b, c = (vertices[body.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert 1.6 < area.sum() < 2.0  # m²
    assert area.min() > 1e-6
    volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
    assert 0.06 < volume < 0.08  # m³


def test_the_shipped_file_is_small_and_holds_no_pickle():
    assert PROCEDURAL_FILE.stat().st_size <= 500_000
    with np.load(PROCEDURAL_FILE, allow_pickle=False) as archive:
        assert not any(archive[key].dtype.hasobject for key in archive.files)


def test_the_shipped_file_is_what_the_generator_makes():
    """Vertices on its surface, weights and shapes by its formulas: a changed generator needs a new file."""
    body = load_body()
    assert np.abs(signed_distance(body.v_template)).max() < 1e-4
    np.testing.assert_allclose(body.weights, procedural.skinning_weights(body.v_template), atol=1e-3)
    for k, direction in enumerate(procedural.SHAPE_DIRECTIONS):
        moves, joint_moves = procedural.shape_displacements(body.v_template, body.weights, direction)
        np.testing.assert_allclose(body.shapedirs[..., k], moves, atol=5e-5)
        # the joint regressor is a fit: 1 mm per unit of a coefficient at the limbs, 7 mm at the hips and collars
        fitted = body.J_regressor @ body.shapedirs[..., k]
        np.testing.assert_allclose(fitted, joint_moves, atol=7e-3)
        limbs = [JOINT_INDEX[name] for name in procedural.both("knee", "ankle", "shoulder", "elbow", "wrist")]
        np.testing.assert_allclose(fitted[limbs], joint_moves[limbs], atol=1e-3)
    np.testing.assert_allclose(body.joints, procedural.rest_joints(), atol=1e-3)
    assert (body.J_regressor >= 0).all()
    np.testing.assert_allclose(body.J_regressor.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(body.face_landmarks, procedural.FACE_LANDMARKS, atol=1e-7)


def test_building_twice_gives_the_same_arrays(coarse):
    again = procedural.build_body(coarseness=2.5)
    assert set(again) == set(coarse)
    for key, value in coarse.items():
        np.testing.assert_array_equal(again[key], value)
        assert again[key].dtype == value.dtype


def test_the_surface_is_symmetric():
    points = np.random.default_rng(0).uniform([-0.9, -1, -0.2], [0.9, 0.85, 0.2], (2000, 3))
    np.testing.assert_allclose(signed_distance(points), signed_distance(points * MIRROR), atol=1e-15)


def mirror_vertices(body) -> np.ndarray:
    """[V] the index of each vertex's mirror image."""
    order = np.lexsort(body.v_template.T)
    mirrored_order = np.lexsort((body.v_template * MIRROR).T)
    mirror = np.empty(len(order), np.int64)
    mirror[mirrored_order] = order
    np.testing.assert_array_equal(body.v_template[mirror], body.v_template * MIRROR)
    return mirror


def test_a_mirrored_pose_gives_the_mirrored_person():
    body = load_body()
    mirror = mirror_vertices(body)
    rng = np.random.default_rng(0)
    pose, betas = rng.normal(0, 0.4, (24, 3)), rng.normal(0, 1, 10)
    mirrored_pose = pose[list(procedural.MIRRORED_JOINT)] * [1, -1, -1]
    vertices = body.pose(BodyPose(pose, betas, np.array([1.0, 2, 3])))
    mirrored = body.pose(BodyPose(mirrored_pose, betas, np.array([-1.0, 2, 3])))
    np.testing.assert_allclose(mirrored[mirror], vertices * MIRROR, atol=2e-5)


@pytest.mark.parametrize(
    ("coefficient", "measure", "change"),
    [
        ("stature", lambda v, j: np.ptp(v[:, 1]), 0.05),
        ("leg length", lambda v, j: j[JOINT_INDEX["left_hip"], 1] - j[JOINT_INDEX["left_ankle"], 1], 0.06),
        ("arm length", lambda v, j: j[JOINT_INDEX["left_wrist"], 0] - j[JOINT_INDEX["left_shoulder"], 0], 0.06),
    ],
)
def test_shape_coefficients_do_what_their_names_say(coefficient, measure, change):
    body = load_body()
    k = [direction.name for direction in procedural.SHAPE_DIRECTIONS].index(coefficient)
    before, after = measure(*body.shaped(np.zeros(10))), measure(*body.shaped(np.eye(10)[k]))
    assert after / before - 1 == pytest.approx(change, abs=0.008)


def test_weight_makes_the_body_rounder_but_not_taller():
    body = load_body()
    thin, thick = body.v_template, body.shaped(np.eye(10)[1])[0]
    at_belly = np.abs(thin[:, 1] - 0.1) < 0.02
    assert np.ptp(thick[at_belly, 2]) > 1.05 * np.ptp(thin[at_belly, 2])
    assert np.ptp(thick[:, 1]) == pytest.approx(np.ptp(thin[:, 1]), abs=0.01)


@pytest.mark.parametrize(
    "pose",
    [
        {"left_hip": (-95, 10, 12), "left_knee": (105, 0, 0)},  # squat
        {"right_hip": (-80, 0, 0), "right_knee": (25, 0, 0)},  # kick
        {"left_shoulder": (0, 0, 60), "left_collar": (0, 0, 14)},  # arm up
        {"left_shoulder": (0, 0, -68)},  # arm down
    ],
)
def test_extreme_poses_do_not_collapse_the_body(pose):
    """The enclosed volume, which linear blend skinning loses at bent joints, stays within 6 %."""
    body = load_body()
    angles = np.zeros((24, 3))
    for name, degrees in pose.items():
        angles[JOINT_INDEX[name]] = np.deg2rad(degrees)

    def volume(v: np.ndarray) -> float:
        a, b, c = (v[body.faces[:, k]] for k in range(3))
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)

    posed = body.pose(BodyPose(angles, np.zeros(10), np.zeros(3)))
    assert volume(posed) == pytest.approx(volume(body.v_template), rel=0.06)


def test_the_build_command_refuses_a_wrong_name(capsys):
    assert procedural.main(["body.txt"]) == 2
    assert "usage" in capsys.readouterr().err
