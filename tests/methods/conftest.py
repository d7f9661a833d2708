from __future__ import annotations

from collections.abc import Iterator

import pytest

from ihbench.clock.threads import one_torch_thread
from ihbench.scene.contracts import TrainView

from .tiny_fit import training_views


@pytest.fixture(scope="module", autouse=True)
def single_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


@pytest.fixture(scope="module")
def views() -> list[TrainView]:
    return training_views()
