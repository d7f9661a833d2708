"""Painters side by side on one task: fill the hidden pixels of single frames, truth known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.crops.elsewhere import with_elsewhere
from ihbench.diffusion.crops.head_crop import PaintedHead, head_views, with_head
from ihbench.diffusion.inpaint_config import COMPONENTS, FULL, SIMPLE, InpaintConfig
from ihbench.document.document import Block, Heading, Table
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.studies.paint_faces import HiddenFaces
from ihbench.metrics.statistics import Interval, mean_interval, paired_test
from ihbench.scene.contracts import Capture
from ihbench.scene.protocol import Protocol
from ihbench.scene.views import open_scene, uncovered

T = TypeVar("T")
TRUTH, SEEN = "the true images", "surface that is seen"  # rows that bound drift and flicker
FACES = 6  # hidden ones that a picture shows at their own scale
SIZES = {"mini": (128, False), "sd2": (512, True)}  # px, height of all painters' crops, and whether they are square


def paint_scene(
    capture: Capture,
    body: Body,
    protocol: Protocol,
    rows: Sequence[str],
    frames: int,
    seeds: Sequence[int],
    config: InpaintConfig,
    progress: Progress,
    device: str = "cpu",
    dropped: float = 0.0,
) -> tuple[dict[str, dict[str, float]], NDArray[np.uint8]]:
    """Row -> scores over the scene's hidden pixels, and a picture. Two more rows bound drift and flicker: the true
    images as a painting, and surface that is seen. A share `dropped` of what a frame shows of the person is kept from
    the painters, and all that other frames show; scored are the same pixels. Raises `BadInput` when nothing is
    hidden."""
    from ihbench.methods.inpainthuman.studies.drift import flicker, hidden_scores, identity_drift

    def paint(row: str, seed: int, ledger: Ledger) -> tuple[list[NDArray[np.uint8]], dict[int, PaintedHead]]:
        """What a painter makes of the picked views, and its heads at their own scale."""
        if row in SIMPLE:
            from ihbench.methods.inpainthuman.inpainting.simple_inpainters import simple_inpainters

            given = [
                replace(view, unknown=few.unknown, person=few.person) for view, few in zip(views, shown, strict=True)
            ]
            painted = simple_inpainters(body, protocol.image.background)[row].inpaint(given, progress)
            return [painted[k] for k in picked], {}
        from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter, load_backbone

        ti, lora, sg = COMPONENTS[row]
        switched = replace(config, ti=ti, lora=lora, sg=sg)
        inpainter = DiffusionInpainter(load_backbone(switched, device), switched, seed, ledger)
        if ti or lora:  # a generic model learns nothing of the person, its ControlNet neither
            inpainter.learn(views, progress, adapt=lora)
        given = [shown[k] for k in picked]
        painted = inpainter.inpaint(given, progress)
        if dropped or not inpainter.paints_heads:  # a head crop would show what is kept from the painters
            return painted, {}
        heads = head_views(given, hiders, painted, body)
        images = inpainter.inpaint_heads(list(heads.values()), progress)
        done = {n: PaintedHead(head, image) for (n, head), image in zip(heads.items(), images, strict=True)}
        for n, head in done.items():
            painted[n] = with_head(given[n], painted[n], head, hiders[picked[n]])
        return painted, done

    size, square = SIZES[config.backbone]
    scene = open_scene(capture, protocol)
    occluded, whole = scene.train, uncovered(scene).train
    with progress.task(f"cutting {capture.name}", 2 * len(occluded)) as task:
        views, truths = [], []
        for k in range(len(occluded)):
            views.append(cut_view(occluded[k], k, body, size, square))
            truths.append(cut_view(whole[k], k, body, size, square))
            task.advance(2)
    views = with_elsewhere(views, views)
    shown = [with_less(view, dropped) for view in views] if dropped else views
    hiding = [k for k, view in enumerate(views) if view.unknown.any()]
    if not hiding:
        raise BadInput(f"scene {capture.name}: no training frame hides anything under {protocol.name}")
    picked = _evenly(hiding, frames)
    asked = [views[k] for k in picked]
    hiders = {k: occluded[k] for k in picked}
    faces = HiddenFaces(asked, hiders, {k: whole[k] for k in picked}, body)
    truth_images = [truths[k].image for k in picked]
    silhouettes = [truths[k].person for k in picked]
    means: dict[str, dict[str, float]] = {}
    pictures: dict[str, NDArray[np.uint8]] = {}
    for row in rows:
        scored = []
        for seed in seeds if row in COMPONENTS else seeds[:1]:
            ledger = Ledger()
            with ledger.stage("paint"):
                painted, heads = paint(row, seed, ledger)
            seen_faces = faces.images(painted, heads)
            scores = hidden_scores(painted, truth_images, asked, silhouettes, protocol.image.background)
            drift, flick = identity_drift(asked, painted, body), flicker(asked, painted, body)
            scored.append(
                scores["hidden"]
                | {f"{name}_on_body": value for name, value in scores["on_body"].items()}
                | {"face": faces.psnr(seen_faces)}
                | {"delta_e": drift.delta_e, "flicker": flick.deviation, "seconds": ledger.seconds}
            )
            pictures.setdefault(row, _with_faces(_row(painted), faces.row(seen_faces, FACES)))
        means[row] = {name: float(np.mean([s[name] for s in scored])) for name in scored[0]}
        progress.say(f"{capture.name} {row}: {means[row]['psnr']:.2f} dB, {means[row]['seconds']:.0f} s")
    drift, flick = identity_drift(asked, truth_images, body), flicker(asked, truth_images, body)
    means[TRUTH] = {"delta_e": drift.delta_e, "flicker": flick.deviation}
    means[SEEN] = {"delta_e": drift.delta_e_floor, "flicker": flick.deviation_floor}
    masked = [np.where(view.unknown[..., None], np.uint8(128), view.image) for view in asked]
    truth_row = _with_faces(_row(truth_images), faces.row(faces.truths, FACES))
    masked_row = _with_faces(_row(masked), faces.row({k: view.image for k, view in faces.views.items()}, FACES))
    return means, np.concatenate([truth_row, masked_row, *pictures.values()], 0)


def with_less(view: CropView, dropped: float) -> CropView:
    """A view of which only a strip on one side is left, so wide that it shows a share 1 - `dropped` of the visible
    person, and nothing of other frames."""
    columns = np.cumsum(view.person.sum(0))
    kept = np.arange(len(columns)) < np.searchsorted(columns, (1 - dropped) * columns[-1])
    unknown = view.unknown | ~kept
    return replace(view, unknown=unknown, person=view.person & ~unknown, elsewhere=None)


def _evenly(items: Sequence[T], most: int) -> list[T]:
    """At most so many, evenly spread."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).astype(int))]


def _with_faces(row: NDArray[np.uint8], faces: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """A row of crops, then head crops at twice the size beside each other."""
    height = row.shape[0]
    cells = [np.full((height, 2, 3), 200, np.uint8)]
    for face in faces:
        large = face.repeat(2, 0).repeat(2, 1)[:height]
        below = height - len(large)
        cells.append(np.pad(large, ((below // 2, below - below // 2), (0, 2), (0, 0)), constant_values=200))
    missing = max(FACES - len(faces), 0)
    if faces:
        cells.append(np.full((height, missing * cells[-1].shape[1], 3), 200, np.uint8))
    return np.concatenate([row, *cells], 1)


def _row(images: Sequence[NDArray[np.uint8]], most: int = 10) -> NDArray[np.uint8]:
    shown = _evenly(images, most)
    wide = [(0, image.shape[0] - image.shape[1]) for image in shown]
    cells = [np.pad(image, ((2, 2), w, (0, 0)), constant_values=200) for image, w in zip(shown, wide, strict=True)]
    return np.concatenate(cells, 1)


def summary(scenes: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, dict[str, float]]]:
    """Row -> score -> mean over scenes with its interval, and the full method's paired lead in PSNR."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    rows = list(next(iter(scenes.values())))
    for row in rows:
        out[row] = {}
        for score in scenes[next(iter(scenes))][row]:
            values = {scene: scores[row][score] for scene, scores in scenes.items()}
            finite = {scene: value for scene, value in values.items() if math.isfinite(value)}
            if finite:
                interval = mean_interval(finite)
                out[row][score] = _numbers(interval) | {"n": interval.n}
        if FULL in rows and row not in (FULL, TRUTH, SEEN) and len(scenes) > 1:
            full = {scene: scores[FULL]["psnr"] for scene, scores in scenes.items()}
            own = {scene: scores[row]["psnr"] for scene, scores in scenes.items()}
            lead = paired_test(full, own)
            out[row]["lead"] = _numbers(lead.interval) | {"p": lead.p}
    return out


def _numbers(interval: Interval) -> dict[str, float]:
    return {"mean": interval.value, "low": interval.low, "high": interval.high}


def table(result: Mapping[str, Mapping[str, Mapping[str, float]]], title: str) -> list[Block]:
    """A row for each painter."""
    head = (
        "painter", "PSNR ↑ (95 %)", "on the body model ↑", "hidden faces ↑", "SSIM ↑", "FLIP ↓", "drift ΔE ↓",
        "flicker ↓", "s",
    )  # fmt: skip
    digits = {
        "psnr": 2,
        "psnr_on_body": 2,
        "face": 2,
        "ssim": 3,
        "flip": 3,
        "delta_e": 1,
        "flicker": 3,
        "seconds": 0,
        "lead": 2,
    }
    rows = tuple(
        (row, *(_text(scores.get(name), n, name in ("psnr", "lead")) for name, n in digits.items()))
        for row, scores in result.items()
    )
    return [Heading(3, f"Hidden person pixels: {title}"), Table((*head, f"{FULL} leads by"), rows)]


def _text(score: Mapping[str, float] | None, digits: int, interval: bool) -> str:
    if score is None:
        return "-"
    text = f"{score['mean']:.{digits}f}"
    if interval and math.isfinite(score["low"]):
        text += f" ({score['low']:.{digits}f} to {score['high']:.{digits}f})"
    return text
