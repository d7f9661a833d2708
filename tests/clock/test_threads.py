"""Threads that wait for work sleep, whichever door the bench is entered by."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from ihbench.clock.threads import WAITING, WORDS, begin_on_one_thread

# says what OpenMP is going to read, at the moment at which torch is first looked for, and ends there
WATCH = f"""
import json, os, sys
class Watch:
    def find_spec(self, name, *_):
        if name == "torch":
            print(json.dumps({{word: os.environ.get(word) for word in {WORDS!r}}}), flush=True)
            os._exit(0)
sys.meta_path.insert(0, Watch())
"""


def said(code, **variables):
    """The last line that Python prints for some code, with no word about waiting in its environment but these."""
    environment = {name: value for name, value in os.environ.items() if name not in (*WORDS, "OMP_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment | variables
    )
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "entry",
    [
        "import ihbench; import torch",
        "from ihbench.render.splat import render_gaussians",
        "from ihbench.metrics.lpips import *; import torch",
        "from ihbench.methods.inpainthuman.method import InpaintHuman",
        "from ihbench.datasets.plain.plain_scene import PlainScene; import torch",
        "from ihbench.runner.executor import _child; import torch",
        "from ihbench.cli import main; import torch",
        "import tests.conftest; import torch",
    ],
)
def test_torch_is_told_before_it_is_imported(entry):
    assert said(WATCH + entry) == {"OMP_WAIT_POLICY": None, **WAITING}


@pytest.mark.parametrize("word", WORDS)
def test_who_has_decided_is_not_overruled(word):
    own = "PASSIVE" if word == "OMP_WAIT_POLICY" else "77"
    assert said(f"{WATCH}import ihbench, torch", **{word: own}) == {w: own if w == word else None for w in WORDS}


def test_in_a_process_with_torch_its_threads_outnumber_the_cores():
    """The GNU library then spins a three-hundredth as long. No clock can say so, the number of threads can."""
    code = """
import json, os, torch
torch.set_num_threads(3)  # of a machine with three cores or more, or more than it has
torch.ones(2**20).sum()
before = len(os.listdir("/proc/self/task"))
import ihbench.render.splat
print(json.dumps([before, len(os.listdir("/proc/self/task"))]))
"""
    before, after = said(code)
    assert after >= before + 2  # a thread that sleeps, and its team


def test_nothing_is_started_where_torch_comes_later_or_somebody_has_decided():
    code = "import json, threading; {}; print(json.dumps(threading.active_count()))"
    assert said(code.format("import ihbench, torch")) == 1
    assert said(code.format("import torch, ihbench"), OMP_WAIT_POLICY="PASSIVE") == 1
    assert said(code.format("import torch, ihbench")) == 2


def _threads_of_a_worker() -> dict[str, int]:
    import cv2
    import numba
    import torch
    from threadpoolctl import threadpool_info

    pools = {entry["prefix"]: entry["num_threads"] for entry in threadpool_info()}
    return pools | {"torch": torch.get_num_threads(), "numba": numba.get_num_threads(), "cv2": cv2.getNumThreads()}


def test_a_worker_of_a_pool_begins_on_one_thread():
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=begin_on_one_thread) as pool:
        found = pool.submit(_threads_of_a_worker).result()
    assert set(found.values()) == {1}, found
