"""OccGaussian's acceptance checks by number (one fit for all that look at a fit), resume, plan and bad input."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.fit.big_pose.avatar import VERTEX
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.harmonics import DC, Y00
from ihbench.methods.gauhuman.avatar import GauHumanAvatar
from ihbench.methods.gauhuman.config import SMOKE as GAUHUMAN
from ihbench.methods.gauhuman.fitting import GauHumanFit
from ihbench.methods.occgaussian.avatar import OccGaussianAvatar
from ihbench.methods.occgaussian.band import draw_band
from ihbench.methods.occgaussian.config import PAPER, PROFILES, SMOKE, BandConfig, FeatureConfig, leave_out
from ihbench.methods.occgaussian.fitting import OccGaussianFit
from ihbench.methods.occgaussian.method import OccGaussian
from ihbench.methods.occgaussian.query import LISTED, Neighbourhood, make_query, neighbourhood
from ihbench.methods.occgaussian.sightings import look_at, look_through, vertices_as_texels
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scene.method_spec import method_spec
from tests.bench.fake_capture import WHITE, a_camera, a_pose, rasterized, the_body, train_view

from .tiny_fit import equal_bits, everything
from .tiny_gaussians import SavesAt, events, killed_after

BODY = the_body()
QUIET = Progress.silent()
SIZE = 64  # px
STRIP = slice(27, 37)
TURNS = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.05, np.pi - 0.2, np.pi + 0.2)  # rad; the last two are clear
PLAIN = {"white_reset": 0, "weight_network": False, "pose_network": False}
FAST = PLAIN | {"lr_opacity": 0.4, "lr_colour": 0.05}
TINY = replace(
    SMOKE,
    steps=12,
    density=DensityConfig(after=4, before=11, every=3),
    features=replace(SMOKE.features, channels=(4, 4, 4), size=4, every=5),
    **PLAIN,
)


def two_coloured():
    """[V, 3] red on the person's left, blue on its right, green in waves across."""
    x = BODY.v_template[:, 0]
    left = x[:, None] > 0
    return np.where(left, [0.9, 0, 0.1], [0.1, 0, 0.9]) + np.stack([0 * x, 0.5 + 0.35 * np.sin(30 * x), 0 * x], 1)


def painted(k, yaw, strip, colours):
    """A view of the person in these colours; the columns `strip` are unknown."""
    camera, pose = a_camera(0.0, SIZE), a_pose(yaw, 0.1 * np.sin(k))
    view, raster = train_view(camera, pose, strip, frame=k), rasterized(camera, pose)
    image = np.full_like(view.image, 255)
    image[raster.mask] = np.round(255 * raster.interpolate(colours, BODY.faces)[raster.mask])
    image[view.mask == MaskState.UNKNOWN] = 255
    return replace(view, image=image)


def some_views(clear=False):
    colours = two_coloured()
    return [painted(k, yaw, None if clear or k >= 8 else STRIP, colours) for k, yaw in enumerate(TURNS)]


def set_of(views):
    return TrainingSet(views, BODY, WHITE, "tiny")


@pytest.fixture(scope="module")
def training():
    return set_of(some_views())


def an_avatar(config=TINY, seed=0):
    return OccGaussianAvatar(config, BODY, seed)


def a_fit(config, training, seed=0, ledger=None):
    avatar = an_avatar(config, seed)
    seen = look_through(training.views, BODY, config) if config.features.on else None
    return OccGaussianFit(avatar, training, seed, ledger or Ledger(), seen)


def fitted(config, training, seed=0, ledger=None):
    fit = a_fit(config, training, seed, ledger)
    fit.run(QUIET)
    return fit.avatar


@pytest.fixture(scope="module")
def trained(training):
    """The one fit that the checks look at, with GauHuman's to the same views beside it."""
    config = replace(SMOKE, steps=50, **FAST)
    fit = a_fit(config, training)
    fit.remember()
    before = drop_errors(fit)
    ledger = fit.ledger
    fit.run(QUIET)
    gauhuman = GauHumanAvatar(replace(GAUHUMAN, steps=40, sh_degree=0, **FAST), BODY, 0)
    GauHumanFit(gauhuman, training, 0, Ledger()).run(QUIET)
    return SimpleNamespace(fit=fit, avatar=fit.avatar, before=before, ledger=ledger, gauhuman=gauhuman)


def rest_colours(avatar):
    """[V, 3] mean colour of the Gaussians of each vertex, at rest; [V] whether there is one."""
    with torch.no_grad():
        return by_vertex(avatar, avatar.at_rest().colours)


def by_vertex(avatar, colours):
    vertex, count = avatar.gaussians.carried(VERTEX), len(BODY.v_template)
    total = torch.zeros(count, 3).index_add(0, vertex, colours.detach())
    number = torch.zeros(count).index_add(0, vertex, torch.ones(len(vertex)))
    return (total / number.clamp(min=1)[:, None]).numpy(), (number > 0).numpy()


# ---------------------------------------------------------------------------------- checks 1 and 2: GauHuman's base


def test_check_1_step_0_is_gauhuman(training):
    fit = a_fit(replace(SMOKE, white_reset=0), training)
    fit.remember()
    gauhuman = GauHumanAvatar(replace(GAUHUMAN, sh_degree=0), BODY, 0)
    for view in training.views[::8]:
        ours, theirs = (a.render(view.camera, view.body_pose) for a in (fit.avatar, gauhuman))
        assert np.abs(ours[0] - theirs[0]).max() < 1e-3
        assert np.abs(ours[1] - theirs[1]).max() < 1e-3
        assert theirs[1].max() > 0.1


def test_check_2_with_nothing_hidden_the_plan_leaves_features_out_and_the_fit_is_gauhumans():
    clear = set_of(some_views(clear=True))
    from ihbench.scene.plan import SceneMeasure

    measure = SceneMeasure(10, 0, 9, 0.0, 0.9, 0.0, 0.1, 60.0, 90.0, 3.0, 1700.0, {"rule": "none"})
    (omission,) = [o for o in leave_out(TINY, measure) if o.field.startswith("features")]
    assert (omission.field, omission.value) == ("features.on", False)
    assert not leave_out(TINY, replace(measure, hidden_share=0.1))
    without = replace(TINY, features=replace(TINY.features, on=False))
    ours = fitted(without, clear)
    own = {name: getattr(TINY, name) for name in ("steps", "density", *PLAIN)}
    theirs = GauHumanAvatar(replace(GAUHUMAN, sh_degree=0, **own), BODY, 0)
    GauHumanFit(theirs, clear, 0, Ledger()).run(QUIET)
    assert ours.encoder is None
    assert equal_bits(everything(ours), everything(theirs))
    view = clear.views[0]
    assert np.array_equal(ours.render(view.camera, view.body_pose)[0], theirs.render(view.camera, view.body_pose)[0])


# ------------------------------------------------------------------------------------------- checks 3 to 5: the query


def brute_force(near, rows, candidates, count):
    """The neighbours restated: sorted distances among candidates of parts that may be asked, else of all."""
    out = []
    for row in rows:
        allowed = candidates & near.beside[near.parts[row]][near.parts]
        allowed[row] = False
        if not allowed.any():
            allowed = candidates & (np.arange(len(candidates)) != row)
        having = np.flatnonzero(allowed)
        distance = np.linalg.norm(near.points[having].astype(np.float64) - near.points[row], axis=1)
        out.append(np.sort(distance)[:count])
    return out


@pytest.mark.parametrize(
    ("share", "same_part"),
    [(0.5, True), (0.004, True), (0.0002, True), (0.0, True), (0.004, False)],
    ids=["many", "few", "two", "none", "anywhere"],
)
def test_check_3_who_is_asked_and_with_what_weight(share, same_part):
    near, rng = neighbourhood(BODY, same_part), np.random.default_rng(5)
    seen = np.where(rng.random(len(near.points)) < share, rng.integers(1, 20, len(near.points)), 0)
    rows = rng.choice(len(near.points), 60, replace=False).astype(np.int64)
    query = make_query(near, rows, seen > 0, seen, neighbours=10, sigma=0.03, device=torch.device("cpu"))
    expected = brute_force(near, rows, seen > 0, 10)
    for q, distances in enumerate(expected):
        weights = query.weights[q].numpy()
        asked = query.index[q].numpy()[: len(distances)]
        assert abs(weights.sum() - (len(distances) > 0)) < 1e-6
        assert not weights[len(distances) :].any()
        assert (seen[asked] > 0).all()
        assert len(set(asked)) == len(asked)
        assert rows[q] not in asked
        got = np.linalg.norm(near.points[asked].astype(np.float64) - near.points[rows[q]], axis=1)
        np.testing.assert_allclose(got, distances, atol=1e-6)
        raw = np.exp(-(distances**2 - distances[:1] ** 2) / (2 * 0.03**2)) * np.log1p(seen[asked])
        np.testing.assert_allclose(weights[: len(distances)], raw / raw.sum() if len(raw) else [], atol=1e-4)
        if same_part and (seen > 0)[near.beside[near.parts[rows[q]]][near.parts]].sum() > (seen[rows[q]] > 0):
            assert near.beside[near.parts[rows[q]], near.parts[asked]].all()


def test_the_lists_and_a_search_among_all_agree():
    """Candidates far from everything: every list ends before the tenth."""
    near = neighbourhood(BODY)
    rows = np.flatnonzero(near.parts == 3)[:40].astype(np.int64)
    candidates = np.zeros(len(near.points), bool)
    candidates[near.lists[rows].max(1)] = True
    candidates[near.lists[rows][near.lists[rows] >= 0]] = False
    candidates[np.flatnonzero(near.parts == 6)[-30:]] = True
    index, distance = near.nearest(rows, candidates, 10)
    for q, expected in enumerate(brute_force(near, rows, candidates, 10)):
        np.testing.assert_allclose(np.sort(distance[q][index[q] >= 0]), expected, atol=1e-6)
    assert near.lists.shape[1] == LISTED


def test_check_4_a_body_of_one_colour_stays_of_one_colour(training):
    """Whatever the geometry."""
    fit = a_fit(TINY, training)
    fit.remember()
    avatar, colour = fit.avatar, torch.tensor([0.3, 0.6, 0.2])
    with torch.no_grad():
        generator = torch.Generator().manual_seed(3)
        for name, p in avatar.gaussians.attributes.items():
            p += 0.02 * torch.randn(p.shape, generator=generator) * (name != DC)
        asks = (avatar.seen <= 0)[avatar.gaussians.carried(VERTEX)]
        avatar.gaussians.attributes[DC][~asks] = (colour - 0.5) / Y00
        found = avatar.at_rest().colours[asks]
    assert len(found) > 1000
    assert (found - colour).abs().max() < 1e-4


def test_check_5_queried_gaussians_take_the_colour_of_their_side(trained):
    avatar = trained.avatar
    colours, there = rest_colours(avatar)
    asked = there & (avatar.seen.numpy() <= 0) & (avatar.hidden.numpy() > 0)
    assert asked.sum() > 2000
    left = avatar.deformation.vertices[:, 0].numpy() > 0
    own = (colours[:, 0] > colours[:, 2]) == left
    assert own[asked].mean() >= 0.95


def test_check_5_without_the_restriction_to_parts_fewer_do():
    """In the big pose no leg is near the other, so it is tried where knees touch: there each asks the other one."""
    points = BODY.v_template.copy()
    side = np.sign(points[:, 0])
    knees = np.isin(BODY.parts, (4, 5))
    points[knees, 0] -= side[knees] * (np.abs(points[knees, 0]).min() - 0.005)
    # the inside of the left knee and shin is hidden, that of the right ones is not
    hidden = (BODY.parts == 4) & (points[:, 0] < 0.05)
    assert hidden.sum() > 100
    rows, seen = np.flatnonzero(hidden), (~hidden).astype(np.int64)
    share = []
    for beside in (neighbourhood(BODY).beside, np.ones((24, 24), bool)):
        near = Neighbourhood(points, BODY.parts, beside)
        query = make_query(near, rows, seen > 0, seen, neighbours=10, sigma=0.03, device=torch.device("cpu"))
        answers = query.of(torch.from_numpy(two_coloured()).float())
        share.append(float((answers[:, 0] > answers[:, 2]).float().mean()))
    assert share[0] >= 0.95
    assert share[1] < share[0] - 0.1, share


# ---------------------------------------------------------------------------------- check 6: blind where hidden


def gradients(fit, k):
    fit._targets = type(fit._targets)(fit._target, len(fit.training.views), held=1)
    fit.step = 0
    fit.remember()
    for p in fit.avatar.parameters():
        p.grad = None
    loss = fit._loss(k)
    loss.backward()
    grads = {n: p.grad.clone() for n, p in fit.avatar.named_parameters() if p.grad is not None}
    return {"loss": loss.detach(), "memory": fit.avatar.memory.clone()} | grads


def test_check_6_pixels_behind_the_occluder_change_nothing(training):
    views = list(training.views)
    noise = np.random.default_rng(0).integers(0, 255, views[1].image.shape, dtype=np.uint8)
    unknown = (views[1].mask == MaskState.UNKNOWN)[..., None]
    other = [replace(v, image=np.where(unknown, noise, v.image)) if k == 1 else v for k, v in enumerate(views)]
    one, two = (gradients(a_fit(TINY, set_of(some)), 1) for some in (views, other))
    assert equal_bits(one, two)
    person = (views[1].mask == MaskState.PERSON)[..., None]
    seen = [replace(v, image=np.where(person, noise, v.image)) if k == 1 else v for k, v in enumerate(views)]
    assert not equal_bits(one, gradients(a_fit(TINY, set_of(seen)), 1))


# ------------------------------------------------------------------------------------------ check 7: the hidden body


def test_check_7_the_hidden_body_is_there_and_has_its_colour(trained):
    clear = painted(3, 0.0, None, two_coloured())
    body = clear.mask == MaskState.PERSON
    strip = body & (np.arange(SIZE) >= STRIP.start) & (np.arange(SIZE) < STRIP.stop)
    found = {}
    for name in ("avatar", "gauhuman"):
        rgb, alpha = getattr(trained, name).render(clear.camera, clear.body_pose)
        error = np.square(rgb - clear.image / 255.0)[strip].mean()
        found[name] = alpha[strip].mean(), -10 * np.log10(error)
    assert found["avatar"][0] >= 0.9, found
    assert found["gauhuman"][0] <= 0.5, found
    assert found["avatar"][1] > found["gauhuman"][1] + 1, found


def test_check_7_with_two_states_the_hidden_body_is_carved(training):
    """The named variant has GauHuman's failure; .997 with three states."""
    two_state = replace(SMOKE, steps=30, **FAST, unknown="background")
    view = training.views[3]
    strip = (train_view(view.camera, view.body_pose).mask == MaskState.PERSON) & (view.mask == MaskState.UNKNOWN)
    avatar = fitted(two_state, training)
    assert avatar.render(view.camera, view.body_pose)[1][strip].mean() < 0.6
    assert float(avatar.hidden.sum()) == 0


# ------------------------------------------------------------------------------------------- check 8: dropped bands


def drop_errors(fit):
    """Mean L1 at vertices under bands nobody trained with: of the query, the mean visible colour of the view, and the
    nearest vertex that is visible beside the band."""
    avatar, points, errors = fit.avatar, fit.avatar.deformation.vertices.numpy(), []
    for k in range(8):
        known, look = fit._targets[k].known, fit.sightings.views[k]
        person = known.person[..., 0].numpy() > 0
        band = draw_band(BandConfig(), person, look, 0, 10_000 + k)
        pixels = known.image.numpy()[look.xy[:, 1].astype(int), look.xy[:, 0].astype(int)]
        under = np.isin(look.seen, band.vertices)
        with torch.no_grad():
            shown = fit._shown(k, known, band)
        found, there = by_vertex(avatar, shown.colours)
        under &= there[look.seen]
        truth, beside = pixels[under], ~np.isin(look.seen, band.vertices)
        apart = np.linalg.norm(points[look.seen[under]][:, None] - points[look.seen[beside]][None], axis=-1)
        guesses = (found[look.seen[under]], pixels[beside].mean(0), pixels[beside][apart.argmin(1)])
        errors.append([np.abs(guess - truth).mean() for guess in guesses])
    return np.mean(errors, 0)


def test_check_8_dropped_bands_are_learned(trained):
    query, mean, nearest = drop_errors(trained.fit)
    assert query < 0.6 * trained.before[0]
    assert query < mean
    assert query < nearest


def test_a_band_hides_a_share_of_the_person_from_the_encoder(training):
    fit = a_fit(TINY, training)
    known, look = fit._targets[0].known, fit.sightings.views[0]
    person = known.person[..., 0].numpy() > 0
    band = draw_band(BandConfig(), person, look, 0, 0)
    for step in range(20):
        band = draw_band(BandConfig(), person, look, 0, step)
        columns = person.sum(0)
        width = columns.max() / columns.sum()
        share = columns[band.first : band.last].sum() / columns.sum()
        assert 0.2 - width <= share <= 0.5 + width
        under = (look.xy[:, 0] >= band.first) & (look.xy[:, 0] < band.last)
        assert set(band.vertices) == set(look.seen[under])
        again = draw_band(BandConfig(), person, look, 0, step)
        assert (band.first, band.last) == (again.first, again.last)
    image = known.image.clone()
    image[:, band.first : band.last] = 0.123
    other = replace(known, image=image)
    assert torch.equal(fit._read(known, band, look.xy), fit._read(other, band, look.xy))
    assert not torch.equal(fit._read(known, None, look.xy), fit._read(other, None, look.xy))


# ------------------------------------------------------------------------------------------------ what views show


def test_sightings_are_of_front_most_vertices_on_eroded_person_pixels(training):
    config = replace(TINY, features=FeatureConfig(erode=1))
    view = training.views[0]
    look = look_at(view, BODY, config)
    vertices = BODY.pose(view.body_pose)
    place = view.camera.project(vertices)
    person = view.mask == MaskState.PERSON
    depth = rasterized(view.camera, view.body_pose).depth
    for v in look.seen[::17]:
        x, y = place[v, :2].astype(int)
        assert person[y - 1 : y + 2, x - 1 : x + 2].all()
        assert place[v, 2] <= depth[y, x] + 0.02
    column = place[look.hidden, 0].astype(int)
    assert ((column >= STRIP.start) & (column < STRIP.stop)).all()
    assert len(look.hidden) > 300
    assert not set(look.seen) & set(look.hidden)
    assert len(look_at(view, BODY, replace(TINY, unknown="background")).hidden) == 0


def test_key_views_are_counted_alone(training):
    two = look_through(training.views, BODY, replace(TINY, features=replace(TINY.features, key_views=2)))
    assert two.key.tolist() == [0, 9]
    assert two.seen.max() == 2
    assert len(two.views) == 10
    texels = vertices_as_texels(BODY)
    where = BODY.faces[texels.face][np.arange(len(texels.face)), texels.bary.argmax(1)]
    used = np.isin(np.arange(len(BODY.v_template)), BODY.faces)
    assert (where == np.arange(len(where)))[used].all()


def test_the_seen_grow_and_the_hidden_are_not_pruned(trained):
    happened = events(trained.ledger)
    assert happened
    assert sum(event["spared"] for event in happened) > 100
    assert sum(event["pruned"] for event in happened) > 10
    avatar = trained.avatar
    vertex = avatar.gaussians.carried(VERTEX)
    first = set(np.flatnonzero(trained.fit.sightings.seen == 0))
    counts = torch.bincount(vertex, minlength=len(BODY.v_template)).numpy()
    assert np.mean([counts[v] > 0 for v in first]) > 0.7


# --------------------------------------------------------------------------------------- resume, files, bad input


@pytest.fixture(scope="module")
def whole(training):
    return everything(fitted(TINY, training))


def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(training, whole):
    """Saved between two readings of the key views, after a change of the set and before another."""
    saved, killed = 7, 8
    ledger = SavesAt(saved)
    killed_after(a_fit(TINY, training, ledger=ledger), killed)
    assert equal_bits(everything(fitted(TINY, training, ledger=ledger)), whole)
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]


def test_a_saved_avatar_draws_the_same(trained, tmp_path):
    trained.avatar.save(tmp_path)
    again = OccGaussian(trained.avatar.config).load(tmp_path, BODY)
    camera, pose = a_camera(0.7, SIZE), a_pose(0.2, 0.5)
    for one, two in zip(trained.avatar.render(camera, pose), again.render(camera, pose), strict=True):
        assert np.array_equal(one, two)
    with pytest.raises(BadInput, match="expected 'gauhuman'"):
        GauHumanAvatar.load(tmp_path, BODY)


def fit_of(views, **changes):
    return OccGaussian(replace(TINY, steps=4, **changes)).fit(
        set_of(views), device="cpu", seed=0, ledger=Ledger(), progress=QUIET
    )


@pytest.mark.parametrize("unknown", ["ignore", "background"])
def test_odd_frames_do_no_harm(training, unknown):
    view = training.views[0]
    blank = replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN))
    beside = replace(view, body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(view, body_pose=a_pose(transl=(0, 0, 9)))
    avatar = fit_of([view, blank, beside, behind], unknown=unknown)
    assert all(p.isfinite().all() for p in avatar.parameters())
    assert avatar.render(view.camera, view.body_pose)[1].max() > 0.005


def test_one_frame_is_enough_and_a_nan_is_a_divergence(training):
    view = training.views[8]
    assert fit_of([view]).render(view.camera, view.body_pose)[1].max() > 0.005
    image = view.image.astype(np.float32)
    image[view.mask == MaskState.PERSON] = np.nan
    with pytest.raises(Diverged, match="loss is nan") as caught:
        fit_of([replace(view, image=image)])
    assert caught.value.step == 0


def test_where_nobody_can_be_asked_a_gaussian_keeps_its_own_colour(training):
    """No vertex is seen on so thin a person: all ask and nobody answers."""
    config = replace(TINY, steps=3, features=replace(TINY.features, erode=40))
    avatar = fitted(config, training)
    assert float(avatar.seen.sum()) == 0
    shown = avatar.at_rest()
    assert shown.colours.isfinite().all()
    assert float(shown.roughness) == 0


def test_a_body_without_pose_blend_shapes_will_do(training):
    bare = replace(BODY, posedirs=None)
    avatar = OccGaussian(replace(TINY, steps=2)).fit(
        TrainingSet(training.views[:2], bare, WHITE, "bare"), device="cpu", seed=0, ledger=Ledger(), progress=QUIET
    )
    assert all(p.isfinite().all() for p in avatar.parameters())


def test_the_profiles_are_the_registered_ones_and_the_rows_footnote_is_told():
    spec = method_spec("occgaussian")
    assert {name: spec.profile(name) for name in ("smoke", "quick", "paper")} == PROFILES
    assert PAPER.query.neighbours == 10
    assert "inferred" in spec.footnote
    assert "five times the frames" in spec.footnote
