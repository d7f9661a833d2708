"""What holds for every layout of every data set, on one turning person of three frames."""

from __future__ import annotations

import dataclasses
import os
import pickle
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ihbench import registry
from ihbench.body import load_body
from ihbench.data.prepare import HandedView, Handout
from ihbench.datasets.ocmotion.original import mask_file
from ihbench.datasets.people_snapshot import gaussianavatar
from ihbench.datasets.people_snapshot import original as people_snapshot
from ihbench.datasets.plain import plain_scene
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.pictures import write_picture
from tests.bench.fake_capture import SIZE, the_body, turning_capture
from tests.datasets.test_ocmotion import annot_frame, write_annots

NAME = "male-3-casual"
N = 3
SMPL = dataclasses.replace(load_body(), name="smpl")
PICTURES = {  # the second frame's image and mask; PeopleSnapshot's release has no such files
    "zju": ("Camera_B1/000001.png", "mask/Camera_B1/000001.png"),
    "zju-refine": ("images/00/000001.png", "mask/00/000001.png"),
    "humannerf": ("images/frame_000001.png", "masks/frame_000001.png"),
    "instantavatar": ("images/image_0001.png", "masks/mask_0001.npy"),
    "gaussianavatar": ("train/images/000001.png", "train/masks/000001.png"),
    "ocmotion-w2a": ("images/00001.png", "masks/00001.png"),
    "ocmotion": ("images/0011/02/00001.png", "masks/0011/02/00001.png"),
    "plain": ("images/000001.png", "masks/000001.png"),
}
DATASETS = {
    "zju": "zju_mocap", "zju-refine": "zju_mocap", "humannerf": "zju_mocap", "instantavatar": "people_snapshot",
    "gaussianavatar": "people_snapshot", "raw": "people_snapshot", "ocmotion-w2a": "ocmotion", "ocmotion": "ocmotion",
    "plain": "custom",
}  # fmt: skip
LAYOUTS = pytest.mark.parametrize("layout", DATASETS)
IN_PICTURES = pytest.mark.parametrize("layout", PICTURES)


def raw(scene: Handout) -> Path:
    folder, views = scene.folder / NAME, list(scene.views())
    people_snapshot.write_camera(folder, scene.cameras[0])
    people_snapshot.write_masks(folder, (view.visible for view in views), (N, SIZE, SIZE))
    people_snapshot.write_poses(folder, scene.body_poses)
    people_snapshot.write_video(folder / f"{NAME}.mp4", (view.image for view in views))
    return folder


def gaussian_avatar(scene: Handout) -> Path:
    folder, views = scene.folder / NAME, list(scene.views())
    for split, some in (("train", views[:2]), ("test", views[2:])):
        gaussianavatar.write_camera(folder, split, scene.cameras[0])
        gaussianavatar.write_poses(folder, split, [view.body_pose for view in some])
        for view in some:
            gaussianavatar.write_frame(folder, split, view.number, view.image, view.visible)
    return folder


def released_ocmotion(scene: Handout) -> Path:
    frames = []
    for view in scene.views():
        path = f"images/0011/02/{view.number:05d}.png"
        frames.append(annot_frame(path, view.camera, {"0": view.body_pose}))
        write_picture(scene.folder / path, view.image)
        write_picture(scene.folder / mask_file(path), view.visible * np.uint8(255))
    write_annots(scene.folder, [[frames]])
    return scene.folder


def plain(scene: Handout) -> Path:
    folder = scene.folder / NAME
    plain_scene.write_cameras(folder, {"phone": scene.cameras[0]})
    plain_scene.write_poses(folder, scene.body_poses)
    for view in scene.views():
        plain_scene.write_frame(folder, view.number, view.image, view.visible)
    return folder


@pytest.fixture(scope="module")
def whole() -> list[HandedView]:
    capture = turning_capture(N)
    return [
        HandedView(k, capture.image(0, k), capture.silhouette(0, k), capture.camera(0), capture.body_pose(k))
        for k in range(N)
    ]


@pytest.fixture(scope="module")
def written(tmp_path_factory, whole) -> dict[str, Path]:
    """Layout -> the subject's folder."""
    own = {"raw": raw, "gaussianavatar": gaussian_avatar, "ocmotion": released_ocmotion, "plain": plain}
    folders = {}
    for layout in DATASETS:
        root = tmp_path_factory.mktemp("layout") / layout
        cameras, poses = [view.camera for view in whole], [view.body_pose for view in whole]
        name = "0011_02_w2a" if layout == "ocmotion-w2a" else NAME
        scene = Handout(root, name, N, lambda: iter(whole), cameras, poses, SMPL)
        folders[layout] = (own.get(layout) or registry.load("training layout", layout))(scene)
    return folders


@pytest.fixture
def copy(written, tmp_path, layout) -> Path:
    """The subject's folder, to damage."""
    root = tmp_path / "copy"
    shutil.copytree(root_of(written[layout], layout), root)
    return root if layout == "ocmotion" else root / written[layout].name


def root_of(folder: Path, layout: str) -> Path:
    return folder if layout == "ocmotion" else folder.parent


def opened(folder: Path, layout: str, body=None):
    dataset = registry.load("dataset", DATASETS[layout])(root_of(folder, layout))
    (subject,) = dataset.subjects()
    return dataset.open(subject, body)


def checked(folder: Path, layout: str, body=None):
    report = registry.load("dataset", DATASETS[layout]).check(root_of(folder, layout), body)
    (subject,) = report.subjects
    assert report.ok == (not subject.problems)
    assert not any("\n" in line for line in (*subject.problems, *subject.warnings))
    return subject


def refused(words: str, call, *arguments) -> None:
    with pytest.raises(BadInput, match=words) as error:
        call(*arguments)
    assert "\n" not in str(error.value)


def mark(folder: Path, layout: str, body_sha: str) -> None:
    words = {"generator": "ihbench", "version": 1, "seed": 0, "body": "procedural", "body_sha": body_sha}
    atomic.write_json(root_of(folder, layout) / "STANDIN.json", words)


@LAYOUTS
def test_reading_gives_back_what_was_written(written, whole, layout):
    capture = opened(written[layout], layout, SMPL)
    assert (capture.dataset, capture.standin, capture.body, capture.n_frames) == (DATASETS[layout], "", "smpl", N)
    camera = capture.camera(0)
    for view in whole:
        np.testing.assert_array_equal(capture.silhouette(0, view.number), view.visible)
        if layout != "raw":  # a video is lossy
            np.testing.assert_array_equal(capture.image(0, view.number), view.image)
        pose = capture.body_pose(view.number)
        for name in ("pose", "transl", "betas"):
            np.testing.assert_allclose(getattr(pose, name), getattr(view.body_pose, name), atol=2e-6)
    for name in ("K", "R", "t"):
        np.testing.assert_allclose(getattr(camera, name), getattr(whole[0].camera, name), atol=1e-9)
    assert (camera.width, camera.height, camera.distortion) == (SIZE, SIZE, None)


@LAYOUTS
def test_check_finds_nothing_wrong(written, layout):
    subject = checked(written[layout], layout, SMPL)
    assert (subject.problems, subject.cameras, subject.frames, subject.image_size) == ([], 1, N, [[SIZE, SIZE]])
    assert min(subject.vertices_in_mask, subject.mask_on_body) > 0.95
    if layout != "plain":  # it takes the bench's body, which is another than SMPL
        assert checked(written[layout], layout).problems == []


@LAYOUTS
def test_where_the_folder_is(written, layout, tmp_path, monkeypatch):
    dataset = registry.load("dataset", DATASETS[layout])
    refused("nowhere: no such folder", dataset, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    refused("expected", dataset, tmp_path / "empty")
    refused("no such folder", dataset.check, tmp_path / "file")
    shutil.copytree(root_of(written[layout], layout), tmp_path / "high" / "deep")
    refused("there is one in .*deep, give that folder", dataset, tmp_path / "high")
    (name,) = dataset(root_of(written[layout], layout)).subjects()
    monkeypatch.chdir(written[layout])
    assert dataset(Path()).subjects() == dataset(written[layout]).subjects() == [name]


@LAYOUTS
def test_no_data_set_takes_anothers(written, layout):
    for name in {*DATASETS.values()} - {DATASETS[layout]}:
        if (layout, name) != ("instantavatar", "custom"):  # a poses.npz beside images/ may be a scene's
            refused("layout|scene", registry.load("dataset", name), root_of(written[layout], layout))


@LAYOUTS
def test_unknown_names_and_indices(written, layout):
    dataset = registry.load("dataset", DATASETS[layout])(root_of(written[layout], layout))
    refused("no subject 'somebody'", dataset.open, "somebody")
    capture = opened(written[layout], layout, SMPL)
    for read in (capture.image, capture.silhouette):
        refused("no camera 1", read, 1, 0)
        refused("no camera -1", read, -1, 0)
        refused(f"no frame {N}", read, 0, N)
    refused("no frame -1", capture.body_pose, -1)
    refused("silhouette source", capture.silhouette, 0, 0, "truth")


@LAYOUTS
def test_which_body(copy, layout):
    refused("ihbench may not ship", lambda: opened(copy, layout).model)
    refused("belong to the smpl body", opened, copy, layout, load_body())
    mark(copy, layout, load_body().content_sha())
    capture = opened(copy, layout)
    assert (capture.body, capture.standin) == ("procedural", "stand-in v1 seed 0")
    assert checked(copy, layout).problems == []
    refused("belong to the procedural body", opened, copy, layout, SMPL)
    mark(copy, layout, "other")
    refused("another version of the procedural body", lambda: opened(copy, layout).model)
    (root_of(copy, layout) / "STANDIN.json").write_text('{"seed": 0}')
    refused("STANDIN.json: expected version, seed", opened, copy, layout)


@LAYOUTS
def test_a_read_only_folder_with_letters_of_all_kinds(copy, layout, tmp_path):
    root = tmp_path / "Люди und Größe 人"
    root_of(copy, layout).rename(root)
    paths = [*root.rglob("*"), root]
    for path in paths:
        path.chmod(stat.S_IRUSR | (stat.S_IXUSR if path.is_dir() else 0))
    try:
        assert checked(root if layout == "ocmotion" else root / copy.name, layout, SMPL).problems == []
    finally:
        for path in reversed(paths):
            path.chmod(stat.S_IRWXU)


@IN_PICTURES
def test_pictures_are_named_when_missing_damaged_or_of_another_size(copy, layout):
    image, mask = (copy / name for name in PICTURES[layout])
    capture = opened(copy, layout)
    digests = [capture.content_digest(0, frame) for frame in range(N)]
    data = image.read_bytes()
    image.write_bytes(data[: len(data) // 2])
    refused(f"{image.name}: .*copy the file again", capture.image, 0, 1)
    Image.fromarray(np.zeros((SIZE, SIZE + 1, 3), np.uint8)).save(image)
    refused(f"{image.name}: {SIZE + 1}×{SIZE} px, but", capture.image, 0, 1)
    if mask.suffix == ".npy":
        np.save(mask, np.zeros((SIZE, SIZE + 1)))
    else:
        Image.fromarray(np.zeros((SIZE, SIZE + 1), np.uint8)).save(mask)
    refused(f"{mask.name}: {SIZE + 1}×{SIZE} px, but", capture.silhouette, 0, 1)
    assert checked(copy, layout).problems
    changed = capture.content_digest(0, 1)
    image.unlink()
    mask.unlink()
    assert len({digests[1], changed, capture.content_digest(0, 1)}) == 3
    assert [capture.content_digest(0, frame) for frame in (0, 2)] == [digests[0], digests[2]]
    assert capture.lacks(0, 1)
    assert not capture.lacks(0, 2)
    refused("no such file|cannot be read", capture.silhouette, 0, 1)


@IN_PICTURES
def test_opening_decodes_no_picture(copy, layout):
    for path in copy.rglob("*.png"):
        path.write_bytes(b"")
    assert opened(copy, layout).n_frames == N


@pytest.mark.parametrize(
    ("change", "words"),
    [(lambda m: ~m, "masks look inverted"), (lambda m: m[:, ::-1], "mirrored"), (lambda m: 0 * m, "show no person")],
)
@pytest.mark.parametrize("layout", ["zju", "instantavatar", "ocmotion-w2a"])
def test_check_names_masks_that_do_not_fit(tmp_path, whole, layout, change, words):
    views = [dataclasses.replace(view, visible=change(view.visible).astype(bool)) for view in whole]
    cameras, poses = [view.camera for view in whole], [view.body_pose for view in whole]
    scene = Handout(tmp_path, "0011_02_w2a", N, lambda: iter(views), cameras, poses, the_body())
    subject = checked(registry.load("training layout", layout)(scene), layout, SMPL)
    assert words in " | ".join(subject.problems)


class Attack:
    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def hostile(path: Path, marker: Path) -> None:
    """The file, running code where it is loaded without care."""
    if path.suffix == ".npy":
        np.save(path, np.array({"poses": Attack(marker)}, object), allow_pickle=True)
    elif path.suffix == ".npz":
        np.savez(path, pose=np.array([Attack(marker)]))
    elif path.suffix == ".pth":
        torch.save({"beta": Attack(marker)}, path)
    else:
        path.write_bytes(pickle.dumps({"camera_f": Attack(marker)}))


@pytest.mark.parametrize("damage", ["empty", "cut short", "hostile", "missing"])
@LAYOUTS
def test_damaged_files_are_named_and_run_nothing(copy, layout, damage, tmp_path):
    """Every file but pictures and those that are kept for other programs."""
    unread = {"canonical_joints.pkl", *(("cameras.pkl",) if layout == "ocmotion-w2a" else ())}
    for path in sorted(copy.rglob("*.*")):
        if path.is_dir() or path.suffix == ".png" or path.name in unread or path.parent.name == "masks":
            continue
        data = path.read_bytes()
        if damage == "missing":
            path.unlink()
        elif damage == "hostile":
            hostile(path, tmp_path / "it_ran")
        else:
            path.write_bytes(data[: len(data) * 6 // 10] if damage == "cut short" else b"")
        try:
            text = " | ".join(checked(copy, layout).problems)
        except BadInput as error:  # no longer of this layout
            assert damage == "missing"
            text = str(error)
        if damage == "missing":
            assert text or path.name == "mesh_infos.pkl"
        else:
            assert path.name in text
        path.write_bytes(data)
    assert not (tmp_path / "it_ran").exists()
