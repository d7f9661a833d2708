"""Read files of `torch.save` that hold plain tensors. Nothing in them runs."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench.errors import BadInput
from ihbench.files.regular import opened

if TYPE_CHECKING:
    from torch import Tensor


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The dictionary in the file, on the CPU. Raises `BadInput` for one that is damaged or holds anything else."""
    import torch

    with opened(path, "a file of torch.save") as file:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of old protocols, and of damaged ones
                content = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # a broken or hostile file can fail in any way
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise BadInput(
                f"{path}: not a file of plain tensors ({reason}); expected a complete file of torch.save"
            ) from None
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise BadInput(f"{path}: expected a dictionary of tensors by name, found a {type(content).__name__}")
    return content
