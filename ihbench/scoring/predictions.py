"""A folder of images that somebody else's code rendered, matched to the test views of a scene.

One image a test view, named by a pattern of the view's camera and frame. The default is the layout of a run's own
`renders/` folder, with the scene's name in front where a folder holds several scenes:

    {scene}/{camera}/{frame:06d}.png        {camera}/{frame:06d}.png

Placeholders: {scene}; {camera}, the data set's name for it; {camera_index} from 0; {frame} of the capture; {index},
the number of the test view in the protocol's order (all frames of a camera, then the next camera). A number may be
padded ({frame:06d}). `ihbench score --names` prints the file expected for each view.

Transparent images are composited on the protocol's background (see `files.images`). The colours of half transparent
pixels rule out two of the three ways to write them, or the user must say which it is.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.files.images import ALPHAS, read_channels, read_image
from ihbench.files.name_pattern import NamePattern
from ihbench.files.pictures import Header, header_of
from ihbench.metrics.images import Color
from ihbench.scene.views import TestViewKey

DEFAULT_PATTERNS = ("{scene}/{camera}/{frame:06d}.png", "{camera}/{frame:06d}.png")
WORDS, NUMBERS = ("scene", "camera"), ("camera_index", "frame", "index")  # placeholders
SUFFIXES = (".png", ".jpg", ".jpeg", ".npy")
ROUNDING = 2 / 255, 16 / 255  # of colours, in files with and without loss
MOST_SIZES = 100  # images of a scene whose size is looked at
SOME = 0.01  # share of pixels: fewer may be colours beyond white, which renderers clip
ENOUGH = 2000  # half transparent pixels


@dataclass(frozen=True)
class Predictions:
    """The images found for the test views of one scene, and what did not match."""

    root: Path
    pattern: str
    files: dict[TestViewKey, Path]
    missing: tuple[str, ...]  # paths expected below `root`, in the order of the views
    surplus: tuple[str, ...]  # image files below `root` that no view of any scene expects
    alpha: str = "straight"  # what the colours of transparent pixels are, one of ALPHAS

    @property
    def digest(self) -> str:
        """Hash of the images' bytes and what they stand for: other images make another run."""
        digest = hashlib.sha256(b"" if self.alpha == ALPHAS[0] else self.alpha.encode())
        for key, path in self.files.items():
            digest.update(f"{key.name}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()[:16]

    def read(self, key: TestViewKey, background: Color) -> NDArray | None:
        """The image of one view, [H, W, 3]; None where there is none. See `read_image`."""
        path = self.files.get(key)
        return None if path is None else read_image(path, background, self.alpha)

    def notes(self) -> list[str]:
        """What a reader of the scores must know, a line each."""
        lines = []
        if self.missing:
            lines.append(f"{len(self.missing)} of {len(self.missing) + len(self.files)} predictions are missing")
        if self.surplus:
            lines.append(f"{len(self.surplus)} image files in the folder match no test view")
        headers = [_header(path) for path in self.files.values() if path.suffix.lower() != ".npy"]
        for what, number in (
            ("are JPEG or the like: compression error counts as the method's", sum(h.lossy for h in headers)),
            ("are grey", sum(h.grey for h in headers)),
            ("have a palette, 256 colours at most", sum(h.palette for h in headers)),
        ):
            if number:
                lines.append(f"{number} predictions {what}")
        if self.alpha != ALPHAS[0]:
            lines.append(f"colours of transparent pixels are {self.alpha}")
        return lines


def find_predictions(
    root: Path, scene: str, keys: Sequence[TestViewKey], pattern: str | None = None, scenes: Sequence[str] = ()
) -> Predictions:
    """Match a folder's images to test views.

    Without a pattern the default under which most files are found is taken. `scenes` are all those that are scored
    from the folder: another scene's images are not surplus. Raises `BadInput` for a folder that is none, a pattern
    that is malformed, leaves the folder or names one file for two views, and when no view has an image.
    """
    candidates = {p: _expected(p, scene, keys) for p in (DEFAULT_PATTERNS if pattern is None else (pattern,))}
    pattern = max(candidates, key=lambda p: sum((root / name).is_file() for name in candidates[p].values()))
    names = candidates[pattern]
    present = {key: root / name for key, name in names.items() if (root / name).is_file()}
    every = {path: path.relative_to(root).as_posix() for path in image_files(root)}
    if not present:
        raise BadInput(
            f"predictions {root}: no image of any of the {len(keys)} test views of {scene}; expected "
            f"{_some(list(names.values()))}; found {_some(list(every.values()))}; "
            "say how they are named with --pattern"
        )
    known = set(present.values())
    for other in set(scenes) - {scene}:
        known |= {root / name for name in _expected(pattern, other, keys).values()}
    missing = tuple(names[key] for key in keys if key not in present)
    return Predictions(root, pattern, present, missing, tuple(name for p, name in every.items() if p not in known))


def image_files(root: Path) -> list[Path]:
    """Every image file below a folder, sorted. Raises `BadInput` for a folder that is none."""
    if not root.is_dir():
        raise BadInput(f"predictions {root}: no such folder; expected one image a test view")
    return sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())


def size_of_most(
    root: Path, scenes: Mapping[str, Sequence[TestViewKey]], pattern: str | None = None
) -> tuple[int, int]:
    """(longer side in px of most images of these test views, how many images there are); (0, 0) without any.

    Files that no view expects are not looked at. Raises `BadInput` for a pattern as `find_predictions` does.
    """
    sides: Counter[int] = Counter()
    count = 0
    for scene, keys in scenes.items():
        for one in DEFAULT_PATTERNS if pattern is None else (pattern,):
            paths = [root / name for name in dict.fromkeys(_expected(one, scene, keys).values())]
            paths = [path for path in paths if path.is_file()]
            count += len(paths)
            for path in paths[:MOST_SIZES]:
                array = path.suffix.lower() == ".npy"
                sides[max(read_channels(path).shape[:2] if array else _header(path).size)] += 1
    return (sides.most_common(1)[0][0], count) if sides else (0, 0)


def expected_names(pattern: str | None, scene: str, keys: Sequence[TestViewKey]) -> list[str]:
    """The file of each test view below the predictions' folder. Raises `BadInput` for a bad pattern."""
    names = _expected(pattern or DEFAULT_PATTERNS[0], scene, keys)
    return [names[key] for key in keys]


def find_alpha(files: Sequence[Path], background: Color, named: str | None = None) -> str:
    """What the colours of the files' transparent pixels are, one of ALPHAS; "straight" where none is transparent.

    Raises `BadInput` when the colours do not tell and none is `named`, and when they are not what is `named`.
    """
    if named is not None and named not in ALPHAS:
        raise BadInput(f"--alpha {named!r}: {registry.nearest(named, list(ALPHAS))}")
    against = {kind: np.zeros((2, 2)) for kind in ALPHAS[1:]}  # clear and half transparent pixels: all, in the way
    example = None
    for path in files:
        is_array = path.suffix.lower() == ".npy"
        if not is_array and not _header(path).alpha:
            continue
        image = read_channels(path)
        if image.shape[2] not in (2, 4):
            continue
        tolerance = ROUNDING[not is_array and _header(path).lossy]
        values = image / 255 if image.dtype == np.uint8 else image
        color, share = values[..., :-1], values[..., -1:]
        clear, half = share[..., 0] <= 0, (share[..., 0] > 0) & (share[..., 0] < 1)
        behind = np.asarray(background)[: color.shape[2]] * (1 - share)
        for kind, least in (("premultiplied", np.zeros(1)), ("composited", behind)):
            beyond = ((color < least - tolerance) | (color > least + share + tolerance)).any(2)
            against[kind] += [[some.sum(), (some & beyond).sum()] for some in (clear, half)]
        example = example or (path if half.any() else None)
        if named is None and against["composited"][1, 0] > ENOUGH and not _possible(against):
            break
    if example is None:
        return ALPHAS[0]
    possible = _possible(against)
    if named is None:
        if not possible:
            return ALPHAS[0]
        raise BadInput(
            f"prediction {example}: half transparent, with colours that may be straight or {' or '.join(possible)}; "
            f"say which with --alpha (premultiplied: times alpha; composited: on the background already)"
        )
    if named not in (ALPHAS[0], *possible):
        raise BadInput(
            f"--alpha {named}: prediction {example} and the others have colours that are not {named}; "
            f"expected --alpha {' or '.join((ALPHAS[0], *possible))}"
        )
    return named


def _possible(against: dict[str, NDArray]) -> list[str]:
    """The kinds of alpha that the colours of all pixels but a few agree with."""
    return [
        kind for kind, (clear, half) in against.items() if clear[1] <= SOME * clear[0] and half[1] <= SOME * half[0]
    ]


def _header(path: Path) -> Header:
    return header_of(path, f"prediction {path}")


def _expected(pattern: str, scene: str, keys: Sequence[TestViewKey]) -> dict[TestViewKey, str]:
    """The relative path of every view under a pattern."""
    parsed = NamePattern.parse(pattern, NUMBERS, WORDS)
    names: dict[TestViewKey, str] = {}
    for index, key in enumerate(keys):
        numbers = {"camera_index": key.camera, "frame": key.frame, "index": index}
        names[key] = parsed.name({"scene": scene, "camera": key.camera_id, **numbers})
    if len(set(names.values())) < len({(key.camera, key.frame) for key in names}):  # groups may share a view
        raise BadInput(
            f"--pattern {pattern!r}: names one file for several views; use {{camera}} and {{frame}}, or {{index}}"
        )
    return names


def _some(names: Sequence[str], most: int = 2) -> str:
    """The first names of a list, and how many more there are."""
    if not names:
        return f"no file that ends in {', '.join(SUFFIXES)}"
    return ", ".join(names[:most]) + (f", … ({len(names)} in all)" if len(names) > most else "")
