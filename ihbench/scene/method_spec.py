"""What a method says of itself: one `MethodSpec`, the one thing that its package registers, in `ihbench.methods`.

A spec is read by `ihbench --help` and `ihbench list`, so its module imports nothing heavy: what needs torch is named
as "package.module:NAME" and imported when it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ihbench import registry
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.scene.contracts import Method
    from ihbench.scene.plan import Omission, SceneMeasure

Config = Any  # of a method: a frozen dataclass, nested or not
# "package.module:NAME" of an object, or the object itself
Profiles = Mapping[str, Config] | str
LeaveOut = Callable[[Config, "SceneMeasure"], "list[Omission]"] | str
OutsideFiles = Callable[[Config], Sequence[Path]] | str


@dataclass(frozen=True)
class Paper:
    """Where a method comes from, and what its paper says of it."""

    title: str
    authors: str = ""
    year: int = 0
    code: str = ""  # where the released code lies, or that there is none
    reported: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # data set -> psnr, ssim, lpips_x1000


@dataclass(frozen=True)
class Command:
    """A command of `ihbench` that a method brings along."""

    summary: str  # one line, for `ihbench --help`
    main: str  # "package.module:main" of a function: words after the command -> exit status


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """A method, without importing it. Only the first five must be given."""

    name: str  # as on the command line; the entry point has the same
    title: str  # as its paper writes it
    summary: str  # one line, for `ihbench list`
    method: str  # "package.module:Class", a `scene.contracts.Method`
    profiles: Profiles  # "quick" and "paper" -> configuration; its fields become --method.* switches
    paper: Paper | None = None
    licence: str = ""
    implemented: str = ""  # how much of the paper, and what differs
    footnote: str = ""  # what every table must say of this method's rows, such as that details are inferred
    needs: tuple[str, ...] = ("images", "three-state masks", "cameras", "SMPL poses")
    leave_out: LeaveOut | None = None  # what a scene does not need of a configuration: see `scene.plan`
    outside_files: OutsideFiles | None = None  # files that a configuration names and whose content moves numbers
    shared_states: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Saved state -> beginnings of the fields it does not depend on: runs that differ in these alone share it."""
    ablations: str = ""  # "package.module:NAME" of a mapping, name -> `runner.ablation.AblationSuite`
    stress: str = ""  # likewise of a list of `stress.case.Case`
    kernels: Mapping[str, str] = field(default_factory=dict)  # name -> likewise of a function: repeats -> rows
    commands: Mapping[str, Command] = field(default_factory=dict)

    def profile(self, name: str) -> Config:
        """The configuration of a profile. Raises `BadInput` for an unknown one."""
        profiles = self.load(self.profiles, Mapping)
        if name not in profiles:
            raise BadInput(
                f"method {self.name!r}: unknown profile {name!r}: {registry.nearest(name, list(profiles))}"
            )
        config = profiles[name]
        if isinstance(config, type) or not is_dataclass(config):
            raise BadInput(
                f"method {self.name!r}: profile {name!r} is {config!r:.60}, expected a dataclass's instance"
            )
        return config

    def create(self, config: Config) -> Method:
        return self.load(self.method)(config)

    def omissions(self, config: Config, scene: SceneMeasure) -> list[Omission]:
        """What this scene does not need of this configuration."""
        return [] if self.leave_out is None else self.load(self.leave_out)(config, scene)

    def outside(self, config: Config) -> Sequence[Path]:
        """Files and folders beside the package whose content moves numbers."""
        return () if self.outside_files is None else self.load(self.outside_files)(config)

    def load(self, part: Any, kind: Any = Callable, of: type = object) -> Any:
        """What `ablations`, `stress`, a kernel or a command's `main` names; an object as it is. Raises `BadInput`,
        for one of another kind or with something in it that is none `of` these, too."""
        loaded = part
        if isinstance(part, str):
            module, _, attribute = part.partition(":")
            try:
                loaded = getattr(import_module(module), attribute)
            except (Exception, SystemExit) as error:
                reason = " ".join(f"{error if isinstance(error, ImportError) else repr(error)}".split())
                raise BadInput(f"method {self.name!r}: {part} cannot be loaded: {reason}") from error
        if not isinstance(loaded, kind):
            raise BadInput(
                f"method {self.name!r}: {part!r:.60} is {loaded!r:.60}, expected a {kind.__name__.lower()}"
            )
        for item in () if of is object else loaded.values() if isinstance(loaded, Mapping) else loaded:
            if not isinstance(item, of):
                raise BadInput(f"method {self.name!r}: {part!r:.60} has {item!r:.60} in it, expected {of.__name__}s")
        return loaded


KINDS = {  # field of a spec -> what it must be: a package that got it wrong must not take `ihbench --help` along
    **dict.fromkeys(("title", "summary", "licence", "implemented", "footnote"), str),
    "profiles": (str, Mapping), "paper": (Paper, type(None)), "needs": (tuple, list),
    "shared_states": Mapping, "ablations": (str, Mapping), "stress": (str, list, tuple),
    "kernels": Mapping, "commands": Mapping,
}  # fmt: skip


def method_spec(name: str) -> MethodSpec:
    """A registered method. Raises `BadInput` for an unknown name, and for an entry point that is no spec of it."""
    spec = registry.load("method", name)
    where = f"method {name!r}: {registry.entry_point('method', name).value}"
    if not isinstance(spec, MethodSpec):
        known = ", ".join(f.name for f in fields(MethodSpec))
        raise BadInput(f"{where} is {spec!r:.60}, expected an ihbench.scene.method_spec.MethodSpec({known})")
    if spec.name != name:
        raise BadInput(f"{where} calls itself {spec.name!r}; its entry point and its spec must have one name")
    for what, kind in KINDS.items():
        if not isinstance(value := getattr(spec, what), kind):
            raise BadInput(f"{where} has the {what} {value!r:.60}; see ihbench.scene.method_spec for what it must be")
    for command, brought in spec.commands.items():
        if not isinstance(brought, Command):
            raise BadInput(f"{where}: command {command!r} is {brought!r:.60}, expected a Command(summary, main)")
    package = registry.entry_point("method", name).module.partition(".")[0]
    for part in (spec.method, spec.profiles):  # a run records the code of the package that registers the method
        if isinstance(part, str) and part.partition(":")[0].partition(".")[0] not in (package, "ihbench"):
            raise BadInput(f"{where} names {part}, expected something of its own package {package!r} or of ihbench")
    return spec


def usable_specs() -> list[MethodSpec]:
    """Every registered method that can be used; `ihbench list` says what is wrong with the others."""
    specs = []
    for name in registry.names("method"):
        try:
            specs.append(method_spec(name))
        except BadInput:
            continue
    return specs
