"""What a time was measured on: machine identity, peak memory, and waiting for the device before reading a clock.

torch is looked at only if something else has imported it already.
"""

from __future__ import annotations

import os
import platform
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from ihbench.config_fields import Entries, Within

Cores = Annotated[int, Within(1, 1e6)]
Loads = Annotated[tuple[Annotated[float, Within(0)], ...], Entries(1)]

BUSY = 1.5  # load average per usable core above which other work was in the way: one run alone brings about 1


@dataclass(frozen=True)
class Machine:
    """Processor, cores, memory, Python, torch and load: what somebody needs to judge a time in seconds.

    Host names and user names are left out: run folders are shared.
    """

    cpu: str | None = None
    cores: Cores | None = None
    cores_usable: Cores | None = None
    memory_gb: float | None = None  # GiB
    platform: str | None = None
    python: str | None = None
    torch: str | None = None  # version; None before it was imported
    torch_threads: Cores | None = None
    gpu: str | None = None
    load_average: Loads | None = None  # at the beginning, which the run itself has no part in
    load_average_end: Loads | None = None

    def at_end(self) -> Machine:
        """The identity as it is known when torch and the device have been used, with the load of both moments."""
        now = identity()
        return replace(now, load_average=self.load_average, load_average_end=now.load_average)


def identity() -> Machine:
    """The machine that this process runs on."""
    torch = sys.modules.get("torch")
    return Machine(
        cpu=cpu_model(),
        cores=os.cpu_count() or 1,
        cores_usable=usable_cores(),
        memory_gb=memory_gb(),
        platform=platform.platform(),
        python=platform.python_version(),
        torch=str(torch.__version__) if torch is not None else None,
        torch_threads=torch.get_num_threads() if torch is not None else None,
        gpu=sys.modules["torch"].cuda.get_device_name() if _cuda_in_use() else None,
        load_average=load_average(),
    )


def load_average() -> tuple[float, ...] | None:
    """Processes that wanted to run over the last 1, 5 and 15 minutes; None where the system does not say."""
    try:
        return tuple(round(value, 2) for value in os.getloadavg())
    except (OSError, AttributeError):  # sandboxes, Windows
        return None


def cpu_model() -> str:
    """The processor's name, as the system tells it."""
    return _field_of("/proc/cpuinfo", "model name") or platform.processor() or platform.machine()


def _field_of(file: str, field: str) -> str | None:
    """What stands behind a field's name and a colon in one of the system's files; None where it does not."""
    with suppress(OSError):
        for line in Path(file).read_text(errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == field:
                return value.strip()
    return None


def usable_cores() -> int:
    """Cores this process may run on; fewer than the machine has under taskset or a batch system."""
    try:
        return len(os.sched_getaffinity(0))
    except (OSError, AttributeError):  # sandboxes, Windows
        return os.cpu_count() or 1


def memory_gb() -> float | None:
    """GiB of main memory."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return None


def peak_memory_mb() -> float:
    """MiB, the most main memory this process has held, since `reset_peak_memory` where the system can reset it."""
    peak = process_memory_mb("VmHWM")
    if peak is not None:
        return peak
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def reset_peak_memory() -> bool:
    """Forget the peak so far, so that one run's peak is not charged to the next in the same process.

    True where that is possible (Linux). The GPU's peak is forgotten as well, where one is in use.
    """
    if _cuda_in_use():
        sys.modules["torch"].cuda.reset_peak_memory_stats()
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def process_memory_mb(field: str) -> float | None:
    """MiB of a field of /proc/self/status ("VmRSS" now, "VmHWM" at most); None where there is no such file."""
    size = _field_of("/proc/self/status", field)
    return None if size is None else int(size.split()[0]) / 2**10


def peak_device_memory_mb() -> float:
    """MiB, the most GPU memory torch has held so far; 0 without a GPU in use."""
    if not _cuda_in_use():
        return 0.0
    return sys.modules["torch"].cuda.max_memory_allocated() / 2**20


def synchronize(device: str = "cpu") -> None:
    """Wait until the device has done what was asked of it, so that a clock read next tells the truth."""
    torch = sys.modules.get("torch")
    kind = str(device).partition(":")[0]
    if torch is None or kind == "cpu":
        return
    if kind == "cuda" and torch.cuda.is_available():
        torch.cuda.synchronize(device)
    elif kind == "mps" and torch.backends.mps.is_available():
        torch.mps.synchronize()


def warm_up(device: str = "cpu") -> None:
    """Let a GPU's libraries start: the first product and the first convolution take seconds, which belong to no
    method. Nothing on a CPU."""
    if str(device).partition(":")[0] != "cuda":
        return
    import torch

    image = torch.ones(1, 4, 8, 8, device=device, requires_grad=True)
    kernel = torch.ones(4, 4, 3, 3, device=device, requires_grad=True)
    drawn = torch.nn.functional.conv2d(image, kernel)
    with warnings.catch_warnings():  # the thread that goes backward has no context yet: torch opens one, and says so
        warnings.filterwarnings("ignore", message="Attempting to run cuBLAS")
        (drawn.flatten(1) @ drawn.flatten(1).T).sum().backward()
    synchronize(device)


def _cuda_in_use() -> bool:
    """Whether this process has opened a GPU. Asking must not open one."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized()
