"""Whether a capture can be what it says it is: its cameras, its poses, its masks, and how these lie on each other.

What every layout's `check` asks of its views. A *problem* is what no sound capture has: units, axes, masks of
something else. A *warning* is what a sound one may have and somebody should look at: estimated poses that are a
little off, loose masks, a person cut by the picture's edge. Bodies are drawn at a small size; a mask is compared with
them in both directions, with room for clothes and hair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.reading.capture_folder import CaptureFolder
from ihbench.errors import BadInput
from ihbench.files.pictures import read_picture
from ihbench.scene.copy_report import SubjectReport

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

COMPARED_CAMERAS, COMPARED_MASKS = 4, 48  # masks of a subject that are decoded, evenly spread
SIDE = 224  # px, longest side at which bodies and masks are compared
NEAREST, FARTHEST = 0.05, 100.0  # m; nobody films a person from there
CLOTHES = 0.03  # of the drawn body's height: how far garments and hair may stand off it
CLEARLY = 0.2  # how much more overlap tells that a change of the masks is what they need
SHIFTS = (1, 2, 3, 4, 5, 7, 10)  # frames by which masks and poses are tried against each other
CERTAIN = 0.08  # gain in overlap from which another order of the frames, or another place, is no chance
STEADY = 0.8  # share of the compared views in which a shift must fit better
LISTED = 3  # problems of one kind that are spelled out
SMALL = 20  # px, height of a person below which little can be learned
SOFT_VALUES = 32  # different grey values of a mask from which it is a matte and no label image

CHANGES: dict[str, Callable[[Mask], Mask]] = {  # what mistakes make of a mask
    "inverted": lambda mask: ~mask,
    "mirrored": lambda mask: mask[:, ::-1],
    "upside down": lambda mask: mask[::-1],
    "rotated": lambda mask: mask[::-1, ::-1],
}
ADVICE = {
    "inverted": "the masks look inverted; expected non-zero for the person, 0 for the rest",
    "mirrored": "pictures and geometry look mirrored left to right; flip the pictures or the geometry's x axis",
    "upside down": "pictures and geometry are upside down to each other; expected OpenCV axes, y down",
    "rotated": "pictures and geometry are turned by 180° to each other; expected OpenCV axes, x right, y down",
    "head down": "the body stands on its head in its place; turn the root of the poses by 180° about its x axis",
    "half": "K looks like that of pictures half as large; multiply its first two rows by 2",
    "double": "K looks like that of pictures twice as large; divide its first two rows by 2",
}
SCALES = {"half": 2.0, "double": 0.5}
PLACES = {  # what is wrong with where the body stands before a camera
    "far": f"the body is {{value:.4g}} m in front of it, more than {FARTHEST:.0f} m: t or transl look like {{unit}}; "
    "expected metres, divide by {factor}",
    "near": f"the body is {{value:.3g}} m in front of it, less than {NEAREST} m: t or transl are not in metres, or "
    "one of them is missing",
    "behind": "sees no body in the sampled frames; it is {value:.3g} m behind it: expected R, t from world to "
    "camera, with OpenCV axes (z forward)",
    "aside": "sees no body in the sampled frames; it is {value:.3g} m in front of it, out of the picture: check K, "
    "R, t and the frames of the poses",
    "inside": "stands inside the body, whose middle is {value:.3g} m in front of it; check the units of t and transl",
    "small": "the person is {value:.0f} px tall; expected pictures with more of them, or check the units of t and "
    "transl",
    "cut": "only {value:.0%} of the body lies in the picture; right for close-ups, else check K and the units of t "
    "and transl",
}


@dataclass
class Outline:
    """A posed body as it can be drawn: with faces, or vertices alone where the model file is not at hand."""

    vertices: Array  # [V, 3] m, world
    faces: NDArray[np.int32] | None = field(default=None)  # [F, 3]

    def drawn(self, view: Camera) -> tuple[Array, Mask]:
        """(points [V, 3]: x px, y px, depth m; silhouette [H, W]) of a view without much size."""
        from scipy.ndimage import binary_closing

        from ihbench.render.zbuffer import rasterize

        points = view.project(self.vertices)
        if self.faces is not None:
            return points, rasterize(points, self.faces, view.height, view.width).mask
        dots = np.zeros((view.height, view.width), bool)
        seen = _in_picture(points, view.height, view.width)
        dots[points[seen, 1].astype(int), points[seen, 0].astype(int)] = True
        return points, np.asarray(binary_closing(np.pad(dots, 8), iterations=4)[8:-8, 8:-8], bool)


@dataclass
class Overlap:
    """How one mask lies on the body of its frame. Shares in [0, 1]."""

    camera: int
    frame: int
    mask: Mask  # [h, w]
    body: Mask  # [h, w]
    view: Camera  # of that size
    outline: Outline
    vertices_in_mask: float  # of the body's vertices, the mask grown by 1 % of the picture's width
    mask_on_body: float  # of the mask, the body grown by `CLOTHES`; 1 for an empty mask
    iou: dict[str, float]  # by what is changed, "" for nothing; all others only where that is low

    @property
    def area(self) -> float:
        """Of the picture that is mask."""
        return float(self.mask.mean())

    @property
    def body_area(self) -> float:
        return float(self.body.mean())

    @property
    def border(self) -> float:
        """Of the picture's border that is mask."""
        return float(np.concatenate([self.mask[0], self.mask[-1], self.mask[:, 0], self.mask[:, -1]]).mean())

    @property
    def in_picture(self) -> float:
        """The share of the body's vertices that lie in the picture."""
        return share_inside(self.view.project(self.outline.vertices), np.ones_like(self.mask))


def share_inside(points: Array, region: Mask) -> float:
    """The share of projected points [V, 3] (x px, y px, depth m) that fall on the region [H, W]."""
    column, row = points[_in_picture(points, *region.shape), :2].astype(int).T
    return float(region[row, column].sum()) / len(points)


def _in_picture(points: Array, height: int, width: int) -> Mask:
    with np.errstate(invalid="ignore"):
        x, y = points[:, 0], points[:, 1]
        return (points[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)


@np.errstate(all="ignore")  # absurd numbers overflow, and are named
def examine(
    capture: CaptureFolder,
    views: Sequence[tuple[int, int]],  # (camera, frame) that have image, mask and pose
    report: SubjectReport,  # gets problems, warnings and what was measured
    *,
    whole: bool | None,  # masks show whole people (True), what is not hidden (False), or nobody knows (None)
    outline: Callable[[int], Outline] | None,  # the body of a frame; None: no model at hand
    exact: bool = True,  # False: another body stands for the capture's own
    samples: int = 3,  # images of a camera that are decoded
) -> None:
    """Decode a few views and say what cannot be, or may not be, right about cameras, poses, masks and their fit.

    Reports the sampled images, their sizes and, with an outline, `vertices_in_mask` and `mask_on_body`.
    """
    _check_poses(capture, report)
    usable = _check_cameras(capture, report)
    posed: dict[int, Outline] = {}
    plausible = False
    aimed = set(usable)
    views = _spread(views)
    if outline is not None:
        frames = sorted({frame for _, frame in views}) or range(0, capture.n_frames, max(1, capture.n_frames // 3))
        posed = readable(frames, outline, lambda frame: f"frame {capture.label(frame)}", report)
        plausible = _check_shape(capture, report)
        aimed = set(_check_placement(capture, usable, list(posed.values())[:: max(1, len(posed) // 8)], report))
    _check_images(capture, views, samples, report)
    masks = readable(views, lambda v: capture.silhouette(*v), lambda v: _views(capture, [v]), report)
    if not masks:
        return
    _check_softness(capture, masks, report)
    whole_pictures = [view for view, mask in masks.items() if mask.mean() > 0.98]
    if len(whole_pictures) == len(masks):
        report.problem("the masks cover whole pictures; expected 0 where the person is not")
        return
    if len(empty := [view for view, mask in masks.items() if not mask.any()]) == len(masks):
        report.problem("the masks show no person in any pixel; expected white where the person is seen, 0 elsewhere")
        return
    if not posed or not plausible:
        _check_masks_alone(masks, empty, whole_pictures, capture, whole, report)
        return
    fits = [
        _overlap(capture.camera(camera), posed[frame], mask, camera, frame)
        for (camera, frame), mask in masks.items()
        if camera in aimed and frame in posed
    ]
    assert outline is not None
    _check_fit(capture, fits, report, whole, exact, outline)


def _spread(views: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """At most `COMPARED_MASKS` of the views, of at most `COMPARED_CAMERAS` cameras, first and last among them."""
    by_camera: dict[int, list[int]] = {}
    for camera, frame in sorted(views):
        by_camera.setdefault(camera, []).append(frame)
    cameras = _evenly(list(by_camera), COMPARED_CAMERAS)
    each = COMPARED_MASKS // max(1, len(cameras))
    return [(camera, frame) for camera in cameras for frame in _evenly(by_camera[camera], each)]


def _evenly(items: Sequence[Any], count: int) -> list[Any]:
    picked = np.linspace(0, len(items) - 1, min(count, len(items))).astype(int)
    return [items[k] for k in sorted(set(picked.tolist()))]


def readable(
    items: Iterable[Any], read: Callable[[Any], Any], name: Callable[[Any], str], report: SubjectReport
) -> dict:
    """What can be read of the items, by item. The first few that cannot are named, the others counted."""
    usable, errors = {}, {}
    for item in items:
        try:
            usable[item] = read(item)
        except BadInput as error:
            errors.setdefault(str(error), item)
    for text, item in list(errors.items())[:LISTED]:
        report.problem(text if "/" in text else f"{name(item)}: {text}")
    if len(errors) > LISTED:
        report.problem(f"and so on: {len(errors)} such of {len(usable) + len(errors)} looked at")
    return usable


# ----------------------------------------------------------------------------------------- cameras, poses


def _check_cameras(capture: CaptureFolder, report: SubjectReport) -> list[int]:
    """Name cameras that nobody has; return those that can be drawn with."""
    usable, same = [], {}
    for camera, name in enumerate(capture.camera_ids):
        try:
            view = capture.camera(camera)
        except BadInput as error:
            if len(capture.camera_ids) == 1 or not capture.standin:  # a stand-in lacks images it was not asked for
                report.problem(str(error))
            continue
        if complaint := absurd_camera(view):
            report.problem(f"camera {name}: {complaint}")
            continue
        if suspicion := suspicious_camera(view):
            report.warn(f"camera {name}: {suspicion}")
        usable.append(camera)
        same.setdefault((view.K.tobytes(), view.R.round(9).tobytes(), view.t.round(9).tobytes()), []).append(name)
    for names in (names for names in same.values() if len(names) > 1):
        report.problem(
            f"cameras {some(names)}: have one and the same K, R and t; expected each camera's own calibration"
        )
    return usable


def absurd_camera(view: Camera) -> str:
    """What no camera can be, in one line; empty for others. Size and K only: what it sees is another question."""
    side, (x, y), focal = max(view.width, view.height), view.K[:2, 2], (view.K[0, 0], view.K[1, 1])
    size = f"{view.width}×{view.height} px"
    if not 0.2 <= focal[0] / focal[1] <= 5:
        return f"focal lengths {focal[0]:.4g} and {focal[1]:.4g} px; expected about the same in x and y"
    for length in focal:
        if not 0.15 * side <= length <= 200 * side:
            angle = 2 * np.degrees(np.arctan2(side / 2, length))
            return (
                f"focal length {length:.4g} px for {size}, a field of view of {angle:.3g}°; expected pixels of these "
                f"pictures, about 0.5 to 5 times their longer side"
            )
    if max(abs(x / view.width - 0.5), abs(y / view.height - 0.5)) > 5:
        return f"principal point ({x:.4g}, {y:.4g}) px, far outside {size}; expected pixels, near the middle"
    return ""


def suspicious_camera(view: Camera) -> str:
    """What few cameras are, in one line; empty for others."""
    side, focal, centre = max(view.width, view.height), (view.K[0, 0], view.K[1, 1]), view.K[:2, 2]
    x, y = 2 * centre / (view.width, view.height)
    size = f"{view.width}×{view.height} px"
    if abs(x - y) < 0.15 * max(x, y) and not 0.65 < max(x, y) < 1.55:
        return (
            f"K looks like that of pictures of about {2 * centre[0]:.0f}×{2 * centre[1]:.0f} px, but these are "
            f"{size}; scale its first two rows with the pictures, unless these are a corner cut out of larger ones"
        )
    if not (0 <= x <= 2 and 0 <= y <= 2):
        place = f"({centre[0]:.4g}, {centre[1]:.4g})"
        return f"principal point {place} px lies outside {size}; right only for cut-out pictures"
    if not 0.8 <= focal[0] / focal[1] <= 1.25:
        return f"focal lengths {focal[0]:.4g} and {focal[1]:.4g} px; few cameras have pixels that are not square"
    if min(focal) < 0.4 * side or max(focal) > 25 * side:
        return f"focal length {focal[0]:.4g} px for {size}; few cameras have that, check its unit"
    return ""


def _check_placement(
    capture: CaptureFolder, cameras: Sequence[int], posed: Sequence[Outline], report: SubjectReport
) -> list[int]:
    """Name cameras with implausible units or without the body in view; return the others."""
    groups: dict[str, list[tuple[int, float]]] = {kind: [] for kind in PLACES}  # camera, and m, px or share
    good = []
    for camera in cameras if posed else ():
        view = capture.camera(camera)
        points = np.concatenate([view.project(body.vertices) for body in posed])
        depth = float(np.median(points[:, 2]))
        share = share_inside(points, np.ones((view.height, view.width), bool))
        if abs(depth) > FARTHEST:
            groups["far"].append((camera, depth))
        elif abs(depth) < NEAREST:
            groups["near"].append((camera, depth))
        elif share == 0:
            groups["behind" if depth < 0 else "aside"].append((camera, depth))
        elif float((points[:, 2] < NEAREST).mean()) > 0.02:
            groups["inside"].append((camera, depth))
        else:
            good.append(camera)
            height = float(np.median([np.ptp(view.project(body.vertices)[:, 1]) for body in posed]))
            groups["small"] += [(camera, height)] if height < SMALL else []
            groups["cut"] += [(camera, share)] if share < 0.4 else []
    for kind, group in groups.items():
        if group:
            value = abs(group[0][1])
            unit, factor = ("millimetres", 1000) if value > 900 else ("centimetres", 100)
            text = PLACES[kind].format(value=value, unit=unit, factor=factor)
            tell = report.warn if kind in ("small", "cut") else report.problem
            names = [capture.camera_ids[camera] for camera, _ in group]
            tell(f"camera{'s' * (len(names) > 1)} {some(names)}: {text}")
    return good


def _check_poses(capture: CaptureFolder, report: SubjectReport) -> None:
    """Name rotations, shapes and motions that people do not have."""
    poses: dict[int, BodyPose] = {}
    for frame in _evenly(range(capture.n_frames), 2 * COMPARED_MASKS):
        try:
            poses[frame] = capture.stored_pose(frame)
        except BadInput:
            continue  # named by the layout, or where the frame is looked at
    if not poses:
        return
    frames = list(poses)
    turns = np.linalg.norm([pose.pose for pose in poses.values()], axis=2)  # [N, 24]
    if turns.max() > 4 * np.pi:
        report.problem(
            f"frame {frames[int(turns.max(1).argmax())]}: a joint turned by {turns.max():.3g} rad; expected "
            f"axis-angle rotations in radians, multiply by π/180 if these are degrees"
        )
    elif np.median(turns[:, 1:].max(1)) > np.pi:
        report.warn(
            f"in most frames a joint is turned by more than half a turn ({np.median(turns[:, 1:].max(1)):.3g} rad); "
            f"expected axis-angle rotations in radians"
        )
    largest = max(float(np.abs(pose.betas).max(initial=0)) for pose in poses.values())
    if largest > 6:
        report.warn(f"a shape coefficient of {largest:.3g}; bodies of people have betas of about -3 to 3")
    if len(poses) > 2 and np.ptp([pose.pose for pose in poses.values()], axis=0).max() < 1e-9:
        still = _masks_stand_still(capture, [frame for frame in frames if not capture.lacks(0, frame)])
        text = f"all {len(poses)} poses looked at are the same"
        why = "; right for somebody who stands still," if still else ", but the masks move;"
        (report.warn if still else report.problem)(f"{text}{why} expected a pose for each frame")


def _masks_stand_still(capture: CaptureFolder, frames: Sequence[int]) -> bool:
    try:
        masks = [capture.silhouette(0, frame) for frame in _evenly(frames, 6)]
    except BadInput:
        return True
    return all(_iou(mask, masks[0]) > 0.9 for mask in masks if mask.shape == masks[0].shape and mask.any())


def _check_shape(capture: CaptureFolder, report: SubjectReport) -> bool:
    """Name betas that make no body; False for those."""
    try:
        body_pose, model = capture.stored_pose(0), capture.model
    except BadInput:
        return True
    vertices = model.shaped(body_pose.betas)[0]
    height = float(np.ptp(vertices, axis=0).max())
    moved = float(np.linalg.norm(vertices - model.v_template, axis=1).max())
    if not 0.4 <= height <= 3 or moved > 0.8:
        report.problem(
            f"its betas make a body of {height:.3g} m with vertices {moved:.3g} m from the mean body's; expected "
            f"shape coefficients of about -3 to 3, and a body in metres"
        )
        return False
    if not 1.1 <= height <= 2.3:
        report.warn(f"its betas make a body of {height:.3g} m, arms spread; expected the size of a person")
    return True


# ------------------------------------------------------------------------------------------ images, masks


def _check_images(
    capture: CaptureFolder, views: Sequence[tuple[int, int]], samples: int, report: SubjectReport
) -> None:
    """Decode `samples` images a camera and the image after each: damaged ones, and pictures that stand still."""
    sizes, decoded_images = set(), 0
    for camera in sorted({camera for camera, _ in views}):
        frames = [frame for other, frame in views if other == camera]
        seen: dict[int, bytes] = {}
        for frame in _evenly(frames, samples):
            try:
                image = capture.image(camera, frame)
                decoded_images += 1
                sizes.add((image.shape[1], image.shape[0]))
                seen[frame] = image.tobytes()
                if not capture.lacks(camera, frame + 1):
                    seen[frame + 1] = capture.image(camera, frame + 1).tobytes()
            except BadInput as error:
                report.problem(str(error))
        repeated = [f for f in seen if f - 1 in seen and seen[f] == seen[f - 1]]
        name = "" if len(capture.camera_ids) == 1 else f" of camera {capture.camera_ids[camera]}"
        if len(seen) > 2 and len(set(seen.values())) == 1:
            still = _one_pose(capture, seen)
            reason = "right for drawings of somebody who stands still, " if still else ""
            (report.warn if still else report.problem)(
                f"all {len(seen)} pictures looked at{name} are one and the same; {reason}"
                f"expected a picture for each frame"
            )
        elif repeated:
            report.warn(
                f"frame {repeated[0]}{name} shows the picture of frame {repeated[0] - 1} again, as "
                f"{len(seen) - len(set(seen.values()))} of {len(seen)} looked at do; expected one picture a frame"
            )
    report.sampled_images = decoded_images
    report.image_size = sorted([list(size) for size in sizes])


def _check_softness(capture: CaptureFolder, masks: dict[tuple[int, int], Mask], report: SubjectReport) -> None:
    """Name mattes: what a threshold at zero and one in the middle make of them differs."""
    soft: list[tuple[float, float, float, int, Path]] = []
    for camera, frame in _evenly(list(masks), 8):
        paths = (path for path in capture.files_of(camera, frame, "mask")[1:] if path.suffix.lower() == ".png")
        try:
            picture = read_picture(path := next(paths), colours_matter=False)
        except (StopIteration, BadInput):  # no picture; a damaged one is named where the mask was read
            continue
        values = picture.colour.max(2)
        n_values, middle = len(np.unique(values)), float((values > picture.white / 2).mean())
        read = float(masks[camera, frame].mean())
        if n_values > SOFT_VALUES and read > 1.1 * middle:
            soft.append((read - middle, read, middle, n_values, path))
    if soft:
        more, read, middle, n_values, path = max(soft)
        text = (
            f"{path}: a soft mask of {n_values} grey values; read as it is {read:.0%} of the picture are the person, "
            f"of the values above the middle {middle:.0%}: threshold the masks at 128 and write 0 and 255"
        )
        (report.problem if more > 0.1 or read > 1.5 * middle else report.warn)(text)


def _one_pose(capture: CaptureFolder, frames: Iterable[int]) -> bool:
    """Whether the person stands still in these frames, by the poses."""
    try:
        poses = [capture.body_pose(frame) for frame in frames]
    except BadInput:  # named where poses are looked at
        return False
    moved = [np.ptp([part(pose) for pose in poses], axis=0).max() for part in (lambda p: p.pose, lambda p: p.transl)]
    return max(moved) < 1e-9


def _check_masks_alone(
    masks: dict[tuple[int, int], Mask],
    empty: list[tuple[int, int]],
    full: list[tuple[int, int]],
    capture: CaptureFolder,
    whole: bool | None,
    report: SubjectReport,
) -> None:
    """What masks say without a body to hold against them."""
    from scipy.ndimage import label

    if full:
        report.problem(
            f"{len(full)} of {len(masks)} masks looked at cover whole pictures ({_views(capture, full)}); expected 0 "
            f"where the person is not"
        )
    if empty:
        text = f"{len(empty)} of {len(masks)} masks looked at are empty ({_views(capture, empty)})"
        (report.problem if whole else report.warn)(text)
    share = float(np.median([mask.mean() for mask in masks.values()]))
    if share > 0.6:
        report.warn(f"the masks make {share:.0%} of the pictures a person; right for close-ups only")
    several = []
    for view, mask in masks.items():
        rows, columns = (np.linspace(0, n - 1, min(n, SIDE)).round().astype(int) for n in mask.shape)
        parts: Any = label(mask[rows][:, columns])  # [h, w] with numbers, and how many
        sizes = np.sort(np.bincount(parts[0].ravel())[1:])
        if len(sizes) > 1 and sizes[-2] > 0.25 * sizes[-1]:
            several.append(view)
    if whole and len(several) > len(masks) / 2:
        report.warn(
            f"{len(several)} of {len(masks)} masks looked at show two shapes ({_views(capture, several)}); expected "
            f"one person, other people are background"
        )


# ---------------------------------------------------------------------------------------- masks and bodies


def _overlap(view: Camera, body: Outline, mask: Mask, camera: int, frame: int) -> Overlap:
    from scipy.ndimage import binary_dilation

    shrink = min(1.0, SIDE / max(view.width, view.height))
    small = view.scaled(max(1, round(view.width * shrink)), max(1, round(view.height * shrink)))
    rows = ((np.arange(small.height) + 0.5) * mask.shape[0] / small.height).astype(int)
    columns = ((np.arange(small.width) + 0.5) * mask.shape[1] / small.width).astype(int)
    part = mask[rows][:, columns]  # the nearest pixels
    points, drawn = body.drawn(small)
    grown = np.asarray(binary_dilation(part, iterations=max(1, small.width // 100)), bool)
    iou = {"": _iou(part, drawn)}
    if iou[""] < 1 - CLEARLY:
        iou |= {name: _iou(change(part), drawn) for name, change in CHANGES.items()}
        iou["head down"] = _iou(part, _on_its_head(drawn))
        for name, factor in SCALES.items():
            scaled = replace(small, K=np.diag([factor, factor, 1.0]) @ small.K)
            iou[name] = _iou(part, body.drawn(scaled)[1])
    inside, on_body = share_inside(points, grown), _on_body(part, drawn)
    return Overlap(camera, frame, part, drawn, small, body, inside, on_body, iou)


def _on_body(mask: Mask, drawn: Mask) -> float:
    from scipy.ndimage import binary_dilation

    if not mask.any():
        return 1.0
    rows = np.flatnonzero(drawn.any(1))
    margin = max(1, round(CLOTHES * (np.ptp(rows) + 1))) if len(rows) else 1
    return float(np.asarray(binary_dilation(drawn, iterations=margin))[mask].mean())


def _on_its_head(drawn: Mask) -> Mask:
    """The silhouette turned about the middle of its own box."""
    from scipy.ndimage import find_objects

    turned = np.zeros_like(drawn)
    for window in find_objects(drawn.astype(np.uint8)):
        turned[window] = drawn[window][::-1]
    return turned


def _iou(a: Mask, b: Mask) -> float:
    return float((a & b).sum()) / max(1, int((a | b).sum()))


def _check_fit(
    capture: CaptureFolder,
    fits: list[Overlap],
    report: SubjectReport,
    whole: bool | None,
    exact: bool,
    outline: Callable[[int], Outline],
) -> None:
    """Say the likeliest reason why masks and bodies do not lie on each other, if they do not."""
    visible = [fit for fit in fits if fit.area > 0]
    if not visible:
        return
    empty = [(fit.camera, fit.frame) for fit in fits if fit.area == 0 and (fit.body_area > 0.005 or whole is False)]
    are_empty = f"{len(empty)} of {len(fits)} masks looked at are empty ({_views(capture, empty)})"
    if empty and whole is False:
        report.warn(are_empty)
    inside = report.vertices_in_mask = round(float(np.mean([fit.vertices_in_mask for fit in visible])), 4)
    covered = report.mask_on_body = round(float(np.mean([fit.mask_on_body for fit in visible])), 4)
    low = [fit for fit in visible if len(fit.iou) > 1]
    iou = {change: float(np.mean([fit.iou[change] for fit in low])) for change in (low[0].iou if low else ())}
    if float(np.mean([fit.border for fit in visible])) < 0.5:  # what is not the person reaches the picture's border
        iou.pop("inverted", None)
    best = max(iou, key=lambda change: iou[change], default="")
    if best and len(low) > len(visible) / 2 and iou[best] > iou[""] + CLEARLY:
        report.problem(
            f"{ADVICE[best]} (overlap {iou['']:.0%} as stored, {iou[best]:.0%} {best}; {inside:.0%} of the body's "
            f"vertices project into the silhouettes)"
        )
        return
    if _check_single_views(capture, fits, whole, report):
        return
    if empty and whole is True:
        report.problem(f"{are_empty}; make these masks anew or leave the frames out")
    elif empty and whole is None:
        report.warn(f"{are_empty}; right only where something hides the whole person")
    lowest_covered, lowest_inside = (0.75, 0.85) if exact else (0.5, 0.7)
    bad = covered < lowest_covered or (whole is True and inside < lowest_inside)
    odd = exact and (covered < 0.9 or (whole is True and inside < 0.95))
    reasons = [_shift(visible), _wrong_order(capture, visible, outline) if exact else None]
    if likely := [reason for reason in reasons if reason]:
        gain, text = max(likely)
        bad |= gain > CERTAIN
    elif bad or odd:
        text = _unlike(visible, covered, inside)
    elif whole is not True and inside < 0.3 * float(np.mean([fit.in_picture for fit in visible])):
        text = "right only if something hides the rest"
    else:
        return
    text = (
        f"{inside:.0%} of the body's vertices project into the silhouettes and {covered:.0%} of the silhouettes "
        f"lie on the body, expected over 95 % and 90 %: {text}"
    )
    (report.problem if bad else report.warn)(text)


def _check_single_views(
    capture: CaptureFolder, fits: Sequence[Overlap], whole: bool | None, report: SubjectReport
) -> bool:
    """Name views whose mask shows another thing than the body, where most fit; False where none is named."""
    out, others = [], []
    for fit in fits:
        empty = fit.area == 0 and fit.body_area > 0.005 and whole is not False
        off = fit.area > 0.05 * fit.body_area and fit.mask_on_body < 0.5
        bad = empty or off or (whole is True and fit.vertices_in_mask < 0.5)
        (out if bad else others).append(fit)
    if not out or len(out) > 0.4 * len(fits):
        return False
    fitting = np.mean([[fit.mask_on_body, fit.vertices_in_mask if whole else 1] for fit in others], axis=0)
    if fitting.min() < 0.85:
        return False
    worst = min(out, key=lambda fit: fit.mask_on_body if fit.area else 0)
    state = f"has {worst.mask_on_body:.0%} on the body, and {worst.vertices_in_mask:.0%} of it"
    state = "is empty" if not worst.area else "covers the whole picture" if worst.area > 0.98 else state
    report.problem(
        f"{len(out)} of {len(fits)} masks looked at do not show the body of their frame "
        f"({_views(capture, [(fit.camera, fit.frame) for fit in out])}; that of frame {capture.label(worst.frame)} "
        f"{state}); make these masks anew or leave the frames out"
    )
    return True


def _unlike(fits: Sequence[Overlap], covered: float, inside: float) -> str:
    """What the masks have that the bodies lack, where no single change helps."""
    share, body = (float(np.median([getattr(fit, name) for fit in fits])) for name in ("area", "body_area"))
    if covered < 0.9 and (share > 1.1 * body if inside > 0.85 else inside > 0.6 and share > body * inside):
        return (
            f"the masks make {share:.0%} of the pictures a person, the body is {body:.0%}; other people, things or a "
            f"soft matte's haze may be in them"
        )
    return "check units, cameras, the order of the frames, and whether the masks are this person's"


def _shift(fits: Sequence[Overlap]) -> tuple[float, str] | None:
    """How much overlap is to be gained, and the advice to move the masks; None where none helps all views."""
    from scipy.fft import irfft2, rfft2
    from scipy.ndimage import shift

    moves = []
    for fit in _evenly(fits, 8):
        size = 2 * fit.mask.shape[0], 2 * fit.mask.shape[1]  # padded: nothing wraps around
        spectra = np.asarray(rfft2(fit.body, size)), np.asarray(rfft2(fit.mask, size))
        score = np.asarray(irfft2(spectra[0] * np.conj(spectra[1]), size))
        y, x = np.unravel_index(int(score.argmax()), size)
        y, x = (int(v - n if v >= n // 2 else v) for v, n in ((y, size[0]), (x, size[1])))
        moved = np.asarray(shift(fit.mask, (y, x), order=0), bool)
        moves.append((x / fit.mask.shape[1], y / fit.mask.shape[0], _iou(moved, fit.body), fit.iou[""]))
    x, y, there, before = np.mean(moves, axis=0)
    if there < before + CLEARLY or there < 0.6 or np.std(moves, axis=0)[:2].max() > 0.02:
        return None
    sides = [f"{abs(x):.0%} of the width to the {'left' if x < 0 else 'right'}"] if abs(x) >= 0.01 else []
    sides += [f"{abs(y):.0%} of the height {'up' if y < 0 else 'down'}"] if abs(y) >= 0.01 else []
    text = f"moved by {' and '.join(sides)} the masks would overlap by {there:.0%}, not {before:.0%}"
    return float(there - before), f"{text}; check cropping and cx, cy"


def _wrong_order(
    capture: CaptureFolder, fits: Sequence[Overlap], outline: Callable[[int], Outline]
) -> tuple[float, str] | None:
    """How much overlap is to be gained, and the word that masks and poses count other frames; None elsewhere."""
    own = [fit for fit in fits if fit.camera == fits[0].camera]
    if np.mean([fit.iou[""] for fit in own]) > 0.96 or len(own) < 3:
        return None
    view, sampled = own[0].view, _evenly(own, 8)
    bodies = {fit.frame: fit.body for fit in own}

    def body(frame: int) -> Mask:
        if frame not in bodies:
            bodies[frame] = outline(frame).drawn(view)[1]
        return bodies[frame]

    def gain(fit: Overlap, frame: int) -> float:
        """How much better the body of another frame lies on the mask; 0 where only one of both shares gains."""
        drawn = body(frame)
        on = float(drawn[fit.mask].mean()) - float(fit.body[fit.mask].mean())
        return min(_iou(fit.mask, drawn) - fit.iou[""], on) if on > 0 else min(0.0, on)

    def gains(sign: int, start: int) -> list[float]:
        """With the poses of the frames start + sign · frame."""
        pairs = [(fit, start + sign * fit.frame) for fit in sampled]
        return [gain(fit, frame) for fit, frame in pairs if 0 <= frame < capture.n_frames and frame != fit.frame]

    candidates = {f"{k} frame{'s' * (k > 1)} later": (1, k) for k in SHIFTS}
    candidates |= {f"{k} frame{'s' * (k > 1)} earlier": (1, -k) for k in SHIFTS}
    candidates["the reversed order"] = -1, capture.n_frames - 1
    try:
        tried = {name: values for name, order in candidates.items() if len(values := gains(*order)) > 2}
        any_frame = [max((gain(fit, other.frame) for other in own if other is not fit), default=0) for fit in sampled]
    except BadInput:  # named where that frame is looked at
        return None
    before = float(np.mean([fit.iou[""] for fit in sampled]))
    name = max(tried, key=lambda name: np.mean(tried[name]), default="")
    if name and np.mean(tried[name]) > 0.015 and np.mean(np.array(tried[name]) > 0) >= STEADY:
        better = float(np.mean(tried[name]))
        advice = "check that pictures and poses count the same frames, from the same first one"
        text = f"the masks fit the poses of {name} better (by {better:.0%}, overlap {before:.0%} as stored)"
        return better, f"{text}; {advice}"
    if before < 0.9 and np.mean(np.array(any_frame) > CERTAIN) > 0.5:
        number = sum(value > CERTAIN for value in any_frame)
        text = f"{number} of {len(any_frame)} masks fit the pose of another frame better than their own"
        return float(np.mean(any_frame)), f"{text}; check that pictures and poses are in one order"
    return None


# ----------------------------------------------------------------------------------------------- wording


def _views(capture: CaptureFolder, views: Sequence[tuple[int, int]]) -> str:
    """ "frames 3, 4, 10, …", with the camera where there are several."""
    several = len(capture.camera_ids) > 1
    labels = [capture.label(frame) for _, frame in views]
    named = [f"{capture.camera_ids[c]}/{n}" if several else n for (c, _), n in zip(views, labels, strict=True)]
    return f"frame{'s' * (len(named) > 1)} {some(named)}"


def some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
