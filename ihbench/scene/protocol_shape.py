"""What a protocol file must look like: every key, the type of its value, its bounds."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from ihbench.bounds import IMAGE_SIZES, Within, expected, fits, rules, shown
from ihbench.errors import BadInput
from ihbench.registry import nearest

LONGEST_NAME, LONGEST_TEXT = 80, 2000  # characters
REGIONS = ("full", "box", "body", "visible", "hidden", "never_seen")
RESAMPLING = ("nearest", "linear", "area", "lanczos4")


@dataclass(frozen=True)
class Name:
    """A text that may become the name of a folder, such as a subject or a protocol's id."""


@dataclass(frozen=True)
class Text:
    """A text for readers."""


@dataclass(frozen=True)
class List:
    """A list of `shape`, of `least` to `most` entries."""

    shape: Any
    least: int = 0
    most: int = 10_000


@dataclass(frozen=True)
class Table:
    """A table with names of the user's own as keys."""

    shape: Any


Frame, Camera = Annotated[int, Within(0, 10_000_000)], Annotated[int, Within(0, 10_000)]
Share, Width = Annotated[float, Within(0, 1)], Annotated[int, Within(1, 65_536)]
Step, Column = Annotated[int, Within(1, 10_000_000)], Annotated[int, Within(0, 65_536)]
FRAMES = {"start": Frame, "stop": Frame | Literal["max_frames"], "step": Step}
CAMERAS = {"start": Camera, "stop": Camera | Literal["max_frames"], "step": Step}
REGION = Literal["full", "box", "body", "visible", "hidden", "never_seen"]

SHAPE = {  # a key that ends in "?" may be missing
    "id": Name(),
    "version": Name(),
    "title": Text(),
    "reason": Text(),
    "source": Text(),
    "dataset": Name(),
    "subjects": {
        "names": List(Name()),
        "standin": List(Name()),
        "silhouette": Name(),
        "max_frames?": Table(Step),
        "spans?": Table({"train": List(Frame, 3, 3), "test": List(Frame, 3, 3)}),
    },
    "train": {"camera": Camera, "frames": FRAMES},
    "test": {"cameras": CAMERAS | {"except_train": bool}, "frames": FRAMES, "pose?": Literal["given"]},
    "also?": List({"name": Name(), "cameras": CAMERAS, "frames": FRAMES}),
    "occlusion": {
        "rule": Name(),
        "unlisted": Name(),
        "fraction": Share,
        "reference_width": Width,
        "covers": {"fraction": Share, "of": Literal["sampled", "raw"]},
        "strips?": Table(List(Column, 2, 2)),
        "seed?": Annotated[int, Within(0, 2**63 - 1)],
        "in_scene?": bool,
    },
    "image": {
        "size": Annotated[int, Within(*IMAGE_SIZES)],
        "background": List(Share, 3, 3),
        "undistort": bool,
        "edge": Literal["hard", "soft"],
        "resample_image": Literal[RESAMPLING],
        "resample_mask": Literal[RESAMPLING],
        "to_8bit": Literal["truncate", "round"],
    },
    "metrics": {
        "presets": List(Name(), 1),
        "regions": List(Literal[REGIONS], 1),
        "headline": Literal[REGIONS],
        "box_padding": Annotated[float, Within(0, 100)],
    },
}


def check_protocol(content: Any, where: str, strict: bool = True) -> None:
    """Raise `BadInput` for the first value that is not as `SHAPE` has it, named by its key: "where: image.size …".

    `strict` refuses keys that no protocol has. Off for records, which another version may have written.
    """
    _check(content, SHAPE, where, "", strict)


def _check(value: Any, shape: Any, where: str, key: str, strict: bool) -> None:
    match shape:
        case dict():
            _check_table(value, shape, where, key, strict)
        case Table():
            for name, item in _table(value, where, key).items():
                _check(name, Name(), where, f"{key}, the name of an entry", strict)
                _check(item, shape.shape, where, f"{key}.{name}", strict)
        case List():
            if not isinstance(value, list) or not shape.least <= len(value) <= shape.most:
                count = shape.least if shape.least == shape.most else f"{shape.least} to {shape.most}"
                raise BadInput(f"{where}: {key}: expected a list of {count} entries, found {_shown(value)}")
            for number, item in enumerate(value, 1):
                _check(item, shape.shape, where, f"{key}, entry {number}", strict)
        case Name() | Text():
            _check_text(value, isinstance(shape, Name), where, key)
        case _:
            _check_value(value, shape, where, key)


def _check_table(value: Any, shape: Mapping[str, Any], where: str, key: str, strict: bool) -> None:
    value, inside = _table(value, where, key), f"{key}." if key else ""
    known = [name.removesuffix("?") for name in shape]
    for name in value:
        if strict and name not in known:
            raise BadInput(f"{where}: unknown key {inside + name!r}: {nearest(name, known)}")
    for name, its_shape in shape.items():
        plain = name.removesuffix("?")
        if plain in value:
            _check(value[plain], its_shape, where, inside + plain, strict)
        elif plain == name:
            raise BadInput(f"{where}: key {inside + plain!r} is missing")


def _table(value: Any, where: str, key: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise BadInput(f"{where}: {key or 'the file'}: expected a table, found {_shown(value)}")
    return value


def _check_text(value: Any, is_name: bool, where: str, key: str) -> None:
    longest = LONGEST_NAME if is_name else LONGEST_TEXT
    wanted = f"a name of 1 to {longest} characters" if is_name else f"a text of up to {longest} characters"
    good = isinstance(value, str) and len(value) <= longest and not (is_name and not value.strip())
    if good and is_name:
        wanted += ", no slash, no dot in front, no control character"
        unseen = any(unicodedata.category(sign)[0] == "C" for sign in value)
        good = not (unseen or "/" in value or "\\" in value or value.startswith("."))
    if not good:
        raise BadInput(f"{where}: {key}: expected {wanted}, found {_shown(value)}")


def _check_value(value: Any, hint: Any, where: str, key: str) -> None:
    good = fits(value, hint)
    if good and isinstance(value, int | float) and not isinstance(value, bool):
        good = all(rule.holds(value) for rule in rules(hint))
    if not good:
        raise BadInput(f"{where}: {key}: expected {expected(hint)}, found {_shown(value)}")


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return "a table"
    return f"a list of {len(value)}" if isinstance(value, list) and len(value) > 3 else shown(value)
