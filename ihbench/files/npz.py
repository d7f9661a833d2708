"""`.npz` files of plain arrays: nothing in them runs, and a small file cannot claim or unpack to a huge one."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.regular import opened
from ihbench.files.safe_pickle import read_npy_header

LARGEST = 2**31  # bytes of all arrays that are read
PLAIN = "biufcSU"  # kinds of dtypes: numbers, truth values and text


def read_npz(path: str | Path, names: Collection[str] | None = None, largest: int = LARGEST) -> dict[str, NDArray]:
    """The arrays by name; of `names` those that are there, without `names` all.

    Raises `BadInput` for a file that cannot be opened, is damaged, names an array twice, holds objects, or holds more
    than `largest` bytes.
    """
    arrays: dict[str, NDArray] = {}
    with opened(path, "an .npz file") as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                for entry in archive.infolist():
                    name = entry.filename.removesuffix(".npy")
                    if names is not None and name not in names:
                        continue
                    if name in arrays:
                        raise BadInput(f"{path}: has two arrays {name!r}; write the file again")
                    if entry.file_size > largest:
                        raise _too_large(path, entry.file_size, largest)
                    with archive.open(entry) as member:
                        arrays[name] = _array(member, f"{path}: {name}", largest)
                    largest -= arrays[name].nbytes
        except BadInput:
            raise
        except Exception as error:  # a damaged archive can fail in any way: zlib, lzma, encryption, its own directory
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise BadInput(
                f"{path}: cannot be read as a .npz of plain arrays ({reason}); copy or write the file again"
            ) from None
    return arrays


def write_npz(
    path: str | Path, arrays: dict[str, NDArray], *, durable: bool = True, compressed: bool = False
) -> None:
    """Write the arrays by name, the file whole or not at all (`atomic.write_bytes`)."""
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    atomic.write_bytes(Path(path), buffer.getvalue(), durable=durable)


def _array(member: IO[bytes], where: str, largest: int) -> NDArray:
    shape, fortran, dtype = read_npy_header(member, where)
    if dtype.kind not in PLAIN:
        raise BadInput(f"{where}: expected numbers or text, found {dtype}; write the file again with plain arrays")
    count = math.prod(shape)
    if count * dtype.itemsize > largest:
        raise _too_large(where, count * dtype.itemsize, largest)
    data = member.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize or member.read(1):
        raise BadInput(f"{where}: its header promises {count * dtype.itemsize} bytes, which is not what follows")
    array = np.ndarray(shape, dtype, data, order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="))


def _too_large(where: object, size: int, largest: int) -> BadInput:
    return BadInput(f"{where}: an array of {size} bytes; expected at most {largest} here")
