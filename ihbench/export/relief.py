"""How far an avatar's surface is from the body's: clothes, hair, and what a fit made of the shape.

The centres of Gaussians lie inside the person that is seen, by about what a pixel of the training images blurs. How
far inside is measured: the surface is moved outwards until its silhouettes are those of the avatar's own pictures, of
training images' pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.body.uv import Texels
from ihbench.camera import Camera
from ihbench.render.triangles import triangle_normals
from ihbench.render.zbuffer import rasterize
from ihbench.show.detail import pixel_at
from ihbench.show.framing import Framing
from ihbench.show.motion import stand_of, up_axis

Array = NDArray[np.float64]

MOST = 0.08  # m from the body; what is farther out hangs together with other places than this texel's
SMOOTHINGS = 2
DIRECTIONS = (0.0, 50.0, 115.0, 180.0, 270.0)  # degrees about the vertical, whose silhouettes are compared
STEPS = np.arange(0.0, 2.6, 0.2)  # pixels outwards that are tried
PICTURE = 256  # px, where the training images' pixel is not known
SOLID = 0.5  # alpha from which a pixel is the person's


def fitted_relief(
    means: Array,  # [N, 3] m, world, of texel k of the table
    texels: Texels,
    avatar: Any,  # a `scene.contracts.Avatar`
    body: Body,
    body_pose: BodyPose,
    pixel: float | None,  # m at the body, of the training images
) -> Array:
    """[V, 3] m, on the shaped T-pose before skinning."""
    centres, outwards = relief_of(means, texels, body, body_pose)
    cameras = list(_cameras(body, body_pose, pixel))
    pixel = pixel_at(cameras[0], body_pose, body)
    shown = [np.asarray(avatar.render(camera, body_pose)[1]) > SOLID for camera in cameras]

    def likeness(step: float) -> float:
        surface = body.pose(body_pose, blend_shapes=False, offsets=centres + step * pixel * outwards)
        return sum(_overlap(surface, body, camera, seen) for camera, seen in zip(cameras, shown, strict=True))

    best = max(STEPS, key=likeness)
    return centres + best * pixel * outwards


def relief_of(means: Array, texels: Texels, body: Body, body_pose: BodyPose) -> tuple[Array, Array]:
    """[V, 3] m from the shaped body's vertices to the surface of the centres, moved back into the T-pose, and [V, 3]
    outwards, of length 1 on flat places. Both the mean of each vertex's texels, smoothed a little; vertices without
    texels follow their neighbours."""
    weights = texels.interpolate(body.weights, body.faces)
    weights /= weights.sum(1, keepdims=True)
    blended = np.einsum("nk,kab->nab", weights, body.joint_transforms(body_pose)[:, :3])
    rest = np.einsum("nab,nb->na", np.linalg.inv(blended[:, :, :3]), means - blended[:, :, 3])
    vertices = body.shaped(body_pose.betas)[0]
    offset = rest - texels.interpolate(vertices, body.faces)
    known = np.isfinite(offset).all(1)
    known[known] = np.linalg.norm(offset[known], axis=1) < MOST
    both = np.column_stack([offset, triangle_normals(vertices[body.faces])[texels.face]])[known]
    corner = body.faces[texels.face[known]]
    count, total = np.zeros(len(vertices)), np.zeros((len(vertices), 6))
    np.add.at(count, corner, texels.bary[known])
    np.add.at(total, corner, texels.bary[known][..., None] * both[:, None])
    mean = np.divide(total, count[:, None], out=np.zeros_like(total), where=count[:, None] > 1e-6)
    smooth = _smoothed(mean, count > 1e-6, body)
    return smooth[:, :3], smooth[:, 3:]


def _smoothed(values: Array, known: NDArray[np.bool_], body: Body) -> Array:
    from scipy.sparse import coo_matrix

    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, 1), axis=0)
    both = np.concatenate([edges, edges[:, ::-1]])
    near = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(len(values), len(values))).tocsr()
    while not known.all():
        neighbours = near @ known.astype(float)
        fresh = (neighbours > 0) & ~known
        if not fresh.any():  # a part of the mesh that no texel is on
            break
        mean = (near @ (values * known[:, None])) / np.maximum(neighbours, 1)[:, None]
        values = np.where(fresh[:, None], mean, values)
        known = known | fresh
    degree = np.maximum(np.asarray(near.sum(1)).reshape(-1, 1), 1)
    for _ in range(SMOOTHINGS):
        values = (values + near @ values / degree) / 2
    return values


def _cameras(body: Body, body_pose: BodyPose, pixel: float | None) -> list[Camera]:
    """With pixels of the training images' size."""
    vertices, pelvis = body.pose(body_pose), body.posed_joints(body_pose)[:1]
    framing = Framing.of([vertices], [0], pelvis, stand_of(body, body_pose, up_axis([body_pose])))
    cameras = [framing.camera(0, degrees, PICTURE, PICTURE) for degrees in DIRECTIONS]
    if pixel is None:
        return cameras
    side = int(np.clip(round(PICTURE * pixel_at(cameras[0], body_pose, body) / pixel), 16, 2048))
    return [camera.scaled(side, side) for camera in cameras]


def _overlap(surface: Array, body: Body, camera: Camera, seen: NDArray[np.bool_]) -> float:
    """Intersection over union of the mesh's silhouette with the avatar's."""
    mesh = rasterize(camera.project(surface), body.faces, camera.height, camera.width).mask
    return float((mesh & seen).sum() / max((mesh | seen).sum(), 1))
