"""Killed, interrupted, diverged, failed: what is recorded, and what the same command does next."""

import signal
import subprocess
import sys
from textwrap import dedent

import pytest

from ihbench import config_fields
from ihbench.clock.ledger import Ledger
from ihbench.files.atomic import read_json, read_json_lines
from tests.conftest import contents

SAVED, STOPPED, LAST = 3, 6, 8  # the step whose state is saved, the step that is never finished, the last step


def by_view(folder):
    """Every per-view score of a run's own row, to the last bit."""
    return {(row["camera"], row["frame"]): row["scores"] for row in read_json_lines(folder / "scores.jsonl")}


def record(bench):
    (folder,) = bench.folders()
    return read_json(folder / "run.json")


def ended(bench):
    """Status and reason."""
    outcome = record(bench)["outcome"]
    return outcome["status"], outcome["reason"]


def events(bench, kind):
    return [event["data"] for event in record(bench)["ledger"]["events"] if event["kind"] == kind]


def run_until_killed(bench, patch):
    """The run in a process of its own, which a patch of the bench kills with SIGKILL."""
    code = f"""\
import os, signal, sys
from ihbench.runner import run_loop
from ihbench.cli import main
from ihbench.clock.ledger import Ledger

die = lambda: os.kill(os.getpid(), signal.SIGKILL)
{dedent(patch)}
sys.exit(main(sys.argv[1:]))
"""
    words = [sys.executable, "-c", code, *bench.run_words()]
    done = subprocess.run(words, env=bench.environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert ended(bench)[0] == "running"


def assert_continues_to_the_same_numbers(bench, finished, step):
    outcome = bench.run()
    assert outcome.status == 0
    assert f"continuing stage1 at step {step}" in outcome.err
    (folder,) = bench.folders()
    assert ended(bench)[0] == "done"
    assert [event["step"] for event in events(bench, "resumed")] == [step]
    assert by_view(folder) == by_view(finished.folder)
    assert contents(folder)["avatar/avatar.safetensors"] == contents(finished.folder)["avatar/avatar.safetensors"]
    assert contents(folder).keys() == contents(finished.folder).keys()
    steps = [point["step"] for point in read_json_lines(folder / "curve.jsonl")]
    assert steps == sorted(set(steps))
    assert steps[-1] == LAST


def stop_at(step, stop):
    """`Ledger.offer` and `Ledger.due_to_save` that save one state and stop later."""
    steps = []

    def offer(self, now, *_, **__):
        steps.append(now)
        if now == step:
            stop()
        return False

    return offer, lambda self: steps[-1] == SAVED


# ------------------------------------------------------------------------------------------- killed, interrupted


def test_a_run_killed_while_fitting_ends_with_the_same_numbers(bench, finished):
    run_until_killed(
        bench,
        f"""
        steps = []
        Ledger.offer = lambda self, step, *_, **__: steps.append(step) or (step == {STOPPED} and die())
        Ledger.due_to_save = lambda self: steps[-1] == {SAVED}
        """,
    )
    assert_continues_to_the_same_numbers(bench, finished, SAVED)


def test_a_run_killed_while_scoring_ends_with_the_same_numbers(bench, finished):
    run_until_killed(
        bench,
        """
        from ihbench.runner import score_stage
        write, left = score_stage.write_png, [1, 1]
        score_stage.write_png = lambda *a: write(*a) if left and left.pop() else die()
        """,
    )
    (folder,) = bench.folders()
    assert len(list((folder / "renders").rglob("*.png"))) <= 2  # written on several threads
    assert not (folder / "scores.jsonl").exists()
    assert_continues_to_the_same_numbers(bench, finished, LAST)


@pytest.fixture(autouse=True)
def interruptible():
    """A job started in the background inherits an ignored SIGINT; here it must interrupt."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupted_run_says_so_and_continues(bench, finished, monkeypatch):
    with monkeypatch.context() as patch:
        offer, due_to_save = stop_at(STOPPED, lambda: signal.raise_signal(signal.SIGINT))
        patch.setattr(Ledger, "offer", offer)
        patch.setattr(Ledger, "due_to_save", due_to_save)
        outcome = bench.run()
    assert (outcome.status, outcome.out) == (130, "")
    assert outcome.err.splitlines()[-1] == "ihbench: interrupted; the same command continues where it stopped"
    assert ended(bench) == ("interrupted", "interrupted by the user")
    assert "Not done: inpainthuman on standin-1: interrupted" in bench("report", "--runs", bench.runs).out
    assert_continues_to_the_same_numbers(bench, finished, SAVED)
    stages = record(bench)["ledger"]["stages"]
    assert stages["redone"]["seconds"] > 0
    top = sum(stage["seconds"] for path, stage in stages.items() if "/" not in path)
    assert 0 < top <= record(bench)["ledger"]["seconds"] * (1 + 1e-9)


def test_a_damaged_checkpoint_costs_time_and_nothing_else(bench, finished, monkeypatch):
    with monkeypatch.context() as patch:
        offer, due_to_save = stop_at(STOPPED, lambda: signal.raise_signal(signal.SIGINT))
        patch.setattr(Ledger, "offer", offer)
        patch.setattr(Ledger, "due_to_save", due_to_save)
        bench.run()
    (folder,) = bench.folders()
    checkpoint = folder / "checkpoints" / "stage1.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    assert bench.run().status == 0
    assert [event["what"][:28] for event in events(bench, "warning")] == ["checkpoint stage1 is damaged"]
    assert by_view(folder) == by_view(finished.folder)


# ------------------------------------------------------------------------------------------------ diverged, failed


def assert_diverged(bench, outcome, step):
    assert outcome.status == 1
    assert [event["step"] for event in events(bench, "diverged")] == [step]
    status, reason = ended(bench)
    assert status == "diverged"
    assert reason.startswith(f"diverged at step {step}: ")
    assert f"Not done: inpainthuman on standin-1: diverged ({reason})." in outcome.out
    assert "| inpainthuman" not in outcome.out
    (folder,) = bench.folders()
    assert not {"scores.jsonl", "avatar/avatar.json"} & contents(folder).keys()


@pytest.mark.parametrize("switch", ["--method.lr-maps", "--method.lr-decoder"])
def test_an_absurd_step_size_is_a_divergence_even_when_the_curve_is_measured_there(bench, monkeypatch, switch):
    due = Ledger.offer
    monkeypatch.setattr(Ledger, "offer", lambda self, *a, force=False: due(self, *a, force=True))
    monkeypatch.setattr(config_fields.Within, "holds", lambda *_: True)  # nobody may ask for so much
    outcome = bench.run(switch, "1e30")
    assert_diverged(bench, outcome, events(bench, "diverged")[0]["step"])
    assert 1 <= events(bench, "diverged")[0]["step"] < LAST


def test_a_divergence_is_recorded_at_its_first_bad_step_and_stands(bench, monkeypatch):
    from ihbench.methods.inpainthuman.stages import stage1

    calls, loss_of = [], stage1.loss_of

    def spoiled(*arguments):
        calls.append(1)
        return loss_of(*arguments) * (float("nan") if len(calls) >= 5 else 1)

    monkeypatch.setattr(stage1, "loss_of", spoiled)
    assert_diverged(bench, bench.run(), 4)
    before, made = contents(bench.folders()[0]), len(calls)
    assert_diverged(bench, bench.run(), 4)
    assert len(calls) == made
    assert contents(bench.folders()[0]) == before


def test_a_method_that_raises_fails_with_its_reason_and_the_other_runs_go_on(bench, broken_mannequin):
    outcome = bench.run("--seed", 0, 1, method=broken_mannequin)
    assert outcome.status == 1
    failed, done = bench.folders()
    why = read_json(failed / "run.json")["outcome"]
    assert (why["status"], why["reason"]) == ("failed", "RuntimeError: a leg fell off (see traceback.txt)")
    assert "in fit\n" in (failed / "traceback.txt").read_text()
    assert f"Not done: mannequin on standin-1: failed ({why['reason']})." in outcome.out
    assert read_json(done / "run.json")["outcome"]["status"] == "done"
    assert "Traceback" not in outcome.err
    assert f"(see {failed / 'traceback.txt'})" in outcome.out.splitlines()[-2]


def test_a_failed_run_is_tried_again(bench, mannequin, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("own_method.method.Mannequin.fit", lambda *_, **__: 1 / 0)
        assert bench.run(method=mannequin).status == 1
    assert ended(bench)[1].startswith("ZeroDivisionError: division by zero")
    assert bench.run(method=mannequin).status == 0
    assert ended(bench) == ("done", "")
    (folder,) = bench.folders()
    assert not (folder / "traceback.txt").exists()
