"""Stage 2, inpainting (sec. 3.3): personalise an inpainter, paint what no view shows, find whole silhouettes."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.checkpoints import Tensors
from ihbench.clock.events import Inpainted, LeftOut, LossCurve, Resumed
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView, Inpainter, cut_view, with_frames
from ihbench.diffusion.crops.elsewhere import with_elsewhere
from ihbench.diffusion.crops.head_crop import PaintedHead, head_views, with_head
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView, paste_back
from ihbench.methods.inpainthuman.inpainting.shown_view import turntable_view, with_known_surface
from ihbench.methods.inpainthuman.inpainting.surface_need import SeenSurface, key_views, seen_surface
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView

if TYPE_CHECKING:
    from ihbench.diffusion.complete_silhouette import SilhouetteFinder
    from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter

STATE = "stage2-painted"
SIMPLE_SIZE = 128  # px, height of the crops of inpainters without a size of their own
LEAST_PIXELS = 12  # of a view; fewer are not worth an inpainter


class Stage2:
    """Paints the training views. What is done is kept by the ledger, so a killed run goes on behind it."""

    def __init__(
        self, avatar: GaussianAvatar, training: TrainingSet, config: InpaintConfig, seed: int, ledger: Ledger
    ):
        self.avatar, self.training, self.config, self.seed, self.ledger = avatar, training, config, seed, ledger

    def run(self, progress: Progress) -> list[PaintedView]:
        """The views that stage 3 learns from besides the training views; none where nothing needs painting."""
        saved = saved_paintings(self.ledger)
        if saved is not None:
            return saved
        with self.ledger.stage("look"):
            surface = seen_surface(self.training, self.config.facing)
            shown = self._shown(surface)
        if not shown and not self.config.always:
            return self._nothing("no training view hides surface that needs a painter")
        inpainter, size, square = self._inpainter()
        finder = self._silhouettes()  # before anything is learned: its weights may be missing
        body, views = self.training.body, self.training.views
        with self.ledger.stage("look"):
            crops = [cut_view(view, k, body, size, square) for k, view in shown.items()]
            crops = [crop for crop in crops if crop.unknown.any()]
            if not crops and not self.config.always:  # what is asked lies outside of every crop
                return self._nothing("what is hidden lies outside of every crop of the body")
            frames = [cut_view(views[k], k, body, size, square) for k in range(len(views))]
            filmed = with_frames(crops, frames)
        diffusion = cast("DiffusionInpainter", inpainter) if self.config.filler == "diffusion" else None
        if diffusion is not None:
            with self.ledger.stage("look"):
                crops, frames = with_elsewhere(crops, frames), with_elsewhere(frames, frames)
            diffusion.learn(frames, progress)
        if not crops:
            return self._nothing("nothing needed painting; personalised as asked")
        heads: dict[int, PaintedHead] = {}
        with self.ledger.stage("inpaint"):
            # the simple inpainters take their colours from whatever frame shows them
            given = crops if diffusion is not None else filmed
            painted = inpainter.inpaint(given, progress)[: len(crops)]
            if diffusion is not None and diffusion.paints_heads:
                heads = self._heads(diffusion, crops, shown, painted, progress)
            if self.config.context == "seen" and self.config.trust < 1:
                trust = self.config.trust
                painted = [self._with_own_guess(*each, trust) for each in zip(crops, painted, strict=True)]
            for k, head in heads.items():
                painted[k] = with_head(crops[k], painted[k], head, shown[crops[k].index])
        with self.ledger.stage("silhouette"):
            silhouettes = [finder.complete(view, image) for view, image in zip(crops, painted, strict=True)]
        out = [
            paste_back(shown[view.index], view, image, silhouette, self._original(view.index), heads.get(k))
            for k, (view, image, silhouette) in enumerate(zip(crops, painted, silhouettes, strict=True))
        ]
        if diffusion is not None:
            for state, curve in diffusion.curves.items():
                self.ledger.event(LossCurve(state, curve.steps[::5], curve.losses[::5]))
        with self.ledger.stage("measure"):
            self._record(crops, filmed, painted, silhouettes)
        self._save(out)
        return out

    def _nothing(self, reason: str) -> list[PaintedView]:
        self.ledger.event(LeftOut("inpainting", reason))
        self._save([])
        return []

    def _shown(self, surface: SeenSurface) -> dict[int, TrainView]:
        """Number -> view, as the inpainter is shown it; numbers beyond the training views are of turntable views."""
        training, config = self.training, self.config
        views = training.views
        if config.context == "frame":
            hidden = [k for k in range(len(views)) if (views[k].mask == MaskState.UNKNOWN).any()]
            keys = set(key_views(surface.faced, np.ones(len(surface.views), bool), config.key_views))
            return {k: views[k] for k in hidden if k in keys}
        chosen = key_views(surface.faced, surface.needed, config.key_views)
        shown = {k: with_known_surface(views[k], training, self.avatar, surface) for k in chosen}
        clearest = min(range(len(views)), key=lambda k: int((views[k].mask == MaskState.UNKNOWN).sum()))
        for turn in range(config.turntable):
            angle = 2 * np.pi * turn / config.turntable
            like = views[clearest]
            shown[len(views) + turn] = turntable_view(angle, like, training, self.avatar, surface)
        return {k: view for k, view in shown.items() if (view.mask == MaskState.UNKNOWN).sum() >= LEAST_PIXELS}

    def _inpainter(self) -> tuple[Inpainter, int, bool]:
        """The inpainter, the height of its crops in px, and whether they must be square."""
        config = self.config
        if config.filler != "diffusion":
            from ihbench.methods.inpainthuman.inpainting.simple_inpainters import simple_inpainters

            simple: Inpainter = simple_inpainters(self.training.body, self.training.background)[config.filler]
            return simple, SIMPLE_SIZE, False
        from ihbench.diffusion.diffusion_inpainter import DiffusionInpainter, load_backbone

        with self.ledger.stage("load"):
            backbone = load_backbone(config, str(self.avatar.device))
        return DiffusionInpainter(backbone, config, self.seed, self.ledger), backbone.size, backbone.square

    def _silhouettes(self) -> SilhouetteFinder:
        from ihbench.diffusion.complete_silhouette import silhouette_finder

        device = str(self.avatar.device)
        return silhouette_finder(self.config.silhouette, self.training.background, self.config.sam_weights, device)

    def _heads(
        self,
        diffusion: DiffusionInpainter,
        crops: list[CropView],
        shown: dict[int, TrainView],
        painted: list[NDArray[np.uint8]],
        progress: Progress,
    ) -> dict[int, PaintedHead]:
        """Number of a crop -> its hidden head, painted once more."""
        views = head_views(crops, shown, painted, self.training.body)
        images = diffusion.inpaint_heads(list(views.values()), progress)
        if self.config.context == "seen":
            trust = self.config.heads_trust
            images = [self._with_own_guess(*each, trust) for each in zip(views.values(), images, strict=True)]
        return {k: PaintedHead(view, image) for (k, view), image in zip(views.items(), images, strict=True)}

    def _with_own_guess(self, view: CropView, painted: NDArray[np.uint8], trust: float) -> NDArray[np.uint8]:
        """Painted pixels, averaged with what the avatar shows there: the two err differently."""
        guess, _ = self.avatar.render(view.camera, view.body_pose, self.training.background)
        mixed = trust * painted + (1 - trust) * 255 * guess
        return np.where(view.unknown[..., None], np.rint(mixed), painted).astype(np.uint8)

    def _original(self, index: int) -> TrainView | None:
        return self.training.views[index] if index < len(self.training.views) else None

    def _record(
        self,
        views: list[CropView],
        filmed: list[CropView],
        painted: list[NDArray[np.uint8]],
        silhouettes: list[NDArray[np.bool_]],
    ) -> None:
        """What the paper claims of its paintings, measured against what was filmed, and a picture of them."""
        from ihbench.methods.inpainthuman.studies.drift import flicker, identity_drift

        body, frames = self.training.body, len(self.training.views)
        images = painted + [view.image for view in filmed[len(painted) :]]
        # a turntable view follows no other in time
        in_time = [k for k, view in enumerate(views) if view.index < frames]
        self.ledger.event(
            Inpainted(
                views=len(views),
                of=frames,
                pixels=int(sum(view.unknown.sum() for view in views)),
                identity_drift=asdict(identity_drift(filmed, images, body)),
                flicker=asdict(flicker([filmed[k] for k in in_time], [painted[k] for k in in_time], body)),
            )
        )
        if self.ledger.on_disk:
            from ihbench.files.pictures import encoded
            from ihbench.methods.inpainthuman.studies.grid import painted_grid

            self.ledger.artifact("inpainting.png", encoded(painted_grid(views, painted, silhouettes), "PNG"))

    # --- resume ---

    def _save(self, painted: list[PaintedView]) -> None:
        tensors: Tensors = {"none": np.zeros(1, np.uint8)}
        for n, view in enumerate(painted):
            tensors |= {f"{n}.image": view.view.image, f"{n}.mask": view.view.mask}
            tensors |= {f"{n}.generated": view.generated.astype(np.uint8)}
            camera, pose = view.view.camera, view.view.body_pose
            tensors |= {f"{n}.K": camera.K, f"{n}.R": camera.R, f"{n}.t": camera.t}
            tensors |= {f"{n}.pose": pose.pose, f"{n}.betas": pose.betas, f"{n}.transl": pose.transl}
        rows = [[view.index, view.view.frame, view.view.camera_id] for view in painted]
        self.ledger.save_state(STATE, tensors, {"views": rows})


def saved_paintings(ledger: Ledger) -> list[PaintedView] | None:
    """What a run has painted, from its saved state; None where there is none, or a damaged one."""
    from ihbench.body.pose import BodyPose
    from ihbench.camera import Camera

    saved = ledger.load_state(STATE)
    if saved is None:
        return None
    tensors, meta = saved
    out = []
    for n, (index, frame, camera_id) in enumerate(meta["views"]):
        part = {name: np.asarray(tensors[f"{n}.{name}"]) for name in
                ("image", "mask", "generated", "K", "R", "t", "pose", "betas", "transl")}  # fmt: skip
        height, width = part["mask"].shape
        camera = Camera(part["K"], part["R"], part["t"], width, height)
        pose = BodyPose(part["pose"], part["betas"], part["transl"])
        view = TrainView(part["image"], part["mask"], camera, pose, int(frame), str(camera_id))
        out.append(PaintedView(int(index), view, part["generated"].astype(bool)))
    ledger.event(Resumed(STATE, len(out)))
    return out
