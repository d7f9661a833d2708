"""Writers of occluded training sets in the layouts that released training code reads. Behind `ihbench prepare`.

Images are PNG everywhere, also where the original release has JPEG: a second compression would be a second method.
Cameras have no lens distortion left. Views are numbered from 0.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ihbench.data.prepare import Handout
from ihbench.datasets.ocmotion import wild2avatar as ocmotion_w2a
from ihbench.datasets.people_snapshot import gaussianavatar, instantavatar
from ihbench.datasets.zju_mocap import humannerf
from ihbench.datasets.zju_mocap import original as zju_mocap
from ihbench.datasets.zju_mocap import refine as zju_refine


def zju(handout: Handout) -> Path:
    """The original release's layout, one camera: CoreView_NAME."""
    folder = handout.folder / f"{zju_mocap.FOLDER_PREFIX}{handout.name}"
    return _one_camera(handout, folder, "Camera_B1", zju_mocap.FITS[0], zju_mocap.write_frame)


def zju_refined(handout: Handout) -> Path:
    """The refine repack's layout, one camera: my_NAME."""
    folder = handout.folder / f"{zju_refine.PREFIX}{handout.name}"
    return _one_camera(handout, folder, "images/00", zju_refine.PARAMS, zju_refine.write_frame)


def _one_camera(handout: Handout, folder: Path, camera: str, fit: str, write_frame: Callable) -> Path:
    paths = [f"{camera}/{number:06d}.png" for number in range(handout.n_views)]
    zju_mocap.write_annots(folder, handout.cameras[:1], [[path] for path in paths])
    for view in handout.views():
        zju_mocap.write_params(folder, view.number, view.body_pose, handout.body, fit)
        zju_mocap.write_vertices(folder, view.number, handout.body.pose(view.body_pose), fit)
        write_frame(folder, paths[view.number], view.image, view.visible * np.uint8(255))
    return folder


def human_nerf(handout: Handout) -> Path:
    """HumanNeRF's and OccNeRF's layout, one camera."""
    folder = handout.folder / handout.name
    names = [f"frame_{number:06d}" for number in range(handout.n_views)]
    pairs = zip(names, zip(handout.cameras, handout.body_poses, strict=True), strict=True)
    humannerf.write_pickles(folder, dict(pairs), handout.body)
    for view in handout.views():
        humannerf.write_view(folder, names[view.number], view.image, view.visible)
    return folder


def instant_avatar(handout: Handout) -> Path:
    """InstantAvatar's layout."""
    folder = handout.folder / handout.name
    instantavatar.write_camera(folder, handout.cameras[0])
    instantavatar.write_poses(folder, handout.body_poses)
    for view in handout.views():
        instantavatar.write_frame(folder, view.number, view.image, view.visible)
    return folder


def gaussian_avatar(handout: Handout) -> Path:
    """GaussianAvatar's layout, its training part."""
    folder = handout.folder / handout.name
    gaussianavatar.write_camera(folder, "train", handout.cameras[0])
    gaussianavatar.write_poses(folder, "train", handout.body_poses)
    for view in handout.views():
        gaussianavatar.write_frame(folder, "train", view.number, view.image, view.visible)
    return folder


def ocmotion(handout: Handout) -> Path:
    """The layout of OcMotion's `_w2a` sequences, as OccFusion reads it."""
    folder = handout.folder / handout.name
    names = [f"{number:05d}" for number in range(handout.n_views)]
    ocmotion_w2a.write_sequence_metadata(folder, names, handout.cameras[0], handout.body_poses)
    ocmotion_w2a.write_mesh_infos(folder, names, handout.body_poses, handout.body)
    for view in handout.views():
        ocmotion_w2a.write_frame(folder, names[view.number], view.image, view.visible)
    return folder
