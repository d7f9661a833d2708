"""The options that say what to run on: shared by the commands that take a protocol, a method and scenes."""

from __future__ import annotations

import ast
import inspect
import types
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, make_dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

from ihbench.config_fields import IMAGE_SIZES, Values, Within, flat, has_text, refuse_repeated
from ihbench.errors import BadInput
from ihbench.scene import protocol as protocol_module
from ihbench.scene.protocol import CHOICES, Protocol, ProtocolFile


def _words(source: str) -> dict[tuple[str, str], str]:
    """(class, field) -> the docstring below it. `inspect` would parse the module for each class anew."""
    return {
        (kind.name, ast.unparse(field.target)): " ".join(ast.literal_eval(text.value).split())
        for kind in ast.parse(source).body
        if isinstance(kind, ast.ClassDef)
        for field, text in pairwise(kind.body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


WORDS = _words(inspect.getsource(protocol_module))


def _optional(kind: type, inside: str = "") -> type:
    """A dataclass with the choices of a protocol that another has, each of which may be left out."""
    own, parts = get_type_hints(kind, include_extras=True), []
    for name in (f.name for f in fields(kind)):
        if inside + name in CHOICES:
            described = tyro.conf.arg(help=WORDS[kind.__name__, name], help_behavior_hint="(default: the protocol's)")
            parts.append((name, Annotated[_on_the_line(own[name]) | None, described], None))
        elif any(choice.startswith(f"{inside}{name}.") for choice in CHOICES):
            nested = _optional(own[name], f"{inside}{name}.")
            parts.append((name, nested, field(default_factory=nested)))
    return make_dataclass(kind.__name__, parts, frozen=True, kw_only=True)


def _on_the_line(hint: Any) -> Any:
    """A type as the command line has it: a text for what can be written as one."""
    parts = tuple(_on_the_line(part) for part in get_args(hint))
    origin = get_origin(hint)
    if has_text(hint):
        return str
    if origin is Annotated:
        return Annotated[(parts[0], *hint.__metadata__)]
    if origin in (Union, types.UnionType):
        return Union[parts]  # noqa: UP007
    if origin is Mapping:
        return dict[parts[0], parts[1]]
    return tuple[parts] if origin is tuple else hint


if TYPE_CHECKING:
    Choices = Any
else:
    Choices = Annotated[_optional(ProtocolFile), tyro.conf.arg(name="protocol")]
NO_CHOICE = get_args(Choices)[0]()
DEFAULT_METHOD = "inpainthuman"


@dataclass(frozen=True)
class OcclusionChoice:
    """Another occlusion than the protocol's. Never in one table with the protocol's own."""

    rule: str | None = None
    """none, fixed-strip, strip-generic, central-band, object, side, upper-half, lower-half, blocks, natural."""
    fraction: Annotated[tuple[float, ...], Within(0, 1)] = ()
    """Share of the person to hide in covered frames; several make a sweep."""
    covers: Annotated[float | None, Within(0, 1)] = None
    """Share of the training frames that are covered; all of them where the occluder stands in the scene (natural)."""


SHORT = {  # choice of a protocol -> field of its short flag
    "train.frames": "train_frames",
    "test.frames": "test_frames",
    "image.size": "image_size",
    "occlusion.rule": "occlusion.rule",
    "occlusion.fraction": "occlusion.fraction",
    "occlusion.covers.fraction": "occlusion.covers",
}


@dataclass(frozen=True, kw_only=True)
class ProtocolChanges:
    """What of a protocol can be changed on the command line: every choice, the usual ones by short flags, too."""

    occlusion: OcclusionChoice = field(default_factory=OcclusionChoice)
    train_frames: str | None = None
    """Other training frames, START:STOP:STEP."""
    test_frames: str | None = None
    """Other (held-out) test frames, START:STOP:STEP."""
    image_size: Annotated[int | None, Within(*IMAGE_SIZES)] = None
    """Other image size, px of the longer side, for training and test images alike."""
    choices: Choices = NO_CHOICE
    """Every choice of the protocol, as `ihbench protocol show` names it."""

    def changes(self) -> Values:
        """Choice -> its other value; of `occlusion.fraction` all, as a tuple. Raises `BadInput` for two of one."""
        out = {name: value for name, value in flat(self.choices).items() if value is not None}
        for name, value in self._short().items():
            if name in out:
                raise BadInput(f"--protocol.{name}: {_flag(name)} says it, too; give one of the two")
            out[name] = value
        return out

    def _short(self) -> Values:
        given = flat(self)
        return {name: given[field] for name, field in SHORT.items() if given[field] not in (None, ())}

    def apply(self, protocol: Protocol) -> list[Protocol]:
        """The protocols that these options mean: one, or one for each severity. Raises `BadInput`."""
        refuse_repeated(self.occlusion.fraction, "--occlusion.fraction")
        changes, flags = self.changes(), {name: _flag(name) for name in self._short()}
        sweep = [{"occlusion.fraction": fraction} for fraction in self.occlusion.fraction] or [{}]
        return [protocol.with_fields(changes | severity, flags) for severity in sweep]


def _flag(choice: str) -> str:
    return f"--{SHORT[choice].replace('_', '-')}"


@dataclass(frozen=True, kw_only=True)
class OwnFiles:
    data: Path | None = None
    """Your copy of the data set; without it (and without IHBENCH_DATA) a stand-in."""
    body: Path | None = None
    """SMPL model file for real data (or IHBENCH_BODY)."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""


@dataclass(frozen=True, kw_only=True)
class RunsFolder(OwnFiles):
    runs: Path = Path("runs")
    """Where run folders lie."""


@dataclass(frozen=True, kw_only=True)
class ScenesChoice(ProtocolChanges, RunsFolder):
    protocol: str
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
    scene: tuple[str, ...] = ()
    """Scenes; none means all that the protocol names."""
    profile: str = "quick"
    """quick (256 px, for a CPU) or paper (512 px, the paper's settings)."""


@dataclass(frozen=True, kw_only=True)
class SceneChoice(ScenesChoice):
    method: str = DEFAULT_METHOD
    """A registered method (`ihbench list methods`)."""
