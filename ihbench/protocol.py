"""Protocols: every choice that moves a number, as a versioned file.

A protocol is a TOML file registered under the entry-point group `ihbench.protocols`. This module reads it, checks it
and answers what a run needs to know. Nothing here imports torch or cv2.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ihbench import registry
from ihbench.errors import BadInput

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


@dataclass(frozen=True)
class ImageRule:
    size: int  # px, square
    background: tuple[float, float, float]
    undistort: bool
    edge: str  # hard | soft
    resample_image: str
    resample_mask: str
    to_8bit: str  # truncate | round


@dataclass(frozen=True)
class OcclusionRule:
    rule: str
    unlisted: str  # rule for subjects without a strip of their own
    fraction: float
    reference_width: int
    covers_fraction: float
    covers_of: str  # sampled | raw
    strips: dict[str, tuple[int, int]]  # subject -> (mid, width)


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

    def with_occlusion(self, rule: str) -> Protocol:
        """The same protocol under another occlusion rule; its digest differs, so numbers never mix."""
        content = {**self.content, "occlusion": {**self.content["occlusion"], "rule": rule, "unlisted": rule}}
        replaced = _build(content, self.profile)
        return replace(replaced, version=f"{self.version}+occlusion={rule}")

    def training_frames(self, subject: str, n_frames: int) -> list[int]:
        """Raw frame numbers of the training images."""
        return list(self.train_frames.indices(self.max_frames.get(subject, n_frames)))

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
        cameras = [c for c in self.test_cameras.indices(n_cameras) if c < n_cameras]
        return [c for c in cameras if not (self.test_except_train and c == self.train_camera)]

    def testing_frames(self, subject: str, n_frames: int) -> list[int]:
        return list(self.test_frames.indices(self.max_frames.get(subject, n_frames)))


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
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadInput(f"protocol file {path}: {error}") from error
    profiles = content.pop("profile", {})
    if profile not in profiles:
        raise BadInput(
            f"protocol file {path}: unknown profile {profile!r}: {registry.nearest(profile, list(profiles))}"
        )
    _merge(content, profiles[profile], path)
    try:
        return _build(content, profile)
    except KeyError as error:
        raise BadInput(f"protocol file {path}: key {error.args[0]!r} is missing") from error
    except (TypeError, ValueError) as error:
        raise BadInput(f"protocol file {path}: {error}") from error


def protocol_from(content: dict[str, Any], profile: str, version: str) -> Protocol:
    """The protocol of a run's record. Raises `BadInput` when the record holds none."""
    try:
        return replace(_build(content, profile), version=version)
    except (KeyError, TypeError, ValueError) as error:
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
        occlusion=OcclusionRule(
            rule=occlusion["rule"],
            unlisted=occlusion["unlisted"],
            fraction=occlusion["fraction"],
            reference_width=occlusion["reference_width"],
            covers_fraction=share,
            covers_of=_one_of(occlusion["covers"]["of"], ("sampled", "raw"), "occlusion.covers.of"),
            strips={k: (int(v[0]), int(v[1])) for k, v in occlusion["strips"].items()},
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
