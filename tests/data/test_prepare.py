"""`ihbench prepare`: what is handed out is what a method gets, in other people's layouts, and nothing else."""

import hashlib
import json
import pickle

import cv2
import numpy as np
import pytest

from ihbench.clock.progress import Progress
from ihbench.data.prepare import prepare
from ihbench.errors import BadInput
from ihbench.scene.contracts import MaskState
from ihbench.scene.views import open_scene
from tests.bench.fake_capture import fake_protocol, the_body, turning_capture

LAYOUTS = ["zju", "zju-refine", "humannerf", "instantavatar", "gaussianavatar", "ocmotion-w2a"]
STRIP = (48, 14)  # mid, width in px of the original image


@pytest.fixture(scope="module")
def scene():
    return open_scene(turning_capture(5), protocol())


def protocol():
    return fake_protocol(n_frames=5, strip=STRIP)


def handed(scene, out, layout):
    return prepare(scene, the_body(), out, layout, Progress.silent())


def files_of(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_file_changes_with_what_the_protocol_hides(tmp_path, layout):
    """Colours and silhouettes behind the occluder, and everything of the test views, are scrambled at the source."""

    def scramble(camera, frame, picture):
        rule = open_scene(turning_capture(5), protocol()).hiding
        hidden = rule.occlusion.hidden(frame) if frame in rule.frames else None
        covered = dict(zip(rule.frames, rule.covered, strict=True))
        out = picture.copy()
        if camera == 0 and covered.get(frame):
            out[hidden] = 255 - out[hidden] if out.dtype == np.uint8 else ~out[hidden]
        elif camera != 0:
            out = 255 - out if out.dtype == np.uint8 else ~out
        return out

    from dataclasses import replace

    clean = turning_capture(5)
    dirty = replace(clean, edit_image=scramble, edit_silhouette=scramble, _photographs={})
    assert (dirty.image(0, 0) != clean.image(0, 0)).any()
    assert (dirty.image(1, 0) != clean.image(1, 0)).any()
    a, b = (
        files_of(handed(open_scene(capture, protocol()), tmp_path / name, layout))
        for name, capture in (("a", clean), ("b", dirty))
    )
    assert a.keys() == b.keys()
    assert [name for name in a if a[name] != b[name]] == []


def test_a_visible_pixel_does_change_a_file(tmp_path):
    from dataclasses import replace

    def brighten(camera, frame, picture):
        return np.clip(picture.astype(int) + 9, 0, 255).astype(np.uint8)

    clean = turning_capture(5)
    other = replace(clean, edit_image=brighten, _photographs={})
    a, b = (
        files_of(handed(open_scene(capture, protocol()), tmp_path / name, "humannerf"))
        for name, capture in (("a", clean), ("b", other))
    )
    assert any(a[name] != b[name] for name in a if name.endswith(".png"))


def test_the_manifest_lists_every_file_with_its_hash(scene, tmp_path):
    folder = handed(scene, tmp_path, "zju")
    manifest = json.loads((folder / "manifest.json").read_text())
    on_disk = {name: hashlib.sha256(data).hexdigest() for name, data in files_of(folder).items()}
    del on_disk["manifest.json"]
    assert manifest["files"] == on_disk
    assert [row["frame"] for row in manifest["train"]] == list(scene.hiding.frames)
    assert [row["covered"] for row in manifest["train"]] == list(scene.hiding.covered)
    assert manifest["protocol_digest"] == scene.protocol.digest
    for row, view in zip(manifest["train"], scene.train, strict=True):
        assert row["mask_sha256"] == hashlib.sha256(view.mask.tobytes()).hexdigest()
    tests = json.loads((folder / "test_views.json").read_text())
    assert [row["prediction"] for row in tests] == [f"{scene.capture.name}/{k.name}.png" for k in scene.test_keys]
    first, view = tests[0], scene.test[0]
    np.testing.assert_allclose(np.array(first["K"])[:2, 2] + 0.5, view.camera.K[:2, 2])
    np.testing.assert_allclose(first["pose"], view.body_pose.pose)
    assert (first["pixel_center"], first["distortion"], first["background"]) == (0.0, [0.0] * 5, [1.0, 1.0, 1.0])
    assert (first["width"], first["height"]) == view.image.shape[1::-1]
    for words in ("metres", "z forward", "radians", "Rh", "sRGB", "add 0.5"):
        assert words in first["conventions"]


def test_what_is_there_is_kept_and_nothing_half_written(scene, tmp_path, monkeypatch):
    handed(scene, tmp_path, "humannerf")
    with pytest.raises(BadInput, match="is there already"):
        handed(scene, tmp_path, "humannerf")
    before = files_of(tmp_path)
    from ihbench.datasets.zju_mocap import humannerf

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(humannerf, "write_view", fail)
    with pytest.raises(BadInput, match="No space left"):
        prepare(scene, the_body(), tmp_path, "humannerf", Progress.silent(), force=True)
    assert files_of(tmp_path) == before
    with pytest.raises(BadInput, match="did you mean 'humannerf'"):
        handed(scene, tmp_path / "x", "humanerf")


# ----------------------------------------------------------------------------------------------------
# Readers written from the released loaders' descriptions, not with ours


def projected(K, R, T, vertices):
    points = vertices @ R.T + T
    return points[:, :2] / points[:, 2:] @ K[:2, :2].T + K[:2, 2]


def read_png(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def check_projection(scene, k, K, E, vertices):
    view = scene.train[k]
    ours = view.camera.project(the_body().pose(view.body_pose))[:, :2] - 0.5  # OpenCV's pixel centres
    np.testing.assert_allclose(projected(K, E[:3, :3], E[:3, 3], vertices), ours, atol=2e-4)


def check_pixels(scene, k, image_bgr, mask):
    view = scene.train[k]
    np.testing.assert_array_equal(image_bgr[..., ::-1], view.image)
    np.testing.assert_array_equal(mask, view.mask == MaskState.PERSON)


def rodrigues(v):
    return cv2.Rodrigues(np.asarray(v, np.float64).reshape(3, 1))[0]


def zju_vertices(params):
    """World vertices from ZJU-MoCap's parameters: zero root, then Rh about the origin and Th."""
    from ihbench.body.pose import BodyPose

    still = BodyPose(
        np.asarray(params["poses"]).reshape(24, 3), np.asarray(params["shapes"]).reshape(-1), np.zeros(3)
    )
    return the_body().pose(still) @ rodrigues(params["Rh"]).T + np.asarray(params["Th"]).reshape(3)


def test_neuralbody_reads_the_zju_layout(scene, tmp_path):
    root = handed(scene, tmp_path, "zju") / f"CoreView_{scene.capture.name}"
    annots = np.load(root / "annots.npy", allow_pickle=True).item()
    cams = annots["cams"]
    K, D, R = (np.array(cams[key][0]) for key in "KDR")
    E = np.eye(4)
    E[:3, :3], E[:3, 3:] = R, np.array(cams["T"][0]) / 1000.0
    assert not D.any()
    for i, ims in enumerate(annots["ims"]):
        path = ims["ims"][0]
        mask = read_png(root / "mask" / (path[:-4] + ".png"))
        check_pixels(scene, i, read_png(root / path), mask != 0)
        params = np.load(root / "new_params" / f"{i}.npy", allow_pickle=True).item()
        vertices = np.load(root / "new_vertices" / f"{i}.npy")
        np.testing.assert_allclose(zju_vertices(params), vertices, atol=1e-5)
        check_projection(scene, i, K, E, vertices)


def test_gauhuman_reads_the_refine_layout(scene, tmp_path):
    root = handed(scene, tmp_path, "zju-refine") / f"my_{scene.capture.name}"
    annots = np.load(root / "annots.npy", allow_pickle=True).item()
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = annots["cams"]["R"][0], np.array(annots["cams"]["T"][0]).reshape(3) / 1000
    for i, ims in enumerate(annots["ims"]):
        path = str(root / ims["ims"][0])
        mask = read_png(path.replace("images", "mask").replace("jpg", "png"))
        check_pixels(scene, i, read_png(path), mask != 0)
        params = np.load(root / "smpl_params" / f"{i}.npy", allow_pickle=True).item()
        check_projection(scene, i, np.array(annots["cams"]["K"][0]), E, zju_vertices(params))


def test_humannerf_reads_its_layout(scene, tmp_path):
    root = handed(scene, tmp_path, "humannerf") / scene.capture.name
    cameras, infos = (pickle.loads((root / n).read_bytes()) for n in ("cameras.pkl", "mesh_infos.pkl"))
    canonical = pickle.loads((root / "canonical_joints.pkl").read_bytes())["joints"]
    assert canonical.shape == (24, 3)
    for i, name in enumerate(sorted(cameras)):
        assert name == f"frame_{i:06d}"
        mask = read_png(root / "masks" / f"{name}.png")
        assert mask.shape[2] == 3
        check_pixels(scene, i, read_png(root / "images" / f"{name}.png"), mask[..., 0] / 255.0 > 0.5)
        info, camera = infos[name], cameras[name]
        params = {"poses": info["poses"], "shapes": info["betas"], "Rh": info["Rh"], "Th": info["Th"]}
        check_projection(scene, i, camera["intrinsics"], camera["extrinsics"], zju_vertices(params))
        assert not camera["distortions"].any()


def smpl_vertices(pose, betas, transl):
    from ihbench.body.pose import BodyPose

    return the_body().pose(BodyPose(np.asarray(pose, np.float64).reshape(24, 3), betas, transl))


def test_instantavatar_reads_its_layout(scene, tmp_path):
    root = handed(scene, tmp_path, "instantavatar") / scene.capture.name
    camera = dict(np.load(root / "cameras.npz"))
    poses = dict(np.load(root / "poses.npz"))
    assert (int(camera["height"]), int(camera["width"])) == scene.train[0].image.shape[:2]
    for i in range(len(scene.train)):
        mask = np.load(root / "masks" / f"mask_{i:04d}.npy")
        check_pixels(scene, i, read_png(root / "images" / f"image_{i:04d}.png"), mask > 0.5 * mask.max())
        vertices = smpl_vertices(poses["thetas"][i], poses["betas"].reshape(-1)[:10], poses["transl"][i])
        check_projection(scene, i, camera["intrinsic"], camera["extrinsic"], vertices)


def test_gaussianavatar_reads_its_layout(scene, tmp_path):
    import torch

    root = handed(scene, tmp_path, "gaussianavatar") / scene.capture.name / "train"
    camera = dict(np.load(root / "cam_parms.npz"))
    smpl = torch.load(root / "smpl_parms.pth", weights_only=True)
    images = sorted((root / "images").iterdir())
    assert len(images) == len(scene.train)
    for i, path in enumerate(images):
        mask = read_png(root / "masks" / path.name)
        check_pixels(scene, i, read_png(path), (mask if mask.ndim == 2 else mask[..., 0]) >= 128)
        vertices = smpl_vertices(
            smpl["body_pose"][i].numpy(), smpl["beta"][0].double().numpy(), smpl["trans"][i].double().numpy()
        )
        check_projection(scene, i, camera["intrinsic"], camera["extrinsic"], vertices)


def test_occfusion_reads_the_w2a_layout(scene, tmp_path):
    root = handed(scene, tmp_path, "ocmotion-w2a") / scene.capture.name
    metadata = json.loads((root / "metadata.json").read_text())
    infos = pickle.loads((root / "mesh_infos.pkl").read_bytes())
    for i, path in enumerate(sorted((root / "images").iterdir())):
        assert int(path.name[:5]) == i
        entry = metadata[path.stem]
        mask = read_png(root / "masks" / path.name)
        check_pixels(scene, i, read_png(path), (mask if mask.ndim == 2 else mask[..., 0]) != 0)
        pose = np.array(entry["poses"])
        pose[:3] = infos[path.stem]["Rh"]
        vertices = smpl_vertices(pose, np.array(entry["betas"]), np.array(entry["trans"]))
        check_projection(scene, i, np.array(entry["cam_intrinsics"]), np.array(entry["cam_extrinsics"]), vertices)
