"""Read pickles without running what they say: SMPL model files, and the `.npy`/`.pkl` files of capture data sets.

A pickle is a program. This reader executes it with nothing to call but a handful of functions of its own, which can
only build plain Python values and numpy arrays of numbers, text or objects. chumpy and scipy.sparse objects, which
old SMPL files hold, come back as inert `ForeignObject`s that carry their state.

Nor can a small file keep the reader or its caller busy: what shared references multiply is counted and bounded,
keys are looked at before they are hashed, and nothing is allocated that the file does not hold.
"""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from ihbench.errors import BadInput
from ihbench.files.regular import opened


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


def _check_key(key: object) -> None:
    """Hashing a tuple takes time and C stack for everything below it: only small ones may be keys."""
    if type(key) in _LEAF_TYPES:
        return
    waiting, parts = [key], 0
    while waiting:
        part = waiting.pop()
        parts += 1
        if isinstance(part, tuple) and parts + len(waiting) + len(part) <= _KEY_PARTS:
            waiting.extend(part)
        elif not isinstance(part, _KEY_TYPES):
            raise pickle.UnpicklingError("refused a key that is not plain, or too large")


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
        raise pickle.UnpicklingError("refused a text encoding that is not latin1")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """How python 3 writes b"" for python 2."""
    return b""


def _set(items: list | tuple = ()) -> set:
    if not isinstance(items, list | tuple):
        raise pickle.UnpicklingError("refused a set of something that is not a list")
    for item in items:
        _check_key(item)
    return set(items)


def _ordered_dict(pairs: list | tuple = ()) -> dict:
    if not isinstance(pairs, list | tuple):
        raise pickle.UnpicklingError("refused a dictionary of something that is not a list")
    for key, _value in pairs:
        _check_key(key)
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

# What shared references may multiply. Honest files stay far below: they share little.
_COPIED_BYTES, _COPIED_BYTES_A_FILE_BYTE = 2**20, 64
_EXPANDED_VALUES, _EXPANDED_A_STORED_ONE = 10**6, 100
_BYTES_AN_ITEM, _BYTES_A_CLASS = 64, 2000
_KEY_PARTS = 1000
_LEAF_TYPES = frozenset((float, int, str, bytes, bool, type(None)))
_KEY_TYPES = (str, bytes, int, float, complex, type(None), np.generic, frozenset, ForeignObject)


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


def _checking_keys(opcode: bytes, step: int) -> Callable:
    """The opcode that hashes every `step`-th item above the mark, with a look at those before."""
    plain = _PythonUnpickler.dispatch[opcode[0]]

    def load(self: SafeUnpickler) -> None:
        for key in self.stack[::step]:
            _check_key(key)
        plain(self)

    return load


class SafeUnpickler(_PythonUnpickler):
    """An unpickler that can only build plain values, numpy arrays and `ForeignObject`s."""

    dispatch: ClassVar[dict[int, Callable]] = dict(_PythonUnpickler.dispatch)

    def __init__(self, data: io.BytesIO, **options: Any):
        super().__init__(data, **options)
        self._allowance = _COPIED_BYTES + _COPIED_BYTES_A_FILE_BYTE * data.getbuffer().nbytes
        self._foreign: dict[tuple[str, str], type] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        if any(module == package or module.startswith(package + ".") for package in _INERT_PACKAGES):
            if (module, name) not in self._foreign:
                self._spend(_BYTES_A_CLASS)
                self._foreign[module, name] = type(name, (ForeignObject,), {"kind": f"{module}.{name}"})
            return self._foreign[module, name]
        raise pickle.UnpicklingError(f"refused: the file asks for {module}.{name}")

    def load(self) -> Any:
        """The value in the pickle, with real numpy arrays in it."""
        value = _resolve(super().load(), {}, self._spend)
        _check_expansion(value)
        return value

    def _spend(self, size: int) -> None:
        """Count bytes that are about to be copied from what the file may name again and again."""
        self._allowance -= size
        if self._allowance < 0:
            raise pickle.UnpicklingError("refused: a small file that grows too large")

    def _spend_on(self, value: object) -> None:
        if isinstance(value, str | bytes | bytearray):
            self._spend(len(value))
        elif isinstance(value, list | tuple | dict | set | frozenset):
            self._spend(_BYTES_AN_ITEM * len(value))

    def _load_reduce(self) -> None:
        """A call gets a copy of its arguments, and some of what can be called copies them again."""
        arguments = self.stack[-1]
        self._spend_on(arguments)
        if isinstance(arguments, tuple):
            for argument in arguments:
                self._spend_on(argument)
        _PythonUnpickler.load_reduce(self)

    def _load_newobj(self) -> None:
        self._spend_on(self.stack[-1])
        _PythonUnpickler.load_newobj(self)

    def _load_setitem(self) -> None:
        _check_key(self.stack[-2])
        _PythonUnpickler.load_setitem(self)

    def _refuse(self) -> None:
        raise pickle.UnpicklingError("refused: an opcode that no data file needs")

    def _load_build(self) -> None:
        """BUILD sets attributes of whatever lies on the stack; here only records and foreign objects take a state."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, _ArrayRecord | _DtypeRecord):
            target.set_state(state)
        elif isinstance(target, ForeignObject):
            for part in state[:2] if isinstance(state, tuple) else (state,):  # attributes, then slots
                if isinstance(part, dict):
                    self._spend_on(part)
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
    dispatch[pickle.REDUCE[0]] = _load_reduce
    dispatch[pickle.NEWOBJ[0]] = _load_newobj
    dispatch[pickle.SETITEM[0]] = _load_setitem
    for _opcode, _step in ((pickle.SETITEMS, 2), (pickle.DICT, 2), (pickle.ADDITEMS, 1), (pickle.FROZENSET, 1)):
        dispatch[_opcode[0]] = _checking_keys(_opcode, _step)
    for _opcode in (
        *(pickle.EXT1, pickle.EXT2, pickle.EXT4),
        *(pickle.PERSID, pickle.BINPERSID, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER, pickle.NEWOBJ_EX),
    ):
        dispatch[_opcode[0]] = _refuse


_UNFINISHED: Any = object()


def _resolve(value: Any, done: dict[int, tuple[Any, Any]], spend: Callable[[int], None]) -> Any:
    """Replace the array records in a value by arrays. `done` maps id -> (original, result), so that a value shared in
    many places is visited once; it holds the original, too, to keep its id taken."""
    if not isinstance(value, list | dict | tuple | _ArrayRecord | _DtypeRecord | ForeignObject):
        if isinstance(value, type) or callable(value) or isinstance(value, _NdarrayClass):
            raise pickle.UnpicklingError("expected data, found a function")
        return value
    if id(value) in done:
        if done[id(value)][1] is _UNFINISHED:
            raise pickle.UnpicklingError("refused an array or a tuple that holds itself")
        return done[id(value)][1]
    done[id(value)] = (value, _UNFINISHED if isinstance(value, tuple | _ArrayRecord) else value)
    if isinstance(value, list):
        value[:] = [_resolve(item, done, spend) for item in value]
    elif isinstance(value, dict):
        for key in value:
            value[key] = _resolve(value[key], done, spend)
    elif isinstance(value, ForeignObject):
        _resolve(value.state, done, spend)
    elif isinstance(value, tuple):
        done[id(value)] = (value, tuple([_resolve(item, done, spend) for item in value]))
    elif isinstance(value, _ArrayRecord):
        done[id(value)] = (value, _build_array(value, done, spend))
    elif isinstance(value, _DtypeRecord):
        done[id(value)] = (value, value.resolve())
    return done[id(value)][1]


def _build_array(record: _ArrayRecord, done: dict[int, tuple[Any, Any]], spend: Callable[[int], None]) -> np.ndarray:
    shape, dtype_record, fortran, data = record.state
    if not isinstance(shape, tuple) or not all(type(n) is int and 0 <= n < 2**63 for n in shape) or len(shape) > 32:
        raise pickle.UnpicklingError("the shape of an array is not a few whole numbers")
    if not isinstance(dtype_record, _DtypeRecord):
        raise pickle.UnpicklingError("an array has no numpy dtype")
    dtype = dtype_record.resolve()
    count = math.prod(shape)
    order = "F" if fortran else "C"
    if dtype.hasobject:
        if not isinstance(data, list) or len(data) != count:
            raise pickle.UnpicklingError(f"an object array of shape {shape} does not hold {count} objects")
        spend(8 * count)
        flat = np.empty(count, object)
        for i, item in enumerate(data):
            flat[i] = _resolve(item, done, spend)
        return flat.reshape(shape, order=order)
    spend(len(data) if isinstance(data, str) else 0)
    raw = _as_bytes(data)
    if len(raw) != count * dtype.itemsize or (count and not dtype.itemsize):
        raise pickle.UnpicklingError(
            f"an array of shape {shape} and {dtype} needs {count * dtype.itemsize} bytes, the file has {len(raw)}"
        )
    spend(len(raw))
    array = np.frombuffer(raw, dtype, count) if count else np.zeros(0, dtype)
    native = dtype.newbyteorder("=")
    return np.array(array.reshape(shape, order=order), dtype=native, order=order)


def _check_expansion(value: Any) -> None:
    """Refuse a few values that refer to each other so often that walking through them would never end."""
    sizes: dict[int, int] = {}  # id of a container -> values in it, shared ones counted wherever they occur
    stored = 0

    def expanded(value: Any) -> int:
        nonlocal stored
        if type(value) in _LEAF_TYPES:
            return 1
        if isinstance(value, list | tuple | set | frozenset):
            parts: Any = value
        elif isinstance(value, dict):
            parts = value.values()
        elif isinstance(value, ForeignObject):
            parts = value.state.values()
        elif isinstance(value, np.ndarray) and value.dtype.hasobject:
            parts = value.ravel().tolist()
        else:
            return 1
        if id(value) not in sizes:
            sizes[id(value)] = 1  # a value that holds itself counts once
            stored += len(parts)
            sizes[id(value)] += sum([expanded(part) for part in parts])
        return sizes[id(value)]

    if expanded(value) > _EXPANDED_VALUES + _EXPANDED_A_STORED_ONE * stored:
        raise pickle.UnpicklingError("refused: a few values, referred to so often that they stand for too many")


def _unpickle(stream: IO[bytes], path: Path) -> Any:
    # in memory, so that a length that goes past the end of the file is cut to it before anything is allocated
    data = io.BytesIO(stream.read())
    try:
        # latin1 maps the bytes of python-2 strings one to one
        return SafeUnpickler(data, encoding="latin1").load()
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
    array = np.frombuffer(data, dtype, count) if count else np.zeros(0, dtype)
    return array.reshape(shape, order="F" if fortran else "C").copy(order="K")


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
