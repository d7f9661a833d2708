"""The skinned mesh: what a glTF reader makes of its nodes is what `Body.pose` makes of the pose."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from ihbench.body import load_body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import JOINT_NAMES, PARENTS
from ihbench.export.glb import Glb
from ihbench.export.skinned_glb import SkinnedMesh, four_weights, quaternions, skinned_glb, standing
from ihbench.show.motion import Motion
from tests.export.glb_reader import GlbFile

BETAS = np.array([0.8, -0.5, 0.3] + [0.0] * 7)
PLACE = np.array([[0.1, 0.9, -0.2]])


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def relief(body):
    return np.random.default_rng(3).normal(0, 0.01, body.v_template.shape)


@pytest.fixture(scope="module")
def made(body, relief):
    rng = np.random.default_rng(0)
    clips = {
        "walk": Motion(rng.normal(0, 0.5, (4, 24, 3)), rng.normal(0, 1, (4, 3)), 10.0),
        "loop": Motion(rng.normal(0, 0.5, (3, 24, 3)), np.zeros((3, 3)), 5.0, cyclic=True),
    }
    still = Motion(canonical_pose("a_pose")[None], PLACE, 1.0)
    texture = rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)
    data = skinned_glb(Glb("test", "a licence"), body, BETAS, still, clips, texture, relief, {"run": "abc"})
    return GlbFile(data), data, clips, texture


def random_pose(seed):
    return np.random.default_rng(seed).normal(0, 0.6, (24, 3))


def test_it_stands_in_its_pose_and_binds_in_the_t_pose(body, relief, made):
    file = made[0]
    vertex = SkinnedMesh.of(body).vertex
    shaped = body.shaped(BETAS)[0] + relief
    np.testing.assert_allclose(file.attributes()["POSITION"], shaped[vertex], atol=1e-6)
    expected = body.pose(BodyPose(canonical_pose("a_pose"), BETAS, PLACE[0]), offsets=relief)
    np.testing.assert_allclose(file.posed(), expected[vertex], atol=1e-5)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_poses_of_its_nodes_are_those_of_the_body(body, relief, made, seed):
    file, vertex = made[0], SkinnedMesh.of(body).vertex
    pose, transl = random_pose(seed), np.array([0.5, 1.0, -2.0])
    joints = file.json["skins"][0]["joints"]
    turns = {node: Rotation.from_rotvec(pose[k]).as_quat() for k, node in enumerate(joints)}
    seen = file.posed(turns, {joints[0]: body.shaped(BETAS)[1][0] + transl})
    expected = body.pose(BodyPose(pose, BETAS, transl), blend_shapes=False, offsets=relief)
    np.testing.assert_allclose(seen, expected[vertex], atol=1e-4)


def test_clips_are_their_motions_key_by_key(body, relief, made):
    file, _, clips, _ = made
    vertex = SkinnedMesh.of(body).vertex
    assert [clip["name"] for clip in file.json["animations"]] == list(clips)
    for number, motion in enumerate(clips.values()):
        times = file.array(file.json["animations"][number]["samplers"][0]["input"])[:, 0]
        frames = len(motion) + motion.cyclic
        np.testing.assert_allclose(times, np.arange(frames) / motion.fps, rtol=1e-6)
        for key in range(frames):
            k = key % len(motion)
            seen = file.posed(*file.at(number, key))
            expected = body.pose(
                BodyPose(motion.pose[k], BETAS, motion.transl[k]), blend_shapes=False, offsets=relief
            )
            np.testing.assert_allclose(seen, expected[vertex], atol=1e-4)


def test_bounds_names_parents_weights_and_what_it_says_of_itself(body, made):
    file = made[0]
    assert file.check_bounds() == 1 + len(file.json["animations"])
    joints = file.json["skins"][0]["joints"]
    assert tuple(file.json["nodes"][node]["name"] for node in joints) == JOINT_NAMES
    parent = {c: n for n, node in enumerate(file.json["nodes"]) for c in node.get("children", ())}
    assert tuple(joints.index(parent[n]) if n in parent else -1 for n in joints) == PARENTS
    a = file.attributes()
    assert a["JOINTS_0"].shape == a["WEIGHTS_0"].shape == (len(a["POSITION"]), 4)
    np.testing.assert_allclose(a["WEIGHTS_0"].sum(1, dtype=np.float64), 1, atol=2e-7)
    assert not a["JOINTS_0"][a["WEIGHTS_0"] == 0].any()
    np.testing.assert_allclose(np.linalg.norm(a["NORMAL"], axis=1), 1, atol=1e-5)
    assert file.json["asset"]["copyright"] == "a licence"
    assert {"run": "abc"} in [node.get("extras") for node in file.json["nodes"]]
    assert file.json["extensionsUsed"] == ["KHR_materials_unlit"]


def test_the_texture_lies_where_the_body_has_it(body, made):
    file, _, _, texture = made
    (image,) = file.json["images"]
    shown = Image.open(io.BytesIO(file.view(image["bufferView"])))
    assert np.array_equal(np.asarray(shown), texture)
    mesh, triangles = SkinnedMesh.of(body), file.array(file.json["meshes"][0]["primitives"][0]["indices"])
    triangles = triangles.reshape(-1, 3)
    assert np.array_equal(mesh.vertex[triangles], body.faces)
    uv = file.attributes()["TEXCOORD_0"][triangles]  # v down
    np.testing.assert_allclose(uv * (1, -1) + (0, 1), body.uv[body.uv_faces], atol=1e-6)


def test_trimesh_reads_the_same(body, relief, made):
    _, data, _, texture = made
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    vertex = SkinnedMesh.of(body).vertex
    assert np.array_equal(vertex[mesh.faces], body.faces)
    bind = body.pose(BodyPose(np.zeros((24, 3)), BETAS, np.zeros(3)), offsets=relief)
    np.testing.assert_allclose(mesh.vertices, bind[vertex], atol=1e-5)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume > 0  # wound outwards
    assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), texture)


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_trimesh_poses_it_as_the_body(body, relief, seed):
    """trimesh knows no skins: its graph of nodes carries its vertices, by the file's weights and joints."""
    pose, transl = random_pose(seed), np.array([0.2, 1.0, -0.4])
    still = Motion(pose[None], transl[None], 1.0)
    data = skinned_glb(Glb("t"), body, BETAS, still, {}, np.zeros((8, 8, 3), np.uint8), relief, {})
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    worlds = np.stack([scene.graph.get(name)[0] for name in JOINT_NAMES])
    a = GlbFile(data).attributes()
    from_rest = mesh.vertices[:, None] - body.shaped(BETAS)[1][a["JOINTS_0"]]
    moved = np.einsum("ckab,ckb->cka", worlds[a["JOINTS_0"], :3, :3], from_rest) + worlds[a["JOINTS_0"], :3, 3]
    seen = np.einsum("ck,cka->ca", a["WEIGHTS_0"].astype(float), moved)
    expected = body.pose(BodyPose(pose, BETAS, transl), blend_shapes=False, offsets=relief)
    np.testing.assert_allclose(seen, expected[SkinnedMesh.of(body).vertex], atol=1e-4)


def test_the_four_largest_weights_are_kept():
    weights = np.zeros((3, 24))
    weights[0, 5] = 1
    weights[1, [3, 7, 11, 2, 9]] = 0.4, 0.3, 0.15, 0.1, 0.05
    weights[2, [1, 2]] = 0.5, 0.5
    joints, kept = four_weights(weights)
    assert joints[0].tolist() == [5, 0, 0, 0]
    assert sorted(joints[1].tolist()) == [2, 3, 7, 11]
    np.testing.assert_allclose(kept[1], np.array([0.4, 0.3, 0.15, 0.1]) / 0.95, rtol=1e-6)
    assert kept.sum(1).tolist() == [1, 1, 1]
    ours = load_body().weights
    joints, kept = four_weights(ours)
    own = np.where(kept > 0, np.take_along_axis(ours, joints.astype(int), 1), 0)
    np.testing.assert_allclose(own, kept, atol=1e-6)  # nothing is lost


def test_quaternions_take_the_short_way():
    pose = np.zeros((3, 24, 3))
    pose[:, 0, 1] = 3.0, np.pi + 0.1, 3.4
    turns = quaternions(pose)[:, 0]
    assert ((turns[1:] * turns[:-1]).sum(1) > 0.9).all()
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-6)


def test_a_motion_of_a_z_up_world_stands_upright_on_the_floor(body):
    rng = np.random.default_rng(0)
    pose = rng.normal(0, 0.1, (5, 24, 3))
    pose[:, 0] = Rotation.from_euler("zx", [[40, 90]] * 5, degrees=True).as_rotvec()
    moved = standing(Motion(pose, rng.normal((3, 4, 5), 0.01, (5, 3)), 10.0), body, BETAS)
    posed = [body.pose(p, blend_shapes=False) for p in moved.body_poses(BETAS)]
    assert min(p[:, 1].min() for p in posed) == pytest.approx(0, abs=1e-9)
    assert all(p[:, 1].max() > 1.4 for p in posed)
    pelvis = body.posed_joints(moved.body_poses(BETAS)[0])[0]
    np.testing.assert_allclose(pelvis[[0, 2]], 0, atol=1e-9)


def test_pose_blend_shapes_are_left_out(body):
    rng = np.random.default_rng(5)
    other = replace(body, posedirs=rng.normal(0, 1e-3, (len(body.v_template), 3, 207)))
    still = Motion(random_pose(7)[None], np.zeros((1, 3)), 1.0)
    file = GlbFile(skinned_glb(Glb("t"), other, BETAS, still, {}, np.zeros((8, 8, 3), np.uint8), None, {}))
    expected = other.pose(BodyPose(still.pose[0], BETAS, np.zeros(3)), blend_shapes=False)
    np.testing.assert_allclose(file.posed(), expected[SkinnedMesh.of(other).vertex], atol=1e-4)
    assert "animations" not in file.json
