"""Textures and relief: known paint and known bumps are found again, whatever the avatar is made of."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from ihbench.body import Body, load_body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.uv import texel_table
from ihbench.clock.progress import Progress
from ihbench.export import relief as relief_module
from ihbench.export import texture as texture_module
from ihbench.export.relief import relief_of
from ihbench.export.texture import baked
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.render.splat import render_gaussians
from ihbench.render.zbuffer import rasterize, vertex_normals

POSE = BodyPose(canonical_pose("a_pose"), np.zeros(10), np.array([0.2, 1.0, 0.0]))


@pytest.fixture(scope="module")
def body():
    return load_body()


def paint(points):
    """[N, 3] a smooth colour of places on the T-pose."""
    return 0.5 + 0.4 * np.sin(points @ np.array([[4.0, 1, 0], [2, 5, 1], [0, 3, 6]]))


@dataclass(frozen=True)
class PaintedMesh:
    """An avatar without Gaussians: the body in `paint`."""

    body: Body

    def render(self, camera, body_pose, background=(1.0, 1.0, 1.0), frame=None):
        mesh = rasterize(camera.project(self.body.pose(body_pose)), self.body.faces, camera.height, camera.width)
        image = np.empty((camera.height, camera.width, 3), np.float32)
        image[:] = background
        image[mesh.mask] = mesh.interpolate(paint(self.body.shaped(body_pose.betas)[0]), self.body.faces)[mesh.mask]
        return image, mesh.mask.astype(np.float32)


def test_paint_that_pictures_show_is_found_again(body, monkeypatch):
    monkeypatch.setattr(texture_module, "PICTURE", 320)
    made = baked(PaintedMesh(body), body, POSE, Progress.silent(), side=128)
    assert made.relief is None
    texels = texel_table(body, 128)
    truth = paint(texels.interpolate(body.shaped(POSE.betas)[0], body.faces))
    error = np.abs(made.texture.reshape(-1, 3)[texels.index] / 255 - truth).mean(1)
    assert np.median(error) < 0.01
    assert (error < 0.05).mean() > 0.9  # soles and what is between the fingers no picture shows
    assert float(made.how.split("; ")[1].split("%")[0]) > 80
    assert made.texture.reshape(-1, 3).min() > 0  # filled beyond the charts, where nothing would be black


def test_it_is_the_silhouette_that_says_which_pixels_are_the_avatars(body, monkeypatch):
    """What is half transparent is made whole; the background's colour gets nowhere."""
    monkeypatch.setattr(texture_module, "PICTURE", 200)
    monkeypatch.setattr(texture_module, "AROUND", 6)

    class Glassy(PaintedMesh):
        def render(self, camera, body_pose, background=(1.0, 1.0, 1.0), frame=None):
            image, alpha = super().render(camera, body_pose, background)
            return 0.7 * image + 0.3 * np.float32(background), 0.7 * alpha

    whole, glassy = (
        baked(kind(body), body, POSE, Progress.silent(), side=64).texture for kind in (PaintedMesh, Glassy)
    )
    assert np.abs(whole.astype(int) - glassy).max() <= 2


@dataclass(frozen=True)
class TexelPerson:
    """Opaque Gaussians at the texels, moved outwards by a bump, in `paint`."""

    body: Body
    side: int
    inside: float  # m that the centres lie under the surface

    @property
    def texels(self):
        return texel_table(self.body, self.side)

    def posed_gaussians(self, body_pose):
        vertices = self.body.pose(body_pose, blend_shapes=False, offsets=bump(self.body, self.inside))
        texels = self.texels
        means = texels.interpolate(vertices, self.body.faces)
        colors = paint(texels.interpolate(self.body.shaped(body_pose.betas)[0], self.body.faces))
        scales = np.full(len(means), 0.006)
        return PosedGaussians(*(torch.from_numpy(v.astype(np.float32)) for v in (means, scales, colors)))

    def render(self, camera, body_pose, background=(1.0, 1.0, 1.0), frame=None):
        own = self.posed_gaussians(body_pose)
        rgb, alpha = render_gaussians(own.means, own.scales, own.colors, camera, background)
        return rgb.numpy(), alpha.numpy()


def bump(body, inside=0.0):
    """[V, 3] m: the chest 3 cm farther out, smoothly."""
    vertices = body.shaped(np.zeros(10))[0]
    chest = body.posed_joints(BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3)))[9]
    amount = 0.03 * np.exp(-((np.linalg.norm(vertices - chest, axis=1) / 0.15) ** 2))
    return (amount - inside)[:, None] * vertex_normals(vertices, body.faces)


def test_texels_are_their_own_texture_and_their_places_the_relief(body):
    person = TexelPerson(body, 64, 0.0)
    made = baked(person, body, POSE, Progress.silent())
    texels = person.texels
    truth = paint(texels.interpolate(body.shaped(POSE.betas)[0], body.faces))
    assert np.abs(made.texture.reshape(-1, 3)[texels.index] / 255 - truth).max() < 0.003
    centres, outwards = relief_of(person.posed_gaussians(POSE).means.double().numpy(), texels, body, POSE)
    error = np.linalg.norm(centres - bump(body), axis=1)
    assert np.median(error) < 0.001
    assert np.percentile(error, 99) < 0.006
    assert np.median(np.linalg.norm(outwards, axis=1)) > 0.9


def test_the_surface_is_as_far_outside_the_centres_as_pictures_say(body, monkeypatch):
    monkeypatch.setattr(relief_module, "PICTURE", 200)
    person = TexelPerson(body, 96, 0.012)
    made = baked(person, body, POSE, Progress.silent())
    centres, _ = relief_of(person.posed_gaussians(POSE).means.double().numpy(), person.texels, body, POSE)
    grown = ((made.relief - centres) * vertex_normals(body.shaped(POSE.betas)[0], body.faces)).sum(1)
    assert 0.004 < np.median(grown) < 0.025
    camera = relief_module._cameras(body, POSE, None)[1]
    seen = person.render(camera, POSE)[1] > 0.5
    alike = [
        relief_module._overlap(body.pose(POSE, blend_shapes=False, offsets=offsets), body, camera, seen)
        for offsets in (made.relief, centres)
    ]
    assert alike[0] > alike[1] + 0.02
    assert alike[0] > 0.94
