"""From a completed crop to the complete person mask M_full (sec. 3.4).

What is known stays: a known pixel is person exactly where the view says so. An unknown pixel deep inside the posed
body is person, one far off it is background, and one near the body's rim is decided by the painted image.

    `CoverageSilhouette`   half of the way from the background's colour to the person's nearby (the default)
    `GrabCutSilhouette`    graph cut with colour models of person and background (Rother et al., SIGGRAPH 2004)
    `SamSilhouette`        HQ-SAM (Ke et al., NeurIPS 2023), the paper's, with the user's own weights

Measured on stand-ins when the image decided `RIM` inside the body too (quick, crops 128 px tall; IoU of the complete
silhouette / of the unknown pixels alone):

                  true image painted    the same, blurred by 1.5 px, noise of 10 grey levels
    body model    0.945 / 0.903         0.945 / 0.903
    coverage      0.991 / 0.985         0.983 / 0.970
    GrabCut       0.991 / 0.984         0.965 / 0.941

A pixel that is half person is what a blurred painting is full of: a graph cut takes it for person down to a tenth.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.checkpoint import has_pickles, read_json, readable, weight_files
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.part_map import smpl_parts
from ihbench.diffusion.memory import said_when_full
from ihbench.errors import BadInput
from ihbench.files.paths import user_path

RIM = 0.03  # of the body's height in the crop: how far outside of the posed body the painted image decides
# of the body's height: farther inside it all is person. A fitted body is about so exact; people stand out from the
# model, not in; and a hole in a neck costs more than a rim too wide
CORE = 0.01
DEEP = 0.02  # of the body's height: so far inside the person the colour is no mixture
COVERAGE = 0.5  # share of a pixel above which it is person
CONTRAST = 40  # grey levels (Euclidean, RGB) below which a person cannot be told from the background
GRABCUT_THRESHOLD = 48  # grey levels; a rim pixel that differs more from the background starts as person
GRABCUT_ROUNDS = 2
SAM_REACH = 0.1  # of the body's height: HQ-SAM's mask counts no farther off the body than this
SAM_POINTS = 8
SAM_OPTION = "--method.inpaint.sam-weights"
SAM_FULL = "silhouette sam: too little free memory"
SAM_SMALLER = "use --method.inpaint.silhouette coverage, or a smaller HQ-SAM"
SAM_LAYOUT = (
    "expected HQ-SAM in transformers layout: config.json, preprocessor_config.json (or processor_config.json) and "
    "model.safetensors, as `hf download syscv-community/sam-hq-vit-huge` brings them"
)


class SilhouetteFinder(ABC):
    """Finds the complete person in a completed crop."""

    reach = RIM  # of the body's height, see `_Rim`

    def complete(self, view: CropView, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """[S, W] the complete person mask of the completed crop `image` [S, W, 3] RGB. Known pixels are as known."""
        rim = _Rim(view, self.reach)
        found = self.found(rim, image) if rim.undecided.any() else None
        return view.person | rim.core | (rim.undecided & (view.body if found is None else found))

    @abstractmethod
    def found(self, rim: _Rim, image: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        """[S, W] the person, looked at where it is undecided; None where the posed body must decide."""


class _OnBackground(SilhouetteFinder):
    def __init__(self, background: tuple[float, float, float]):
        self.background = 255 * np.array(background, np.float32)


class CoverageSilhouette(_OnBackground):
    """A rim pixel is person when its colour lies more than half of the way from the background's to the person's.

    The person's colour is that of the nearest pixel deep inside the person. Where it is the background's, the posed
    body decides. `background` is RGB in [0, 1].
    """

    def found(self, rim: _Rim, image: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        view = rim.view
        from_background = image.astype(np.float32) - self.background
        deep = cv2.erode(view.person.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
        deep |= view.unknown & (rim.inside > rim.pixels(DEEP))
        if not deep.any():
            return None
        person = _nearest(from_background * deep[..., None], deep)
        contrast = (person**2).sum(-1)
        coverage = (from_background * person).sum(-1) / np.maximum(contrast, 1)
        return np.where(contrast < CONTRAST**2, view.body, coverage > COVERAGE)


class GrabCutSilhouette(_OnBackground):
    """GrabCut, seeded by what is known and by the posed body. `background` is RGB in [0, 1]. Deterministic."""

    def found(self, rim: _Rim, image: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
        view = rim.view
        differs = np.abs(image - self.background).max(-1) > GRABCUT_THRESHOLD
        labels = np.where(view.person | rim.core, cv2.GC_FGD, cv2.GC_BGD).astype(np.uint8)
        labels[rim.undecided] = np.where(view.body | differs, cv2.GC_PR_FGD, cv2.GC_PR_BGD)[rim.undecided]
        person = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
        if person.all() or not person.any():
            return None  # two colour models need two sets of pixels
        cv2.setRNGSeed(0)  # the colour models start from k-means with random centres
        models = np.zeros((1, 65)), np.zeros((1, 65))
        no_box = (0, 0, 1, 1)  # the mask says it all
        cv2.grabCut(np.ascontiguousarray(image), labels, no_box, *models, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
        return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


class SamSilhouette(SilhouetteFinder):
    """HQ-SAM, prompted with the box of the posed body and with points on its parts.

    `weights` is a folder in transformers' layout, safetensors only. Raises `BadInput` for a folder that is missing,
    incomplete, pickled, damaged or another model. Nothing is downloaded.
    """

    reach = SAM_REACH

    def __init__(self, weights: str, device: str = "cpu"):
        self.model, self.processor = _load_sam(weights, device)
        self.device = device

    def found(self, rim: _Rim, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        import torch

        inputs = self.processor(
            images=np.ascontiguousarray(image),
            input_points=[[[[float(x), float(y)] for x, y in _points_on_parts(smpl_parts(rim.view.parts))]]],
            input_boxes=[[[float(edge) for edge in _box(rim.outside <= rim.pixels(RIM))]]],
            return_tensors="pt",
        )
        number = next(self.model.parameters()).dtype
        prompt = {
            name: inputs[name].to(self.device, number) for name in ("pixel_values", "input_points", "input_boxes")
        }
        with torch.inference_mode(), said_when_full(f"{SAM_FULL} on {self.device}; {SAM_SMALLER}"):
            # one mask: a box and points leave nothing ambiguous
            masks = self.model(**prompt, multimask_output=False).pred_masks.float().cpu()
        sizes = inputs["original_sizes"], inputs["reshaped_input_sizes"]
        (mask,) = self.processor.post_process_masks(masks, *sizes)
        return mask[0, 0].numpy()


SILHOUETTES = ("coverage", "grabcut", "sam")


def silhouette_finder(
    name: str, background: tuple[float, float, float], sam_weights: str = "", device: str = "cpu"
) -> SilhouetteFinder:
    """The finder of that name, one of `SILHOUETTES`. `background` is RGB in [0, 1]. Raises `BadInput` for another
    name, and for HQ-SAM without its weights."""
    if name == "coverage":
        return CoverageSilhouette(background)
    if name == "grabcut":
        return GrabCutSilhouette(background)
    if name == "sam":
        return SamSilhouette(sam_weights, device)
    raise BadInput(f"--method.inpaint.silhouette {name!r}: expected one of {', '.join(SILHOUETTES)}")


# --- what the posed body decides ---


class _Rim:
    """Which unknown pixels of a view the painted image decides: those at most `reach` of the body's height outside
    the posed body, and at most `CORE` inside it."""

    def __init__(self, view: CropView, reach: float = RIM):
        self.view, body = view, view.body
        rows = np.flatnonzero(body.any(1))
        self.height = int(rows[-1] - rows[0] + 1) if len(rows) else 0  # px
        self.outside = _distance(~body)  # [S, W] px to the body, infinite without one
        self.inside = _distance(body)  # [S, W] px to the body's rim, 0 off the body
        self.core = view.unknown & (self.inside > self.pixels(CORE))
        self.undecided = view.unknown & ~self.core & (self.outside <= self.pixels(reach))

    def pixels(self, share: float) -> float:
        return max(share * self.height, 1.0)


def _distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[S, W] px from each pixel of the mask to the nearest one off it, 0 off it, infinite in a mask of everything.
    The image's edge is no rim: a body that it cuts goes on behind it."""
    if mask.all():
        return np.full(mask.shape, np.inf, np.float32)
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _nearest(
    values: NDArray[np.float32],  # [S, W, C], zero outside `where`
    where: NDArray[np.bool_],  # [S, W], somewhere true
) -> NDArray[np.float32]:
    """[S, W, C] at every pixel the value at the nearest pixel of `where`, averaged with those beside that one."""
    share = cv2.GaussianBlur(where.astype(np.float32), (0, 0), 1.0)
    smooth = cv2.GaussianBlur(values, (0, 0), 1.0) / np.maximum(share, 1e-6)[..., None]
    _, labels = cv2.distanceTransformWithLabels(
        (~where).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    number = np.asarray(labels, np.int64)
    table = np.zeros((number.max() + 1, values.shape[2]), np.float32)
    table[number[where]] = smooth[where]
    return table[number]


# --- HQ-SAM ---


def _box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 in px around a mask that is not empty."""
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return int(cols[0]), int(rows[0]), int(cols[-1]) + 1, int(rows[-1]) + 1


def _points_on_parts(parts: NDArray[np.uint8]) -> list[tuple[float, float]]:
    """x, y in px of the pixel deepest inside each of the largest parts."""
    found, counts = np.unique(parts, return_counts=True)
    largest = [p for _, p in sorted(zip(-counts, found, strict=True)) if p != 255][:SAM_POINTS]
    points = []
    for part in largest:
        depth = cv2.distanceTransform(np.pad(parts == part, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        row, col = np.unravel_index(int(depth.argmax()), depth.shape)
        points.append((float(col) - 0.5, float(row) - 0.5))  # of the padding 1, to the pixel's centre 0.5
    return points


def check_sam(weights: str) -> Path:
    """The folder, after what a look can tell. Raises `BadInput`, see `SamSilhouette`."""
    folder = user_path(weights, SAM_OPTION)
    if not weights or not folder.is_dir():
        raise BadInput(f"{SAM_OPTION} {weights!r}: no such folder; {SAM_LAYOUT}")
    if not (folder / "config.json").is_file():
        raise BadInput(f"{SAM_OPTION} {folder}: lacks config.json; {SAM_LAYOUT}")
    kind = read_json(folder / "config.json").get("model_type")
    if kind != "sam_hq":
        raise BadInput(f"{SAM_OPTION} {folder}: holds a model of type {kind!r}, not 'sam_hq'; {SAM_LAYOUT}")
    if not weight_files(folder, "model"):
        why = "has only pickles, which are refused" if has_pickles(folder) else "lacks model.safetensors"
        raise BadInput(f"{SAM_OPTION} {folder}: {why}; {SAM_LAYOUT}")
    if not any((folder / f"{name}_config.json").is_file() for name in ("preprocessor", "processor")):
        raise BadInput(f"{SAM_OPTION} {folder}: lacks preprocessor_config.json; {SAM_LAYOUT}")
    return folder


def _load_sam(weights: str, device: str) -> tuple[Any, Any]:
    folder = check_sam(weights)
    try:
        from transformers import SamHQModel, SamHQProcessor
    except ImportError as error:
        raise BadInput(f"silhouette 'sam' needs transformers 4.52 or newer ({error}); update it") from error
    with readable(f"{SAM_OPTION} {folder}: not readable"):
        loaded: Any = SamHQModel.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
        model, report = loaded
        processor = SamHQProcessor.from_pretrained(str(folder), local_files_only=True)
    bad = [*report["missing_keys"], *(key[0] for key in report["mismatched_keys"])]
    if bad:
        # from_pretrained makes them up
        raise BadInput(
            f"{SAM_OPTION} {folder}: {len(bad)} tensors are missing or misshapen ({bad[0]}); fetch it again"
        )
    if not all(p.isfinite().all() for p in model.parameters()):
        raise BadInput(f"{SAM_OPTION} {folder}: has NaN or infinite weights; fetch it again")
    with said_when_full(f"{SAM_FULL} on {device}; {SAM_SMALLER}"):
        return model.to(device).eval().requires_grad_(False), processor
