"""Painters side by side on one task: fill the hidden pixels of single frames, truth known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.inpaint_config import COMPONENTS, FULL, SIMPLE, InpaintConfig
from ihbench.document.document import Block, Heading, Table
from ihbench.errors import BadInput
from ihbench.metrics.statistics import mean_interval, paired_test
from ihbench.scene.contracts import Capture
from ihbench.scene.protocol import Protocol
from ihbench.scene.views import open_scene, uncovered

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
) -> tuple[dict[str, dict[str, float]], NDArray[np.uint8]]:
    """Row -> scores over the scene's hidden pixels, and a picture. Raises `BadInput` when nothing is hidden."""
    from ihbench.methods.inpainthuman.studies.drift import flicker, hidden_scores, identity_drift

    size, square = SIZES[config.backbone]
    scene = open_scene(capture, protocol)
    occluded, whole = scene.train, uncovered(scene).train
    with progress.task(f"cutting {capture.name}", 2 * len(occluded)) as task:
        views, truths = [], []
        for k in range(len(occluded)):
            views.append(cut_view(occluded[k], k, body, size, square))
            truths.append(cut_view(whole[k], k, body, size, square))
            task.advance(2)
    hiding = [k for k, view in enumerate(views) if view.unknown.any()]
    if not hiding:
        raise BadInput(f"scene {capture.name}: no training frame hides anything under {protocol.name}")
    chosen = [hiding[k] for k in np.unique(np.linspace(0, len(hiding) - 1, min(frames, len(hiding))).astype(int))]
    asked = [views[k] for k in chosen]
    truth_images = [truths[k].image for k in chosen]
    silhouettes = [truths[k].person for k in chosen]
    found: dict[str, dict[str, float]] = {}
    pictures: dict[str, NDArray[np.uint8]] = {}
    for row in rows:
        scored = []
        for seed in seeds if row in COMPONENTS else seeds[:1]:
            ledger = Ledger()
            with ledger.stage("paint"):
                painted = _paint(
                    row, views, chosen, body, protocol.image.background, config, seed, ledger, progress, device
                )
            scores = hidden_scores(painted, truth_images, asked, silhouettes, protocol.image.background)
            drift, flick = identity_drift(asked, painted, body), flicker(asked, painted, body)
            scored.append(
                scores["hidden"]
                | {f"{name}_on_body": value for name, value in scores["on_body"].items()}
                | {"delta_e": drift.delta_e, "flicker": flick.deviation, "seconds": ledger.seconds}
            )
            pictures.setdefault(row, _row(painted))
        found[row] = {name: float(np.mean([s[name] for s in scored])) for name in scored[0]}
        progress.say(f"{capture.name} {row}: {found[row]['psnr']:.2f} dB, {found[row]['seconds']:.0f} s")
    masked = [np.where(view.unknown[..., None], np.uint8(128), view.image) for view in asked]
    picture = np.concatenate([_row(truth_images), _row(masked), *pictures.values()], 0)
    return found, picture


def _paint(
    row: str,
    views: list[CropView],
    chosen: list[int],
    body: Body,
    background: tuple[float, float, float],
    config: InpaintConfig,
    seed: int,
    ledger: Ledger,
    progress: Progress,
    device: str,
) -> list[NDArray[np.uint8]]:
    if row in SIMPLE:
        from ihbench.methods.inpainthuman.inpainting.simple_inpainters import simple_inpainters

        painted = simple_inpainters(body, background)[row].inpaint(views, progress)
        return [painted[k] for k in chosen]
    from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter, load_backbone

    ti, lora, sg = COMPONENTS[row]
    switched = replace(config, ti=ti, lora=lora, sg=sg)
    inpainter = DiffusionInpainter(load_backbone(switched, device), switched, seed, ledger)
    if ti or lora:  # a generic model learns nothing of the person, its ControlNet neither
        inpainter.learn(views, progress)
    return inpainter.inpaint([views[k] for k in chosen], progress)


def _row(images: Sequence[NDArray[np.uint8]], most: int = 10) -> NDArray[np.uint8]:
    shown = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, min(most, len(images))).astype(int))]
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
                low, high = interval.low, interval.high
                out[row][score] = {"mean": interval.value, "low": low, "high": high, "n": interval.n}
        if FULL in rows and row != FULL and len(scenes) > 1:
            full = {scene: scores[FULL]["psnr"] for scene, scores in scenes.items()}
            own = {scene: scores[row]["psnr"] for scene, scores in scenes.items()}
            lead = paired_test(full, own)
            out[row]["lead"] = {
                "mean": lead.interval.value, "low": lead.interval.low, "high": lead.interval.high, "p": lead.p,
            }  # fmt: skip
    return out


def table(result: Mapping[str, Mapping[str, Mapping[str, float]]], title: str) -> list[Block]:
    """A row for each painter."""
    head = ("painter", "PSNR ↑ (95 %)", "on the body model ↑", "SSIM ↑", "FLIP ↓", "drift ΔE ↓", "flicker ↓", "s")
    rows = []
    for row, scores in result.items():
        cells = [
            _told(scores.get("psnr"), 2, True), _told(scores.get("psnr_on_body"), 2), _told(scores.get("ssim"), 3),
            _told(scores.get("flip"), 3), _told(scores.get("delta_e"), 1), _told(scores.get("flicker"), 3),
            _told(scores.get("seconds"), 0), _told(scores.get("lead"), 2, True),
        ]  # fmt: skip
        rows.append((row, *cells))
    return [Heading(3, f"Hidden person pixels: {title}"), Table((*head, f"{FULL} leads by"), tuple(rows))]


def _told(score: Mapping[str, float] | None, digits: int, interval: bool = False) -> str:
    if score is None:
        return "-"
    text = f"{score['mean']:.{digits}f}"
    if interval and math.isfinite(score["low"]):
        text += f" ({score['low']:.{digits}f} to {score['high']:.{digits}f})"
    return text
