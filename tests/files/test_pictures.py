"""The one reader of picture files: every kind is right or refused in one line."""

import io
import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin

from ihbench.errors import BadInput
from ihbench.files.images import read_image
from ihbench.files.pictures import encoded, read_mask, read_picture, read_rgb, size_of

RGB = np.random.default_rng(0).integers(1, 255, (6, 5, 3)).astype(np.uint8)
GREY = RGB[..., 0]
DEEP = np.random.default_rng(1).integers(0, 65536, (6, 5, 3)).astype(np.uint16)
PERSON = np.zeros((6, 5), bool)
PERSON[1:4, 2:4] = True
LABELS = PERSON.astype(np.uint8)


def eight(deep):
    return np.rint(deep / 65535 * 255).astype(np.uint8)


def in_colour(grey):
    return np.repeat(grey[..., None], 3, 2)


def bits16(path, values):
    assert cv2.imwrite(str(path), values[..., ::-1] if values.ndim == 3 else values)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunk(path, kind, data):
    Image.fromarray(RGB).save(path)
    content = path.read_bytes()
    path.write_bytes(content[:33] + chunk(kind, data) + content[33:])


def saved(array, mode=None, **options):
    picture = Image.fromarray(array)
    return lambda path: (picture.convert(mode) if mode else picture).save(path, **options)


def with_palette(labels, *colours, **options):
    picture = Image.fromarray(labels)
    picture = picture.copy()
    picture.putpalette([value for colour in colours for value in colour])
    return lambda path: picture.save(path, **options)


def turned(path, kind="PNG", tag=6):
    exif = Image.Exif()
    exif[0x0112] = tag
    Image.fromarray(RGB).save(path, kind, exif=exif)


def display_p3():
    """A profile with wider primaries: sRGB's with its red column moved."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    at = data.index(b"rXYZ", 128)
    offset = struct.unpack(">I", data[at + 4 : at + 8])[0]
    data[offset + 8 : offset + 20] = struct.pack(">iii", *(round(v * 65536) for v in (0.515, 0.241, -0.001)))
    return bytes(data)


def raw(data):
    return lambda path: path.write_bytes(data)


def claims(width, height):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return raw(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", b"") * 2)


def interlaced(path):
    """Adam7 of one pixel: a single pass."""
    head = struct.pack(">IIBBBBB", 1, 1, 8, 2, 0, 0, 1)
    body = zlib.compress(b"\0" + bytes(RGB[0, 0]))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b""))


RIGHT = {
    "bit": (saved(PERSON), "a.png", in_colour(PERSON * np.uint8(255))),
    "grey": (saved(GREY), "a.png", in_colour(GREY)),
    "grey with alpha": (saved(np.dstack([GREY, LABELS * 255])), "a.png", in_colour(GREY)),
    "palette": (
        with_palette(LABELS, (9, 8, 7), (200, 100, 50)),
        "a.png",
        np.array([(9, 8, 7), (200, 100, 50)])[LABELS],
    ),
    "colour": (saved(RGB), "a.png", RGB),
    "colour with alpha": (saved(np.dstack([RGB, GREY])), "a.png", RGB),
    "16-bit grey PNG": (lambda p: bits16(p, DEEP[..., 0]), "a.png", in_colour(eight(DEEP[..., 0]))),
    "16-bit grey TIFF": (lambda p: bits16(p, DEEP[..., 0]), "a.tif", in_colour(eight(DEEP[..., 0]))),
    "16-bit grey PGM": (lambda p: bits16(p, DEEP[..., 0]), "a.pgm", in_colour(eight(DEEP[..., 0]))),
    "16-bit colour PNG": (lambda p: bits16(p, DEEP), "a.png", eight(DEEP)),
    "16-bit colour TIFF": (lambda p: bits16(p, DEEP), "a.tif", eight(DEEP)),
    "16-bit colour with alpha": (lambda p: cv2.imwrite(str(p), DEEP[..., [2, 1, 0, 1]]), "a.png", eight(DEEP)),
    "big-endian TIFF": (saved(DEEP[..., 0].astype(">u2")), "a.tif", in_colour(eight(DEEP[..., 0]))),
    "interlaced": (interlaced, "a.png", RGB[:1, :1]),
    "BMP by another name": (saved(RGB, format="BMP"), "a.png", RGB),
    "YCbCr TIFF": (saved(np.full_like(RGB, 128), "YCbCr"), "a.tif", np.full_like(RGB, 128)),
    "one-frame GIF": (saved(GREY), "a.gif", in_colour(GREY)),
    "sRGB's own profile": (
        saved(RGB, icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()),
        "a.png",
        RGB,
    ),
    "a gamma of 1/2.2": (lambda p: with_chunk(p, b"gAMA", struct.pack(">I", 45455)), "a.png", RGB),
    "sRGB's primaries": (
        lambda p: with_chunk(p, b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)),
        "a.png",
        RGB,
    ),
    "video of standard range": (lambda p: with_chunk(p, b"cICP", bytes([1, 1, 0, 1])), "a.png", RGB),
    "orientation upright": (lambda p: turned(p, tag=1), "a.png", RGB),
    "upper case": (saved(RGB, format="PNG"), "A.PNG", RGB),
}
REFUSED = {
    "floating-point TIFF": (saved(GREY.astype(np.float32)), "a.tif", "floating-point"),
    "floating-point colour TIFF": (
        lambda p: cv2.imwrite(str(p), RGB.astype(np.float32) / 255),
        "a.tif",
        "save it as PNG",
    ),
    "32-bit TIFF": (saved(GREY.astype(np.int32)), "a.tif", "32-bit"),
    "PFM": (lambda p: cv2.imwrite(str(p), RGB.astype(np.float32) / 255), "a.pfm", "PFM"),
    "PFM by another name": (raw(b"Pf\n1 1\n-1.0\n\0\0\0\0"), "a.png", "floating-point|PFM"),
    "Radiance HDR": (lambda p: cv2.imwrite(str(p), RGB.astype(np.float32) / 255), "a.hdr", "linear light"),
    "OpenEXR": (raw(b"v/1\x01" + bytes(20)), "a.exr", "OpenEXR.*linear light"),
    "HEIC": (raw(b"\0\0\0\x18ftypheic" + bytes(20)), "a.jpg", "HEIC"),
    "CMYK": (saved(RGB, "CMYK"), "a.jpg", "CMYK"),
    "Lab": (lambda p: Image.new("LAB", (5, 6)).save(p), "a.tif", "LAB"),
    "several frames PNG": (
        saved(RGB, save_all=True, append_images=[Image.fromarray(RGB[::-1].copy())]),
        "a.png",
        "2 pictures",
    ),
    "several frames GIF": (
        saved(GREY, save_all=True, append_images=[Image.fromarray(GREY[::-1].copy())]),
        "a.gif",
        "2 pictures",
    ),
    "several frames WebP": (
        saved(RGB, save_all=True, append_images=[Image.fromarray(RGB[::-1].copy())]),
        "a.webp",
        "2 pictures",
    ),
    "several pages": (saved(RGB, save_all=True, append_images=[Image.fromarray(RGB)]), "a.tif", "2 pictures"),
    "turned PNG": (turned, "a.png", "orientation"),
    "turned JPEG": (lambda p: turned(p, "JPEG", 3), "a.jpg", "orientation"),
    "turned TIFF": (lambda p: turned(p, "TIFF", 6), "a.tif", "orientation"),
    "mirrored WebP": (lambda p: turned(p, "WEBP", 2), "a.webp", "orientation"),
    "wider colours": (saved(RGB, icc_profile=display_p3()), "a.png", "not sRGB"),
    "a damaged profile": (saved(RGB, icc_profile=b"no profile"), "a.png", "profile that cannot be read"),
    "wide primaries": (
        lambda p: with_chunk(p, b"cHRM", struct.pack(">8I", 31270, 32900, 70800, 29200, 17000, 79700, 13100, 4600)),
        "a.png",
        "primaries",
    ),
    "HDR video": (lambda p: with_chunk(p, b"cICP", bytes([9, 18, 0, 1])), "a.png", r"BT\.2020, HDR \(HLG\)"),
    "linear light": (lambda p: with_chunk(p, b"gAMA", struct.pack(">I", 100000)), "a.png", "linear light"),
    "white is zero, 16 bits": (saved(DEEP[..., 0], tiffinfo={262: 0}), "a.tif", "inverted"),
    "cut short": (raw(b"\x89PNG\r\n\x1a\n"), "a.png", "cut short"),
    "empty": (raw(b""), "a.png", "empty"),
    "a web page": (raw(b"<html>404</html>"), "a.png", "web page"),
    "a pointer": (raw(b"version https://git-lfs.github.com/spec/v1\n"), "a.png", "git lfs pull"),
    "a bomb": (claims(60000, 60000), "a.png", "pixels"),
    "a smaller bomb": (claims(12000, 12000), "a.png", "12000×12000 px"),
    "no pixels": (claims(0, 4), "a.png", "image"),
    "a folder": (lambda p: p.mkdir(), "a.png", "folder"),
    "a pipe": (os.mkfifo, "a.png", "no regular file"),
}


@pytest.mark.parametrize("kind", RIGHT)
def test_what_is_read_is_right(tmp_path, kind, recwarn):
    write, name, expected = RIGHT[kind]
    write(tmp_path / name)
    np.testing.assert_array_equal(read_rgb(tmp_path / name), expected)
    assert size_of(tmp_path / name) == expected.shape[1::-1]
    assert not recwarn.list


@pytest.mark.parametrize("kind", REFUSED)
@pytest.mark.parametrize(
    "read", [read_rgb, lambda path: read_image(path, (1.0, 1.0, 1.0))], ids=["data", "prediction"]
)
def test_what_cannot_be_read_rightly_is_refused_in_one_line(tmp_path, kind, read, recwarn):
    write, name, words = REFUSED[kind]
    write(tmp_path / name)
    with pytest.raises(BadInput, match=words) as error:
        read(tmp_path / name)
    assert name in str(error.value)
    assert "\n" not in str(error.value)
    assert not recwarn.list


def test_ordinary_pictures_are_what_pillow_makes_of_them(tmp_path):
    for mode in ("1", "L", "LA", "P", "RGB", "RGBA"):
        Image.fromarray(RGB).convert(mode).save(tmp_path / "a.png")
        np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), Image.open(tmp_path / "a.png").convert("RGB"))
    Image.fromarray(np.tile(RGB, (4, 4, 1))).save(tmp_path / "a.jpg")
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.jpg"), Image.open(tmp_path / "a.jpg"))


def test_colours_of_data_that_may_be_multiplied_with_alpha_are_refused(tmp_path):
    Image.fromarray(np.dstack([np.minimum(RGB, GREY[..., None]), GREY])).save(tmp_path / "a.png")
    with pytest.raises(BadInput, match="multiplied with alpha; save it without alpha"):
        read_rgb(tmp_path / "a.png")
    cut_out = np.dstack([RGB * LABELS[..., None], LABELS * 255])  # nothing half transparent
    Image.fromarray(cut_out).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png"), cut_out[..., :3])


@pytest.mark.parametrize("white", [255, 1023, 4095])
def test_fewer_bits_stored_in_sixteen_are_refused_as_colours_not_as_labels(tmp_path, white):
    bits16(tmp_path / "a.png", LABELS.astype(np.uint16) * np.uint16(white))
    with pytest.raises(BadInput, match=f"no value above {white} of 65535"):
        read_rgb(tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png", "half"), PERSON)
    bits16(tmp_path / "a.png", np.zeros((4, 4), np.uint16))
    assert not read_rgb(tmp_path / "a.png").any()


@pytest.mark.parametrize("mode", ["P", "RGB", "L"])
def test_a_transparent_colour_of_a_prediction_shows_the_background(tmp_path, mode):
    picture = Image.fromarray(LABELS * 200).convert(mode)
    picture.save(tmp_path / "a.png", transparency=(0, 0, 0) if mode == "RGB" else 0)
    image = read_image(tmp_path / "a.png", (1.0, 0.5, 0.0))
    np.testing.assert_allclose(image[~PERSON], np.broadcast_to((1.0, 0.5, 0.0), image[~PERSON].shape))
    np.testing.assert_allclose(image[PERSON] * 255, 200)


def test_a_phones_jpeg_with_a_preview_behind_it_is_its_first_picture(tmp_path):
    Image.fromarray(RGB).save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[Image.fromarray(RGB[:2, :2])])
    assert read_rgb(tmp_path / "a.jpg").shape == RGB.shape
    assert read_picture(tmp_path / "a.jpg").lossy


# ------------------------------------------------------------------------------------------------------ masks

OPAQUE = np.full_like(LABELS, 255)
FAINT = np.where(PERSON, 40, 0).astype(np.uint8)
SOFT = np.where(PERSON, 200, 100).astype(np.uint8)
MASKS = {  # written, file name -> whether it is PERSON as "non-zero" and as "half"
    "0 and 1": (saved(LABELS), True, True),
    "0 and 255": (saved(LABELS * 255), True, True),
    "one bit": (saved(PERSON), True, True),
    "a faint label": (saved(FAINT), True, True),
    "grey on grey": (saved(SOFT), False, True),
    "blue": (saved(np.dstack([LABELS * 0, LABELS * 0, LABELS * 255])), True, True),
    "16 bits": (saved(LABELS.astype(np.uint16) * 65535), True, True),
    "16-bit labels": (saved(LABELS.astype(np.uint16) * 3), True, True),
    "16 bits, soft": (saved(np.where(PERSON, 40000, 20000).astype(np.uint16)), False, True),
    "labels in a palette": (with_palette(LABELS, (0, 0, 0), (0, 128, 0)), True, True),
    "an opaque alpha channel": (saved(np.dstack([LABELS * 255] * 3 + [OPAQUE])), True, True),
    "the same in the alpha channel": (saved(np.dstack([LABELS * 255] * 4)), True, True),
}
NO_MASKS = {
    "black, with the mask in alpha": (saved(np.dstack([LABELS * 0] * 3 + [LABELS * 255])), "a.png", "alpha"),
    "white, with the mask in alpha": (saved(np.dstack([OPAQUE] * 3 + [LABELS * 255])), "a.png", "alpha"),
    "a black label on white in a palette": (with_palette(LABELS, (255, 255, 255), (0, 0, 0)), "a.png", "palette"),
    "a black background that is no label 0": (
        with_palette(LABELS + 1, (9, 9, 9), (0, 0, 0), (255, 255, 255)),
        "a.png",
        "palette",
    ),
    "compressed with loss": (saved(LABELS * 255, format="JPEG"), "a.png", "lossy"),
    "floating-point": (saved(PERSON.astype(np.float32)), "a.tif", "floating-point"),
    "turned": (turned, "a.png", "orientation"),
}


@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize("person", ["non-zero", "half"])
def test_masks(tmp_path, kind, person):
    write, nonzero, half = MASKS[kind]
    write(tmp_path / "a.png")
    mask = read_mask(tmp_path / "a.png", person)
    assert mask.dtype == bool
    assert (mask == PERSON).all() == (nonzero if person == "non-zero" else half)


@pytest.mark.parametrize("kind", NO_MASKS)
def test_masks_that_say_two_things_are_refused(tmp_path, kind):
    write, name, words = NO_MASKS[kind]
    write(tmp_path / name)
    with pytest.raises(BadInput, match=words):
        read_mask(tmp_path / name, "non-zero")


def test_a_mask_of_channel_0_is_just_that(tmp_path):
    saved(np.dstack([LABELS, OPAQUE, OPAQUE]))(tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png", "first channel"), PERSON)


def test_a_masks_colours_have_no_profile(tmp_path):
    info = PngImagePlugin.PngInfo()
    info.add(b"gAMA", struct.pack(">I", 100000))
    Image.fromarray(LABELS * 255).save(tmp_path / "a.png", pnginfo=info)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png", "non-zero"), PERSON)


def test_every_damage_to_a_file_is_bad_input(tmp_path):
    """Bytes flipped and files cut, of every format: read, or refused in one line."""
    random, refused = np.random.default_rng(0), []
    for kind in ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM", "TGA", "GIF"):
        buffer = io.BytesIO()
        Image.fromarray(RGB).save(buffer, kind)
        for _ in range(40):
            data = bytearray(buffer.getvalue())
            for at in random.integers(0, len(data), 3):
                data[at] = random.integers(256)
            (tmp_path / "a.png").write_bytes(data[: random.integers(1, len(data) + 1)])
            try:
                assert read_rgb(tmp_path / "a.png").ndim == 3
            except BadInput as error:
                refused.append(str(error))
    assert 100 < len(refused) < 320
    assert not any("\n" in line for line in refused)


@pytest.mark.parametrize(
    ("picture", "word"),
    [
        (np.zeros((4, 5, 3)), "multiplied by 255"),
        (np.full((4, 5, 3), 200.0), "round them"),
        (np.zeros((3, 4, 5), np.uint8), "channels last"),
        (np.zeros((4, 5, 4), np.uint8), "leave the alpha"),
        (np.zeros((4, 5), np.uint16), "divided by 257"),
        (np.zeros((4, 5), int), "astype"),
    ],
)
def test_only_8_bit_pictures_are_encoded(picture, word):
    with pytest.raises(ValueError, match=f"expected uint8.*{word}"):
        encoded(picture, "PNG")


def test_8_bits_in_16_may_be_dark(tmp_path):
    dark = np.arange(16, dtype=np.uint16).reshape(4, 4)
    cv2.imwrite(str(tmp_path / "a.png"), 257 * np.repeat(dark[..., None], 3, 2))
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.png")[..., 0], dark)
