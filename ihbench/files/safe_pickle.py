"""Read pickles without running what they say: SMPL model files, and the `.npy`/`.pkl` files of capture data sets.

A pickle is a program. This reader executes it with nothing to call but a handful of functions of its own, which can
only build plain Python values and numpy arrays of numbers, text or objects. chumpy and scipy.sparse objects, which
old SMPL files hold, come back as inert `ForeignObject`s that carry their state.

Memory is bounded by the file's size: nothing is allocated that the file does not hold, and bytes that are copied
again and again are counted, and tuples nest only so deep: hashing one goes down all of it, in C. A file that is made
to be slow can still be that.
"""

from __future__ import annotations

import io
import math
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from ihbench.errors import BadInput
from ihbench.files.regular import opened

LARGEST = 4 * 2**30  # bytes of a file
DEEPEST = 1000  # tuple in a tuple
GROWTH = 64  # bytes copied for each byte of a file, at most: honest files share little, and stay far below


class ForeignObject:
    """Stands for an object of a library this reader never imports: its full name and its attributes."""

    kind: str = ""  # e.g. "chumpy.ch.Ch"
    state: dict[str, Any]

    def __new__(cls, *_args: object) -> ForeignObject:
        self = super().__new__(cls)
        self.state = {}
        return self

    def __setstate__(self, state: object) -> None:
        for part in state[:2] if isinstance(state, tuple) else (state,):  # attributes, or else slots
            if isinstance(part, dict) and part:
                self.state = part


class _DtypeRecord:
    """A numpy dtype as a pickle spells it, checked before numpy sees it."""

    def __init__(self, name: str, *_flags: object):
        if not isinstance(name, str):
            raise pickle.UnpicklingError("refused a structured numpy dtype")
        self.name = name
        self.order = "="

    def __setstate__(self, state: tuple) -> None:
        _version, order, subarray, names, fields = state[:5]
        if subarray is not None or names is not None or fields is not None or order not in ("<", ">", "=", "|"):
            raise pickle.UnpicklingError("refused a structured numpy dtype")
        self.order = order

    def resolve(self) -> np.dtype:
        dtype = np.dtype("O") if self.name[:1] == "O" else np.dtype(self.name)
        if dtype.kind not in "biufcSUO" or dtype.fields is not None or dtype.subdtype is not None:
            raise pickle.UnpicklingError(f"refused numpy dtype {self.name!r}")
        return dtype.newbyteorder(">") if self.order == ">" else dtype


class _ArrayRecord:
    """A numpy array as a pickle spells it; becomes a real one when its size is known to match its bytes."""

    def __init__(self) -> None:
        self.state: tuple = ((0,), _DtypeRecord("u1"), False, b"")

    def __setstate__(self, state: tuple) -> None:
        self.state = state[-4:]  # a version number may stand before them


def _ndarray() -> None:
    """`numpy.ndarray` is only ever named for `_reconstruct`."""
    raise pickle.UnpicklingError("refused to call numpy.ndarray")


def _reconstruct(cls: object, _shape: object, _typecode: object) -> _ArrayRecord:
    if not isinstance(cls, _Allowed) or cls.function is not _ndarray:
        raise pickle.UnpicklingError("refused an array of another class than numpy.ndarray")
    return _ArrayRecord()


def _frombuffer(buffer: object, dtype: _DtypeRecord, shape: tuple, order: str) -> _ArrayRecord:
    record = _ArrayRecord()
    record.state = (shape, dtype, order == "F", buffer)
    return record


def _scalar(dtype: _DtypeRecord, data: object = b"") -> Any:
    real = dtype.resolve()
    raw = _as_bytes(data)
    if real.hasobject or len(raw) != real.itemsize:
        raise pickle.UnpicklingError("a numpy scalar does not have the size of its dtype")
    return np.frombuffer(raw, real)[0] if real.itemsize else real.type()


def _reconstructor(cls: type, _base: object, _state: object) -> ForeignObject:
    if not (isinstance(cls, type) and issubclass(cls, ForeignObject)):
        raise pickle.UnpicklingError("refused an object of an unknown class")
    return cls()


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("refused a text encoding that is not latin1")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """How python 3 writes b"" for python 2."""
    return b""


def _object() -> None:
    """`object` is only ever named as the base class of `_reconstructor`."""


_NUMPY_CORES = ("numpy.core", "numpy._core")
_ALLOWED: dict[tuple[str, str], Callable] = {
    ("numpy", "ndarray"): _ndarray,
    ("numpy", "dtype"): _DtypeRecord,
    **{(f"{core}.multiarray", "_reconstruct"): _reconstruct for core in _NUMPY_CORES},
    **{(f"{core}.multiarray", "scalar"): _scalar for core in _NUMPY_CORES},
    **{(f"{core}.numeric", "_frombuffer"): _frombuffer for core in _NUMPY_CORES},
    **{(module, "_reconstructor"): _reconstructor for module in ("copy_reg", "copyreg")},
    **{(module, "object"): _object for module in ("__builtin__", "builtins")},
    **{(module, "bytes"): _empty_bytes for module in ("__builtin__", "builtins")},
    **{(module, "set"): set for module in ("__builtin__", "builtins")},
    ("collections", "OrderedDict"): dict,
    ("_codecs", "encode"): _encode,
}
_INERT_PACKAGES = ("chumpy", "scipy.sparse")
_LEAVES = (str, bytes, bytearray, int, float, complex, type(None), np.generic)
_TUPLES = (pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3)
_REFUSED = (pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.NEWOBJ_EX)  # no data file needs these


def _as_bytes(data: object) -> bytes | bytearray:
    """Raw array bytes; a python-2 pickle read as latin1 hands them over as text."""
    if isinstance(data, str):
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray):
        return data
    raise pickle.UnpicklingError("expected the bytes of a numpy array")


class _Allowed:
    """A function that a pickle may call, and nothing else: BUILD cannot change it."""

    __slots__ = ("function", "spend")

    def __init__(self, function: Callable, spend: Callable[[object], None]):
        self.function, self.spend = function, spend

    def __call__(self, *arguments: object) -> Any:
        for argument in arguments:
            self.spend(argument)
        return self.function(*arguments)

    def __setstate__(self, _state: object) -> None:
        raise pickle.UnpicklingError("refused to change a function")


def _shallow(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """An opcode that makes a tuple, of no more than `DEEPEST` others in each other."""

    def loaded(self: Any) -> None:
        load(self)
        made, depth = self.stack[-1], self._depth
        depth[id(made)] = 1 + max((depth.get(id(part), 0) for part in made if type(part) is tuple), default=0)
        if depth[id(made)] > DEEPEST:
            raise pickle.UnpicklingError("refused: tuples nested too deeply")

    return loaded


_UNFINISHED: Any = object()


class SafeUnpickler(pickle._Unpickler):  # in Python: it allocates nothing that the file does not hold
    """An unpickler that can only build plain values, numpy arrays and `ForeignObject`s."""

    dispatch: ClassVar = {
        code: _shallow(load) if bytes([code]) in _TUPLES else load
        for code, load in pickle._Unpickler.dispatch.items()
        if bytes([code]) not in _REFUSED
    }

    def __init__(self, data: bytes):
        super().__init__(io.BytesIO(data), encoding="latin1")  # maps the bytes of python-2 strings one to one
        self._bytes = 2**20 + GROWTH * len(data)
        self._most = self._bytes  # values, however often they are shared
        self._values: dict[int, int] = {}  # in the result of a shared container, by its id
        self._depth: dict[int, int] = {}  # by id of a tuple; one that takes a freed one's id takes its place here
        self._foreign: dict[tuple[str, str], type] = {}
        # id -> (original, result), so that a value shared in many places is visited once; the original is there to
        # keep its id taken
        self._done: dict[int, tuple[Any, Any]] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _Allowed(_ALLOWED[module, name], self._spend)
        if any(module == package or module.startswith(package + ".") for package in _INERT_PACKAGES):
            kind = {"kind": f"{module}.{name}"}
            return self._foreign.setdefault((module, name), type(name, (ForeignObject,), kind))
        raise pickle.UnpicklingError(f"refused: the file asks for {module}.{name}")

    def load(self) -> Any:
        """The value in the pickle, with real numpy arrays in it."""
        return self._resolve(super().load())

    def _spend(self, value: object) -> None:
        """Count bytes that are about to be copied from what the file may name again and again."""
        if isinstance(value, str | bytes | bytearray):
            self._bytes -= len(value)
        elif isinstance(value, list | tuple | dict | set | frozenset):
            self._bytes -= 64 * len(value)
        if self._bytes < 0:
            raise pickle.UnpicklingError("refused: a small file that grows too large")

    def _resolve(self, value: Any) -> Any:
        """The value with arrays in the place of records."""
        if isinstance(value, _LEAVES):
            return value
        if id(value) not in self._done:
            open_ended = isinstance(value, list | dict | ForeignObject)  # these may hold themselves
            self._done[id(value)] = value, value if open_ended else _UNFINISHED
            self._done[id(value)] = value, self._resolved(value)
            self._count(value)
        result = self._done[id(value)][1]
        if result is _UNFINISHED:
            raise pickle.UnpicklingError("refused an array or a tuple that holds itself")
        return result

    def _count(self, value: Any) -> None:
        """Refuse a value that shares its parts so often that walking it would never end."""
        data = value.state[-1] if isinstance(value, _ArrayRecord) else value
        parts = data.values() if isinstance(data, dict) else data if isinstance(data, list | tuple) else ()
        self._values[id(value)] = count = 1 + sum(self._values.get(id(part), 1) for part in parts)
        if count > self._most:
            raise pickle.UnpicklingError("refused: a small file that grows too large")

    def _resolved(self, value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(self._resolve, value))
        if isinstance(value, list):
            value[:] = map(self._resolve, value)
        elif isinstance(value, dict):
            _check_keys(value)
            for key in value:
                value[key] = self._resolve(value[key])
        elif isinstance(value, set | frozenset):
            _check_keys(value)
        elif isinstance(value, ForeignObject):
            self._resolve(value.state)
        elif isinstance(value, _ArrayRecord):
            return self._array(*value.state)
        elif isinstance(value, _DtypeRecord):
            return value.resolve()
        else:
            raise pickle.UnpicklingError("expected data, found a function")
        return value

    def _array(self, shape: Any, record: Any, fortran: Any, data: Any) -> np.ndarray:
        if (
            not isinstance(shape, tuple)
            or not all(type(n) is int and 0 <= n < 2**63 for n in shape)
            or len(shape) > 32
        ):
            raise pickle.UnpicklingError("the shape of an array is not a few whole numbers")
        if not isinstance(record, _DtypeRecord):
            raise pickle.UnpicklingError("an array has no numpy dtype")
        dtype, count, order = record.resolve(), math.prod(shape), "F" if fortran else "C"
        self._spend(data)
        if dtype.hasobject:
            if not isinstance(data, list) or len(data) != count:
                raise pickle.UnpicklingError(f"an object array of shape {shape} does not hold {count} objects")
            flat = np.empty(count, object)
            for i, item in enumerate(data):
                flat[i] = self._resolve(item)
            return flat.reshape(shape, order=order)
        raw = _as_bytes(data)
        if len(raw) != count * dtype.itemsize or (count and not dtype.itemsize):
            raise pickle.UnpicklingError(
                f"an array of shape {shape} and {dtype} needs {count * dtype.itemsize} bytes, the file has {len(raw)}"
            )
        array = np.frombuffer(raw, dtype, count) if count else np.zeros(0, dtype)
        return np.array(array.reshape(shape, order=order), dtype=dtype.newbyteorder("="), order=order)


def _check_keys(keys: Any) -> None:
    for key in keys:
        if not all(
            isinstance(part, (*_LEAVES, ForeignObject)) for part in (key if isinstance(key, tuple) else [key])
        ):
            raise pickle.UnpicklingError("refused a key that is not plain")


def _unpickle(stream: IO[bytes], path: Path) -> Any:
    if os.fstat(stream.fileno()).st_size > LARGEST:
        raise BadInput(f"{path}: larger than {LARGEST // 2**30} GiB; expected a pickle of plain data")
    try:
        return SafeUnpickler(stream.read()).load()
    except Exception as error:
        # a broken or hostile program can fail in any way: what is on the stack need not be what an opcode expects
        reason = " ".join(str(error)[:200].split()) or type(error).__name__
        raise BadInput(
            f"{path}: cannot be read as a pickle of plain data ({reason}); expected an untouched, complete file"
        ) from None


def load_pickle(path: str | Path) -> Any:
    """The value in a pickle file, python 2 or 3. Nothing in the file runs.

    Raises `BadInput` when the file is missing, truncated, not a pickle, or asks for anything but plain data.
    """
    path = Path(path)
    with opened(path) as stream:
        return _unpickle(stream, path)


def load_npy(path: str | Path) -> np.ndarray:
    """The array in a `.npy` file. Arrays of objects are read by `SafeUnpickler`, never by numpy's own pickle reader.

    An object array that holds one dictionary (ZJU-MoCap's annots.npy) is 0-dimensional: take it out with `.item()`.
    Raises `BadInput` as `load_pickle` does, and when the header promises more data than the file holds.
    """
    path = Path(path)
    with opened(path) as stream:
        shape, fortran, dtype = read_npy_header(stream, path)
        if dtype.hasobject:
            value = _unpickle(stream, path)
            if not isinstance(value, np.ndarray) or value.shape != shape:
                raise BadInput(f"{path}: expected the {shape} object array its header promises, found something else")
            return value
        count = math.prod(shape)
        data = stream.read()
        if len(data) < count * dtype.itemsize:
            raise BadInput(
                f"{path}: truncated, its header promises {count * dtype.itemsize} bytes of {dtype} {shape} "
                f"and {len(data)} follow; copy the file again"
            )
    return np.ndarray(shape, dtype, data, order="F" if fortran else "C").copy(order="K")


def read_npy_header(stream: IO[bytes], path: str | Path) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, whether in Fortran's order, dtype) of what follows in an .npy file. Raises `BadInput`."""
    readers: dict[tuple[int, int], Callable] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    damaged = f"{path}: not a numpy .npy file, or its header is damaged; copy the file again"
    try:
        shape, fortran, dtype = readers[np.lib.format.read_magic(stream)](stream)
    except Exception:  # numpy lets the header's parser fail in its own ways: TokenError, MemoryError, TypeError, …
        raise BadInput(damaged) from None
    sound = len(shape) <= 32 and all(type(n) is int and 0 <= n < 2**63 for n in shape)
    if not sound or dtype.subdtype is not None or (dtype.itemsize == 0 and math.prod(shape)):
        raise BadInput(damaged)
    if math.prod(shape) == 0 and math.prod(n for n in shape if n) * max(1, dtype.itemsize) >= 2**63:
        raise BadInput(damaged)  # numpy makes no such array, empty or not
    return shape, fortran, dtype
