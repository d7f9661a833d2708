"""Saved states of a run: tensors and words in one safetensors file, whole or absent, with a checksum.

A file that is truncated or damaged is never half read. Without a folder, states live in memory.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ihbench.files.atomic import decode, encode, write_bytes
from ihbench.files.regular import read_bytes

CRC_BLANK = b'"payload_crc32":"00000000"'
LARGEST_HEADER = 2**26  # bytes of a saved state's header, events and all
STATE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}")

Tensors = dict[str, Any]  # name -> torch tensor or numpy array, of any shape
Words = dict[str, Any]  # JSON-able


def state_file(folder: Path, name: str) -> Path:
    """Where a run folder has its saved state `name`. Raises `ValueError` for a name that is no plain file name."""
    if not STATE_NAME.fullmatch(name):
        raise ValueError(f"checkpoint name: expected letters, digits and _.+-, got {name!r}")
    return folder / "checkpoints" / f"{name}.safetensors"


class States:
    """The saved states of one run, in its folder or in memory."""

    def __init__(self, folder: Path | None):
        self.folder = folder
        self._in_memory: dict[str, tuple[Tensors, Words]] = {}

    def save(self, name: str, tensors: Mapping[str, Any], words: Mapping[str, Any]) -> None:
        """Replace state `name` whole. Raises `BadInput` when the disk is full, `ValueError` for another name."""
        file = state_file(self.folder or Path(), name)
        encoded = encode(dict(words))
        if self.folder is None:
            self._in_memory[name] = _copies(tensors), encoded
        else:
            write_bytes(file, *_pack(tensors, {**encoded, "name": name, "of": self.folder.name}))

    def load(self, name: str) -> tuple[Tensors, Words] | None:
        """Tensors (as they were: torch on the CPU, or numpy) and words of state `name`, or None if there is none.
        Raises `ValueError`, or what the reader raises, when the file is damaged. Words that another run has written
        have no `events`."""
        file = state_file(self.folder or Path(), name)
        if self.folder is None:
            tensors, words = self._in_memory.get(name, (None, {}))
            return None if tensors is None else (_copies(tensors), decode(words))
        if not file.exists():
            return None
        tensors, words = _unpack(read_bytes(file))
        return tensors, decode(words if words.get("of") == self.folder.name else words | {"events": []})


def saved_meta(file: Path) -> Words:
    """The meta of a saved state's file. Raises `ValueError`, or what the reader raises, when it is damaged."""
    return decode(_unpack(read_bytes(file))[1]["meta"])


def is_saved_state(file: Path) -> bool:
    """Whether `save_state` wrote this file, under this name: a copy under another name is somebody's own."""
    try:
        with open(file, "rb") as stream:
            header = json.loads(stream.read(min(int.from_bytes(stream.read(8), "little"), LARGEST_HEADER)))
        record = json.loads(header["__metadata__"]["record"])
        return file.suffix == ".safetensors" and record.get("name", file.stem) == file.stem
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False


def _copies(tensors: Mapping[str, Any]) -> Tensors:
    """Own, contiguous copies on the CPU: what is written later cannot change, and no two share memory."""
    return {
        name: np.array(value, order="C") if isinstance(value, np.ndarray) else value.clone()
        for name, value in _plain(tensors).items()
    }


def _plain(tensors: Mapping[str, Any]) -> Tensors:
    """The same on the CPU, contiguous; not copied where they are so already. `TypeError` for anything else."""
    out: Tensors = {}
    for name, value in tensors.items():
        if hasattr(value, "detach"):
            out[name] = value.detach().cpu().contiguous()
        elif isinstance(value, np.ndarray):
            out[name] = np.ascontiguousarray(value).reshape(value.shape)  # numpy makes a vector of a single number
        else:
            raise TypeError(f"checkpoint {name}: expected a tensor or an array, got {type(value).__name__}")
    return out


def _pack(tensors: Mapping[str, Any], record: Mapping[str, Any]) -> tuple[bytes, memoryview]:
    """A safetensors file with the record and a checksum of the payload in its metadata: its header and its payload,
    which can be hundreds of megabytes."""
    values = _plain(tensors)
    arrays = [name for name, value in values.items() if isinstance(value, np.ndarray)]
    metadata = {"record": json.dumps({**record, "arrays": arrays}), "payload_crc32": "00000000"}
    if len(arrays) == len(values):
        from safetensors.numpy import save

        data = save(values, metadata)
    else:
        data = _saved_with_torch(values, metadata)
    header, payload = data[: _payload_start(data)], memoryview(data)[_payload_start(data) :]
    crc = b"%08x" % zlib.crc32(payload)
    return header.replace(CRC_BLANK, CRC_BLANK.replace(b"00000000", crc), 1), payload


def _saved_with_torch(values: Tensors, metadata: dict[str, str]) -> bytes:
    """The file's bytes. A view, and a tensor whose memory another one has, are copied: safetensors refuses them."""
    import torch
    from safetensors.torch import save

    named, seen = {}, set()
    for name, value in values.items():
        if isinstance(value, np.ndarray):  # torch warns of read-only ones
            tensor = torch.from_numpy(value if value.flags.writeable else value.copy())
        else:
            tensor = value
        memory = tensor.untyped_storage()
        own = memory.nbytes() == tensor.nbytes and memory.data_ptr() not in seen
        seen.add(memory.data_ptr())
        named[name] = tensor if own else tensor.clone()
    return save(named, metadata)


def _unpack(data: bytes) -> tuple[Tensors, Words]:
    """The inverse of `_pack`. Raises `ValueError`, or what the reader raises, when the file is damaged."""
    start = _payload_start(data)
    metadata = json.loads(data[8:start])["__metadata__"]
    if zlib.crc32(memoryview(data)[start:]) != int(metadata["payload_crc32"], 16):
        raise ValueError("checksum differs")
    record = json.loads(metadata["record"])
    arrays = set(record["arrays"])
    if len(arrays) == len(json.loads(data[8:start])) - 1:
        from safetensors.numpy import load

        return {name: np.array(value) for name, value in load(data).items()}, record
    from safetensors.torch import load as load_torch

    values = {name: value.clone() for name, value in load_torch(data).items()}
    return {name: value.numpy() if name in arrays else value for name, value in values.items()}, record


def _payload_start(data: bytes) -> int:
    """Where the tensors begin: after 8 bytes of header length, little endian, and the header."""
    return 8 + int.from_bytes(data[:8], "little")
