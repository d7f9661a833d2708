"""What a module's parameters were decoded to, kept from one camera to the next for as long as they stay the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from torch import nn

DECODED_KEPT = 16  # poses

Decoded = TypeVar("Decoded")


class DecodedCache(Generic[Decoded]):
    """By a key, such as a pose; the oldest of `DECODED_KEPT` goes first."""

    def __init__(self) -> None:
        self._kept: dict[bytes, Decoded] = {}
        self._decoded_from: list[tuple[int, float]] = []  # these parameters: versions and sums

    def get(self, module: nn.Module, key: bytes, decode: Callable[[], Decoded]) -> Decoded:
        """What `decode` gives for this key, computed once until a parameter of the module changes."""
        # fused optimisers change parameters without counting a version, so their sums are looked at, too
        state = [(p._version, float(p.detach().sum())) for p in module.parameters()]
        if state != self._decoded_from:
            self._kept.clear()
            self._decoded_from = state
        if key not in self._kept:
            if len(self._kept) >= DECODED_KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = decode()
        return self._kept[key]
