"""Write pickles byte by byte as python 2 and old numpy wrote them, with objects of absent libraries in them."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Instance:
    """An old-library object: its module, class name and attributes."""

    module: str
    name: str
    state: dict[str, Any] = field(default_factory=dict)


def dumps(value: Any, protocol: int = 2) -> bytes:
    """The pickle of a value in python 2's protocol 0 (text) or 2 (binary)."""
    return (b"\x80\x02" if protocol == 2 else b"") + encode(value, protocol) + b"."


def encode(value: Any, protocol: int) -> bytes:
    def sub(item: Any) -> bytes:
        return encode(item, protocol)

    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"I01\n" if value else b"I00\n"
    if isinstance(value, int):
        return b"I%d\n" % value
    if isinstance(value, float):
        return b"F%s\n" % repr(value).encode()
    if isinstance(value, str):
        return sub(value.encode("latin1"))
    if isinstance(value, bytes):
        if protocol == 0:
            return b"S" + repr(value)[1:].encode() + b"\n"
        return b"T" + struct.pack("<i", len(value)) + value
    if isinstance(value, tuple):
        return b"(" + b"".join(map(sub, value)) + b"t"
    if isinstance(value, list):
        return b"(l" + b"".join(sub(item) + b"a" for item in value)
    if isinstance(value, dict):
        return b"(d" + b"".join(sub(key) + sub(item) + b"s" for key, item in value.items())
    if isinstance(value, np.dtype):
        state = (3, "|" if value.itemsize == 1 else value.str[0], None, None, None, -1, -1, 0)
        return b"cnumpy\ndtype\n" + sub((value.str[1:], 0, 1)) + b"R" + sub(state) + b"b"
    if isinstance(value, np.ndarray):
        fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        data = list(value.ravel()) if value.dtype.hasobject else value.tobytes("F" if fortran else "C")
        make = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n" + sub((0,)) + sub("b") + b"tR"
        return make + sub((1, value.shape, value.dtype, fortran, data)) + b"b"
    if isinstance(value, Instance):
        where = f"c{value.module}\n{value.name}\n".encode()
        return b"ccopy_reg\n_reconstructor\n(" + where + b"c__builtin__\nobject\nNtR" + sub(value.state) + b"b"
    raise TypeError(type(value))
