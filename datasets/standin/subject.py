"""A stand-in person: body shape, outfit and motion, all from a seed and a number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.standin import motion, outfit
from ihbench.datasets.standin.lighting import Lighting, studio_lighting
from ihbench.datasets.standin.photograph import Photograph, photograph
from ihbench.datasets.standin.rig import camera_ring

# what each member of a cast does; odd members turn all the way round, even ones look about
ROUTINES: tuple[tuple[str, ...], ...] = (
    ("arm_swing", "twist", "wave"),
    ("kick", "arm_swing", "punch"),
    ("squat", "overhead", "twist"),
    ("punch", "kick", "wave"),
    ("overhead", "arm_swing", "squat"),
    ("twist", "punch", "overhead", "kick"),
)


@dataclass(frozen=True)
class Subject:
    """Member `number` (from 1) of the cast that `seed` draws. A pure function of (seed, number, body).

    `vertices` are the unclothed body that a fit to the person would give; `clothed_vertices` and `baked`
    are the truth that the photographs show and that no file of the capture holds.
    """

    seed: int
    number: int
    body: Body

    def rng(self, what: str) -> np.random.Generator:
        """An own stream for every aspect, so that changing one does not reshuffle the others."""
        return np.random.default_rng([self.seed, self.number, *what.encode()])

    @cached_property
    def betas(self) -> NDArray[np.float64]:
        """[10] shape coefficients."""
        return np.clip(self.rng("shape").normal(0, 0.9, 10), -1.8, 1.8)

    @cached_property
    def style(self) -> outfit.Style:
        """The wardrobe. The first six of a cast share no skin, hair, top, trousers or shoes."""
        cast = np.random.default_rng([self.seed, *b"cast"])
        order = {what: cast.permutation(6) for what in ("skins", "hairs", "tops", "bottoms", "shoes")}
        place = (self.number - 1) % 6
        return outfit.choose_style(self.rng("style"), {what: int(order[what][place]) for what in order})

    @cached_property
    def performance(self) -> motion.Performance:
        """The movements, before they are put on this body."""
        cast = np.random.default_rng([self.seed, *b"routines"])
        routine = ROUTINES[int(cast.permutation(len(ROUTINES))[(self.number - 1) % len(ROUTINES)])]
        return motion.perform(self.rng("motion"), routine, full_turn=self.number % 2 == 1)

    @cached_property
    def novel_performance(self) -> motion.Performance:
        """What they do after the exercises: movements that nobody makes among those."""
        return motion.perform(self.rng("novel"), motion.NOVEL, full_turn=False, n_frames=motion.NOVEL_FRAMES)

    @cached_property
    def body_poses(self) -> list[BodyPose]:
        """One pose per frame, world with z up and the floor at z = 0."""
        shows = (self.performance, self.novel_performance)
        return [pose for show in shows for pose in motion.body_poses(show, self.betas, self.body)]

    @cached_property
    def lighting(self) -> Lighting:
        return studio_lighting(self.rng("light"))

    @cached_property
    def cameras(self) -> list[Camera]:
        """The calibrated rig of this person's session."""
        return camera_ring(self.rng("rig"))

    @cached_property
    def studio_seed(self) -> int:
        """Which studio the session took place in."""
        return int(self.rng("studio").integers(2**31))

    @cached_property
    def offsets(self) -> NDArray[np.float64]:
        """[V, 3] m, how cloth and hair stand off the rest-pose body."""
        return outfit.stand_off(self.body, self.style)

    @cached_property
    def baked(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Over the body's atlas [S, S, 3] sRGB albedo in [0, 1], and [S, S] `outfit.Part`."""
        return outfit.bake(self.body, self.style, outfit.TEXTURE_SIZE)

    def vertices(self, frame: int) -> NDArray[np.float64]:
        """[V, 3] m, world: the unclothed body."""
        return self.body.pose(self.body_poses[frame])

    def clothed_vertices(self, frame: int) -> NDArray[np.float64]:
        """[V, 3] m, world: the true surface with cloth and hair."""
        return self.body.pose(self.body_poses[frame], offsets=self.offsets)

    def photograph(
        self,
        vertices: NDArray[np.float64],  # [V, 3] m, world: the clothed surface
        camera: Camera,
        background: NDArray[np.uint8],  # [H, W, 3] sRGB, what this camera sees without the person
    ) -> Photograph:
        return photograph(vertices, self.body, *self.baked, self.lighting, camera, background)
