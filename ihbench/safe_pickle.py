"""Read pickles without running what they say: SMPL model files, and the `.npy`/`.pkl` files of capture data sets.

A pickle is a program. This reader executes it with nothing to call but a handful of functions of its own, which can
only build plain Python values and numpy arrays of numbers, text or objects. chumpy and scipy.sparse objects, which
old SMPL files hold, come back as inert `ForeignObject`s that carry their state.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ihbench.errors import BadInput


class ForeignObject:
    """Stands for an object of a library this reader never imports: its full name and its attributes."""

    kind: str = ""  # e.g. "chumpy.ch.Ch"
    state: dict[str, Any]

    def __new__(cls, *_args: object) -> ForeignObject:
        self = super().__new__(cls)
        self.state = {}
        return self


class _DtypeRecord:
    """A numpy dtype as a pickle spells it, checked before numpy sees it."""

    def __init__(self, name: str, *_flags: object):
        if not isinstance(name, str):
            raise pickle.UnpicklingError("refused a structured numpy dtype")
        self.name = name
        self.order = "="

    def set_state(self, state: tuple) -> None:
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

    def set_state(self, state: tuple) -> None:
        self.state = state[-4:]  # a version number may stand before them


class _NdarrayClass:
    """What the name `numpy.ndarray` becomes: a token for `_reconstruct`, nothing that can be called."""


def _reconstruct(cls: object, _shape: object, _typecode: object) -> _ArrayRecord:
    if cls is not _NDARRAY:
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
        raise pickle.UnpicklingError(f"refused text encoding {encoding!r}")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """How python 3 writes b"" for python 2."""
    return b""


def _set(items: list | tuple = ()) -> set:
    if not isinstance(items, list | tuple):
        raise pickle.UnpicklingError("refused a set of something that is not a list")
    return set(items)


def _ordered_dict(pairs: list | tuple = ()) -> dict:
    if not isinstance(pairs, list | tuple):
        raise pickle.UnpicklingError("refused a dictionary of something that is not a list")
    return {key: value for key, value in pairs}


def _object() -> None:
    """`object` is only ever named as the base class of `_reconstructor`."""


_NDARRAY = _NdarrayClass()
_NUMPY_CORES = ("numpy.core", "numpy._core")
_ALLOWED: dict[tuple[str, str], object] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _DtypeRecord,
    **{(f"{core}.multiarray", "_reconstruct"): _reconstruct for core in _NUMPY_CORES},
    **{(f"{core}.multiarray", "scalar"): _scalar for core in _NUMPY_CORES},
    **{(f"{core}.numeric", "_frombuffer"): _frombuffer for core in _NUMPY_CORES},
    **{(module, "_reconstructor"): _reconstructor for module in ("copy_reg", "copyreg")},
    **{(module, "object"): _object for module in ("__builtin__", "builtins")},
    **{(module, "bytes"): _empty_bytes for module in ("__builtin__", "builtins")},
    **{(module, "set"): _set for module in ("__builtin__", "builtins")},
    ("collections", "OrderedDict"): _ordered_dict,
    ("_codecs", "encode"): _encode,
}
_INERT_PACKAGES = ("chumpy", "scipy.sparse")


def _as_bytes(data: object) -> bytes | bytearray:
    """Raw array bytes; a python-2 pickle read as latin1 hands them over as text."""
    if isinstance(data, str):
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray):
        return data
    raise pickle.UnpicklingError("expected the bytes of a numpy array")


# The pure-Python unpickler, because its opcodes can be replaced, its memo is a dictionary (the C one allocates as
# many slots as the highest index a file names) and the extension registry, which bypasses `find_class`, can be shut.
_PythonUnpickler: Any = pickle._Unpickler  # pyright: ignore[reportAttributeAccessIssue]


class SafeUnpickler(_PythonUnpickler):
    """An unpickler that can only build plain values, numpy arrays and `ForeignObject`s."""

    dispatch: ClassVar[dict[int, Callable]] = dict(_PythonUnpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        if any(module == package or module.startswith(package + ".") for package in _INERT_PACKAGES):
            return type(name, (ForeignObject,), {"kind": f"{module}.{name}"})
        raise pickle.UnpicklingError(f"refused: the file asks for {module}.{name}")

    def load(self) -> Any:
        """The value in the pickle, with real numpy arrays in it."""
        return _resolve(super().load(), {})

    def _refuse(self) -> None:
        raise pickle.UnpicklingError("refused: an opcode that no data file needs")

    def _load_build(self) -> None:
        """BUILD sets attributes of whatever lies on the stack; here only records and foreign objects take a state."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, _ArrayRecord | _DtypeRecord):
            target.set_state(state)
        elif isinstance(target, ForeignObject):
            for part in state if isinstance(state, tuple) else (state,):
                if isinstance(part, dict):
                    target.state.update(part)
        else:
            raise pickle.UnpicklingError(f"refused to change a {type(target).__name__}")

    def _load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        data = self.read(size)
        if len(data) != size:
            raise pickle.UnpicklingError("pickle data was truncated")
        self.append(bytearray(data))

    dispatch[pickle.BUILD[0]] = _load_build
    dispatch[pickle.BYTEARRAY8[0]] = _load_bytearray8
    for _opcode in (
        *(pickle.EXT1, pickle.EXT2, pickle.EXT4),
        *(pickle.PERSID, pickle.BINPERSID, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER),
    ):
        dispatch[_opcode[0]] = _refuse


def _resolve(value: Any, done: dict[int, tuple[Any, Any]]) -> Any:
    """Replace the array records in a value by arrays. `done` maps id -> (original, result), so that a value shared in
    many places is visited once; it holds the original, too, to keep its id taken."""
    if not isinstance(value, list | dict | tuple | set | _ArrayRecord | _DtypeRecord | ForeignObject):
        if isinstance(value, type) or callable(value) or isinstance(value, _NdarrayClass):
            raise pickle.UnpicklingError("expected data, found a function")
        return value
    if id(value) in done:
        return done[id(value)][1]
    done[id(value)] = (value, value)
    if isinstance(value, list):
        value[:] = [_resolve(item, done) for item in value]
    elif isinstance(value, dict):
        for key in value:
            value[key] = _resolve(value[key], done)
    elif isinstance(value, ForeignObject):
        _resolve(value.state, done)
    elif isinstance(value, tuple):
        done[id(value)] = (value, tuple(_resolve(item, done) for item in value))
    elif isinstance(value, _ArrayRecord):
        done[id(value)] = (value, _build_array(value, done))
    elif isinstance(value, _DtypeRecord):
        done[id(value)] = (value, value.resolve())
    return done[id(value)][1]


def _build_array(record: _ArrayRecord, done: dict[int, tuple[Any, Any]]) -> np.ndarray:
    shape, dtype_record, fortran, data = record.state
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"an array has shape {shape!r}")
    if not isinstance(dtype_record, _DtypeRecord):
        raise pickle.UnpicklingError("an array has no numpy dtype")
    dtype = dtype_record.resolve()
    count = math.prod(shape)
    order = "F" if fortran else "C"
    if dtype.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise pickle.UnpicklingError(f"an object array of shape {shape} does not hold {count} objects")
        flat = np.empty(count, object)
        for i, item in enumerate(data):
            flat[i] = _resolve(item, done)
        return flat.reshape(shape, order=order)
    raw = _as_bytes(data)
    if len(raw) != count * dtype.itemsize:
        raise pickle.UnpicklingError(
            f"an array of shape {shape} and {dtype} needs {count * dtype.itemsize} bytes, the file has {len(raw)}"
        )
    array = np.frombuffer(raw, dtype, count) if count and dtype.itemsize else np.zeros(count, dtype)
    native = dtype.newbyteorder("=")
    return np.array(array.reshape(shape, order=order), dtype=native, order=order)


def _unpickle(stream: io.BufferedIOBase, path: Path) -> Any:
    # in memory, so that a length that goes past the end of the file is cut to it before anything is allocated
    data = io.BytesIO(stream.read())
    try:
        # latin1 maps the bytes of python-2 strings one to one
        return SafeUnpickler(data, encoding="latin1").load()
    except Exception as error:
        # a broken or hostile program can fail in any way: what is on the stack need not be what an opcode expects
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BadInput(
            f"{path}: cannot be read as a pickle of plain data ({reason}); expected an untouched, complete file"
        ) from None


def load_pickle(path: str | Path) -> Any:
    """The value in a pickle file, python 2 or 3. Nothing in the file runs.

    Raises `BadInput` when the file is missing, truncated, not a pickle, or asks for anything but plain data.
    """
    path = Path(path)
    with _open(path) as stream:
        return _unpickle(stream, path)


def load_npy(path: str | Path) -> np.ndarray:
    """The array in a `.npy` file. Arrays of objects are read by `SafeUnpickler`, never by numpy's own pickle reader.

    An object array that holds one dictionary (ZJU-MoCap's annots.npy) is 0-dimensional: take it out with `.item()`.
    Raises `BadInput` as `load_pickle` does, and when the header promises more data than the file holds.
    """
    path = Path(path)
    with _open(path) as stream:
        shape, fortran, dtype = _read_npy_header(stream, path)
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
    array = np.frombuffer(data, dtype, count) if count and dtype.itemsize else np.zeros(count, dtype)
    return array.reshape(shape, order="F" if fortran else "C").copy(order="K")


def _read_npy_header(stream: io.BufferedIOBase, path: Path) -> tuple[tuple[int, ...], bool, np.dtype]:
    readers: dict[tuple[int, int], Callable] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    try:
        return readers[np.lib.format.read_magic(stream)](stream)
    except (ValueError, KeyError, EOFError):
        raise BadInput(f"{path}: not a numpy .npy file, or its header is damaged; copy the file again") from None


def _open(path: Path) -> io.BufferedReader:
    try:
        return path.open("rb")
    except OSError as error:
        raise BadInput(f"{path}: cannot be opened ({error.strerror}); check the path") from None
