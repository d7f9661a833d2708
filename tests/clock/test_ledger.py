"""Stages add up to the wall clock, the fit clock stands still when it must, states survive kills and damage."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.clock.events import DivergedAt, Inpainted, Reused, Warned
from ihbench.clock.ledger import Ledger, LedgerState, QualityTimes


class Clock:
    """Time that passes only when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def seconds_of(ledger: Ledger) -> dict[str, float]:
    return {row["stage"]: row["seconds"] for row in ledger.table()}


def assert_balanced(ledger: Ledger) -> None:
    rows = ledger.table()
    assert rows[-1]["stage"] == "total"
    for column in ("seconds", "cpu_seconds"):
        top = sum(row[column] for row in rows[:-1] if row["depth"] == 0)
        assert math.isclose(top, rows[-1][column], abs_tol=1e-9), column
    for row in rows[:-1]:
        inner = [r for r in rows if r["stage"].rpartition("/")[0] == row["stage"]]
        assert sum(r["seconds"] for r in inner) <= row["seconds"] + 1e-9


def test_nested_stages_are_charged_to_their_path_and_parents():
    clock = Clock()
    ledger = Ledger(clock=clock)
    clock.sleep(1)
    with ledger.stage("load"):
        clock.sleep(2)
    with ledger.stage("fit"):
        clock.sleep(3)
        with ledger.stage("stage1"):
            clock.sleep(4)
        with ledger.stage("fit/stage2"):
            clock.sleep(5)
    assert seconds_of(ledger) == {"load": 2, "fit": 12, "fit/stage1": 4, "fit/stage2": 5, "other": 1, "total": 15}
    assert [row["stage"] for row in ledger.table()][:4] == ["load", "fit", "fit/stage1", "fit/stage2"]
    assert_balanced(ledger)


def test_a_full_path_outside_any_stage_opens_its_parents():
    clock = Clock()
    ledger = Ledger(clock=clock)
    with ledger.stage("fit/stage1"):
        clock.sleep(4)
    assert ledger.fit_seconds == 4
    assert seconds_of(ledger)["fit/stage1"] == 4


def test_a_stage_that_raises_is_closed_and_booked():
    clock = Clock()
    ledger = Ledger(clock=clock)

    def fails() -> None:
        with ledger.stage("fit"):
            clock.sleep(2)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fails()
    clock.sleep(1)
    assert seconds_of(ledger) == {"fit": 2, "other": 1, "total": 3}


@pytest.mark.parametrize("name", ["", "/fit", "fit/", "fit//a", "..", "fit/../x", "a\nb"])
def test_a_stage_name_is_a_path_of_words(name: str):
    with pytest.raises(ValueError, match="stage"), Ledger().stage(name):
        pass


@given(
    st.recursive(
        st.just([]),
        lambda inner: st.lists(
            st.tuples(st.sampled_from(["fit", "load", "a", "b", "|paused|", "|save|"]), st.floats(0, 5), inner),
            max_size=4,
        ),
        max_leaves=12,
    )
)
@settings(deadline=None, derandomize=True, max_examples=60)
def test_whatever_is_nested_in_whatever_the_books_balance(tree):
    clock = Clock()
    ledger = Ledger(clock=clock)
    paused_in_fit = 0.0

    def walk(nodes, in_fit, in_pause):
        nonlocal paused_in_fit
        for name, seconds, inner in nodes:
            if name == "|save|":
                ledger.save_state("s", {}, {})
            elif name == "|paused|":
                with ledger.paused():
                    clock.sleep(seconds)
                    paused_in_fit += seconds if in_fit else 0
                    walk(inner, False, True)
            else:
                with ledger.stage(name):
                    clock.sleep(seconds)
                    walk(inner, in_fit or (name == "fit" and not in_pause), in_pause)

    walk(tree, False, False)
    assert_balanced(ledger)
    assert math.isclose(ledger.seconds, clock.now - 100)


def test_time_before_the_ledger_is_a_stage_of_its_own_and_the_books_still_balance():
    clock = Clock()
    ledger = Ledger(clock=clock)
    with ledger.stage("fit"):
        clock.sleep(2)
        ledger.book("open", 5.0, 3.0)
        clock.sleep(1)
    assert seconds_of(ledger) == {"fit": 3, "open": 5, "other": 0, "total": 8}
    assert ledger.fit_seconds == 3
    assert_balanced(ledger)
    Ledger(state=ledger.state(), clock=clock).book("open", 1.0)
    for name, seconds in (("fit/x", 1.0), ("", 1.0), ("open", -1.0), ("open", math.nan)):
        with pytest.raises(ValueError, match="stage"):
            ledger.book(name, seconds)


def test_a_pause_stops_the_fit_clock_and_is_booked_as_evaluation():
    clock = Clock()
    ledger = Ledger(clock=clock)
    with ledger.stage("fit/stage1"):
        clock.sleep(3)
        with ledger.paused():
            clock.sleep(10)
            assert ledger.fit_seconds == 3
        clock.sleep(1)
    assert seconds_of(ledger) == {"fit": 4, "fit/stage1": 4, "evaluate": 10, "other": 0, "total": 14}


def test_real_clocks_and_memory():
    ledger = Ledger()
    with ledger.stage("fit"):
        sum(i * i for i in range(300_000))
    row = ledger.table()[0]
    assert row["seconds"] > 0
    assert 0 < row["cpu_seconds"] <= ledger.table()[-1]["cpu_seconds"]
    assert row["peak_mb"] > 10
    assert row["entered"] == 1
    assert_balanced(ledger)


# --- quality against time ---


def fit(ledger: Ledger, clock: Clock, steps: range, seconds: float = 0.5) -> None:
    with ledger.stage("fit"):
        for step in steps:
            clock.sleep(seconds)
            ledger.offer(step, lambda step=step: f"avatar {step}")


def test_avatars_are_taken_at_geometric_times_of_the_fit_clock():
    clock, points = Clock(), []

    def score(step, seconds, avatar):
        clock.sleep(100)  # scoring takes long; the fit clock must not notice
        points.append((step, seconds, avatar))

    ledger = Ledger(clock=clock, on_checkpoint=score)
    fit(ledger, clock, range(1, 41))
    assert points == [(s, s / 2, f"avatar {s}") for s in (4, 8, 16, 32)]
    assert ledger.fit_seconds == 20
    assert seconds_of(ledger)["evaluate"] == 400


def test_one_long_step_gives_one_point_not_many():
    clock, points = Clock(), []
    ledger = Ledger(clock=clock, on_checkpoint=lambda *point: points.append(point[1]))
    fit(ledger, clock, range(1, 4), seconds=30)
    assert points == [30, 60, 90]  # due at 2, 32, 64


def test_force_takes_the_last_step_once():
    clock, points = Clock(), []
    ledger = Ledger(clock=clock, on_checkpoint=lambda step, *rest: points.append(step))
    fit(ledger, clock, range(1, 6))
    assert points == [4]
    assert ledger.offer(5, "avatar", force=True)
    assert not ledger.offer(5, "avatar", force=True)
    assert points == [4, 5]


def test_an_avatar_that_happens_to_be_callable_is_not_called():
    class Avatar(torch.nn.Module):
        def render(self): ...

        def forward(self):
            raise AssertionError("called")

    seen = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: seen.append(avatar))
    avatar = Avatar()
    ledger.offer(1, avatar, force=True)
    assert seen == [avatar]


def test_the_avatar_is_not_even_made_when_nothing_is_due_or_nobody_listens():
    def make():
        raise AssertionError("made")

    assert not Ledger(on_checkpoint=lambda *point: None).offer(1, make)
    assert not Ledger().offer(1, make, force=True)


@given(st.floats(0.01, 100), st.floats(1.1, 10), st.floats(0, 1e5))
@settings(deadline=None, derandomize=True)
def test_the_next_quality_time_is_later_and_on_the_grid(first, factor, now):
    times = QualityTimes(first, factor)
    due = times.after(now)
    assert due > now
    assert due == first or due / factor <= now * (1 + 1e-12)


@pytest.mark.parametrize(("first", "factor"), [(0, 2), (-1, 2), (1, 1), (1, math.nan), (math.nan, 2)])
def test_quality_times_that_never_come_are_refused(first, factor):
    with pytest.raises(ValueError, match="quality times"):
        QualityTimes(first, factor)


# --- resume ---

TENSORS = {
    "weights": torch.linspace(0, 1, 12).reshape(3, 4).T,  # not contiguous
    "half": torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
    "scalar": torch.tensor(3),
    "empty": torch.zeros(0, 3),
    "flags": np.array([True, False]),
    "double": np.array(math.pi),
}


@pytest.mark.parametrize("on_disk", [True, False])
def test_a_state_comes_back_as_it_was(tmp_path, on_disk):
    ledger = Ledger(tmp_path if on_disk else None)
    tensors = {**TENSORS, "same_memory": TENSORS["weights"]}
    ledger.save_state("stage1", tensors, {"step": 7, "loss": math.inf, "text": "nan", "note": '"payload_crc32"'})
    loaded = (Ledger(tmp_path) if on_disk else ledger).load_state("stage1")
    assert loaded is not None
    back, meta = loaded
    assert meta == {"step": 7, "loss": math.inf, "text": "nan", "note": '"payload_crc32"'}
    assert set(back) == set(tensors)
    for name, value in tensors.items():
        assert type(back[name]) is type(value)
        assert back[name].dtype == value.dtype
        assert back[name].shape == value.shape
        assert (back[name] == value).all()
        back[name][...] = 0  # writable, and its own memory


def test_a_state_of_arrays_needs_no_torch(tmp_path):
    code = (
        "import sys, numpy as np; from pathlib import Path; from ihbench.clock.ledger import Ledger\n"
        f"l = Ledger(Path({str(tmp_path)!r})); l.save_state('a', {{'x': np.arange(3.0)}}, {{}})\n"
        "assert (l.load_state('a')[0]['x'] == [0, 1, 2]).all(); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_saving_is_booked_apart_and_throttled():
    clock = Clock()
    ledger = Ledger(clock=clock, save_every=20)
    with ledger.stage("fit"):
        assert not ledger.due_to_save()
        clock.sleep(20)
        assert ledger.due_to_save()
        ledger.save_state("s", {}, {})
        assert not ledger.due_to_save()
        clock.sleep(19)
        assert not ledger.due_to_save()
    assert ledger.fit_seconds == 39
    assert "checkpoint" in seconds_of(ledger)


def test_slow_saves_are_made_rarer(monkeypatch):
    clock = Clock()
    ledger = Ledger(clock=clock, save_every=20)
    monkeypatch.setattr("ihbench.clock.checkpoints._copies", lambda tensors: clock.sleep(10) or {})
    ledger.save_state("s", {}, {})
    clock.sleep(199)
    assert not ledger.due_to_save()
    clock.sleep(1)
    assert ledger.due_to_save()
    assert seconds_of(ledger)["checkpoint"] == 10


def killed_run(folder, until: float = 30.0) -> LedgerState:
    """A fit that saves at 12 s of its clock and goes on to `until`; gives the ledger's last state."""
    clock = Clock()
    ledger = Ledger(folder, clock=clock, on_checkpoint=lambda *point: clock.sleep(50))
    with ledger.stage("load"):
        clock.sleep(1)
    fit(ledger, clock, range(1, 11), seconds=1)
    with ledger.stage("fit/stage2"):
        clock.sleep(2)
        ledger.save_state("stage2", {"x": np.zeros(2)}, {"step": 12})
        clock.sleep(until - 12)
    return ledger.state()


def test_the_fit_clock_goes_on_from_the_saved_state(tmp_path):
    killed_run(tmp_path)
    clock, points = Clock(), []
    ledger = Ledger(tmp_path, clock=clock, on_checkpoint=lambda step, seconds, avatar: points.append(seconds))
    with ledger.stage("load"):
        clock.sleep(1)
    with ledger.stage("fit"):
        assert ledger.load_state("stage2") is not None
        assert ledger.fit_seconds == 12
        with ledger.stage("stage2"):
            for step in range(13, 21):
                clock.sleep(1)
                ledger.offer(step, "avatar")
    assert ledger.fit_seconds == 20
    assert seconds_of(ledger)["fit/stage2"] == 10
    assert points == [16]  # 2, 4 and 8 were taken before the kill
    assert_balanced(ledger)


def test_work_a_kill_threw_away_is_booked_as_redone(tmp_path):
    state = killed_run(tmp_path, until=30)
    ledger = Ledger(tmp_path, clock=Clock(), state=state)
    assert ledger.fit_seconds == 30
    assert ledger.load_state("stage2") is not None
    assert ledger.fit_seconds == 12
    assert seconds_of(ledger)["redone"] == 18
    assert ledger.seconds == state.seconds
    assert_balanced(ledger)


def test_of_several_states_the_latest_sets_the_clock(tmp_path):
    clock = Clock()
    ledger = Ledger(tmp_path, clock=clock)
    for name in ("stage1", "stage2"):
        with ledger.stage("fit"):
            clock.sleep(5)
            ledger.save_state(name, {}, {})
    for order in (["stage1", "stage2"], ["stage2", "stage1"]):
        resumed = Ledger(tmp_path, clock=Clock())
        for name in order:
            assert resumed.load_state(name) is not None
        assert resumed.fit_seconds == 10


def test_a_state_that_is_not_there_is_none(tmp_path):
    ledger = Ledger(tmp_path)
    assert ledger.load_state("nothing") is None
    assert Ledger().load_state("nothing") is None
    assert ledger.events == []


@pytest.mark.parametrize("numpy_only", [True, False])
def test_damage_anywhere_counts_as_absent_and_is_said(tmp_path, numpy_only):
    ledger = Ledger(tmp_path)
    ledger.save_state("s", {"x": np.arange(50.0)} if numpy_only else {"x": torch.arange(50.0)}, {"step": 1})
    file = tmp_path / "checkpoints" / "s.safetensors"
    good = file.read_bytes()
    header_end = 8 + int.from_bytes(good[:8], "little")
    flipped_payload = bytearray(good)
    flipped_payload[-20] ^= 1
    flipped_header = bytearray(good)
    flipped_header[header_end // 2] ^= 255
    cases = [b"", b"\xff" * 8, b"\xff" * 100, good[:5], good[: header_end // 2], good[:header_end], good[:-1]]
    for count, data in enumerate([*cases, good + b"x", bytes(flipped_payload), bytes(flipped_header)], 1):
        file.write_bytes(data)
        assert ledger.load_state("s") is None
        assert len(ledger.events) == count
        assert ledger.events[-1].kind == "warning"
    file.write_bytes(good)
    assert ledger.load_state("s") is not None


@pytest.mark.parametrize("name", ["", "../s", "a/b", ".hidden", "a" * 200])
def test_checkpoint_names_cannot_leave_their_folder(tmp_path, name):
    with pytest.raises(ValueError, match="checkpoint name"):
        Ledger(tmp_path).save_state(name, {}, {})
    with pytest.raises(ValueError, match="checkpoint name"):
        Ledger(tmp_path).load_state(name)


def test_only_tensors_go_into_a_state():
    with pytest.raises(TypeError, match="step: expected a tensor"):
        Ledger().save_state("s", {"step": 3}, {})


def test_events_carry_both_clocks_and_survive_a_resume():
    clock = Clock()
    ledger = Ledger(clock=clock)
    clock.sleep(1)
    with ledger.stage("fit"):
        clock.sleep(2)
        ledger.event(DivergedAt(9, "loss is NaN"))
    expected = {"kind": "diverged", "fit_seconds": 2, "seconds": 3, "data": {"step": 9, "reason": "loss is NaN"}}
    assert [vars(event) for event in ledger.state().events] == [expected]
    assert Ledger(state=ledger.state()).events == ledger.events


def test_events_that_a_kill_took_from_the_record_come_back_with_the_state(tmp_path):
    before = Ledger(tmp_path)
    before.event(Warned("told before the fit"))
    recorded = before.state()  # what run.json has
    before.event(Inpainted(1, 2, 3, {"delta_e": math.nan}, {}))
    before.save_state("painted", {"a": np.zeros(1)}, {})
    before.event(Warned("never saved"))

    again = Ledger(tmp_path, state=recorded)
    again.event(Reused("stage1", "0123456789"))
    for _ in range(2):  # once is enough
        again.load_state("painted")
    assert [event.kind for event in again.events] == ["warning", "inpainted", "shared"]
    assert math.isnan(again.events[1].data["identity_drift"]["delta_e"])
    again.save_state("refined", {"a": np.zeros(1)}, {})
    third = Ledger(tmp_path, state=recorded)
    third.load_state("painted")
    third.load_state("refined")
    assert [event.kind for event in third.events] == ["warning", "inpainted", "shared"]


def test_a_lent_state_brings_no_events_of_its_lender(tmp_path):
    lender = Ledger(tmp_path / "lender")
    lender.event(Warned("of the lender"))
    lender.save_state("stage1", {"a": np.zeros(1)}, {})
    (tmp_path / "borrower").mkdir()
    (tmp_path / "lender" / "checkpoints").rename(tmp_path / "borrower" / "checkpoints")
    borrower = Ledger(tmp_path / "borrower")
    assert borrower.load_state("stage1") is not None
    assert borrower.events == []


def test_an_artifact_lies_beside_the_record_under_a_known_name_only(tmp_path):
    ledger = Ledger(tmp_path)
    ledger.artifact("inpainting.png", b"picture")
    assert (tmp_path / "inpainting.png").read_bytes() == b"picture"
    for name in ("run.json", "../inpainting.png"):
        with pytest.raises(ValueError, match="artifact: expected one of inpainting"):
            ledger.artifact(name, b"")
    assert (Ledger().artifact("inpainting.png", b"x"), Ledger().on_disk) == (None, False)  # nowhere to put it


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("on_disk", [True, False])
@pytest.mark.parametrize("with_torch", [True, False])
def test_views_shared_memory_and_read_only_arrays_come_back_as_they_were(tmp_path, on_disk, with_torch):
    fixed = np.arange(6.0)
    fixed.flags.writeable = False
    values = {
        "fixed": fixed,
        "turned": np.arange(6.0).reshape(2, 3).T,
        "one": np.array(2.5),
        "none": np.zeros((0, 3)),
    }
    if with_torch:
        whole = torch.arange(12.0).reshape(3, 4)
        values |= {"whole": whole, "same": whole, "part": whole[1:, :2], "across": whole.T, "rows": whole[:2]}
    ledger = Ledger(tmp_path if on_disk else None)
    ledger.save_state("s", values, {})
    before = {name: np.asarray(value).copy() for name, value in values.items()}
    if with_torch:
        whole += 1  # what is saved is what was there
    loaded, _ = ledger.load_state("s")
    assert loaded.keys() == values.keys()
    for name, value in loaded.items():
        assert type(value) is type(values[name])
        assert value.shape == values[name].shape
        np.testing.assert_array_equal(np.asarray(value), before[name], strict=True)
