import pickle

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.files.safe_pickle import ForeignObject, load_npy, load_pickle
from tests.body.python2_pickle import Instance, dumps


@pytest.mark.parametrize("content", [b"", b".", b"hello", b"\x80\x04", b"PK\x03\x04" * 9])
def test_broken_files_are_bad_input(content, tmp_path):
    file = tmp_path / "broken.pkl"
    file.write_bytes(content)
    with pytest.raises(BadInput, match=r"broken\.pkl") as refusal:
        load_pickle(file)
    assert "\n" not in str(refusal.value)


def test_every_truncation_of_a_good_file_is_bad_input(tmp_path):
    file = tmp_path / "cut.pkl"
    whole = pickle.dumps({"cams": {"K": [np.eye(3)]}, "ims": ["a", np.float32(2)]}, protocol=3)
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(BadInput, match=r"cut\.pkl"):
            load_pickle(file)


def test_missing_file_is_bad_input(tmp_path):
    for load in (load_pickle, load_npy):
        with pytest.raises(BadInput, match="nowhere"):
            load(tmp_path / "nowhere")


def plain_data() -> dict:
    shared = np.arange(4)
    return {
        "doubles": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        "empty": np.zeros((0, 3)),
        "zero_d": np.array(3.5),
        "flags": np.array([True, False]),
        "words": np.array(["ab", "c"]),
        "bytes_words": np.array([b"ab", b"c"]),
        "big_endian": np.arange(3, dtype=">f4"),
        "complex": np.array([1 + 2j]),
        "objects": np.array([{"K": np.eye(2)}, None, [1]], dtype=object),
        "scalars": [np.float64(1.5), np.float32(2.5), np.int64(-3), np.bool_(True)],
        "plain": [1, 2.5, "text", b"raw", None, True, (1, ("nested", shared)), {3, 4}, 10**30],
        "shared": [shared, shared],
    }


def assert_same(a, b):
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.shape == b.shape
        assert a.dtype.newbyteorder("=") == b.dtype
        if a.dtype.hasobject:
            assert_same(list(a.ravel()), list(b.ravel()))
        else:
            np.testing.assert_array_equal(a, b)
            assert b.flags.writeable
    else:
        assert a == b


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_survives_every_protocol(protocol, tmp_path):
    file = tmp_path / "data.pkl"
    file.write_bytes(pickle.dumps(plain_data(), protocol=protocol))
    assert_same(plain_data(), load_pickle(file))
    shared = load_pickle(file)["shared"]
    assert shared[0] is shared[1]


@pytest.mark.parametrize("protocol", [0, 2])
def test_python_2_pickles(protocol, tmp_path):
    file = tmp_path / "camera.pkl"
    data = {
        "camera_k": np.array([0.1, -0.2, 0, 0, 0]),
        "width": 1080,
        "raw": np.arange(256, dtype=np.uint8),
        "objects": np.array(["a", 1], dtype=object),
    }
    file.write_bytes(dumps(data, protocol))
    value = load_pickle(file)
    np.testing.assert_array_equal(value["camera_k"], data["camera_k"])
    np.testing.assert_array_equal(value["raw"], data["raw"])
    assert value["width"] == 1080
    assert list(value["objects"]) == ["a", 1]


@pytest.mark.parametrize("protocol", [0, 2])
def test_foreign_objects_carry_their_state(protocol, tmp_path):
    file = tmp_path / "model.pkl"
    inner = Instance("chumpy.ch", "Ch", {"x": np.eye(2)})
    file.write_bytes(
        dumps({"v": Instance("chumpy.reordering", "Select", {"a": inner, "idxs": np.array([0])})}, protocol)
    )
    value = load_pickle(file)["v"]
    assert isinstance(value, ForeignObject)
    assert value.kind == "chumpy.reordering.Select"
    np.testing.assert_array_equal(value.state["a"].state["x"], np.eye(2))


def test_npy_of_objects_reads_like_numpy(tmp_path):
    file = tmp_path / "annots.npy"
    annots = {
        "cams": {"K": [np.eye(3), np.eye(3)], "T": [np.ones((3, 1))]},
        "ims": [{"ims": ["Camera_B1/000000.jpg"]}],
    }
    np.save(file, np.array(annots, dtype=object), allow_pickle=True)
    assert_same(annots, load_npy(file).item())


@pytest.mark.parametrize(
    "array", [np.arange(12.0).reshape(3, 4), np.asfortranarray(np.eye(3)), np.array(2), np.zeros(0)]
)
def test_npy_of_numbers_reads_like_numpy(array, tmp_path):
    file = tmp_path / "numbers.npy"
    np.save(file, array)
    value = load_npy(file)
    np.testing.assert_array_equal(value, array)
    assert value.dtype == array.dtype


def test_tuples_nested_so_deeply_that_hashing_one_would_end_the_process(tmp_path):
    path = tmp_path / "deep.pkl"
    path.write_bytes(b"\x80\x02})" + 1_000_000 * pickle.TUPLE1 + b"K\x01s.")
    with pytest.raises(BadInput, match="tuples nested too deeply"):
        load_pickle(path)
    path.write_bytes(b"\x80\x02})" + 900 * pickle.TUPLE1 + b"K\x01s.")
    with pytest.raises(BadInput, match="key that is not plain"):
        load_pickle(path)
