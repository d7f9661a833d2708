"""How many runs share a graphics card, and which: numbers in, numbers out."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from ihbench.clock import gpu_slots
from ihbench.clock.gpu_slots import RUN_MEMORY, card_slots, free_memory, only
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.runner.executor import Cell, run_cells

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "runs", "cores", "workers", "slots"),
    [
        ([80 * GIB], 20, 64, None, [0] * 6),  # memory decides, not the cores
        ([80 * GIB], 20, 4, None, [0] * 4),  # each wants a core, too
        ([80 * GIB], 2, 64, None, [0, 0]),  # and there must be runs
        ([8 * GIB], 20, 64, None, [0]),  # a small card takes one: the profile may fit
        ([0], 20, 64, None, [0]),
        ([24 * GIB, 24 * GIB], 20, 64, None, [0, 1, 0, 1]),
        ([24 * GIB, 80 * GIB], 20, 64, None, [1, 1, 1, 1, 1, 0, 1, 0]),
        ([2 * GIB, 30 * GIB], 20, 64, None, [1, 1]),  # somebody else works on the first
        ([80 * GIB, 80 * GIB], 20, 64, 3, [0, 1, 0]),  # as many as were asked for, evenly
        ([8 * GIB], 20, 64, 4, [0] * 4),
        ([80 * GIB], 2, 64, 4, [0, 0]),
    ],
)
def test_free_memory_decides_how_many_runs_share_a_card(free, runs, cores, workers, slots):
    found = card_slots(free, runs, cores, workers)
    assert found == slots
    for card, memory in enumerate(free):
        assert workers is not None or len(found) == 1 or found.count(card) * RUN_MEMORY <= memory


def test_without_a_card_there_is_no_slot():
    with pytest.raises(ValueError, match="expected one or more"):
        card_slots([], 1, 1)


@pytest.mark.parametrize(
    ("seen", "card", "name"),
    [(None, 1, "1"), ("", 1, "1"), ("2,3", 1, "3"), (" GPU-8c3e , GPU-77aa", 0, "GPU-8c3e"), ("5", 0, "5")],
)
def test_a_process_is_shown_one_of_the_cards_that_its_parent_sees(seen, card, name):
    environment = {} if seen is None else {"CUDA_VISIBLE_DEVICES": seen}
    assert only(card, environment) == {"CUDA_VISIBLE_DEVICES": name}


@pytest.mark.parametrize("code", ["import sys; sys.exit(1)", "print('no numbers')", "print('[]')", ""])
def test_cards_that_do_not_answer_are_bad_input(monkeypatch, code):
    monkeypatch.setattr(gpu_slots, "ASK", code)
    with pytest.raises(BadInput, match="--device cuda"):
        free_memory()


def test_a_card_is_given_to_the_next_run_when_one_ends(monkeypatch):
    """Five runs on two cards: never two on one, each told its own by the environment alone."""
    from ihbench.runner import executor as module

    shown, ends = [], []

    class Process:
        def __init__(self, target, args, daemon):
            self.exitcode, self.connection = 0, args[0]

        def start(self):
            shown.append((os.environ["CUDA_VISIBLE_DEVICES"], os.environ["OMP_NUM_THREADS"]))
            ends.append(self.connection)

        def join(self, *_):
            pass

    context = SimpleNamespace(Process=Process, Pipe=module.get_context("spawn").Pipe)
    monkeypatch.setattr(module, "get_context", lambda _: context)

    def first_ends(connections):
        ends.pop(0).send((None, "done with it"))
        return [next(c for c in connections if c.poll())]

    monkeypatch.setattr(module, "wait", first_ends)
    # the parent's own end of each pipe must stay open until its answer is read
    monkeypatch.setattr(module.Connection, "close", lambda self: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    cells = [Cell(str(k), None, None, "scene") for k in range(5)]  # pyright: ignore[reportArgumentType]
    outcomes = run_cells(cells, 2, 3, Progress.silent(), [0, 1])
    assert [card for card, _ in shown] == ["4", "6", "4", "6", "4"]
    assert {threads for _, threads in shown} == {"3"}
    assert [outcome.problem for outcome in outcomes] == ["done with it"] * 5
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "4,6"
