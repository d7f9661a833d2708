"""Procedural people to train on, with captions. None of them is a stand-in that a protocol scores.

A stand-in is drawn from (seed, member of the cast); these come from their own stream, keyed by `STREAM` and a number.
Numbers below `HELD_OUT` are for training, the others for validation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.datasets.standin import motion, outfit
from ihbench.datasets.standin.lighting import studio_lighting
from ihbench.datasets.standin.photograph import photograph
from ihbench.datasets.standin.subject import ROUTINES

VERSION = 2
STREAM = (86, *b"passer-by")  # stand-ins' streams are (seed, number, *words); no word of theirs is this one
HELD_OUT = 1_000_000
TEXTURE = 512  # px; with fewer there is no eye in a face
ALTERED = 0.75  # share of the garments whose colours are drawn anew instead of tinted
EXERCISES = sorted({name for routine in ROUTINES for name in routine})

Colour = tuple[float, float, float]

COLOURS: dict[str, Colour] = {
    "black": (0.08, 0.08, 0.09), "charcoal": (0.22, 0.23, 0.25), "grey": (0.50, 0.51, 0.52),
    "silver": (0.72, 0.72, 0.72), "white": (0.92, 0.92, 0.90), "cream": (0.92, 0.86, 0.72),
    "beige": (0.78, 0.68, 0.52), "tan": (0.62, 0.50, 0.36), "brown": (0.36, 0.23, 0.14),
    "maroon": (0.42, 0.12, 0.18), "red": (0.75, 0.15, 0.14), "orange": (0.88, 0.46, 0.14),
    "mustard": (0.80, 0.62, 0.18), "yellow": (0.92, 0.84, 0.28), "lime": (0.60, 0.76, 0.28),
    "olive": (0.36, 0.38, 0.24), "green": (0.18, 0.48, 0.26), "teal": (0.14, 0.46, 0.46),
    "sky": (0.48, 0.68, 0.86), "blue": (0.18, 0.34, 0.68), "navy": (0.13, 0.17, 0.33),
    "purple": (0.40, 0.24, 0.52), "pink": (0.88, 0.56, 0.64), "rose": (0.64, 0.30, 0.38),
}  # fmt: skip
TONES: dict[str, Colour] = {
    "fair": (0.93, 0.76, 0.66), "light": (0.88, 0.70, 0.57), "tanned": (0.76, 0.57, 0.44),
    "brown": (0.57, 0.39, 0.29), "dark": (0.40, 0.27, 0.20),
}  # fmt: skip
PATTERNS = {
    "stripes": "striped", "plaid": "plaid", "print": "printed", "raglan": "raglan", "dots": "dotted",
    "chest_band": "banded",
}  # fmt: skip
SENTENCE = ("a", "photo", "of", "person", "wearing", "with", "and", ",", "skin", "hair", "beard", "shoes", "sleeves")
SLEEVES, LEGS = ("short", "long"), ("short", "long")
TOPS = ("tee", "longsleeve", "shirt", "hoodie", "polo")
BOTTOMS = ("jeans", "track", "chinos", "joggers")
CUTS = ("short", "crop", "bob")


@dataclass(frozen=True)
class Snapshot:
    """One photograph of a person on white."""

    image: NDArray[np.uint8]  # [H, W, 3]
    silhouette: NDArray[np.bool_]  # [H, W]
    camera: Camera
    body_pose: BodyPose


@dataclass(frozen=True)
class TrainingPerson:
    phrases: tuple[str, ...]  # the caption without "a photo of a person": any of them may be left out
    traits: NDArray[np.float32]  # [N_TRAITS] what the caption describes, in numbers
    snapshots: list[Snapshot]


N_TRAITS = 3 * 9 + 4 + len(PATTERNS) + len(TOPS) + len(BOTTOMS) + len(CUTS)


def vocabulary() -> tuple[str, ...]:
    """Every word of every caption, sorted."""
    words = {*SENTENCE, *COLOURS, *TONES, *PATTERNS.values(), *TOPS, *BOTTOMS, *CUTS, *SLEEVES, *LEGS}
    return tuple(sorted(words))


def draw_person(number: int, body: Body, count: int) -> TrainingPerson:
    """Person `number`, photographed `count` times in varied poses, from varied cameras. Pure in its arguments."""
    if number < 0 or count < 1:
        raise ValueError(f"person {number}, {count} photographs: expected 0 or more and 1 or more")
    rng = np.random.default_rng([*STREAM, number])
    style = draw_style(rng)
    betas = np.clip(rng.normal(0, 0.9, 10), -1.8, 1.8)
    offsets = outfit.stand_off(body, style)
    texture, labels = outfit.bake(body, style, TEXTURE)
    poses = _poses(rng, betas, body, count)
    lighting = studio_lighting(rng)
    shots = []
    for pose in poses:
        camera = _camera(rng, pose, body)
        white = np.full((camera.height, camera.width, 3), 255, np.uint8)
        shot = photograph(body.pose(pose, offsets=offsets), body, texture, labels, lighting, camera, white)
        shots.append(Snapshot(shot.image, shot.mask, camera, pose))
    return TrainingPerson(phrases(style), traits(style), shots)


def draw_style(rng: np.random.Generator) -> outfit.Style:
    """Any garment with any pattern, most of them in colours of their own."""
    order = {what: int(rng.integers(6)) for what in ("skins", "hairs", "tops", "bottoms", "shoes")}
    style = outfit.choose_style(rng, order)
    if rng.random() < ALTERED:
        top, pattern = str(rng.choice(TOPS)), str(rng.choice(list(PATTERNS)))
        sleeve = rng.uniform(0.5, 0.75) if top in ("tee", "polo") else 1.95
        drawn = (_colour(rng), _colour(rng), _colour(rng))
        style = replace(style, top=top, top_pattern=pattern, top_colours=drawn, sleeve=float(sleeve))
    if rng.random() < ALTERED:
        leg = float(rng.choice([0.92, 1.95], p=[0.25, 0.75]))
        style = replace(
            style, bottom=str(rng.choice(BOTTOMS)), bottom_colours=(_colour(rng, 0.8), _colour(rng)), leg=leg
        )
    if rng.random() < ALTERED:
        style = replace(style, shoe_colours=(_colour(rng), _colour(rng)))
    if rng.random() < ALTERED:
        skin = _between(rng, list(TONES.values()))
        hair = _between(rng, list(outfit.HAIRS))
        style = replace(style, skin=skin, hair=hair)
    return style


def _colour(rng: np.random.Generator, brightest: float = 1.0) -> Colour:
    """One of the named colours, shifted, so that the space between the names is filled too."""
    base = np.array(list(COLOURS.values()))[rng.integers(len(COLOURS))]
    r, g, b = np.clip((base * rng.uniform(0.85, 1.1) + rng.normal(0, 0.04, 3)) * brightest, 0.03, 0.95)
    return float(r), float(g), float(b)


def _between(rng: np.random.Generator, colours: list[Colour]) -> Colour:
    a, b = rng.choice(len(colours), 2)
    t = rng.uniform()
    r, g, b_ = np.clip((1 - t) * np.array(colours[a]) + t * np.array(colours[b]) + rng.normal(0, 0.01, 3), 0.03, 0.95)
    return float(r), float(g), float(b_)


def _poses(rng: np.random.Generator, betas: NDArray[np.float64], body: Body, count: int) -> list[BodyPose]:
    """Frames of exercises, of a stroll or of a turntable, facing anywhere."""
    length = 96
    kind = rng.choice(["exercise", "turntable", "stroll"], p=[0.65, 0.25, 0.10])
    if kind == "exercise":
        routine = tuple(rng.choice(EXERCISES, 3, replace=False))
        show = motion.perform(rng, routine, full_turn=True, n_frames=length)
    elif kind == "turntable":
        show = motion.turntable(rng, length, turns=1)
    else:
        show = motion.stroll(rng, length, reach=1.0)
    show = replace(show, yaw=show.yaw + rng.uniform(0, 2 * np.pi))
    picked = np.sort(rng.choice(length, count, replace=count > length))
    poses = motion.body_poses(show, betas, body)
    return [poses[k] for k in picked]


def _camera(rng: np.random.Generator, pose: BodyPose, body: Body) -> Camera:
    """Around the person, 2.5 to 4 m away, so that they are about 140 to 240 px tall."""
    azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2.5, 4.0)
    middle = np.array([pose.transl[0], pose.transl[1], rng.uniform(0.85, 1.0)])
    eye = middle + distance * np.array([np.cos(azimuth), np.sin(azimuth), 0])
    eye[2] = rng.uniform(0.7, 1.9)
    R, t = look_at(eye, middle, up=np.array([0.0, 0.0, 1.0]))
    size = int(rng.integers(200, 340))
    focal = 0.75 * size * distance / 1.9
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, R, t, size, size)


def phrases(style: outfit.Style) -> tuple[str, ...]:
    """The parts of the caption."""
    main, second, accent = (_name(colour, COLOURS) for colour in style.top_colours)
    sleeves = "short" if style.sleeve < 1 else "long"
    parts = [
        f"{_name(style.skin, TONES)} skin",
        f"{_name(style.hair, COLOURS)} {style.hair_cut} hair",
        f"{main} {PATTERNS[style.top_pattern]} {style.top} with {second} and {accent}",
        f"{sleeves} sleeves",
        f"{'short' if style.leg < 1.5 else 'long'} {_name(style.bottom_colours[0], COLOURS)} {style.bottom}",
        f"{_name(style.shoe_colours[0], COLOURS)} shoes",
    ]
    return (*parts, "beard") if style.beard else tuple(parts)


def _name(colour: Colour, names: dict[str, Colour]) -> str:
    return min(names, key=lambda name: float(np.square(np.subtract(names[name], colour)).sum()))


def traits(style: outfit.Style) -> NDArray[np.float32]:
    """[N_TRAITS] colours in [-1, 1], lengths, and one-hot kinds."""
    colours = [style.skin, style.hair, *style.top_colours, *style.bottom_colours, *style.shoe_colours]
    kinds = (
        (style.top_pattern, list(PATTERNS)), (style.top, TOPS), (style.bottom, BOTTOMS), (style.hair_cut, CUTS),
    )  # fmt: skip
    one_hot = [float(known == kind) for kind, every in kinds for known in every]
    lengths = [style.sleeve - 1, style.leg - 1, float(style.beard), style.frequency / 8 - 2]
    return np.array([*(2 * np.ravel(colours) - 1), *lengths, *one_hot], np.float32)
