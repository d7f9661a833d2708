"""OccNeRF's field and fit: acceptance checks 3, 4, 6, 7 and 8; resume, bad input, the plan."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import nn

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.fit.rays.marching import MarchedPixels
from ihbench.fit.rays.ray_target import PosedBox
from ihbench.methods.occnerf import fitting
from ihbench.methods.occnerf.avatar import OccNerfAvatar
from ihbench.methods.occnerf.completeness import completeness
from ihbench.methods.occnerf.config import PAPER, PROFILES, QUICK, SMOKE, leave_out
from ihbench.methods.occnerf.field import decoded, vertex_features
from ihbench.methods.occnerf.fitting import OccNerfFit, PriorNoted, ending_vertices
from ihbench.methods.occnerf.method import OccNerf
from ihbench.methods.occnerf.stress import CASES, TINY, start
from ihbench.render.volumes.compositing import alpha_composite
from ihbench.render.volumes.density_laws import opacity, softplus_density
from ihbench.render.volumes.fast import march
from ihbench.render.volumes.intervals import box_interval, even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays, pixel_rays
from ihbench.render.volumes.reference import reference_rays
from ihbench.scene.contracts import MaskState
from ihbench.scene.method_spec import method_spec
from ihbench.stress.run import run_cases
from tests.bench.fake_capture import a_camera, a_pose, the_body

from .tiny_fit import SIZE, equal_bits, everything, training_set, training_views
from .tiny_gaussians import SavesAt, events, killed_after

BODY = the_body()
SMALL = replace(TINY, steps=10, decay_steps=10, patch_px=12, samples=24, width=16, weight_code=8, weight_channels=16)


def an_avatar(seed=0, **changes):
    return OccNerfAvatar(replace(SMALL, **changes), BODY, np.zeros(10), seed)


def a_fit(training, seed=0, ledger=None, **changes):
    return OccNerfFit(start(replace(SMALL, **changes), training), training, seed, ledger or Ledger())


@cache
def whole():
    """A fit to all views, in two passes, and its ledger."""
    ledger = Ledger()
    fit = a_fit(training_set(training_views()), ledger=ledger, inside=8)
    fit.run(Progress.silent())
    return fit.avatar, ledger


def seen_from_the_front(avatar, pixels, samples, dtype=torch.float32):
    """Field, rays through some pixels of a view, depths and lengths."""
    camera, pose = a_camera(0.0, SIZE), a_pose(0.4, 0.2)
    box = PosedBox.around(BODY, pose)
    rays = pixel_rays(camera, pixels // SIZE, pixels % SIZE, box.frame, dtype)
    near, far = box_interval(rays, *box.ends(dtype, "cpu"))
    met = (near < far).nonzero()[:, 0]
    depths = even_depths(near[met], far[met], samples)
    rays = rays[met]
    volume, features = avatar.decode()
    return avatar.posed(pose, volume, features), rays, depths, segment_lengths(depths, rays.lengths)


# ------------------------------------------------------------------------------------------ check 3: who ends a ray


class Faint(nn.Module):
    """A decoder that says the same everywhere."""

    def __init__(self, raw):
        super().__init__()
        self.raw = raw

    def forward(self, lent, variance, own):
        return lent.new_full((len(lent),), self.raw), lent.new_zeros(len(lent), 3)


@pytest.mark.parametrize(("raw", "count"), [(8.0, 10), (-12.0, 0)])
def test_check_3_the_vertices_nearest_to_where_a_ray_ends(views, raw, count):
    """A ray through a solid person ends near ten vertices, each of which gains one, however many such rays there are;
    one through a faint one ends nowhere."""
    training = training_set(views)
    fit = a_fit(training, completeness="off")
    fit.avatar.decoder = Faint(raw)
    middle = views[0].camera.project(BODY.posed_joints(views[0].body_pose)[9][None])[0]
    number = int(middle[1]) * SIZE + int(middle[0])
    field, rays, depths, lengths = seen_from_the_front(fit.avatar, np.array([number]), 64)

    marched = march(field, rays, depths, lengths, 1e-3)
    shown = MarchedPixels(marched.composited.rgb, marched.composited.alpha, depths, rays, marched, torch.arange(1))
    near = ending_vertices(fit.avatar, shown)
    assert near.numel() == count
    if count:
        alpha = marched.alpha[0]
        sample = int(alpha.argmax())
        place = rays.points(depths)[0, sample]
        canonical = field.bones.located(place[None])[1][0]
        apart = (fit.avatar.displaced() - canonical).norm(dim=1)
        assert set(near[0].tolist()) == set(apart.topk(10, largest=False).indices.tolist())


def test_check_3_nobody_is_counted_without_training(views):
    """Counters move in steps only: not when the avatar is drawn, nor when the guard looks at a loss; each by one at
    most in a step, and not at all where counting is off."""
    training = training_set(views)
    fit = a_fit(training, steps=3)
    counts = [fit.avatar.counters.clone()]
    update = fit._update

    def noted():
        update()
        counts.append(fit.avatar.counters.clone())

    fit._update = noted
    fit.run(Progress.silent())
    steps = torch.stack(counts).diff(dim=0)
    assert set(steps.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(fit.avatar.counters, counts[-1]), "the guard's look at the end"
    fit.avatar.render(views[0].camera, views[0].body_pose)
    assert torch.equal(fit.avatar.counters, counts[-1])
    off = a_fit(training, steps=2, visibility=False)
    off.run(Progress.silent())
    assert (off.avatar.counters == 1).all()


# ------------------------------------------------------------------------------------------ check 4: displacement


def test_check_4_displacements():
    """As released one number moves a vertex along (1, 1, 1); the named variant moves it along its normal."""
    for kind, length in (("released", math.sqrt(3) * 1e-2), ("normal", 1e-2)):
        avatar = an_avatar(displacement=kind)
        with torch.no_grad():
            avatar.displacement.fill_(1e-2)
        moved = avatar.displaced() - avatar.surface.vertices
        assert moved.norm(dim=1).tolist() == pytest.approx([length] * len(moved), rel=1e-4)
        wanted = torch.full((3,), 1e-2) if kind == "released" else 1e-2 * avatar.surface.normals
        torch.testing.assert_close(moved, wanted.expand_as(moved), atol=1e-6, rtol=0)
    first = an_avatar().displacement
    assert 0.9e-4 < first.abs().max() <= 1e-4


def test_features_are_of_where_a_vertex_was_moved_to():
    """And their gradient reaches the displacement of that vertex, and no other's."""
    avatar = an_avatar()
    features = vertex_features(avatar)
    assert features.shape == (8522, avatar.grid.width + 3)
    torch.testing.assert_close(features[:, -3:], avatar.displaced())
    (gradient,) = torch.autograd.grad(features[17, :-3].sum(), avatar.displacement)
    assert gradient.nonzero().flatten().tolist() == [17]


# ------------------------------------------------------------------------------------------ check 6: softplus fog


def test_check_6_zero_raw_density_is_a_fog():
    length = torch.tensor([0.05, 0.3, 2.0], dtype=torch.float64)
    samples = 64
    alpha = opacity(softplus_density(torch.zeros(3, samples, dtype=torch.float64)), (length / samples)[:, None])
    total = alpha_composite(alpha, torch.ones(3, samples, 3), torch.ones(3, samples)).alpha
    assert total.tolist() == pytest.approx((1 - torch.exp(-0.6931 * length)).tolist(), rel=1e-4)
    assert float(total[1]) == pytest.approx(0.19, abs=0.005), "through a torso, at the start of a fit"


# ----------------------------------------------------------------------------- check 7: nothing but the T-pose


def test_check_7_pose_moves_and_corrects_nothing(views):
    """The released configuration never switches the non-rigid network and the pose correction on, and no gradient
    reaches a canonical place, so what moved it would not learn: there is none. The same canonical place is the same
    in every pose; parameters are those of grid, networks, displacements and motion weights."""
    avatar, _ = whole()
    assert {name.split(".")[0] for name, _ in avatar.named_parameters()} == {
        "decoder", "displacement", "grid", "motion",
    }  # fmt: skip
    places = avatar.surface.vertices[::500].clone().requires_grad_()
    _, features = avatar.decode()
    at = decoded(avatar, features, places)
    (gradient,) = torch.autograd.grad(at.raw.sum() + at.rgb.sum(), places, allow_unused=True)
    assert gradient is None
    field = avatar.posed(a_pose(0.3, 0.5), *avatar.decode())
    posed = field.values(torch.zeros(1, 3))
    again = decoded(avatar, features, posed.canonical)
    torch.testing.assert_close(again.raw, posed.raw)


# --------------------------------------------------------------------------------- check 8: an occluded slab


def slab(prior, hidden=0.8, steps=800, inside=25, outside=103, thick=0.3):
    """Alpha of a ray through a slab of the body that the strip hides in a share of the frames: squared error times .2
    on random backgrounds, Adam, the samples of a box of 128."""
    torch.manual_seed(0)
    raw = torch.full((inside,), 0.1, requires_grad=True)
    optimizer = torch.optim.Adam([raw], lr=0.02, betas=(0.9, 0.99))
    lengths = torch.full((inside,), thick / inside)
    color, generator = torch.tensor([0.6, 0.3, 0.2]), torch.Generator().manual_seed(0)

    def alpha():
        return 1 - (1 - opacity(softplus_density(raw), lengths)).prod()

    for _ in range(steps):
        background = torch.rand(64, 3, generator=generator)
        shown = torch.rand(64, generator=generator) >= hidden
        wanted = torch.where(shown[:, None], color, background)
        loss = 0.2 * (alpha() * color + (1 - alpha()) * background - wanted).square().mean()
        if prior:
            loss = loss + completeness(raw, torch.ones(inside, dtype=torch.bool), inside + outside).total
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return alpha().item()


def test_check_8_the_prior_keeps_a_hidden_slab_solid():
    assert slab(prior=True) > 0.8
    assert slab(prior=False) == pytest.approx(0.2, abs=0.05)


# ------------------------------------------------------------------------------------- the renderer's twin


def test_the_fast_renderer_is_the_twin_without_any_skipping():
    avatar = an_avatar(clamp=False, neighbour_cell=0.0, least_weight=0.0)
    with torch.no_grad():
        avatar.grid.table.mul_(2e3)
        avatar.counters += torch.randint(0, 50, avatar.counters.shape, generator=torch.Generator().manual_seed(0))
    pixels = np.arange(SIZE * SIZE)[SIZE // 3 :: 97]
    field, rays, depths, lengths = seen_from_the_front(avatar, pixels, 24)
    with torch.no_grad():
        own = march(field, rays, depths, lengths, 0.0).composited
        exact = avatar.double()
        twin = seen_from_the_front(exact, pixels, 24, torch.float64)
        rgb, alpha, _ = reference_rays(*twin)
    assert alpha.max() > 0.05
    torch.testing.assert_close(own.alpha.double(), alpha, atol=2e-4, rtol=0)
    torch.testing.assert_close(own.rgb.double(), rgb, atol=2e-4, rtol=0)
    avatar.float()


def test_places_see_the_surface_and_not_themselves():
    """Two places over the same vertex at the same distance look alike: the networks are given features, no
    position."""
    avatar = an_avatar()
    surface = avatar.surface
    at = decoded(avatar, vertex_features(avatar), surface.vertices[100:101] + 0.01 * surface.normals[100:101])
    assert at.raw.shape == (1,)
    assert not at.inside[0]
    none = decoded(avatar, vertex_features(avatar), torch.empty(0, 3))
    assert none.rgb.shape == (0, 3)


# ------------------------------------------------------------------------------------- the completeness in a fit


def test_samples_without_weights_count_as_the_origin_as_released(views):
    """With `released` all samples of the rays' boxes are in the mean, most of them at the origin, inside the torso;
    with `body` those alone that are evaluated. A second pass has closer samples, which stand for less each."""
    training = training_set(views)
    values = {}
    for kind, refined in (("body", 0), ("body", 12), ("released", 0), ("off", 0)):
        fit = a_fit(training, completeness=kind, inside=refined)
        fit._loss(0)
        values[kind, refined] = fit._prior
    assert values["off", 0] is None
    body, finer, released = values["body", 0], values["body", 12], values["released", 0]
    assert body.collapsed == finer.collapsed == 0
    assert released.body.item() == pytest.approx(body.body.item())
    assert 3 < released.collapsed.item() < 10
    assert finer.body.item() == pytest.approx(body.body.item(), rel=0.5)


# ------------------------------------------------------------------------------------------- the fit as a whole


def test_everything_learns_and_the_record_says_how(views):
    avatar, ledger = whole()
    first = start(replace(SMALL, inside=8), training_set(views))
    for name, value in avatar.named_parameters():
        if name.startswith("motion.") or name.startswith("decoder.") or name in ("displacement", "grid.table"):
            assert not torch.equal(value, dict(first.named_parameters())[name]), name
    assert any(event.kind == LeftOut.kind and "stands for it" in event.data["reason"] for event in ledger.events) or (
        not any(event.kind == LeftOut.kind for event in ledger.events)
    )
    assert avatar.counters.max() > 1


def test_the_prior_is_noted(views, monkeypatch):
    monkeypatch.setattr(fitting, "NOTED_EVERY", 3)
    ledger = Ledger()
    fit = a_fit(training_set(views[:1]), ledger=ledger, steps=4)
    fit.run(Progress.silent())
    (note,) = events(ledger, PriorNoted.kind)
    assert note["step"] == 3
    assert note["collapsed"] == 0
    assert 0 < note["seen_vertices"] < 1


def test_released_rates_fall_and_everything_is_clipped_together(views):
    """.1^(it / 500 000): .631 at the released end; the norm of all gradients is 1 at most."""
    fit = a_fit(
        training_set(views), completeness="released", completeness_weight=100.0, clip=1.0, decay_steps=500_000
    )
    fit.step = 100_000
    assert fit._rate_share() == pytest.approx(0.631, abs=1e-3)
    fit.step = 0
    fit._loss(0).backward()
    fit._check_gradients()
    norm = torch.stack([p.grad.norm() for p in fit.avatar.parameters() if p.grad is not None]).norm()
    assert float(norm) == pytest.approx(1.0, abs=1e-4)
    assert (PAPER.lr, PAPER.lr_grid, PAPER.lr_displacement, PAPER.lr_motion) == (5e-4, 5e-4, 1e-4, 5e-5)
    assert (PAPER.mse, PAPER.lpips, PAPER.completeness_weight, PAPER.clip) == (0.2, 1.0, 1.0, 1.0)


def test_the_released_sizes():
    sizes = (PAPER.levels, PAPER.hash_size, PAPER.hash_finest, PAPER.width, PAPER.depth, PAPER.samples, PAPER.patches,
             PAPER.patch_px, PAPER.inside, PAPER.steps)  # fmt: skip
    assert sizes == (16, 19, 2048, 256, 4, 128, 6, 32, 0, 100_000)


def test_a_resumed_fit_is_the_same_to_the_bit(views):
    """Killed after 7 steps with the state of step 5; counters, coarse sets and displacements go on."""
    training = training_set(views)
    avatar, _ = whole()
    ledger = SavesAt(5)
    killed_after(a_fit(training, ledger=ledger, inside=8), 7)
    again = a_fit(training, ledger=ledger, inside=8)
    again.run(Progress.silent())
    assert equal_bits(everything(again.avatar), everything(avatar))


def test_a_saved_avatar_draws_the_same(views, tmp_path):
    """Coarser sets and counters are in the file: a loaded avatar has no others (the released code draws new ones)."""
    avatar, _ = whole()
    avatar.save(tmp_path)
    loaded = OccNerf(SMALL).load(tmp_path, BODY)
    assert torch.equal(loaded.counters, avatar.counters)
    for own, other in zip(*(each.render(views[0].camera, views[0].body_pose) for each in (avatar, loaded)),
                          strict=True):  # fmt: skip
        assert np.array_equal(own, other)
    (tmp_path / "avatar.json").write_text("{}")
    with pytest.raises(BadInput, match="kind"):
        OccNerf(SMALL).load(tmp_path, BODY)


def test_a_picture_is_bounded_and_stands_on_the_background(views):
    avatar, _ = whole()
    view = views[0]
    rgb, alpha = avatar.render(view.camera, view.body_pose, (0.0, 0.5, 1.0))
    assert rgb.shape == (SIZE, SIZE, 3)
    assert (alpha >= 0).all()
    assert alpha.max() > 0.1
    assert rgb[alpha == 0] == pytest.approx(np.broadcast_to([0.0, 0.5, 1.0], rgb[alpha == 0].shape))
    other = avatar.render(view.camera, view.body_pose, (1.0, 1.0, 1.0))[0]
    change = (1 - alpha)[..., None] * np.array([1.0, 0.5, 0.0])
    assert other - rgb == pytest.approx(change, abs=1e-5)


# --------------------------------------------------------------------------------------------------- bad input


def fit_of(views, ledger=None, **changes):
    return OccNerf(replace(SMALL, **changes)).fit(
        training_set(views), device="cpu", seed=0, ledger=ledger or Ledger(), progress=Progress.silent()
    )


def test_views_without_a_visible_pixel_are_not_drawn(views):
    blank = replace(views[1], mask=np.full_like(views[1].mask, MaskState.UNKNOWN))
    fit = a_fit(training_set([views[0], blank, views[2]]))
    assert {fit._view_of(step, 3) for step in range(20)} == {0, 2}


@pytest.mark.parametrize("unknown", ["background", "ignore"])
def test_bodies_beside_the_image_do_not_harm(views, unknown):
    beside = replace(views[2], body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(views[4], body_pose=a_pose(transl=(0, 0, 9)))
    avatar = fit_of([views[1], beside, behind], unknown=unknown, steps=6)
    assert all(p.isfinite().all() for p in avatar.parameters())


def test_a_nan_pixel_is_a_divergence_and_one_behind_the_occluder_is_nobodys_business(views):
    image = views[0].image.astype(np.float32)
    image[views[0].mask == MaskState.PERSON] = np.nan
    with pytest.raises(Diverged, match="loss is nan") as caught:
        fit_of([replace(views[0], image=image)], steps=2)
    assert caught.value.step == 0
    image = views[1].image.astype(np.float32)
    image[views[1].mask == MaskState.UNKNOWN] = np.nan
    for unknown in ("background", "ignore"):
        some = (replace(views[1], image=image), views[1])
        one, other = (fit_of([view], unknown=unknown, steps=2) for view in some)
        assert equal_bits(everything(one), everything(other))


# -------------------------------------------------------------------------------------------------------- plan


class Scene:
    """A `SceneMeasure` of which the plan reads these."""

    covered_views = 80


def test_the_plan_leaves_out_what_a_scene_does_not_need():
    scene = Scene()
    assert leave_out(QUICK, scene) == []
    scene.covered_views = 0
    assert [(o.field, o.value) for o in leave_out(QUICK, scene)] == [("visibility", False)]
    assert leave_out(replace(QUICK, visibility=False), scene) == []


def test_it_is_registered_and_its_profiles_keep_what_makes_it():
    spec = method_spec("occnerf")
    assert spec.load(spec.method) is OccNerf
    assert spec.profile("smoke") is SMOKE
    for profile in PROFILES.values():
        assert profile.unknown == "background"
        assert profile.completeness != "off"
        assert profile.visibility
        assert profile.displacement == "released"
        assert profile.clip == 1


@pytest.mark.parametrize("name", ["rate-1", "rate-1e+30", "huge-prior"])
def test_stress_cases_pass(name):
    (case,) = [case for case in CASES if case.name == f"occnerf-{name}"]
    (outcome,) = run_cases([case])
    assert outcome.verdict == "passed", outcome.reason


def test_a_ray_that_meets_nothing_is_the_background():
    avatar = an_avatar()
    field = avatar.posed(a_pose(), *avatar.decode())
    rays = Rays(torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    depths = torch.linspace(1, 2, 8)[None]
    shown = march(field, rays, depths, segment_lengths(depths, rays.lengths))
    assert not shown.active.any()
    assert shown.composited.alpha[0] == 0
