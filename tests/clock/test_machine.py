"""The machine's identity, peak memory, and provenance."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ihbench.clock import machine
from ihbench.files import atomic
from ihbench.record import provenance


def test_identity_is_complete_and_fits_into_json():
    facts = machine.identity()
    json.dumps(atomic.encode(facts))
    assert facts.cpu
    assert 1 <= facts.cores_usable <= facts.cores
    assert facts.memory_gb > 0.1
    assert facts.python == ".".join(map(str, sys.version_info[:3]))
    assert facts.torch == torch.__version__


def test_the_load_of_the_beginning_is_kept_beside_that_of_the_end():
    after = replace(machine.identity(), load_average=(7.0, 7.0, 7.0), torch=None, gpu=None).at_end()
    assert after.load_average == (7.0, 7.0, 7.0)
    assert after.load_average_end == machine.identity().load_average
    assert after.torch == torch.__version__


def test_a_cpu_has_nothing_to_warm_up_and_torch_is_not_brought_for_it():
    code = "import sys; from ihbench.clock import machine; machine.warm_up('cpu'); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_identity_does_not_import_torch():
    code = (
        "import sys; from ihbench.clock import machine; facts = machine.identity(); machine.synchronize('cuda')\n"
        "assert machine.peak_device_memory_mb() == 0 and facts.torch is None and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_peak_memory_sees_an_allocation():
    before = machine.peak_memory_mb()
    size = int(before + 64)
    np.ones(size * 2**17)  # touched, so resident
    assert machine.peak_memory_mb() >= size
    assert machine.peak_memory_mb() < before + size + 512


def test_a_reset_forgets_an_earlier_peak():
    np.ones(256 * 2**17)  # 256 MiB, given back at once
    before = machine.peak_memory_mb()
    assert machine.reset_peak_memory() == (sys.platform == "linux")
    assert machine.peak_memory_mb() < before - 128 or sys.platform != "linux"


def test_synchronize_takes_any_device_name():
    for device in ("cpu", "cuda", "cuda:0", "mps"):
        if device == "cpu" or not torch.cuda.is_available():
            machine.synchronize(device)


def git(folder: Path, *arguments: str) -> None:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    subprocess.run(["git", *identity, "-C", str(folder), *arguments], check=True, capture_output=True)


def test_git_state_tells_clean_from_changed_and_ignores_foreign_checkouts(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    assert provenance.git_state(package) is None
    git(tmp_path, "init")
    (tmp_path / "other.txt").write_text("x")
    git(tmp_path, "add", "other.txt")
    git(tmp_path, "commit", "-m", "a")
    assert provenance.git_state(package) is None  # the checkout around it does not track it
    git(tmp_path, "add", "package")
    git(tmp_path, "commit", "-m", "b")
    clean = provenance.git_state(package)
    assert clean is not None
    assert len(clean.commit) == 40
    assert clean.dirty is False
    (package / "__init__.py").write_text("changed")
    assert provenance.git_state(package) == replace(clean, dirty=True)


def test_versions_are_those_of_the_installed_packages():
    versions = provenance.package_versions()
    assert versions["numpy"] == np.__version__
    assert "gsplat" not in versions or versions["gsplat"]


def test_a_system_that_tells_nothing_is_no_error(monkeypatch):
    """Sandboxes hide the load, the affinity, /proc."""

    def refuses(*_, **__):
        raise OSError("not here")

    for name in ("getloadavg", "sched_getaffinity"):
        monkeypatch.setattr(machine.os, name, refuses, raising=False)
    monkeypatch.setattr(machine.Path, "read_text", refuses)
    about = machine.identity()
    assert about.load_average is None
    assert about.cores_usable >= 1
    assert about.cpu
