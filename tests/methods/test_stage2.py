"""Stage 2: what is asked of the painter, what is believed of it, and that a killed run goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import cut_view, with_frames
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.methods.inpainthuman.inpainting.painted_view import paste_back
from ihbench.methods.inpainthuman.inpainting.shown_view import orbit, turntable_view, with_known_surface
from ihbench.methods.inpainthuman.inpainting.surface_need import SeenSurface, key_views, pixels_of, seen_surface
from ihbench.methods.inpainthuman.stages.stage2 import Stage2
from ihbench.scene.contracts import MaskState
from ihbench.scene.visibility import PosedSurface
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view
from tests.methods.tiny_fit import SIZE, an_avatar, shaken, training_set, training_views

QUIET = Progress.silent()
HIDDEN = slice(28, 36)
SIMPLE = InpaintConfig(filler="mean", key_views=0)


def one_sided(hidden=HIDDEN):
    """Three views of the front, the strip in all of them: the middle of the front is hidden, the back never seen."""
    return training_set([train_view(a_camera(0.0, SIZE), a_pose(0.0, 0.1 * k), hidden, frame=k) for k in range(3)])


def red(view, at):
    """A view whose image is red where `at`."""
    return np.where(at[..., None], np.array([255, 0, 0], np.uint8), view.image)


class TestNeed:
    def test_a_strip_that_never_moves_hides_its_surface(self):
        training = one_sided()
        surface = seen_surface(training)
        view = training.views[0]
        unseen = pixels_of(surface.map_of(surface.unseen), the_body().pose(view.body_pose), the_body(), view.camera)
        hidden, body = view.mask == MaskState.UNKNOWN, view.mask == MaskState.PERSON
        assert unseen[hidden].sum() > 40
        assert not unseen[body].mean() > 0.05  # the rim is seen too obliquely to count

    def test_nothing_is_needed_where_another_view_shows_it(self):
        views = [*one_sided().views, train_view(a_camera(0.0, SIZE), a_pose(0.0, 0.0), None, frame=9)]
        surface = seen_surface(training_set(views))
        view = views[0]
        unseen = pixels_of(surface.map_of(surface.unseen), the_body().pose(view.body_pose), the_body(), view.camera)
        hidden = view.mask == MaskState.UNKNOWN
        assert (unseen & hidden).sum() < 0.1 * hidden.sum()

    def test_a_body_nowhere_in_the_image(self):
        training = one_sided()
        away = the_body().pose(a_pose(0.0, 0.0)) + np.array([50.0, 0, 0])
        everything = np.ones((64, 64), bool)
        assert not pixels_of(everything, away, the_body(), training.views[0].camera).any()
        here = the_body().pose(training.views[0].body_pose)
        assert pixels_of(everything, here, the_body(), training.views[0].camera).any()

    def test_surface_seen_at_a_glancing_angle_only_needs_no_painter(self):
        training = one_sided()
        everything, well = (seen_surface(training, facing) for facing in (0.0, 0.7))
        best = np.zeros(len(well.views))
        for view in training.views:
            faced = PosedSurface(the_body(), view.camera, view.body_pose).faced(well.texels)
            best[faced.texel] = np.maximum(best[faced.texel], faced.cosine)
        assert (everything.unseen == well.unseen).all()
        assert (everything.needed <= everything.unseen).all()
        assert (well.needed == everything.needed & (best >= 0.7)).all()
        assert 10 < well.needed.sum() < everything.needed.sum()

    def test_key_views_cover_every_needed_texel(self):
        faced = [np.arange(0, 10), np.arange(0, 10), np.arange(5, 20), np.arange(18, 30), np.arange(0, 0)]
        needed = np.ones(30, bool)
        chosen = key_views(faced, needed, 3)
        assert len(chosen) == 3
        assert set(np.concatenate([faced[k] for k in chosen])) == set(range(30))
        assert key_views(faced, needed, 0) == [0, 1, 2, 3]
        assert key_views(faced, np.zeros(30, bool), 0) == []


class TestShown:
    def test_only_unseen_surface_stays_unknown(self):
        views = training_views()
        training = training_set(views)
        surface = seen_surface(training)
        avatar = shaken(an_avatar())
        shown = with_known_surface(views[1], training, avatar, surface)
        was, is_now = views[1].mask == MaskState.UNKNOWN, shown.mask == MaskState.UNKNOWN
        assert is_now.sum() < was.sum()
        assert not (is_now & ~was).any()
        assert (shown.image[~was] == views[1].image[~was]).all()
        rgb, _ = avatar.render(views[1].camera, views[1].body_pose, training.background)
        drawn = was & ~is_now
        np.testing.assert_array_equal(shown.image[drawn], np.rint(rgb[drawn] * 255).astype(np.uint8))

    def test_a_turntable_view_asks_for_the_side_nobody_filmed(self):
        training = one_sided(hidden=None)
        surface = seen_surface(training)
        avatar = an_avatar()
        front, back = (turntable_view(angle, training.views[0], training, avatar, surface) for angle in (0.0, np.pi))
        body = [(view.mask != MaskState.BACKGROUND).sum() for view in (front, back)]
        asked = [(view.mask == MaskState.UNKNOWN).sum() for view in (front, back)]
        assert asked[0] < 0.25 * body[0]
        assert asked[1] > 0.75 * body[1]

    def test_an_orbit_keeps_the_distance_and_turns_right_round(self):
        camera, pose = a_camera(0.0, SIZE), a_pose(0.4, 0.2)
        pelvis = the_body().shaped(pose.betas)[1][0] + pose.transl
        for angle in (0.5, 2.0, np.pi):
            turned = orbit(camera, pose, the_body(), angle)
            np.testing.assert_allclose(turned.to_camera(pelvis), camera.to_camera(pelvis), atol=1e-9)
            np.testing.assert_allclose(turned.R @ turned.R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(orbit(camera, pose, the_body(), 2 * np.pi).R, camera.R, atol=1e-9)
        assert np.linalg.norm(orbit(camera, pose, the_body(), np.pi).center - camera.center) > 2


class TestOwnGuess:
    def test_painted_pixels_lie_between_the_painting_and_the_avatar(self):
        training, avatar = one_sided(), shaken(an_avatar(), 0.05)
        painted, mixed, own = (
            Stage2(avatar, training, replace(SIMPLE, trust=trust), 0, Ledger()).run(QUIET)[0]
            for trust in (1, 0.75, 0)
        )
        where = painted.generated & (own.view.mask == MaskState.PERSON)
        low, middle, high = (view.view.image[where].astype(float) for view in (painted, mixed, own))
        assert np.abs(low - high).mean() > 5
        np.testing.assert_allclose(middle, 0.75 * low + 0.25 * high, atol=2.5)  # rounded in the crop, then resampled
        drawn = 255 * avatar.render(painted.view.camera, painted.view.body_pose, training.background)[0][where]
        assert np.abs(high - drawn).mean() < 0.35 * np.abs(low - drawn).mean()
        kept = ~painted.generated
        np.testing.assert_array_equal(painted.view.image[kept], mixed.view.image[kept])

    def test_a_frames_own_context_leaves_the_painter_alone(self):
        training, avatar = one_sided(), shaken(an_avatar(), 0.05)
        alone, trusted = (
            Stage2(avatar, training, replace(SIMPLE, context="frame", trust=trust), 0, Ledger()).run(QUIET)[0]
            for trust in (1, 0.5)
        )
        np.testing.assert_array_equal(alone.view.image, trusted.view.image)


class TestBelieved:
    def setup_method(self):
        self.view = one_sided().views[0]
        self.crop = cut_view(self.view, 0, the_body(), 64)

    def test_the_original_stays_and_the_painted_joins(self):
        painted = red(self.crop, self.crop.unknown)
        done = paste_back(self.view, self.crop, painted, self.crop.body, self.view)
        known = self.view.mask != MaskState.UNKNOWN
        assert (done.view.image[known] == self.view.image[known]).all()
        assert (done.view.mask[known] == self.view.mask[known]).all()
        inside = done.generated & (done.view.mask == MaskState.PERSON)
        middle = inside & np.roll(inside, 2, 1) & np.roll(inside, -2, 1)
        assert middle.any()
        assert (done.view.image[middle] == (255, 0, 0)).mean() > 0.95
        assert not (done.generated & known).any()

    def test_hidden_pixels_that_nobody_was_asked_about_stay_unknown(self):
        asked = self.view.mask.copy()
        rows = np.arange(SIZE)[:, None] < SIZE // 2
        asked[(asked == MaskState.UNKNOWN) & rows] = MaskState.PERSON
        shown = replace(self.view, mask=asked)
        crop = cut_view(shown, 0, the_body(), 64)
        done = paste_back(shown, crop, crop.image, crop.body, self.view)
        upper = (self.view.mask == MaskState.UNKNOWN) & rows
        assert (done.view.mask[upper] == MaskState.UNKNOWN).all()
        assert not done.generated[upper].any()

    def test_of_a_turntable_view_only_the_painted_is_believed(self):
        done = paste_back(self.view, self.crop, self.crop.image, self.crop.body, None)
        assert ((done.view.mask != MaskState.UNKNOWN) == done.generated).all()


class TestStage2:
    def test_paints_and_resumes_without_painting_again(self, tmp_path, monkeypatch):
        training, avatar = one_sided(), shaken(an_avatar(), 0.05)
        first = Stage2(avatar, training, SIMPLE, 0, Ledger(tmp_path)).run(QUIET)
        assert len(first) == 3
        assert (tmp_path / "inpainting.png").is_file()
        monkeypatch.setattr(Stage2, "_inpainter", None)
        again = Stage2(avatar, training, SIMPLE, 0, Ledger(tmp_path)).run(QUIET)
        for a, b in zip(first, again, strict=True):
            assert a.index == b.index
            assert (a.view.image == b.view.image).all()
            assert (a.view.mask == b.view.mask).all()
            assert (a.generated == b.generated).all()
            np.testing.assert_array_equal(a.view.camera.K, b.view.camera.K)
            np.testing.assert_array_equal(a.view.body_pose.pose, b.view.body_pose.pose)

    def test_nothing_hidden_loads_no_painter(self, monkeypatch):
        monkeypatch.setattr(Stage2, "_inpainter", None)
        ledger = Ledger()
        assert Stage2(an_avatar(), one_sided(hidden=None), SIMPLE, 0, ledger).run(QUIET) == []
        assert [event.data["what"] for event in ledger.events] == ["inpainting"]

    def test_context_frame_asks_for_every_hidden_pixel(self):
        training = training_set()
        config = replace(SIMPLE, context="frame")
        painted = Stage2(an_avatar(), training, config, 0, Ledger()).run(QUIET)
        hiding = [k for k, view in enumerate(training.views) if (view.mask == MaskState.UNKNOWN).any()]
        assert [view.index for view in painted] == hiding
        for view in painted:
            hidden = training.views[view.index].mask == MaskState.UNKNOWN
            assert (view.generated & hidden).sum() > 0.5 * hidden.sum()

    def test_simple_painters_borrow_from_frames_that_need_no_painting(self):
        """Only the first view hides something; the clear one after it shows what."""
        clear = train_view(a_camera(0.0, SIZE), a_pose(0.0, 0.0), None, frame=1)
        training = training_set([train_view(a_camera(0.0, SIZE), a_pose(0.0, 0.0), HIDDEN, frame=0), clear])
        config = replace(SIMPLE, context="frame", filler="temporal")
        (done,) = Stage2(an_avatar(), training, config, 0, Ledger()).run(QUIET)
        believed = done.generated & (done.view.mask == MaskState.PERSON)
        assert believed.sum() > 50
        error = np.abs(done.view.image[believed].astype(int) - clear.image[believed]).mean()
        (mean,) = Stage2(an_avatar(), training, replace(config, filler="mean"), 0, Ledger()).run(QUIET)
        assert error < 0.5 * np.abs(mean.view.image[believed].astype(int) - clear.image[believed]).mean()

    def test_what_the_avatar_drew_is_no_evidence(self):
        training = training_set()
        crops = [cut_view(view, k, the_body(), 64) for k, view in enumerate(training.views)]
        asked = [replace(crops[1], person=crops[1].body), replace(crops[0], index=6)]  # drawn, and a turntable view
        filmed = with_frames(asked, crops)
        assert [view.index for view in filmed] == [1, 6, 0, 2, 3, 4, 5]
        assert (filmed[0].person == crops[1].person).all()
        assert not filmed[1].person.any()
        assert (filmed[0].unknown == asked[0].unknown).all()
        assert not any(view.unknown.any() for view in filmed[2:])

    def test_nothing_to_paint_inside_any_crop(self, monkeypatch):
        """Hidden pixels far from the person ask for nothing."""
        far = slice(0, 3)
        ledger = Ledger()
        config = replace(SIMPLE, context="frame")
        monkeypatch.setattr(Stage2, "_shown", lambda self, surface: {0: one_sided(far).views[0]})
        assert Stage2(an_avatar(), one_sided(far), config, 0, ledger).run(QUIET) == []
        assert [event.kind for event in ledger.events] == ["left_out"]

    def test_what_is_claimed_is_in_the_record(self):
        ledger = Ledger()
        Stage2(an_avatar(), one_sided(), SIMPLE, 0, ledger).run(QUIET)
        (event,) = [event for event in ledger.events if event.kind == "inpainted"]
        assert event.data["views"] == 3
        assert event.data["pixels"] > 0
        assert {"identity_drift", "flicker"} <= set(event.data)
        assert {"look", "inpaint", "silhouette", "measure"} <= set(ledger.state().stages)

    def test_turntable_views_follow_the_training_views(self):
        config = replace(SIMPLE, turntable=3)
        painted = Stage2(an_avatar(), one_sided(), config, 0, Ledger()).run(QUIET)
        assert {view.index for view in painted} >= {3, 4, 5} - {3}
        assert all(view.view.frame == -1 for view in painted if view.index >= 3)


def test_a_map_of_texels_reaches_beyond_the_charts():
    surface = seen_surface(one_sided())
    assert isinstance(surface, SeenSurface)
    table = surface.texels
    on = table.mask
    unseen = surface.map_of(surface.unseen)
    assert (unseen[on] == (surface.views == 0)).all()
    assert unseen[~on].any()
