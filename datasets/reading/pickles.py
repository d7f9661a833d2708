"""Pickles as other people's code reads them, with numpy 1's module names, which numpy 1 and 2 read."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ihbench.files import atomic


def write_object(path: Path, value: Mapping[str, object]) -> None:
    """A dictionary as np.save would write it; `ihbench.files.safe_pickle.load_npy` reads it."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "|O", "fortran_order": False, "shape": ()})
    buffer.write(_pickled(np.array(value, dtype=object)))
    atomic.write_bytes(path, buffer.getvalue(), durable=False)


def write_pickle(path: Path, value: Any) -> None:
    """Plain values and numpy arrays as a pickle; `ihbench.files.safe_pickle.load_pickle` reads it."""
    atomic.write_bytes(path, _pickled(value), durable=False)


def _pickled(value: Any) -> bytes:
    # protocol 3 spells module names as plain lines without lengths, so they can be replaced in place
    return pickle.dumps(value, protocol=3).replace(b"cnumpy._core.", b"cnumpy.core.")
