"""Wild2Avatar's parts: the acceptance checks of density, layers, coordinates and start; samples, rays, inverse
skinning, each term of the loss."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial import KDTree

from ihbench.errors import BadInput
from ihbench.methods.wild2avatar.config import PAPER, QUICK, SMOKE
from ihbench.methods.wild2avatar.layers import Layer, background_layer, occlusion_layer, together
from ihbench.methods.wild2avatar.losses import LEAST, Rays, binary_entropy, eikonal, ray_losses
from ihbench.methods.wild2avatar.person.activation import sharp_softplus
from ihbench.methods.wild2avatar.person.body_fit import fit_to_body
from ihbench.methods.wild2avatar.person.canonical_body import BodySurface, CanonicalBody
from ihbench.methods.wild2avatar.person.human_field import HumanField
from ihbench.methods.wild2avatar.person.human_rays import HumanMarch, HumanRays, march_human
from ihbench.methods.wild2avatar.person.inverse_skinning import PosedBody
from ihbench.methods.wild2avatar.person.near_body import REACH, near_body, near_body_plain, unit_rays
from ihbench.methods.wild2avatar.person.ray_samples import (
    ERROR,
    SampleCounts,
    by_density,
    error_bound,
    least_distance,
    least_spread,
    ray_samples,
)
from ihbench.methods.wild2avatar.person.sdf_network import RADIUS, SdfNetwork
from ihbench.methods.wild2avatar.scene_network import SceneNetwork
from ihbench.methods.wild2avatar.target import beside_visible, prepare_target
from ihbench.methods.wild2avatar.three_parts import inner_radius, three_parts
from ihbench.render.volumes.density_laws import laplace_density, opacity
from ihbench.scene.contracts import MaskState
from tests.bench.fake_capture import a_camera, a_pose, rasterized, the_body, train_view

BODY = the_body()
SIZE = 48
COUNTS = SampleCounts(even=24, rounds=0, by_weight=10, extra=4)


@cache
def canonical():
    return CanonicalBody(BODY, np.zeros(10))


@cache
def like_the_body():
    """A field fitted to the body, and nothing else, with a surface that is not soft."""
    field = HumanField(replace(SMOKE, sdf_width=64, beta=0.005), torch.Generator().manual_seed(0))
    fit_to_body(field.sdf, canonical(), 0, 320)
    return field


def scene_network(seed=0, frames=3):
    return SceneNetwork(torch.Generator().manual_seed(seed), 24, 2, 0, 4, frames)


def some_rays(count=50, distance=2.7, seed=0):
    """From one camera towards places around the centre."""
    rng = np.random.default_rng(seed)
    origin = np.array([0.3, -0.2, -1.0])
    origin *= distance / np.linalg.norm(origin)
    directions = rng.uniform(-1.2, 1.2, (count, 3)) - origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return torch.from_numpy(np.tile(origin, (count, 1))), torch.from_numpy(directions)


# ------------------------------------------------------------------------------------------- check 1: the density


def test_sizes_of_the_distance_network_work_or_are_refused():
    """With a layer that sees the place again, without, and with one that would come after the last."""
    points = torch.zeros(2, 3)
    for depth, skip in ((8, 4), (4, 4), (3, 4), (5, 4), (1, 1), (2, 1), (3, 0)):
        config = replace(PAPER, sdf_width=64, sdf_depth=depth, sdf_skip=skip, pose_conditioning=False)
        network = HumanField(config, torch.Generator().manual_seed(0)).sdf
        assert network(points, None)[0].isfinite().all()
    with pytest.raises(BadInput, match=r"sdf-width: expected more than the 39 values.*sdf-skip 4, got 32"):
        replace(PAPER, sdf_width=32)
    assert replace(PAPER, sdf_width=32, sdf_skip=0).sdf_width == 32


def test_check_1_density_at_and_around_the_surface():
    b = 0.1001
    at = laplace_density(torch.tensor([0.0, b, -b, 0.3, -50.0], dtype=torch.float64), b)
    assert at.tolist() == pytest.approx([4.995, 1.838, 8.152, 0.2494, 9.990], rel=1e-3)
    field = HumanField(PAPER, torch.Generator())
    assert field.spread.item() == pytest.approx(b)


@pytest.mark.parametrize("depth", [0.05, 0.2, 0.7])
def test_check_1_opacity_of_a_ray_into_a_half_space(depth):
    """From where there is no density to a depth L behind the plane."""
    b = 0.1001
    t = torch.linspace(-3, depth, 20_001, dtype=torch.float64)
    through = opacity(laplace_density(-(t[1:] + t[:-1]) / 2, b), t.diff())
    alpha = 1 - (1 - through).prod()
    assert alpha.item() == pytest.approx(1 - np.exp(-(depth / b + 0.5 * np.exp(-depth / b))), rel=0.01)


# --------------------------------------------------------------------------------------- check 2: layers' weights


def test_check_2_the_three_parts_share_what_a_ray_shows():
    parts = three_parts(*(x.float() for x in some_rays()), inner=0.9)
    scene = scene_network()
    rng = torch.Generator().manual_seed(1)
    alpha = torch.rand(50, generator=rng)
    occlusion, background = (layer(scene, parts, 0, 16) for layer in (occlusion_layer, background_layer))
    assert 0.01 < occlusion.alpha.min() <= occlusion.alpha.max() < 0.99, "degenerate: no test"
    white = [Layer(layer.alpha[:, None].expand(-1, 3), layer.alpha) for layer in (occlusion, background)]
    human = HumanRays(alpha[:, None].expand(-1, 3), alpha, alpha > 1)
    assert torch.allclose(together(white[0], human, white[1].rgb), torch.ones(50, 3), atol=1e-5)


def test_check_2_an_empty_occlusion_layer_is_exactly_nothing():
    """No interval of it is endless."""
    parts = three_parts(*(x.float() for x in some_rays()), inner=0.9)
    scene = scene_network()
    with torch.no_grad():
        scene.last.weight[0] = 0
        scene.last.bias[0] = 0
    layer = occlusion_layer(scene, parts, 0, 16)
    assert (layer.alpha == 0).all()
    assert (layer.rgb == 0).all()
    with torch.no_grad():
        scene.last.bias[0] = 1e-6
    assert (background_layer(scene, parts, 0, 16).alpha > 0.99).all()
    assert (occlusion_layer(scene, parts, 0, 16).alpha < 1e-4).all()


# ------------------------------------------------------------------------------------------ check 3: coordinates


def test_check_3_a_ray_through_the_centre():
    parts = three_parts(torch.tensor([[0.0, 0.0, -2.7]]).double(), torch.tensor([[0.0, 0.0, 1.0]]).double(), 0.9)
    assert (parts.enter.item(), parts.leave.item()) == pytest.approx((1.8, 5.7))
    shares = torch.linspace(0, 1, 9).double()
    before, lengths = parts.occlusion(shares)
    assert before[0, [0, -1], 3].tolist() == pytest.approx([-0.37037, -1.11111], abs=1e-4)
    assert (before[0, :, 3].diff() < 0).all()
    assert lengths[0].sum().item() == pytest.approx(9 / 8 * (1.11111 - 0.37037), abs=1e-4)
    behind, _ = parts.background(shares)
    assert behind[0, [0, -1], 3].tolist() == pytest.approx([1 / 3, 0.0])
    assert before[0, :, :3].tolist() == [[0, 0, -1]] * 9
    assert behind[0, :, :3].tolist() == [[0, 0, 1]] * 9


def test_check_3_directions_are_unit_places_are_on_the_ray_and_the_ranges_never_meet():
    origins, directions = some_rays(200)
    parts = three_parts(origins, directions, 0.9)
    shares = torch.linspace(0, 1, 11).double()
    for points, _ in (parts.occlusion(shares), parts.background(shares[:-1])):
        assert torch.allclose(points[..., :3].norm(dim=-1), torch.ones(()).double(), atol=1e-6)
        places = points[..., :3] / points[..., 3:].abs()  # p = (p / ρ) ρ
        away = torch.linalg.cross(places - origins[:, None], directions[:, None].expand_as(places)).norm(dim=-1)
        assert away.max() < 1e-5
    before, behind = parts.occlusion(shares)[0][..., 3], parts.background(shares)[0][..., 3]
    assert before.max() < 0 <= behind.min()
    missing = torch.linalg.cross(origins, directions).norm(dim=1) > 0.9
    assert 20 < missing.sum() < 180
    closest = -(origins * directions).sum(1)
    assert torch.equal(parts.enter[missing], closest[missing].clamp(min=0))
    entry = (origins + parts.enter[:, None] * directions).norm(dim=1)
    assert torch.allclose(entry[~missing], torch.tensor(0.9).double())


def test_a_camera_beyond_the_outer_sphere_or_turned_away():
    """Nothing is negative or NaN, and parts are in order."""
    origins = torch.tensor([[0.0, 0, -5], [0.0, 0, -5], [0.0, 0, -2]])
    directions = torch.tensor([[0.0, 0, 1], [0.0, 1, 0], [0.0, 0, -1]])
    parts = three_parts(origins, directions, 0.9)
    assert (parts.enter >= 0).all()
    assert (parts.leave >= parts.enter).all()
    for points, lengths in (parts.occlusion(torch.linspace(0, 1, 5)), parts.background(torch.linspace(0, 1, 5))):
        assert points.isfinite().all()
        assert (lengths >= 0).all()
    assert inner_radius(1.0, 3.0) == pytest.approx(1.1)
    assert inner_radius(1.0, 0.8) < 0.8


# ------------------------------------------------------------------------------------------------ check 4: start


def test_softplus_and_its_derivatives_are_torchs():
    x = torch.linspace(-0.2, 0.2, 41, dtype=torch.float64, requires_grad=True)

    def up_to_the_second(function):
        y = function(x)
        (first,) = torch.autograd.grad(y.square().sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), x)
        return y, first, second

    own, theirs = (up_to_the_second(f) for f in (sharp_softplus, lambda x: F.softplus(x, beta=100)))
    for a, b in zip(own, theirs, strict=True):
        assert torch.allclose(a, b, atol=1e-5)  # torch is linear from β x = 20 on


def test_the_network_starts_as_a_sphere():
    network = SdfNetwork(torch.Generator().manual_seed(0), 256, 8, 4, 6, True)
    rng = np.random.default_rng(0)
    points = rng.standard_normal((500, 3))
    points *= rng.uniform(0.3, 1.2, (500, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    distance, features = network(torch.from_numpy(points).float())
    assert features.shape == (500, 256)
    expected = np.linalg.norm(points, axis=1) - RADIUS
    assert np.corrcoef(distance.detach().numpy(), expected)[0, 1] > 0.9
    assert np.abs(distance.detach().numpy() - expected)[np.abs(expected) < 0.05].mean() < 0.1


def test_check_4_the_start_is_the_body():
    network, vertices = like_the_body().sdf, canonical().vertices
    with torch.no_grad():
        distance, _, gradient = network.with_gradient(vertices)
    assert (distance.abs() < 0.01).float().mean() > 0.99
    assert gradient.norm(dim=1).mean().item() == pytest.approx(1, abs=0.05)


def test_check_4_a_pose_that_is_not_looked_at_changes_nothing():
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    pose = torch.randn(69, generator=torch.Generator().manual_seed(1))
    network = SdfNetwork(torch.Generator().manual_seed(0), 32, 3, 0, 4, True)
    with torch.no_grad():
        network.layers[0].parametrizations.weight.original1 += 0.01
    assert torch.equal(network(points, None)[0], network(points, torch.zeros(69))[0])
    assert not torch.equal(network(points, None)[0], network(points, pose)[0])


def test_signed_distances_of_the_body():
    """Moved along its normal a surface point is as far away as it was moved; deep inside is negative."""
    surface = BodySurface(canonical(), np.random.default_rng(0))
    chosen = np.random.default_rng(1).integers(len(surface.points), size=2000)
    for step in (-0.01, -0.004, 0.004, 0.01):
        found = surface.distance(surface.points[chosen] + step * surface.normals[chosen])
        assert (np.sign(found) == np.sign(step)).mean() > 0.97
        assert np.median(np.abs(found - step)) < 0.001
    joints = canonical().rest_joints.numpy()
    assert (surface.distance(joints[[0, 3, 6, 12]].astype(np.float64)) < -0.02).all()


# ------------------------------------------------------------------------------------------------------ skinning


def test_posed_vertices_go_back_to_where_they_came_from():
    pose = replace(a_pose(0.7, 0.4), transl=np.array([0.3, -0.1, 2.0]))
    body = canonical()
    posed = PosedBody(body, body.bones_of(pose))
    assert np.allclose(posed.vertices.numpy(), BODY.pose(pose, blend_shapes=False), atol=0.01)
    back = posed.to_canonical(posed.vertices)
    assert torch.allclose(back.points, body.vertices, atol=1e-4)
    assert (back.away < 1e-5).all()


def test_a_gradient_of_the_canonical_pose_is_turned_as_the_surface_is():
    """(∇f)ᵀ M⁻¹ is the gradient of x -> f(x_c(x)) in the world, while the nearest vertex is the same."""
    body, field = canonical(), like_the_body()
    posed = PosedBody(body, body.bones_of(a_pose(0.7, 0.4)))
    points = (posed.vertices[::200] + 0.02).requires_grad_()
    own = posed.to_canonical(points)
    (world,) = torch.autograd.grad(field.sdf(own.points)[0].sum(), points)
    with torch.no_grad():
        gradient = field.sdf.with_gradient(own.points.detach())[2]
    assert torch.allclose((gradient[:, None] @ own.back)[:, 0], world, atol=1e-4)


# ------------------------------------------------------------------------------------------------ rays and samples


def test_near_and_far_are_where_a_ray_enters_and_leaves_the_neighbourhood():
    camera, vertices = a_camera(0.4, SIZE), BODY.pose(a_pose(0.2, 0.3))
    near, far = near_body(camera, vertices)
    some = torch.arange(0, SIZE * SIZE, 7)
    near, far, rays = near[some], far[some], unit_rays(camera, some)
    t = torch.linspace(2.2, 3.8, 401)
    away = KDTree(vertices).query(rays.points(t.expand(len(some), -1)).numpy(), distance_upper_bound=REACH)[0]
    inside = away < REACH
    met = inside.any(1)
    assert met.sum() > 40
    # a ray that grazes may pass between two of these places
    assert (near < far).numpy()[met].all()
    assert ((near < far).numpy() & ~met).sum() < 5
    first, last = t[inside.argmax(1)].numpy(), t[400 - inside[:, ::-1].argmax(1)].numpy()
    assert np.abs(first - near.numpy())[met].max() < 0.0045
    assert np.abs(last - far.numpy())[met].max() < 0.0045


def test_near_and_far_in_plain_torch():
    camera, vertices = a_camera(0.4, SIZE), BODY.pose(a_pose(0.2, 0.3))[::3]
    seen = torch.from_numpy(camera.to_camera(vertices))
    for fast, plain in zip(near_body(camera, vertices), near_body_plain(camera, seen, REACH), strict=True):
        assert torch.equal(fast.isfinite(), plain.isfinite())
        assert torch.allclose(fast, plain, atol=1e-5)


def test_a_body_behind_the_camera_is_near_no_ray():
    near, far = near_body(a_camera(0.0, SIZE), BODY.pose(a_pose()) + np.array([0, 0, 10.0]))
    assert not (near < far).any()


def two_planes(t):
    """Signed distance along rays through a slab from 1.2 to 1.5 m."""
    return (t - 1.35).abs() - 0.15


def test_error_bounded_samples_keep_the_opacity_within_the_bound():
    """The paper's claim, on a slab that even samples resolve badly."""
    near, far, spread = torch.zeros(4), torch.full((4,), 4.0), 0.005
    counts = SampleCounts(even=64, rounds=5, by_weight=64, extra=16)
    t = ray_samples(two_planes, near, far, spread, counts)
    assert t.shape == (4, counts.total)
    assert (t.diff(dim=1) >= 0).all()
    assert torch.equal(t[:, [0, -1]], torch.tensor([[0.0, 4.0]]).expand(4, 2))
    even = torch.linspace(0, 4, 64).expand(1, -1)
    assert error_bound(even, two_planes(even), torch.tensor([spread])).item() > ERROR
    wide = least_spread(even, two_planes(even), spread)
    assert wide.item() > spread
    assert error_bound(even, two_planes(even), wide).item() <= ERROR * 1.01
    dense = torch.linspace(0, 4, 40_001).expand(1, -1)

    def opacity_up_to(t, to):
        """[] by the left rule, as rays are composited."""
        free = laplace_density(two_planes(t), spread)[:, :-1] * t.diff(dim=1)
        return 1 - (-free[t[:, 1:] <= to].sum()).exp()

    for to in (1.19, 1.2, 1.21, 1.3):
        assert abs(opacity_up_to(t[:1], to) - opacity_up_to(dense, to)) < ERROR, to
    at_the_surface = ((t > 1.15) & (t < 1.26)).sum(1)
    assert (at_the_surface > 30).all()


def test_the_least_distance_within_an_interval():
    """Surfaces as near as the distances at both ends allow: by the triangle, the nearer end, or 0 between signs."""
    t = torch.tensor([[0.0, 1.0]])
    for ends, expected in (((1.0, 1.0), np.sqrt(0.75)), ((0.2, 2.0), 0.2), ((0.3, 0.3), 0.0), ((1.0, -1.0), 0.0)):
        assert least_distance(t, torch.tensor([ends])).item() == pytest.approx(expected, abs=1e-6)


def test_samples_by_density_follow_it():
    t = torch.linspace(0, 1, 11)[None]
    mass = torch.zeros(1, 10)
    mass[0, 3], mass[0, 7] = 0.3, 0.1
    drawn = by_density(t, mass, 4000, torch.Generator().manual_seed(0))
    assert ((drawn > 0.3) & (drawn < 0.4)).float().mean().item() == pytest.approx(0.75, abs=0.01)
    nothing = by_density(t, torch.zeros(1, 10), 10, None)
    assert torch.allclose(nothing, (torch.arange(10) + 0.5)[None] / 10, atol=1e-5)


def test_the_person_on_rays_is_what_every_sample_in_float64_gives():
    """No sample skipped, no share of the largest weight, in loops: the same picture."""
    field, body = like_the_body(), canonical()
    camera, pose = a_camera(0.3, SIZE), a_pose(0.2, 0.3)
    posed = PosedBody(body, body.bones_of(pose))
    near, far = near_body(camera, posed.vertices.double().numpy())
    pixels = (near < far).nonzero()[:, 0][::9]
    rays, near, far = unit_rays(camera, pixels), near[pixels], far[pixels]
    with torch.no_grad():
        fast = march_human(field, posed, rays, near, far, None, HumanMarch(COUNTS, least=1e-3))

        def distance_at(t):
            own = posed.to_canonical(rays.points(t).flatten(0, 1))
            return torch.where(own.away > REACH, 4.0, field.sdf(own.points)[0]).view_as(t)

        t = ray_samples(distance_at, near, far, field.spread.item(), COUNTS)
        own = posed.to_canonical(rays.points(t).flatten(0, 1))
        double = HumanField(replace(SMOKE, sdf_width=64), torch.Generator()).double()
        double.load_state_dict({name: value.double() for name, value in field.state_dict().items()})
        distance, features, gradient = double.sdf.with_gradient(own.points.double())
        normals = F.normalize((gradient[:, None] @ own.back.double())[:, 0], dim=1)
        colours = double.colour(own.points.double(), normals, features, None).view(*t.shape, 3)
        distance = torch.where(own.away > REACH, 4.0, distance).view_as(t)
    rgb, alpha = torch.zeros(len(t), 3).double(), torch.zeros(len(t)).double()
    b = double.spread.item()
    for n in range(len(t)):
        through = 1.0
        for s in range(t.shape[1] - 1):
            d = distance[n, s].item()
            sigma = (0.5 * np.exp(-d / b) if d > 0 else 1 - 0.5 * np.exp(d / b)) / b
            weight = through * (1 - np.exp(-sigma * (t[n, s + 1] - t[n, s]).item()))
            rgb[n] += weight * colours[n, s]
            alpha[n] += weight
            through -= weight
    assert alpha.max() > 0.99
    assert (fast.alpha - alpha).abs().max() < 1e-4
    assert (fast.rgb - rgb).abs().max() < 1 / 255


def test_the_start_is_drawn_as_the_body():
    """Its silhouette is the posed body's."""
    field, body = like_the_body(), canonical()
    camera, pose = a_camera(0.3, 96), a_pose(0.2, 0.3)
    posed = PosedBody(body, body.bones_of(pose))
    near, far = near_body(camera, posed.vertices.double().numpy())
    every = torch.arange(96 * 96)
    with torch.no_grad():
        drawn = march_human(field, posed, unit_rays(camera, every), near, far, None, HumanMarch(COUNTS))
    own, truth = (drawn.alpha > 0.5).numpy().reshape(96, 96), rasterized(camera, pose).mask
    assert (own & truth).sum() / (own | truth).sum() > 0.85
    assert not drawn.beside.any()


def test_rays_beside_the_surface():
    field, body = like_the_body(), canonical()
    camera, pose = a_camera(0.3, SIZE), a_pose(0.2, 0.3)
    posed = PosedBody(body, body.bones_of(pose))
    near, far = near_body(camera, posed.vertices.double().numpy())
    pixels = (near < far).nonzero()[:, 0]
    with torch.no_grad():
        how = HumanMarch(COUNTS, outline=field.sdf)
        drawn = march_human(field, posed, unit_rays(camera, pixels), near[pixels], far[pixels], None, how)
    on_body = torch.from_numpy(rasterized(camera, pose).mask.reshape(-1))[pixels]
    assert not (drawn.beside & on_body).any()
    assert drawn.beside[~on_body].float().mean() > 0.2
    assert drawn.alpha[drawn.beside].max() < 0.2


# ------------------------------------------------------------------------------------------------- the loss's terms


def a_target(strip: slice | None = slice(20, 28)):
    view = train_view(a_camera(0.0, SIZE), a_pose(), strip, frame=7)
    return prepare_target(view, 0, BODY, False, torch.device("cpu"))


def some_shown(target, human=0.7, layer=0.2, seed=0):
    pixels = torch.arange(SIZE * SIZE)
    colours = torch.rand(len(pixels), 3, generator=torch.Generator().manual_seed(seed))
    alphas = (torch.full((len(pixels),), alpha) for alpha in (human, layer))
    return Rays(pixels, colours, *alphas, torch.zeros_like(target.body))


def test_classes_of_pixels():
    view = train_view(a_camera(0.0, SIZE), a_pose(), slice(20, 28), frame=7)
    target = a_target()
    states = [target.person, target.unknown, target.background]
    assert (torch.stack(states).sum(0) == 1).all()
    assert np.array_equal(target.unknown.view(SIZE, SIZE).numpy(), view.mask == MaskState.UNKNOWN)
    assert torch.equal(target.coloured, ~target.unknown)
    assert torch.equal(target.body, torch.from_numpy(rasterized(view.camera, view.body_pose).mask.reshape(-1)))
    filmed = replace(view, filmed=np.full_like(view.image, 7))
    real = prepare_target(filmed, 0, BODY, True, torch.device("cpu"))
    assert real.coloured.all()
    assert (real.colours == 7 / 255).all()
    assert torch.equal(prepare_target(filmed, 0, BODY, False, torch.device("cpu")).colours, target.colours)


def test_beside_what_is_seen_of_the_body_nobody_is():
    """The mask of a real occluder: a body of which the upper half is seen, in clothes a pixel wider on one side."""
    body, mask = np.zeros((16, 16), bool), np.full((16, 16), MaskState.UNKNOWN, np.uint8)
    body[4:12, 4:8] = True
    mask[4:8, 4:9] = MaskState.PERSON
    found = beside_visible(body, mask)
    assert found[5, [1, 2, 10, 15]].all()
    assert not found[5, [3, 9]].any(), "next to visible person: both are in the pixel"
    assert not found[9:, :].any(), "beside what is hidden"
    assert not (found & body).any()
    assert not beside_visible(np.zeros_like(body), mask).any()


def test_which_pixels_a_term_is_about():
    target = a_target()
    beside = target.unknown & ~target.body
    assert beside.any()
    reached = target.near < target.far
    assert 0 < (target.background & reached).sum() < target.background.sum()
    expected = {
        "completeness": target.body | target.person,
        "background": target.background & reached,
        "around": beside,
    }
    for config, changed in ((QUICK, {}), (PAPER, {"background": target.background})):
        shown = some_shown(target)
        alpha = shown.human.requires_grad_()
        terms = ray_losses(replace(shown, human=alpha), target, config, 0.0)
        for name, where in (expected | changed).items():
            (gradient,) = torch.autograd.grad(terms[name], alpha, retain_graph=True)
            assert torch.equal(gradient != 0, where), name


def test_rays_are_drawn_mostly_in_the_window_of_the_body():
    target = a_target()
    pixels = target.draw(1000, np.random.default_rng(0))
    x0, y0, width, height = target.box
    rows, columns = pixels // SIZE, pixels % SIZE
    inside = (columns >= x0) & (columns < x0 + width) & (rows >= y0) & (rows < y0 + height)
    assert inside[:900].all()
    assert 0 < inside[900:].sum() < 100


def test_each_term_by_hand():
    target = a_target()
    shown = some_shown(target)
    with torch.no_grad():
        terms = ray_losses(shown, target, PAPER, 200.0)
    known = target.coloured
    colours = (shown.colours - target.colours).abs().mean(1)[known].mean()
    assert terms["colours"].item() == pytest.approx(colours.item())
    assert terms["completeness"].item() == pytest.approx(-0.1 * np.log(0.7 + LEAST))
    assert terms["background"].item() == pytest.approx(-0.1 * np.log(0.3 + LEAST))
    assert terms["around"].item() == pytest.approx(PAPER.around * 0.7)
    assert terms["entropy"].item() == pytest.approx(-0.005 * 2 * (0.7 * np.log(0.7) + 0.3 * np.log(0.3)))
    assert terms["occlusion"].item() == pytest.approx(-np.log(0.8 + LEAST) - np.log(0.2 + LEAST), rel=1e-5)
    assert terms["sparsity"].item() == pytest.approx(0.01 * 0.2)
    assert terms["inside"].item() == 0
    all_beside = replace(shown, beside=~target.body)
    with torch.no_grad():
        first, last = (ray_losses(all_beside, target, PAPER, e)["beside"].item() for e in (0.0, 200.0))
        fading = [
            ray_losses(shown, target, replace(PAPER, inside=0.01), e)["inside"].item() for e in (0.0, 100.0, 200.0)
        ]
    assert (first, last) == pytest.approx((0.003 * 0.7, 0.003 * 1001 * 0.7))
    assert fading == pytest.approx([0.01 * 0.3, 0.005 * 0.3, 0.0])


def test_a_class_without_pixels_has_a_loss_of_zero():
    """Vid2Avatar's issue 29: its mean of nothing is NaN."""
    target = a_target(strip=None)
    shown = some_shown(target)
    with torch.no_grad():
        terms = ray_losses(shown, target, PAPER, 0.0)
        none = Rays(*(x[:0] for x in (shown.pixels, shown.colours, shown.human)), None, shown.beside[:0])
        empty = ray_losses(none, target, PAPER, 0.0)
    assert terms["occlusion"].item() == pytest.approx(-np.log(0.8 + LEAST), rel=1e-5)
    assert all(np.isfinite(term.item()) for term in terms.values())
    assert all(term.item() == 0 for name, term in empty.items() if name != "entropy")


def test_alphas_of_0_and_1_have_finite_terms_and_gradients():
    alpha = torch.tensor([0.0, 1.0, 0.5], requires_grad=True)
    loss = binary_entropy(alpha)
    loss.backward()
    assert loss.isfinite()
    assert alpha.grad is not None
    assert alpha.grad.isfinite().all()
    assert eikonal(torch.tensor([[0.0, 0.0, 2.0]])).item() == 1
