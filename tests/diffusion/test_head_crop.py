"""Head crops: where they look, what guides them, and how their painting comes back into the person's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.body.pose import BodyPose
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion import diffusion_inpainter
from ihbench.diffusion.crops.crop_view import cut_to, cut_view
from ihbench.diffusion.crops.diffusion_batch import batch_of, shared_noise
from ihbench.diffusion.crops.head_crop import PaintedHead, head_crop, head_region, head_views, with_head
from ihbench.diffusion.crops.head_places import EYES, MOUTH, head_guide, head_of, head_vertices, marked
from ihbench.diffusion.crops.part_map import drawn_body
from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.mini.weights import load_mini, save_mini
from ihbench.methods.inpainthuman.inpainting.painted_view import paste_back
from ihbench.scene.contracts import MaskState
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view
from tests.diffusion.tiny_diffusion import CROP, tiny_backbone

SIZE = 200  # px of a view
FRONT, BACK = 0.0, np.pi
RED = np.array([255, 0, 0], np.uint8)


def a_view(azimuth=FRONT, hidden=None):
    """The person from a side; of the mask `hidden` marks what nobody sees."""
    view = train_view(a_camera(azimuth, SIZE), a_pose(0.0, 0.0))
    if hidden is None:
        return view
    mask = view.mask.copy()
    mask[hidden] = MaskState.UNKNOWN
    return replace(view, mask=mask)


def without_head(azimuth=FRONT):
    """The view whose upper third is hidden."""
    rows = np.nonzero((a_view(azimuth).mask == MaskState.PERSON).any(1))[0]
    return a_view(azimuth, slice(0, int(rows[0] + 0.33 * (rows[-1] - rows[0]))))


def guide_at(azimuth, size=64):
    view = a_view(azimuth)
    vertices = the_body().pose(view.body_pose)
    crop = head_crop(view.camera, vertices, the_body(), size)
    return head_guide(drawn_body(vertices, the_body(), crop.camera(view.camera)), the_body())


class TestCrop:
    def test_holds_the_head_with_room_for_hair(self):
        view, body = a_view(), the_body()
        vertices = body.pose(view.body_pose)
        crop = head_crop(view.camera, vertices, body, 64)
        assert (crop.width, crop.height) == (48, 64)
        p = crop.camera(view.camera).project(vertices[head_vertices(body)])
        assert p[:, 1].min() > 8
        assert p[:, 1].max() < 56
        assert 30 < p[:, 1].max() - p[:, 1].min() < 42

    def test_is_at_twice_the_scale_of_the_person_crop_or_more(self):
        view = a_view()
        person = cut_view(view, 0, the_body(), 128).crop
        head = head_crop(view.camera, the_body().pose(view.body_pose), the_body(), 64)
        assert head.height / head.window_height > 1.9 * person.height / person.window_height

    def test_there_is_none_of_a_head_behind_the_camera(self):
        away = the_body().pose(BodyPose(np.zeros((24, 3)), np.zeros(10), np.array([0.0, 0.0, 50.0])))
        back = the_body().pose(BodyPose(np.zeros((24, 3)), np.zeros(10), np.array([0.0, 0.0, -50.0])))
        camera = a_camera(FRONT, SIZE)
        assert [head_crop(camera, v, the_body(), 64) is None for v in (away, back)].count(True) == 1
        assert head_crop(camera, np.full_like(away, np.nan), the_body(), 64) is None


class TestGuide:
    def test_marks_two_eyes_above_one_mouth_in_front_and_nothing_behind(self):
        third = guide_at(FRONT)[..., 2] / 255 * the_head(FRONT)
        eyes = np.argwhere(np.abs(third - EYES) < 0.01)
        mouth = np.argwhere(np.abs(third - MOUTH) < 0.01)
        assert len(eyes) > 4
        assert len(mouth) > 4
        assert eyes[:, 0].max() < mouth[:, 0].min()
        gaps = np.diff(np.unique(eyes[:, 1]))
        assert (gaps > 1).sum() == 1, "two eyes, apart"
        assert not (marked(guide_at(BACK)) & the_head(BACK)).any()

    def test_says_left_and_up(self):
        guide, head = guide_at(FRONT), the_head(FRONT)
        rows, cols = np.nonzero(head)
        across, up = guide[rows, cols, 0].astype(float), guide[rows, cols, 1].astype(float)
        assert np.corrcoef(up, -rows)[0, 1] > 0.9
        assert abs(np.corrcoef(across, cols)[0, 1]) > 0.9

    def test_a_body_that_does_not_say_where_its_eyes_are(self):
        silent = replace(the_body(), face_landmarks=None)
        for guess, known in zip(silent.eyes_and_mouth, the_body().eyes_and_mouth, strict=True):
            assert guess == pytest.approx(known, abs=0.03)


def the_head(azimuth):
    view = a_view(azimuth)
    crop = head_crop(view.camera, the_body().pose(view.body_pose), the_body(), 64)
    return head_of(cut_to(view, 0, the_body(), crop).parts)


class TestViews:
    def setup_method(self):
        self.view = without_head()
        self.crop = cut_view(self.view, 5, the_body(), 128)
        self.painted = self.crop.completed(np.full_like(self.crop.image, 77))
        (self.head,) = head_views([self.crop], {5: self.view}, [self.painted], the_body()).values()

    def test_only_hidden_heads_are_painted(self):
        open_view = a_view()
        crop = cut_view(open_view, 0, the_body(), 128)
        assert head_views([crop], {0: open_view}, [crop.image], the_body()) == {}

    def test_begin_with_what_was_painted_of_the_person(self):
        inner = head_of(self.head.parts) & self.head.unknown
        assert inner.sum() > 100
        np.testing.assert_allclose(self.head.fill[inner], 77, atol=2)

    def test_answer_for_the_head_and_not_for_the_shoulders(self):
        region = head_region(self.head)
        assert (region & head_of(self.head.parts)).sum() == (self.head.unknown & head_of(self.head.parts)).sum()
        assert not (region & ~self.head.unknown).any()
        assert not region[-6:].any()

    def test_leave_what_is_seen_of_a_head_alone(self):
        columns = np.nonzero((a_view().mask == MaskState.PERSON).any(0))[0]
        hidden = np.zeros((SIZE, SIZE), bool)
        hidden[:, : int(columns.mean())] = True
        view = a_view(FRONT, hidden)
        crop = cut_view(view, 0, the_body(), 128)
        (half,) = head_views([crop], {0: view}, [crop.image], the_body()).values()
        head = head_of(half.parts)
        assert (head & ~half.unknown).sum() > 100
        region = head_region(half)
        assert region.any()
        assert not (region & ~half.unknown).any()

    def test_come_back_into_the_person_crop(self):
        head = PaintedHead(self.head, self.head.completed(np.tile(RED, (64, 48, 1))))
        done = with_head(self.crop, self.painted, head, self.view)
        red = (done == RED).all(-1)
        inner = head_of(self.crop.parts) & self.crop.unknown
        assert red[inner].mean() > 0.8
        changed = (done != self.painted).any(-1)
        assert not (changed & ~self.crop.unknown).any()
        legs = np.arange(128) > 70
        assert not changed[legs].any()

    def test_are_pasted_into_the_view_at_their_own_scale(self):
        head = PaintedHead(self.head, self.head.completed(np.tile(RED, (64, 48, 1))))
        plain = paste_back(self.view, self.crop, self.painted, self.crop.body, self.view)
        done = paste_back(self.view, self.crop, self.painted, self.crop.body, self.view, head)
        known = self.view.mask != MaskState.UNKNOWN
        assert (done.view.image[known] == self.view.image[known]).all()
        red = (done.view.image == RED).all(-1)
        assert red.sum() > 150
        assert (done.view.image[~red] == plain.view.image[~red]).mean() > 0.99
        assert (done.view.mask == plain.view.mask).all()


class TestPainting:
    def heads(self):
        view = without_head()
        crop = cut_view(view, 0, the_body(), CROP)
        return list(head_views([crop], {0: view}, [crop.image], the_body()).values())

    def test_hidden_pixels_begin_with_the_fill_and_known_ones_do_not(self):
        backbone, (head,) = tiny_backbone(), self.heads()
        other = replace(head, fill=255 - head.fill)
        batches = [batch_of([view], torch.device("cpu")) for view in (head, other)]
        a, b = (backbone.condition(x.pixels, x.unknown, x.person, x.fill) for x in batches)
        differs = (a != b).any(1)[0]
        assert differs.any()
        asked = a[0, 0] > 0
        assert not (differs & ~asked).any()
        assert batch_of([head, replace(head, fill=None)], torch.device("cpu")).fill is None

    def test_follows_what_it_begins_with(self, monkeypatch):
        monkeypatch.setattr(diffusion_inpainter, "load_backbone", lambda config, device: tiny_backbone())
        (head,) = self.heads()
        painter = DiffusionInpainter(tiny_backbone(), InpaintConfig(sampler_steps=2), 0, Ledger())
        begun = [head, replace(head, fill=255 - head.fill)]
        first, second = painter.inpaint_heads(begun, Progress.silent())
        assert (first[head.unknown] != second[head.unknown]).any()

    def test_noise_of_a_lower_crop_is_the_persons_first_rows(self):
        backbone = tiny_backbone()
        whole = shared_noise(backbone, 3, CROP // 2)
        part = shared_noise(backbone, 3, CROP // 2, CROP // 2)
        assert torch.equal(part, whole[:, : part.shape[1]])
        assert part.shape[1:] == (CROP // 8, CROP // 8)

    def test_by_the_backbone_as_it_was_before_it_learned_the_person(self, monkeypatch):
        monkeypatch.setattr(diffusion_inpainter, "load_backbone", lambda config, device: tiny_backbone())
        (head,) = self.heads()
        made = []
        for spoiled in (False, True):
            backbone = tiny_backbone()
            if spoiled:
                with torch.no_grad():
                    backbone.unet.conv_out.bias += 1
            painter = DiffusionInpainter(backbone, InpaintConfig(sampler_steps=2), 0, Ledger())
            made.append(painter.inpaint_heads([head], Progress.silent())[0])
        assert (made[0] == made[1]).all()
        assert (made[0][~head.unknown] == head.image[~head.unknown]).all()
        assert (made[0][head.unknown] != head.image[head.unknown]).any()

    @pytest.mark.parametrize("learned", [False, True])
    def test_is_for_backbones_that_have_learned_heads(self, tmp_path, learned):
        backbone = tiny_backbone()
        backbone.heads = learned
        save_mini(backbone, tmp_path)
        loaded = load_mini(tmp_path)

        def paints(**switches):
            return DiffusionInpainter(loaded, InpaintConfig(**switches), 0, Ledger()).paints_heads

        assert [paints(heads=heads) for heads in (None, False, True)] == [learned, False, True]
        assert not paints(heads=True, sg=False)

    def test_the_shipped_backbone_has_learned_them(self):
        assert load_mini().heads
