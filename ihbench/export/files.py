"""What `ihbench export` writes of one subject: a file, or numbered files, as names and bytes."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.export.about import GENERATOR, data_note, facts, licence
from ihbench.export.axes import WORDS, placement
from ihbench.export.glb import Glb
from ihbench.export.splat_cloud import SplatCloud, splat_cloud
from ihbench.files.splat_ply import splat_ply
from ihbench.show.motion import Motion, Stand, stand_of, up_axis
from ihbench.show.subject import Subject

BLUR = "the blur of a training image's pixel"
WIDENED = 0.275  # px² of a training image: nearly the renderer's LOW_PASS, since viewers add a low-pass of their own
CANONICAL = "a_pose"  # in which textures are baked: arms and legs are apart


@dataclass(frozen=True)
class Exporter:
    """Makes files of one run's avatar. Whatever its method cannot give raises `BadInput`."""

    subject: Subject
    progress: Progress
    relief: bool = True
    side: int = 512  # texels of a baked texture
    footprint: float | None = (
        None  # m, standard deviation that Gaussians are widened by; None: a training pixel's blur
    )

    # --- Gaussians ---

    def cloud(self, body_pose: BodyPose, axes: str, stand: Stand | None = None) -> SplatCloud:
        """The Gaussians in a pose, placed in the file's axes by where this body stands, or another one."""
        avatar = self.subject.avatar
        if not hasattr(avatar, "posed_gaussians"):
            method = self.subject.run.record.identity.method
            raise BadInput(
                f"{self.subject.run.folder}: {method} has no Gaussians to export; --to glb takes any method"
            )
        cloud, broken = splat_cloud(avatar.posed_gaussians(body_pose))
        if broken:  # the renderer does not draw them either
            print(f"ihbench: {broken} Gaussians that are not finite are left out", file=sys.stderr)
        cloud = cloud.widened(self.blur)
        stand = stand or stand_of(self.subject.body, self._own(body_pose), up_axis([body_pose]))
        R, origin = placement(axes, stand)
        return cloud if axes == "world" else cloud.turned(R, origin)

    @property
    def blur(self) -> float:
        """m, standard deviation of what the renderer's low-pass adds in the training images: the Gaussians learned
        under it, and look as they were fitted only with it. Not all of it: `WIDENED` is nearest to them in
        three.js (`docs/`). 0 where the data are not at hand."""
        if self.footprint is not None:
            return self.footprint
        return float(np.sqrt(WIDENED)) * (self.subject.pixel or 0.0)

    def ply(self, body_pose: BodyPose, axes: str, named: str, stand: Stand | None = None) -> bytes:
        """A splat PLY; its comments say what it is. Brush and splat-transform read the last one."""
        cloud, record = self.cloud(body_pose, axes, stand), self.subject.run.record
        note = licence(self.subject.body, holds_body=False)
        why = BLUR if self.footprint is None else "as asked"
        comments = [
            f"Exported from {GENERATOR}",
            "run: {run} {method} {scene}".format(**facts(record)),
            f"data: {data_note(record)}",
            *([f"licence: {note}"] if note else []),
            f"pose: {named}",
            "units: metres",
            *([f"widened by: {1000 * self.blur:.3g} mm (standard deviation), {why}"] if self.blur else []),
            f"axes: {WORDS[axes]}",
            "SplatRenderMode: default",
        ]
        return splat_ply(
            cloud.means, cloud.scales, cloud.colors, comments, cloud.quaternions, cloud.opacities, cloud.harmonics
        )

    def ply_sequence(self, motion: Motion, axes: str, named: str) -> Iterator[tuple[str, bytes]]:
        """A PLY for each frame, numbered from 1 as players expect it. The first one's pelvis is the origin of all."""
        poses = motion.body_poses(self.subject.betas)
        stand = stand_of(self.subject.body, poses[0], up_axis(poses))
        with self.progress.task("posing", len(poses)) as task:
            for k, body_pose in enumerate(poses, 1):
                said = f"frame {k} of {len(poses)} of {named}, {motion.fps:g} frames a second"
                yield f"avatar_{k:04d}.ply", self.ply(body_pose, axes, said, stand)
                task.advance()

    def splat_glb(self, body_pose: BodyPose, named: str) -> bytes:
        """glTF with `KHR_gaussian_splatting`."""
        from ihbench.export.splat_glb import splat_glb

        cloud, extras = self.cloud(body_pose, "y-up"), self._extras(holds_body=False, pose=named)
        return splat_glb(cloud, self._glb(holds_body=False), extras)

    # --- the mesh ---

    def skinned_glb(self, named: str, clips: Sequence[tuple[str, Motion]], still: Motion | None = None) -> bytes:
        """The skinned mesh, standing in the named pose; or as `still` has it, one frame that stands already."""
        from ihbench.export.skinned_glb import skinned_glb, standing

        subject, made = self.subject, self.baked
        relief = made.relief if self.relief else None
        if still is None:
            pose = subject.pose(named)
            still = standing(Motion(pose.pose[None], pose.transl[None], 1.0), subject.body, subject.betas, relief)
        moving = {name: standing(motion, subject.body, subject.betas, relief) for name, motion in clips}
        extras = self._extras(holds_body=True, pose=named, texture=made.how, pose_blend_shapes=False)
        return skinned_glb(
            self._glb(holds_body=True),
            subject.body,
            subject.betas,
            still,
            moving,
            made.texture,
            relief,
            extras,
        )

    def texture(self) -> bytes:
        """The texture as a PNG; what it is stands in its text."""
        from PIL import Image
        from PIL.PngImagePlugin import PngInfo

        made, words = self.baked, PngInfo()
        for name, text in self._extras(holds_body=False, texture=made.how).items():
            words.add_text(name, str(text))
        words.add_text("Software", GENERATOR)
        buffer = io.BytesIO()
        Image.fromarray(made.texture).save(buffer, "PNG", pnginfo=words, compress_level=9)
        return buffer.getvalue()

    @cached_property
    def baked(self) -> Any:
        """The mesh's surface: made once, it may take minutes. See `export.texture.Baked`."""
        from ihbench.export.texture import baked

        subject = self.subject
        return baked(
            subject.avatar,
            subject.body,
            subject.pose(CANONICAL, centred=True),
            self.progress,
            self.side,
            subject.pixel,
        )

    # --- the motion ---

    def amass(self, motion: Motion, named: str, axes: str) -> bytes:
        """AMASS' npz."""
        from ihbench.export.amass import amass_arrays

        subject = self.subject
        note = f"{GENERATOR}: {named}, for {subject.run.record.identity.scene}"
        arrays = amass_arrays(motion, subject.body, subject.betas, axes != "world", note)
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
        return buffer.getvalue()

    # --- what files say of themselves ---

    def _glb(self, holds_body: bool) -> Glb:
        return Glb(GENERATOR, licence(self.subject.body, holds_body))

    def _extras(self, holds_body: bool, **more: Any) -> dict[str, Any]:
        record, note = self.subject.run.record, licence(self.subject.body, holds_body)
        about = {**facts(record), "data": data_note(record), "units": "metres"}
        return {**about, **({"licence": note} if note else {}), **more}

    def _own(self, body_pose: BodyPose) -> BodyPose:
        """The pose of the avatar's own shape, by which it is placed."""
        betas: NDArray[np.float64] = self.subject.betas
        return BodyPose(body_pose.pose, betas, body_pose.transl)
