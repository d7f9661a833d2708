"""ihbench measures how well a method rebuilds an occluded person as an animatable 3D avatar."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ihbench.clock.kernel_cache import choose_kernel_cache
from ihbench.clock.threads import bound_spinning
from ihbench.version import __version__

__all__ = ["__version__", "ablate", "frame", "load_scene", "run", "score"]

choose_kernel_cache()  # before numba
bound_spinning()  # whoever comes in, by whichever module, comes by here, and mostly before torch

if TYPE_CHECKING:
    from ihbench.api import ablate, frame, load_scene, run, score


def __getattr__(name: str) -> Any:
    """`ihbench.run` and its like, imported at first use."""
    if name in __all__:
        from ihbench import api

        return getattr(api, name)
    raise AttributeError(f"module 'ihbench' has no attribute {name!r}")
