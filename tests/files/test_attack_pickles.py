"""A corpus of hostile pickles and .npy headers. None may run, crash, hang or grow: `BadInput`, or inert data."""

from __future__ import annotations

import builtins
import contextlib
import copyreg
import operator
import os
import pickle
import struct
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.files.safe_pickle import ForeignObject, load_npy, load_pickle

# ------------------------------------------------------------------------------- pieces of pickle programs

STOP = b"."


def g(module: str, name: str) -> bytes:
    """GLOBAL: the name as plain lines."""
    return b"c" + module.encode() + b"\n" + name.encode() + b"\n"


def s(value: str) -> bytes:
    """A text by BINUNICODE."""
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def b(value: bytes) -> bytes:
    return b"B" + struct.pack("<I", len(value)) + value


def sg(module: str, name: str) -> bytes:
    """STACK_GLOBAL: names from the stack, dots allowed."""
    return s(module) + s(name) + b"\x93"


def call(function: bytes, *arguments: bytes) -> bytes:
    return function + b"(" + b"".join(arguments) + b"tR"


def put(index: int) -> bytes:
    return b"r" + struct.pack("<I", index)


def get(index: int) -> bytes:
    return b"j" + struct.pack("<I", index)


def integer(value: int) -> bytes:
    data = pickle.encode_long(value)
    return b"\x8b" + struct.pack("<i", len(data)) + data


RECONSTRUCT = g("numpy.core.multiarray", "_reconstruct")
NDARRAY, DTYPE = g("numpy", "ndarray"), g("numpy", "dtype")
EMPTY_ARRAY = call(RECONSTRUCT, NDARRAY, b"K\x00\x85", b(b"b"))


def dtype(name: str) -> bytes:
    return call(DTYPE, s(name), b"I0\nI1\n")


def array(shape: bytes, kind: bytes, data: bytes) -> bytes:
    return EMPTY_ARRAY + b"(K\x01" + shape + kind + b"\x89" + data + b"tb"


def nested_pairs(levels: int) -> bytes:
    """Billion laughs: each level holds the one below twice."""
    return b"N" + put(0) + b"".join(get(k) * 2 + b"\x86" + put(k + 1) for k in range(levels))


class Reduced:
    """What `pickle.dumps` writes as a call."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def python(mark: Path) -> str:
    return f"open({str(mark)!r}, 'w').close()"


# ---------------------------------------------------------------------------------------- programs that run


def programs(mark: Path) -> dict[str, bytes]:
    """Pickles that would create `mark` (or do something else that is no business of data)."""
    shell, code = f"touch {mark}", python(mark)
    run = (s(shell),)
    return {
        "os.system": call(g("os", "system"), *run) + STOP,
        "builtins.eval": pickle.dumps(Reduced(builtins.eval, code)),
        "builtins.getattr": call(
            call(g("builtins", "getattr"), call(g("builtins", "__import__"), s("os")), s("system")), *run
        )
        + STOP,
        "builtins.open": call(g("builtins", "open"), s(str(mark)), s("w")) + STOP,
        "operator.methodcaller": pickle.dumps(Reduced(operator.methodcaller, "system", shell)),
        "pickle.loads": call(g("pickle", "loads"), b(call(g("os", "system"), *run) + STOP)) + STOP,
        # allowed modules, other names
        "numpy.savetxt": call(g("numpy", "savetxt"), s(str(mark)), b"](K\x01e") + STOP,
        "numpy.core.multiarray dotted": b"\x80\x04" + call(sg("numpy.core.multiarray", "os.system"), *run) + STOP,
        "numpy.ndarray.tofile": b"\x80\x04" + call(sg("numpy", "ndarray.tofile"), EMPTY_ARRAY, s(str(mark))) + STOP,
        "ndarray called": call(NDARRAY, integer(10**9)) + STOP,
        "_reconstruct of a foreign class": call(RECONSTRUCT, g("subprocess", "Popen"), b"K\x00\x85", b(b"b")) + STOP,
        "_reconstruct of an inert class": call(RECONSTRUCT, g("chumpy", "Ch"), b"K\x00\x85", b(b"b")) + STOP,
        # copyreg
        "copyreg._reconstructor of dict": call(
            g("copyreg", "_reconstructor"), g("builtins", "dict"), g("builtins", "object"), b"N"
        )
        + STOP,
        "copyreg._reconstructor of an allowed name": call(
            g("copyreg", "_reconstructor"), DTYPE, g("builtins", "object"), b"N"
        )
        + STOP,
        "copyreg.__newobj_ex__": call(g("copyreg", "__newobj_ex__"), NDARRAY, b")", b"}") + STOP,
        # BUILD
        "BUILD on a module": g("os", "path") + b"}" + s("x") + b"Nsb" + STOP,
        "BUILD on a reader's function": RECONSTRUCT + b"}" + s("__code__") + b"Nsb" + STOP,
        "BUILD with __class__": dtype("f8") + b"N}" + s("__class__") + g("os", "system") + b"s\x86b" + STOP,
        "BUILD with __setstate__": b"]}" + s("__setstate__") + g("os", "system") + b"sb" + s(shell) + b"b" + STOP,
        # opcodes
        "EXT1": b"\x80\x02\x82\xf0" + s(shell) + b"\x85R" + STOP,
        "EXT2": b"\x80\x02\x83\xf0\x00" + s(shell) + b"\x85R" + STOP,
        "EXT4": b"\x80\x02\x84\xf0\x00\x00\x00" + s(shell) + b"\x85R" + STOP,
        "INST": b"(" + s(shell) + b"ios\nsystem\n" + STOP,
        "OBJ": b"(" + g("subprocess", "Popen") + b"](" + s("touch") + s(str(mark)) + b"eo" + STOP,
        "NEWOBJ": g("subprocess", "Popen") + b")\x81" + STOP,
        "NEWOBJ_EX": g("subprocess", "Popen") + b")}\x92" + STOP,
        "NEWOBJ_EX of an inert class": g("chumpy", "Ch") + b")}\x92" + STOP,
        "PERSID": b"P" + code.encode() + b"\n" + STOP,
        "BINPERSID": s(code) + b"Q" + STOP,
        "NEXT_BUFFER": b"\x80\x05\x97" + STOP,
        "READONLY_BUFFER": b"\x80\x05N\x98" + STOP,
        "STACK_GLOBAL of os": b"\x80\x04" + call(sg("os", "path.os.system"), *run) + STOP,
        "STACK_GLOBAL without texts": b"\x80\x04NN\x93" + STOP,
        "REDUCE of a foreign object": call(call(g("chumpy", "Ch")), *run) + STOP,
        # codecs
        "_codecs.encode to rot13": call(g("_codecs", "encode"), s("a"), s("rot13")) + STOP,
        # torch
        # packages with names like the inert ones
        "chumpyx": call(g("chumpyx", "system"), *run) + STOP,
        # reader's own names as values
        "a function as value": RECONSTRUCT + STOP,
        "a function in a set": call(g("builtins", "set"), b"](" + RECONSTRUCT + b"e") + STOP,
        "a function as key": b"}" + RECONSTRUCT + b"Ns" + STOP,
        "an unfinished array as key": b"}" + EMPTY_ARRAY + b"Ns" + STOP,
        "a function in an object array": array(b"K\x01\x85", dtype("O8"), b"](" + RECONSTRUCT + b"e") + STOP,
        "a function in a foreign state": call(g("chumpy", "Ch")) + b"}" + s("x") + RECONSTRUCT + b"sb" + STOP,
    }


HERE = Path("mark")


@pytest.fixture
def registered_extension():
    """An extension code that plain pickle would follow."""
    copyreg.add_extension("os", "system", 0xF0)
    pickle.loads(b"\x80\x02\x82\xf0.")  # warms the cache that bypasses find_class
    yield
    copyreg.remove_extension("os", "system", 0xF0)
    copyreg._extension_cache.clear()


def as_npy(program: bytes) -> bytes:
    """An object .npy whose content is that program."""
    return npy_header({"descr": "|O", "fortran_order": False, "shape": ()}) + program


def npy_header(header: dict | str) -> bytes:
    text = (header if isinstance(header, str) else repr(header)).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def tried(data: bytes, folder: Path, reader) -> object:
    """What the reader gives back, or None when it refuses in one short line that names the file."""
    file = folder / ("attack.npy" if reader is load_npy else "attack.pkl")
    file.write_bytes(data)
    try:
        return reader(file)
    except BadInput as error:
        refusal = str(error)
    assert "\n" not in refusal
    assert str(file) in refusal
    assert len(refusal) < len(str(file)) + 400
    return None


def both(program: bytes, folder: Path) -> list[object]:
    return [tried(program, folder, load_pickle), tried(as_npy(program), folder, load_npy)]


@pytest.mark.parametrize("name", programs(HERE))
@pytest.mark.usefixtures("registered_extension")
def test_programs_are_refused_and_do_nothing(name, tmp_path):
    mark = tmp_path / "mark"
    modules = set(sys.modules)
    assert both(programs(mark)[name], tmp_path) == [None, None]
    assert {path.name for path in tmp_path.iterdir()} == {"attack.pkl", "attack.npy"}
    assert set(sys.modules) == modules


RUNNABLE = (
    *("os.system", "builtins.eval", "builtins.getattr", "builtins.open", "operator.methodcaller", "pickle.loads"),
    *("numpy.savetxt", "numpy.ndarray.tofile", "EXT1", "EXT2", "EXT4", "INST", "STACK_GLOBAL of os"),
)


@pytest.mark.parametrize("name", RUNNABLE)
@pytest.mark.usefixtures("registered_extension")
def test_these_programs_are_real_under_plain_pickle(name, tmp_path):
    """So that the test above is known to test something."""
    mark = tmp_path / "mark"
    program = programs(mark)[name]
    with contextlib.suppress(Exception):  # some stumble after the deed
        value = pickle.loads(program)
        if callable(value):
            value(os)
    assert mark.exists()


# ------------------------------------------------------------------------------------------------- bombs

LEVELS = 64
KEY = put(10**6), get(10**6)
SELF = put(7), get(7)


def bombs() -> dict[str, bytes]:
    """Small pickles that would take for ever, or all memory, or the C stack."""
    laughs = nested_pairs(LEVELS)
    megabyte = s("a" * 10**6) + put(1)
    zeros = b(bytes(10**6)) + put(1)
    encode, f8 = g("_codecs", "encode"), dtype("u1") + put(3)
    n = 20_000
    return {
        "tuples as a shape": laughs + KEY[0] + array(KEY[1], dtype("f8"), b(b"")) + STOP,
        "deep foreign objects": b"".join(
            (call(g("chumpy", "Ch")), (b"}" + s("x") + call(g("chumpy", "Ch"))) * 5000, b"sb" * 5000)
        )
        + STOP,
        "copies of a text": megabyte + encode + put(2) + b"](" + (get(2) + get(1) + b"\x85R") * n + b"e" + STOP,
        "copies of array data": zeros
        + EMPTY_ARRAY[:0]
        + f8
        + RECONSTRUCT
        + put(4)
        + NDARRAY
        + put(5)
        + b"]("
        + (get(4) + get(5) + b"K\x00\x85U\x01b\x87R(" + integer(10**6) + b"\x85" + get(3) + b"\x89" + get(1) + b"tb")
        * 2000
        + b"e"
        + STOP,
        "BINBYTES8": b"\x80\x04\x8e" + struct.pack("<Q", 2**60) + b"abc" + STOP,
        "BYTEARRAY8": b"\x80\x05\x96" + struct.pack("<Q", 2**60) + b"abc" + STOP,
        "FRAME": b"\x80\x04\x95" + struct.pack("<Q", 2**60) + b"N" + STOP,
        "LONG of many digits": b"L" + b"9" * 10**6 + b"L\n" + STOP,
        "LONG_BINPUT": b"Nr\xff\xff\xff\xff" + b"j\xfe\xff\xff\xff" + STOP,
        "PUT": b"Np" + b"9" * 4000 + b"\n" + b"g1\n" + STOP,
        "a shape of 2**40": array(integer(2**40) + b"\x85", dtype("f8"), b(b"")) + STOP,
        "a shape of objects": array(integer(2**40) + b"\x85", dtype("O8"), b"]") + STOP,
        "a shape of 100 dimensions": array(b"(" + b"K\x01" * 100 + b"t", dtype("f8"), b(bytes(8))) + STOP,
        "a negative shape": array(integer(-1) + b"\x85", dtype("f8"), b(bytes(8))) + STOP,
        "a shape that is none": array(s("(1,)"), dtype("f8"), b(bytes(8))) + STOP,
        "a huge dtype": array(b"K\x01\x85", dtype(f"S{2**40}"), b(b"")) + STOP,
        "a scalar of a huge dtype": call(g("numpy.core.multiarray", "scalar"), dtype(f"U{2**28}"), b(b"")) + STOP,
        # structure
        "a structured dtype": array(b"K\x01\x85", dtype("f8,f8"), b(bytes(16))) + STOP,
        "a structured dtype by BUILD": array(
            b"K\x01\x85", dtype("V8") + b"(K\x03" + s("|") + b"N" + s("a") + b"\x85}I8\nI1\nK\x00tb", b(bytes(8))
        )
        + STOP,
        "a subarray dtype": array(b"K\x01\x85", dtype("(2,)f8"), b(bytes(16))) + STOP,
        "an object array with a buffer": array(b"K\x01\x85", dtype("O8"), b(bytes(8))) + STOP,
        "an object array by _frombuffer": call(
            g("numpy._core.numeric", "_frombuffer"),
            b"\x96" + struct.pack("<Q", 8) + bytes(8),
            dtype("O8"),
            b"K\x01\x85",
            s("C"),
        )
        + STOP,
        "an object scalar": call(g("numpy.core.multiarray", "scalar"), dtype("O8"), b(bytes(8))) + STOP,
        "an object array that holds itself": EMPTY_ARRAY
        + SELF[0]
        + b"(K\x01K\x01\x85"
        + dtype("O8")
        + b"\x89]("
        + SELF[1]
        + b"etb"
        + STOP,
        "a tuple that holds itself": b"]"
        + SELF[0]
        + b"\x85"
        + put(8)
        + b"0"
        + SELF[1]
        + get(8)
        + b"a0"
        + get(8)
        + STOP,
    }


@pytest.mark.parametrize("name", bombs())
def test_bombs_are_refused_at_once(name, tmp_path):
    program = bombs()[name]
    tracemalloc.start()
    start = time.perf_counter()
    try:
        results = both(program, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert results == [None, None]
    assert time.perf_counter() - start < 20  # as it is measured; hangs were meant to last for years
    assert peak < 100e6 + 100 * len(program)


# ----------------------------------------------------------------------------------------- harmless ones


def harmless() -> dict[str, bytes]:
    """Odd pickles that come back as plain data."""
    return {
        "a list that holds itself": b"]" + SELF[0] + SELF[1] + b"a" + STOP,
        "a dictionary that holds itself": b"}" + SELF[0] + s("me") + SELF[1] + b"s" + STOP,
        "a foreign object that holds itself": call(g("chumpy", "Ch"))
        + SELF[0]
        + b"}"
        + s("x")
        + SELF[1]
        + b"sb"
        + STOP,
        "an object array in a list in a list": b"]("
        + array(b"K\x01\x85", dtype("O8"), b"](" + s("a") + b"e")
        + b"e"
        + STOP,
        "chumpy with __setstate__": call(g("chumpy.ch", "Ch"))
        + b"}"
        + s("__setstate__")
        + s("os.system")
        + b"sb"
        + STOP,
        "a dotted name in an inert package": b"\x80\x04" + call(sg("chumpy", "os.system"), s("true")) + STOP,
        "more after the end": b"N" + STOP + call(g("os", "system"), s("true")) + STOP,
        "one list in a list, often": b"](" + b"N" * 100 + b"e" + put(1) + b"0](" + get(1) * 50_000 + b"e" + STOP,
        "keys of every plain kind": b"}("
        + s("a")
        + b"N"
        + b"K\x01N"
        + b"\x88N"
        + b"NN"
        + b"K\x01"
        + s("x")
        + b"\x86Nu"
        + STOP,
    }


def assert_inert(value: object, seen: set[int]) -> None:
    """Plain values, arrays and foreign objects, all the way down."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, ForeignObject):
        assert type(value).__mro__[1:] == (ForeignObject, object)
        assert vars(value).keys() == {"state"}
        assert_inert(value.state, seen)
    elif isinstance(value, dict):
        assert type(value) is dict
        for key in value:
            assert isinstance(key, str | int | tuple | None)
        for item in value.values():
            assert_inert(item, seen)
    elif isinstance(value, list | tuple):
        assert type(value) in (list, tuple)
        for item in value:
            assert_inert(item, seen)
    elif isinstance(value, np.ndarray):
        assert type(value) is np.ndarray
        for item in value.ravel().tolist():
            assert_inert(item, seen)
    else:
        assert type(value) in (str, int, float, bool, bytes, type(None))


@pytest.mark.parametrize("name", harmless())
def test_harmless_ones_come_back_as_inert_data(name, tmp_path):
    value = tried(harmless()[name], tmp_path, load_pickle)
    if name != "more after the end":
        assert value is not None
    assert_inert(value, set())
    assert tried(as_npy(harmless()[name]), tmp_path, load_npy) is None  # no array, as its header promises


def test_honest_data_with_much_in_it_is_read(tmp_path):
    """Nothing that real files hold comes near the limits."""
    rng = np.random.default_rng(0)
    frames = [
        {
            "img_path": f"0011_02/{k:06d}.png",
            "h_w": (1080, 1920),
            "0": {"pose": rng.normal(size=72), "betas": rng.normal(size=10).tolist(), "trans": np.float32(k)},
        }
        for k in range(500)
    ]
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        data = pickle.dumps([frames, frames], protocol)
        value = tried(data, tmp_path, load_pickle)
        assert isinstance(value, list)
        np.testing.assert_array_equal(value[1][-1]["0"]["pose"], frames[-1]["0"]["pose"])
        assert value[0][7]["0"]["betas"] == frames[7]["0"]["betas"]


# ------------------------------------------------------------------------------------------ .npy headers


def headers() -> dict[str, bytes]:
    usual = {"descr": "<f8", "fortran_order": False, "shape": (1,)}
    return {
        "a shape of 2**40": npy_header(usual | {"shape": (2**40,)}) + bytes(8),
        "a shape of 2**40 objects": npy_header(usual | {"shape": (2**40,), "descr": "|O"}) + b"]" + STOP,
        "a shape of empty texts": npy_header(usual | {"shape": (2**60,), "descr": "<U0"}),
        "a shape of void": npy_header(usual | {"shape": (2**60,), "descr": "|V0"}),
        "an empty giant that fits": npy_header(usual | {"shape": (0, 2**62)}),
        "a negative shape": npy_header(usual | {"shape": (-1,)}) + bytes(8),
        "a shape of truth": npy_header(usual | {"shape": (True,)}) + bytes(8),
        "a subarray": npy_header(usual | {"descr": ("<f8", (2,))}) + bytes(16),
        "an object in a structure": npy_header(usual | {"descr": [("a", "|O")]}) + bytes(8),
        "a call": npy_header("{'descr': __import__('os').system('true'), 'fortran_order': False, 'shape': ()}"),
        "many signs": npy_header("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "-" * 9000 + "1,)}"),
        "a power": npy_header("{'descr': '<f8', 'fortran_order': False, 'shape': (9**9**9,)}"),
        "a huge descr": npy_header(usual | {"descr": "<U99999999999"}),
        "a header of another length": b"\x93NUMPY\x01\x00\xff\xff{}",
    }


@pytest.mark.parametrize("name", headers())
def test_hostile_headers_are_bad_input(name, tmp_path):
    assert tried(headers()[name], tmp_path, load_npy) is None


def test_a_structured_array_of_numbers_is_plain_data(tmp_path):
    table = np.array([(1, 2.5), (3, 4.5)], [("a", "<i4"), ("b", "<f8")])
    np.save(tmp_path / "table.npy", table)
    np.testing.assert_array_equal(load_npy(tmp_path / "table.npy"), table)
