"""What `ihbench prepare` has written, read again: the protocol and the data on which drawings of it are scored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench import registry
from ihbench.data.prepare import MANIFEST, Manifest, read_manifest
from ihbench.errors import BadInput
from ihbench.scene.contracts import Capture
from ihbench.scene.data_source import DataSource, locate, own_data, standin_root
from ihbench.scene.protocol import Protocol, protocol_from

if TYPE_CHECKING:
    from ihbench.body import Body


@dataclass(frozen=True)
class Prepared:
    """What `prepare` has written, for `score`: everything that decides which numbers the drawings get."""

    protocol: Protocol
    manifests: dict[str, Manifest]  # scene -> its manifest
    data: Path | None  # the user's copy; None for a stand-in
    body_file: Path | None

    def source(self, data: Path | None, scenes: tuple[str, ...]) -> DataSource:
        """Where the truth lies: in `data`, else where it was prepared from. Raises `BadInput` as `locate` does."""
        known = tuple(self.manifests)
        for scene in scenes:
            if scene not in known:
                raise BadInput(f"--scene {scene}: was not prepared: {registry.nearest(scene, list(known))}")
        if data is None and self.data is None and next(iter(self.manifests.values())).standin:
            return DataSource(self.protocol, standin_root(self.protocol.dataset), True, scenes or known)
        if data is None and self.data is not None:
            data = self.data if self.data.is_dir() else own_data(None)
            if data is None:
                raise BadInput(f"{self.data}: no such folder, but there lay the data that were prepared; name --data")
        return locate(self.protocol, data, scenes or known)

    def check(self, capture: Capture, body: Body) -> None:
        """Raise `BadInput` when a scene is not what was handed out under its name."""
        manifest = self.manifests[capture.name]
        if (capture.standin, body.content_sha()) != (manifest.standin, manifest.body):
            was, now = manifest.standin or "real data", capture.standin or "real data"
            raise BadInput(
                f"{capture.name}: was prepared from {was} and body {manifest.body}, but here is {now} and body "
                f"{body.content_sha()}; name the same with --data and --body"
            )


def read_prepared(folder: Path) -> Prepared:
    """Read the manifests of what `prepare` has written to a folder, or of one scene in it. Raises `BadInput`."""
    if folder.name == MANIFEST and folder.is_file():
        folder = folder.parent
    own = folder / MANIFEST
    files = [own] if own.is_file() else sorted(folder.glob(f"*/{MANIFEST}")) if folder.is_dir() else []
    manifests = {manifest.scene: manifest for manifest in map(read_manifest, files)}
    if not manifests:
        raise BadInput(f"{folder}: no {MANIFEST} in it or its folders; name what `ihbench prepare --out` has written")
    first, file = next(iter(manifests.values())), files[0]
    alike = ("protocol", "protocol_digest", "profile", "data", "body_file")
    if any(getattr(manifest, key) != getattr(first, key) for manifest in manifests.values() for key in alike):
        raise BadInput(f"{folder}: holds scenes of several protocols or data folders; name one scene's folder")
    try:
        protocol = protocol_from(first.content, first.profile, first.protocol.partition("@")[2])
    except BadInput as error:
        raise BadInput(f"{file}: {error}; prepare it again") from error
    if protocol.digest != first.protocol_digest:
        raise BadInput(f"{file}: its protocol {first.protocol} is another one to this ihbench; prepare it again")
    where = first.data, first.body_file
    data, body_file = (None if path is None else (file.parent / path).resolve() for path in where)
    return Prepared(protocol, manifests, data, body_file)
