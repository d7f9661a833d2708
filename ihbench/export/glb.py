"""A binary glTF 2.0 file, put together piece by piece: buffers, accessors with exact bounds, nodes.

Written by hand: trimesh writes no skins and no extensions. Source: the Khronos glTF 2.0 specification.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC, VERSION, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
VERTICES, INDICES = 34962, 34963  # what a buffer view is for


class Glb:
    """Collects a document; lists of it are appended to as they are, and give the number of what was added."""

    def __init__(self, generator: str, copyright: str = "", extras: Mapping[str, Any] | None = None) -> None:
        asset: dict[str, Any] = {"version": "2.0", "generator": generator}
        if copyright:
            asset["copyright"] = copyright
        if extras:
            asset["extras"] = dict(extras)
        self.document: dict[str, Any] = {"asset": asset}
        self._binary = bytearray()

    def add(self, kind: str, item: Mapping[str, Any]) -> int:
        """Append to one of the document's lists, such as "nodes"; the item's number."""
        items = self.document.setdefault(kind, [])
        items.append(dict(item))
        return len(items) - 1

    def use(self, *extensions: str) -> None:
        """Say that extensions are used; readers without them show something sensible all the same."""
        used = self.document.setdefault("extensionsUsed", [])
        used += [name for name in extensions if name not in used]

    def view(self, data: bytes, target: int | None = None) -> int:
        """A piece of the binary part, as a buffer view."""
        self._binary += b"\0" * (-len(self._binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data)}
        self._binary += data
        return self.add("bufferViews", view | ({"target": target} if target else {}))

    def accessor(
        self,
        values: NDArray,  # [n] or [n, k] of float32, uint8, uint16 or uint32
        target: int | None = None,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """An array; `bounds` writes the least and greatest value of each component, exactly. Rows of vertex data must
        be multiples of 4 bytes: give uint8 and uint16 in fours or twos."""
        values = np.ascontiguousarray(values)
        width = 1 if values.ndim == 1 else values.shape[1]
        item: dict[str, Any] = {
            "bufferView": self.view(values.astype(values.dtype.newbyteorder("<")).tobytes(), target),
            "componentType": COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": TYPES[width],
        }
        if normalized:
            item["normalized"] = True
        if bounds:
            rows = values.reshape(len(values), width)
            item |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        return self.add("accessors", item)

    def picture(self, png: bytes) -> int:
        """A PNG inside, as an image."""
        return self.add("images", {"bufferView": self.view(png), "mimeType": "image/png"})

    def data(self) -> bytes:
        """The file."""
        self._binary += b"\0" * (-len(self._binary) % 4)
        self.document["buffers"] = [{"byteLength": len(self._binary)}]
        text = json.dumps(self.document, separators=(",", ":"), allow_nan=False).encode("utf-8")
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self._binary)
        head = struct.pack("<III", MAGIC, VERSION, length)
        first = struct.pack("<II", len(text), JSON_CHUNK) + text
        return head + first + struct.pack("<II", len(self._binary), BIN_CHUNK) + bytes(self._binary)
