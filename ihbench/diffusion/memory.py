"""Running out of memory, on whatever device: telling it from other errors, and saying what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ihbench.errors import BadInput

ADVICE = {
    "mini": "close other programs, or use a machine with more memory",
    "sd2": "switch memory-lean on, or use a GPU with more memory",
}


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out."""
    words = str(error).lower()
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or (
        "out of memory" in words or "can't allocate memory" in words
    )


def halved(batch: int, error: BaseException, line: str) -> int:
    """Half of a batch that ended in this error. Raises the error itself where it is no lack of memory, and `BadInput`
    with `line` where a batch of one does not fit."""
    if not out_of_memory(error):
        raise error
    if batch == 1:
        raise BadInput(line) from error
    return batch // 2


@contextmanager
def said_when_full(line: str) -> Iterator[None]:
    """Raises `BadInput` with `line` when what happens inside runs out of memory."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        raise BadInput(line) from error
