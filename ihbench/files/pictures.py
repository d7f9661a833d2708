"""The one reader of picture files: every kind comes out right, or is refused with one line.

Colour is sRGB as stored. What would have to be guessed is refused: other colour spaces and profiles, an orientation
tag (cameras and masks may belong to the stored or to the turned picture), several frames, floating-point values,
which mostly are linear light, and masks whose palette or alpha channel contradicts their colours.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput, BadValue
from ihbench.files import atomic

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM", "TGA", "GIF")
MOST_PIXELS = 2**30 // 12  # 9459 px square: what a header may ask for
PLAIN_GAMMA = (0.42, 0.48)  # of a PNG's gAMA: 1/2.2 by any rounding
SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # primaries, x and y
WIDE = {9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}  # primaries, by their number in ITU-T H.273
HIGH_RANGE = {8: "linear light", 16: "HDR (PQ)", 18: "HDR (HLG)"}  # transfer functions, likewise
SAME_COLOUR = 12  # levels by which a profile that calls itself sRGB, or a gamma of 2.2, may differ from it
SOME = 0.01  # share of pixels that say nothing: renderers clip colours beyond white
JPEG_QUALITY = 95
TWELVE_BITS = 4095  # a picture as dark as that in 16 bits holds fewer
ORIENTATION = 0x0112  # the EXIF tag
WHITE_IS_ZERO, SAMPLE_FORMAT = 262, 339  # TIFF tags
CONVERTED = {"P": "RGB", "PA": "RGBA", "1": "L", "La": "LA", "YCbCr": "RGB", "RGBX": "RGB"}  # modes of Pillow
OTHER_FILES = {  # what a file that is no such picture begins with -> what it is and what helps
    b"v/1\x01": "OpenEXR, which holds linear light; save it as sRGB in PNG",
    b"#?": "Radiance HDR, which holds linear light; save it as sRGB in PNG",
    (b"PF", b"Pf"): "PFM, floating-point; save it as sRGB in PNG",
    (b"II", b"MM"): "a kind of TIFF that is not read (floating-point, perhaps); save it as PNG",
    (b"\x00\x00\x00\x0cjP", b"\xff\x4f\xff\x51"): "JPEG 2000; save it as PNG",
    (b"\x00\x00\x00\x0cJXL", b"\xff\x0a"): "JPEG XL; save it as PNG",
    b"8BPS": "Photoshop; save it as PNG",
    b"%PDF": "PDF; save it as PNG",
    b"\x93NUMPY": "a numpy array; name it .npy",
    b"version https://git-lfs": "a Git LFS pointer, not the picture; fetch it with `git lfs pull`",
    b"<": "text (a web page, perhaps), not the picture; copy the file again",
}


@dataclass(frozen=True)
class Picture:
    """A decoded picture. 16-bit values are scaled so that white is 65535."""

    values: NDArray[np.uint8] | NDArray[np.uint16]  # [H, W, C]: 1 grey, 2 with alpha, 3 RGB, 4 with alpha (straight)
    lossy: bool
    labels: NDArray[np.uint8] | None = None  # [H, W] indices into a palette

    @property
    def white(self) -> int:
        return 255 if self.values.dtype == np.uint8 else 65535

    @property
    def colour(self) -> NDArray[Any]:
        """[H, W, 1 or 3] without alpha."""
        return self.values[..., : self.values.shape[2] - (self.values.shape[2] in (2, 4))]

    @property
    def alpha(self) -> NDArray[Any] | None:
        """[H, W]; None without an alpha channel, and with one that is opaque everywhere."""
        alpha = self.values[..., -1] if self.values.shape[2] in (2, 4) else None
        return None if alpha is None or (alpha == self.white).all() else alpha


@dataclass(frozen=True)
class Header:
    """What a picture file says before it is decoded."""

    size: tuple[int, int]  # px, width and height
    alpha: bool  # whether some pixels may be transparent
    grey: bool
    palette: bool
    lossy: bool


def header_of(path: Path, name: str = "") -> Header:
    """Raises `BadInput` for what is no picture. `name` stands in messages for the path."""
    with _opened(path, name or str(path)) as picture:
        mode = picture.mode
        return Header(
            picture.size,
            mode in ("LA", "La", "PA", "RGBA") or "transparency" in picture.info,
            mode in ("1", "L", "LA", "La") or mode.startswith("I"),
            mode in ("P", "PA"),
            _lossy(picture, path),
        )


def size_of(path: Path) -> tuple[int, int]:
    """(width, height) px by the header. Raises `BadInput`."""
    return header_of(path).size


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """[H, W, 3] as stored, 16 bits rounded to 8, grey in three channels, a straight alpha channel dropped.

    Raises `BadInput`.
    """
    picture = read_picture(path)
    colour, alpha = picture.colour, picture.alpha
    if alpha is not None and _may_be_premultiplied(colour, alpha, picture.white):
        raise BadInput(
            f"{path}: its half transparent pixels look as if they were multiplied with alpha; save it without "
            f"alpha, on a background"
        )
    if colour.dtype != np.uint8:
        if 0 < colour.max() <= TWELVE_BITS and (colour % 257).any():  # 8 bits, rightly scaled, may be dark
            raise BadInput(
                f"{path}: 16 bits a channel, but no value above {colour.max()} of 65535; scale what has 8, 10 or 12 "
                f"bits, so that white is 65535"
            )
        colour = ((colour.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)
    return np.repeat(colour, 3, 2) if colour.shape[2] == 1 else np.ascontiguousarray(colour)


def _may_be_premultiplied(colour: NDArray[Any], alpha: NDArray[Any], white: int) -> bool:
    """Whether next to none of the half transparent pixels is brighter than its alpha."""
    half = (alpha > 0) & (alpha < white)
    brightest = colour[half].max(1).astype(np.int64)
    return bool(half.any()) and float((brightest > alpha[half] + np.int64(2 * white // 255)).mean()) <= SOME


def read_mask(path: Path, person: str) -> NDArray[np.bool_]:
    """[H, W], True = person. Raises `BadInput`.

    `person` says what is person: "non-zero", in any channel, where a palette counts by its labels; "first channel"
    non-zero, a palette by its colours; or "half", as bright as half of white, or any label of a picture that has two
    values. An alpha channel may be there if it says the same as the colours.
    """
    picture = read_picture(path, colours_matter=False)
    if person == "first channel":
        mask = picture.colour[..., 0] != 0
    elif person == "non-zero":
        mask = picture.colour.max(2) != 0 if picture.labels is None else _labelled(picture, path)
    else:
        mask = above_half(picture.colour.max(2), picture.white)
    if picture.lossy and person != "half":
        raise BadInput(
            f"{path}: a mask with lossy compression, whose noise around the person would count as person; "
            f"expected PNG, 0 where the person is not"
        )
    alpha = picture.alpha
    if alpha is not None and ((alpha > 0 if person != "half" else alpha > picture.white / 2) != mask).any():
        raise BadInput(
            f"{path}: its alpha channel and its colours are different masks; save the one that is meant as grey, "
            f"0 where the person is not (the alpha channel: Image.open(path).getchannel('A').save(path))"
        )
    return mask


def above_half(values: NDArray[Any], white: float) -> NDArray[np.bool_]:
    """Where a soft mask is above one half of `white`; of two values, 0 and a smaller label, where the label is."""
    if not values.size:
        return np.zeros(values.shape, bool)
    lowest, highest = values.min(), values.max()
    if lowest == 0 < highest <= white / 2 and np.isin(values, (lowest, highest)).all():
        return values != 0
    return values > white / 2


def read_picture(path: Path, name: str = "", colours_matter: bool = True) -> Picture:
    """Decode one picture. `name` stands in messages for the path; `colours_matter` not where they are labels.

    Raises `BadInput` for what is damaged, and for what cannot be read rightly.
    """
    name = name or str(path)
    with _opened(path, name) as picture:
        header = dict(picture.info)
        if picture.format == "TIFF":
            header["orientation"] = picture.tag_v2.get(ORIENTATION)  # type: ignore[attr-defined]
        tiles = [str(getattr(tile, "args", "")) for tile in getattr(picture, "tile", ())]
        try:
            frames = 1 if picture.format == "MPO" else getattr(picture, "n_frames", 1)  # phones add previews
            if frames == 1:
                picture.load()
        except Exception as error:  # a damaged file may raise anything
            raise BadInput(
                f"{name}: damaged or cut short, cannot be read as an image ({one_line(error)}); copy the file again"
            ) from error
        if frames > 1:
            raise BadInput(f"{name}: holds {frames} pictures; expected one, save each as a file of its own")
        if picture.format == "PNG":
            header["cicp"] = _code_points(path)
        _refuse(picture, header, name, colours_matter)
        lossy = _lossy(picture, path)
        if picture.mode in ("RGB", "RGBA", "LA") and any(";16" in tile for tile in tiles):
            return Picture(_deep(path, name, tiles), lossy)
        labels = np.array(picture) if picture.mode == "P" else None
        return Picture(_values(picture, tiles, name), lossy, labels)


def encoded(picture: NDArray[np.uint8], kind: str, **options: int) -> bytes:
    """The file of a picture [H, W] or [H, W, 3], in memory. Raises `ValueError` for anything else."""
    from PIL import Image

    if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or (picture.ndim == 3 and picture.shape[2] != 3):
        if picture.ndim == 3 and picture.shape[2] in (2, 4):
            word = "leave the alpha channel out"
        elif picture.ndim != 2 and picture.shape[-1] != 3:
            word = "one picture, its channels last"
        elif picture.dtype.kind == "f":
            word = "floats in 0..1 are multiplied by 255 first" if picture.max(initial=0) <= 2 else "round them first"
        else:
            word = "16 bits are divided by 257" if picture.dtype == np.uint16 else "astype(np.uint8) of 0 to 255"
        shape = picture.shape
        raise BadValue(f"picture: expected uint8 [H, W] or [H, W, 3], got {picture.dtype} {shape}; {word}")

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, **options)
    return buffer.getvalue()


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """A picture file of a data set by its name's ending: JPEG of quality 95, else PNG."""
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    data = encoded(picture, "JPEG", quality=JPEG_QUALITY) if jpeg else encoded(picture, "PNG", compress_level=3)
    atomic.write_bytes(path, data, durable=False)


def one_line(error: object) -> str:
    return " ".join(str(error).split())[:120]


def _opened(path: Path, name: str) -> Image.Image:
    from PIL import Image, UnidentifiedImageError

    warnings.filterwarnings("ignore", module=r"PIL\.")  # lines on stderr about what is refused here anyway
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise BadInput(f"{name}: is {'a folder' if path.is_dir() else 'no regular file'}; expected a picture file")
    try:
        picture = Image.open(path, formats=FORMATS)
    except UnidentifiedImageError as error:
        raise BadInput(f"{name}: cannot be read as an image: {_kind(path)}") from error
    except Exception as error:  # a damaged file may raise anything
        raise BadInput(f"{name}: cannot be read as an image ({one_line(error)}); copy the file again") from error
    width, height = picture.size
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        picture.close()
        raise BadInput(f"{name}: {width}×{height} px; expected 1 to {MOST_PIXELS:,} pixels, copy the file again")
    return picture


def _kind(path: Path) -> str:
    """What a file that Pillow does not know is, and what helps."""
    with open(path, "rb") as file:
        start = file.read(64)
    if not start:
        return "it is empty; copy the file again"
    if start[4:8] == b"ftyp":
        return "HEIC, AVIF or a video; save it as PNG"
    for magic, kind in OTHER_FILES.items():
        if start.lstrip().startswith(magic):
            return kind
    return f"cut short, or none of {', '.join(FORMATS)}; copy the file again"


def _refuse(picture: Image.Image, header: dict[Any, Any], name: str, colours_matter: bool) -> None:
    """Raise `BadInput` for a picture that says of itself that its pixels are not simply what they look like."""
    turned = _orientation(picture, header)
    if turned not in (0, 1):
        raise BadInput(
            f"{name}: its orientation tag ({turned}) says: shown turned or mirrored; save it without the tag, "
            f"its pixels as the camera and masks have them (turned: mogrify -auto-orient; as they are: "
            f"exiftool -Orientation= )"
        )
    if not colours_matter:
        return
    profile, gamma = header.get("icc_profile"), header.get("gamma")
    primaries, transfer = header.get("cicp", (2, 2))
    if primaries in WIDE or transfer in HIGH_RANGE:
        raise BadInput(
            f"{name}: its colours are {WIDE.get(primaries, 'sRGB')}, {HIGH_RANGE.get(transfer, 'standard range')}; "
            f"expected sRGB, convert the video or the picture to it"
        )
    if profile and (other := _other_colours(bytes(profile))):
        raise BadInput(
            f"{name}: its colours are not sRGB but {other}; convert it to sRGB and save it without a profile"
        )
    if profile or "srgb" in header:
        return
    corners = header.get("chromaticity", ())[2:]  # of a PNG's cHRM, after the white point
    if len(corners) == 6 and np.abs(np.subtract(corners, SRGB)).max() > 0.02:
        raise BadInput(f"{name}: its primaries are not sRGB's; convert it to sRGB, or remove a wrong cHRM")
    if gamma and not PLAIN_GAMMA[0] <= gamma <= PLAIN_GAMMA[1]:
        raise BadInput(
            f"{name}: its gamma is {gamma:g} (1 is linear light); expected sRGB, convert it or remove a wrong gAMA"
        )


def _code_points(path: Path) -> tuple[int, int]:
    """(primaries, transfer) of a PNG's cICP, as ffmpeg writes it, by ITU-T H.273; (2, 2), unknown, without."""
    with open(path, "rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8:
            length, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind == b"IDAT":
                break
            if kind == b"cICP":
                content = file.read(2)
                return (content[0], content[1]) if len(content) == 2 else (2, 2)
            file.seek(length + 4, 1)
    return 2, 2


def _orientation(picture: Image.Image, header: dict[Any, Any]) -> int:
    if picture.format == "TIFF":  # Pillow turns these by itself when it decodes them, and forgets the tag
        return int(header.get("orientation") or 1)
    try:
        return int(picture.getexif().get(ORIENTATION, 1))
    except Exception:  # damaged metadata turn nothing
        return 1


@lru_cache(maxsize=64)
def _other_colours(profile: bytes) -> str | None:
    """The name of a colour profile under which colours are others than in sRGB; None where they are the same."""
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = one_line(ImageCms.getProfileDescription(source)) or "of a profile without a name"
        steps = np.linspace(0, 255, 6).round().astype(np.uint8)
        stored: Any = source.profile
        mode = {"RGB": "RGB", "GRAY": "L"}.get(stored.xcolor_space.strip())
        if mode is None:
            return repr(name)
        colours = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(36, 6, 3)
        swatch = Image.fromarray(colours).convert(mode)
        shown = ImageCms.profileToProfile(
            swatch, source, ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC, outputMode="RGB"
        )
        assert shown is not None
        error = np.abs(np.asarray(shown).astype(int) - np.asarray(swatch.convert("RGB"))).max()
    except Exception:
        return "of a colour profile that cannot be read"
    return repr(name) if error > SAME_COLOUR else None


def _values(picture: Image.Image, tiles: list[str], name: str) -> NDArray[Any]:
    """[H, W, C] uint8 or uint16 of a loaded picture."""
    tags = getattr(picture, "tag_v2", {})
    sample_format = tags.get(SAMPLE_FORMAT, (1,))
    odd_samples = any(kind != 1 for kind in (sample_format if isinstance(sample_format, tuple) else (sample_format,)))
    mode, transparent = picture.mode, "transparency" in picture.info
    if mode in ("I;16", "I;16B", "I;16L", "I;16N") or (mode == "I" and picture.format in ("PNG", "PPM")):
        if transparent or odd_samples or tags.get(WHITE_IS_ZERO, 1) == 0:
            raise BadInput(
                f"{name}: a 16-bit picture with inverted, signed or transparent values; save it as 8-bit PNG"
            )
        values = np.array(picture).astype(np.uint32)
        if any("I;12" in tile for tile in tiles):
            values = (values * 65535 + 2047) // 4095
        return values.astype(np.uint16)[..., None]
    if odd_samples or mode in ("F", "I"):
        raise BadInput(
            f"{name}: {'floating-point' if mode == 'F' else 'signed or 32-bit'} values, whose white nobody knows; "
            f"expected 8 or 16 bits, save it as sRGB in PNG"
        )
    if transparent and mode in ("1", "L", "RGB", "P"):
        picture = picture.convert("RGBA")
    elif mode in CONVERTED:
        picture = picture.convert(CONVERTED[mode])
    elif mode not in ("L", "LA", "RGB", "RGBA"):
        raise BadInput(f"{name}: {mode} colours; expected grey or sRGB, convert it and save it as PNG")
    values = np.array(picture)
    return values[..., None] if values.ndim == 2 else values


def _deep(path: Path, name: str, tiles: list[str]) -> NDArray[np.uint16]:
    """[H, W, 3 or 4] of a picture of 16 bits a channel, of which Pillow keeps eight."""
    import cv2

    odd = any("RGBa" in tile or "X" in tile for tile in tiles)
    try:
        deep = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        deep = None
    if odd or deep is None or deep.dtype != np.uint16 or deep.ndim != 3 or deep.shape[2] not in (3, 4):
        raise BadInput(f"{name}: 16 bits a channel of a kind that is not read; save it as 16-bit RGB in PNG")
    return deep[..., [2, 1, 0, 3][: deep.shape[2]]].astype(np.uint16)  # OpenCV has blue first


def _labelled(picture: Picture, path: Path) -> NDArray[np.bool_]:
    """[H, W] of a palette's labels, where label 0 is the background whatever the others are painted in."""
    assert picture.labels is not None
    used, first = np.unique(picture.labels, return_index=True)
    painted = picture.colour.reshape(-1, picture.colour.shape[2])[first].max(1) > 0  # not black
    if painted[0] if used[0] == 0 else painted.any() and not painted.all():
        raise BadInput(
            f"{path}: a palette in which label 0 is not the black background; save the mask as grey, 0 where the "
            f"person is not"
        )
    return picture.labels != 0


def _lossy(picture: Image.Image, path: Path) -> bool:
    if picture.format != "WEBP":
        return picture.format in ("JPEG", "MPO")
    with open(path, "rb") as file:
        return b"VP8 " in file.read(2**16)
