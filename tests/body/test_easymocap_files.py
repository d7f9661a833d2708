"""EasyMocap's calibrations and fits, written as its own code writes them, by OpenCV and by hand."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench.body import load_body
from ihbench.body.easymocap_files import easymocap_cameras, easymocap_poses
from ihbench.body.pose_estimators import from_easymocap
from ihbench.camera import Camera
from ihbench.datasets.plain import plain_scene
from ihbench.errors import BadInput

NAMES = ["1", "02", "left"]
ROTATIONS = {name: Rotation.from_rotvec([0.1 * k, -0.2, 0.3]) for k, name in enumerate(NAMES)}
K = np.array([[1200.0, 0, 959.5], [0, 1210, 539.5], [0, 0, 1]])
LENS = np.array([[-0.1, 0.02, 1e-3, 2e-3, 0.01]])
T = np.array([[0.5], [1.0], [3.0]])


def by_opencv(folder: Path, lens=LENS, size: bool = False, lens_key: str = "dist", rotation: str = "R") -> list[Path]:
    """intri.yml and extri.yml, by cv2.FileStorage as EasyMocap's older versions."""
    files = [folder / "intri.yml", folder / "extri.yml"]
    intri, extri = (cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE) for path in files)
    for storage in (intri, extri):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in NAMES:
            storage.write("", name)
        storage.endWriteStruct()
    for name in NAMES:
        intri.write(f"K_{name}", K)
        if lens is not None:
            intri.write(f"{lens_key}_{name}", np.asarray(lens))
        if size:
            intri.write(f"W_{name}", 1920)
            intri.write(f"H_{name}", 1080)
        turn = ROTATIONS[name]
        extri.write(f"R_{name}" if rotation == "R" else f"Rot_{name}",
                    turn.as_rotvec().reshape(3, 1) if rotation == "R" else turn.as_matrix())  # fmt: skip
        extri.write(f"T_{name}", T)
    intri.release()
    extri.release()
    return files


def by_hand(folder: Path) -> list[Path]:
    """As its newer versions write them, digits of the names in quotes or not."""

    def matrix(key: str, values: np.ndarray) -> str:
        numbers = ", ".join(f"{value:.9f}" for value in values.ravel())
        rows, columns = values.shape
        return f"{key}: !!opencv-matrix\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: [{numbers}]\n"

    head = '%YAML:1.0\n---\nnames:\n  - 1\n  - "02"\n  - "left"\n'
    files = [folder / "intri.yml", folder / "extri.yml"]
    files[0].write_text(head + "".join(matrix(f"K_{n}", K) + matrix(f"dist_{n}", LENS) for n in NAMES))
    files[1].write_text(
        head + "".join(
            matrix(f"R_{n}", ROTATIONS[n].as_rotvec().reshape(3, 1)) + matrix(f"Rot_{n}", ROTATIONS[n].as_matrix())
            + matrix(f"T_{n}", T) for n in NAMES
        )
    )  # fmt: skip
    return files


@pytest.mark.parametrize(
    "write",
    [
        by_hand,
        by_opencv,
        lambda folder: by_opencv(folder, LENS.T),
        lambda folder: by_opencv(folder, np.pad(LENS, ((0, 0), (0, 9))), lens_key="D"),
        lambda folder: by_opencv(folder, rotation="Rot"),
        lambda folder: by_opencv(folder, size=True),
    ],
)
def test_every_calibration_of_easymocap_is_read(tmp_path, write):
    cameras = easymocap_cameras(*write(tmp_path), 1920, 1080)
    assert list(cameras) == NAMES
    points = np.array([[0.1, 0.2, 0.3], [-0.4, 0.1, -0.2]])
    for name, camera in cameras.items():
        expected = cv2.projectPoints(points, ROTATIONS[name].as_rotvec(), T, K, LENS)[0][:, 0]
        np.testing.assert_allclose(camera.project(points)[:, :2] - 0.5, expected, atol=1e-3)
    plain_scene.write_cameras(tmp_path, cameras)
    back = plain_scene.read_cameras(tmp_path / "cameras.json")
    np.testing.assert_allclose(back["left"].K, cameras["left"].K)


def test_the_documented_line_takes_what_easymocaps_own_reader_gives(tmp_path):
    """`read_camera`: R by Rodrigues, T a column, dist as stored or None, and the list of names beside the cameras."""
    intri, extri = (cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ) for path in by_opencv(tmp_path, LENS.T))
    calibration: dict = {
        name: {
            "K": intri.getNode(f"K_{name}").mat(),
            "R": cv2.Rodrigues(extri.getNode(f"R_{name}").mat())[0],
            "T": extri.getNode(f"T_{name}").mat(),
            "dist": intri.getNode(f"dist_{name}").mat() if name != "1" else None,
        }
        for name in NAMES
    }
    calibration["basenames"] = NAMES
    cameras = {
        name: Camera.from_opencv(c["K"], c["R"], c["T"], 1920, 1080, c["dist"])
        for name, c in calibration.items()
        if name != "basenames"
    }
    for name, camera in easymocap_cameras(tmp_path / "intri.yml", tmp_path / "extri.yml", 1920, 1080).items():
        np.testing.assert_allclose(cameras[name].R, camera.R, atol=1e-12)
        np.testing.assert_array_equal(cameras[name].t, camera.t)
        assert (cameras[name].distortion is None) == (name == "1")


def test_sizes_come_from_the_file_or_are_asked_for(tmp_path):
    files = by_opencv(tmp_path, None, size=True)
    camera = easymocap_cameras(*files)["02"]
    assert (camera.width, camera.height, camera.distortion) == (1920, 1080, None)
    with pytest.raises(BadInput, match="camera '1' has no W_1 and H_1"):
        easymocap_cameras(*by_opencv(tmp_path))


@pytest.mark.parametrize(
    ("file", "content", "word"),
    [
        ("intri.yml", None, "no such file"),
        ("intri.yml", "", "OpenCV|names"),
        ("intri.yml", "%YAML:1.0\n---\nnames: 5\n", "matrix K_1"),
        ("intri.yml", "{ not yaml ::", "OpenCV|names"),
        ("intri.yml", "\x00\xff", "OpenCV|names"),
        ("extri.yml", '%YAML:1.0\n---\nnames:\n  - "1"\n', "matrix R_1 or Rot_1"),
        ("extri.yml", '%YAML:1.0\n---\nnames:\n  - "1"\nR_1: 5\n', "matrix R_1 or Rot_1"),
    ],
)
def test_a_damaged_calibration_is_bad_input(tmp_path, file, content, word):
    files = by_opencv(tmp_path)
    path = tmp_path / file
    if content is None:
        path.unlink()
    else:
        path.write_text(content)
    with pytest.raises(BadInput, match=word) as error:
        easymocap_cameras(*files, 1920, 1080)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("annots", [False, True])
def test_fits_are_read_person_by_person(tmp_path, annots):
    body, rng = load_body(), np.random.default_rng(0)
    fits = {}
    for frame in (0, 3):
        people = [
            {"id": k, "poses": [[0.0] * 3 + rng.normal(0, 0.2, 69).tolist()], "shapes": [[0.1 * k] * 10],
             "Rh": [rng.normal(size=3).tolist()], "Th": [rng.normal(size=3).tolist()]}
            for k in range(2)
        ]  # fmt: skip
        fits[frame] = people[1]
        path = tmp_path / f"{frame:06d}.json"
        path.write_text(json.dumps({"annots": people} if annots else people))
    poses = easymocap_poses(tmp_path, body, person=1)
    assert list(poses) == [0, 3]
    for frame, pose in poses.items():
        record = fits[frame]
        own = from_easymocap(record["poses"], record["shapes"], record["Rh"], record["Th"], body)
        np.testing.assert_array_equal(pose.transl, own.transl)
    with pytest.raises(BadInput, match="person 7"):
        easymocap_poses(tmp_path, body, person=7)
    for wrong in ("5", "[5]", '{"a": 1}', '{"annots": 5}', "not json"):
        (tmp_path / "000009.json").write_text(wrong)
        with pytest.raises(BadInput, match="000009"):
            easymocap_poses(tmp_path, body)
