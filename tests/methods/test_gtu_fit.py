"""GTU's fit: masks and vertices over a whole fit, identity, resume in every stage, bad input, the avatar on disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.methods.gtu.avatar import NONE, VERTEX, GtuAvatar
from ihbench.methods.gtu.fitting import pruning_alone
from ihbench.methods.gtu.identity import CROSS_ATTENTION, IdentityTuning
from ihbench.methods.gtu.method import Gtu
from ihbench.methods.gtu.random_views import view_from
from ihbench.methods.gtu.target import left_out
from ihbench.render.zbuffer import vertex_normals
from ihbench.scene.contracts import MaskState
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view
from tests.diffusion.sd2_miniature import make_miniature
from tests.diffusion.tiny_diffusion import same, tiny_backbone, weights

from .tiny_fit import SIZE, STRIP, equal_bits, everything, training_set, training_views
from .tiny_gaussians import Killed, SavesAt, events, killed_after
from .tiny_gtu import TINY, a_fit, cropped, fitted

BODY = the_body()
QUIET = Progress.silent()


@pytest.fixture(scope="module")
def whole():
    """A fit with guesses and a set that changes, not interrupted; its ledger; what the vertices were at each step."""
    ledger = Ledger()
    fit = a_fit(training_set(), ledger=ledger)
    hold, places = fit._hold, {}

    def noted(iteration):
        hold(iteration)
        own = fit.avatar.gaussians.carried(VERTEX) != NONE
        places[iteration] = (
            fit.avatar.gaussians.means[own].detach().clone(),
            fit.avatar.gaussians.opacities[own].min(),
        )

    fit._hold = noted
    fit.run(QUIET)
    return fit.avatar, ledger, places


# ------------------------------------------------------------------------------------------- check 8, over a fit


def test_check_8_every_vertex_is_there_at_the_end(whole):
    avatar, ledger, places = whole
    vertex = avatar.gaussians.carried(VERTEX)
    assert torch.equal(vertex[vertex != NONE].sort().values, torch.arange(len(BODY.v_template)))
    assert len(avatar) > len(BODY.v_template), "nothing grew: no test"
    assert [event["step"] for event in events(ledger)] == [6, 9]
    for iteration, (means, faintest) in places.items():
        put_back = iteration < TINY.reset_until
        if iteration != 6:  # whose step is lost with the change of the set
            assert torch.equal(means, avatar.deformation.vertices) == put_back
        if put_back:
            assert faintest >= TINY.opacity_floor - 1e-6
    assert not avatar.deformation.outside(avatar.gaussians.means[vertex != NONE]).any()


def test_check_8_a_picture_behind_the_occluder_changes_no_bit():
    def painted(view):
        near = left_out(view, BODY, TINY)
        return replace(view, image=np.where(near[..., None], 255 - view.image, view.image))

    views = training_views()
    short = {"steps": 4, "photo_steps": 4}
    one, other = (fitted(training_set(some), **short) for some in (views, [painted(view) for view in views]))
    assert equal_bits(everything(one), everything(other))


def test_vertices_that_would_go_are_put_back_faint():
    fit = a_fit(training_set(), sds=False, density=replace(TINY.density, clone="off", split=False, faint=0.95))
    fit.run(QUIET)
    assert events(fit.ledger)[0]["spared"] > 1000
    assert len(fit.avatar) == len(BODY.v_template)
    assert (fit.avatar.gaussians.opacities < 0.1).sum() > 1000
    later = pruning_alone(TINY)
    assert (later.clone, later.split, later.largest) == ("off", False, TINY.prune_largest)
    assert not later.changes_at(10)


# ----------------------------------------------------------------------------------------------------- guesses


def test_guesses_move_what_no_photo_shows_and_not_what_it_shows():
    """One frame, from the front. The same photos with and without guesses: the back changes, the front hardly."""
    training = training_set([train_view(a_camera(0.0, SIZE), a_pose(), frame=0)])
    free = {"reset_until": 0, "density": replace(TINY.density, after=0, before=0), "steps": 14, "context": "none"}
    seeing, guessing = (everything(fitted(training, **free, sds=on)) for on in (False, True))
    colour = "gaussians.attributes.sh_dc"
    moved = (guessing[colour] - seeing[colour]).norm(dim=(1, 2))
    torso = np.abs(BODY.v_template[:, 1] - 0.2) < 0.2
    depth = vertex_normals(BODY.v_template, BODY.faces)[:, 2]
    front, back = (moved[torch.from_numpy(torso & side)].median() for side in (depth > 0.7, depth < -0.7))
    assert back > 1.5 * front, (back, front)


def test_a_guess_leaves_the_poses_alone():
    fit = a_fit(training_set())
    fit.guesser(1, 0).loss.backward()
    assert all(p.grad is None for p in fit.avatar.poses)
    assert fit.avatar.gaussians.attributes["sh_dc"].grad.any()


def test_poses_are_refined_in_training_alone(whole):
    avatar, ledger, _ = whole
    (moved,) = events(ledger, "poses_refined")
    assert moved["frames"] == 6
    assert 0 < moved["median_deg"] <= moved["largest_deg"] < 2
    view = training_views()[0]
    plain = avatar.render(view.camera, view.body_pose)[0]
    assert np.array_equal(avatar.render(view.camera, view.body_pose, frame=view.frame)[0], plain)
    with torch.no_grad():
        kept = avatar.poses[0].clone()
        avatar.poses[0] += 1
        assert np.array_equal(avatar.render(view.camera, view.body_pose)[0], plain)
        avatar.poses[0].copy_(kept)


def test_what_training_saw_is_shown_to_the_model():
    """The guide has its colours; what is near the body and unseen is hidden; of the rest the picture is shown."""
    guesser = a_fit(training_set(), context="seen").guesser
    view = view_from("entire", 40, 0, BODY, np.zeros((24, 3)), np.zeros(10), 32)
    picture = torch.full((1, 3, 32, 32), 0.3)
    guide, condition = guesser._shown(view, picture, BODY, 32)
    parts, seen, hidden = guide[0, :3].amax(0) > 0, guide[0, 6] > 0, condition[0, 0] > 0
    assert (seen & ~parts).sum() == 0
    assert 0.05 < seen.sum() / parts.sum() < 0.9
    assert hidden.any()
    assert not hidden[0, 0]
    blind = a_fit(training_set(), context="none").guesser
    guide, condition = blind._shown(view, picture, BODY, 32)
    assert condition is None
    assert not guide[0, 3:].any()


def test_with_stable_diffusion_2s_layers(tmp_path):
    """All of it with the user's kind of weights, in miniature: identity, views of half the size, then whole."""
    folder = make_miniature(tmp_path)
    config = replace(
        TINY, backbone="sd2", weights=str(folder), steps=4, photo_steps=2, sds_every=1, coarse_steps=2, reset_until=0,
        identity=replace(TINY.identity, steps=1),
    )  # fmt: skip
    ledger = Ledger()
    avatar = Gtu(config).fit(training_set(), device="cpu", seed=0, ledger=ledger, progress=QUIET)
    assert all(p.isfinite().all() for p in avatar.parameters())
    (curve,) = events(ledger, "loss_curve")
    assert np.isfinite(curve["losses"]).all()
    photos_alone = Gtu(replace(config, sds=False)).fit(
        training_set(), device="cpu", seed=0, ledger=Ledger(), progress=QUIET
    )
    assert not equal_bits(everything(avatar), everything(photos_alone))


# ---------------------------------------------------------------------------------------------------- the signature


def test_the_strip_is_filled_unless_it_counts_as_background():
    """Hidden in every frame but one: with occluder masks alpha stays, without them it falls."""
    frames = range(6)
    hidden = [train_view(a_camera(0.0, SIZE), a_pose(0.3 * k), STRIP if k else None, frame=k) for k in frames]
    side = a_camera(0.0, SIZE), a_pose(0.75)
    columns = (np.arange(SIZE) >= STRIP.start) & (np.arange(SIZE) < STRIP.stop)
    person = (train_view(*side).mask == MaskState.PERSON) & columns
    alpha = {}
    for unknown in ("ignore", "background"):
        avatar = fitted(training_set(hidden), unknown=unknown, sds=False, steps=30, reset_until=4, lr_opacity=0.6)
        alpha[unknown] = avatar.render(*side)[1][person].mean()
    assert alpha["ignore"] > 0.9, alpha
    assert alpha["background"] < alpha["ignore"] - 0.2, alpha


# ---------------------------------------------------------------------------------------------------------- identity


def tuned(ledger=None, views=None, **changes):
    backbone = tiny_backbone()
    crops = cropped(training_set(views))
    config = replace(TINY, **changes)
    tuning = IdentityTuning(backbone, crops, config, 0, ledger or Ledger())
    tuning.run(QUIET)
    return backbone, tuning


def test_identity_moves_the_word_and_the_cross_attention_alone():
    before = tiny_backbone()
    backbone, tuning = tuned()
    assert same(weights(backbone.controlnet), weights(before.controlnet))
    old, new = weights(before.unet), weights(backbone.unet)
    moved = {name for name in old if not torch.equal(old[name], new[name])}
    assert moved == {name for name in old if any(part in name for part in CROSS_ATTENTION)}
    assert len(moved) >= 4
    words = before.text_encoder.get_input_embeddings().weight
    assert torch.equal(backbone.text_encoder.get_input_embeddings().weight[: len(words)], words)
    start = words[before.tokenizer("person", add_special_tokens=False).input_ids[0]]
    assert not torch.allclose(tuning.token.vectors.detach(), start.expand(4, -1))
    assert len(tuning.curves["gtu-identity"].losses) == TINY.identity.steps


def test_identity_learns_nothing_of_hidden_pixels():
    def repainted(view):
        return replace(view, image=np.where((view.mask == MaskState.UNKNOWN)[..., None], 0, view.image))

    views, weight = training_views(), {}
    hidden = torch.from_numpy(cropped(training_set(views))[1].unknown)
    for unknown in ("ignore", "background"):
        config = replace(TINY, unknown=unknown)
        tuning = IdentityTuning(tiny_backbone(), cropped(training_set(views)), config, 0, Ledger())
        weight[unknown] = tuning._picture(tuning.views[1], 1.0, np.random.default_rng(0))[2][0, 0]
    assert hidden.sum() > 50
    assert not weight["ignore"][hidden].any()
    assert weight["background"][hidden].min() >= TINY.identity.background
    assert torch.equal(weight["ignore"][~hidden], weight["background"][~hidden])
    one, other = (tuned(views=some)[1].token.vectors for some in (views, [repainted(view) for view in views]))
    assert torch.equal(one, other)


# ------------------------------------------------------------------------------------------------------------ resume


def test_identity_killed_and_resumed_ends_the_same(tmp_path, monkeypatch):
    expected, _ = tuned()
    ledger = Ledger(tmp_path, save_every=0.0)
    monkeypatch.setattr(ledger, "due_to_save", lambda: True)
    honest, count = IdentityTuning.loss, []

    def loss(self, *args):
        count.append(0)
        if len(count) > 3:
            raise Killed
        return honest(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(IdentityTuning, "loss", loss)
        with pytest.raises(Killed):
            tuned(ledger)
    ledger = Ledger(tmp_path)
    resumed, _ = tuned(ledger)
    assert same(weights(resumed.unet), weights(expected.unet))
    assert [event["step"] for event in events(ledger, "resumed")] == [3]


@pytest.mark.parametrize(("saved", "killed"), [(3, 5), (8, 11)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(whole, saved, killed):
    """Saved among photos, and among guesses after a change of the set."""
    ledger = SavesAt(saved)
    killed_after(a_fit(training_set(), ledger=ledger), killed)
    resumed = fitted(training_set(), ledger=ledger)
    assert equal_bits(everything(whole[0]), everything(resumed))
    assert resumed.degree == whole[0].degree
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]


def test_another_seed_gives_other_bits(whole):
    short = {"steps": 3, "photo_steps": 3}
    one, other = (fitted(training_set(), seed, **short) for seed in (0, 1))
    assert not equal_bits(everything(one), everything(other))


# ------------------------------------------------------------------------------------------------ disk and bad input


def test_what_was_saved_renders_the_same(whole, tmp_path):
    avatar, _, _ = whole
    avatar.save(tmp_path)
    again = GtuAvatar.load(tmp_path, BODY)
    view = training_views()[2]
    for one, other in zip(avatar.render(view.camera, view.body_pose), again.render(view.camera, view.body_pose),
                          strict=True):  # fmt: skip
        assert np.array_equal(one, other)
    assert len(again.poses) == 6
    (tmp_path / "avatar.json").write_text((tmp_path / "avatar.json").read_text().replace('"gtu"', '"other"'))
    with pytest.raises(BadInput, match="kind 'other'"):
        GtuAvatar.load(tmp_path, BODY)


def photos(views, **changes):
    config = replace(TINY, sds=False, steps=4, **changes)
    return Gtu(config).fit(training_set(views), device="cpu", seed=0, ledger=Ledger(), progress=QUIET)


def test_frames_without_a_person_and_shapes_that_vary_do_no_harm():
    views = training_views()
    blank = replace(views[1], mask=np.full_like(views[1].mask, MaskState.UNKNOWN))
    beside = replace(views[2], body_pose=a_pose(transl=(9, 0, 0)))
    behind = replace(views[4], body_pose=a_pose(transl=(0, 0, 9)))
    tall = replace(views[3], body_pose=replace(views[3].body_pose, betas=np.array([1.0, 0.0])))
    short = replace(views[0], body_pose=replace(views[0].body_pose, betas=np.array([-1.0, 0.0])))
    for some in ([short, tall], [views[0], blank, beside, behind], views[:1]):
        if some[0] is not short:
            some = [replace(v, body_pose=replace(v.body_pose, betas=np.zeros(2))) for v in some]
        avatar = photos(some)
        assert all(p.isfinite().all() for p in avatar.parameters())
        assert avatar.render(views[0].camera, views[0].body_pose)[1].max() > 0.5


def test_a_nan_is_a_divergence_unless_it_is_hidden():
    view = training_views()[1]
    for state, bad in ((MaskState.PERSON, True), (MaskState.UNKNOWN, False)):
        image = view.image.astype(np.float32)
        image[view.mask == state] = np.nan
        if bad:
            with pytest.raises(Diverged, match="loss is nan"):
                photos([replace(view, image=image)])
        else:
            one, other = photos([replace(view, image=image)]), photos([view])
            assert equal_bits(everything(one), everything(other))
