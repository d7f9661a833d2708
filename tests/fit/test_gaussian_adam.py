"""A set of Gaussians and its Adam: rates by attribute, moments that stay with their Gaussian, resume to the bit."""

import math

import pytest
import torch

from ihbench.clock.checkpoints import States
from ihbench.fit.gaussians.adam import MOMENTS, GaussianAdam, Rate, rates_3dgs
from ihbench.fit.gaussians.gaussian_set import Carried, Gaussians, Rows, to_logit
from ihbench.fit.gaussians.neighbours import spacing


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def a_set(n=10, seed=0):
    carried = {
        "weights": random(n, 4, seed=seed + 1).softmax(1),
        "parent": torch.arange(n),
        "original": Carried(torch.ones(n, dtype=torch.bool), of_new=0),
    }
    return Gaussians.on(random(n, 3, seed=seed), more={"sh": random(n, 4, 3, seed=seed + 2)}, carried=carried)


def an_adam(n=10, seed=0):
    return GaussianAdam(a_set(n, seed), rates_3dgs() | {"sh": Rate(2.5e-3)})


def change(adam, keep, parents=()):
    """Keep some rows (mask) and add a new one for each parent."""
    rows = Rows.made(keep, torch.tensor(parents, dtype=torch.int64))
    adam.rearrange(rows)
    return rows


def loss(gaussians):
    """Each Gaussian's own, told apart by the vertex that it carries."""
    place = 1 + gaussians.carried("parent").float()
    return sum(
        (place * (p - 0.3).square().flatten(1).sum(1) if p.ndim > 1 else place * (p - 0.3).square()).sum()
        for p in gaussians.attributes.values()
    )


def walk(adam, first, last):
    for k in range(first, last):
        adam.zero_grad()
        loss(adam.gaussians).backward()
        adam.step(k)


def test_what_a_set_starts_with():
    """GauHuman's acceptance check 3: opacity .1, round, as large as the points are apart."""
    points = random(50, 3)
    gaussians = Gaussians.on(points)
    torch.testing.assert_close(gaussians.opacities, torch.full((50,), 0.1))
    torch.testing.assert_close(gaussians.scales, spacing(points)[:, None].expand(50, 3))
    assert (gaussians.quaternions == torch.tensor([1.0, 0, 0, 0])).all()
    assert len(gaussians) == 50
    assert len(Gaussians.on(torch.zeros(1, 3))) == 1


def test_wrong_shapes_are_refused():
    points = random(3, 3)
    with pytest.raises(ValueError, match="quaternions: expected"):
        Gaussians(points, points, points, points[:, 0])
    with pytest.raises(ValueError, match="at least one row"):
        Gaussians.on(points[:0])
    with pytest.raises(ValueError, match="attribute 'means'"):
        Gaussians.on(points, more={"means": points})
    with pytest.raises(ValueError, match="carried parent: expected 3 rows, got 2"):
        Gaussians.on(points, carried={"parent": torch.arange(2)})
    with pytest.raises(ValueError, match="got means"):
        GaussianAdam(Gaussians.on(points), {"means": Rate(1.0)})


def test_what_is_broken():
    gaussians = a_set(4)
    with torch.no_grad():
        gaussians.means[0, 1] = math.nan
        gaussians.attributes["sh"][1, 0, 0] = math.inf
        gaussians.opacity_logits[2] = math.inf
    assert gaussians.broken().tolist() == [True, True, False, False]
    assert gaussians.opacities[2] == 1


def test_logits_are_finite_at_both_ends():
    ends = to_logit(torch.tensor([0.0, 0.5, 1.0]))
    assert ends.isfinite().all()
    assert ends[1] == 0
    torch.testing.assert_close(ends.sigmoid(), torch.tensor([0.0, 0.5, 1.0]), atol=2e-6, rtol=0)


def test_rates():
    means = rates_3dgs()["means"]
    assert means.at(0) == 1.6e-4
    assert means.at(1200) == pytest.approx(1.331e-4, rel=1e-3)  # GauHuman's acceptance check 5
    assert means.at(30_000) == means.at(10**6) == pytest.approx(1.6e-6)
    assert rates_3dgs(3.4693)["means"].at(15_000) == pytest.approx(5.55e-5, rel=1e-3)  # 3DGS-Avatar's 6
    held = Rate(1.0, 0.01, steps=100, hold=50)
    assert held.at(50) == 1
    assert held.at(100) == pytest.approx(0.1)
    assert Rate(0.0).at(7) == 0
    with pytest.raises(ValueError, match="expected rates above 0"):
        Rate(0.0, 0.1)


def test_each_attribute_moves_by_its_own_rate():
    """Adam's first step is the learning rate, whatever the gradient."""
    adam = an_adam()
    before = {name: p.detach().clone() for name, p in adam.gaussians.attributes.items()}
    adam.rates["means"] = Rate(1.0, 0.01, steps=10)
    walk(adam, 5, 6)
    for name, p in adam.gaussians.attributes.items():
        moved = (p.detach() - before[name]).abs().amax()
        assert moved.item() == pytest.approx(0.1 if name == "means" else adam.rates[name].first, rel=1e-3), name


def test_kept_rows_go_on_as_if_nothing_had_happened():
    """Against a run of the same Gaussians in which none is removed or added."""
    plain, changed = an_adam(40), an_adam(40)
    walk(plain, 0, 30)
    walk(changed, 0, 10)
    keep = torch.arange(40) % 3 != 0
    change(changed, keep, range(5))
    walk(changed, 10, 20)
    some = torch.ones(len(changed.gaussians), dtype=torch.bool)
    some[[1, 4]] = False
    change(changed, some)
    walk(changed, 20, 30)
    left = torch.arange(40)[keep][torch.arange(int(keep.sum())).apply_(lambda k: k not in (1, 4)).bool()]
    assert changed.gaussians.carried("parent")[: len(left)].tolist() == left.tolist()
    for name, p in changed.gaussians.attributes.items():
        torch.testing.assert_close(
            p.detach()[: len(left)], plain.gaussians.attributes[name].detach()[left], rtol=1e-6, atol=1e-7
        )
        state, whole = changed.optimizer.state[p], plain.optimizer.state[plain.gaussians.attributes[name]]
        assert state["step"] == whole["step"] == 30
        for key in MOMENTS:
            torch.testing.assert_close(state[key][: len(left)], whole[key][left], rtol=1e-5, atol=1e-12)
    assert len(changed.optimizer.state) == len(changed.gaussians.attributes)


def test_a_new_row_has_zero_moments_and_its_parents_everything_else():
    adam = an_adam()
    walk(adam, 0, 5)
    before = {name: p.detach().clone() for name, p in adam.gaussians.attributes.items()}
    moments = {name: adam.optimizer.state[p]["exp_avg"].clone() for name, p in adam.gaussians.attributes.items()}
    rows = change(adam, torch.ones(10, dtype=torch.bool), [3, 7])
    assert rows.source.tolist() == [*range(10), 3, 7]
    for name, p in adam.gaussians.attributes.items():
        assert torch.equal(p.detach(), before[name][rows.source])
        state = adam.optimizer.state[p]
        assert torch.equal(state["exp_avg"][:10], moments[name])
        assert state["exp_avg"][10:].eq(0).all()
        assert state["exp_avg_sq"][10:].eq(0).all()
        assert p.requires_grad
    assert adam.gaussians.carried("parent")[10:].tolist() == [3, 7]
    assert torch.equal(adam.gaussians.carried("weights")[10:], adam.gaussians.carried("weights")[[3, 7]])
    assert adam.gaussians.carried("original").tolist() == [True] * 10 + [False] * 2


def test_a_change_before_adams_step_loses_that_step():
    adam = an_adam()
    loss(adam.gaussians).backward()
    change(adam, torch.ones(10, dtype=torch.bool))
    before = adam.gaussians.means.detach().clone()
    adam.step(1)
    assert torch.equal(adam.gaussians.means.detach(), before)


def test_rows_set_back_forget_where_they_were_going():
    """GTU's vertices: put back, they stay bit for bit through a step without gradient; others move on."""
    adam = an_adam()
    start = adam.gaussians.means.detach().clone()
    walk(adam, 0, 5)
    some = torch.arange(10) < 4
    adam.set_rows("means", some, start[some])
    adam.set_rows("opacity_logits", some, 0.7)
    adam.step(6)
    now = adam.gaussians.means.detach()
    assert torch.equal(now[:4], start[:4])
    assert not torch.equal(now[4:], start[4:])
    assert adam.gaussians.opacity_logits[:4].tolist() == [pytest.approx(0.7)] * 4


def test_a_saved_state_goes_on_to_the_bit(tmp_path):
    adam = an_adam(20)
    walk(adam, 0, 7)
    change(adam, torch.arange(20) > 4, [7])
    walk(adam, 7, 12)
    states = States(tmp_path)
    states.save("fit", adam.tensors(), {})
    walk(adam, 12, 20)
    saved = states.load("fit")
    assert saved is not None
    other = an_adam(20, seed=5)
    other.put(saved[0])
    walk(other, 12, 20)
    for name, value in adam.tensors().items():
        assert torch.equal(other.tensors()[name], value), name
    with pytest.raises(ValueError, match=r"expected gaussians\.means"):
        other.put({})


def test_rows_of_a_change():
    rows = Rows.made(torch.tensor([True, False, True]), torch.tensor([1, 1]))
    assert rows.source.tolist() == [0, 2, 1, 1]
    assert rows.of(torch.tensor([5, 6, 7])).tolist() == [5, 7, 6, 6]
    assert rows.of(torch.tensor([5, 6, 7]), fresh=0).tolist() == [5, 7, 0, 0]
