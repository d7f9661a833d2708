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
from torch import Tensor, nn

from ihbench import registry
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone, shrink_mask
from ihbench.diffusion.crops.crop_dataset import PAGE, CropDataset
from ihbench.diffusion.crops.diffusion_batch import guide_of, signed
from ihbench.diffusion.crops.head_places import marked
from ihbench.diffusion.crops.part_map import HEAD, N_PARTS, NO_PART, part_colours
from ihbench.diffusion.mini.batches import TRAIT_TOKENS, Batches, Crops, MiniBatch
from ihbench.diffusion.mini.model import GUIDE_CHANNELS, SIZE, TEXT_WIDTH, new_mini
from ihbench.diffusion.mini.training import MiniTraining
from ihbench.diffusion.mini.weights import load_mini
from ihbench.errors import BadInput, Diverged
from ihbench.files import atomic

STATE = "training.safetensors"
CURVE = "curve.jsonl"
TRAINED = ("unet", "controlnet", "text_encoder")
RISE = 200  # steps of warming up
HEAD_STEPS = 6.0  # times the loss of head crops: a gradient as long as persons', or Adam would hardly hear it
GUIDE = "controlnet_cond_embedding.conv_in.weight"


def curve_of(folder: Path) -> list[dict[str, float]]:
    """The loss curve of a training, one row every fifty steps; of steps done twice after a kill, the later row."""
    rows = atomic.read_json_lines(folder / CURVE)
    return [row for _, row in sorted({row["step"]: row for row in rows}.items())]


class PersonTokens(nn.Module):
    """Word vectors of the training people in the place of V*: only training has them. What their traits say, plus a
    row of each person's own, learned like textual inversion learns V*. It makes the space of word vectors hold whole
    outfits and persons, so that a V* found by gradient descent can say one."""

    def __init__(self, n_traits: int, people: int):
        super().__init__()
        self.own = nn.Embedding(people, TRAIT_TOKENS * TEXT_WIDTH)
        nn.init.zeros_(self.own.weight)
        first, last = nn.Linear(n_traits, 128), nn.Linear(128, TRAIT_TOKENS * TEXT_WIDTH)
        nn.init.normal_(last.weight, std=0.01)
        self.net = nn.Sequential(first, nn.SiLU(), last)

    def forward(self, traits: Tensor, people: Tensor) -> Tensor:  # [B, T], [B] -> [B, TRAIT_TOKENS, TEXT_WIDTH]
        return (self.net(traits) + self.own(people)).reshape(len(traits), TRAIT_TOKENS, TEXT_WIDTH)


class MiniTrainer:
    """A training in a folder: its dataset, its state, its loss curve."""

    def __init__(
        self,
        config: MiniTraining,
        folder: Path,
        dataset: Path,
        progress: Progress,
        device: str = "cpu",
        workers: int = 0,
        start: Path | None = None,
    ):
        if config.people < PAGE or config.people % PAGE:
            raise BadInput(f"--people {config.people}: expected a multiple of {PAGE}")
        self.config, self.folder, self.progress = config, Path(folder), progress
        self.device, self.workers = torch.device(device), workers
        people = registry.load("people", "procedural")
        store = CropDataset(dataset, "procedural", config.each, SIZE)
        store.make(0, config.people, progress)
        crops = Crops(list(store.pages(0, config.people)))
        self.backbone = new_mini(people.vocabulary(), config.seed)
        if start is not None:
            self._begin_from(load_mini(start))
        self.backbone.heads |= config.heads > 0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed + 1)
            self.tokens = PersonTokens(people.N_TRAITS, config.people)
        timesteps = self.backbone.scheduler.config.num_train_timesteps
        self.batches = Batches(config, crops, timesteps, self.backbone.tokenizer, self.backbone.max_tokens)
        self.modules = {name: getattr(self.backbone, name) for name in TRAINED} | {"tokens": self.tokens}
        for module in (*self.modules.values(), self.backbone.codec):
            module.to(self.device)
        if self.device.type == "cuda":  # convolutions are faster so there, and slower on the CPU
            for name in ("unet", "controlnet"):
                self.modules[name].to(memory_format=torch.channels_last)
        self.named = {
            f"{part}.{name}": p for part, module in self.modules.items() for name, p in module.named_parameters()
        }
        self.mean = {name: p.detach().clone() for name, p in self.named.items()}
        own = self.tokens.own.weight
        rest = [p for p in self.named.values() if p is not own]
        self.optimizer = torch.optim.AdamW(
            [{"params": rest, "times": 1.0}, {"params": [own], "times": config.table_lr}],
            lr=config.lr, betas=(0.9, 0.99), weight_decay=0.01, fused=True,
        )  # fmt: skip
        self.step, self.seconds = 0, 0.0
        self._traits: Tensor | None = None
        self.backbone.text_encoder.get_input_embeddings().register_forward_hook(self._say_traits)
        every_label = np.arange(256, dtype=np.uint8)
        self.colours = torch.from_numpy(part_colours(every_label)).to(self.device).float() / 255  # [256, 3]
        self._weigh_channels() if start is not None else self._standardise(crops)
        self._restore()

    def _begin_from(self, earlier: Backbone) -> None:
        """Take an earlier backbone's weights. Raises `BadInput` when it has another shape or other words."""
        if earlier.tokenizer.get_vocab() != self.backbone.tokenizer.get_vocab():
            raise BadInput("--start: a backbone that knows other words than these people's captions have")
        self.backbone.heads = earlier.heads
        for name in (*TRAINED, "codec"):
            state = getattr(earlier, name).state_dict()
            if name == "controlnet":
                state[GUIDE] = _widened(state[GUIDE], GUIDE_CHANNELS)
            try:
                getattr(self.backbone, name).load_state_dict(state)
            except RuntimeError as error:
                raise BadInput(f"--start: its {name} has another shape ({str(error).splitlines()[0]})") from error

    def _standardise(self, crops: Crops) -> None:
        page = crops.pages[0]
        images = signed(torch.from_numpy(page.images).to(self.device))
        person = torch.from_numpy(page.silhouettes).to(self.device)
        self.backbone.codec.standardise(images, person[:, None])
        self._weigh_channels()

    def _weigh_channels(self) -> None:
        scale = self.backbone.codec.scale
        weight = scale**1.5  # between the pixels' own (2) and equal weight for every frequency (0)
        self.channel_weight = (weight / weight.mean())[:, None, None]
        self.detail_weight = (scale / scale.mean())[:, None, None]  # of heads, whose details make a face

    # --- one step ---

    def run(self) -> Backbone:
        """Train to the last step; the backbone with the mean weights. Raises `Diverged` at a non-finite loss."""
        config = self.config
        last = saved = time.monotonic()
        losses: list[float] = []
        with self.progress.task("training mini", config.steps) as task:
            task.advance(self.step)
            pinned = self.device.type == "cuda"
            for batch in self.batches.stream(self.step, config.steps, self.workers, pinned):
                losses.append(self._one_step(batch))
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

    def _one_step(self, batch: MiniBatch) -> float:
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate() * group["times"]
        self.optimizer.zero_grad(set_to_none=True)
        loss = self.loss(batch)
        value = loss.item()
        if not np.isfinite(value):
            raise Diverged(self.step, f"loss is {value}")
        loss.backward()
        torch.nn.utils.clip_grad_norm_(list(self.named.values()), 1.0)
        self.optimizer.step()
        decay = min(self.config.average, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.mean.values()), list(self.named.values()), 1 - decay)
        return value

    def loss(self, batch: MiniBatch) -> Tensor:
        """Weighted error of the clean latents over hidden blocks. SNR weights are clipped to [1, 5]; heads have none,
        since their sampling begins with nearly all that it will say."""
        backbone, device = self.backbone, self.device
        batch = batch.to(device)
        pixels = signed(batch.images)
        person, hidden = (mask[:, None].float() for mask in (batch.person, batch.hidden))
        timesteps = batch.timesteps
        latents = backbone.codec.encode(pixels)
        generator = torch.Generator(device).manual_seed(batch.noise_seed)
        noise = torch.randn(latents.shape, generator=generator, device=device)
        noisy = backbone.scheduler.add_noise(latents, noise, timesteps)
        guide = None
        if batch.use_parts:
            seen = batch.seen.movedim(-1, 1).float() / 255
            parts = self.colours[batch.labels.long()] if batch.guides is None else batch.guides.float() / 255
            guide = guide_of(parts.movedim(-1, 1), seen)
        condition = backbone.condition(pixels, hidden, person, None if batch.fills is None else signed(batch.fills))
        with torch.autocast(device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            predicted = backbone.predict(noisy, timesteps, condition, self._text(batch), guide).float()
        body = shrink_mask(person, latents)
        weight = shrink_mask(hidden, latents)
        weight = weight * (self.config.background_weight + (1 - self.config.background_weight) * body)
        squared = (predicted - backbone.target(latents, noise, timesteps)).square()
        head = ((batch.labels % N_PARTS == HEAD) & (batch.labels != NO_PART))[:, None]
        if batch.guides is not None:
            weight = weight * _raised(self.config.feature_weight, head & marked(batch.guides)[:, None], latents)
            error = (squared * self.detail_weight).mean(1)
            return HEAD_STEPS * (error * weight[:, 0]).sum() / weight.sum().clamp(min=1)
        weight = weight * _raised(self.config.head_weight, head, latents)
        error = (squared * self.channel_weight).mean(1)
        per_sample = (error * weight[:, 0]).sum((1, 2)) / weight.sum((1, 2, 3)).clamp(min=1)
        return (per_sample * backbone.snr(timesteps).clamp(1, 5)).mean()

    def _text(self, batch: MiniBatch) -> Tensor:
        self._traits, self._told = self.tokens(batch.traits, batch.people), batch.told
        try:
            return self.backbone.text_of(batch.ids)
        finally:
            self._traits = None

    def _say_traits(self, module: nn.Module, inputs: Any, vectors: Tensor) -> Tensor | None:
        """Hook on the word vectors: in told prompts, words 4 to 7 ([start] a photo of …) are the traits."""
        if self._traits is None:
            return None
        before = 4
        spoken = torch.cat([vectors[:, :before], self._traits.to(vectors), vectors[:, before + TRAIT_TOKENS :]], 1)
        return torch.where(self._told[:, None, None], spoken, vectors)

    # --- keeping ---

    def averaged(self) -> Backbone:
        """The backbone with the running mean of its weights."""
        with torch.no_grad():
            for name, p in self.named.items():
                p.copy_(self.mean[name])
        for name in TRAINED:
            module = getattr(self.backbone, name).eval().requires_grad_(False)
            module.to(memory_format=torch.contiguous_format)  # the only one that can be saved
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
            step, seconds = int(meta["step"]), float(meta["seconds"])
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
                        self.optimizer.state[p] = {key: _like(p, tensors[f"adam.{name}.{key}"]) for key in keys}
        except (OSError, SafetensorError, KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            raise BadInput(f"{path}: not a readable training state ({error}); remove it to start again") from error
        self.step, self.seconds = step, seconds

    def _note(self, row: dict[str, float]) -> None:
        path = self.folder / CURVE
        atomic.write_json_lines(path, [*(atomic.read_json_lines(path) if path.is_file() else ()), row])


def _raised(times: float, where: Tensor, latents: Tensor) -> Tensor:
    """[B, 1, h, w] `times` in blocks that a mask [B, 1, H, W] marks, else 1."""
    return 1 + (times - 1) * shrink_mask(where, latents)


def _widened(weight: Tensor, channels: int) -> Tensor:
    """[O, I, 3, 3] with so many inputs, the new ones of no weight: a ControlNet that knew the part map alone."""
    more = max(channels - weight.shape[1], 0)
    return torch.cat([weight, weight.new_zeros(len(weight), more, *weight.shape[2:])], 1)


def _like(parameter: Tensor, kept: Tensor) -> Tensor:
    """A kept tensor where a parameter lies; a moment in its memory format, too, as the fused optimiser wants it."""
    if kept.shape != parameter.shape:  # the count of steps
        return kept.to(parameter.device)
    return torch.empty_like(parameter, dtype=kept.dtype).copy_(kept)
