"""The option `--device`, checked before anything is fitted."""

from __future__ import annotations

from ihbench.errors import BadInput


def check_device(device: str) -> None:
    """Raises `BadInput` for cuda where there is no CUDA device."""
    if device != "cuda":
        return
    import torch

    if not torch.cuda.is_available():
        raise BadInput("--device cuda: torch sees no CUDA device here; leave --device out to fit on the CPU")
