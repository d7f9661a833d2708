"""Every reader of files on damaged files: each answers with a value, or with `BadInput` in one line that names it."""

from __future__ import annotations

import io
import os
import random
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from ihbench import registry
from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.body.smpl_file import read_arrays, write_body
from ihbench.body.uv_obj import read_uv_obj
from ihbench.clock.ledger import Ledger
from ihbench.datasets.ocmotion import wild2avatar as ocmotion_w2a
from ihbench.datasets.people_snapshot import gaussianavatar, instantavatar
from ihbench.datasets.people_snapshot import original as people_snapshot
from ihbench.datasets.plain import plain_scene
from ihbench.datasets.reading.pickles import write_pickle
from ihbench.datasets.reading.standin_mark import STANDIN_FILE, standin_mark
from ihbench.datasets.zju_mocap import original as zju
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.images import read_image
from ihbench.files.safe_pickle import load_npy, load_pickle
from ihbench.reports.lint.table_files import read_tables
from ihbench.scene.protocol import read_protocol
from tests.bench.fake_capture import a_camera, a_pose
from tests.fuzz.patience import TooLong, at_most

SECONDS = 30  # for one file
LONGEST = 2000  # characters of a complaint
JUNK = [
    *(
        b"null",
        b"true",
        b"{}",
        b"[]",
        b'""',
        b'"x"',
        b"-1",
        b"0",
        b"1e999",
        b"NaN",
        b"9" * 400,
        "１".encode(),
        b"\xff",
    ),
    *(b"\0", b"[" * 2000, b'"\\ud800"', b"../..", b"/dev/zero", b"\x1b[2J"),
]


@dataclass(frozen=True)
class Reader:
    """`make` writes a good file at a path, `read` reads it."""

    name: str  # of the file
    make: Callable[[Path], Any]
    read: Callable[[Path], Any]


def readers() -> list[Reader]:
    """Every way in which a file of somebody else comes in."""
    body, camera = load_body(), a_camera()
    poses = [a_pose(yaw) for yaw in (0.0, 1.0, 2.0)]
    masks = np.zeros((3, 8, 6), bool)
    masks[:, 2:6, 2:4] = True
    picture = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(8, 6, 3)
    snapshot = people_snapshot
    found = [
        Reader("body.npz", lambda path: write_body(path, body), load_body),
        Reader("body.pkl", lambda path: write_pickle(path, read_arrays(_own_body())), load_body),
        Reader("any.pkl", lambda path: write_pickle(path, {"a": [1, (2, None)], "b": np.eye(3)}), load_pickle),
        Reader("any.npy", lambda path: np.save(path, np.eye(4)), load_npy),
        Reader("map.obj", _write_obj, lambda path: read_uv_obj(path, np.array([[0, 1, 2]], np.int32))),
        Reader(
            "cameras.json",
            lambda path: plain_scene.write_cameras(path.parent, {"main": camera}),
            plain_scene.read_cameras,
        ),
        Reader(
            "poses.npz",
            lambda path: plain_scene.write_poses(path.parent, poses, frames=[0, 1, 2]),
            plain_scene.read_poses,
        ),
        Reader(
            "scene.json",
            lambda path: atomic.write_json(path, {"name": "a", "about": "b"}),
            lambda path: plain_scene.read_about(path.parent),
        ),
        Reader("camera.pkl", lambda path: snapshot.write_camera(path.parent, camera), snapshot.read_camera),
        Reader(
            "masks.hdf5",
            lambda path: snapshot.write_masks(path.parent, masks, masks.shape),
            lambda path: snapshot.MaskFile(path).frame(1),
        ),
        Reader(
            "reconstructed_poses.hdf5", lambda path: snapshot.write_poses(path.parent, poses), snapshot.read_poses
        ),
        Reader(
            "keypoints.hdf5",
            lambda path: h5py.File(path, "w").create_dataset("keypoints", data=np.zeros((3, 54))).file.close(),
            snapshot.read_keypoints,
        ),
        Reader(
            "consensus.pkl",
            lambda path: snapshot.write_consensus(path.parent, np.zeros(10), np.zeros((6, 3))),
            snapshot.read_consensus,
        ),
        Reader("smpl_parms.pth", _write_pth, gaussianavatar.read_poses),
        Reader(
            "cameras.npz",
            lambda path: instantavatar.write_camera(path.parent, camera),
            instantavatar.read_camera,
        ),
        Reader("poses_i.npz", _write_instant_poses, instantavatar.read_poses),
        Reader("annots.npy", _write_annots, zju.read_annots),
        Reader("1.npy", _write_params, zju.read_params),
        Reader(
            "metadata.json",
            lambda path: atomic.write_json(path, {"00001": {"poses": [0.0]}}),
            ocmotion_w2a.read_metadata,
        ),
        Reader(
            STANDIN_FILE,
            lambda path: atomic.write_json(path, {"version": 2, "seed": 0, "body_sha": "x"}),
            lambda path: standin_mark(path.parent),
        ),
        Reader("p.toml", _copy("protocol", "zju_occ", "zju_occ.toml"), read_protocol),
        Reader("t.md", lambda path: path.write_text("| a | PSNR |\n|---|---|\n| x | **1.5** |\n"), read_tables),
        Reader("t.tex", lambda path: path.write_text(_TEX), read_tables),
        Reader("run.json", lambda path: atomic.write_json(path, {"a": [1, None, "nan"]}), atomic.read_json),
        Reader("rows.jsonl", lambda path: atomic.write_json_lines(path, [{"a": 1}] * 3), atomic.read_json_lines),
        Reader(
            "checkpoints/state.safetensors",
            _write_state,
            lambda path: Ledger(path.parents[1]).load_state("state"),  # a damaged one counts as absent
        ),
    ]
    for ending, mode in (
        (".png", "RGB"),
        (".png", "RGBA"),
        (".png", "L"),
        (".jpg", "RGB"),
        (".png", "P"),
        (".png", "1"),
    ):
        make = partial(_save_picture, picture, mode)
        found.append(Reader(f"{mode}{ending}", make, lambda path: read_image(path, (1.0, 1.0, 1.0))))
    found.append(
        Reader(
            "a.npy",
            lambda path: np.save(path, picture / np.float32(255)),
            lambda path: read_image(path, (1.0, 1.0, 1.0)),
        )
    )
    return found


_TEX = "\\begin{tabular}{lr}\na & PSNR \\\\\n\\midrule\nx & \\textbf{1.5} \\\\\n\\end{tabular}\n"


def _own_body() -> Path:
    from ihbench.body.smpl_file import PROCEDURAL_FILE

    return PROCEDURAL_FILE


def _write_obj(path: Path) -> None:
    path.write_text("vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")


def _write_pth(path: Path) -> None:
    import torch

    torch.save({"body_pose": torch.zeros(3, 72), "trans": torch.zeros(3, 3), "beta": torch.zeros(1, 10)}, path)


def _write_instant_poses(path: Path) -> None:
    np.savez(
        path, global_orient=np.zeros((3, 3)), body_pose=np.zeros((3, 69)), transl=np.zeros((3, 3)), betas=np.zeros(10)
    )


def _write_annots(path: Path) -> None:
    cameras = [a_camera() for _ in range(2)]
    zju.write_annots(path.parent, cameras, zju.standard_image_paths(2, 3))


def _write_params(path: Path) -> None:
    zju.write_params(path.parent, 1, BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3)), load_body())
    (path.parent / "new_params" / "1.npy").rename(path)


def _copy(kind: str, name: str, file: str) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes((registry.package_folder(kind, name) / file).read_bytes())


def _write_state(path: Path) -> None:
    Ledger(path.parents[1]).save_state("state", {"a": np.eye(3)}, {"step": 3})


def _save_picture(picture: np.ndarray, mode: str, path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(picture).convert(mode).save(buffer, "JPEG" if path.suffix == ".jpg" else "PNG")
    path.write_bytes(buffer.getvalue())


# --------------------------------------------------------------------------------------------- damages


DAMAGES = [
    "bits",
    "bits",
    "many_bits",
    "cut",
    "zeros",
    "noise",
    "inserted",
    "twice",
    "swapped",
    "token",
    "token",
    "token",
]


def damaged(data: bytes, others: list[bytes], draw: random.Random) -> tuple[str, bytes]:
    """(what was done, other contents)."""
    kind = draw.choice(DAMAGES)
    at = draw.randrange(len(data) + 1)
    length = draw.choice([1, 2, 4, 8, 64, 1024])
    if kind in ("bits", "many_bits"):
        changed = bytearray(data)
        for _ in range(draw.choice([1, 2, 4]) if kind == "bits" else 200):
            # headers are short and say most
            place = draw.randrange(min(len(data), draw.choice([64, 512, len(data)])) or 1)
            changed[place] ^= 1 << draw.randrange(8)
        return kind, bytes(changed)
    if kind == "cut":
        return kind, data[:at]
    if kind == "zeros":
        return kind, data[:at] + bytes(len(data[at : at + length])) + data[at + length :]
    if kind == "noise":
        return kind, data[:at] + draw.randbytes(len(data[at : at + length])) + data[at + length :]
    if kind == "inserted":
        return kind, data[:at] + draw.randbytes(length) + data[at:]
    if kind == "twice":
        return kind, data + data
    if kind == "swapped":
        return kind, draw.choice(others)
    tokens = list(re.finditer(rb'"[^"\n]{0,40}"|[-+.\w]+|[\[\]{}(),:=]', data[:20_000]))
    if not tokens:
        return "empty", b""
    token = draw.choice(tokens)
    return f"token at {token.start()}", data[: token.start()] + draw.choice(JUNK) + data[token.end() :]


PLACES: dict[str, Callable[[Path], Any]] = {
    "gone": lambda path: None,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "endless": lambda path: path.symlink_to("/dev/zero"),
}


def faults(folder: Path, n: int, seed: int) -> Iterator[str]:
    """Read `n` damaged files; what went wrong, a line each."""
    draw, every, good = random.Random(seed), readers(), {}
    for number, reader in enumerate(every):
        place = folder / str(number)
        place.mkdir()
        reader.make(place / reader.name)
        good[number] = (place / reader.name).read_bytes()
        fault = _fault(reader, place / reader.name, good_file=True)
        if fault:
            yield f"{reader.name}, untouched: {fault}"
    for case in range(n):
        number = case % len(every)
        reader, path = every[number], folder / str(number) / every[number].name
        path.unlink()
        if draw.random() < 0.05:
            kind = draw.choice(list(PLACES))
            PLACES[kind](path)
        else:
            kind, data = damaged(good[number], list(good.values()), draw)
            path.write_bytes(data)
        fault = _fault(reader, path)
        if fault:
            yield f"{reader.name}, {kind} (case {case}): {fault}"
        if path.is_dir():
            path.rmdir()
        path.unlink(missing_ok=True)
        path.write_bytes(good[number])


def _fault(reader: Reader, path: Path, good_file: bool = False) -> str:
    try:
        with at_most(SECONDS), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            reader.read(path)
    except BadInput as error:
        told = str(error)
        if good_file:
            return f"refused: {told}"
        if "\n" in told or len(told) > LONGEST or not told.isprintable():
            return f"not one short line: {told[:200]!a}"
        if path.name not in told and str(path.parent) not in told:
            return f"does not name the file: {told}"
        return ""
    except (Exception, TooLong) as error:
        return f"{type(error).__name__}: {error}"
    return ""
