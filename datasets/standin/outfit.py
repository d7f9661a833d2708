"""What a stand-in wears: a texture, part labels and the stand-off of cloth and hair from the body.

Everything is a function of the point on the rest-pose body (where it lies on a garment), so it is painted in three
dimensions and texels that meet across a seam of the atlas agree. Labels are those of the CIHP data set, as in
ZJU-MoCap's `mask_cihp`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array

from ihbench.body import Body
from ihbench.body.skeleton import JOINT_INDEX
from ihbench.body.uv import nearest_on_chart
from ihbench.datasets.standin.noise import fractal_noise, value_noise
from ihbench.render.zbuffer import rasterize, vertex_normals

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

TEXTURE_SIZE = 1024
SOFT = 0.0015  # m, width over which one colour gives way to another: about a texel
NECK_OPENING = 0.080  # m, radius about the neck's axis


class Part(IntEnum):
    """CIHP part labels (Gong et al. 2018); 0 is background."""

    HAIR = 2
    UPPER_CLOTHES = 5
    TROUSERS = 9
    NECK = 10
    FACE = 13
    LEFT_ARM = 14
    RIGHT_ARM = 15
    LEFT_LEG = 16
    RIGHT_LEG = 17
    LEFT_SHOE = 18
    RIGHT_SHOE = 19


@dataclass(frozen=True)
class Style:
    """What is chosen for one person. Colours are sRGB in [0, 1]."""

    skin: Colour
    hair: Colour
    hair_cut: str  # "short", "crop", "bob"
    beard: bool
    top: str  # "tee", "longsleeve", "shirt", "hoodie", "polo"
    top_pattern: str  # "stripes", "plaid", "print", "raglan", "dots", "chest_band"
    top_colours: tuple[Colour, Colour, Colour]
    sleeve: float  # 0 shoulder, 1 elbow, 2 wrist
    bottom: str  # "jeans", "track", "chinos", "joggers"
    bottom_colours: tuple[Colour, Colour]
    leg: float  # 0 hip, 1 knee, 2 ankle
    shoe_colours: tuple[Colour, Colour]
    frequency: float  # repetitions of the pattern per metre
    seed: int  # of grain, folds and emblem


SKINS: tuple[Colour, ...] = (
    (0.93, 0.76, 0.66), (0.55, 0.37, 0.27), (0.84, 0.65, 0.52),
    (0.40, 0.27, 0.20), (0.90, 0.71, 0.57), (0.70, 0.50, 0.38),
)  # fmt: skip
HAIRS: tuple[Colour, ...] = (
    (0.27, 0.17, 0.10), (0.07, 0.06, 0.06), (0.62, 0.46, 0.25),
    (0.10, 0.08, 0.07), (0.45, 0.22, 0.11), (0.16, 0.11, 0.08),
)  # fmt: skip
TOPS: tuple[tuple[str, str, tuple[Colour, Colour, Colour]], ...] = (
    ("longsleeve", "stripes", ((0.90, 0.89, 0.85), (0.14, 0.20, 0.36), (0.75, 0.18, 0.16))),
    ("shirt", "plaid", ((0.68, 0.16, 0.14), (0.13, 0.14, 0.20), (0.90, 0.84, 0.70))),
    ("tee", "print", ((0.16, 0.45, 0.42), (0.94, 0.90, 0.78), (0.93, 0.62, 0.18))),
    ("hoodie", "raglan", ((0.52, 0.54, 0.56), (0.24, 0.27, 0.33), (0.86, 0.42, 0.12))),
    ("polo", "chest_band", ((0.20, 0.33, 0.58), (0.93, 0.92, 0.88), (0.85, 0.68, 0.20))),
    ("tee", "dots", ((0.86, 0.74, 0.32), (0.30, 0.20, 0.36), (0.55, 0.18, 0.30))),
)
BOTTOMS: tuple[tuple[str, tuple[Colour, Colour], float], ...] = (
    ("jeans", ((0.20, 0.29, 0.44), (0.70, 0.56, 0.34)), 1.95),
    ("chinos", ((0.62, 0.53, 0.39), (0.30, 0.20, 0.13)), 1.95),
    ("track", ((0.13, 0.14, 0.17), (0.88, 0.88, 0.86)), 1.95),
    ("jeans", ((0.13, 0.15, 0.20), (0.40, 0.38, 0.36)), 1.95),
    ("chinos", ((0.34, 0.38, 0.30), (0.20, 0.16, 0.12)), 0.92),
    ("joggers", ((0.36, 0.17, 0.22), (0.82, 0.72, 0.66)), 1.95),
)
SHOES: tuple[tuple[Colour, Colour], ...] = (
    ((0.88, 0.87, 0.85), (0.20, 0.24, 0.40)),
    ((0.36, 0.22, 0.13), (0.12, 0.09, 0.07)),
    ((0.70, 0.20, 0.16), (0.94, 0.93, 0.90)),
    ((0.16, 0.16, 0.18), (0.92, 0.92, 0.90)),
    ((0.25, 0.34, 0.28), (0.90, 0.86, 0.76)),
    ((0.85, 0.80, 0.74), (0.70, 0.34, 0.30)),
)


def choose_style(rng: np.random.Generator, order: dict[str, int]) -> Style:
    """A wardrobe drawn with `rng`. `order` gives this person's place in the cast's shuffled list of "skins", "hairs",
    "tops", "bottoms" and "shoes", so that the first six people of a cast share none of them."""
    top, pattern, top_colours = TOPS[order["tops"] % len(TOPS)]
    bottom, bottom_colours, leg = BOTTOMS[order["bottoms"] % len(BOTTOMS)]
    cut = ("short", "crop", "bob")[int(rng.integers(3))]
    sleeve = {"tee": rng.uniform(0.5, 0.7), "polo": rng.uniform(0.6, 0.75), "shirt": 1.93}.get(top, 1.96)
    return Style(
        skin=_tinted(SKINS[order["skins"] % len(SKINS)], rng),
        hair=_tinted(HAIRS[order["hairs"] % len(HAIRS)], rng),
        hair_cut=cut,
        beard=cut != "bob" and bool(rng.random() < 0.35),
        top=top,
        top_pattern=pattern,
        top_colours=(_tinted(top_colours[0], rng), _tinted(top_colours[1], rng), _tinted(top_colours[2], rng)),
        sleeve=float(sleeve),
        bottom=bottom,
        bottom_colours=(_tinted(bottom_colours[0], rng), _tinted(bottom_colours[1], rng)),
        leg=leg,
        shoe_colours=SHOES[order["shoes"] % len(SHOES)],
        frequency=float(rng.uniform(13, 19)),
        seed=int(rng.integers(2**31)),
    )


def _tinted(colour: Colour, rng: np.random.Generator) -> Colour:
    r, g, b = np.clip(np.asarray(colour) * rng.uniform(0.92, 1.06) + rng.uniform(-0.015, 0.015, 3), 0.02, 0.96)
    return float(r), float(g), float(b)


class Chart:
    """Where points of the rest-pose body lie on the limbs and garments.

    Every array has one entry per point: `x y z` m; `torso head arm leg` exclusive booleans; `along` the limb
    coordinate (arm: 0 shoulder, 1 elbow, 2 wrist; leg: 0 hip, 1 knee, 2 ankle); `round` the angle about the torso or
    limb in turns, 0 in front (torso, leg) or on top (arm); `left` True on the person's left.
    """

    def __init__(self, points: Array, groups: Array, body: Body):
        """`points` [N, 3] m on the rest-pose body, `groups` [N, 4] from `limb_groups`."""
        J = self.joints = body.joints
        self.points, self.groups, self.body = points, groups, body
        self.x, self.y, self.z = points.T
        group = groups.argmax(1)
        self.torso, self.head, self.arm, self.leg = (group == k for k in range(4))
        self.left = self.x > 0
        across = np.abs(self.x)
        arm_x = [joint("shoulder", J)[0], joint("elbow", J)[0], joint("wrist", J)[0], joint("hand", J)[0]]
        leg_y = [-joint("hip", J)[1], -joint("knee", J)[1], -joint("ankle", J)[1]]
        self.arm_along = np.interp(across, [arm_x[0] - 0.12, *arm_x], [-0.5, 0, 1, 2, 2.5])
        self.leg_along = np.interp(-self.y, [*leg_y, leg_y[2] + 0.08], [0, 1, 2, 2.4])
        leg_x = np.interp(-self.y, leg_y, [joint(n, J)[0] for n in ("hip", "knee", "ankle")])
        leg_z = np.interp(-self.y, leg_y, [joint(n, J)[2] for n in ("hip", "knee", "ankle")])
        self.outward = across - leg_x  # m outside the leg's axis
        self.forward = self.z - leg_z  # m ahead of the leg's axis
        arm_y, arm_z = joint("elbow", J)[1], joint("elbow", J)[2]
        self.round = np.where(
            self.arm,
            np.arctan2(self.z - arm_z, self.y - arm_y),
            np.where(self.leg, np.arctan2(self.outward, self.forward), np.arctan2(self.x, self.z + 0.01)),
        ) / (2 * np.pi)
        self.hem = J[0, 1] - 0.055  # where the top ends
        self.waist = J[0, 1] - 0.045  # where the trousers end below the top
        self.sole = body.v_template[:, 1].min()
        self.fingertips = body.v_template[:, 0].max()
        head, neck = J[JOINT_INDEX["head"]], J[JOINT_INDEX["neck"]]
        self.eye_x, self.eye_y, self.mouth_y = body.eyes_and_mouth
        self.head_z = head[2]
        # round neckline, lower in front
        self.collar = self.y - (neck[1] - 0.030 - 0.35 * np.clip(self.z - neck[2], 0, 0.14))
        self.neck_distance = np.hypot(self.x, self.z - neck[2])

    def at(self, where: NDArray[np.bool_]) -> Chart:
        """The chart of some of the points."""
        return Chart(self.points[where], self.groups[where], self.body)


def joint(name: str, joints: Array) -> Array:
    """[3] m, the left joint of that name."""
    return joints[JOINT_INDEX[f"left_{name}"]]


def limb_groups(weights: Array) -> Array:
    """[N, 24] skinning weights -> [N, 4] shares of torso, head, arms, legs."""

    def share(*names: str) -> Array:
        return weights[:, [k for name, k in JOINT_INDEX.items() if name.split("_")[-1] in names]].sum(1)

    collar = share("collar")
    return np.stack(
        [
            share("pelvis", "spine1", "spine2", "spine3") + 0.1 * collar,
            share("neck", "head"),
            share("shoulder", "elbow", "wrist", "hand") + 0.9 * collar,
            share("hip", "knee", "ankle", "foot"),
        ],
        1,
    )


def part_labels(c: Chart, style: Style) -> NDArray[np.uint8]:
    """[N] `Part` of every point."""
    left = c.left
    label = np.where(c.arm, np.where(left, Part.LEFT_ARM, Part.RIGHT_ARM), Part.NECK)
    label = np.where(c.leg, np.where(left, Part.LEFT_LEG, Part.RIGHT_LEG), label)
    label = np.where(c.head & (c.y > c.joints[JOINT_INDEX["head"], 1] - 0.015), Part.FACE, label)
    shoulder = c.head & (c.y < c.joints[JOINT_INDEX["neck"], 1] + 0.02) & (c.neck_distance > NECK_OPENING)
    top = c.torso | (c.arm & (c.arm_along < style.sleeve)) | (c.head & (c.collar < 0)) | shoulder
    top &= ~((c.collar > 0) & (c.neck_distance < NECK_OPENING))
    top |= c.leg & (c.y >= c.hem)
    label = np.where(top, Part.UPPER_CLOTHES, label)
    bottom = (c.y < c.hem) & (c.torso | (c.leg & (c.leg_along < style.leg)))
    label = np.where(bottom, Part.TROUSERS, label)
    shoe = c.leg & (c.leg_along > 2.03)
    label = np.where(shoe, np.where(left, Part.LEFT_SHOE, Part.RIGHT_SHOE), label)
    return np.where(_hair(c, style), Part.HAIR, label).astype(np.uint8)


def _hair(c: Chart, style: Style) -> NDArray[np.bool_]:
    up, back = c.y - c.eye_y, c.head_z + 0.010 - c.z  # above the eyes, behind the ears
    ragged = 0.012 * (value_noise(c.points, style.seed + 3, 45) - 0.5)
    fringe = {"short": 0.066, "crop": 0.072, "bob": 0.056}[style.hair_cut] + ragged
    nape = {"short": -0.052, "crop": -0.035, "bob": -0.105}[style.hair_cut] + ragged
    side = {"short": 0.010, "crop": -0.004, "bob": 0.022}[style.hair_cut]
    ear = (np.abs(c.x) > 0.071) & (np.abs(up + 0.012) < 0.034) & (np.abs(back) < 0.022) & (style.hair_cut != "bob")
    # the hairline falls from the forehead over the temples to the nape
    falling = np.interp(back, [-0.10, -0.055, -side, 0.012], [0, 0.012, 0.075, 0.075])
    line = np.where(back > 0.012 - side, nape, fringe - falling)
    return c.head & (up > line) & ~ear & (c.y > c.joints[JOINT_INDEX["neck"], 1])


def albedo(c: Chart, style: Style) -> NDArray[np.float32]:
    """[N, 3] sRGB colour of every point, without light."""
    label = part_labels(c, style)
    colour_of = {Part.UPPER_CLOTHES: _top, Part.TROUSERS: _bottom, Part.HAIR: _hair_colour}
    colour_of |= {Part.LEFT_SHOE: _shoes, Part.RIGHT_SHOE: _shoes}
    out = np.empty((len(label), 3))
    for part in np.unique(label):
        here = label == part
        out[here] = colour_of.get(Part(part), _skin)(c.at(here), style)
    return np.clip(out, 0, 1).astype(np.float32)


def _inside(signed: Array) -> Array:
    """A soft step: 1 where `signed` m is well above 0, 0 well below."""
    return np.clip(signed / SOFT + 0.5, 0, 1)


def _band(value: Array, low: float | Array, high: float | Array) -> Array:
    return _inside(value - low) * _inside(high - value)


def _ellipse(u: Array, v: Array, a: float, b: float) -> Array:
    return _inside((1 - np.hypot(u / a, v / b)) * min(a, b))


def _stroke(u: Array, v: Array, start: tuple[float, float], end: tuple[float, float], width: float) -> Array:
    """A straight stroke of the brush in the (u, v) plane, m."""
    du, dv = end[0] - start[0], end[1] - start[1]
    t = np.clip(((u - start[0]) * du + (v - start[1]) * dv) / (du * du + dv * dv), 0, 1)
    return _inside(width / 2 - np.hypot(u - start[0] - t * du, v - start[1] - t * dv))


def _paint(out: Array, where: Array, colour: Array | Colour) -> None:
    """Cover `out` [N, 3] with `colour` as far as `where` [N] in [0, 1] says."""
    out += where[:, None] * (np.asarray(colour) - out)


def _filled(c: Chart, colour: Colour) -> Array:
    return np.tile(np.asarray(colour, np.float64), (len(c.x), 1))


def _skin(c: Chart, style: Style) -> Array:
    skin = np.asarray(style.skin)
    out = _filled(c, style.skin) * (0.95 + 0.10 * fractal_noise(c.points, style.seed + 20, 35))[:, None]
    front = c.head & (c.z > c.head_z + 0.03)
    x, up = np.abs(c.x), c.y - c.eye_y
    mouth = c.y - c.mouth_y
    face = front.astype(np.float64)
    blush = np.exp(-((x - 0.040) ** 2 + (up + 0.030) ** 2) / 0.016**2)
    _paint(out, 0.30 * face * blush, skin * (1.02, 0.74, 0.70))
    _paint(out, 0.35 * face * np.exp(-((x / 0.03) ** 2) - ((mouth - 0.018) / 0.006) ** 2), skin * 0.78)  # philtrum
    if style.beard:
        jaw = _inside(0.013 - mouth + 0.5 * np.clip(x - 0.03, 0, 1)) * _inside(c.z - c.head_z + 0.01)
        jaw *= c.head & (mouth > -0.065)
        grain = 0.55 + 0.4 * value_noise(c.points, style.seed + 4, 300)
        _paint(out, jaw * grain, np.asarray(style.hair) * 0.9)
    _paint(out, face * _ellipse(c.x, mouth, 0.023, 0.0085), skin * (0.90, 0.58, 0.56))
    _paint(out, face * _ellipse(c.x, mouth - 0.0005, 0.021, 0.0011), skin * (0.45, 0.25, 0.25))
    eye = x - c.eye_x
    _paint(out, 0.45 * face * _ellipse(eye, up - 0.002, 0.020, 0.013), skin * 0.72)
    _paint(out, face * _ellipse(eye, up, 0.0145, 0.0070), (0.93, 0.92, 0.90))
    iris = np.asarray(((0.22, 0.14, 0.09), (0.28, 0.36, 0.42), (0.26, 0.31, 0.18))[style.seed % 3])
    _paint(out, face * _ellipse(eye, up, 0.0062, 0.0066), iris)
    _paint(out, face * _ellipse(eye, up, 0.0028, 0.0030), (0.03, 0.03, 0.03))
    _paint(out, face * _stroke(eye, up, (-0.014, 0.0052), (0.015, 0.0062), 0.003), (0.10, 0.07, 0.06))  # lashes
    brow = np.asarray(style.hair) * 0.75
    _paint(out, face * _stroke(eye, up, (-0.015, 0.0195), (0.004, 0.0235), 0.0058), brow)
    _paint(out, face * _stroke(eye, up, (0.004, 0.0235), (0.019, 0.0185), 0.0045), brow)
    _paint(out, 0.8 * face * _ellipse(x - 0.0075, up + 0.034, 0.0042, 0.0028), skin * (0.45, 0.32, 0.30))  # nostrils
    nails = c.arm & (np.abs(c.x) > c.fingertips - 0.012)
    _paint(out, 0.5 * nails, (0.95, 0.80, 0.76))
    return out


def _hair_colour(c: Chart, style: Style) -> Array:
    strands = fractal_noise(c.points * (1, 0.18, 1), style.seed + 21, 130)
    clumps = value_noise(c.points * (1, 0.4, 1), style.seed + 22, 40)
    light = np.asarray(style.hair) + 0.07
    out = _filled(c, style.hair)
    _paint(out, np.clip(1.6 * strands - 0.55, 0, 1), light * 1.35)
    return out * (0.65 + 0.5 * clumps)[:, None]


def _folds(c: Chart, style: Style, depth: float) -> Array:
    """[N, 1] brightness of soft folds and of the weave."""
    fold = fractal_noise(c.points * (1, 0.6, 1), style.seed + 10, 9)
    weave = value_noise(c.points, style.seed + 11, 420)
    return (1 + depth * (fold - 0.5) + 0.07 * (weave - 0.5))[:, None]


def _top(c: Chart, style: Style) -> Array:
    main, second, accent = (np.asarray(colour) for colour in style.top_colours)
    out = _filled(c, style.top_colours[0])
    # lengthwise coordinate that runs down the torso and along the sleeve, and a whole number of repeats around
    length = np.where(c.arm, np.abs(c.x), c.y - c.hem)
    repeats = np.where(c.arm, round(style.frequency * 0.45), round(style.frequency * 0.9))
    across = c.round * repeats / style.frequency
    turns = np.mod(across * style.frequency, 1) / style.frequency
    period = np.mod(length * style.frequency, 1) / style.frequency
    p = 1 / style.frequency
    if style.top_pattern == "stripes":
        _paint(out, _band(period, 0.15 * p, 0.60 * p), second)
        count = np.floor(length * style.frequency)
        _paint(out, _band(period, 0.15 * p, 0.60 * p) * (np.mod(count, 4) == 0), accent)
    elif style.top_pattern == "plaid":
        _paint(out, 0.55 * _band(period, 0.10 * p, 0.50 * p), second)
        _paint(out, 0.55 * _band(turns, 0.10 * p, 0.50 * p), second)
        _paint(out, 0.75 * _band(period, 0.74 * p, 0.82 * p), accent)
        _paint(out, 0.75 * _band(turns, 0.74 * p, 0.82 * p), accent)
    elif style.top_pattern == "dots":
        stagger = np.mod(np.floor(length * style.frequency), 2) * 0.5 * p
        u = np.mod(across + stagger, p) - 0.5 * p
        _paint(out, _ellipse(u, period - 0.5 * p, 0.27 * p, 0.27 * p), second)
    elif style.top_pattern == "raglan":
        yoke = c.arm | (c.neck_distance < 0.19 - 0.9 * np.clip(c.joints[JOINT_INDEX["neck"], 1] - c.y - 0.05, 0, 1))
        _paint(out, (yoke & (c.y > c.joints[JOINT_INDEX["spine3"], 1] + 0.02)).astype(np.float64), second)
    elif style.top_pattern == "chest_band":
        chest = c.joints[JOINT_INDEX["spine3"], 1]
        _paint(out, _band(c.y, chest - 0.035, chest + 0.055) * c.torso, second)
        _paint(out, _band(c.y, chest - 0.055, chest - 0.043) * c.torso, accent)
        _paint(out, _band(c.arm_along, style.sleeve - 0.26, style.sleeve - 0.14) * c.arm, second)
    if style.top_pattern in ("print", "raglan", "dots"):
        _emblem(out, c, style, accent if style.top_pattern != "print" else second)
    _sewing(out, c, style, main, second, accent)
    return out * _folds(c, style, 0.26)


def _emblem(out: Array, c: Chart, style: Style, colour: Array) -> None:
    """A symmetric 7×7 emblem on the chest and a two-digit number on the back."""
    rng = np.random.default_rng(style.seed)
    half = rng.random((7, 4)) < 0.55
    half[3, 1:] = True
    emblem = np.concatenate([half, half[:, 2::-1]], 1)
    size, bottom = 0.020, c.joints[JOINT_INDEX["spine3"], 1] - 0.045
    row = np.floor((c.y - bottom) / size).astype(int)
    column = np.floor(c.x / size + 3.5).astype(int)
    on_grid = c.torso & (row >= 0) & (row < 7) & (column >= 0) & (column < 7)
    filled = emblem[np.clip(6 - row, 0, 6), np.clip(column, 0, 6)]
    _paint(out, (on_grid & filled & (c.z > 0.02)).astype(np.float64), colour)
    behind = (c.torso & (c.z < -0.02)).astype(np.float64)
    for digit, centre in zip(rng.integers(0, 10, 2), (-0.055, 0.055), strict=True):
        _paint(out, behind * _digit(int(digit), -c.x - centre, c.y - bottom - 0.055), colour)


# seven segments: (start, end) in units of half a digit's height; which of them each digit lights
_SEGMENTS = (
    ((-0.5, 1), (0.5, 1)), ((0.5, 1), (0.5, 0)), ((0.5, 0), (0.5, -1)), ((-0.5, -1), (0.5, -1)),
    ((-0.5, 0), (-0.5, -1)), ((-0.5, 1), (-0.5, 0)), ((-0.5, 0), (0.5, 0)),
)  # fmt: skip
_DIGITS = ("012345", "12", "01346", "01236", "1256", "02356", "023456", "012", "0123456", "012356")


def _digit(digit: int, u: Array, v: Array, half_height: float = 0.07) -> Array:
    out = np.zeros(len(u))
    for segment in _DIGITS[digit]:
        (u0, v0), (u1, v1) = _SEGMENTS[int(segment)]
        start, end = (u0 * half_height, v0 * half_height), (u1 * half_height, v1 * half_height)
        out = np.maximum(out, _stroke(u, v, start, end, 0.022))
    return out


def _sewing(out: Array, c: Chart, style: Style, main: Array, second: Array, accent: Array) -> None:
    """Hems, cuffs, collar, buttons, pocket, cords."""
    front = (c.z > 0).astype(np.float64)
    dark = main * 0.55
    forearm = np.abs(joint("elbow", c.joints)[0] - joint("wrist", c.joints)[0])
    to_cuff = (style.sleeve - c.arm_along) * forearm
    cuff = 0.045 if style.top in ("hoodie", "shirt", "longsleeve") else 0.015
    rib = second * 0.8 if style.top in ("hoodie", "longsleeve") else dark
    _paint(out, _inside(cuff - to_cuff) * c.arm, rib)
    _paint(out, _inside(c.hem + (0.040 if style.top == "hoodie" else 0.012) - c.y), rib)
    _paint(out, _band(c.collar, -0.022, 0.05) * (c.neck_distance < NECK_OPENING + 0.018), rib)
    _paint(out, 0.6 * _band(c.arm_along, -0.10, -0.07) * c.arm, dark)  # shoulder seam
    if style.top in ("shirt", "polo"):
        _paint(
            out,
            _band(c.collar, -0.045, 0.05) * (c.neck_distance < NECK_OPENING + 0.03),
            main * 0.85 if style.top == "shirt" else second,
        )
        placket_end = c.hem if style.top == "shirt" else c.joints[JOINT_INDEX["spine3"], 1] + 0.02
        _paint(out, front * _band(c.x, -0.015, 0.015) * _inside(c.y - placket_end), main * 0.8)
        button = np.mod(c.y - c.hem, 0.075) - 0.037
        _paint(out, front * _ellipse(c.x, button, 0.0055, 0.0055) * _inside(c.y - placket_end), accent)
    if style.top == "shirt":
        u, v = c.x - 0.065, c.y - c.joints[JOINT_INDEX["spine3"], 1] - 0.035
        pocket = _band(u, -0.038, 0.038) * _band(v, -0.045, 0.045)
        edge = pocket - _band(u, -0.034, 0.034) * _band(v, -0.041, 0.036)
        _paint(out, front * np.clip(edge, 0, 1) * c.torso, second)
    if style.top == "hoodie":
        low = c.hem + 0.075
        width = 0.105 - 0.35 * np.clip(c.y - low - 0.05, 0, 1)
        pouch = _band(c.y, low, low + 0.125) * _inside(width - np.abs(c.x))
        inner = _band(c.y, low + 0.006, low + 0.119) * _inside(width - 0.006 - np.abs(c.x))
        _paint(out, front * np.clip(pouch - inner, 0, 1), main * 0.5)
        _paint(out, front * pouch * 0.25, main * 0.6)
        cord_top = c.joints[JOINT_INDEX["neck"], 1] - 0.06
        for x0 in (-0.028, 0.028):
            _paint(out, front * _stroke(c.x, c.y, (x0, cord_top), (x0 * 1.2, cord_top - 0.13), 0.007), accent)


def _bottom(c: Chart, style: Style) -> Array:
    main, accent = (np.asarray(colour) for colour in style.bottom_colours)
    out = _filled(c, style.bottom_colours[0])
    front, back = (c.z > 0).astype(np.float64), (c.z <= 0).astype(np.float64)
    across = np.abs(c.x)
    thigh = np.abs(joint("hip", c.joints)[1] - joint("knee", c.joints)[1])
    down = c.leg_along * thigh  # m below the hip joint
    to_cuff = (style.leg - c.leg_along) * thigh
    if style.bottom == "jeans":
        twill = value_noise(c.points @ np.array([[1, 0, 0], [0.7, 1, 0], [0, 0, 1]]), style.seed + 12, 330)
        out *= (0.80 + 0.40 * twill)[:, None]
        worn = np.exp(-(((c.leg_along - 0.55) / 0.5) ** 2)) * np.exp(-((c.outward / 0.04) ** 2)) * front
        _paint(out, 0.35 * worn, main * 1.5 + 0.10)
        _paint(out, 0.9 * _band(np.abs(c.forward), -0.001, 0.0025) * (c.outward > 0.02), main * 0.6)
        _paint(out, 0.8 * _band(np.abs(c.forward) - 0.007, -0.001, 0.001) * (c.outward > 0.02), accent)
    elif style.bottom == "track":
        for centre in (-0.022, 0.0, 0.022):
            _paint(out, _inside(0.006 - np.abs(c.forward - centre)) * (c.outward > 0.02), accent)
    elif style.bottom == "joggers":
        _paint(out, _inside(0.055 - to_cuff) * c.leg, main * 0.6)
        _paint(out, front * _stroke(c.outward + 0.01, down, (0.0, 0.06), (0.0, 0.17), 0.022), accent)
    else:
        crease = _inside(0.002 - np.abs(c.outward)) * c.leg
        _paint(out, 0.5 * crease, main * 0.75)
    if style.bottom in ("jeans", "chinos"):
        _paint(out, front * _stroke(across, c.y, (0.085, c.hem - 0.005), (0.150, c.hem - 0.075), 0.004), main * 0.55)
        u, v = across - 0.085, c.y - (c.hem - 0.065)
        pocket = _band(u, -0.045, 0.045) * _band(v, -0.055 + 0.3 * np.abs(u), 0.045)
        inner = _band(u, -0.041, 0.041) * _band(v, -0.051 + 0.3 * np.abs(u), 0.041)
        _paint(out, back * np.clip(pocket - inner, 0, 1), accent if style.bottom == "jeans" else main * 0.6)
        _paint(out, front * _band(c.x, -0.002, 0.002) * _inside(c.y - c.hem + 0.13), main * 0.5)
        _paint(out, _inside(0.012 - to_cuff) * c.leg, main * 0.7)
    return out * _folds(c, style, 0.30)


def _shoes(c: Chart, style: Style) -> Array:
    upper, trim = (np.asarray(colour) for colour in style.shoe_colours)
    out = _filled(c, style.shoe_colours[0])
    above_sole = c.y - c.sole
    ankle = joint("ankle", c.joints)
    forward = c.z - ankle[2]
    middle = np.abs(c.x) - np.interp(forward, [0, 0.14], [ankle[0], ankle[0] + 0.012])
    _paint(out, _inside(forward - 0.115) * _inside(above_sole - 0.02), upper * 0.8)  # toe cap
    laces = (
        _band(np.mod(forward, 0.016), 0.004, 0.010) * _band(forward, 0.035, 0.10) * _inside(0.020 - np.abs(middle))
    )
    _paint(out, laces * _inside(above_sole - 0.03), trim)
    for start in (0.0, 0.022):
        swoosh = _stroke(forward, above_sole, (start, 0.030), (start + 0.025, 0.065), 0.009)
        _paint(out, swoosh * (np.abs(middle) > 0.018), trim)
    _paint(out, _inside(0.020 - above_sole), trim if trim.mean() > upper.mean() else upper * 0.5)
    _paint(
        out, _inside(c.y - ankle[1] + 0.006), (0.90, 0.90, 0.88) if style.leg < 1.5 else upper * 0.6
    )  # sock, collar
    return out * _folds(c, style, 0.12)


# m of stand-off from the body
_STAND_OFF = {Part.UPPER_CLOTHES: 0.013, Part.TROUSERS: 0.012, Part.LEFT_SHOE: 0.009, Part.RIGHT_SHOE: 0.009}
_HAIR_STAND_OFF = {"short": 0.018, "crop": 0.010, "bob": 0.026}
_LOOSER = {"hoodie": 0.006, "shirt": 0.003}


def stand_off(body: Body, style: Style) -> Array:
    """[V, 3] m to add to the rest-pose vertices: cloth and hair stand off the body by 1–2 cm and more at the hems.

    This is what makes the true surface differ from the body mesh that a method is given, as in real captures.
    """
    chart = Chart(body.v_template, limb_groups(body.weights), body)
    label = part_labels(chart, style)
    distance = np.zeros(len(label))
    for part, metres in _STAND_OFF.items():
        distance[label == part] = metres
    distance[label == Part.HAIR] = _HAIR_STAND_OFF[style.hair_cut]
    top, bottom = label == Part.UPPER_CLOTHES, label == Part.TROUSERS
    crown = np.clip((chart.y - chart.eye_y) / 0.08, 0, 1)
    distance += (label == Part.HAIR) * 0.007 * (crown + fractal_noise(body.v_template, style.seed + 31, 22) - 0.5)
    wide = np.clip((body.joints[JOINT_INDEX["spine1"], 1] + 0.05 - chart.y) / 0.2, 0, 1)
    distance += top * (_LOOSER.get(style.top, 0) + 0.010 * wide * ~chart.arm)
    distance += (top & chart.arm) * 0.008 * np.clip(chart.arm_along / max(style.sleeve, 1), 0, 1) * (style.sleeve < 1)
    flare = {"jeans": 0.008, "track": 0.014, "chinos": 0.010, "joggers": 0.004}[style.bottom]
    distance += bottom * chart.leg * flare * np.clip(chart.leg_along / style.leg, 0, 1)
    folds = 0.010 * (value_noise(body.v_template, style.seed + 32, 9) - 0.5)
    folds += 0.006 * (value_noise(body.v_template, style.seed + 33, 26) - 0.5)
    distance += (top | bottom) * folds
    neighbours = _neighbour_mean(body.faces, len(distance))
    for _ in range(2):
        distance = 0.5 * distance + 0.5 * (neighbours @ distance)
    direction = vertex_normals(body.v_template, body.faces)
    for _ in range(6):
        direction = neighbours @ direction
    direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-9
    return distance[:, None] * direction


def _neighbour_mean(faces: NDArray[np.integer], n: int) -> csr_array:
    """[n, n] sparse matrix that replaces a value by the mean over the vertices an edge away."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, 1), axis=0)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    adjacent = coo_array((np.ones(len(i)), (i, j)), (n, n)).tocsr()
    degree = np.maximum(adjacent.sum(1), 1)
    return csr_array(diags_array(1 / degree) @ adjacent)


def bake(body: Body, style: Style, size: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Texture [S, S, 3] sRGB in [0, 1] and part labels [S, S] over the body's atlas; row 0 is v = 1.

    Texels outside every chart take the nearest chart's value, so bilinear look-ups at a seam do not bleed.
    """
    corners = np.column_stack([body.uv[:, 0] * size, (1 - body.uv[:, 1]) * size, np.ones(len(body.uv))])
    raster = rasterize(corners, body.uv_faces, size, size)
    hit = raster.mask
    on_body = np.concatenate([body.v_template, limb_groups(body.weights)], 1)
    corner, bary = body.faces[raster.face[hit]], raster.bary[hit].astype(np.float64)
    values = np.zeros((len(corner), on_body.shape[1]))
    for k in range(3):
        values += bary[:, [k]] * on_body[corner[:, k]]
    chart = Chart(values[:, :3], values[:, 3:], body)
    texture = np.zeros((size, size, 3), np.float32)
    labels = np.zeros((size, size), np.uint8)
    texture[hit], labels[hit] = albedo(chart, style), part_labels(chart, style)
    nearest = nearest_on_chart(hit)
    return texture.reshape(-1, 3)[nearest], labels.ravel()[nearest]
