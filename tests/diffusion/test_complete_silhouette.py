"""Complete silhouettes: what is known stays, the painted image decides the rim, and HQ-SAM's whole path runs."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ihbench.clock.threads import one_torch_thread
from ihbench.diffusion import complete_silhouette as module
from ihbench.diffusion.complete_silhouette import (
    CoverageSilhouette,
    GrabCutSilhouette,
    SamSilhouette,
    silhouette_finder,
)
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.crops.part_map import NO_PART
from ihbench.errors import BadInput
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view

FINDERS = [CoverageSilhouette(WHITE), GrabCutSilhouette(WHITE)]
NAMES = ["coverage", "grabcut"]
both = pytest.mark.parametrize("finder", FINDERS, ids=NAMES)
COAT = 2  # px by which the person stands off the body model


def silhouette_iou(found, truth):
    return np.count_nonzero(found & truth) / np.count_nonzero(found | truth)


@pytest.fixture(scope="module", autouse=True)
def single_thread():
    with one_torch_thread():
        yield


def a_view(size: int = 96, hidden: slice | None = slice(34, 60), pixels: int = 96) -> CropView:
    """A person with a strip before them, cut to `size` px."""
    return cut_view(train_view(a_camera(0.0, pixels), a_pose(0.4, 0.5), hidden), 0, the_body(), size)


def dressed(
    view: CropView, colour=(60, 90, 140), background=(255, 255, 255), coat: int = COAT
) -> tuple[CropView, np.ndarray, np.ndarray]:
    """The view of a person who stands `coat` px off the body model everywhere, the true image, the true mask."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * coat + 1, 2 * coat + 1))
    truth = cv2.dilate(view.body.astype(np.uint8), disc) > 0
    stripes = 40 * (np.arange(view.image.shape[0]) // 6 % 2)[:, None, None]
    image = np.where(truth[..., None], np.clip(np.array(colour) + stripes, 0, 255), background).astype(np.uint8)
    shown = np.where(view.unknown[..., None], background, image).astype(np.uint8)
    return replace(view, image=shown, person=truth & ~view.unknown), image, truth


def with_unknown(view: CropView, unknown: np.ndarray) -> CropView:
    return replace(view, unknown=unknown, person=view.person & ~unknown)


# ------------------------------------------------------------------------------------------------------ finding


@both
@pytest.mark.parametrize("colour", [(60, 90, 140), (10, 10, 10), (200, 120, 40)], ids=str)
def test_clothes_beyond_the_body_model_are_found(finder, colour):
    view, image, truth = dressed(a_view(), colour)
    found = finder.complete(view, image)
    hidden = view.unknown
    alone = silhouette_iou(view.body[hidden], truth[hidden])
    assert silhouette_iou(found[hidden], truth[hidden]) > max(0.97, alone + 0.1)


@both
def test_a_person_thinner_than_the_body_model_is_found(finder):
    """By a pixel, a hundredth of the height: so exact are fitted bodies."""
    view = a_view()
    truth = cv2.erode(view.body.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0
    image = np.where(truth[..., None], np.array([60, 90, 140], np.uint8), np.uint8(255))
    view = replace(view, person=truth & ~view.unknown)
    hidden = view.unknown
    assert silhouette_iou(finder.complete(view, image)[hidden], truth[hidden]) > 0.95
    assert silhouette_iou(view.body[hidden], truth[hidden]) < 0.9


def test_of_a_blurred_person_the_pixels_half_covered_are_the_rim():
    """Mixtures below a half are background: a threshold near the background's colour takes two pixels too many."""
    view, image, truth = dressed(a_view())
    blurred = cv2.GaussianBlur(image, (0, 0), 1.5)
    found = CoverageSilhouette(WHITE).complete(view, blurred)
    hidden = view.unknown
    assert silhouette_iou(found[hidden], truth[hidden]) > 0.96
    near_white = np.where(hidden, (blurred < 245).any(-1), view.person)
    assert silhouette_iou(near_white[hidden], truth[hidden]) < 0.9


@both
def test_what_is_known_stays_known(finder):
    """Even where the picture says the contrary."""
    view, image, truth = dressed(a_view())
    lying = np.where(view.unknown[..., None], image, 255 - image)
    for shown in (image, lying):
        found = finder.complete(view, shown)
        assert found.dtype == bool
        assert found.shape == truth.shape
        assert np.array_equal(found[~view.unknown], view.person[~view.unknown])


@both
def test_far_off_the_body_nothing_is_person_and_deep_inside_everything_is(finder):
    view, _, _ = dressed(a_view())
    everywhere = with_unknown(view, np.ones_like(view.unknown))
    distance = cv2.distanceTransform((~view.body).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    depth = cv2.distanceTransform(view.body.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    rows = np.flatnonzero(view.body.any(1))
    reach = module.RIM * (rows[-1] - rows[0] + 1)
    dark, white = (np.full_like(view.image, level) for level in (20, 255))
    assert not finder.complete(everywhere, dark)[distance > reach].any()
    for image in (dark, white):
        assert finder.complete(everywhere, image)[depth > reach].all()
    if isinstance(finder, CoverageSilhouette):
        assert finder.complete(everywhere, dark)[view.body].all()


@both
def test_everything_unknown_is_found_from_the_picture_alone(finder):
    view, image, truth = dressed(a_view())
    everywhere = with_unknown(view, np.ones_like(view.unknown))
    assert silhouette_iou(finder.complete(everywhere, image), truth) > 0.97


@both
def test_nothing_unknown_gives_the_known_mask(finder):
    view, image, truth = dressed(a_view(hidden=None))
    assert np.array_equal(finder.complete(view, image), truth)


@both
def test_a_body_that_is_nowhere_adds_nothing(finder):
    view, image, _ = dressed(a_view())
    gone = replace(view, parts=np.full_like(view.parts, NO_PART))
    assert np.array_equal(finder.complete(gone, image), view.person)
    nobody = replace(with_unknown(gone, np.ones_like(gone.unknown)), person=np.zeros_like(gone.person))
    assert not finder.complete(nobody, image).any()


@both
def test_a_crop_full_of_body_is_all_person(finder):
    view, image, _ = dressed(a_view())
    full = replace(with_unknown(view, np.ones_like(view.unknown)), parts=np.zeros_like(view.parts))
    assert finder.complete(full, image).all()


@both
@pytest.mark.parametrize("size", [8, 16, 24])
def test_small_crops(finder, size):
    view, image, truth = dressed(a_view(size), coat=0)
    found = finder.complete(view, image)
    assert found.shape == truth.shape
    assert np.array_equal(found[~view.unknown], view.person[~view.unknown])
    assert silhouette_iou(found, truth) > 0.9


@both
def test_a_person_as_white_as_the_background_gets_the_body_model(finder):
    view, _, _ = dressed(a_view())
    image = np.full_like(view.image, 255)
    found = finder.complete(view, image)
    assert np.array_equal(found[~view.unknown], view.person[~view.unknown])
    hidden = view.unknown
    assert silhouette_iou(found[hidden], view.body[hidden]) > 0.6
    if isinstance(finder, CoverageSilhouette):
        assert np.array_equal(found[hidden], view.body[hidden])


@both
def test_another_background_is_taken_for_background(finder):
    view, image, truth = dressed(a_view(), (230, 225, 235), (20, 120, 30))
    other = type(finder)((20 / 255, 120 / 255, 30 / 255))
    hidden = view.unknown
    assert silhouette_iou(other.complete(view, image)[hidden], truth[hidden]) > 0.97


@both
def test_the_same_picture_gives_the_same_mask(finder):
    """Whatever the random state of OpenCV."""
    view, image, _ = dressed(a_view())
    noisy = np.clip(image + np.random.default_rng(0).normal(0, 25, image.shape), 0, 255).astype(np.uint8)
    first = finder.complete(view, noisy)
    cv2.setRNGSeed(7)
    assert np.array_equal(first, finder.complete(view, noisy))
    assert np.array_equal(first, type(finder)(WHITE).complete(view, noisy[:, :, ::1].copy(order="F")))


def test_finders_by_name():
    assert isinstance(silhouette_finder("coverage", WHITE), CoverageSilhouette)
    assert isinstance(silhouette_finder("grabcut", WHITE), GrabCutSilhouette)
    with pytest.raises(BadInput, match=r"--method.inpaint.silhouette 'sma': expected one of coverage, grabcut, sam"):
        silhouette_finder("sma", WHITE)
    with pytest.raises(BadInput, match=r"--method.inpaint.sam-weights '': expected a path"):
        silhouette_finder("sam", WHITE)


# ------------------------------------------------------------------------------------------------------ HQ-SAM


SIDE = 64  # px of the miniature's input


@pytest.fixture(scope="module")
def sam_folder(tmp_path_factory):
    """HQ-SAM's classes with random weights, in miniature, as `save_pretrained` leaves them."""
    import torch
    from transformers import SamHQConfig, SamHQModel, SamHQProcessor, SamImageProcessor

    vision = {
        "hidden_size": 32, "output_channels": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
        "image_size": SIDE, "patch_size": 8, "window_size": 4, "global_attn_indexes": [1], "num_pos_feats": 8,
        "mlp_dim": 32,
    }  # fmt: skip
    prompt = {"hidden_size": 16, "image_size": SIDE, "patch_size": 8, "mask_input_channels": 4}
    decoder = {
        "hidden_size": 16, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16, "vit_dim": 32,
    }  # fmt: skip
    config = SamHQConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = SamHQModel(config)
        with torch.no_grad():  # HQ-SAM's own initial weights are near zero
            for p in model.parameters():
                p.normal_(0, 0.3)
    small = {"longest_edge": SIDE}, {"height": SIDE, "width": SIDE}
    processor = SamHQProcessor(SamImageProcessor(size=small[0], pad_size=small[1]))
    folder = tmp_path_factory.mktemp("sam")
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Whoever opens a connection fails."""
    import socket

    def refuse(*_args, **_kw):
        pytest.fail("asked the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.mark.parametrize("size", [96, 40])
def test_the_whole_path_of_sam(sam_folder, size):
    """Random weights find rubbish, but where they may: near the body, in unknown pixels, the same every time."""
    view, image, truth = dressed(a_view(size))
    finder = SamSilhouette(str(sam_folder))
    found = finder.complete(view, image)
    assert found.dtype == bool
    assert found.shape == truth.shape
    assert np.array_equal(found[~view.unknown], view.person[~view.unknown])
    distance = cv2.distanceTransform((~view.body).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    assert not found[distance > module.SAM_REACH * size].any()
    assert np.array_equal(found, finder.complete(view, image))
    assert np.array_equal(found, SamSilhouette(str(sam_folder)).complete(view, image))


def test_sams_mask_lies_where_the_crop_is(sam_folder, monkeypatch):
    """A mask that knows the picture, in the frame of the padded input, comes back in the frame of the crop."""
    import torch

    view, _, truth = dressed(a_view())
    finder = SamSilhouette(str(sam_folder))
    asked = {}

    class Knows(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.scale = torch.nn.Parameter(torch.ones(1))

        def forward(self, pixel_values, input_points, input_boxes, multimask_output):
            asked.update(points=input_points, boxes=input_boxes, several=multimask_output)
            dark = pixel_values.mean(1) < 1.0
            small = torch.nn.functional.interpolate(dark[:, None].float() - 0.5, scale_factor=0.5, mode="area")

            class Answer:
                pred_masks = small[:, None]

            return Answer

    finder.model = Knows()
    image = np.where(truth[..., None], np.uint8(30), np.uint8(255)).repeat(3, -1)[..., :3]
    found = finder.complete(view, image)
    hidden = view.unknown
    assert silhouette_iou(found[hidden], truth[hidden]) > 0.85  # at 32 px
    assert silhouette_iou(np.roll(found, 4, 1)[hidden], truth[hidden]) < 0.8
    # prompts are in the frame of the input: the longest edge is SIDE
    scale = SIDE / max(image.shape[:2])
    rows, cols = np.flatnonzero(view.body.any(1)), np.flatnonzero(view.body.any(0))
    box = asked["boxes"][0, 0].numpy() / scale
    assert asked["several"] is False
    np.testing.assert_allclose(box, [cols[0], rows[0], cols[-1] + 1, rows[-1] + 1], atol=module.RIM * 96 + 1)
    points = asked["points"][0, 0].numpy() / scale
    assert len(points) == module.SAM_POINTS
    assert all(view.body[int(y), int(x)] for x, y in points)


def copied(folder, tmp_path):
    target = tmp_path / "copy"
    shutil.copytree(folder, target)
    return target


def drop_weights(folder):
    (folder / "model.safetensors").unlink()


def only_pickle(folder):
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")


def cut_short(folder):
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-100])


def plain_sam(folder):
    words = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(words | {"model_type": "sam"}))


def drop_config(folder):
    (folder / "config.json").unlink()


def drop_processor(folder):
    for name in ("preprocessor_config.json", "processor_config.json"):
        (folder / name).unlink(missing_ok=True)


def edit_tensors(folder, change):
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})


def lose_tensor(folder):
    edit_tensors(folder, lambda tensors: tensors.pop("vision_encoder.patch_embed.projection.weight"))


def misshape_tensor(folder):
    name = "vision_encoder.patch_embed.projection.weight"
    edit_tensors(folder, lambda tensors: tensors.update({name: tensors[name][:, :2].contiguous()}))


def spoil_tensor(folder):
    def change(tensors):
        tensors["vision_encoder.patch_embed.projection.weight"][0] = float("nan")

    edit_tensors(folder, change)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (shutil.rmtree, "no such folder"),
        (drop_config, "lacks config.json"),
        (drop_processor, "lacks preprocessor_config.json"),
        (drop_weights, "lacks model.safetensors"),
        (only_pickle, "only pickles, which are refused"),
        (plain_sam, "a model of type 'sam', not 'sam_hq'"),
        (cut_short, "not readable"),
        (lose_tensor, r"1 tensors are missing or misshapen \(vision_encoder.patch_embed.projection.weight\)"),
        (misshape_tensor, "patch_embed.projection.weight|not readable"),
        (spoil_tensor, "NaN or infinite"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_weights_that_cannot_be_used_are_refused_in_one_line(sam_folder, tmp_path, damage, said):
    folder = copied(sam_folder, tmp_path)
    damage(folder)
    with pytest.raises(BadInput, match=said) as caught:
        SamSilhouette(str(folder))
    assert str(caught.value).startswith("--method.inpaint.sam-weights ")
    assert "\n" not in str(caught.value)
