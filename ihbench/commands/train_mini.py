"""`ihbench train-mini --out DIR`: train the small backbone on procedural people. Resumable."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ihbench.commands.options.device import check_device
from ihbench.diffusion.mini.training import MiniTraining
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.diffusion.mini.validation import Validation

TRAINING = "training"  # folder in the output: state and loss curve


@dataclass(frozen=True, kw_only=True)
class TrainMiniOptions:
    out: Path
    """Folder of the backbone; its folder `training` holds the state, so that the same command goes on."""
    dataset: Path | None = None
    """Folder of the photographs; by default in the cache."""
    train: MiniTraining = field(default_factory=MiniTraining)
    """How it is trained."""
    start: Path | None = None
    """Folder of a mini backbone to go on from; by default training starts from random weights."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""


def main(argv: list[str]) -> int:
    from ihbench.commands.options.parse import options

    chosen = options(TrainMiniOptions, argv, "train-mini", "Train the small diffusion backbone.")
    result = _train(chosen)
    print(json.dumps(asdict(result)) if chosen.json else _told(result, chosen.out))
    return 0


def _train(chosen: TrainMiniOptions) -> Validation:
    from ihbench.clock.progress import Progress
    from ihbench.diffusion.mini.card import write_card
    from ihbench.diffusion.mini.folder import SHIPPED, check_mini
    from ihbench.diffusion.mini.train_mini import MiniTrainer
    from ihbench.diffusion.mini.validation import validate
    from ihbench.diffusion.mini.weights import save_mini
    from ihbench.files import removal
    from ihbench.files.locks import locked
    from ihbench.scene.data_source import cache_folder

    check_device(chosen.device)
    if chosen.out.resolve() == SHIPPED.resolve():
        raise BadInput(f"--out {chosen.out}: holds the shipped backbone; train in a folder of your own")
    if chosen.start is not None and removal.holds(chosen.start, chosen.out):
        raise BadInput(f"--out {chosen.out}: holds the backbone to start from; train in a folder of your own")
    if chosen.start is not None:
        check_mini(chosen.start)  # before hours of photographs
    _check_out(chosen.out)
    dataset = chosen.dataset or cache_folder() / "crops"
    # a GPU waits for one process that draws occluders; on the CPU more processes would only take from each other
    workers = 0 if chosen.device == "cpu" else max((os.cpu_count() or 1) - 2, 0)
    with locked(chosen.out / TRAINING / "lock", "choose another --out folder"):
        trainer = MiniTrainer(
            chosen.train, chosen.out / TRAINING, dataset, Progress(), chosen.device, workers, start=chosen.start
        )
        backbone = trainer.run()
        save_mini(backbone, chosen.out)
        result = validate(backbone, dataset, chosen.train.each, Progress())
        write_card(chosen.out, chosen.train, trainer.seconds, result, chosen.device, chosen.start)
    return result


def _check_out(out: Path) -> None:
    """Raise `BadInput` where training would overwrite what is not of an earlier training: another model has folders
    of the same names, and a project a README.md."""
    from ihbench.diffusion.mini.card import CARD, FIGURES
    from ihbench.diffusion.mini.folder import PARTS, check_mini
    from ihbench.diffusion.mini.train_mini import CURVE, STATE

    state = out / TRAINING / STATE
    names = sorted(name for name in (*PARTS, CARD, FIGURES, TRAINING) if os.path.lexists(out / name))
    if not names or (state.is_file() and not state.is_symlink()):
        return
    if names == [TRAINING] and set(os.listdir(out / TRAINING)) <= {CURVE, "lock", "lock.owner", "lock.claim"}:
        return  # stopped before its first state was saved
    try:
        check_mini(out)
    except BadInput as error:
        raise BadInput(f"--out {out}: holds {names[0]}, not of a training of mini; choose another folder") from error


def _told(result: Validation, out: Path) -> str:
    lines = [f"{name:<40}{value:6.2f} dB" for name, value in result.hidden_psnr.items()]
    return "\n".join([f"hidden pixels of {result.people} unseen people:", *lines, f"backbone: {out}"])
