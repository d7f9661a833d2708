"""Simple inpainting: each fill is exactly the trivial thing that it says it is."""

from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest

from ihbench.body import texel_table
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.part_map import smpl_parts
from ihbench.diffusion.inpaint_config import Filler
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.inpainting.colour_fills import GREY, IMAGE_FILLS, MeanColour
from ihbench.methods.inpainthuman.inpainting.simple_inpainters import simple_inpainters
from ihbench.methods.inpainthuman.inpainting.surface_colours import counted_colours, off_the_rim, pixel_texels
from ihbench.methods.inpainthuman.inpainting.texture_fills import (
    MirroredTexture,
    TemporalCopy,
    mirrored_texels,
    nearest_colours,
)
from ihbench.metrics import psnr
from ihbench.scene.visibility import PosedSurface
from tests.bench.fake_capture import the_body

from .hidden_person import (
    STRIP,
    WHITE,
    all_unknown,
    crop,
    nothing_unknown,
    pattern,
    plain,
    symmetric_pattern,
    truth,
    two_sided,
)

BODY = the_body()
BLUE = (0.2, 0.4, 1.0)
NAMES = list(simple_inpainters(BODY, WHITE))
TEXELS = 128
RED, GREEN = (0.8, 0.2, 0.1), (0.1, 0.7, 0.3)


def fill(filler, views):
    return filler.inpaint(views, Progress.silent())


def eight_bit(rgb):
    return np.round(255 * np.array(rgb)).astype(np.uint8)


@pytest.fixture(scope="module")
def views():
    """Three sides of the person; two of the views have the strip."""
    return [crop(0, pattern(), 0.0, STRIP), crop(1, pattern(), 0.4), crop(2, pattern(), 0.8, STRIP)]


# -------------------------------------------------------------------------------------------- all of them


def test_the_table_has_every_name_of_the_switch():
    table = simple_inpainters(BODY, WHITE)
    assert ["diffusion", *table] == list(get_args(Filler))
    assert all(filler.name == name for name, filler in table.items())


@pytest.mark.parametrize("name", NAMES)
def test_known_pixels_stay_and_unknown_ones_change(name, views):
    shown = [replace(v, image=np.where(v.unknown[..., None], np.uint8(3), v.image)) for v in views]
    before = [view.image.copy() for view in shown]
    filler = simple_inpainters(BODY, BLUE)[name]
    out = fill(filler, shown)
    assert len(out) == 3
    for view, old, new in zip(shown, before, out, strict=True):
        assert new.dtype == np.uint8
        assert new.shape == view.image.shape
        assert np.array_equal(view.image, old), "the input was written to"
        assert np.array_equal(new[~view.unknown], view.image[~view.unknown])
        if view.unknown.any():
            assert (new[view.unknown] != 3).any(1).mean() > 0.99
    # what the unknown pixels are painted with beforehand is of no account
    again = fill(filler, [replace(v, image=np.where(v.unknown[..., None], np.uint8(200), v.image)) for v in views])
    assert all(np.array_equal(a, b) for a, b in zip(out, again, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_unknown_and_no_views(name, views):
    filler = simple_inpainters(BODY, WHITE)[name]
    assert fill(filler, []) == []
    view = nothing_unknown(views[0])
    assert np.array_equal(fill(filler, [view])[0], view.image)


@pytest.mark.parametrize("name", NAMES)
def test_a_view_without_a_known_pixel(name, views):
    """Alone it is grey (on the body, where a fill knows the body); beside others the person's colours help."""
    view, filler = all_unknown(views[0]), simple_inpainters(BODY, BLUE)[name]
    (alone,) = fill(filler, [view])
    on = np.ones_like(view.body) if filler in IMAGE_FILLS else view.body
    assert (alone[on] == GREY).all()
    assert (alone[~on] == eight_bit(BLUE)).all()
    beside = fill(filler, [view, views[1]])[0]
    assert (beside[view.body] != GREY).any() == (filler not in IMAGE_FILLS)


# -------------------------------------------------------------------------------------------- colour


def test_mean_colour_is_the_views_own_mean(views):
    out = fill(MeanColour(BLUE), views)
    for view, image in zip(views, out, strict=True):
        on, off = view.unknown & view.body, view.unknown & ~view.body
        mean = view.image[view.person].mean(0)
        assert (np.abs(image[on] - mean) <= 0.5 + 1e-9).all()
        assert (image[off] == eight_bit(BLUE)).all()
    assert not np.array_equal(
        out[0][views[0].unknown & views[0].body][0], out[2][views[2].unknown & views[2].body][0]
    )


def test_mean_colour_of_a_view_that_shows_nobody_is_that_of_all(views):
    pixels = np.concatenate([view.image[view.person] for view in views[1:]])
    image = fill(MeanColour(BLUE), [all_unknown(views[0]), *views[1:]])[0]
    assert (np.abs(image[views[0].body] - pixels.mean(0)) <= 0.5 + 1e-9).all()


@pytest.mark.parametrize("filler", IMAGE_FILLS, ids=lambda f: f.name)
def test_a_plain_crop_is_continued(filler, views):
    """To the image's edges too; the extrapolation of Telea's and FSR overshoots by a few levels."""
    off_by = 10 if filler.name in ("telea", "fsr") else 1
    view = replace(views[0], image=np.where(views[0].unknown[..., None], np.uint8(0), np.uint8([200, 120, 40])))
    out = fill(filler, [view])[0]
    assert np.abs(out.astype(int) - [200, 120, 40]).max() <= off_by


@pytest.mark.parametrize("filler", IMAGE_FILLS, ids=lambda f: f.name)
def test_nothing_but_the_crop_is_known(filler, views):
    assert np.array_equal(fill(filler, views)[0], fill(filler, views[:1])[0])


def test_an_opencv_without_contributed_modules_is_named(views, monkeypatch):
    monkeypatch.delattr(cv2, "xphoto")
    with pytest.raises(BadInput, match="opencv-contrib"):
        fill(simple_inpainters(BODY, WHITE)["fsr"], views)


# -------------------------------------------------------------------------------------------- surface


def test_a_texel_and_the_pixel_that_shows_it_find_each_other(views):
    view, texels = views[1], texel_table(BODY, TEXELS)
    faced, shown = PosedSurface(BODY, view.camera, view.body_pose).faced(texels), pixel_texels(view, BODY, texels)
    assert np.array_equal(shown >= 0, view.body)
    points = texels.interpolate(BODY.pose(view.body_pose), BODY.faces)
    column, row = faced.xy.astype(int).T
    there = shown[row, column]
    known = there >= 0
    assert known.mean() > 0.85  # the others are nearer than the slack of visibility to the outline
    # a pixel of 2 cm, more where the surface is seen obliquely
    apart = np.linalg.norm(points[faced.texel[known]] - points[there[known]], axis=1)
    assert np.median(apart) < 0.015
    assert np.quantile(apart, 0.98) < 0.04


def test_colours_are_sampled_from_counted_pixels_only(views):
    view, texels = views[1], texel_table(BODY, TEXELS)
    faced, counted = PosedSurface(BODY, view.camera, view.body_pose).faced(texels), view.person & off_the_rim(view)
    texel, rgb = counted_colours(faced, view.image, counted)
    dirty = np.where(counted[..., None], view.image, np.uint8(0))
    assert np.array_equal(counted_colours(faced, dirty, counted)[1], rgb)
    true = 255 * texels.interpolate(pattern(), BODY.faces)[texel]
    assert np.abs(rgb - true).mean() < 4
    flat = np.full_like(view.image, 77)
    assert (counted_colours(faced, flat, counted)[1] == 77).all()


def test_the_rim_is_where_a_neighbour_is_background(views):
    view = views[0]
    inner = off_the_rim(view)
    solid = view.person | (view.unknown & view.body)
    padded = np.pad(solid, 1, constant_values=True)
    h, w = solid.shape
    expected = np.all([padded[i : i + h, j : j + w] for i in range(3) for j in range(3)], axis=0)
    assert np.array_equal(inner, expected)
    assert 0.3 < inner.sum() / solid.sum() < 0.95


# -------------------------------------------------------------------------------------------- mirror


def test_mirrored_texels_lie_on_the_other_side():
    texels = texel_table(BODY, TEXELS)
    points = texels.interpolate(BODY.v_template, BODY.faces)
    other = mirrored_texels(BODY, TEXELS)
    assert np.median(np.linalg.norm(points[other] * [-1, 1, 1] - points, axis=1)) < 0.008
    far = np.abs(points[:, 0]) > 0.03
    assert (np.sign(points[other][far, 0]) == -np.sign(points[far, 0])).all()
    back = np.linalg.norm(points[other[other]] - points, axis=1)
    assert np.quantile(back, 0.99) < 0.025


def test_a_lopsided_body_has_a_mirror_too():
    shift = BODY.v_template + 0.02 * np.sin(9 * BODY.v_template[:, [1, 2, 0]])
    body = replace(BODY, v_template=shift)
    points = texel_table(body, 64).interpolate(shift, body.faces)
    other = mirrored_texels(body, 64)
    assert np.quantile(np.linalg.norm(points[other] * [-1, 1, 1] - points, axis=1), 0.9) < 0.05


def test_the_mirror_gives_each_side_the_colour_of_the_other():
    """Red left, green right, the left hidden: the mirror paints it green, another frame red."""
    colours = two_sided(RED, GREEN)
    hidden = crop(0, colours, 0.0, slice(66, 128))
    left = np.abs(truth(hidden, colours).astype(int) - eight_bit(RED)).max(-1) < 3  # of the person
    image = fill(MirroredTexture(BODY, WHITE), [hidden])[0]
    chosen = hidden.unknown & hidden.body & left
    assert chosen.sum() > 300
    # whose mirror is at the rim has the mean of its part, in which white is mixed
    assert (np.abs(image[chosen].astype(int) - eight_bit(GREEN)).max(1) < 30).mean() > 0.98
    assert (np.abs(image[chosen].astype(int) - eight_bit(GREEN)).max(1) < 3).mean() > 0.6
    copied = fill(TemporalCopy(BODY, WHITE), [hidden, crop(1, colours, 0.2)])[0]
    assert (np.abs(copied[chosen].astype(int) - eight_bit(RED)).max(1) < 30).mean() > 0.85
    assert (np.abs(copied[chosen].astype(int) - eight_bit(RED)).max(1) < 3).mean() > 0.6


def test_a_symmetric_person_is_recovered_by_the_mirror():
    colours = symmetric_pattern()
    view = crop(0, colours, 0.0, slice(70, 128))
    inside = view.unknown & off_the_rim(view)
    assert inside.sum() > 200
    image = fill(MirroredTexture(BODY, WHITE), [view])[0]
    plain_fill = fill(MeanColour(WHITE), [view])[0]
    assert psnr(image, truth(view, colours), inside) > 26 > psnr(plain_fill, truth(view, colours), inside) + 8


# -------------------------------------------------------------------------------------------- other frames


def test_another_view_of_the_same_texels_recovers_the_picture(views):
    view = views[0]
    image = fill(TemporalCopy(BODY, WHITE), [view, crop(1, pattern(), 0.15)])[0]
    inside = view.unknown & off_the_rim(view)
    off_by = np.abs(image[inside].astype(int) - truth(view, pattern())[inside])
    assert np.median(off_by) <= 2
    assert np.quantile(off_by, 0.9) <= 6
    assert psnr(image, truth(view, pattern()), inside) > 25  # a few texels are not seen there, or at the rim alone
    off = view.unknown & ~view.body
    assert (image[off] == 255).all()


def test_the_nearest_view_in_index_lends_whatever_the_order():
    """Views 0, 5 and 9 differ in colour alone; 5 and, hidden, 6."""
    lenders = {k: crop(k, plain(rgb)) for k, rgb in ((0, RED), (5, GREEN), (9, BLUE))}
    for k, nearest in ((6, GREEN), (8, BLUE), (2, RED), (7, GREEN)):  # 7 is as near to 9: the earlier one
        hidden = crop(k, plain((0.5, 0.5, 0.5)), 0.0, slice(40, 90))
        chosen = hidden.unknown & off_the_rim(hidden)
        for order in ((0, 5, 9), (9, 0, 5)):
            given = [lenders[n] for n in order]
            image = fill(TemporalCopy(BODY, WHITE, texels=64), [*given[:1], hidden, *given[1:]])[1]
            close = np.abs(image[chosen].astype(int) - eight_bit(nearest)).max(1) <= 1
            # texels beside the strip are seen by the view itself
            own = np.abs(image[chosen].astype(int) - 128).max(1) <= 1
            assert (close | own).mean() > 0.93
            assert close.mean() > 0.8


def test_nearest_colours_is_the_search_that_it_says():
    rng = np.random.default_rng(0)
    n, index = 40, np.array([3, 11, 4, 20, 7, 15])
    seen = [
        (np.flatnonzero(rng.random(n) < 0.15).astype(np.int32), rng.integers(0, 256, (n, 3), dtype=np.uint8))
        for _ in index
    ]
    seen = [(texel, rgb[: len(texel)]) for texel, rgb in seen]
    wanted = [rng.integers(0, n, 25).astype(np.int32) for _ in index]
    for k, (colour, found) in enumerate(nearest_colours(wanted, seen, index, n)):
        for m, texel in enumerate(wanted[k]):
            having = [v for v in range(len(index)) if texel in seen[v][0]]
            assert found[m] == bool(having)
            if having:
                best = min(having, key=lambda v: (abs(index[v] - index[k]), index[v]))
                assert np.array_equal(colour[m], seen[best][1][np.flatnonzero(seen[best][0] == texel)[0]])


def test_what_no_view_shows_has_the_mean_colour_of_its_part():
    """The person in one colour per part, the back never seen: every part of the back has its part's colour."""
    by_part = np.random.default_rng(3).uniform(0.1, 0.9, (24, 3))
    colours = by_part[BODY.weights.argmax(1)]
    front, back = crop(0, colours), all_unknown(crop(1, colours, np.pi))
    image = fill(TemporalCopy(BODY, WHITE), [front, back])[1]
    means = np.zeros((24, 3))
    shown = np.zeros(24, bool)
    for part in range(24):
        pixels = front.image[front.person & (smpl_parts(front.parts) == part)]
        shown[part] = len(pixels) > 0
        means[part] = pixels.mean(0) if shown[part] else front.image[front.person].mean(0)
    on = back.body
    off = np.abs(image[on] - means[smpl_parts(back.parts)[on]]).max(1)
    unseen = off <= 0.5 + 1e-6
    assert unseen.mean() > 0.6, "too little of the back was filled by part"
    borrowed = np.abs(image[on] - 255 * by_part[smpl_parts(back.parts)[on]]).max(1)
    assert np.minimum(off, borrowed).mean() < 25
    assert shown.sum() > 10
