import copyreg
import os
import pickle
import struct
import subprocess
import tracemalloc

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.files import safe_pickle
from ihbench.files.safe_pickle import ForeignObject, load_npy, load_pickle
from tests.body.python2_pickle import Instance, dumps


def text(value: str) -> bytes:
    return b"S" + repr(value).encode() + b"\n"


def short(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


class Reduced:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def attacks(mark: str, evil_npy: str) -> dict[str, bytes]:
    """Pickles that create the file `mark` when plain pickle reads them."""
    shell = f"touch {mark}"
    python = f"open({mark!r}, 'w').close()"
    return {
        "os.system": b"cos\nsystem\n(" + text(shell) + b"tR.",
        "posix.system": b"cposix\nsystem\n(" + text(shell) + b"tR.",
        "eval": b"c__builtin__\neval\n(" + text(python) + b"tR.",
        "exec": pickle.dumps(Reduced(exec, python)),
        "getattr": (
            b"cbuiltins\ngetattr\n(cos\n__dict__\n"
            + text("get")
            + b"tR("
            + text("system")
            + b"tR("
            + text(shell)
            + b"tR."
        ),
        "subprocess": pickle.dumps(Reduced(subprocess.check_call, ["touch", mark])),
        "numpy.load": b"cnumpy\nload\n(" + text(evil_npy) + b"NI01\ntR.",
        "numpy runstring": (
            b"cnumpy.testing._private.utils\nrunstring\n(" + text(python) + b"cbuiltins\ndict\n)RtR."
        ),
        "stack global": b"\x80\x04" + short("os") + short("system") + b"\x93" + short(shell) + b"\x85R.",
        "inst": b"(" + text(shell) + b"ios\nsystem\n.",
        "obj": b"(csubprocess\nPopen\n(" + text("touch") + text(mark) + b"lo.",
        "newobj": b"\x80\x02csubprocess\nPopen\n)\x81.",
        "inside a list": b"]cos\nsystem\n(" + text(shell) + b"tRa.",
        "extension registry": b"\x80\x02\x82\xf0(" + text(shell) + b"tR.",
    }


# "newobj" runs nothing under plain pickle (Popen needs __init__), it only must be refused
EFFECTIVE = sorted(set(attacks("", "")) - {"newobj"})


@pytest.fixture
def registered_extension():
    copyreg.add_extension("os", "system", 0xF0)
    pickle.loads(b"\x80\x02\x82\xf0.")  # warms the cache that bypasses find_class
    yield
    copyreg.remove_extension("os", "system", 0xF0)
    copyreg._extension_cache.clear()


@pytest.mark.parametrize("name", [*EFFECTIVE, "newobj"])
@pytest.mark.usefixtures("registered_extension")
def test_hostile_pickles_are_refused_and_do_not_run(name, tmp_path):
    mark = tmp_path / "mark"
    evil_npy = tmp_path / "evil.npy"
    np.save(evil_npy, np.array(Reduced(os.system, f"touch {mark}"), dtype=object), allow_pickle=True)
    attack = attacks(str(mark), str(evil_npy))[name]
    file = tmp_path / "attack.pkl"
    file.write_bytes(attack)
    if name in EFFECTIVE:  # the attack is a real one
        result = pickle.loads(attack)
        if isinstance(result, subprocess.Popen):
            result.wait()
        assert mark.exists()
        mark.unlink()
    with pytest.raises(BadInput, match=r"attack\.pkl") as refusal:
        load_pickle(file)
    assert "\n" not in str(refusal.value)
    assert not mark.exists()


def test_hostile_npy_does_not_run(tmp_path):
    mark, file = tmp_path / "mark", tmp_path / "annots.npy"
    np.save(file, np.array(Reduced(os.system, f"touch {mark}"), dtype=object), allow_pickle=True)
    with pytest.raises(BadInput, match=r"annots\.npy.*system"):
        load_npy(file)
    assert not mark.exists()


@pytest.mark.parametrize(
    "attack",
    [
        # attributes of what the reader itself can call
        b"cnumpy.core.multiarray\n_reconstruct\n(N(dS'__defaults__'\n(I1\ntstb.",
        b"cnumpy\nndarray\n(N(dS'__call__'\nI1\nstb.",
        b"cnumpy\ndtype\n(dS'resolve'\nI1\nsb.",
        b"cchumpy.ch\nCh\n(N(dS'__new__'\nI1\nstb.",
        # a class or function as a value
        b"cnumpy\ndtype\n.",
        b"cnumpy\nndarray\n.",
        b"ccopy_reg\n_reconstructor\n.",
        # wrong classes for the constructors
        b"ccopy_reg\n_reconstructor\n(cnumpy\ndtype\nc__builtin__\nobject\nNtR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(cchumpy.ch\nCh\n(I0\ntS'b'\ntR.",
        b"c_codecs\nencode\n(S'abc'\nS'rot13'\ntR.",
        # opcodes no data file needs
        b"Pid\n.",
        b"S'id'\nQ.",
        b"\x80\x05\x97.",
        # structured and object scalars
        b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(S'O8'\nI0\nI1\ntRS'12345678'\ntR.",
        b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(S'V8'\nI0\nI1\ntRS'12345678'\ntR.",
        b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\n(S'f8'\n(I9\nttNNI-1\nI-1\nI0\ntb.",
    ],
)
def test_trickery_with_allowed_names_is_refused(attack, tmp_path):
    file = tmp_path / "trick.pkl"
    file.write_bytes(attack)
    with pytest.raises(BadInput, match=r"trick\.pkl"):
        load_pickle(file)
    assert safe_pickle._reconstruct.__defaults__ is None


def test_names_that_hide_in_an_inert_package_do_nothing(tmp_path):
    mark, file = tmp_path / "mark", tmp_path / "dotted.pkl"
    call = short("chumpy") + short("os.system") + b"\x93" + short(f"touch {mark}") + b"\x85R."
    file.write_bytes(b"\x80\x04" + call)
    value = load_pickle(file)
    assert isinstance(value, ForeignObject)
    assert value.kind == "chumpy.os.system"
    assert not mark.exists()


def array_pickle(shape: tuple, dtype: str, data: bytes) -> bytes:
    dims = b"(" + b"".join(b"L%dL\n" % n for n in shape) + b"t"
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n" + dims + b"S'b'\ntR"
        b"(I1\n" + dims + b"cnumpy\ndtype\n(" + text(dtype) + b"I0\nI1\ntRI00\n" + data + b"tb."
    )


@pytest.mark.parametrize(
    "content",
    [
        array_pickle((10**13,), "f8", b"S''\n"),
        array_pickle((10**6, 10**6), "f8", b"S'12345678'\n"),
        array_pickle((10**12,), "O8", b"(l"),
        array_pickle((-1,), "f8", b"S''\n"),
        b"\x80\x04\x8e" + struct.pack("<Q", 10**13) + b"abc.",  # BINBYTES8
        b"\x80\x05\x96" + struct.pack("<Q", 10**13) + b"abc.",  # BYTEARRAY8
        b"\x80\x04\x95" + struct.pack("<Q", 10**13) + b"N",  # FRAME
        b"\x80\x02Nr\xff\xff\xff\xffq",  # LONG_BINPUT at the highest index
    ],
)
def test_sizes_that_the_file_does_not_hold_are_refused_without_allocating(content, tmp_path):
    file = tmp_path / "giant.pkl"
    file.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(BadInput, match=r"giant\.pkl"):
            load_pickle(file)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("content", [b"", b".", b"hello", b"\x80\x04", b"PK\x03\x04" * 9])
def test_broken_files_are_bad_input(content, tmp_path):
    file = tmp_path / "broken.pkl"
    file.write_bytes(content)
    with pytest.raises(BadInput, match=r"broken\.pkl") as refusal:
        load_pickle(file)
    assert "\n" not in str(refusal.value)


def test_deep_nesting_is_bad_input(tmp_path):
    file = tmp_path / "deep.pkl"
    file.write_bytes(b"]" * 50_000 + b"a" * 49_999 + b".")
    with pytest.raises(BadInput, match=r"deep\.pkl"):
        load_pickle(file)


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


def test_npy_headers_that_promise_too_much_are_bad_input(tmp_path):
    file = tmp_path / "giant.npy"
    for shape, dtype in (((10**13,), "<f8"), ((10**12,), "|O"), ((4,), "<f8")):
        with file.open("wb") as stream:
            header = {"descr": dtype, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.write(pickle.dumps(np.zeros(1, object)) if dtype == "|O" else b"12345678" * 3)
        with pytest.raises(BadInput, match=r"giant\.npy"):
            load_npy(file)
    for content in (b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\x10\x00{'descr': os}   ", b"text"):
        file.write_bytes(content)
        with pytest.raises(BadInput, match=r"giant\.npy"):
            load_npy(file)
