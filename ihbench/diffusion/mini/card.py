"""The model card of a trained `mini` backbone."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

import torch

from ihbench import registry
from ihbench.diffusion.mini.train_mini import curve_of
from ihbench.diffusion.mini.training import MiniTraining
from ihbench.diffusion.mini.validation import Validation
from ihbench.files.atomic import write_json, write_text
from ihbench.version import __version__

CARD = "README.md"
FIGURES = "training.json"


def write_card(
    folder: Path,
    config: MiniTraining,
    seconds: float,
    validation: Validation,
    device: str = "cpu",
    start: Path | None = None,
) -> None:
    """`README.md` for people and `training.json` for programs, beside the weights."""
    people = registry.load("people", "procedural")
    curve = curve_of(folder / "training")
    machine = torch.cuda.get_device_name() if device != "cpu" else f"{os.cpu_count()} CPU cores"
    write_json(
        folder / FIGURES,
        {"config": asdict(config), "seconds": seconds, "machine": machine, "validation": validation, "curve": curve},
    )
    settings = " ".join(
        f"--train.{name.replace('_', '-')} {value}" for name, value in asdict(config).items() if name != "save_every"
    )
    on = "" if device == "cpu" else f" --device {device}"
    on += "" if start is None else " --start EARLIER"
    before = [] if start is None else ["- Started from the weights of an earlier training:", *_quoted(start / CARD)]
    rows = [f"| {name} | {value:.2f} |" for name, value in validation.hidden_psnr.items()]
    thinned = curve[:: max(len(curve) // 20, 1)]
    points = [f"| {row['step']} | {row['loss']:.4f} | {row['seconds'] / 60:.0f} |" for row in thinned]
    write_text(folder / CARD, "\n".join([
        "# mini: a small inpainting diffusion backbone",
        "",
        "The classes of Stable Diffusion 2 inpainting (9-channel scheme, text encoder, ControlNet on the SMPL parts)",
        "at a hundredth of its size, for persons in crops 128 px tall and heads in crops of 64. It knows procedural",
        "people and nothing else: it is there to run InpaintHuman without any download, on stand-ins; real people",
        "want real weights.",
        "",
        f"- Data: people 0 to {config.people - 1} of `datasets/standin/training_people.py` version {people.VERSION}, "
        f"{config.each} photographs each.",
        "  Stand-ins of the protocols come from another random stream; none of them is in it.",
        f"- {config.steps} steps of about {config.batch} crops in {config.precision}, {seconds / 60:.0f} minutes on "
        f"{machine}, seed {config.seed}.",
        f"- Made with ihbench {__version__}, torch {torch.__version__}, by",
        f"  `ihbench train-mini --out DIR{on} {settings}`.",
        *before,
        "- Weights are rounded to 16 bit. Licence: that of ihbench.",
        "",
        f"PSNR over the hidden pixels of {validation.people} unseen procedural people behind a central strip over",
        f"{validation.strip:.0%} of them, not personalised; of hidden faces over the person in head crops that begin",
        "with a blurred head:",
        "",
        "| painter | dB |",
        "|---|---|",
        *rows,
        "",
        "| step | training loss | minutes |",
        "|---|---|---|",
        *points,
        "",
    ]))  # fmt: skip


def _quoted(card: Path) -> list[str]:
    """What an earlier card says of its training."""
    lines = card.read_text(encoding="utf-8").splitlines() if card.is_file() else ["- (it has no card)"]
    return [f"  {line}" for line in lines if line.startswith(("- ", "  ")) and "rounded to 16 bit" not in line]
