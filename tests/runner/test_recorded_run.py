"""What a run's record says of memory and of how it ended, over all its processes."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from ihbench.clock import machine
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.metrics import Identity
from ihbench.record.schema import ScoreLine
from ihbench.record.store import RunFolder
from ihbench.runner.recorded_run import RecordedRun, recorded
from tests.record.test_store import IDENTITY
from tests.reports.fake_runs import about


class OneStage(RecordedRun):
    def work(self):
        with self.ledger.stage("fit"):
            pass
        self.describe()
        self.folder.set_status("done", ledger=self.ledger)


def test_the_peak_is_that_of_the_process_that_held_most(tmp_path, monkeypatch):
    """The stages of an earlier process, or of a run that lent one, count too."""
    folder = RunFolder.create(tmp_path, IDENTITY)
    monkeypatch.setattr(machine, "peak_memory_mb", lambda: 3000.0)
    first = OneStage(folder, Progress.silent())
    with first.ledger.stage("fit"):
        pass
    folder.set_status("interrupted", ledger=first.ledger)
    monkeypatch.setattr(machine, "peak_memory_mb", lambda: 700.0)
    again = RunFolder.open(folder.path)
    run = OneStage(again, Progress.silent())
    run.ledger.book("score", 1.0)
    run.describe()
    assert again.about.peak_mb == 3000.0


def test_a_run_that_ends_well_says_so(tmp_path):
    folder = RunFolder.create(tmp_path, IDENTITY)
    OneStage(folder, Progress.silent()).guarded()
    run = RunFolder.open(folder.path)
    assert run.status == "done"
    assert run.about.peak_mb > 10


class Fails(RecordedRun):
    def work(self):
        raise SystemExit("this method prefers to leave")


def test_a_method_that_exits_fails_and_takes_nothing_along(tmp_path):
    folder = RunFolder.create(tmp_path, IDENTITY)
    Fails(folder, Progress.silent()).guarded()
    run = RunFolder.open(folder.path)
    assert run.status == "failed"
    assert run.reason == "SystemExit: this method prefers to leave (see traceback.txt)"


def test_a_record_that_cannot_be_written_is_said_and_the_first_reason_counts(tmp_path, monkeypatch):
    folder = RunFolder.create(tmp_path, IDENTITY)
    said = []
    run = Fails(folder, SimpleNamespace(say=said.append))  # pyright: ignore

    def broken(*_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(atomic, "write_bytes", broken)
    run.guarded()
    assert said == ["the run's record could not be written: [Errno 5] Input/output error"]


def test_a_finished_run_is_found_where_nothing_may_be_written(tmp_path, monkeypatch):
    folder = RunFolder.create(tmp_path, IDENTITY, about())
    folder.write_scores([ScoreLine("inpainthuman", "1", 0, {Identity.parse("psnr/pooled/range1/full/v1"): 30.0}, {})])
    folder.set_status("done")

    def read_only(*_, **__):
        raise OSError(30, "Read-only file system")

    for name in ("open", "replace", "mkdir", "rename", "unlink"):
        monkeypatch.setattr(os, name, read_only)
    assert recorded(tmp_path, IDENTITY, {}, False, lambda _: pytest.fail("run again")).status == "done"
    with pytest.raises(BadInput, match="Read-only file system"):
        recorded(tmp_path, IDENTITY, {}, True, lambda _: pytest.fail("run again"))
