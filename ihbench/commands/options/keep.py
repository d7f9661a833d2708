"""The option `--keep`, checked before anything is fitted."""

from __future__ import annotations

from typing import Any

from ihbench import registry
from ihbench.errors import BadInput


def check_keep(keep: tuple[str, ...], config: Any) -> None:
    """Raises `BadInput` for a field that the method's configuration does not have; "all" stands for every one."""
    from ihbench.config_fields import flat

    if "all" in keep:
        return
    known = list(flat(config))
    for name in keep:
        if name not in known:
            raise BadInput(f"--keep {name}: no such switch: {registry.nearest(name, known)}")
