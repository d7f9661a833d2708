"""The dataset that `mini` learns from: crops of procedural people, kept in files of a hundred people each."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.body import Body, load_body
from ihbench.clock.interruption import end_with_parent
from ihbench.clock.progress import Progress
from ihbench.clock.threads import begin_on_one_thread
from ihbench.diffusion.crops.head_crop import ROOM, WIDTH, head_crop, head_size
from ihbench.diffusion.crops.head_places import head_guide
from ihbench.diffusion.crops.part_map import NO_PART, drawn_body, labels_of
from ihbench.diffusion.crops.person_crop import PADDING, person_crop
from ihbench.diffusion.crops.seen_surface import NOWHERE, uv_cells
from ihbench.errors import BadInput
from ihbench.files.npz import read_npz, write_npz

VERSION = 4  # of what is kept of a photograph
PAGE = 100  # people per file
COLUMNS = ("widths", "images", "silhouettes", "parts", "cells", "person")  # one row a crop
HEADS = ("head_there", "head_images", "head_silhouettes", "head_parts", "head_guides")  # and of its head
JITTER = 0.03  # of the body's longer side, by which the padding varies
ROOM_JITTER = 0.1  # by which a head crop's room varies


@dataclass(frozen=True)
class Page:
    """The crops of a hundred people. `first[k] : first[k + 1]` are person k's."""

    widths: NDArray[np.int64]  # [N] px; crop n is `images[n, :, :widths[n]]`
    images: NDArray[np.uint8]  # [N, S, S, 3]
    silhouettes: NDArray[np.bool_]  # [N, S, S]
    parts: NDArray[np.uint8]  # [N, S, S] SMPL parts
    cells: NDArray[np.uint16]  # [N, S, S] of the UV chart
    person: NDArray[np.int64]  # [N]
    head_there: NDArray[np.bool_]  # [N] whether there is a head crop
    head_images: NDArray[np.uint8]  # [N, h, w, 3]
    head_silhouettes: NDArray[np.bool_]  # [N, h, w]
    head_parts: NDArray[np.uint8]  # [N, h, w]
    head_guides: NDArray[np.uint8]  # [N, h, w, 3] of `head_guide`
    phrases: list[tuple[str, ...]]  # per person
    traits: NDArray[np.float32]  # [P, T] per person


def make_page(people: str, start: int, count: int, each: int, size: int) -> Page:
    """Draw `count` people from number `start`, and crop `each` photographs of every one."""
    draw_person, body = registry.load("people", people).draw_person, load_body()
    columns: dict[str, list[Any]] = {name: [] for name in (*COLUMNS, *HEADS)}
    phrases, traits = [], []
    for k in range(count):
        person = draw_person(start + k, body, each)
        rng = np.random.default_rng((start + k, 7))
        phrases.append(person.phrases)
        traits.append(person.traits)
        for shot in person.snapshots:
            vertices = body.pose(shot.body_pose)
            padding = PADDING + JITTER * rng.uniform(-1, 1)
            crop = person_crop(shot.camera, vertices, size, padding=padding)
            padded = ((0, 0), (0, size - crop.width))
            raster = drawn_body(vertices, body, crop.camera(shot.camera))
            columns["widths"].append(crop.width)
            columns["images"].append(np.pad(crop.cut(shot.image, 255), (*padded, (0, 0))))
            columns["silhouettes"].append(np.pad(crop.cut(shot.silhouette) > 0.5, padded))
            columns["parts"].append(np.pad(labels_of(raster, body), padded))
            columns["cells"].append(np.pad(uv_cells(raster, body), padded, constant_values=NOWHERE))
            columns["person"].append(k)
            room = ROOM * (1 + ROOM_JITTER * rng.uniform(-1, 1))
            for name, value in _head(shot, vertices, body, head_size(size), room).items():
                columns[name].append(value)
    arrays = {name: np.array(values) for name, values in columns.items()}
    return Page(**arrays, phrases=phrases, traits=np.array(traits, np.float32))


def _head(shot: Any, vertices: NDArray[np.float64], body: Body, size: int, room: float) -> dict[str, Any]:
    """The row of `HEADS` of a photograph; of a head behind the camera an empty one."""
    crop = head_crop(shot.camera, vertices, body, size, room)
    if crop is None:
        shape = (size, round(WIDTH * size))
        empty = np.zeros(shape, np.uint8), np.zeros((*shape, 3), np.uint8)
        return dict(zip(HEADS, (False, empty[1], empty[0] > 0, empty[0] + NO_PART, empty[1]), strict=True))
    raster = drawn_body(vertices, body, crop.camera(shot.camera))
    image, silhouette = crop.cut(shot.image, 255), crop.cut(shot.silhouette) > 0.5
    row = True, image, silhouette, labels_of(raster, body), head_guide(raster, body)
    return dict(zip(HEADS, row, strict=True))


class CropDataset:
    """Pages `start / PAGE` onwards of a dataset in a folder; made when they are missing, each written whole."""

    def __init__(self, folder: Path, people: str, each: int, size: int):
        self.people, self.each, self.size = people, each, size
        version = f"{registry.load('people', people).VERSION}.{VERSION}"
        self.folder = Path(folder) / f"{people}-v{version}-{each}x{size}"

    def path(self, start: int) -> Path:
        return self.folder / f"{start:08d}.npz"

    def make(self, start: int, count: int, progress: Progress) -> None:
        """Make sure that people `start` to `start + count` are there. Raises `BadInput` for a partial page."""
        if start % PAGE or count % PAGE:
            raise BadInput(f"dataset: people come in pages of {PAGE}, got {start} and {count}")
        missing = [s for s in range(start, start + count, PAGE) if not self.path(s).is_file()]
        if not missing:
            return
        work = [(self.people, s, PAGE, self.each, self.size, self.path(s)) for s in missing]
        with progress.task("photographing people", len(missing) * PAGE) as task, ExitStack() as stack:
            workers, side_by_side = min(os.cpu_count() or 1, len(missing)), map
            # where there is no shared memory, as in some sandboxes, this process takes all of them
            with suppress(OSError, ImportError, NotImplementedError):
                if workers > 1:
                    # a fork of a process whose libraries have threads waits for them forever
                    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin_worker)
                    side_by_side = stack.enter_context(pool).map
            for _ in side_by_side(_write_page, work):
                task.advance(PAGE)

    def pages(self, start: int, count: int) -> Iterator[Page]:
        for s in range(start, start + count, PAGE):
            yield _read_page(self.path(s))


def _begin_worker() -> None:
    end_with_parent()
    begin_on_one_thread()


def _write_page(work: tuple[str, int, int, int, int, Path]) -> None:
    people, start, count, each, size, path = work
    page = make_page(people, start, count, each, size)
    words = np.array(["\n".join(phrases) for phrases in page.phrases])
    arrays = {name: getattr(page, name) for name in (*COLUMNS, *HEADS, "traits")}
    write_npz(path, {"phrases": words, **arrays})


def _read_page(path: Path) -> Page:
    try:
        arrays = dict(read_npz(path))
        words = arrays.pop("phrases")
        return Page(**arrays, phrases=[tuple(str(word).split("\n")) for word in words])
    except (BadInput, KeyError, TypeError) as error:
        raise BadInput(
            f"{path}: not a readable page of a dataset ({error}); remove it and it is made again"
        ) from error
