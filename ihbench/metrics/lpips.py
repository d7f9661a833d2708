"""LPIPS (Zhang et al., CVPR 2018), version 0.1, through the authors' `lpips` package.

The package wants images in [-1, 1]; several released evaluators feed it [0, 1], which halves the contrast and gives
another number: `feed` is part of every identity. The trunks' ImageNet weights are not in the package and are never
downloaded behind anybody's back: without them there is no LPIPS, and the reason says which file is missing.

A frame larger than `TILE` is computed in tiles. A tile starts at a multiple of the trunk's stride and reaches `HALO`
pixels beyond its core, more than the receptive field; features of the core alone are counted, so that convolutions
are padded with zeros at the true edges only and the result is that of the whole frame.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.files.tensors import read_tensors
from ihbench.metrics.images import as_background, as_mask, bounds, checked, in_colour, peak_of
from ihbench.metrics.weights import FILES, locate

NETS = ("vgg", "alex", "squeeze")
FEEDS = ("[-1,1]", "[0,1]")
MIN_SIDE = 64  # px; a smaller image is padded to it
PADDING = 0.5  # what with, to the right and below, in both images
TILE = 1024  # px; a multiple of every trunk's stride
HALO = 128  # px; receptive fields reach 98 (vgg), 97 (alex) and 104 px (squeeze) to a side
STRIDES = {"vgg": (1, 2, 4, 8, 16), "alex": (4, 8, 16, 16, 16), "squeeze": (2, 4, 8, 16, 16, 16, 16)}  # px, by layer


def lpips(
    pred: Any,  # [H, W, 3] or [H, W], float in [0, 1] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W] bool; None is the whole frame
    *,
    net: str = "vgg",
    feed: str = "[-1,1]",
    background: float | tuple[float, ...] = 1.0,
    crop: Any = None,  # [H, W] bool
    hdr: bool = False,
) -> float:
    """LPIPS over the frame, or over a region; 0 for identical images.

    For a region both images are painted with `background` outside the mask and cut to the bounding rectangle of
    `crop` (of the mask, where none is given): nothing outside can leak in. What is smaller than `MIN_SIDE` is padded
    with grey. An empty mask gives NaN, a NaN or infinite pixel inside the region NaN. `hdr=True` takes floats of any
    range as they are. Raises `ValueError` for images that do not match or are none (`images.as_image`), for a
    background outside [0, 1] and for an unknown net or feed, `BadInput` when the trunk's weights are not here.
    """
    if net not in NETS or feed not in FEEDS:
        raise ValueError(f"lpips: expected net in {NETS} and feed in {FEEDS}, got {net!r}, {feed!r}")
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr)
    paint = as_background(background, 3).astype(np.float32)
    cut = None if crop is None else as_mask(crop, pred.shape, "crop")
    network = load(net)
    if isinstance(network, str):
        raise BadInput(network)
    rectangle = (slice(None), slice(None))
    if mask is not None:
        box = bounds(mask if cut is None else cut)
        if box is None or not mask.any():
            return math.nan
        rectangle = box
    x, y = (_as_float32(in_colour(image[rectangle])) for image in (pred, truth))
    if mask is not None:
        inside = mask[rectangle][..., None]
        x, y = (np.where(inside, image, paint) for image in (x, y))
    if x.size == 0 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        return math.nan
    return 0.0 if np.array_equal(x, y) else network.distance(padded(x), padded(y), feed)


def padded(
    image: NDArray,  # [H, W, 3]
) -> NDArray:
    """[H, W, 3] the image, grey to the right and below where it is smaller than `MIN_SIDE`."""
    short = [max(0, MIN_SIDE - side) for side in image.shape[:2]]
    if not any(short):
        return image
    return np.pad(image, ((0, short[0]), (0, short[1]), (0, 0)), constant_values=PADDING)


def lacking(net: str) -> str:
    """Why there is no LPIPS with this trunk here; "" when there is. Imports no torch."""
    if _random:
        return ""
    weights = locate(FILES[f"lpips-{net}"])
    return weights if isinstance(weights, str) else ""


# ----------------------------------------------------------------------------------------------------
# Networks


@dataclass(frozen=True)
class Network:
    """A trunk with LPIPS's linear heads."""

    net: str
    package: Any  # lpips.LPIPS, in evaluation mode

    def distance(
        self,
        pred: NDArray,  # [H, W, 3] float in [0, 1] or uint8
        truth: NDArray,  # as pred
        feed: str,
        tile: int = TILE,
    ) -> float:
        """LPIPS of two finite images [H, W, 3] in [0, 1], at least `MIN_SIDE` on each side, in tiles of `tile` px (a
        multiple of every stride)."""
        import torch

        height, width = pred.shape[:2]
        scale, shift = (2.0, -1.0) if feed == "[-1,1]" else (1.0, 0.0)
        totals = [0.0] * len(STRIDES[self.net])
        counts = [0] * len(totals)
        with torch.no_grad():
            for top in range(0, height, tile):
                for left in range(0, width, tile):
                    rows, row_core = _tile(top, height, tile)
                    columns, column_core = _tile(left, width, tile)
                    images = [
                        torch.from_numpy(np.ascontiguousarray(image[rows, columns].transpose(2, 0, 1), np.float32))
                        for image in (pred, truth)
                    ]
                    batch = torch.stack(images) * scale + shift
                    for layer, values in enumerate(self._layers(batch)):
                        stride = STRIDES[self.net][layer]
                        core = values[_core(row_core, stride), _core(column_core, stride)]
                        totals[layer] += float(core.sum(dtype=torch.float64))
                        counts[layer] += core.numel()
        return math.fsum(total / count for total, count in zip(totals, counts, strict=True))

    def _layers(self, batch: Any) -> Iterator[Any]:
        """[h, w] the weighted squared difference of the two images' features, layer by layer."""
        features = self.package.scaling_layer(batch)
        for layer in range(self.package.L):
            features = getattr(self.package.net, f"slice{layer + 1}")(features)
            norm = features.square().sum(1, keepdim=True).sqrt()
            unit = features / (norm + 1e-10)
            yield self.package.lins[layer]((unit[:1] - unit[1:]).square())[0, 0]


def _tile(start: int, length: int, tile: int) -> tuple[slice, tuple[int, int | None]]:
    """Pixels to read for the tile from `start`, and its core within them; None is the end of the image."""
    first, last = max(start - HALO, 0), min(start + tile + HALO, length)
    end = None if start + tile >= length else start + tile - first
    return slice(first, last), (start - first, end)


def _core(pixels: tuple[int, int | None], stride: int) -> slice:
    start, end = pixels
    return slice(start // stride, None if end is None else end // stride)


_lock = Lock()
_loaded: dict[str, Network] = {}
_random: dict[str, Network] = {}  # instead of them, inside `random_networks`


def load(net: str) -> Network | str:
    """The network, or the reason why there is none. Loaded once; safe from any thread."""
    with _lock:
        if _random:
            return _random[net]
        if net not in _loaded:
            weights = locate(FILES[f"lpips-{net}"])
            if isinstance(weights, str):
                return weights
            network = _read(net, weights)
            if isinstance(network, str):
                return network
            _loaded[net] = network
        return _loaded[net]


def _read(net: str, path: Path) -> Network | str:
    """The network with its trunk from a torchvision state dict."""
    package = _package(net)
    try:
        state = read_tensors(path)
        names = {name: f"features.{name.split('.', 1)[1]}" for name in package.net.state_dict()}
        package.net.load_state_dict({name: state[source] for name, source in names.items()})
    except (BadInput, RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        return f"{path}: not the weights of torchvision's {FILES[f'lpips-{net}'].file} ({type(error).__name__})"
    return Network(net, package)


def _package(net: str) -> Any:
    """`lpips.LPIPS` with the package's own linear heads and a trunk that is yet to be filled."""
    import lpips as package

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package uses torchvision arguments that are deprecated
        model = package.LPIPS(net=net, version="0.1", pretrained=False, pnet_rand=True, verbose=False)
    heads = Path(package.__file__).parent / "weights" / "v0.1" / f"{net}.pth"
    missing, unexpected = model.load_state_dict(read_tensors(heads), strict=False)
    if unexpected or any(re.match(r"lin\d", name) for name in missing):
        raise BadInput(f"{heads}: not the linear heads of LPIPS v0.1; install the lpips package again")
    return model.eval()


@cache
def _random_network(net: str, seed: int) -> Network:
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Network(net, _package(net))


@contextmanager
def random_networks(seed: int = 0) -> Iterator[dict[str, Network]]:
    """For checks and tests only: networks with a seeded random trunk instead of the real ones.

    Whatever is computed inside is no LPIPS of anything and must never reach a result.
    """
    for net in NETS:
        _random[net] = _random_network(net, seed)
    try:
        yield dict(_random)
    finally:
        _random.clear()


def _as_float32(image: NDArray) -> NDArray[np.float32]:
    """The image with peak 1."""
    return (image / np.float32(peak_of(image.dtype))).astype(np.float32)
