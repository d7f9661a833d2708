"""What a run's record says of memory and of how it ended, over all its processes."""

from __future__ import annotations

from ihbench import machine
from ihbench.progress import Progress
from ihbench.recorded_run import RecordedRun
from ihbench.store import RunFolder
from tests.bench.test_store import IDENTITY


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
    assert again.record["about"]["peak_mb"] == 3000.0


def test_a_run_that_ends_well_says_so(tmp_path):
    folder = RunFolder.create(tmp_path, IDENTITY)
    OneStage(folder, Progress.silent()).guarded()
    record = RunFolder.open(folder.path).record
    assert record["status"] == "done"
    assert record["about"]["peak_mb"] > 10
