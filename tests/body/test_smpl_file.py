import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ihbench.body import PARENTS, load_body, write_body
from ihbench.body.smpl_file import find_model_file
from ihbench.errors import BadInput
from tests.body.python2_pickle import Instance, dumps

V, F = 6890, 13776
UV_COUNT = 7576


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    """Arrays of SMPL's shapes and types: a cloud of vertices around random bones, faces between neighbours in it."""
    rng = np.random.default_rng(0)
    v = rng.normal(0, [0.2, 0.35, 0.1], (V, 3)).clip(-0.9, 0.9)
    weights = rng.random((V, 24)) ** 8
    regressor = np.zeros((24, V))
    for k in range(24):
        regressor[k, rng.choice(V, 30, replace=False)] = 1 / 30
    kintree = np.array([PARENTS, range(24)], np.int64)
    kintree[0, 0] = 2**32 - 1
    start = np.argsort(rng.random((F, 3)), axis=1)
    return {
        "v_template": v,
        "shapedirs": rng.normal(0, 0.01, (V, 3, 10)),
        "posedirs": rng.normal(0, 0.001, (V, 3, 207)),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor,
        "kintree_table": kintree.astype(np.uint32),
        "f": ((rng.integers(0, V - 5, (F, 1)) + start) % V).astype(np.uint32),
    }


@pytest.fixture(scope="module")
def few_arrays(arrays) -> dict[str, np.ndarray]:
    """The same without the pose correctives, which a model may lack and which are nine tenths of its file."""
    return {name: array for name, array in arrays.items() if name != "posedirs"}


def sparse(matrix: np.ndarray) -> Instance:
    """The matrix as scipy 0.1x pickled a csc_matrix."""
    columns, rows = np.nonzero(matrix.T)
    indptr = np.searchsorted(columns, np.arange(matrix.shape[1] + 1)).astype(np.int32)
    state = {
        "_shape": matrix.shape,
        "data": matrix.T[columns, rows],
        "indices": rows.astype(np.int32),
        "indptr": indptr,
        "maxprint": 50,
    }
    return Instance("scipy.sparse.csc", "csc_matrix", state)


def chumpy_array(array: np.ndarray) -> Instance:
    return Instance("chumpy.ch", "Ch", {"x": array, "_dirty_vars": [], "_itr": None})


def official(arrays: dict[str, np.ndarray]) -> dict:
    """The entries of basicModel_f_lbs_10_207_0_v1.0.0.pkl, with its chumpy and scipy objects."""
    shapes = arrays["shapedirs"]
    longer = chumpy_array(np.concatenate([shapes, np.zeros_like(shapes)], -1))  # a slice of a longer array
    idxs = np.arange(longer.state["x"].size).reshape(longer.state["x"].shape)[..., :10]
    return {
        **arrays,
        "J_regressor": sparse(arrays["J_regressor"]),
        "v_template": chumpy_array(arrays["v_template"]),
        "shapedirs": Instance(
            "chumpy.reordering", "Select", {"a": longer, "idxs": idxs.ravel(), "preferred_shape": shapes.shape}
        ),
        "posedirs": Instance(
            "chumpy.reordering",
            "transpose",
            {"a": chumpy_array(arrays["posedirs"].transpose(2, 0, 1)), "axes": (1, 2, 0)},
        ),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
        "J": np.zeros((24, 3)),
        "vert_sym_idxs": np.arange(V),
    }


def assert_is(body, arrays) -> None:
    np.testing.assert_array_equal(body.v_template, arrays["v_template"])
    np.testing.assert_array_equal(body.shapedirs, arrays["shapedirs"])
    np.testing.assert_array_equal(body.posedirs, arrays["posedirs"])
    np.testing.assert_array_equal(body.weights, arrays["weights"])
    np.testing.assert_array_equal(body.J_regressor, arrays["J_regressor"])
    np.testing.assert_array_equal(body.faces, arrays["f"])
    assert tuple(body.parents) == PARENTS
    assert body.name == "smpl"
    assert body.uv_faces.shape == (F, 3)
    assert body.uv_faces.max() < len(body.uv)


@pytest.mark.parametrize("protocol", [0, 2])
def test_official_python_2_pickle(protocol, arrays, tmp_path):
    file = tmp_path / "basicModel_f_lbs_10_207_0_v1.0.0.pkl"
    file.write_bytes(dumps(official(arrays), protocol))
    assert_is(load_body(file), arrays)
    assert find_model_file(tmp_path, "female") == file


def test_official_npz(arrays, tmp_path):
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **arrays)
    assert_is(load_body(tmp_path), arrays)


def test_pickle_cleaned_with_plain_arrays(arrays, tmp_path):
    (tmp_path / "SMPL_MALE.pkl").write_bytes(pickle.dumps(arrays, protocol=5))
    assert_is(load_body(tmp_path, gender="male"), arrays)


def test_300_shape_coefficients_stay_unless_cut(few_arrays, tmp_path):
    many = np.repeat(few_arrays["shapedirs"], 30, axis=2)
    np.savez(tmp_path / "a.npz", **{**few_arrays, "shapedirs": many})
    assert load_body(tmp_path / "a.npz").shapedirs.shape == (V, 3, 300)
    np.testing.assert_array_equal(load_body(tmp_path / "a.npz", n_betas=10).shapedirs, many[..., :10])
    with pytest.raises(BadInput, match="has 300 shape coefficients, asked for 301"):
        load_body(tmp_path / "a.npz", n_betas=301)


@pytest.mark.parametrize("name", ["procedural", "with pose correctives"])
def test_written_bodies_read_back_equal(name, tmp_path):
    body = load_body()
    if name != "procedural":
        posedirs = np.zeros((len(body.v_template), 3, 207))
        posedirs[:, :, 5] = np.random.default_rng(0).normal(size=(len(body.v_template), 3))
        body = replace(body, posedirs=posedirs, face_landmarks=None, name="smpl")
    write_body(tmp_path / "body.npz", body)
    again = load_body(tmp_path / "body.npz")
    assert again.content_sha() == body.content_sha()
    assert again.name == body.name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": None}, "lacks weights"),
        ({"v_template": np.zeros((V, 2))}, r"v_template has shape \(6890, 2\), expected \(6890, 3\)"),
        ({"v_template": np.zeros(())}, "v_template has shape"),
        ({"v_template": np.full((V, 3), np.nan)}, "v_template: expected finite"),
        ({"posedirs": np.zeros((V, 3, 9))}, r"posedirs has shape .* expected \(6890, 3, 207\)"),
        ({"shapedirs": np.zeros((V, 3, 0))}, "shapedirs has shape"),
        ({"J_regressor": np.zeros((24, 7))}, "J_regressor has shape"),
        ({"weights": np.zeros((V, 24))}, "weights: expected rows that sum to 1"),
        ({"weights": np.ones((V, 52)) / 52}, "weights has shape"),
        ({"kintree_table": np.zeros((2, 52), np.int64)}, r"SMPL-H and SMPL-X"),
        ({"kintree_table": np.zeros((2, 24), np.int64)}, "24 joints in SMPL's order"),
        ({"f": np.full((F, 3), V)}, "f: expected whole numbers from 0 to 6889"),
        ({"f": np.zeros((F, 3))}, "f: expected whole numbers"),
        ({"ft": np.zeros((F, 3), np.int32)}, "only one of vt and ft"),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "pkl"])
def test_wrong_arrays_are_bad_input(suffix, change, message, few_arrays, tmp_path):
    file = tmp_path / f"wrong.{suffix}"
    changed = {key: value for key, value in {**few_arrays, **change}.items() if value is not None}
    if suffix == "npz":
        np.savez(file, **changed)
    else:
        file.write_bytes(pickle.dumps(changed))
    with pytest.raises(BadInput, match=message) as error:
        load_body(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_millimetres_are_noticed(few_arrays, tmp_path):
    np.savez(tmp_path / "mm.npz", **{**few_arrays, "v_template": few_arrays["v_template"] * 1000})
    with pytest.raises(BadInput, match="expected a person in metres"):
        load_body(tmp_path / "mm.npz")


@pytest.mark.parametrize(
    "regressor",
    [
        Instance("scipy.sparse.csc", "csc_matrix", {"_shape": (24, V)}),
        Instance("scipy.sparse.csc", "csc_matrix", {"_shape": (10**9, 10**9)}),
        Instance("chumpy.ch", "Ch", {}),
        Instance("chumpy.linalg", "dot", {"a": np.eye(2)}),
        Instance("chumpy.reordering", "Select", {"a": np.zeros(3), "idxs": np.array([99])}),
        "text",
        [[1, 2], [3]],
    ],
)
def test_damaged_objects_are_bad_input(regressor, few_arrays, tmp_path):
    (tmp_path / "damaged.pkl").write_bytes(dumps({**few_arrays, "J_regressor": regressor}))
    with pytest.raises(BadInput, match=r"damaged\.pkl: J_regressor"):
        load_body(tmp_path / "damaged.pkl")


def test_files_that_are_no_model_are_bad_input(tmp_path):
    for name, content in {
        "a.npz": b"not a zip",
        "b.npz": b"PK\x05\x06" + b"\0" * 18,
        "c.pkl": pickle.dumps([1]),
        "d.txt": b"",
        "e.pkl": b"cos\nsystem\n(S'true'\ntR.",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BadInput, match=name):
            load_body(tmp_path / name)
    np.savez(tmp_path / "f.npz", v_template=np.array({}, dtype=object))
    with pytest.raises(BadInput, match=r"f\.npz"):
        load_body(tmp_path / "f.npz")


def test_missing_files_say_where_smpl_comes_from(tmp_path):
    for place in (tmp_path, tmp_path / "SMPL_NEUTRAL.pkl"):
        with pytest.raises(BadInput, match=r"smpl\.is\.tue\.mpg\.de"):
            load_body(place)
    with pytest.raises(BadInput, match="neutral, male or female"):
        load_body(tmp_path, gender="other")


@pytest.mark.parametrize(
    "name",
    [
        "SMPL_NEUTRAL.npz",
        "smpl/SMPL_NEUTRAL.pkl",
        "models/basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl",
        "smpl/models/basicModel_neutral_lbs_10_207_0_v1.0.0.pkl",
    ],
)
def test_folders_are_searched_like_the_official_archives(name, tmp_path):
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "SMPL_FEMALE.pkl").touch()
    file.touch()
    assert find_model_file(tmp_path) == file


# texture coordinates


@pytest.fixture(scope="module")
def uv() -> np.ndarray:
    return np.random.default_rng(1).random((UV_COUNT, 2)).round(6)


@pytest.fixture(scope="module")
def uv_faces() -> np.ndarray:
    return np.random.default_rng(2).integers(0, UV_COUNT, (F, 3))


def write_obj(path: Path, uv: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray, normal: str = "") -> None:
    lines = ["# texture", "mtllib body.mtl", "v 0 0 0", *(f"vt {u:.6f} {v:.6f}" for u, v in uv), "s off"]
    for face, uv_face in zip(faces + 1, uv_faces + 1, strict=True):
        lines.append("f " + " ".join(f"{a}/{b}{normal}" for a, b in zip(face, uv_face, strict=True)))
    path.write_text("\n".join(lines))


def test_smpl_uv_obj_beside_the_model_is_used(few_arrays, uv, uv_faces, tmp_path):
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **few_arrays)
    write_obj(tmp_path / "smpl_uv.obj", uv, few_arrays["f"].astype(int), uv_faces)
    body = load_body(tmp_path)
    np.testing.assert_array_equal(body.uv, uv)
    np.testing.assert_array_equal(body.uv_faces, uv_faces)


def test_obj_faces_may_come_in_another_order_and_start_at_another_corner(few_arrays, uv, uv_faces, tmp_path):
    faces = few_arrays["f"].astype(int)
    _, first = np.unique(np.sort(faces, 1), axis=0, return_index=True)  # a triangle that occurs twice has two answers
    faces, uv_faces = faces[first], uv_faces[first]
    np.savez(tmp_path / "model.npz", **{**few_arrays, "f": faces})
    rng = np.random.default_rng(3)
    order = rng.permutation(len(faces))
    turn = (np.arange(3) + rng.integers(0, 3, (len(faces), 1))) % 3
    write_obj(
        tmp_path / "turned.obj",
        uv,
        np.take_along_axis(faces[order], turn, 1),
        np.take_along_axis(uv_faces[order], turn, 1),
        normal="/1",
    )
    body = load_body(tmp_path / "model.npz", uv_path=tmp_path / "turned.obj")
    np.testing.assert_array_equal(body.uv_faces, uv_faces)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found none"),
        ("vt 0 0\nf 1/1 2/1 3/1 4/1\n", "line 2: expected"),
        ("vt 0 0\nf 1 2 3\n", "line 2: expected"),
        ("vt zero 0\n", "line 1: expected"),
        ("vt 0\n", "line 1: expected"),
        ("vt 0 1.5\nf 1/1 2/1 3/1\n", "coordinates from 0 to 1"),
        ("vt 0 nan\nf 1/1 2/1 3/1\n", "coordinates from 0 to 1"),
        ("vt 0 0\nf 1/2 2/1 3/1\n", "not in the file"),
        ("vt 0 0\nf 1/0 2/1 3/1\n", "not in the file"),
        ("vt 0 0\nf 1/1 2/1 99999999999/1\n", "32 bits"),
        ("vt 0 0\nf 1/1 2/1 3/1\n", "its 1 triangles are not the body's 13776"),
    ],
)
def test_wrong_obj_files_are_bad_input(text, message, few_arrays, tmp_path):
    np.savez(tmp_path / "model.npz", **few_arrays)
    (tmp_path / "uv.obj").write_text(text)
    with pytest.raises(BadInput, match=message) as error:
        load_body(tmp_path / "model.npz", uv_path=tmp_path / "uv.obj")
    assert "uv.obj" in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_obj_is_bad_input(few_arrays, tmp_path):
    np.savez(tmp_path / "model.npz", **few_arrays)
    with pytest.raises(BadInput, match=r"nowhere\.obj"):
        load_body(tmp_path / "model.npz", uv_path=tmp_path / "nowhere.obj")
