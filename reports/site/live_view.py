"""A fit while it goes on, in the browser: snapshots of the running run in a viser scene on this machine alone.

viser (the extra `view`) draws the Gaussians of avatars that have them, and a textured mesh of others. Its splats are
those of files (`export.splat_cloud`): colours of no direction, widened by a training image's pixel.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ihbench import registry
from ihbench.body.canonical import canonical_pose
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.export.files import Exporter
from ihbench.export.skinned_glb import standing
from ihbench.record.finished_run import FinishedRun
from ihbench.show.following import Following, Seen
from ihbench.show.motion import Motion, Stand, find_motion
from ihbench.show.subject import Subject

HOST = "127.0.0.1"
EVERY = 1.0  # s between two looks at the run
REST = "a_pose"
FPS = 15.0
AVATAR = "/avatar"  # in the scene
HEIGHT, AWAY = 0.85, 4.4  # m: of the camera above the floor, and in front of the body
FIELD = np.radians(30)  # what it sees, vertically
TEXTURE = 256  # texels of a mesh's texture: it is made anew for every snapshot


def viser_or_why() -> ModuleType:
    """viser. Raises `BadInput` where it is not installed."""
    try:
        import viser
    except ImportError as error:
        why = "is not installed" if error.name == "viser" else f"cannot be imported ({error})"
        raise BadInput(f"--live needs viser, which {why}: pip install 'ihbench[view]'") from error
    return viser


class LiveView:
    """The page: what is new is loaded, posed as the page's controls say, and drawn."""

    def __init__(self, server: Any, following: Following, data: Path | None = None, body: Path | None = None):
        self.server, self.following = server, following
        self._data, self._body = data, body
        self._run: FinishedRun | None = None
        self._blur: float | None = None  # m, of its images' pixels
        self._exporter: Exporter | None = None  # of what is shown
        self._motions: dict[str, Motion] = {}  # for its body
        self._changed = False
        self._handle: Any = None
        server.scene.set_up_direction("+y")
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = (0.0, HEIGHT, AWAY), (0.0, HEIGHT, 0.0), FIELD
        self._words = server.gui.add_markdown("Waiting for the first snapshot of a run.")
        motions = registry.names("motion")
        self._motion = server.gui.add_dropdown("pose", (REST, *motions), initial_value=REST)
        self._time = server.gui.add_slider("time", min=0.0, max=1.0, step=0.01, initial_value=0.0)
        for control in (self._motion, self._time):
            control.on_update(self._ask_again)

    def _ask_again(self, _: object) -> None:
        self._changed = True

    def look(self) -> Seen | None:
        """Show what is new, if anything, and pose again what the page's controls have moved."""
        seen = self.following.look()
        if seen is not None and (subject := self._loaded(seen)) is not None:
            self._show(subject)
            self._words.content = f"**{seen.run.name}**: {seen.words}"
        if self.following.fault:
            self._words.content = self.following.fault
        if self._changed and self._exporter is not None:
            self._changed = False
            self._draw(self._exporter)
        return seen

    def _loaded(self, seen: Seen) -> Subject | None:
        """None where the run has begun to write over it: the next one will come."""
        if self._run is None or self._run.folder != seen.run:
            self._run, self._blur = FinishedRun(seen.run, self._data, self._body), None
        subject = Subject(self._run, snapshot=seen.folder)
        try:
            whole = subject.avatar is not None and seen.still_there
        except (BadInput, OSError):
            if seen.number is None:
                raise
            return None
        return subject if whole else None

    def _show(self, subject: Subject) -> None:
        before = self._exporter
        if before is None or not np.array_equal(before.subject.betas, subject.betas):
            self._motions = {}
        self._exporter = Exporter(subject, Progress.silent(), side=TEXTURE, footprint=self._blur)
        self._blur = self._exporter.blur
        self._changed = True

    def _pose(self, subject: Subject) -> Motion:
        """One frame: the pose that the page's controls say, upright, on a floor at y = 0."""
        name = self._motion.value
        if name not in self._motions:
            rest = Motion(canonical_pose(REST)[None], np.zeros((1, 3)), FPS)
            motion = rest if name == REST else find_motion(name, FPS, subject.body, subject.betas)
            self._motions[name] = standing(motion, subject.body, subject.betas)
        motion = self._motions[name]
        k = min(int(self._time.value * len(motion)), len(motion) - 1)
        return Motion(motion.pose[k][None], motion.transl[k][None], FPS)

    def _draw(self, exporter: Exporter) -> None:
        subject = exporter.subject
        still = self._pose(subject)
        if hasattr(subject.avatar, "posed_gaussians"):
            (pose,) = still.body_poses(subject.betas)
            cloud = exporter.cloud(pose, "y-up", Stand(np.eye(3), np.zeros(3)))
            factors = _axes(cloud.quaternions) * cloud.scales[:, None, :]
            self._handle = self.server.scene.add_gaussian_splats(
                AVATAR,
                cloud.means.astype(np.float32),
                (factors @ factors.transpose(0, 2, 1)).astype(np.float32),
                np.rint(cloud.colors * 255).astype(np.uint8),
                cloud.opacities[:, None].astype(np.float32),
            )
        else:
            self._handle = self.server.scene.add_glb(AVATAR, exporter.skinned_glb(self._motion.value, [], still))


def _axes(quaternions: Any) -> Any:
    """[N, 3, 3] of quaternions [N, 4], w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()


def serve_live(
    places: Sequence[Path],
    port: int,
    say: Callable[[str], None],
    data: Path | None = None,
    body: Path | None = None,
    goes_on: Callable[[], bool] = lambda: True,
) -> None:
    """Serve on the loopback address until interrupted, or until `goes_on` says no. Raises `BadInput` without viser,
    and for a port that cannot be had."""
    viser = viser_or_why()
    server = viser.ViserServer(host=HOST, port=port or _free_port(), label="ihbench", verbose=False)
    try:
        here = server.get_port()
        if port and here != port:
            raise BadInput(f"--port {port}: is taken; name another, or 0 for any that is free")
        say(f"http://{HOST}:{here}/  (from elsewhere: ssh -L {here}:{HOST}:{here} THIS_MACHINE; Ctrl-C ends it)")
        view, last = LiveView(server, Following(places), data, body), ""
        while goes_on():
            seen = None
            with suppress(FileNotFoundError):  # a run folder that goes away: the next look will not find it
                seen = view.look()
            words = f"{seen.run.name}: {seen.words}" if seen is not None else view.following.fault
            if words and words != last:
                say(words)
                last = words
            time.sleep(EVERY)
    finally:
        server.stop()


def _free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
