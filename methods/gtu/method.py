"""GTU as a registered method."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.events import LossCurve
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.gtu.avatar import GtuAvatar
from ihbench.methods.gtu.config import GtuConfig
from ihbench.methods.gtu.fitting import GtuFit
from ihbench.scene.contracts import TrainingSet

SWITCHES = "--method."  # what those of the backbone begin with


class Gtu:
    """The diffusion model is tuned to the person, then Gaussians are fitted to photos and guesses in one go."""

    def __init__(self, config: GtuConfig):
        self.config = config

    def fit(self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress) -> GtuAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        for weights that are missing or wrong."""
        views, config = training.views, self.config
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            if config.guesses:
                self._look_at_backbone()
            poses = [view.body_pose for view in views]
            betas = mean_betas(views, ledger, "the avatar")
            avatar = GtuAvatar(config, training.body, betas, [pose.pose for pose in poses]).to(device)
        guesser = None
        if config.guesses:
            with ledger.stage("fit/identity"):
                guesser = self._guesser(avatar, training, device, seed, ledger, progress)
        with ledger.stage("fit/gaussians"):
            GtuFit(avatar, training, seed, ledger, guesser).run(progress)
        return avatar

    def _look_at_backbone(self) -> None:
        """Raises `BadInput` for what a look at the folders can tell, before an hour of fitting."""
        from ihbench.diffusion.backbone_choice import look_at_chosen
        from ihbench.diffusion.subject_token import new_words

        config, identity = self.config, self.config.identity
        tokenizer = look_at_chosen(config, SWITCHES)
        if identity.on:
            option = f"{SWITCHES}identity.token"
            new_words(tokenizer, identity.token, config.settled().vectors, config.backbone, option)

    def _guesser(
        self, avatar: GtuAvatar, training: TrainingSet, device: str, seed: int, ledger: Ledger, progress: Progress
    ):
        """The backbone, tuned to the person. Imported here: a run without guesses must not pay for it."""
        from ihbench.diffusion.backbone_choice import load_chosen
        from ihbench.diffusion.crops.crop_view import cut_view
        from ihbench.methods.gtu.guesser import Guesser
        from ihbench.methods.gtu.identity import IdentityTuning

        backbone = load_chosen(self.config, device, SWITCHES)
        frames = [
            cut_view(view, k, training.body, backbone.size, square=True) for k, view in enumerate(training.views)
        ]
        words: list[str] = []
        if self.config.identity.on:
            tuning = IdentityTuning(backbone, frames, self.config, seed, ledger)
            tuning.run(progress)
            words = tuning.token.words
            for state, curve in tuning.curves.items():
                ledger.event_once(LossCurve(state, curve.steps[::5], curve.losses[::5]))
        return Guesser(backbone, words, avatar, frames, training.background, seed)

    def load(self, folder: Path, body: Body, device: str = "cpu") -> GtuAvatar:
        """Read an avatar written by `GtuAvatar.save`."""
        return GtuAvatar.load(folder, body, device)
