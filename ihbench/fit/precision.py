"""Which precision the networks of a fit compute in: chosen by a measurement, once a process; the record says so."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor, nn

from ihbench.fit.precision_name import Precision

WORTH_IT = 1.3  # times as fast, before half the digits are given up
HOPELESS = 0.5  # times as fast; such a processor has no arithmetic for it
ROWS, WIDTH, ROUNDS = 4096, 128, 5
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Computed:
    """The precision that a fit's networks compute in."""

    kind: ClassVar[str] = "precision"
    precision: str
    reason: str


@cache
def bfloat16_speed(device: str) -> float:
    """How many times faster a small network learns in bfloat16 than in float32 there; the best of a few rounds."""
    network = nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH)).to(device)
    rows = torch.ones(ROWS, WIDTH, device=device)

    def seconds(dtype: torch.dtype) -> float:
        start = time.perf_counter()
        with autocast(device, dtype):
            out: Tensor = network(rows)
        torch.autograd.grad(out.sum(), list(network.parameters()))
        if device.startswith("cuda"):
            torch.cuda.synchronize(device)
        return time.perf_counter() - start

    best = best_half = float("inf")
    for k in range(ROUNDS):  # the first warms up
        best, best_half = min(best, seconds(torch.float32)), min(best_half, seconds(torch.bfloat16))
        if k > 0 and best < HOPELESS * best_half:
            break
    return best / best_half


def choose(wanted: Precision, device: str) -> Computed:
    """What was asked for, or with `auto` what a measurement on this machine says."""
    if wanted != "auto":
        return Computed(wanted, "asked for")
    speed = bfloat16_speed(device)
    name = "bfloat16" if speed >= WORTH_IT else "float32"
    return Computed(name, f"bfloat16 is {speed:.1f} times as fast as float32 here, worth it from {WORTH_IT}")


def autocast(device: str, dtype: torch.dtype) -> torch.autocast:
    """Networks inside compute in this precision; parameters and sums stay in float32."""
    return torch.autocast(torch.device(device).type, dtype, enabled=dtype != torch.float32)
