"""Training of the `mini` backbone on procedural people. Killed at any moment, the same call goes on.

Every step is a function of (seed, step), so an interrupted training ends like an uninterrupted one. The learning rate
is constant after a short rise and falls over the last quarter of the steps.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench import atomic, registry
from ihbench.errors import BadInput, Diverged
from ihbench.methods.inpainthuman.inpainting.backbone import Backbone, shrink_mask
from ihbench.methods.inpainthuman.inpainting.crop_album import PAGE, CropAlbum, Page
from ihbench.methods.inpainthuman.inpainting.mini_model import SIZE, TEXT_WIDTH, new_mini
from ihbench.methods.inpainthuman.inpainting.mini_training import MiniTraining
from ihbench.methods.inpainthuman.inpainting.part_map import part_colours
from ihbench.methods.inpainthuman.inpainting.random_mask import random_mask
from ihbench.progress import Progress

STATE = "training.safetensors"
CURVE = "curve.jsonl"
PERSON = "a photo of a person"
TRAIT_TOKENS = 4
TRAINED = ("unet", "controlnet", "text_encoder")
PIXELS = 8 * SIZE * 96  # of a batch: eight crops of the commonest width
RISE = 200  # steps of warming up


def curve_of(folder: Path) -> list[dict[str, Any]]:
    """The loss curve of a training, one row every fifty steps; of steps done twice after a kill, the later row."""
    rows = atomic.read_json_lines(folder / CURVE)
    return [row for _, row in sorted({row["step"]: row for row in rows}.items())]


class TraitTokens(nn.Module):
    """Turns a person's traits into word vectors in the place of V*: only training has them. It makes the room of word
    vectors hold whole outfits, so that a V* found by gradient descent can say one."""

    def __init__(self, n_traits: int):
        super().__init__()
        first, last = nn.Linear(n_traits, 128), nn.Linear(128, TRAIT_TOKENS * TEXT_WIDTH)
        nn.init.normal_(last.weight, std=0.01)
        self.net = nn.Sequential(first, nn.SiLU(), last)

    def forward(self, traits: Tensor) -> Tensor:  # [B, T] -> [B, TRAIT_TOKENS, TEXT_WIDTH]
        return self.net(traits).reshape(len(traits), TRAIT_TOKENS, TEXT_WIDTH)


class Crops:
    """All crops of an album, by width."""

    def __init__(self, pages: list[Page]):
        starts = np.cumsum([0, *(len(page.phrases) for page in pages)])
        self.pages = pages
        self.phrases = [phrases for page in pages for phrases in page.phrases]
        self.traits = np.concatenate([page.traits for page in pages])
        self.by_width: dict[int, NDArray[np.int64]] = {}  # [n, 3] page, crop, person
        for width in np.unique(np.concatenate([page.widths for page in pages])):
            rows = []
            for k, page in enumerate(pages):
                crops = np.flatnonzero(page.widths == width)
                rows.append(np.column_stack([np.full(len(crops), k), crops, starts[k] + page.person[crops]]))
            self.by_width[int(width)] = np.concatenate(rows)
        self.widths = sorted(self.by_width)
        counts = np.array([len(self.by_width[w]) for w in self.widths], np.float64)
        self.shares = counts / counts.sum()

    def draw(self, rng: np.random.Generator) -> tuple[int, NDArray[np.int64]]:
        """A width, and as many crops of it as fill a batch."""
        width = self.widths[int(rng.choice(len(self.widths), p=self.shares))]
        rows = self.by_width[width]
        size = max(PIXELS // (SIZE * width), 1)
        return width, rows[rng.choice(len(rows), size, replace=len(rows) < size)]

    def images(self, width: int, rows: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """Images [B, S, W, 3], silhouettes [B, S, W] and part labels [B, S, W]."""
        picked = [(self.pages[page], crop) for page, crop, _ in rows]
        return (
            np.stack([page.images[crop, :, :width] for page, crop in picked]),
            np.stack([page.silhouettes[crop, :, :width] for page, crop in picked]),
            np.stack([page.parts[crop, :, :width] for page, crop in picked]),
        )


class MiniTrainer:
    """A training in a folder: its album, its state, its loss curve."""

    def __init__(self, config: MiniTraining, folder: Path, album: Path, progress: Progress):
        if config.people < PAGE or config.people % PAGE:
            raise BadInput(f"--people {config.people}: expected a multiple of {PAGE}")
        self.config, self.folder, self.progress = config, Path(folder), progress
        people = registry.load("people", "procedural")
        store = CropAlbum(album, "procedural", config.each, SIZE)
        store.make(0, config.people, progress)
        self.crops = Crops(list(store.pages(0, config.people)))
        self.backbone = new_mini(people.vocabulary(), config.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed + 1)
            self.tokens = TraitTokens(people.N_TRAITS)
        self.modules = {name: getattr(self.backbone, name) for name in TRAINED} | {"tokens": self.tokens}
        self.named = {
            f"{part}.{name}": p for part, module in self.modules.items() for name, p in module.named_parameters()
        }
        self.mean = {name: p.detach().clone() for name, p in self.named.items()}
        self.optimizer = torch.optim.AdamW(
            list(self.named.values()), lr=config.lr, betas=(0.9, 0.99), weight_decay=0.01, fused=True
        )
        self.step, self.seconds = 0, 0.0
        self._traits: Tensor | None = None
        self.backbone.text_encoder.get_input_embeddings().register_forward_hook(self._say_traits)
        self._standardise()
        self._restore()

    def _standardise(self) -> None:
        page = self.crops.pages[0]
        images = torch.from_numpy(page.images).movedim(-1, 1).float() / 127.5 - 1
        self.backbone.codec.standardise(images, torch.from_numpy(page.silhouettes)[:, None])
        scale = self.backbone.codec.scale
        weight = scale**1.5  # between the pixels' own (2) and equal weight for every frequency (0)
        self.channel_weight = (weight / weight.mean())[:, None, None]

    # --- one step ---

    def run(self) -> Backbone:
        """Train to the last step; the backbone with the mean weights. Raises `Diverged` at a non-finite loss."""
        config = self.config
        last = saved = time.monotonic()
        losses: list[float] = []
        with self.progress.task("training mini", config.steps) as task:
            task.advance(self.step)
            while self.step < config.steps:
                losses.append(self._one_step())
                self.step += 1
                task.advance()
                now = time.monotonic()
                self.seconds, last = self.seconds + now - last, now
                if self.step % 50 == 0 or self.step == config.steps:
                    task.note(f"loss {np.mean(losses):.4f}")
                    self._note({"step": self.step, "seconds": round(self.seconds, 1), "loss": float(np.mean(losses))})
                    losses = []
                if now - saved > config.save_every and self.step < config.steps:
                    self.save()
                    saved = time.monotonic()
        self.save()
        return self.averaged()

    def _rate(self) -> float:
        left = (self.config.steps - self.step) / (0.25 * self.config.steps)
        return self.config.lr * min(1.0, (self.step + 1) / RISE) * min(1.0, left)

    def _one_step(self) -> float:
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate()
        self.optimizer.zero_grad(set_to_none=True)
        loss = self.loss(np.random.default_rng((self.config.seed, self.step)))
        value = loss.item()
        if not np.isfinite(value):
            raise Diverged(self.step, f"loss is {value}")
        loss.backward()
        torch.nn.utils.clip_grad_norm_(list(self.named.values()), 1.0)
        self.optimizer.step()
        decay = min(self.config.average, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for name, p in self.named.items():
                self.mean[name].lerp_(p, 1 - decay)
        return value

    def loss(self, rng: np.random.Generator) -> Tensor:
        """Weighted error of the clean latents over hidden blocks. SNR weights are clipped to [1, 5]."""
        backbone, config = self.backbone, self.config
        width, rows = self.crops.draw(rng)
        images, silhouettes, labels = self.crops.images(width, rows)
        hidden = torch.from_numpy(np.stack([random_mask(rng, s) for s in silhouettes]))[:, None].float()
        pixels = torch.from_numpy(images).movedim(-1, 1).float() / 127.5 - 1
        latents = backbone.codec.encode(pixels)
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        noise = torch.randn(latents.shape, generator=generator)
        timesteps = torch.randint(0, backbone.scheduler.config.num_train_timesteps, (len(rows),), generator=generator)
        noisy = backbone.scheduler.add_noise(latents, noise, timesteps)
        parts = None
        if rng.random() < config.control:
            parts = torch.from_numpy(part_colours(labels)).movedim(-1, 1).float() / 255
        text = self._text(rng, rows[:, 2])
        person = torch.from_numpy(silhouettes)[:, None].float()
        predicted = backbone.predict(noisy, timesteps, backbone.condition(pixels, hidden, person), text, parts)
        body = shrink_mask(person, latents)
        weight = shrink_mask(hidden, latents) * (config.background_weight + (1 - config.background_weight) * body)
        error = ((predicted - backbone.target(latents, noise, timesteps)).square() * self.channel_weight).mean(1)
        per_sample = (error * weight[:, 0]).sum((1, 2)) / weight.sum((1, 2, 3)).clamp(min=1)
        return (per_sample * backbone.snr(timesteps).clamp(1, 5)).mean()

    def _text(self, rng: np.random.Generator, people: NDArray[np.int64]) -> Tensor:
        config = self.config
        prompts, told = [], []
        for person in people:
            chance = rng.random()
            told.append(chance < config.traits)
            kept = [phrase for phrase in self.crops.phrases[person] if rng.random() < config.phrase_kept]
            if chance < config.traits:
                prompts.append(" ".join(["a photo of", *["person"] * TRAIT_TOKENS]))
            elif chance < config.traits + config.captions and kept:
                order = rng.permutation(len(kept))
                prompts.append(f"{PERSON} with {' , '.join(kept[k] for k in order)}")
            else:
                prompts.append(PERSON)
        self._traits = self.tokens(torch.from_numpy(self.crops.traits[people]))
        self._told = torch.tensor(told)
        try:
            return self.backbone.text(prompts)
        finally:
            self._traits = None

    def _say_traits(self, module: nn.Module, inputs: Any, vectors: Tensor) -> Tensor | None:
        """Hook on the word vectors: in told prompts, words 4 to 7 ([start] a photo of …) are the traits."""
        if self._traits is None:
            return None
        before = 4
        spoken = torch.cat([vectors[:, :before], self._traits, vectors[:, before + TRAIT_TOKENS :]], 1)
        return torch.where(self._told[:, None, None], spoken, vectors)

    # --- keeping ---

    def averaged(self) -> Backbone:
        """The backbone with the running mean of its weights."""
        with torch.no_grad():
            for name, p in self.named.items():
                p.copy_(self.mean[name])
        for name in TRAINED:
            getattr(self.backbone, name).eval().requires_grad_(False)
        return self.backbone

    def save(self) -> None:
        from safetensors.torch import save

        tensors = {f"now.{name}": p.detach() for name, p in self.named.items()}
        tensors |= {f"mean.{name}": p for name, p in self.mean.items()}
        for name, p in self.named.items():
            # a ControlNet that no step has used yet has no moments
            tensors |= {f"adam.{name}.{key}": value for key, value in self.optimizer.state.get(p, {}).items()}
        tensors = {name: value.contiguous() for name, value in tensors.items()}
        meta = {"step": str(self.step), "seconds": str(self.seconds), "config": json.dumps(asdict(self.config))}
        atomic.write_bytes(self.folder / STATE, save(tensors, meta))

    def _restore(self) -> None:
        from safetensors import SafetensorError, safe_open

        path = self.folder / STATE
        if not path.is_file():
            return
        try:
            with safe_open(path, "pt") as file:
                meta = file.metadata()
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            theirs = json.loads(meta["config"])
            free = ("steps", "save_every")
            differing = [k for k, v in asdict(self.config).items() if k not in free and theirs.get(k) != v]
            if differing:
                raise BadInput(f"{path}: a training with other {', '.join(differing)}; choose another folder")
            with torch.no_grad():
                for name, p in self.named.items():
                    p.copy_(tensors[f"now.{name}"])
                    self.mean[name].copy_(tensors[f"mean.{name}"])
                    keys = ("step", "exp_avg", "exp_avg_sq")
                    if f"adam.{name}.step" in tensors:
                        self.optimizer.state[p] = {key: tensors[f"adam.{name}.{key}"] for key in keys}
        except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
            raise BadInput(f"{path}: not a readable training state ({error}); remove it to start again") from error
        self.step, self.seconds = int(meta["step"]), float(meta["seconds"])

    def _note(self, row: dict[str, Any]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / CURVE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
