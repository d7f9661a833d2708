"""Protocols: every choice that moves a number, as a versioned file.

A protocol is a TOML file registered under the entry-point group `ihbench.protocols`. This module reads it, checks it
and answers what a run needs to know. Nothing here imports torch or cv2.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ihbench import registry
from ihbench.bounds import whole
from ihbench.errors import BadInput
from ihbench.files.regular import read_toml
from ihbench.scene.protocol_shape import check_protocol

REGIONS = ("full", "box", "body", "visible", "hidden", "never_seen")
PROFILES = ("paper", "quick")  # every protocol has both
RESAMPLING = ("nearest", "linear", "area", "lanczos4")


@dataclass(frozen=True)
class Span:
    """start, stop, step of frames or cameras; `stop` may be the name of a per-subject limit."""

    start: int
    stop: int | str
    step: int

    def indices(self, limit: int) -> range:
        """The indices below both `stop` (or `limit`, where stop is a name) and nothing else."""
        stop = self.stop if isinstance(self.stop, int) else limit
        return range(self.start, stop, self.step)

    def below(self, limit: int) -> range:
        """The indices that are below `limit`, too."""
        return range(self.start, min(self.indices(limit).stop, limit), self.step)


@dataclass(frozen=True)
class ImageRule:
    size: int  # px, the longer side; the aspect is the original's
    background: tuple[float, float, float]
    undistort: bool
    edge: str  # hard | soft
    resample_image: str
    resample_mask: str
    to_8bit: str  # truncate | round

    def extent(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) px of the protocol's image of an original of this width and height."""
        scale = self.size / max(width, height)
        return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class OcclusionRule:
    rule: str
    unlisted: str  # rule for subjects without a strip of their own
    fraction: float
    reference_width: int
    covers_fraction: float
    covers_of: str  # sampled | raw
    strips: dict[str, tuple[int, int]]  # subject -> (mid, width)
    seed: int = 0  # of rules that draw something
    in_scene: bool = False  # the occluder stands in the scene: all frames are covered, test images are occluded, too

    def of(self, subject: str) -> str:
        """The rule for one subject."""
        return self.unlisted if self.rule == "fixed-strip" and subject not in self.strips else self.rule


@dataclass(frozen=True)
class TestGroup:
    """Further test views, scored apart from the protocol's own."""

    __test__ = False

    name: str  # what a table calls it, for example "train = test"
    cameras: Span
    frames: Span


@dataclass(frozen=True)
class Protocol:
    """One protocol under one profile, checked. `content` is the merged file, `digest` its hash."""

    id: str
    version: str
    profile: str
    title: str
    reason: str
    source: str
    dataset: str
    subjects: tuple[str, ...]
    standin_subjects: tuple[str, ...]
    silhouette: str
    max_frames: dict[str, int]
    train_camera: int
    train_frames: Span
    test_cameras: Span
    test_except_train: bool
    test_frames: Span
    spans: dict[str, tuple[Span, Span]]  # subject -> training and test frames, where they are its own
    also: tuple[TestGroup, ...]
    occlusion: OcclusionRule
    image: ImageRule
    regions: tuple[str, ...]
    headline: str
    presets: tuple[str, ...]
    box_padding: float  # m
    content: dict[str, Any]

    @property
    def name(self) -> str:
        return f"{self.id}@{self.version}"

    @property
    def digest(self) -> str:
        """16 hex digits over every choice; two protocols with one digest mean the same numbers."""
        words = {k: v for k, v in self.content.items() if k not in ("title", "reason", "source")}
        return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:16]

    def with_occlusion(
        self, rule: str | None = None, fraction: float | None = None, covers: float | None = None
    ) -> Protocol:
        """The same protocol under another occlusion; its digest differs, so numbers never mix.

        `fraction` is what the rule aims at, `covers` the share of the training frames that are covered. Published
        strips have no fraction: asked for one, `fixed-strip` becomes the rule for subjects without a strip. An
        occluder that stands in the scene covers every frame. Raises `BadInput` for shares outside [0, 1], and for
        those that the rule does not have.
        """
        for name, share in (("fraction", fraction), ("covers", covers)):
            if share is not None and not 0 <= share <= 1:
                raise BadInput(f"--occlusion.{name} {share:g}: expected a share from 0 to 1")
        occlusion = {key: value for key, value in self.content["occlusion"].items() if key != "in_scene"}
        if fraction is not None and rule is None and occlusion["rule"] == "fixed-strip":
            rule = occlusion["unlisted"]
        if rule is not None:
            occlusion |= {"rule": rule, "unlisted": rule}
        if fraction is not None and not _trait(occlusion["rule"], "takes_fraction", True):
            raise BadInput(
                f"--occlusion.fraction {fraction:g}: rule {occlusion['rule']!r} hides what it hides, whatever the "
                "fraction; leave it out, or name another --occlusion.rule"
            )
        if _trait(occlusion["rule"], "in_scene", False):
            if covers not in (None, 1):
                raise BadInput(
                    f"--occlusion.covers {covers:g}: the occluder of rule {occlusion['rule']!r} stands in the scene "
                    "and covers every frame; leave it out, or name a rule that draws an occluder"
                )
            occlusion["covers"], covers = {**occlusion["covers"], "fraction": 1.0}, None
        if fraction is not None:
            occlusion["fraction"] = float(fraction)
        if covers is not None:
            occlusion["covers"] = {**occlusion["covers"], "fraction": float(covers)}
        changed = {"rule": rule, "fraction": fraction, "covers": covers}
        told = ",".join(
            str(value) if key == "rule" else f"{key}={value:g}" for key, value in changed.items() if value is not None
        )
        if not told:
            return self
        try:
            replaced = _build({**self.content, "occlusion": _settled(occlusion)}, self.profile)
        except ValueError as error:
            raise BadInput(f"--occlusion.rule {rule}: {error}") from error
        return replace(replaced, version=f"{self.version}+occlusion={told}")

    def with_frames(self, train: str | None = None, test: str | None = None) -> Protocol:
        """The same protocol with other frames, each "START:STOP:STEP" as in a Python slice; its digest differs.

        Frames that are both trained on and tested stay in both: the caller's choice. Raises `BadInput` for anything
        else than such a slice.
        """
        content, version = {**self.content}, self.version
        for part, text in (("train", train), ("test", test)):
            if text is not None:
                content[part] = {**content[part], "frames": _slice(text, f"--{part}-frames")}
                version += f"+{part}={text}"
        if version == self.version:
            return self
        content["subjects"] = {k: v for k, v in content["subjects"].items() if k != "spans"}
        return replace(_build(content, self.profile), version=version)

    def with_size(self, size: int | None) -> Protocol:
        """The same protocol with images of another size (px, the longer side); its digest differs.

        Raises `BadInput` for a size outside 8 to 8192.
        """
        if size is None or size == self.image.size:
            return self
        if not 8 <= size <= 8192:
            raise BadInput(f"--image-size {size}: expected 8 to 8192 px")
        replaced = _build({**self.content, "image": {**self.content["image"], "size": size}}, self.profile)
        return replace(replaced, version=f"{self.version}+size={size}")

    def check_views(self, subject: str, n_frames: int, n_cameras: int, where: str) -> None:
        """Raise `BadInput` where a capture of so many frames and cameras does not have the views that are asked for.

        `where` names the capture. To be called before anything lists, reads or writes them: a span may have any size.
        """
        limit = self.max_frames.get(subject, n_frames)
        cameras = self.testing_cameras(n_cameras)
        groups = [group for group in self.also if group.cameras.below(n_cameras)]
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
        if self.train_camera >= n_cameras:
            raise BadInput(f"{where}: has {n_cameras} cameras, training needs camera index {self.train_camera}")
        if not cameras and not groups:
            raise BadInput(f"{where}: {self.name} leaves no test view ({n_cameras} cameras)")

    def _spans_of(self, subject: str) -> tuple[Span, Span]:
        return self.spans.get(subject, (self.train_frames, self.test_frames))

    def training_frames(self, subject: str, n_frames: int) -> list[int]:
        """Raw frame numbers of the training images."""
        return list(self._spans_of(subject)[0].indices(self.max_frames.get(subject, n_frames)))

    def covered(self, subject: str, frames: list[int], n_frames: int) -> list[bool]:
        """For each training frame, whether the occluder covers it.

        `of = "sampled"`: the first share of the sampled frames (OccFusion). `of = "raw"`: raw frame numbers below
        that share of all kept frames (OccNeRF).
        """
        share = self.occlusion.covers_fraction
        if self.occlusion.covers_of == "sampled":
            return [k < share * len(frames) for k in range(len(frames))]
        stop = int(share * self.max_frames.get(subject, n_frames))
        return [frame < stop for frame in frames]

    def testing_cameras(self, n_cameras: int) -> list[int]:
        """Camera indices of the test views. The training camera is left out where the protocol says so."""
        cameras = self.test_cameras.below(n_cameras)
        return [c for c in cameras if not (self.test_except_train and c == self.train_camera)]

    def testing_frames(self, subject: str, n_frames: int) -> list[int]:
        return list(self._spans_of(subject)[1].indices(self.max_frames.get(subject, n_frames)))

    def test_views(self, subject: str, n_frames: int, n_cameras: int) -> list[tuple[int, int, str]]:
        """(camera, frame, group) of every test view, in order; the group of the protocol's own is ""."""
        views = [
            (camera, frame, "")
            for camera in self.testing_cameras(n_cameras)
            for frame in self.testing_frames(subject, n_frames)
        ]
        limit = self.max_frames.get(subject, n_frames)
        for group in self.also:
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
    content = read_toml(path, "a protocol file")
    profiles = content.pop("profile", {})
    if not isinstance(profiles, dict) or not all(isinstance(own, dict) for own in profiles.values()):
        raise BadInput(f"protocol file {path}: profile: expected the tables {', '.join(PROFILES)}")
    if profile not in profiles:
        raise BadInput(
            f"protocol file {path}: unknown profile {profile!r}: {registry.nearest(profile, list(profiles))}"
        )
    _merge(content, profiles[profile], path)
    check_protocol(content, f"protocol file {path}")
    try:
        return _build({**content, "occlusion": _settled(content["occlusion"])}, profile)
    except (ValueError, BadInput) as error:
        raise BadInput(f"protocol file {path}: {error}") from error


def protocol_from(content: dict[str, Any], profile: str, version: str) -> Protocol:
    """The protocol of a run's record. Raises `BadInput` when the record holds none."""
    check_protocol(content, "recorded protocol", strict=False)
    try:
        return replace(_build(content, profile), version=version)
    except ValueError as error:
        raise BadInput(f"recorded protocol: {error}") from error


def _merge(base: dict[str, Any], override: dict[str, Any], path: Path, prefix: str = "") -> None:
    for key, value in override.items():
        if key not in base:
            raise BadInput(f"protocol file {path}: a profile sets {prefix + key!r}, which the protocol does not have")
        if isinstance(value, dict) and isinstance(base[key], dict):
            _merge(base[key], value, path, f"{prefix}{key}.")
        else:
            base[key] = value


def _one_of(value: str, known: tuple[str, ...], what: str) -> str:
    if value not in known:
        raise ValueError(f"{what} is {value!r}, expected one of {', '.join(known)}")
    return value


def _trait(rule: str, name: str, default: bool) -> bool:
    """What a registered occlusion rule says of itself; see `ihbench.scene.occlusion.occluder`."""
    return bool(getattr(registry.load("occlusion", rule), name, default))


def _settled(occlusion: dict[str, Any]) -> dict[str, Any]:
    """The occlusion's table with `in_scene = true` where the rule says so: it changes what the numbers mean."""
    rules = {occlusion["rule"], *([occlusion["unlisted"]] if occlusion["rule"] == "fixed-strip" else [])}
    standing = {rule for rule in rules if _trait(rule, "in_scene", False)}
    settled = {key: value for key, value in occlusion.items() if key != "in_scene"}
    if standing and standing != rules:
        raise ValueError(
            f"occlusion.unlisted is {occlusion['unlisted']!r}, whose occluder stands in the scene, but "
            f"that of {occlusion['rule']!r} is drawn; expected one kind in a protocol"
        )
    if not standing:
        if occlusion.get("in_scene"):
            raise ValueError(f"occlusion.in_scene is true, but rule {occlusion['rule']!r} draws its occluder")
        return settled
    if occlusion["covers"]["fraction"] != 1:
        raise ValueError(
            f"occlusion.covers.fraction is {occlusion['covers']['fraction']}, but the occluder of rule "
            f"{occlusion['rule']!r} stands in the scene and covers every frame; expected 1.0"
        )
    return settled | {"in_scene": True}


def _slice(text: str, flag: str) -> dict[str, Any]:
    """A span's table from "0:500:5", "0::2" or "100:"."""
    parts = text.split(":")
    try:
        start, stop, step = (whole(part) if part else None for part in [*parts, "", ""][:3])
    except ValueError:
        start = stop = step = -1
    if len(parts) not in (2, 3) or (start or 0) < 0 or (step is not None and step < 1):
        raise BadInput(f"{flag} {text}: expected START:STOP:STEP with numbers from 0, for example 0:500:5")
    if stop is not None and stop <= (start or 0):
        raise BadInput(f"{flag} {text}: expected a stop above the start")
    return {"start": start or 0, "stop": "max_frames" if stop is None else stop, "step": step or 1}


def _spans(table: dict[str, Any]) -> dict[str, tuple[Span, Span]]:
    """Per subject [start, stop, step] of its training and test frames."""
    found = {}
    for subject, own in table.items():
        spans = [
            _span(dict(zip(("start", "stop", "step"), own[part], strict=True)), f"subjects.spans.{subject}.{part}")
            for part in ("train", "test")
        ]
        found[subject] = (spans[0], spans[1])
    return found


def _span(table: dict[str, Any], what: str) -> Span:
    start, stop, step = table["start"], table["stop"], table["step"]
    ends = stop > start if isinstance(stop, int) else stop == "max_frames"
    if start < 0 or step < 1 or not ends:
        raise ValueError(f'{what} is {table}, expected start >= 0, stop > start (or "max_frames"), step >= 1')
    return Span(start, stop, step)


def _build(c: dict[str, Any], profile: str) -> Protocol:
    image, occlusion, metrics = c["image"], c["occlusion"], c["metrics"]
    if not 8 <= image["size"] <= 8192:
        raise ValueError(f"image.size is {image['size']} px, expected 8 to 8192")
    share = occlusion["covers"]["fraction"]
    if not 0 <= share <= 1 or not 0 <= occlusion["fraction"] <= 1:
        raise ValueError("occlusion.covers.fraction and occlusion.fraction must lie in [0, 1]")
    regions = tuple(_one_of(r, REGIONS, "a region") for r in metrics["regions"])
    if occlusion.get("in_scene") and metrics["headline"] in ("full", "box"):
        raise ValueError(
            f"metrics.headline is {metrics['headline']!r}, which has no number where the occluder stands in test "
            "images; expected another region, for example body"
        )
    return Protocol(
        id=c["id"],
        version=c["version"],
        profile=profile,
        title=c["title"],
        reason=c["reason"],
        source=c["source"],
        dataset=c["dataset"],
        subjects=tuple(c["subjects"]["names"]),
        standin_subjects=tuple(c["subjects"]["standin"]),
        silhouette=c["subjects"]["silhouette"],
        max_frames=dict(c["subjects"].get("max_frames", {})),
        train_camera=c["train"]["camera"],
        train_frames=_span(c["train"]["frames"], "train.frames"),
        test_cameras=_span(c["test"]["cameras"], "test.cameras"),
        test_except_train=c["test"]["cameras"]["except_train"],
        test_frames=_span(c["test"]["frames"], "test.frames"),
        spans=_spans(c["subjects"].get("spans", {})),
        also=tuple(
            TestGroup(g["name"], _span(g["cameras"], "also.cameras"), _span(g["frames"], "also.frames"))
            for g in c.get("also", [])
        ),
        occlusion=OcclusionRule(
            rule=occlusion["rule"],
            unlisted=occlusion["unlisted"],
            fraction=occlusion["fraction"],
            reference_width=occlusion["reference_width"],
            covers_fraction=share,
            covers_of=_one_of(occlusion["covers"]["of"], ("sampled", "raw"), "occlusion.covers.of"),
            strips={k: (int(v[0]), int(v[1])) for k, v in occlusion.get("strips", {}).items()},
            seed=occlusion.get("seed", 0),
            in_scene=occlusion.get("in_scene", False),
        ),
        image=ImageRule(
            size=image["size"],
            background=tuple(image["background"]),
            undistort=image["undistort"],
            edge=_one_of(image["edge"], ("hard", "soft"), "image.edge"),
            resample_image=_one_of(image["resample_image"], RESAMPLING, "image.resample_image"),
            resample_mask=_one_of(image["resample_mask"], RESAMPLING, "image.resample_mask"),
            to_8bit=_one_of(image["to_8bit"], ("truncate", "round"), "image.to_8bit"),
        ),
        regions=regions,
        headline=_one_of(metrics["headline"], regions, "metrics.headline"),
        presets=tuple(metrics["presets"]),
        box_padding=metrics["box_padding"],
        content=c,
    )


def flatten(content: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """("image.size", "512") pairs of a protocol's content, in file order."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield prefix + key, json.dumps(value, ensure_ascii=False)


def difference(a: Protocol, b: Protocol) -> list[tuple[str, str, str]]:
    """(key, value in a, value in b) wherever two protocols differ; a value that one lacks is empty."""
    left, right = dict(flatten(a.content)), dict(flatten(b.content))
    keys = list(left) + [key for key in right if key not in left]
    return [(k, left.get(k, ""), right.get(k, "")) for k in keys if left.get(k) != right.get(k)]
