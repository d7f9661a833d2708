"""A reader of binary glTF that shares nothing with the writer: what a viewer does with nodes, skins and clips."""

from __future__ import annotations

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbFile:
    def __init__(self, data: bytes):
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json = json.loads(data[20 : 20 + size])
        binary, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0"
        self.binary = data[28 + size :]
        assert len(self.binary) == binary == self.json["buffers"][0]["byteLength"]

    def view(self, number):
        view = self.json["bufferViews"][number]
        return self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def array(self, number):
        a = self.json["accessors"][number]
        values = np.frombuffer(self.view(a["bufferView"]), NUMBERS[a["componentType"]])
        rows = values.reshape(a["count"], WIDTHS[a["type"]])
        return rows / np.iinfo(values.dtype).max if a.get("normalized") else rows

    def attributes(self):
        (primitive,) = self.json["meshes"][0]["primitives"]
        return {name: self.array(number) for name, number in primitive["attributes"].items()}

    def worlds(self, rotations=None, translations=None):
        """Node -> 4 × 4 to the scene, with some nodes' turns (x y z w) and places replaced."""
        found = {}

        def visit(number, parent):
            node, local = self.json["nodes"][number], np.eye(4)
            turn = (rotations or {}).get(number, node.get("rotation", (0, 0, 0, 1)))
            local[:3, :3] = Rotation.from_quat(turn).as_matrix()
            local[:3, 3] = (translations or {}).get(number, node.get("translation", (0, 0, 0)))
            found[number] = parent @ local
            for child in node.get("children", ()):
                visit(child, found[number])

        for root in self.json["scenes"][self.json["scene"]]["nodes"]:
            visit(root, np.eye(4))
        return found

    def posed(self, rotations=None, translations=None):
        """[C, 3] the skinned vertices."""
        (skin,) = self.json["skins"]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        worlds = self.worlds(rotations, translations)
        joints = np.stack([worlds[node] @ bind for node, bind in zip(skin["joints"], inverse, strict=True)])
        a = self.attributes()
        points = np.column_stack([a["POSITION"], np.ones(len(a["POSITION"]))])
        moved = np.einsum("ckab,cb->cka", joints[a["JOINTS_0"]], points)
        return np.einsum("ck,cka->ca", a["WEIGHTS_0"].astype(float), moved)[:, :3]

    def at(self, clip, key):
        """Turns and places of a clip at the time of one of its keys."""
        turns, places = {}, {}
        for channel in self.json["animations"][clip]["channels"]:
            sampler = self.json["animations"][clip]["samplers"][channel["sampler"]]
            value = self.array(sampler["output"])[key]
            target = channel["target"]
            (turns if target["path"] == "rotation" else places)[target["node"]] = value
        return turns, places

    def check_bounds(self):
        """Every accessor that says its bounds has exactly these."""
        said = [(k, a) for k, a in enumerate(self.json["accessors"]) if "min" in a]
        for number, a in said:
            rows = self.array(number)
            assert np.array_equal(np.float32(a["min"]), rows.min(0)), number
            assert np.array_equal(np.float32(a["max"]), rows.max(0)), number
            assert all(float(np.float32(v)) == v for v in (*a["min"], *a["max"]))
        return len(said)
