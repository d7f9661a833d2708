"""Contact sheets: every picture is on it, whole, unscaled and in its place."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from ihbench.errors import BadInput
from ihbench.files.images import write_png
from ihbench.scoring.contact_sheet import COLUMNS, GREY, SheetRow, contact_sheet, error_image

H, W = 40, 160  # wider than the column heads, so that cells lie at known places


def a_row(seed, label="cam1/000030"):
    """Three pictures of noise with the corner's colour nowhere else: nothing can be cut."""
    rng = np.random.default_rng(seed)
    truth, prediction = (rng.uniform(0, 0.8, (H, W, 3)).astype(np.float32) for _ in range(2))
    training = rng.integers(0, 200, (H, W, 3)).astype(np.uint8)
    for image, white in ((truth, 1), (prediction, 1), (training, 255)):
        image[0, 0] = white
    return SheetRow(label, training, truth, prediction)


def contains(sheet, image):
    """How often an image lies in the sheet, pixel for pixel."""
    h, w = image.shape[:2]
    key = image[h // 2, w // 2]
    rows, cols = np.nonzero((sheet == key).all(-1))
    corners = [(r - h // 2, c - w // 2) for r, c in zip(rows, cols, strict=True)]
    return [(r, c) for r, c in corners if min(r, c) >= 0 and np.array_equal(sheet[r : r + h, c : c + w], image)]


def to_8bit(image):
    return np.round(image * 255).astype(np.uint8)


def test_the_error_is_four_times_the_mean_over_the_channels():
    truth = np.full((2, 2, 3), 0.5, np.float32)
    prediction = truth + np.array([[[0.3, 0, 0]], [[-0.1, -0.1, -0.1]]], np.float32)
    expected = np.array([[102, 102], [102, 102]])
    assert np.array_equal(error_image(prediction, truth), np.repeat(expected[..., None], 3, -1))
    assert error_image(truth, truth).max() == 0
    assert error_image(np.zeros((1, 1, 3), np.float32), np.ones((1, 1, 3), np.float32)).min() == 255


@pytest.mark.parametrize("n", [1, 3])
def test_every_picture_is_there_once_in_its_row_and_column(n):
    rows = [a_row(k) for k in range(n)]
    sheet = contact_sheet(rows, "zju_occ@1  standin-1")
    assert sheet.dtype == np.uint8
    assert sheet.ndim == 3
    places = []
    for row in rows:
        pictures = (row.training, to_8bit(row.truth), to_8bit(row.prediction), error_image(row.prediction, row.truth))
        found = [contains(sheet, picture) for picture in pictures]
        assert [len(f) for f in found] == [1] * len(COLUMNS)
        places.append([f[0] for f in found])
    places = np.array(places)  # [n, 4, 2] row, column
    assert (np.diff(places[..., 1], axis=1) > W).all()
    assert (np.diff(places[..., 0], axis=0) > H).all()
    assert (places[..., 0] == places[:, :1, 0]).all()
    assert (places[..., 1] == places[:1, :, 1]).all()


def test_title_and_labels_are_written():
    plain = contact_sheet([a_row(0, "")], "")
    titled, labelled = contact_sheet([a_row(0, "")], "title"), contact_sheet([a_row(0, "label")], "")
    assert (titled[:18] != plain[:18]).any()
    assert np.array_equal(titled[18:], plain[18:])
    assert (labelled != plain).any()
    assert plain[-1, -1].tolist() == [GREY] * 3


def test_pictures_are_cut_to_the_person():
    """One window for truth, prediction and error, so that they lie on each other."""
    image = np.ones((200, 200, 3), np.float32)
    truth, prediction = image.copy(), image.copy()
    truth[60:100, 80:120], prediction[70:120, 90:110] = 0.2, 0.6
    training = to_8bit(image)
    training[10:30, 10:150] = 90
    sheet = contact_sheet([SheetRow("", training, truth, prediction)], "")
    window = slice(56, 124), slice(76, 124)
    assert len(contains(sheet, to_8bit(truth)[window])) == 1
    assert len(contains(sheet, to_8bit(prediction)[window])) == 1
    assert len(contains(sheet, error_image(prediction, truth)[window])) == 1
    assert len(contains(sheet, training[6:34, 6:154])) == 1
    assert sheet.shape[0] < 150


def test_white_on_white_and_other_empty_pictures():
    white = np.ones((30, 50, 3), np.float32)
    row = SheetRow("nobody", to_8bit(white), white, white)
    sheet = contact_sheet([row], "nobody anywhere")
    assert (sheet == 255).all(-1).sum() >= 3 * 30 * 50
    assert (sheet == 0).all(-1).sum() >= 30 * 50  # no error
    one_pixel = replace(row, truth=np.where(np.arange(50)[:, None] == 49, 0, white).astype(np.float32))
    assert contact_sheet([one_pixel, row], "").shape[2] == 3


def test_predictions_out_of_range_are_clipped():
    row = a_row(0)
    wild = replace(row, prediction=row.prediction * 10 - 4)
    assert len(contains(contact_sheet([wild], ""), to_8bit(np.clip(wild.prediction, 0, 1)))) == 1


def test_a_png_comes_back_as_it_was(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    write_png(tmp_path / "deep" / "sheet.png", image)
    data = (tmp_path / "deep" / "sheet.png").read_bytes()
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), image)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["sheet.png"]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BadInput):
        write_png(tmp_path / "file" / "sheet.png", image)


def test_8_bit_pictures_and_tensors_do_not_wrap_around_and_other_layouts_are_refused():
    rng = np.random.default_rng(0)
    truth, prediction = rng.integers(0, 256, (2, 4, 5, 3)).astype(np.uint8)
    expected = error_image((prediction / 255).astype(np.float32), (truth / 255).astype(np.float32))
    assert np.abs(error_image(prediction, truth).astype(int) - expected).max() <= 1
    row = SheetRow("a", truth, truth, torch.tensor(prediction / 255))
    np.testing.assert_allclose(row.truth, truth / 255, atol=1e-7)
    np.testing.assert_allclose(row.prediction, prediction / 255, atol=1e-7)
    for wrong in (prediction.transpose(2, 0, 1), prediction[None], prediction.astype(np.int64), prediction[:2]):
        with pytest.raises(ValueError, match="expected"):
            SheetRow("a", truth, truth, wrong)
        with pytest.raises(ValueError, match="expected"):
            error_image(wrong, truth)
    with pytest.raises(ValueError, match="training"):
        SheetRow("a", truth / 255, truth, prediction)
