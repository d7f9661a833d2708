"""What other frames show of a crop's surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ihbench.body import load_body
from ihbench.camera import Camera
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.crops.elsewhere import seen_elsewhere, with_elsewhere
from ihbench.diffusion.crops.part_map import drawn_body
from ihbench.diffusion.crops.seen_surface import NOWHERE, SurfaceColours, uv_cells
from ihbench.scene.contracts import MaskState, TrainView
from tests.diffusion.test_inpainting_crops import STANDING, camera


@pytest.fixture(scope="module")
def body():
    return load_body()


def view(body, index: int, colour: int) -> CropView:
    """The standing person, all of one colour."""
    here: Camera = camera()
    on = drawn_body(body.pose(STANDING), body, here).mask
    image = np.where(on[..., None], np.uint8(colour), np.uint8(255)).repeat(3, -1)
    mask = np.where(on, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    return cut_view(TrainView(image, mask, here, STANDING, index, "0"), index, body, 64)


def test_a_surface_takes_the_nearest_other_frame_the_earlier_of_two(body):
    frames = [view(body, 0, 10), view(body, 2, 20), view(body, 4, 40), view(body, 7, 70)]
    drawn = seen_elsewhere(frames, frames)
    for own, expected in zip(drawn, (20, 10, 20, 40), strict=True):
        seen = own[..., 3] == 255
        assert seen.any()
        assert (np.abs(own[seen][:, :3].astype(int) - expected) <= 2).mean() > 0.98  # but for mixed pixels
        assert not own[~seen].any()


def test_hidden_pixels_and_rims_show_nothing_to_others(body):
    one, two = view(body, 0, 10), view(body, 1, 20)
    nobody = replace(one, person=np.zeros_like(one.person))
    assert not seen_elsewhere([two], [nobody])[0].any()
    thin = np.zeros_like(one.person)
    thin[:, thin.shape[1] // 2] = True  # one pixel wide: all rim
    assert not seen_elsewhere([two], [replace(one, person=thin & one.person)])[0].any()


def test_views_beyond_the_frames_and_a_single_frame(body):
    frame = view(body, 0, 10)
    assert not with_elsewhere([frame], [frame])[0].elsewhere.any()  # only its own
    assert with_elsewhere([replace(frame, index=9)], [frame])[0].elsewhere.any()
    assert with_elsewhere([], [frame]) == []


def test_cells_cover_the_body_and_nothing_else(body):
    raster = drawn_body(body.pose(STANDING), body, camera())
    cells = uv_cells(raster, body)
    assert ((cells != NOWHERE) == raster.mask).all()
    assert len(np.unique(cells)) > 500


def test_a_coarse_cell_speaks_where_the_fine_one_was_not_seen():
    known = SurfaceColours()
    cells = np.full((3, 3), 0, np.uint16)
    known.show(cells, np.full((3, 3, 3), 7, np.uint8), np.ones((3, 3), bool), 5)
    drawn, frame = known.drawn(np.array([[0, 1, 2, NOWHERE]], np.uint16))
    assert drawn[0].tolist() == [[7, 7, 7, 255], [7, 7, 7, 255], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert frame[0, :2].tolist() == [5, 5]
