"""From a capture's stored images to the training and test views of a protocol.

Order of operations, as in the released ZJU readers: occluder on the silhouette of the original image, lens
undistortion with unchanged K, background paint outside the silhouette, resampling, 8 bit.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.errors import BadInput
from ihbench.metrics.images import bounds
from ihbench.scene.contracts import Capture, MaskState, TestView, TrainingSet, TrainView
from ihbench.scene.occlusion import OcclusionPlan, apply_rule, grown_for_clothes
from ihbench.scene.protocol import ImageRule, Protocol

if TYPE_CHECKING:
    from ihbench.body import Body

View = TypeVar("View")
LEVELS = (np.arange(256) / 255).astype(np.float32)  # of 8-bit images
REACH = 0.4  # m from its nearest joint, more than which no part of a body or its clothes is away
MAX_HELD = 700  # views kept in memory: 512² training views of this many take about 700 MB


class LazyViews(Sequence[View]):
    """A sequence whose items are made on first use and kept, at most `held` of them (the oldest goes first).

    Safe from any number of threads; an item that one of them is making is not made again by another.
    """

    def __init__(self, make: Callable[[int], View], length: int, held: int = MAX_HELD):
        self._make, self._length, self._held = make, length, held
        self._kept: OrderedDict[int, Future[View]] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._length))]
        if not -self._length <= index < self._length:
            raise IndexError(f"view {index} of {self._length}")
        index %= self._length
        own: Future[View] = Future()
        with self._lock:
            future = self._kept.setdefault(index, own)
            self._kept.move_to_end(index)
            if len(self._kept) > self._held:
                self._kept.popitem(last=False)
        if future is own:
            try:
                own.set_result(self._make(index))
            except BaseException as error:
                with self._lock:
                    self._kept.pop(index, None)
                own.set_exception(error)
                raise
        return future.result()

    def preload(self, workers: int = 2) -> Preloading:
        """Begin to make the first `held` items, in order, on threads of their own (image decoding releases the
        interpreter lock). What cannot be made is left to whoever asks for it, who gets the error."""
        pool = Preloading(workers, thread_name_prefix="preload")
        pool.futures = [pool.submit(self.__getitem__, index) for index in range(min(self._length, self._held))]
        return pool


class Preloading(ThreadPoolExecutor):
    """Items being made in the background. As a context it ends with what has been begun; `wait` waits for all."""

    futures: Sequence[Future]

    def wait(self) -> None:
        """Wait for all of them, and raise what went wrong with the first that failed."""
        for future in self.futures:
            future.result()
        self.shutdown()

    def __exit__(self, *_: object) -> None:
        self.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class TestViewKey:
    """Which test view a score belongs to."""

    __test__ = False

    camera: int
    frame: int
    camera_id: str
    group: str = ""  # further test views of a protocol are scored apart, under this name

    @property
    def name(self) -> str:
        return f"{self.camera_id}/{self.frame:06d}"


@dataclass(frozen=True)
class OccludedScene:
    """One capture under one protocol: what goes to the method, and what is kept back for scoring."""

    capture: Capture
    protocol: Protocol
    hiding: OcclusionPlan
    train: LazyViews[TrainView]
    test_keys: tuple[TestViewKey, ...]
    test: LazyViews[TestView]

    @cached_property
    def training(self) -> TrainingSet:
        """What the method gets."""
        return TrainingSet(self.train, self.capture.model, self.protocol.image.background, self.capture.name)

    def nearest_training(self, frame: int) -> TrainView:
        """The training view of about the moment of a frame."""
        frames = self.protocol.training_frames(self.capture.name, self.capture.n_frames)
        return self.train[min(range(len(frames)), key=lambda k: abs(frames[k] - frame))]


def straight_camera(camera: Camera, rule: ImageRule) -> Camera:
    """The camera of the protocol's images of this camera."""
    if rule.undistort and camera.distortion is not None:
        camera = camera.undistorted()
    return camera.scaled(*rule.extent(camera.width, camera.height))


class Undistorter:
    """Lens undistortion and resampling of one camera's images, with its pixel maps computed once."""

    def __init__(self, camera: Camera, rule: ImageRule):
        import cv2

        self._cv2, self._rule = cv2, rule
        # whole levels: what is known background and what is painted over must not differ by a rounding
        self.background = np.round(np.asarray(rule.background) * 255).astype(np.uint8)  # [3]
        self._maps = None
        if rule.undistort and camera.distortion is not None:
            K, size = camera.K_opencv, (camera.width, camera.height)
            self._maps = cv2.initUndistortRectifyMap(K, camera.distortion, np.eye(3), K, size, cv2.CV_16SC2)
        self.size = rule.extent(camera.width, camera.height)
        self.camera = straight_camera(camera, rule)
        # [h, w] pixels whose ray left the original image (a pincushion lens reaches out of it); None for none
        self.unphotographed: NDArray[np.bool_] | None = None
        if self._maps is not None:
            beyond = self.straighten(np.full((camera.height, camera.width), 255, np.uint8)) < 255
            self.unphotographed = self.shrink(beyond.astype(np.float32), "area") > 0 if beyond.any() else None

    def straighten(
        self,
        image: NDArray[Any],  # [H, W] or [H, W, C], original size
    ) -> NDArray[Any]:
        """The same shape without lens distortion."""
        if self._maps is None:
            return image
        return self._cv2.remap(image, self._maps[0], self._maps[1], self._cv2.INTER_LINEAR)

    def shrink(
        self,
        image: NDArray[Any],  # [H, W] or [H, W, C], original size
        how: str,
    ) -> NDArray[Any]:
        """[h, w] or [h, w, C] of the protocol's size."""
        return self._cv2.resize(image, self.size, interpolation=getattr(self._cv2, f"INTER_{how.upper()}"))

    def person(
        self,
        image: NDArray[np.uint8],  # [H, W, 3] the original
        silhouette: NDArray[np.bool_],  # [H, W]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """[h, w, 3] the person on the protocol's background, undistorted, resampled, 8 bit; and [h, w] the silhouette
        treated likewise."""
        alpha = self.straighten(silhouette.astype(np.uint8) * 255)
        if self._rule.edge == "hard":
            alpha = (alpha >= 128).astype(np.uint8) * 255
        return self._composited(image, alpha), self.shrink(alpha, self._rule.resample_mask) >= 128

    def _composited(self, image: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[h, w, 3]. Only the rectangle that holds the person is worked on: beyond it everything is background,
        before and after resampling."""
        height, width = alpha.shape
        # whole blocks of pixels, where resampling is a mean over blocks; all of the image elsewhere
        block = width // self.size[0] if self._rule.resample_image == "area" else 0
        if (block * self.size[0], block * self.size[1]) != (width, height):
            block = 0
        rows, columns = bounds(alpha > 0) or (slice(0, 1), slice(0, 1))
        if block:
            rows, columns = (slice(s.start // block * block, -(-s.stop // block) * block) for s in (rows, columns))
        share = alpha[rows, columns, None].astype(np.float32) / 255
        part = image[rows, columns]
        if self._maps is not None:
            part = self._cv2.remap(image, *(m[rows, columns] for m in self._maps), self._cv2.INTER_LINEAR)
        part = part * share + self.background * (1 - share)
        if block:
            small = np.empty((self.size[1], self.size[0], 3), np.uint8)
            small[:] = self.background
            target = tuple(slice(s.start // block, s.stop // block) for s in (rows, columns))
            shape = part.shape[1] // block, part.shape[0] // block
            small[target] = self._to_8bit(self._cv2.resize(part, shape, interpolation=self._cv2.INTER_AREA))
            return small
        full = np.empty((height, width, 3), np.float32)
        full[:] = self.background
        full[rows, columns] = part
        return self._to_8bit(self.shrink(full, self._rule.resample_image))

    def whole(
        self,
        image: NDArray[np.uint8],  # [H, W, 3] the original
    ) -> NDArray[np.uint8]:
        """[h, w, 3] the photograph itself, undistorted, resampled, 8 bit; background where none shows anything."""
        out = self._to_8bit(self.shrink(self.straighten(image).astype(np.float32), self._rule.resample_image))
        if self.unphotographed is not None:
            out[self.unphotographed] = self.background
        return out

    def _to_8bit(self, image: NDArray[np.float32]) -> NDArray[np.uint8]:
        return (np.clip(image, 0, 255) + (0.5 if self._rule.to_8bit == "round" else 1e-3)).astype(np.uint8)

    def touched(
        self,
        hidden: NDArray[np.bool_],  # [H, W] of the original image
    ) -> NDArray[np.bool_]:
        """[h, w] pixels with any part of a hidden original pixel in them: their colour is not to be trusted."""
        return self.shrink((self.straighten(hidden.astype(np.uint8) * 255) > 0).astype(np.float32), "area") > 0

    def cut_off(self, body: Body, body_pose: BodyPose) -> NDArray[np.bool_] | None:
        """[h, w] pixels that no photograph shows although the body may be there; None for none."""
        if self.unphotographed is None:
            return None
        from ihbench.render.zbuffer import rasterize
        from ihbench.scene.regions import projected_box

        camera = self.camera
        if not (self.unphotographed & projected_box(body.posed_joints(body_pose), camera, REACH)).any():
            return None  # as a rule: nobody near the borders, nothing to draw
        drawn = rasterize(camera.project(body.pose(body_pose)), body.faces, camera.height, camera.width).mask
        cut = self.unphotographed & grown_for_clothes(drawn)
        return cut if cut.any() else None


def test_view_keys(
    protocol: Protocol, subject: str, n_frames: int, camera_ids: Sequence[str]
) -> tuple[TestViewKey, ...]:
    """The test views of a subject of so many frames before these cameras, in the protocol's order."""
    return tuple(
        TestViewKey(camera, frame, camera_ids[camera], group)
        for camera, frame, group in protocol.test_views(subject, n_frames, len(camera_ids))
    )


test_view_keys.__test__ = False  # type: ignore[attr-defined]  # pytest: not a test


def open_scene(capture: Capture, protocol: Protocol) -> OccludedScene:
    """Apply a protocol to a capture. Pixels are read lazily.

    Raises `BadInput` when the capture has fewer frames or cameras than the protocol needs.
    """
    n_cameras = len(capture.camera_ids)
    protocol.check_views(capture.name, capture.n_frames, n_cameras, f"{capture.dataset} {capture.name}")
    hiding = apply_rule(protocol, capture)
    frames, covered = hiding.frames, hiding.covered
    lenses = LazyViews(lambda camera: Undistorter(capture.camera(camera), protocol.image), n_cameras, held=n_cameras)
    last: list[tuple[NDArray[np.bool_], NDArray[np.bool_]]] = []  # most rules hide the same every time

    def hidden_of(frame: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Hidden pixels of the original image, and of the protocol's."""
        hidden = hiding.occlusion.hidden(frame)
        known = last[-1] if last else None
        if known is None or known[0] is not hidden:
            known = hidden, lenses[protocol.train.camera].touched(np.ascontiguousarray(hidden))
            last[:] = [known]
        return known

    def silhouette(camera: int, frame: int) -> NDArray[np.bool_]:
        return capture.silhouette(camera, frame, protocol.subjects.silhouette)

    def train_view(k: int) -> TrainView:
        lens, frame = lenses[protocol.train.camera], frames[k]
        person = silhouette(protocol.train.camera, frame)
        image = capture.image(protocol.train.camera, frame)
        filmed = lens.whole(image) if hiding.in_scene else None
        unknown = [lens.cut_off(capture.model, capture.body_pose(frame))] if lens.unphotographed is not None else []
        if covered[k]:
            hidden, touched = hidden_of(frame)
            unknown.append(touched)
            person = person & ~hidden
            # before anything is resampled: lens and kernel would carry hidden colours out of the strip
            image = np.where(hidden[..., None], lens.background, image)
        image, mask = lens.person(image, person)
        state = np.where(mask, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
        for pixels in unknown:
            if pixels is not None:
                state[pixels] = MaskState.UNKNOWN
                image[pixels] = lens.background
        return TrainView(
            image,
            state,
            lens.camera,
            capture.body_pose(frame),
            frame,
            capture.camera_ids[protocol.train.camera],
            filmed,
        )

    keys = test_view_keys(protocol, capture.name, capture.n_frames, capture.camera_ids)

    def test_view(k: int) -> TestView:
        key = keys[k]
        lens, person = lenses[key.camera], silhouette(key.camera, key.frame)
        image, mask = lens.person(capture.image(key.camera, key.frame), person)
        hidden = None
        if lens.unphotographed is not None:
            hidden = lens.cut_off(capture.model, capture.body_pose(key.frame))
        if hiding.in_scene:
            standing = lens.touched(np.ascontiguousarray(hiding.in_test(key.camera).hidden(key.frame)))
            hidden = standing if hidden is None else hidden | standing
        if hidden is not None:
            mask &= ~hidden
            image[hidden] = lens.background
        return TestView(
            LEVELS[image], mask, lens.camera, capture.body_pose(key.frame), key.frame, key.camera_id, hidden
        )

    train, test = LazyViews(train_view, len(frames)), LazyViews(test_view, len(keys), held=64)
    return OccludedScene(capture, protocol, hiding, train, keys, test)


def uncovered(scene: OccludedScene) -> OccludedScene:
    """The scene without its occluder, for those who ask what a painter could have known. Raises `BadInput` where the
    occluder stands in the scene: nobody knows what is behind it."""
    if scene.hiding.in_scene:
        raise BadInput(
            f"{scene.capture.dataset} {scene.capture.name}: the occluder of {scene.protocol.name} stands in the "
            "scene, nobody knows what is behind it; name a rule that draws its occluder"
        )
    return open_scene(scene.capture, scene.protocol.with_fields({"occlusion.rule": "none"}))
