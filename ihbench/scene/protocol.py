"""Protocols: every choice that moves a number, as a versioned file.

A protocol is a TOML file registered under the entry-point group `ihbench.protocols`; the dataclasses here mirror it,
key by key. This module reads it, checks it and answers what a run needs to know. Nothing here imports torch or cv2.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from ihbench import registry
from ihbench.config_fields import (
    IMAGE_SIZES,
    Entries,
    Name,
    Text,
    Values,
    Within,
    as_table,
    flat,
    hints,
    read,
    refuse_repeated,
    replaced,
    whole,
)
from ihbench.errors import BadInput
from ihbench.files.atomic import Json
from ihbench.files.regular import read_toml

Region = Literal["full", "box", "body", "visible", "hidden", "never_seen"]
REGIONS: tuple[str, ...] = get_args(Region)
PROFILES = ("paper", "quick")  # every protocol has both
Resampling = Literal["nearest", "linear", "area", "lanczos4"]
Frame = Annotated[int, Within(0, 10_000_000)]
Camera = Annotated[int, Within(0, 10_000)]
Step = Annotated[int, Within(1, 10_000_000)]
Share = Annotated[float, Within(0, 1)]
Column = Annotated[int, Within(0, 65_536)]
Width = Annotated[int, Within(1, 65_536)]

SHORT = {
    "train.frames": "train",
    "test.frames": "test",
    "image.size": "size",
}  # what a version calls a change of them
OCCLUSION = {"occlusion.rule": "", "occlusion.fraction": "fraction=", "occlusion.covers.fraction": "covers="}
ALWAYS_SHOWN = {"train.frames", "test.frames", *OCCLUSION}  # in a version, even where the protocol has that value
LONGEST_CHANGE = 60  # characters of a value in a version; a digest stands for longer ones


@dataclass(frozen=True)
class Span:
    """start, stop, step of frames; `stop` may be the name of a per-subject limit. Raises `ValueError` for none."""

    start: Frame
    stop: Frame | Literal["max_frames"]
    step: Step

    def __post_init__(self) -> None:
        if self.start < 0 or self.step < 1 or (isinstance(self.stop, int) and self.stop <= self.start):
            raise ValueError(
                f"is {self.start}:{self.stop}:{self.step}, expected start >= 0, a stop above the start (or "
                '"max_frames"), step >= 1'
            )

    @classmethod
    def parse(cls, text: str) -> Span:
        """A span from "0:500:5", "0::2" or "100:"."""
        parts = text.split(":")
        try:
            start, stop, step = (whole(part) if part else None for part in [*parts, "", ""][:3])
        except ValueError:
            start = stop = step = -1
        if len(parts) not in (2, 3) or (start or 0) < 0 or (step is not None and step < 1):
            raise ValueError("expected START:STOP:STEP with numbers from 0, for example 0:500:5")
        if stop is not None and stop <= (start or 0):
            raise ValueError("expected a stop above the start")
        return cls(start or 0, "max_frames" if stop is None else stop, step or 1)

    def indices(self, limit: int) -> range:
        """The indices below both `stop` (or `limit`, where stop is a name) and nothing else."""
        stop = self.stop if isinstance(self.stop, int) else limit
        return range(self.start, stop, self.step)

    def below(self, limit: int) -> range:
        """The indices that are below `limit`, too."""
        return range(self.start, min(self.indices(limit).stop, limit), self.step)


@dataclass(frozen=True)
class Cameras(Span):
    """start, stop, step of camera indices."""

    start: Camera
    stop: Camera | Literal["max_frames"]
    step: Step


@dataclass(frozen=True)
class TestCameras(Cameras):
    __test__ = False
    HAS_TEXT: ClassVar[bool] = False

    start: Camera
    """Index of the first test camera."""
    stop: Camera | Literal["max_frames"]
    """Index after the last."""
    step: Step
    """Every so many."""
    except_train: bool
    """Leave the training camera out."""


@dataclass(frozen=True)
class OwnFrames:
    """A subject's own training and test frames: start, stop, step."""

    train: tuple[Frame, Frame, Frame]
    test: tuple[Frame, Frame, Frame]

    def __post_init__(self) -> None:
        for own in (self.train, self.test):
            Span(*own)

    @classmethod
    def parse(cls, text: str) -> OwnFrames:
        """From "0:500:5,500:617:10"."""
        spans = [Span.parse(part) for part in text.split(",")]
        if len(spans) != 2 or any(span.stop == "max_frames" for span in spans):
            raise ValueError("expected training and test frames, for example 0:500:5,500:617:10")
        train, test = ((span.start, int(span.stop), span.step) for span in spans)
        return cls(train, test)


@dataclass(frozen=True, kw_only=True)
class Subjects:
    names: tuple[Name, ...]
    """Subjects of the real data set."""
    standin: tuple[Name, ...]
    """Subjects of the stand-in."""
    silhouette: Name
    """Which mask files are the person, such as mask, mask_cihp or union."""
    max_frames: Mapping[Name, Step] | None = None
    """Subject and how many raw frames of it are kept, for some of them."""
    spans: Mapping[Name, OwnFrames] | None = None
    """Subject and its own training and test frames, START:STOP:STEP,START:STOP:STEP, for some of them."""


@dataclass(frozen=True, kw_only=True)
class Train:
    camera: Camera
    """Index of the training camera."""
    frames: Span
    """Training frames, START:STOP:STEP; subjects' own (subjects.spans) give way to them."""


@dataclass(frozen=True, kw_only=True)
class Test:
    __test__ = False

    cameras: TestCameras
    frames: Span
    """Test frames, START:STOP:STEP; subjects' own (subjects.spans) give way to them."""
    pose: Literal["given"] | None = None
    """Body poses of test views are given, never refined."""


@dataclass(frozen=True)
class TestGroup:
    """Further test views, scored apart from the protocol's own."""

    __test__ = False
    name: Name  # what a table calls it, for example "train = test"
    cameras: Cameras
    frames: Span

    @classmethod
    def parse(cls, text: str) -> TestGroup:
        """From "train = test,0:1,0:100:2"."""
        name, *spans = text.rsplit(",", 2)
        if len(spans) != 2:
            raise ValueError('expected NAME,CAMERAS,FRAMES, for example "train = test,0:1,0:100:2"')
        cameras, frames = Span.parse(spans[0]), Span.parse(spans[1])
        return cls(name, Cameras(cameras.start, cameras.stop, cameras.step), frames)


@dataclass(frozen=True, kw_only=True)
class Covers:
    fraction: Share
    """Share of the training frames that are covered."""
    of: Literal["sampled", "raw"]
    """Share of the frames trained on, or of all frames kept."""


@dataclass(frozen=True, kw_only=True)
class OcclusionRule:
    rule: Name
    """Which pixels are hidden: a registered occlusion rule."""
    unlisted: Name
    """Rule for subjects without a published strip."""
    fraction: Share
    """Share of the person that the rule aims to hide in covered frames."""
    reference_width: Width
    """Image width that strips refer to, px."""
    covers: Covers
    strips: Mapping[Name, tuple[Column, Column]] | None = None
    """Subject, middle and width of its published strip, columns of the original image, px."""
    seed: Annotated[int, Within(0, 2**63 - 1)] | None = None
    """Of rules that draw something; none is 0."""
    in_scene: bool = False
    """The occluder stands in the scene: all frames are covered, test images are occluded, too. The rule says it."""

    def of(self, subject: str) -> str:
        """The rule for one subject."""
        return self.unlisted if self.rule == "fixed-strip" and subject not in (self.strips or {}) else self.rule

    def settled(self) -> OcclusionRule:
        """The same with `in_scene` where the rule says so: it changes what the numbers mean. Raises `ValueError`."""
        rules = {self.rule, *([self.unlisted] if self.rule == "fixed-strip" else [])}
        standing = {rule for rule in rules if _trait(rule, "in_scene", False)}
        if standing and standing != rules:
            raise ValueError(
                f"occlusion.unlisted is {self.unlisted!r}, whose occluder stands in the scene, but "
                f"that of {self.rule!r} is drawn; expected one kind in a protocol"
            )
        if not standing and self.in_scene:
            raise ValueError(f"occlusion.in_scene is true, but rule {self.rule!r} draws its occluder")
        if standing and self.covers.fraction != 1:
            raise ValueError(
                f"occlusion.covers.fraction is {self.covers.fraction}, but the occluder of rule "
                f"{self.rule!r} stands in the scene and covers every frame; expected 1.0"
            )
        return replace(self, in_scene=bool(standing))


@dataclass(frozen=True, kw_only=True)
class ImageRule:
    size: Annotated[int, Within(*IMAGE_SIZES)]
    """Longer side of training and test images, px; the aspect is the original's."""
    background: tuple[Share, Share, Share]
    """Colour that stands in for the background, RGB from 0 to 1."""
    undistort: bool
    """Take the lens's distortion out of the images."""
    edge: Literal["hard", "soft"]
    """The silhouette after undistortion."""
    resample_image: Resampling
    """How images are shrunk."""
    resample_mask: Resampling
    """How masks are shrunk."""
    to_8bit: Literal["truncate", "round"]
    """How values become 8 bit."""

    def extent(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) px of the protocol's image of an original of this width and height."""
        scale = self.size / max(width, height)
        return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True, kw_only=True)
class Metrics:
    presets: Annotated[tuple[Name, ...], Entries(1)]
    """Metric presets (`ihbench list presets`)."""
    regions: Annotated[tuple[Region, ...], Entries(1)]
    """Regions that get numbers."""
    headline: Region
    """The region of the headline table."""
    box_padding: Annotated[float, Within(0, 100)]
    """Around the projected body's box, m."""

    def __post_init__(self) -> None:
        if self.headline not in self.regions:
            raise ValueError(f"headline is {self.headline!r}, expected one of {', '.join(self.regions)}")


@dataclass(frozen=True, kw_only=True)
class ProtocolFile:
    """What a protocol file says under one profile; raises `ValueError` where it contradicts itself."""

    id: Name
    version: Name
    title: Text
    reason: Text
    source: Text
    dataset: Name
    """The registered data set (`ihbench list datasets`)."""
    subjects: Subjects
    train: Train
    test: Test
    also: tuple[TestGroup, ...] | None = None
    """Further test views, scored apart: NAME,CAMERAS,FRAMES."""
    occlusion: OcclusionRule
    image: ImageRule
    metrics: Metrics

    def __post_init__(self) -> None:
        if self.occlusion.in_scene and self.metrics.headline in ("full", "box"):
            raise ValueError(
                f"metrics.headline is {self.metrics.headline!r}, which has no number where the occluder stands in "
                "test images; expected another region, for example body"
            )
        refuse_repeated(self.subjects.names, "subjects.names")
        refuse_repeated(self.subjects.standin, "subjects.standin")
        refuse_repeated(self.metrics.presets, "metrics.presets")
        refuse_repeated(self.metrics.regions, "metrics.regions")
        refuse_repeated([group.name for group in self.also or ()], "also")


WORDS = ("title", "reason", "source")  # for readers: no choices
CHOICES = {  # name -> type of what can be changed; test.pose has one value, occlusion.in_scene is its rule's to say
    name: hint
    for name, hint in hints(ProtocolFile).items()
    if name not in (*WORDS, "id", "version", "test.pose", "occlusion.in_scene")
}


@dataclass(frozen=True, kw_only=True)
class Protocol(ProtocolFile):
    """One protocol under one profile, checked."""

    profile: str
    changed: str = ""  # what `with_fields` changed, in words that stand behind the version

    @property
    def name(self) -> str:
        return f"{self.id}@{self.version}{self.changed}"

    @property
    def content(self) -> dict[str, Json]:
        """The merged file, as TOML and JSON have it."""
        return as_table(self, ProtocolFile)

    @property
    def digest(self) -> str:
        """16 hex digits over every choice; two protocols with one digest mean the same numbers."""
        choices = {k: v for k, v in self.content.items() if k not in WORDS}
        return hashlib.sha256(json.dumps(choices, sort_keys=True).encode()).hexdigest()[:16]

    def with_fields(self, values: Mapping[str, Any], flags: Mapping[str, str] | None = None) -> Protocol:
        """The same protocol with other choices, named as `flat` names them ("image.size"); its digest differs, so
        numbers never mix.

        Spans may be texts, "START:STOP:STEP" as in a Python slice; frames that are both trained on and tested stay in
        both: the caller's choice. `occlusion.fraction` is what the rule aims at; published strips have none: asked
        for one, `fixed-strip` becomes the rule for subjects without a strip. An occluder that stands in the scene
        covers every frame. `flags` says what errors call a choice. Raises `BadInput` for values that a protocol, or
        its rule, cannot have.
        """
        called = {name: (flags or {}).get(name, f"--protocol.{name.replace('_', '-')}") for name in values}
        new: Values = {}
        for name, value in values.items():
            if name not in CHOICES:
                raise BadInput(f"{called[name]}: no choice of a protocol: {registry.nearest(name, list(CHOICES))}")
            present = reduce(getattr, name.split("."), self)
            value = _as_real(read(CHOICES[name], value, "", called[name]), present)
            if name in ALWAYS_SHOWN or value != present:
                new[name] = value
        shown = {name: values[name] if name in SHORT else value for name, value in new.items()}
        if "train.frames" in new or "test.frames" in new:
            new.setdefault("subjects.spans", None)
        if any(name.startswith("occlusion.") for name in new):
            new |= self._occlusion(new, shown, called)
        if not shown:
            return self
        version = _in_version(shown)
        try:
            changed = replaced(self, new)
            return replace(changed, occlusion=changed.occlusion.settled(), changed=self.changed + version)
        except ValueError as error:
            raise BadInput(f"protocol {self.name}{version}: {error}") from error

    def _occlusion(self, new: Values, shown: Values, called: Mapping[str, str]) -> Values:
        """What follows from a changed occlusion; `shown` gets what of it the version shall say."""
        rule, fraction, covers = (new.get(name) for name in OCCLUSION)
        out: Values = {}
        if fraction is not None and rule is None and self.occlusion.rule == "fixed-strip":
            rule = shown["occlusion.rule"] = self.occlusion.unlisted
        if rule is not None:
            registry.entry_point("occlusion", rule)
            out = {"occlusion.rule": rule} | ({} if "occlusion.unlisted" in new else {"occlusion.unlisted": rule})
        rule = rule or self.occlusion.rule
        if fraction is not None and not _trait(rule, "takes_fraction", True):
            raise BadInput(
                f"{called['occlusion.fraction']} {fraction:g}: rule {rule!r} hides what it hides, whatever the "
                "fraction; leave it out, or name another --occlusion.rule"
            )
        standing = _trait(rule, "in_scene", False)
        if standing and covers not in (None, 1):
            raise BadInput(
                f"{called['occlusion.covers.fraction']} {covers:g}: the occluder of rule {rule!r} stands in the "
                "scene and covers every frame; leave it out, or name a rule that draws an occluder"
            )
        if standing:
            shown.pop("occlusion.covers.fraction", None)
            out["occlusion.covers.fraction"] = 1.0
        return out | {"occlusion.in_scene": standing}

    def check_views(self, subject: str, n_frames: int, n_cameras: int, where: str) -> None:
        """Raise `BadInput` where a capture of so many frames and cameras does not have the views that are asked for.

        `where` names the capture. To be called before anything lists, reads or writes them: a span may have any size.
        """
        limit = self._limit(subject, n_frames)
        cameras = self.testing_cameras(n_cameras)
        groups = [group for group in self.also or () if group.cameras.below(n_cameras)]
        train, test = self._spans_of(subject)
        spans = {"training": train, **({"test": test} if cameras else {})}
        spans |= {f"test ({group.name})": group.frames for group in groups}
        for what, span in spans.items():
            frames = span.indices(limit)
            if not frames:
                raise BadInput(f"{where}: {self.name} selects no {what} frame of its {n_frames}")
            if frames[-1] >= n_frames:
                raise BadInput(
                    f"{where}: has {n_frames} frames, {self.name} needs frame {frames[-1]} ({what}); use a complete "
                    "copy, another protocol, or other --train-frames and --test-frames"
                )
        if self.train.camera >= n_cameras:
            raise BadInput(f"{where}: has {n_cameras} cameras, training needs camera index {self.train.camera}")
        if not cameras and not groups:
            raise BadInput(f"{where}: {self.name} leaves no test view ({n_cameras} cameras)")

    def _limit(self, subject: str, n_frames: int) -> int:
        return (self.subjects.max_frames or {}).get(subject, n_frames)

    def _spans_of(self, subject: str) -> tuple[Span, Span]:
        own = (self.subjects.spans or {}).get(subject)
        return (self.train.frames, self.test.frames) if own is None else (Span(*own.train), Span(*own.test))

    def training_frames(self, subject: str, n_frames: int) -> list[int]:
        """Raw frame numbers of the training images."""
        return list(self._spans_of(subject)[0].indices(self._limit(subject, n_frames)))

    def covered(self, subject: str, frames: list[int], n_frames: int) -> list[bool]:
        """For each training frame, whether the occluder covers it.

        `of = "sampled"`: the first share of the sampled frames (OccFusion). `of = "raw"`: raw frame numbers below
        that share of all kept frames (OccNeRF).
        """
        covers = self.occlusion.covers
        if covers.of == "sampled":
            return [k < covers.fraction * len(frames) for k in range(len(frames))]
        stop = int(covers.fraction * self._limit(subject, n_frames))
        return [frame < stop for frame in frames]

    def testing_cameras(self, n_cameras: int) -> list[int]:
        """Camera indices of the test views. The training camera is left out where the protocol says so."""
        cameras = self.test.cameras
        return [c for c in cameras.below(n_cameras) if not (cameras.except_train and c == self.train.camera)]

    def testing_frames(self, subject: str, n_frames: int) -> list[int]:
        return list(self._spans_of(subject)[1].indices(self._limit(subject, n_frames)))

    def test_views(self, subject: str, n_frames: int, n_cameras: int) -> list[tuple[int, int, str]]:
        """(camera, frame, group) of every test view, in order; the group of the protocol's own is ""."""
        views = [
            (camera, frame, "")
            for camera in self.testing_cameras(n_cameras)
            for frame in self.testing_frames(subject, n_frames)
        ]
        limit = self._limit(subject, n_frames)
        for group in self.also or ():
            cameras = group.cameras.below(n_cameras)
            views += [(camera, frame, group.name) for camera in cameras for frame in group.frames.indices(limit)]
        return views


def load_protocol(name: str, profile: str = "quick") -> Protocol:
    """Read a registered protocol, or a TOML file of your own, under a profile.

    Raises `BadInput` for unknown names and malformed files.
    """
    if name.endswith(".toml"):
        return read_protocol(Path(name), profile)
    point = registry.entry_point("protocol", name)
    return read_protocol(registry.package_folder("protocol", name) / point.attr, profile)


def read_protocol(path: Path, profile: str = "quick") -> Protocol:
    """Read a protocol file. Raises `BadInput` naming the file and the key."""
    content, where = read_toml(path, "a protocol file"), f"protocol file {path}"
    profiles = content.pop("profile", {})
    if not isinstance(profiles, dict) or not all(isinstance(own, dict) for own in profiles.values()):
        raise BadInput(f"{where}: profile: expected the tables {', '.join(PROFILES)}")
    if profile not in profiles:
        raise BadInput(f"{where}: unknown profile {profile!r}: {registry.nearest(profile, list(profiles))}")
    _merge(content, profiles[profile], where)
    file = read(ProtocolFile, content, where)
    try:
        return _under(replace(file, occlusion=file.occlusion.settled()), profile)
    except (ValueError, BadInput) as error:
        raise BadInput(f"{where}: {error}") from error


def protocol_from(content: Mapping[str, Any], profile: str, version: str) -> Protocol:
    """The protocol of a run's record, without keys of other versions. Raises `BadInput` where there is none."""
    file = read(ProtocolFile, content, "recorded protocol", strict=False)
    return replace(_under(file, profile), changed=version.removeprefix(file.version))


def _under(file: ProtocolFile, profile: str) -> Protocol:
    return Protocol(**{field.name: getattr(file, field.name) for field in fields(file)}, profile=profile)


def _merge(base: dict[str, Json], override: Mapping[str, Json], where: str, prefix: str = "") -> None:
    for key, value in override.items():
        if key not in base:
            raise BadInput(f"{where}: a profile sets {prefix + key!r}, which the protocol does not have")
        own = base[key]
        if isinstance(value, dict) and isinstance(own, dict):
            _merge(own, value, where, f"{prefix}{key}.")
        else:
            base[key] = value


def _trait(rule: str, name: str, default: bool) -> bool:
    """What a registered occlusion rule says of itself; see `ihbench.scene.occlusion.occluder`."""
    return bool(getattr(registry.load("occlusion", rule), name, default))


def _in_version(shown: Mapping[str, Any]) -> str:
    """Changed choices as they stand behind a version: "+size=128+image.edge=soft+occlusion=blocks,fraction=0.3"."""
    parts = [f"+{SHORT.get(name, name)}={_words(shown[name])}" for name in (*SHORT, *shown) if name in shown]
    occlusion = [f"{word}{_words(shown[name])}" for name, word in OCCLUSION.items() if name in shown]
    parts = [part for part in dict.fromkeys(parts) if part[1:].partition("=")[0] not in OCCLUSION]
    return "".join(parts) + (f"+occlusion={','.join(occlusion)}" if occlusion else "")


def _as_real(value: Any, present: Any) -> Any:
    """Whole numbers as real ones where the protocol has real ones."""
    if isinstance(present, tuple) and present:
        return tuple(_as_real(item, present[0]) for item in value)
    return float(value) if isinstance(present, float) else value


def _words(value: Any) -> str:
    """A value in a version: short, and the same for the same value."""
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple) and all(isinstance(item, str | float) for item in value):
        value = ",".join(map(_words, value))
    text = value if isinstance(value, str) else json.dumps(as_table(value), separators=(",", ":"))
    return text if len(text) <= LONGEST_CHANGE else hashlib.sha256(text.encode()).hexdigest()[:16]


def spelled(content: Mapping[str, Any]) -> dict[str, str]:
    """Name -> value as JSON, in file order, of a protocol's content."""
    return {name: json.dumps(value, ensure_ascii=False) for name, value in flat(content).items()}


def difference(a: Protocol, b: Protocol) -> list[tuple[str, str, str]]:
    """(key, value in a, value in b) wherever two protocols differ; a value that one lacks is empty."""
    left, right = spelled(a.content), spelled(b.content)
    keys = list(left) + [key for key in right if key not in left]
    return [(k, left.get(k, ""), right.get(k, "")) for k in keys if left.get(k) != right.get(k)]
