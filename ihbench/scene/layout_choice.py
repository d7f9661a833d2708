"""One data set in several on-disk layouts: the one that a folder has is found by trying."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from ihbench.errors import BadInput
from ihbench.files.paths import user_path
from ihbench.scene.contracts import Dataset

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.scene.copy_report import CopyReport


@dataclass(frozen=True)
class LayoutChoice:
    """A registered data set: called with a folder it opens the layout there; see `scene.contracts.Dataset`."""

    name: str
    layouts: tuple[str, ...]  # "module:class" of each, in the order in which they are tried

    def __call__(self, root: Path) -> Dataset:
        return self._find(root)(root)

    def check(self, root: Path, body: Body | None = None) -> CopyReport:
        """What a folder holds and lacks. `body` is the user's SMPL model, with which poses are held against masks.

        Raises `BadInput` when it has none of the layouts.
        """
        return self._find(root).check(root, body)

    def _find(self, root: Path) -> type[Dataset]:
        if not user_path(root).is_dir():
            raise BadInput(f"{root}: no such folder")
        if len(self.layouts) == 1:  # it says itself what it lacks
            return resolve_name(self.layouts[0])
        complaints = []
        for name in self.layouts:
            layout = resolve_name(name)
            try:
                layout(root)
            except BadInput as error:
                complaints.append(str(error).removeprefix(f"{root}: "))
                continue
            return layout
        raise BadInput(f"{root}: no layout of {self.name} ({'; '.join(complaints)})")
