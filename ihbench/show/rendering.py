"""One or several runs' avatars drawn frame by frame, beside each other and beside the truth where there is one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.metrics.eight_bit import displayed
from ihbench.show.detail import drawn
from ihbench.show.panels import beside
from ihbench.show.shots import Shot, Take, View, take_of
from ihbench.show.subject import Subject, names_of


@dataclass(frozen=True)
class Film:
    """Frames to be drawn."""

    subjects: Sequence[Subject]
    takes: Sequence[Take]  # of each subject, of one length
    background: tuple[float, float, float]  # RGB in [0, 1]
    truth: bool  # a panel before the others
    names: Sequence[str]  # over the panels; none for no captions
    sharp: bool = False  # finer than the training images, too: see `show.detail`

    def __len__(self) -> int:
        return len(self.takes[0].shots)

    @property
    def fps(self) -> float:
        return self.takes[0].fps

    def frames(self, progress: Progress) -> Iterator[NDArray[np.uint8]]:
        """[H, W, 3] each, drawn when asked for."""
        with progress.task("rendering", len(self)) as task:
            for shots in zip(*(take.shots for take in self.takes), strict=True):
                panels = [self._panel(*of_run) for of_run in zip(self.subjects, self.takes, shots, strict=True)]
                if self.truth and shots[0].truth is not None:
                    panels.insert(0, displayed(shots[0].truth()))
                yield beside(panels, self.names, self.background)
                task.advance()

    def _panel(self, subject: Subject, take: Take, shot: Shot) -> NDArray[np.uint8]:
        camera = shot.camera.undistorted() if shot.camera.distortion is not None else shot.camera
        pixel = None if self.sharp or take.as_scored else subject.pixel
        image = drawn(subject.avatar, camera, shot.body_pose, self.background, shot.frame, subject.body, pixel)[0]
        expected = (camera.height, camera.width, 3)
        if np.shape(image) != expected:
            method = subject.run.record.identity.method
            raise BadInput(f"{method}: rendered an image of shape {np.shape(image)}, expected {expected}")
        return displayed(np.asarray(image))


def film(
    subjects: Sequence[Subject],
    view: View,
    background: tuple[float, float, float] | None = None,  # None: the protocol's
    side_by_side: bool = False,
    captions: bool = True,
    sharp: bool = False,
) -> Film:
    """What to draw. Raises `BadInput`, also for runs whose frames do not go together."""
    takes = [take_of(subject, view) for subject in subjects]
    lengths = {len(take.shots) for take in takes}
    if len(lengths) > 1:
        words = ", ".join(
            f"{len(take.shots)} of {s.run.folder.name}" for take, s in zip(takes, subjects, strict=True)
        )
        raise BadInput(f"--side-by-side: runs with as many frames: got {words}; name one --motion or --orbit for all")
    scenes = {(s.run.record.identity.scene, s.run.record.identity.data) for s in subjects}
    truth = side_by_side and len(scenes) == 1 and all(shot.truth is not None for shot in takes[0].shots)
    names = (["truth"] if truth else []) + names_of([subject.run for subject in subjects])
    own = subjects[0].run.protocol.image.background if background is None else background
    r, g, b = own
    return Film(subjects, takes, (r, g, b), truth, names if captions and side_by_side else (), sharp)
