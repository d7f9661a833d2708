"""InpaintHuman's representation: where its Gaussians are, what moves them, what is drawn, and that it can be kept."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion, distance_transform_edt, maximum_filter
from scipy.spatial.transform import Rotation

from ihbench.body import CANONICAL_POSES, canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.errors import BadInput
from ihbench.fit.decoded_cache import DECODED_KEPT
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.avatar.decoder import GaussianDecoder, scale_factor
from ihbench.methods.inpainthuman.config import QUICK
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.render.splat import render_gaussians
from ihbench.render.splats import LOW_PASS
from tests.bench.fake_capture import DISTANCE, WHITE, a_camera, a_pose, rasterized, the_body

from .tiny_fit import SIZE, TINY, an_avatar, equal_bits, parameters_of, random_pose, shaken

BODY = the_body()
BETAS = np.random.default_rng(5).normal(0, 1, 10)


def posed(avatar, body_pose, offset=None):
    """[N, 3] world points of an avatar with this canonical offset [N, 3]."""
    offset = torch.zeros(len(avatar), 3) if offset is None else offset
    return avatar.posed(avatar.every_point, avatar.transforms(body_pose)).moved(offset).detach().numpy()


def on_the_surface(avatar, body_pose):
    vertices = BODY.pose(BodyPose(body_pose.pose, avatar.betas, body_pose.transl), blend_shapes=False)
    return avatar.texels.interpolate(vertices, BODY.faces)


# -------------------------------------------------------------------------------------------- where points are


@pytest.mark.parametrize("name", CANONICAL_POSES)
@pytest.mark.parametrize("betas", [np.zeros(10), BETAS], ids=["mean shape", "other shape"])
def test_points_without_offset_lie_on_the_posed_body(name, betas):
    """Exactly where a face moves rigidly; where a joint bends it, weights and points are interpolated one by one."""
    avatar = an_avatar(canonical_pose=name, betas=betas)
    corners = BODY.weights[BODY.faces[avatar.texels.face]]  # [N, 3, 24]
    rigid = (corners.max(-1) > 1 - 1e-9).all(1) & (np.ptp(corners.argmax(-1), axis=1) == 0)
    assert 0.2 < rigid.mean() < 0.8
    for seed in range(3):
        for spread, limit in ((0.2, 2e-3), (1.0, 8e-3)):
            pose = random_pose(seed, spread, betas)
            distance = np.linalg.norm(posed(avatar, pose) - on_the_surface(avatar, pose), axis=1)
            assert distance.max() < limit
            assert distance[rigid].max() < 2e-6


@pytest.mark.parametrize("name", CANONICAL_POSES)
def test_an_offset_is_meant_in_the_axes_of_the_canonical_pose(name):
    avatar = an_avatar(canonical_pose=name)
    pose = BodyPose(canonical_pose(name), np.zeros(10), np.array([0.1, 0.2, -0.3]))
    offset = torch.from_numpy(np.random.default_rng(0).normal(0, 0.02, (len(avatar), 3)).astype(np.float32))
    moved = posed(avatar, pose, offset) - posed(avatar, pose)
    np.testing.assert_allclose(moved, offset.numpy(), atol=2e-6)


def test_an_offset_turns_with_its_part_of_the_body():
    avatar, offset = an_avatar(), torch.tensor([[0.0, 0.0, 0.03]])
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    pose = canonical_pose("a_pose")
    pose[0] = turn.as_rotvec()
    moved = posed(avatar, BodyPose(pose, np.zeros(10), np.zeros(3)), offset.expand(len(avatar), 3))
    still = posed(avatar, BodyPose(pose, np.zeros(10), np.zeros(3)))
    np.testing.assert_allclose(moved - still, np.broadcast_to(turn.apply([0, 0, 0.03]), moved.shape), atol=2e-6)


def test_an_avatar_has_its_own_shape_whatever_the_pose_says():
    avatar = an_avatar(betas=BETAS)
    pose = random_pose(0)
    np.testing.assert_array_equal(posed(avatar, pose), posed(avatar, BodyPose(pose.pose, BETAS, pose.transl)))


def test_initial_scales_are_the_spacing_of_the_texels():
    """Together the Gaussians' squares cover the body: sum of (scale / 0.7)² is its surface."""
    corners = BODY.v_template[BODY.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    coarse, fine = (an_avatar(texels=texels, scale_limit=1.0).base_scale.numpy() for texels in (64, 128))
    assert ((fine / TINY.scale_initial) ** 2).sum() == pytest.approx(area, rel=0.05)
    assert np.median(fine) == pytest.approx(np.median(coarse) / 2, rel=0.1)
    assert an_avatar(scale_limit=0.004).base_scale.max() == pytest.approx(0.004)
    assert an_avatar(scale_initial=0.35, scale_limit=1.0).base_scale.numpy() == pytest.approx(coarse / 2)


# ---------------------------------------------------------------------------------------------- UV features


def grid_sampled(avatar, level):
    """[N, C] of one level by torch's grid_sample on a padded map: an independent way to the same features."""
    from scipy.ndimage import distance_transform_edt

    from ihbench.body.uv import texel_table

    sizes = avatar.config.levels
    size, start = sizes[level], sum(r * r for r in sizes[:level])
    table = avatar.features.table.detach()[start : start + size**2].reshape(size, size, -1)
    inside = texel_table(BODY, size).mask
    row, column = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    padded = table[torch.from_numpy(row), torch.from_numpy(column)].permute(2, 0, 1)[None]
    grid = torch.from_numpy((2 * avatar.texels.uv - 1) * [1, -1]).float()[None, None]
    sampled = torch.nn.functional.grid_sample(
        padded, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


@pytest.mark.parametrize("levels", [(16, 32, 64), (64,), (24, 40)], ids=str)
def test_features_are_the_sum_of_the_bilinear_samples_of_the_padded_maps(levels):
    avatar = shaken(an_avatar(levels=levels), 1.0)
    expected = sum(grid_sampled(avatar, k) for k in range(len(levels)))
    got = avatar.features(avatar.every_point)
    assert got.shape == (len(avatar), TINY.channels)
    torch.testing.assert_close(got, expected, atol=2e-5, rtol=0)
    some = torch.tensor([7, 0, 7, len(avatar) - 1])
    torch.testing.assert_close(avatar.features(some), expected[some], atol=2e-5, rtol=0)


def test_concatenated_features_are_the_levels_side_by_side():
    avatar = shaken(an_avatar(fusion="concat"), 1.0)
    got = avatar.features(avatar.every_point)
    assert got.shape == (len(avatar), 3 * TINY.channels)
    torch.testing.assert_close(got, torch.cat([grid_sampled(avatar, k) for k in range(3)], 1), atol=2e-5, rtol=0)


def test_features_off_the_charts_are_never_used():
    from ihbench.body.uv import texel_table

    avatar = an_avatar()
    avatar.features(avatar.every_point).sum().backward()
    used = (avatar.features.table.grad != 0).any(1).numpy()
    inside = np.concatenate([texel_table(BODY, r).mask.ravel() for r in TINY.levels])
    assert not used[~inside].any()
    assert used[inside].mean() > 0.95
    torch.testing.assert_close(avatar.features.weight.sum(1), torch.full((len(avatar),), 3.0))


# --------------------------------------------------------------------------------------------------- decoder


@pytest.mark.parametrize("activation", ["exp", "softplus"])
def test_scale_factor_is_one_at_zero_positive_and_monotone(activation):
    raw = torch.linspace(-30, 30, 601, dtype=torch.float64)
    factor = scale_factor(raw, activation)
    assert scale_factor(torch.zeros(1, dtype=torch.float64), activation).item() == pytest.approx(1, abs=1e-12)
    assert (factor > 0).all()
    assert factor.isfinite().all()
    assert (factor.diff() >= 0).all()
    assert (factor[(raw.abs() < 5)].diff() > 0).all()


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_a_decoder_starts_on_the_surface_in_grey(layers):
    decoder = GaussianDecoder(20, 16, layers, torch.Generator().manual_seed(0))
    assert [(m.in_features, m.out_features) for m in decoder.linear][-1][1] == 7
    assert len(decoder.linear) == layers
    offset, scale, color = decoder(torch.randn(50, 8), torch.randn(50, 12))
    assert not offset.any()
    assert not scale.any()
    assert (color == 0.5).all()


@pytest.mark.parametrize("change", [{}, {"scale_activation": "softplus"}, {"offset": "tanh"}, {"decoder_layers": 1}])
def test_an_avatar_starts_on_the_surface_in_grey(change):
    avatar = an_avatar(**change)
    offset, scale, color = avatar.decode(avatar.every_point, None)
    assert not offset.any()
    torch.testing.assert_close(scale, avatar.base_scale)
    assert (color == 0.5).all()


def test_outputs_stay_in_their_bounds_however_wild_the_parameters():
    for form in ("linear", "tanh"):
        avatar = shaken(an_avatar(offset=form), 5.0)
        offset, scale, color = avatar.decode(avatar.every_point, None)
        assert (scale > 0).all()
        assert (scale <= TINY.scale_limit).all()
        assert ((color >= 0) & (color <= 1)).all()
        assert (offset.abs().max() <= TINY.offset_scale) == (form == "tanh")


# --------------------------------------------------------------------------------------------- pose residual


def test_the_residual_starts_as_no_change_and_then_is_one():
    avatar = an_avatar()
    with torch.no_grad():
        for layer in avatar.decoder.linear:
            layer.weight += 0.2 * torch.randn(layer.weight.shape, generator=torch.Generator().manual_seed(0))
    position_map = avatar.position_map(a_pose(0, 0.5))
    without = avatar.decode(avatar.every_point, position_map)
    avatar.residual_on = True
    for a, b in zip(without, avatar.decode(avatar.every_point, position_map), strict=True):
        assert torch.equal(a, b)
    shaken(avatar)
    bent, straight = (avatar.decode(avatar.every_point, avatar.position_map(a_pose(0, arms))) for arms in (0.8, 0.0))
    assert all((a - b).abs().max() > 1e-4 for a, b in zip(bent, straight, strict=True))
    avatar.residual_on = False
    for a, b in zip(
        avatar.decode(avatar.every_point, position_map), avatar.decode(avatar.every_point, None), strict=True
    ):
        assert torch.equal(a, b)


def test_the_residual_knows_nothing_of_where_the_root_is():
    avatar = shaken(an_avatar())
    avatar.residual_on = True
    pose = random_pose(0).pose.copy()
    maps = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        pose[0] = rng.normal(0, 2, 3)
        maps.append(avatar.position_map(BodyPose(pose, np.zeros(10), rng.normal(0, 3, 3))))
    assert torch.equal(*maps)
    assert maps[0].shape == (3, TINY.position_map, TINY.position_map)
    pose[18] += 0.5
    assert not torch.equal(avatar.position_map(BodyPose(pose, np.zeros(10), np.zeros(3))), maps[0])


def test_the_position_map_holds_the_body_where_the_charts_are():
    from ihbench.body.uv import texel_table

    avatar = an_avatar()
    pose = a_pose(1.3, 0.6, (0.4, 0, 0))
    texels = texel_table(BODY, TINY.position_map)
    rootless = BodyPose(np.concatenate([np.zeros((1, 3)), pose.pose[1:]]), np.zeros(10), np.zeros(3))
    expected = texels.interpolate(BODY.pose(rootless, blend_shapes=False), BODY.faces)
    flat = avatar.position_map(pose).flatten(1).T.numpy()
    np.testing.assert_allclose(flat[texels.index], expected, atol=1e-6)
    assert not np.delete(flat, texels.index, 0).any()


def test_the_residual_can_be_left_out():
    avatar = an_avatar(pose_residual=False)
    assert avatar.position_map(a_pose()) is None
    assert not any(name.startswith("encoder") for name, _ in avatar.named_parameters())
    assert avatar.render(a_camera(0.0, SIZE), a_pose())[1].max() > 0.9


# ------------------------------------------------------------------------------------------------- rendering


@pytest.mark.parametrize("azimuth", [0.0, 1.3, 3.0])
def test_a_new_avatar_draws_the_silhouette_of_the_body(azimuth):
    camera, pose = a_camera(azimuth, 128), a_pose(0.3, 0.4)
    avatar = an_avatar(texels=128)
    rgb, alpha = avatar.render(camera, pose, (0.0, 0.0, 1.0))
    assert rgb.shape == (128, 128, 3)
    assert rgb.dtype == alpha.dtype == np.float32
    body = rasterized(camera, pose).mask
    assert alpha[body].min() > 0.5
    sigma = np.sqrt((np.median(avatar.base_scale.numpy()) * camera.K[0, 0] / DISTANCE) ** 2 + LOW_PASS)  # px
    away = distance_transform_edt(~body)
    assert away[alpha > 0.5].max() < 3 * sigma + 1
    assert alpha[away > 5 * sigma + 2].max() < 0.05
    inside = binary_erosion(body, iterations=2)
    np.testing.assert_allclose(rgb[inside], 0.5, atol=0.05)
    np.testing.assert_allclose(rgb[alpha < 1e-6], np.broadcast_to([0, 0, 1], rgb[alpha < 1e-6].shape), atol=1e-5)


def moved(camera, body_pose, turn, shift):
    """Camera and body, both moved by x -> turn x + shift."""
    root = BODY.shaped(body_pose.betas)[1][0]  # the root joint: the body turns about it
    pose = body_pose.pose.copy()
    pose[0] = (turn * Rotation.from_rotvec(pose[0])).as_rotvec()
    transl = turn.apply(root + body_pose.transl) + shift - root
    R = camera.R @ turn.as_matrix().T
    return replace(camera, R=R, t=camera.t - R @ shift), BodyPose(pose, body_pose.betas, transl)


@pytest.mark.parametrize("seed", range(4))
def test_moving_camera_and_body_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=seed), rng.normal(0, 5, 3)
    avatar = shaken(an_avatar(betas=BETAS), 0.1)
    avatar.residual_on = True
    camera, pose = a_camera(0.4, SIZE), BodyPose(a_pose(0.5, 0.6).pose, BETAS, np.array([0.1, 0, 0.1]))
    camera_too, pose_too = moved(camera, pose, turn, shift)
    np.testing.assert_allclose(
        BODY.pose(pose_too, blend_shapes=False), turn.apply(BODY.pose(pose, blend_shapes=False)) + shift, atol=1e-9
    )
    (rgb, alpha), (rgb_too, alpha_too) = avatar.render(camera, pose), avatar.render(camera_too, pose_too)
    assert alpha.max() > 0.99
    assert np.abs(rgb - rgb_too).mean() < 1e-4
    assert np.quantile(np.abs(alpha - alpha_too), 0.99) < 1e-2


@pytest.mark.parametrize(("texels", "size"), [(128, 96), (256, 128)])
@pytest.mark.parametrize("azimuth", [0.0, 1.2, 2.6, 4.0])
def test_culling_hardly_changes_the_picture(texels, size, azimuth):
    avatar = an_avatar(texels=texels)
    with torch.no_grad():  # every point another colour: one that shows through would be seen
        avatar.decoder.linear[-1].weight[4:] += torch.randn(
            (3, TINY.decoder_width), generator=torch.Generator().manual_seed(0)
        )
    camera, pose = a_camera(azimuth, size), a_pose(0.2, 0.7)
    kept = avatar.unhidden(camera, pose)
    assert 0.2 * len(avatar) < len(kept) < 0.9 * len(avatar)
    few = render_gaussians(*(part[torch.from_numpy(kept)] for part in avatar.gaussians(pose)), camera, WHITE)
    avatar.config = replace(avatar.config, cull=False)
    assert len(avatar.unhidden(camera, pose)) == len(avatar)
    for a, b in zip((part.numpy() for part in few), avatar.render(camera, pose), strict=True):
        assert np.abs(a - b).max() <= 0.05
        assert np.abs(a - b).mean() <= 1e-3


def culled(avatar, camera, pose):
    """Per point: kept or not, cosine between its normal and the view, m behind the farthest first surface around."""
    kept = np.zeros(len(avatar), bool)
    kept[avatar.unhidden(camera, pose)] = True
    points = camera.project(on_the_surface(avatar, pose))
    column, row = points[:, :2].astype(int).T
    behind = points[:, 2] - maximum_filter(rasterized(camera, pose).depth, 3)[row, column]
    corners = BODY.pose(pose)[BODY.faces[avatar.texels.face]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return kept, (normals * (camera.center - corners.mean(1))).sum(1) / DISTANCE, behind


def test_culling_goes_by_depth_with_room_for_offsets():
    """Within 3 cm behind the first surface all stays, or 1 cm where turned away; what is far behind goes."""
    avatar = an_avatar(texels=256)
    views = [culled(avatar, a_camera(a, 256), a_pose(0, arms)) for a, arms in ((1.1, 0.3), (1.4, 0.9), (4.5, 0.6))]
    kept, cosine, behind = (np.concatenate(part) for part in zip(*views, strict=True))
    assert kept[behind < 0].all()
    for near in ((cosine > 0) & (behind < 0.03), (cosine < -0.5) & (behind < 0.01)):
        near &= behind > 0.004
        assert near.sum() > 10
        assert kept[near].all()
    for deep in (behind > 0.06, (cosine < -0.5) & (behind > 0.03)):
        assert deep.sum() > 1000
        assert not kept[deep].any()


@pytest.mark.parametrize("distance", [-3.0, 0.0, 0.3])
def test_a_camera_behind_or_inside_the_body_draws_finite_pictures(distance):
    R = np.diag([1.0, -1.0, -1.0])
    camera = Camera(a_camera(0.0, SIZE).K, R, -R @ np.array([0, 0, distance]), SIZE, SIZE)
    rgb, alpha = an_avatar().render(camera, a_pose())
    assert np.isfinite(rgb).all()
    assert np.isfinite(alpha).all()
    if distance < 0:
        assert alpha.max() == 0


def test_gaussians_are_what_is_rendered():
    avatar = shaken(an_avatar(), 0.1)
    camera, pose = a_camera(0.0, SIZE), a_pose(0.4)
    means, scales, colors = avatar.gaussians(pose)
    assert (means.shape, scales.shape, colors.shape) == ((len(avatar), 3), (len(avatar),), (len(avatar), 3))
    rgb, alpha = render_gaussians(means, scales, colors, camera, WHITE)
    assert avatar.config.cull  # of a step of fitting, not of a picture
    np.testing.assert_allclose(avatar.render(camera, pose)[0], rgb.numpy(), atol=1e-6)
    np.testing.assert_allclose(avatar.render(camera, pose)[1], alpha.numpy(), atol=1e-6)
    assert not means.requires_grad


# --------------------------------------------------------------------------------------- seeds, save and load


def test_an_avatar_is_its_seed():
    assert equal_bits(parameters_of(an_avatar(3)), parameters_of(an_avatar(3)))
    a, b = parameters_of(an_avatar(3)), parameters_of(an_avatar(4))
    differs = {name.partition(".")[0] for name in a if not torch.equal(a[name], b[name])}
    assert differs == {"features", "decoder", "encoder"}


@pytest.fixture
def saved(tmp_path):
    avatar = shaken(an_avatar(betas=BETAS, canonical_pose="big_pose", levels=(24, 48), fusion="concat"), 0.2)
    avatar.residual_on = True
    avatar.save(tmp_path / "deep" / "avatar")
    return avatar, tmp_path / "deep" / "avatar"


def test_what_was_saved_renders_the_same(saved):
    avatar, folder = saved
    assert sorted(path.name for path in folder.iterdir()) == ["avatar.json", "avatar.safetensors"]
    for loaded in (GaussianAvatar.load(folder, BODY), InpaintHuman(QUICK).load(folder, BODY)):
        assert loaded.config == avatar.config
        assert equal_bits(parameters_of(loaded), parameters_of(avatar))
        for a, b in zip(
            loaded.render(a_camera(1, SIZE), a_pose()), avatar.render(a_camera(1, SIZE), a_pose()), strict=True
        ):
            assert np.array_equal(a, b)


def test_another_body_is_refused(saved):
    thinner = replace(BODY, v_template=BODY.v_template * 0.99)
    with pytest.raises(BadInput, match="another body") as caught:
        GaussianAvatar.load(saved[1], thinner)
    assert thinner.content_sha() in str(caught.value)
    assert BODY.content_sha() in str(caught.value)


def words(folder, **changes):
    record = json.loads((folder / "avatar.json").read_text()) | changes
    (folder / "avatar.json").write_text(json.dumps({k: v for k, v in record.items() if v is not None}))


def cut(path, share=0.5):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def foreign_tensors(path):
    from safetensors.torch import save_file

    save_file({"other": torch.zeros(3)}, path)


DAMAGE = {
    "no record": lambda folder: (folder / "avatar.json").unlink(),
    "no tensors": lambda folder: (folder / "avatar.safetensors").unlink(),
    "no folder": lambda folder: folder.rename(folder.with_name("elsewhere")),
    "cut record": lambda folder: cut(folder / "avatar.json"),
    "cut tensors": lambda folder: cut(folder / "avatar.safetensors"),
    "empty tensors": lambda folder: cut(folder / "avatar.safetensors", 0),
    "not utf-8": lambda folder: (folder / "avatar.json").write_bytes(b"\xff\xfe\x00"),
    "not a record": lambda folder: (folder / "avatar.json").write_text("[1, 2]"),
    "of another method": lambda folder: words(folder, kind="nerf"),
    "no kind": lambda folder: words(folder, kind=None),
    "no configuration": lambda folder: words(folder, config=None),
    "strange configuration": lambda folder: words(folder, config=[3]),
    "unknown switch": lambda folder: words(folder, config={"texels": 64, "wings": 2}),
    "no shape": lambda folder: words(folder, betas=None),
    "words for a shape": lambda folder: words(folder, betas=["tall"]),
    "another size": lambda folder: words(folder, config={"texels": 64, "levels": [8], "channels": 4}),
    "foreign tensors": lambda folder: foreign_tensors(folder / "avatar.safetensors"),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_and_foreign_files_are_refused_in_one_line(saved, damage):
    folder = saved[1]
    damage(folder)
    with pytest.raises(BadInput) as caught:
        GaussianAvatar.load(folder, BODY)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_a_place_that_cannot_be_written_is_said_and_nothing_is_left_there(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BadInput, match="file"):
        an_avatar().save(tmp_path / "file" / "avatar")
    (tmp_path / "avatar.safetensors").mkdir()
    with pytest.raises(BadInput, match=r"avatar\.safetensors"):
        an_avatar().save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["avatar.safetensors", "file"]


def nudge(avatar):
    avatar.decoder.linear[-1].bias.grad = -torch.ones(7)


def test_what_is_decoded_is_kept_for_other_cameras_and_no_longer_than_the_parameters(monkeypatch):
    avatar = shaken(an_avatar(), 0.1)
    avatar.residual_on = True
    decoded = []
    decode = avatar.decode
    monkeypatch.setattr(avatar, "decode", lambda *given: decoded.append(1) or decode(*given))
    poses = [a_pose(0.2 * k, 0.1 * k) for k in range(DECODED_KEPT)]
    first = [avatar.render(a_camera(yaw), pose)[0] for pose in poses for yaw in (0.0, 1.0)]
    assert len(decoded) == len(poses)
    torch.optim.AdamW([avatar.decoder.linear[-1].bias], lr=0.5, fused=True).step(lambda: nudge(avatar))
    again = avatar.render(a_camera(0.0), poses[0])[0]
    assert len(decoded) == len(poses) + 1
    assert not np.allclose(again, first[0])
    fresh = shaken(an_avatar(), 0.1)
    fresh.residual_on = True
    np.testing.assert_array_equal(fresh.render(a_camera(1.0), poses[3])[0], first[7])
    avatar.render(a_camera(0.0), a_pose(1.0, 0.1 * 1))  # the root alone is another
    assert len(decoded) == len(poses) + 2
    avatar.render(a_camera(0.0), a_pose(2.0, 0.1 * 1))
    assert len(decoded) == len(poses) + 2
