"""What pose estimators give, as a `Camera` and a `BodyPose`; pure functions, one person of one frame a call.

Arrays, tensors and lists are taken, with dimensions of one as batches leave them.

All of them pose SMPL in its standard root convention, v = R(theta_0) (v0 - J0) + J0 + t: about the pelvis joint, then
the translation. EasyMocap alone keeps ZJU-MoCap's root (`root_convention`). Outputs in the camera's frame have OpenCV
axes (x right, y down, z forward), so an upright person's root is turned by about pi about x.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.body.root_convention import from_zju_root
from ihbench.body.skeleton import SMPLX_SIZES, pose_hint
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, as_numbers, check_intrinsics, check_rotation, whole_pixels, without_rounding
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.body.model import Body

Array = NDArray[np.float64]

SMPLX_PELVIS = (0.0031, -0.3514, 0.0120)  # m, joint 0 of SMPL-X's neutral mean body at rest
SIX_D_LAYOUTS = ("columns", "interleaved", "rows")
UP_AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
WORLD_AXES = {f"{sign}{axis}": s * np.eye(3)[k] for k, axis in enumerate("xyz") for sign, s in (("+", 1), ("-", -1))}


def from_weak_perspective(
    pose: Any,  # [72] or [24, 3] rad, or rotation matrices [24, 3, 3]; root in the camera's frame
    betas: Any,  # [B]
    scale_translation: Any,  # (s, tx, ty) of the crop camera
    box: Any,  # (cx, cy, size) px: centre and side of the square crop in the full image, whose corner is (0, 0)
    focal: float,  # px, of the full image
    width: int,
    height: int,
) -> tuple[Camera, BodyPose]:
    """HMR, SPIN, VIBE, 4D-Humans: a crop camera -> a pinhole camera at the origin and the body in front of it.

    The crop camera maps a body point (X, Y, Z) to x = s (X + tx), y = s (Y + ty) in [-1, 1]², that is, to column
    cx + size/2 · s (X + tx) of the full image. The pinhole camera maps it to width/2 + focal (X + Tx) / (Z + Tz).
    Equal at Z = 0 for every X when focal / Tz = s · size / 2 and focal Tx / Tz = cx - width/2 + s · size / 2 · tx:

        Tz = 2 focal / (s · size)
        Tx = tx + 2 (cx - width/2) / (s · size),   Ty likewise with cy and height

    For other Z, distances from the image's centre differ by the factor 1 + Z / Tz, as perspective has it. A wrong
    `focal` moves the body nearer or farther and hardly moves its pixels. Raises `BadInput`.
    """
    s, tx, ty = _numbers("scale and translation (s, tx, ty)", scale_translation, (3,))
    cx, cy, size = _numbers("crop box (cx, cy, size)", box, (3,))
    f = float(_numbers("focal length", focal, ()))
    if s <= 0 or size <= 0 or f <= 0:
        raise BadInput(
            f"weak perspective: expected scale, box size and focal length above 0, got {s:.4g}, {size:.4g}, {f:.4g}"
        )
    width, height = whole_pixels(width), whole_pixels(height)
    per_metre = s * size / 2  # px
    transl = [tx + (cx - width / 2) / per_metre, ty + (cy - height / 2) / per_metre, f / per_metre]
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    return Camera(K, np.eye(3), np.zeros(3), width, height), BodyPose(_pose(pose), _betas(betas), np.array(transl))


def from_camera_space(
    pose: Any,  # [72] or [24, 3] rad, or rotation matrices [24, 3, 3]; root in the camera's frame
    betas: Any,  # [B]
    transl: Any,  # [3] m, in the camera's frame
    K: Any,  # [3, 3] px, (fx, fy, cx, cy), or a focal length: then the principal point is the image's centre
    width: int,
    height: int,
    pixel_center: float = 0.5,  # where K puts the centre of the first pixel; OpenCV's calibration: 0.0
) -> tuple[Camera, BodyPose]:
    """ROMP and BEV (cam_trans), WHAM ("incam"), TRAM, and GVHMR after `from_smplx`: a body before a pinhole camera.

    Their camera is the origin of the world here. Raises `BadInput`, also for a body behind the camera.
    """
    width, height = whole_pixels(width), whole_pixels(height)
    transl = _numbers("transl", transl, (3,))
    if transl[2] <= 0:
        raise BadInput(
            f"transl: expected the body in front of the camera, got z = {transl[2]:.4g} m; "
            f"turn OpenGL axes into OpenCV's (y down, z forward) first"
        )
    camera = Camera(_K(K, width, height, pixel_center), np.eye(3), np.zeros(3), width, height)
    return camera, BodyPose(_pose(pose), _betas(betas), transl)


def from_world(
    pose: Any,  # [72] or [24, 3] rad, or rotation matrices [24, 3, 3]; root in the world
    betas: Any,  # [B]
    transl: Any,  # [3] m, in the world
    R_w2c: Any,  # [3, 3]
    t_w2c: Any,  # [3] m
    K: Any,  # [3, 3] px, (fx, fy, cx, cy), or a focal length
    width: int,
    height: int,
    up: str = "y",  # the world axis against gravity: "y" or "z"
    pixel_center: float = 0.5,
) -> tuple[Camera, BodyPose]:
    """WHAM ("global"), SLAHMR, GVHMR after `from_smplx`: a body in a gravity-aligned world and the frame's camera.

    The world is kept as it is. Raises `BadInput`, also when image and body together stand along another axis than
    `up`: then the world was turned or flipped on the way. (Either of them alone may lie or look down.)
    """
    width, height = whole_pixels(width), whole_pixels(height)
    if up not in UP_AXES:
        raise BadInput(f"up axis {up!r}: expected y or z")
    R = _numbers("R world to camera", R_w2c, (3, 3))
    check_rotation(R, "R world to camera")
    t = _numbers("t world to camera", t_w2c, (3,))
    body_pose = BodyPose(_pose(pose), _betas(betas), _numbers("transl", transl, (3,)))
    upright = axis_angle_to_matrix(body_pose.pose[0])[:, 1] - R[1]  # of the body, plus that of the image
    best = max(WORLD_AXES, key=lambda axis: upright @ WORLD_AXES[axis])
    if upright @ WORLD_AXES[best] > 1.5 and upright @ np.array(UP_AXES[up]) < 0.5:
        raise BadInput(
            f"world: expected +{up} to point up, but picture and body both stand along {best}; "
            f"give the other up axis, or poses and cameras of one world"
        )
    return Camera(_K(K, width, height, pixel_center), R, t, width, height), body_pose


def from_smplx(
    pose: Any,  # 66, 78, 87, 156, 159 or 165 numbers, or [J, 3], root first; rad; or matrices [J, 3, 3]
    transl: Any,  # [3] m
    body: Body,
    betas: Any = (0.0,),  # [B] of SMPL
    pelvis: Any = SMPLX_PELVIS,  # [3] m, joint 0 of the SMPL-X (or SMPL-H) body at rest
) -> BodyPose:
    """GVHMR, SMPLer-X, EasyMocap's SMPL-X and others: SMPL's pose of an SMPL-X or SMPL-H one.

    The first 22 joints are the same; SMPL's two hand joints stay straight. The pelvis stays where it was: each model
    turns about its own, and SMPL-X's lies 0.12 m lower at rest. The shape coefficients are of another body and cannot
    be taken over: fit SMPL's, or leave the mean shape. Raises `BadInput`.
    """
    array = _numbers("SMPL-X pose", pose, None)
    if (shape := _without_ones(array.shape))[1:] == (3, 3) and 3 * shape[0] in SMPLX_SIZES:
        array = matrix_to_axis_angle(array.reshape(shape))
    if array.size not in SMPLX_SIZES or len(_without_ones(array.shape)) > 2:
        raise BadInput(
            f"SMPL-X pose: expected {', '.join(map(str, SMPLX_SIZES))} numbers of axis-angle, root first, "
            f"got {list(array.shape)}; concatenate global_orient and body_pose"
        )
    smpl = np.zeros((24, 3))
    smpl[:22] = array.reshape(-1)[:66].reshape(22, 3)
    betas = _betas(betas)
    shift = _numbers("pelvis", pelvis, (3,)) - body.shaped(betas)[1][0]
    return BodyPose(smpl, betas, _numbers("transl", transl, (3,)) + shift)


def from_easymocap(
    poses: Any,  # 72 numbers with a zero root, or 69 without it; rad
    shapes: Any,  # [B]
    Rh: Any,  # [3] rad
    Th: Any,  # [3] m
    body: Body,
) -> BodyPose:
    """EasyMocap's SMPL fit, as ZJU-MoCap keeps it: v = R(Rh) v_zero_root + Th, about the model's origin.

    In the calibration's world; its cameras are OpenCV's (`Camera.from_opencv`). Raises `BadInput`, also for the 87
    numbers of an SMPL-X fit.
    """
    values = _numbers("EasyMocap poses", poses, None).reshape(-1)
    if values.size not in (69, 72):
        hint = pose_hint(np.shape(poses))
        if values.size in SMPLX_SIZES:
            hint = "; these are SMPL-X or SMPL-H poses, fit with --body smpl"
        raise BadInput(f"EasyMocap poses: expected 72 numbers (or 69 without the root), got {values.size}{hint}")
    rotation, translation = (_numbers(name, value, (3,)) for name, value in (("Rh", Rh), ("Th", Th)))
    return from_zju_root(values, _betas(shapes), rotation, translation, body)


def matrix_to_axis_angle(
    matrices: Any,  # [..., 3, 3]
) -> Array:
    """[..., 3] rad, of length 0 to pi: the inverse of `axis_angle_to_matrix`, exact near 0 and near pi as well.

    Rounded rotations (float32, half precision) are accepted. Raises `BadInput` for other matrices.
    """
    R = _numbers("rotation matrices", matrices, None)
    if R.shape[-2:] != (3, 3):
        raise BadInput(f"rotation matrices: expected shape [..., 3, 3], got {list(R.shape)}")
    check_rotation(R, "rotation matrices")
    from scipy.spatial.transform import Rotation

    return np.reshape(Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec(), R.shape[:-1])


def six_d_to_matrix(
    values: Any,  # [..., 6]
    layout: str,
) -> Array:
    """[..., 3, 3] from the 6-number rotations of Zhou et al., which nobody orders alike. `layout` says how:

    "columns": the first column, then the second (4D-Humans);
    "interleaved": R00 R01 R10 R11 R20 R21, the first two columns read row by row (SPIN and its descendants);
    "rows": the first row, then the second (PyTorch3D).

    Raises `BadInput`, also for numbers that span no plane.
    """
    d = _numbers("6D rotations", values, None)
    if layout not in SIX_D_LAYOUTS:
        raise BadInput(f"6D rotation layout {layout!r}: expected {', '.join(SIX_D_LAYOUTS)}")
    if d.ndim == 0 or d.shape[-1] != 6:
        raise BadInput(f"6D rotations: expected shape [..., 6], got {list(d.shape)}")
    first, second = (d[..., 0::2], d[..., 1::2]) if layout == "interleaved" else (d[..., :3], d[..., 3:])
    a = _unit(first)
    b = _unit(second - (a * second).sum(-1, keepdims=True) * a)
    return np.stack([a, b, np.cross(a, b)], -2 if layout == "rows" else -1)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if (length < 1e-8).any():
        raise BadInput("6D rotations: expected two independent directions, got zero or parallel ones")
    return vectors / length


def _numbers(what: str, value: Any, shape: tuple[int, ...] | None) -> Array:
    """Finite numbers as float64, of this shape (as a row or a column of it, too), or of any."""
    try:
        array = as_numbers(value, what)
    except ValueError as error:
        raise BadInput(f"{error}; leave a frame without numbers out") from None
    if shape is None:
        return array
    if array.shape != shape and array.size == math.prod(shape) and _without_ones(array.shape) == shape:
        array = array.reshape(shape)
    if array.shape != shape:
        more = array.shape[-len(shape) :] == shape
        hint = "; give one row a call: these are several frames or persons" if more else ""
        raise BadInput(f"{what}: expected shape {list(shape)}, got {list(array.shape)}{hint}")
    return array


def _without_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(n for n in shape if n != 1)


def _pose(pose: Any) -> Array:
    """[24, 3] of 72 numbers in any of their shapes, or of rotation matrices [24, 3, 3]."""
    array = _numbers("pose", pose, None)
    shape = _without_ones(array.shape)
    if shape == (24, 3, 3):
        check_rotation(array, "pose by matrix_to_axis_angle")
        return matrix_to_axis_angle(array.reshape(24, 3, 3))
    if shape not in ((72,), (24, 3)):
        hint = pose_hint(array.shape)
        raise BadInput(f"pose: expected 72 numbers of axis-angle, [72] or [24, 3], got {list(array.shape)}{hint}")
    return array.reshape(24, 3)


def _betas(betas: Any) -> Array:
    array = _numbers("betas", betas, None)
    if array.size == 0 or array.ndim == 0 or len(_without_ones(array.shape)) > 1:
        more = "; give one row a call: these are several frames or persons" if array.ndim == 2 and array.size else ""
        raise BadInput(f"betas: expected shape [B], got {list(array.shape)}{more}")
    return array.reshape(-1)


def _K(K: Any, width: int, height: int, pixel_center: float) -> Array:
    matrix = _numbers("K", K, None)
    if matrix.size == 1:
        f = float(matrix.reshape(()))
        matrix, pixel_center = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]), 0.5
    if _without_ones(matrix.shape) == (4,):
        fx, fy, cx, cy = matrix.reshape(4)
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if _without_ones(matrix.shape) != (3, 3):
        raise BadInput(f"K: expected shape [3, 3] or a focal length, got {list(matrix.shape)}; give one frame's")
    matrix = without_rounding(matrix.reshape(3, 3))
    check_intrinsics(matrix, "K")
    if pixel_center not in (0.0, 0.5):
        raise BadInput(f"pixel_center {pixel_center!r}: expected 0.0 or 0.5")
    matrix[:2, 2] += 0.5 - pixel_center
    return matrix
