"""The backbone that a method's configuration chooses: its folders, looked at or loaded. Imports nothing heavy by
itself: plans and identities of runs ask it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.diffusion.backbone import Backbone

SWITCHES = "--method.inpaint."  # where most methods have them


class BackboneChoice(Protocol):
    """The switches of a configuration that say which backbone it is."""

    @property
    def backbone(self) -> Literal["mini", "sd2"]: ...
    @property
    def weights(self) -> str: ...  # folder or hub id; empty for the shipped mini
    @property
    def control_weights(self) -> str: ...  # of sd2; empty: made from the UNet
    @property
    def memory_lean(self) -> bool: ...  # of sd2


def load_chosen(choice: BackboneChoice, device: str, switches: str = SWITCHES) -> Backbone:
    """The backbone, frozen. `switches` is what its switches begin with, for messages. Raises `BadInput` for weights
    that are missing, wrong or damaged."""
    if choice.backbone == "sd2":
        from ihbench.diffusion.sd2_weights import load_sd2

        return load_sd2(
            choice.weights,
            choice.control_weights or None,
            device=device,
            memory_lean=choice.memory_lean,
            switches=switches,
        )
    from ihbench.diffusion.mini.weights import load_mini

    return load_mini(Path(choice.weights) if choice.weights else None, device)


def look_at_chosen(choice: BackboneChoice, switches: str = SWITCHES) -> Any:
    """Its tokenizer. Raises `BadInput` for what `load_chosen` would complain of and a look at the folders can tell,
    before an hour of fitting."""
    if choice.backbone == "sd2":
        from ihbench.diffusion.sd2_weights import look_at_sd2

        return look_at_sd2(choice.weights, choice.control_weights or None, switches).tokenizer
    from ihbench.diffusion.mini.folder import SHIPPED, check_mini
    from ihbench.diffusion.mini.weights import mini_tokenizer

    return mini_tokenizer(check_mini(Path(choice.weights) if choice.weights else SHIPPED)[0])


def cached_folders(names: Iterable[str]) -> list[Path]:
    """A folder, or the cached snapshot of a hub id, for each name. An empty name, and one that the run will complain
    of by itself, has none."""
    return [path for name in names if name and (path := _cached_folder(name)) is not None]


def _cached_folder(name: str) -> Path | None:
    from ihbench.diffusion.checkpoint import find_folder

    try:
        return find_folder(name, "")
    except BadInput:
        return None
