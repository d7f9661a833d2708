"""What no sound capture has is a problem, what few have is a warning, and the likeliest reason is in the line."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from ihbench.body import load_body, write_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.plain import plain_scene
from ihbench.datasets.plain.plain_scene import PlainScene
from ihbench.datasets.reading.plausibility import absurd_camera, suspicious_camera
from ihbench.render.zbuffer import rasterize

WIDTH, HEIGHT, FRAMES = 96, 128, 14
ROWS = np.arange(HEIGHT)[:, None]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Somebody who turns about, arms at different heights, off the middle of the picture."""
    folder, body = tmp_path_factory.mktemp("plausible") / "turn", load_body()
    focal = 1.3 * HEIGHT
    camera = Camera(
        np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]), np.eye(3), np.zeros(3), WIDTH, HEIGHT
    )
    poses = []
    for frame in range(FRAMES):
        turn = 2 * np.pi * frame / FRAMES
        pose = np.zeros((24, 3))
        pose[0] = (Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0, turn, 0])).as_rotvec()
        pose[16, 2], pose[17, 2] = -0.9, 0.5 + 0.3 * np.sin(turn)
        poses.append(BodyPose(pose, np.zeros(10), np.array([0.05, 0.0, 3.2]) - body.joints[0]))
        mask = rasterize(camera.project(body.pose(poses[-1])), body.faces, HEIGHT, WIDTH).mask
        image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        image[mask] = 150 + frame
        plain_scene.write_frame(folder, frame, image, mask)
    plain_scene.write_cameras(folder, {"main": camera})
    plain_scene.write_poses(folder, poses)
    write_body(folder / "body.npz", body)
    return folder


def masks(change, frames=range(FRAMES)):
    def damage(folder):
        for frame in frames:
            path = folder / "masks" / f"{frame:06d}.png"
            Image.fromarray(np.ascontiguousarray(change(np.array(Image.open(path))))).save(path)

    return damage


def order(kind, numbers):
    def damage(folder):
        paths = sorted((folder / kind).iterdir())
        data = [path.read_bytes() for path in paths]
        for path, number in zip(paths, numbers, strict=True):
            path.write_bytes(data[number])

    return damage


def camera(change):
    def damage(folder):
        content = json.loads((folder / "cameras.json").read_text())
        change(content["cameras"]["main"])
        (folder / "cameras.json").write_text(json.dumps(content))

    return damage


def set_K(**entries):
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}

    def change(entry):
        for name, value in entries.items():
            row, column = places[name]
            entry["K"][row][column] = value

    return camera(change)


def poses(**changes):
    def damage(folder):
        arrays = dict(np.load(folder / "poses.npz"))
        for name, change in changes.items():
            arrays[name] = change(arrays[name].copy())
        np.savez(folder / "poses.npz", **arrays)

    return damage


def haze(mask):
    noise = np.random.default_rng(0).integers(1, 60, mask.shape).astype(np.uint8)
    return np.maximum(mask, np.where(ROWS < 90, noise, 0).astype(np.uint8))


def blurred(mask):
    return np.array(Image.fromarray(mask).filter(ImageFilter.GaussianBlur(2)))


def with_somebody_else(mask):
    other = np.roll(mask, 30, 1)
    other[:, :30] = 0
    return np.maximum(mask, other)


def upright(turned):
    turned = turned.reshape(-1, 24, 3)
    turned[:, 0] = (Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(turned[:, 0])).as_rotvec()
    return turned


def small_pictures(folder):
    for path in folder.glob("*s/*.png"):
        picture = Image.open(path)
        picture.resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.NEAREST).save(path)
    camera(lambda entry: entry.update(width=WIDTH // 2, height=HEIGHT // 2))(folder)


def a_second_camera_alike(folder):
    content = json.loads((folder / "cameras.json").read_text())
    content["cameras"]["copy"] = content["cameras"]["main"]
    (folder / "cameras.json").write_text(json.dumps(content))
    for kind in ("images", "masks"):
        shutil.move(folder / kind, folder / "main")
        shutil.copytree(folder / "main", folder / kind / "copy")
        shutil.move(folder / "main", folder / kind / "main")


PROBLEMS = {
    "a matte of most of the picture": (masks(lambda m: np.maximum(m, 255 * (ROWS < 83)).astype(np.uint8)),
                                       "pictures a person, the body is"),
    "two people": (masks(with_somebody_else), "other people, things or a soft matte"),
    "haze": (masks(haze), "a soft mask of"),
    "blurred": (masks(blurred), "threshold the masks at 128"),
    "boxes": (masks(lambda m: 255 * (m.any(1)[:, None] & m.any(0)).astype(np.uint8)), "the body is"),
    "inverted": (masks(lambda m: 255 - m), "look inverted"),
    "mirrored": (masks(lambda m: m[:, ::-1]), "look mirrored left to right"),
    "turned": (masks(lambda m: m[::-1, ::-1]), "turned by 180°"),
    "full": (masks(lambda m: 0 * m + 255), "cover whole pictures"),
    "empty": (masks(lambda m: 0 * m), "show no person"),
    "shifted": (masks(lambda m: np.roll(m, 6, 1)), "moved by 6% of the width to the left the masks would overlap by"),
    "somewhere else": (masks(lambda m: np.roll(m, 40, 0)), "% of the silhouettes lie on the body"),
    "some empty": (masks(lambda m: 0 * m, [3, 4]), "(frames 3, 4; that of frame 3 is empty)"),
    "one full": (masks(lambda m: 0 * m + 255, [5]), "that of frame 5 covers the whole picture"),
    "some elsewhere": (masks(lambda m: np.roll(m, 48, 1), [2, 9]), "2 of 14 masks looked at do not show the body"),
    "one frame off": (order("masks", [*range(1, FRAMES), 0]), "fit the poses of 1 frame later better"),
    "three frames off": (order("masks", [*range(3, FRAMES), 0, 1, 2]), "fit the poses of 3 frames later better"),
    "backwards": (order("masks", range(FRAMES)[::-1]), "the poses of the reversed order"),
    "shuffled": (order("masks", np.random.default_rng(1).permutation(FRAMES)), "the pose of another frame better"),
    "one picture": (order("images", [0] * FRAMES), "one and the same"),
    "10 px": (set_K(fx=10, fy=10), "focal length 10 px for 96×128 px, a field of view of 162°"),
    "1e7 px": (set_K(fx=1e7, fy=1e7), "camera main: focal length 1e+07 px"),
    "not square": (set_K(fx=20), "focal lengths 20 and 166.4 px"),
    "centre far away": (set_K(cx=1e5), "far outside 96×128 px"),
    "centre beside": (set_K(cx=60), "check cropping and cx, cy"),
    "K of larger pictures": (small_pictures, "divide its first two rows by 2"),
    "one camera twice": (a_second_camera_alike, "cameras main, copy: have one and the same K, R and t"),
    "t in millimetres": (camera(lambda c: c.update(t=[0, 0, 3000])), "millimetres; expected metres, divide by 1000"),
    "transl in centimetres": (poses(transl=lambda t: 100 * t), "centimetres; expected metres, divide by 100"),
    "transl in decimetres": (poses(transl=lambda t: 10 * t), "% of the silhouettes lie on the body"),
    "camera in the body": (camera(lambda c: c.update(t=[0, 0, -3.05])), "stands inside the body"),
    "behind": (camera(lambda c: c.update(t=[0, 0, -6.2])), "it is 3 m behind it"),
    "nowhere": (poses(transl=lambda t: t + 1e300), "t or transl look like"),
    "boundless": (poses(betas=lambda b: b + 1e300), "its betas make a body of"),
    "betas": (poses(betas=lambda b: b + 50 * np.eye(10)[0]), "its betas make a body of 6.14 m"),
    "degrees": (poses(pose=np.degrees), "multiply by π/180"),
    "a few degrees": (poses(pose=lambda p: p / np.abs(p).max() * 19), "a joint turned by"),
    "head down": (poses(pose=upright), "upside down"),
    "frozen": (poses(pose=lambda p: np.repeat(p[:1], FRAMES, 0)), "poses looked at are the same, but the masks move"),
}  # fmt: skip


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_no_sound_scene_has(name, scene, tmp_path):
    damage, words = PROBLEMS[name]
    folder = shutil.copytree(scene, tmp_path / "turn")
    damage(folder)
    found = PlainScene.check(folder)
    problems = found.subjects[0].problems
    assert not found.ok
    assert any(words in line for line in problems), problems
    assert all("\n" not in line and "nan" not in line for line in problems)


def a_statue(folder):
    for kind in ("images", "masks"):
        order(kind, [0] * FRAMES)(folder)
    poses(pose=lambda p: np.repeat(p[:1], FRAMES, 0), transl=lambda t: np.repeat(t[:1], FRAMES, 0))(folder)


WARNINGS = {
    "a statue": (a_statue, "right for drawings of somebody who stands still"),
    "most empty": (masks(lambda m: 0 * m, range(3, FRAMES)), "masks looked at are empty (frames 3, 4,"),
    "only heads": (masks(lambda m: np.where(ROWS < 36, m, 0).astype("u1")), "something hides"),
    "a little loose": (masks(lambda m: np.array(Image.fromarray(m).filter(ImageFilter.MaxFilter(9)))), "the body is"),
    "every other picture": (
        order("images", [frame // 2 * 2 for frame in range(FRAMES)]),
        "shows the picture of frame",
    ),
    "odd shape": (poses(betas=lambda b: b + 8 * np.eye(10)[1]), "a shape coefficient of 8"),
    "close": (poses(transl=lambda t: t - [0, 0, 2.6]), "of the body lies in the picture"),
}


@pytest.mark.parametrize("name", WARNINGS)
def test_what_few_sound_scenes_have(name, scene, tmp_path):
    damage, words = WARNINGS[name]
    folder = shutil.copytree(scene, tmp_path / "turn")
    damage(folder)
    found = PlainScene.check(folder)
    assert found.ok, found.subjects[0].problems
    assert any(words in line for line in found.subjects[0].warnings), found.subjects[0].warnings


SOUND = {
    "as it is": lambda folder: None,
    "hidden from the hips down": masks(lambda m: np.where(ROWS > 64, 0, m).astype(np.uint8)),
    "hidden by a post": masks(lambda m: np.where(abs(np.arange(WIDTH) - 50) < 6, 0, m).astype(np.uint8)),
    "clothes": masks(lambda m: np.array(Image.fromarray(m).filter(ImageFilter.MaxFilter(5)))),
    "smooth edges": masks(lambda m: np.array(Image.fromarray(m).filter(ImageFilter.GaussianBlur(0.3)))),
    "labels": masks(lambda m: (m > 0) * np.uint8(3)),
}


@pytest.mark.parametrize("name", SOUND)
def test_sound_scenes_pass_without_a_word(name, scene, tmp_path):
    folder = shutil.copytree(scene, tmp_path / "turn")
    SOUND[name](folder)
    found = PlainScene.check(folder)
    assert (found.ok, found.subjects[0].warnings) == (True, []), found.subjects[0].problems


def test_the_advice_on_moved_masks_is_true(scene, tmp_path):
    """What the line says helps."""
    folder = shutil.copytree(scene, tmp_path / "turn")
    masks(lambda m: np.roll(m, 6, 1))(folder)
    assert not PlainScene.check(folder).ok
    set_K(cx=WIDTH / 2 - 0.5 + 6)(folder)
    assert PlainScene.check(folder).ok
    small_pictures(folder)
    assert not PlainScene.check(folder).ok
    camera(lambda entry: entry.update(K=(np.diag([0.5, 0.5, 1]) @ np.array(entry["K"])).tolist()))(folder)
    assert PlainScene.check(folder).ok


@pytest.mark.parametrize(
    ("K", "absurd", "suspicious"),
    [
        ([500, 500, 320, 240], "", ""),
        ([5000, 5000, 320, 240], "", ""),  # the focal length that HMR assumes
        ([100, 100, 320, 240], "", "focal length 100 px"),
        ([40, 40, 320, 240], "a field of view of 166°", ""),
        ([500, 300, 320, 240], "", "not square"),
        ([500, 500, 640, 480], "", "pictures of about 1280×960 px"),
        ([500, 500, 160, 120], "", "pictures of about 320×240 px"),
        ([500, 500, 900, 240], "", "principal point (900, 240) px lies outside"),
        ([500, 500, 9000, 240], "far outside", ""),
    ],
)
def test_cameras(K, absurd, suspicious):
    fx, fy, cx, cy = K
    view = Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.eye(3), np.zeros(3), 640, 480)
    assert absurd in absurd_camera(view)
    assert bool(absurd) == bool(absurd_camera(view))
    assert absurd or (suspicious in suspicious_camera(view) and bool(suspicious) == bool(suspicious_camera(view)))
