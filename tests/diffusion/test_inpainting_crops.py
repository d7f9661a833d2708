"""Crops, part maps, the block transform, push-pull and made-up occluders: what the diffusion model is fed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.diffusion.crops.crop_view import cut_view
from ihbench.diffusion.crops.part_map import (
    BACK,
    HEAD,
    NO_PART,
    PROFILE,
    palette,
    part_colours,
    part_labels,
    smpl_parts,
)
from ihbench.diffusion.crops.person_crop import PersonCrop, person_crop
from ihbench.diffusion.crops.push_pull import push_pull
from ihbench.diffusion.crops.random_mask import KINDS, random_mask
from ihbench.diffusion.mini.block_transform import BlockTransform
from ihbench.scene.contracts import MaskState, TrainView

STANDING = BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3))


@pytest.fixture(scope="module")
def body():
    return load_body()


def camera(size=200, distance=3.0, focal=1.2):
    R, t = look_at(np.array([0.0, 0.0, distance]), np.zeros(3), up=np.array([0.0, 1.0, 0.0]))
    K = np.array([[focal * size, 0, size / 2], [0, focal * size, size / 2], [0, 0, 1]])
    return Camera(K, R, t, size, size)


class TestPersonCrop:
    def test_holds_the_whole_body_with_a_margin(self, body):
        vertices = body.pose(STANDING)
        crop = person_crop(camera(), vertices, 128)
        p = crop.camera(camera()).project(vertices)
        margin = 0.04 * 128
        assert p[:, 0].min() > margin
        assert p[:, 0].max() < crop.width - margin
        assert p[:, 1].min() > margin
        assert p[:, 1].max() < crop.height - margin

    @pytest.mark.parametrize(("arms", "share"), [(0.0, 1.0), (75.0, 0.5)])
    def test_is_as_wide_as_the_pose_needs(self, body, arms, share):
        pose = np.zeros((24, 3))
        pose[16, 2], pose[17, 2] = -np.deg2rad(arms), np.deg2rad(arms)
        crop = person_crop(camera(), body.pose(BodyPose(pose, np.zeros(10), np.zeros(3))), 128)
        assert crop.width == share * 128
        assert person_crop(camera(), body.pose(STANDING), 128, square=True).width == 128

    def test_crop_camera_agrees_with_the_cut_pixels(self, body):
        """A marked pixel of the image appears where the crop's camera projects its point."""
        view = camera(size=400)
        vertices = body.pose(STANDING)
        crop = person_crop(view, vertices, 128)
        point = vertices[np.argmax(vertices[:, 1])]
        x, y, _ = view.project(point[None])[0]
        image = np.zeros((400, 400), np.float32)
        image[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 1
        cut = crop.cut(image)
        rows, cols = np.mgrid[: crop.height, : crop.width] + 0.5
        found = np.array([(cols * cut).sum(), (rows * cut).sum()]) / cut.sum()
        expected = crop.camera(view).project(np.array([point]))[0, :2]
        np.testing.assert_allclose(found, expected, atol=0.5)

    def test_paste_undoes_cut_up_to_resampling(self):
        rng = np.random.default_rng(0)
        from scipy.ndimage import gaussian_filter

        image = gaussian_filter(rng.random((90, 80, 3)), (6, 6, 0)).astype(np.float32)
        crop = PersonCrop(-10, 5, 60, 120, 64, 128)  # beyond the image on three sides
        back = crop.paste(crop.cut(image), np.zeros_like(image))
        np.testing.assert_allclose(back[8:85, 2:46], image[8:85, 2:46], atol=0.01)
        assert not back[:, 51:].any()
        assert not back[:5].any()

    def test_a_body_behind_the_camera_gets_the_whole_image(self, body):
        crop = person_crop(camera(distance=0.2), body.pose(STANDING), 128)
        assert crop.window_height >= 200


class TestPartMap:
    def test_left_and_right_lie_on_their_sides(self, body):
        labels = smpl_parts(part_labels(body.pose(STANDING), body, camera()))
        columns = np.arange(200)[None].repeat(200, 0)
        left_hip, right_hip = columns[labels == 1].mean(), columns[labels == 2].mean()
        assert left_hip > right_hip  # the person faces the camera: their left is on our right
        assert set(np.unique(labels)) <= {*range(24), NO_PART}

    @pytest.mark.parametrize(
        ("turn", "mostly"), [(0.0, 0), (np.pi, BACK), (np.pi / 2, PROFILE), (-np.pi / 2, PROFILE)]
    )
    def test_a_head_is_told_from_front_back_and_profile(self, body, turn, mostly):
        pose = STANDING.pose.copy()
        pose[0] = [0, turn, 0]
        labels = part_labels(body.pose(replace(STANDING, pose=pose)), body, camera())
        head = labels[smpl_parts(labels) == HEAD] - HEAD
        sides, counts = np.unique(head, return_counts=True)
        assert set(sides) <= {0, BACK, PROFILE}
        assert sides[counts.argmax()] == mostly
        if mostly != PROFILE:
            assert not (head == BACK - mostly).any()  # nothing of the other side

    def test_every_side_of_a_part_has_a_colour_of_its_own(self):
        assert len(np.unique(palette(), axis=0)) == 72
        shown = part_colours(np.array([[3, NO_PART]], np.uint8))
        assert (shown[0, 0] == palette()[3]).all()
        assert not shown[0, 1].any()


class TestBlockTransform:
    def test_all_coefficients_are_exact(self):
        codec = BlockTransform(4, 16, 16)
        image = torch.rand(2, 3, 16, 24) * 2 - 1
        codec.standardise(image, torch.ones(2, 1, 16, 24))
        torch.testing.assert_close(codec.decode(codec.encode(image)), image, atol=1e-5, rtol=0)

    def test_squared_error_is_that_of_the_pixels(self):
        codec = BlockTransform(4, 16, 16)
        a, b = torch.rand(1, 3, 8, 8), torch.rand(1, 3, 8, 8)
        difference = codec.encode(a) - codec.encode(b)
        torch.testing.assert_close(difference.square().sum(), (a - b).square().sum())

    def test_standardised_channels_have_mean_zero_and_scale_one(self):
        codec = BlockTransform(4, 16, 4)
        image = torch.rand(8, 3, 32, 32)
        codec.standardise(image, torch.ones(8, 1, 32, 32))
        latents = codec.encode(image)
        assert latents.shape == (8, 24, 8, 8)
        torch.testing.assert_close(latents.mean((0, 2, 3)), torch.zeros(24), atol=1e-4, rtol=0)
        torch.testing.assert_close(latents.std((0, 2, 3)), torch.ones(24), atol=1e-2, rtol=0)

    def test_what_is_dropped_is_fine_detail_only(self):
        codec = BlockTransform(4, 16, 4)
        flat = torch.rand(1, 3, 2, 2).repeat_interleave(4, 2).repeat_interleave(4, 3)
        torch.testing.assert_close(codec.decode(codec.encode(flat)), flat, atol=1e-5, rtol=0)

    @pytest.mark.parametrize(("luma", "chroma"), [(0, 4), (17, 4), (16, 17)])
    def test_refuses_coefficients_that_do_not_exist(self, luma, chroma):
        with pytest.raises(ValueError, match="coefficients"):
            BlockTransform(4, luma, chroma)


class TestPushPull:
    def test_known_pixels_stay_and_a_constant_spreads(self):
        image = torch.zeros(1, 3, 21, 13)
        image[:, 0] = 0.7
        known = torch.zeros(1, 1, 21, 13)
        known[..., 3:5, 2:4] = 1
        known[..., 15, 9] = 1
        filled = push_pull(image, known)
        torch.testing.assert_close(filled, image, atol=1e-5, rtol=0)

    def test_the_nearer_colour_wins(self):
        image = torch.zeros(1, 3, 32, 8)
        image[:, :, :16] = 1
        known = torch.zeros(1, 1, 32, 8)
        known[..., :3, :], known[..., -3:, :] = 1, 1
        filled = push_pull(image, known)[0, 0].mean(1)
        assert filled[5] > 0.7
        assert filled[-5] < 0.3
        torch.testing.assert_close(filled[:3], torch.ones(3))

    def test_nothing_known_is_zero(self):
        assert not push_pull(torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8)).any()


class TestRandomMask:
    PERSON = np.zeros((64, 48), bool)
    PERSON[8:60, 14:34] = True

    def test_every_kind_comes_and_hides_part_of_the_person(self):
        shares = []
        for kind in range(len(KINDS)):
            only = tuple(float(k == kind) for k in range(len(KINDS)))
            masks = [random_mask(np.random.default_rng(s), self.PERSON, only) for s in range(20)]
            shares.append(np.mean([(m & self.PERSON).sum() / self.PERSON.sum() for m in masks]))
            assert all(m.shape == self.PERSON.shape for m in masks)
        assert shares[KINDS.index("all")] == 1
        assert all(0.05 < share < 0.8 for share in shares[:-1]), shares

    def test_is_a_function_of_the_generator(self):
        a, b, c = (random_mask(np.random.default_rng(s), self.PERSON) for s in (1, 1, 2))
        assert (a == b).all()
        assert (a != c).any()

    def test_nobody_there_hides_everything(self):
        assert random_mask(np.random.default_rng(0), np.zeros((5, 5), bool)).all()


class TestCutView:
    def view(self, body, mask):
        image = np.full((200, 200, 3), 255, np.uint8)
        return TrainView(image, mask, camera(), STANDING, 0, "0")

    def test_a_pixel_is_unknown_if_any_part_of_it_is(self, body):
        mask = np.zeros((200, 200), np.uint8)
        mask[:, 100] = MaskState.UNKNOWN
        view = cut_view(self.view(body, mask), 3, body, 64)
        columns = np.flatnonzero(view.unknown.all(0))
        assert 1 <= len(columns) <= 2
        assert view.index == 3
        assert 0 < view.hidden_share < 0.2

    def test_all_hidden(self, body):
        view = cut_view(self.view(body, np.full((200, 200), MaskState.UNKNOWN, np.uint8)), 0, body, 64)
        assert view.hidden_share == 1
        assert not view.person.any()

    def test_completed_changes_unknown_pixels_only(self, body):
        mask = np.zeros((200, 200), np.uint8)
        mask[:, 90:110] = MaskState.UNKNOWN
        view = cut_view(self.view(body, mask), 0, body, 64)
        done = view.completed(np.zeros_like(view.image))
        assert (done[~view.unknown] == view.image[~view.unknown]).all()
        assert not done[view.unknown].any()
