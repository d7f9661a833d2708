"""Writes Stable Diffusion 2 inpainting in miniature: its layers, its files and its names at random, tiny weights.

Files are as the original repository has them, written by diffusers 0.8: sparse configurations, old names of the VAE's
attention, `text_model.` before the text encoder's names, vocab.json with merges.txt. Only widths differ, and how deep
the text encoder is (SD2 stores 23 of 24 layers, so that its last hidden state is the penultimate one of OpenCLIP).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from safetensors.torch import save_file
from torch import Tensor
from transformers import CLIPTextConfig, CLIPTextModel

TEXT_WIDTH = 32
NEW_ATTENTION = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}

UNET = {
    "_class_name": "UNet2DConditionModel",
    "_diffusers_version": "0.8.0",
    "act_fn": "silu",
    "attention_head_dim": [2, 4, 4, 4],  # SD2: 5, 10, 20, 20; the number of heads, in spite of its name
    "block_out_channels": [16, 32, 32, 32],  # SD2: 320, 640, 1280, 1280
    "center_input_sample": False,
    "cross_attention_dim": TEXT_WIDTH,  # SD2: 1024
    "down_block_types": ["CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"],
    "downsample_padding": 1,
    "dual_cross_attention": False,
    "flip_sin_to_cos": True,
    "freq_shift": 0,
    "in_channels": 9,
    "layers_per_block": 2,
    "mid_block_scale_factor": 1,
    "norm_eps": 1e-05,
    "norm_num_groups": 8,  # SD2: 32
    "num_class_embeds": None,
    "only_cross_attention": False,
    "out_channels": 4,
    "sample_size": 8,  # SD2: 64
    "up_block_types": ["UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"],
    "use_linear_projection": True,
}
VAE = {
    "_class_name": "AutoencoderKL",
    "_diffusers_version": "0.8.0",
    "act_fn": "silu",
    "block_out_channels": [8, 8, 16, 16],  # SD2: 128, 256, 512, 512
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "in_channels": 3,
    "latent_channels": 4,
    "layers_per_block": 2,
    "norm_num_groups": 8,
    "out_channels": 3,
    "sample_size": 64,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
}
TEXT = {
    "architectures": ["CLIPTextModel"],
    "attention_dropout": 0.0,
    "bos_token_id": 0,
    "dropout": 0.0,
    "eos_token_id": 2,
    "hidden_act": "gelu",
    "hidden_size": TEXT_WIDTH,
    "initializer_factor": 1.0,
    "initializer_range": 0.02,
    "intermediate_size": 2 * TEXT_WIDTH,
    "layer_norm_eps": 1e-05,
    "max_position_embeddings": 77,
    "model_type": "clip_text_model",
    "num_attention_heads": 2,
    "num_hidden_layers": 3,
    "pad_token_id": 1,
    "projection_dim": TEXT_WIDTH,
    "torch_dtype": "float32",
}
SCHEDULER = {
    "_class_name": "PNDMScheduler",
    "_diffusers_version": "0.8.0",
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "clip_sample": False,
    "num_train_timesteps": 1000,
    "set_alpha_to_one": False,
    "skip_prk_steps": True,
    "steps_offset": 1,
    "trained_betas": None,
}
MERGES = ("p h", "o t", "ph ot", "phot o</w>", "p e", "r s", "o n</w>", "pe rs", "pers on</w>", "o f</w>")


def make_miniature(
    folder: Path, seed: int = 0, in_channels: int = 9, prediction_type: str = "epsilon", **unet_changes: Any
) -> Path:
    """`folder` with a whole model in it. `unet_changes` go into the UNet's configuration."""
    folder = Path(folder)
    unet = {**UNET, "in_channels": in_channels, **unet_changes}
    scheduler = SCHEDULER if prediction_type == "epsilon" else {**SCHEDULER, "prediction_type": prediction_type}
    vocabulary = clip_vocabulary()
    text = {**TEXT, "vocab_size": len(vocabulary)}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        models: Any = (
            UNet2DConditionModel.from_config(unet),
            AutoencoderKL.from_config(VAE),
            CLIPTextModel(CLIPTextConfig(**text)),
        )
    weights = [{name: p.detach().contiguous() for name, p in model.state_dict().items()} for model in models]
    write_part(folder / "unet", unet, "diffusion_pytorch_model", weights[0])
    write_part(folder / "vae", VAE, "diffusion_pytorch_model", {_old_name(n): p for n, p in weights[1].items()})
    named = {"text_model." + name.removeprefix("text_model."): p for name, p in weights[2].items()}
    named["text_model.embeddings.position_ids"] = torch.arange(77)[None]
    write_part(folder / "text_encoder", text, "model", named)
    write_json(folder / "scheduler" / "scheduler_config.json", scheduler)
    write_tokenizer(folder / "tokenizer", vocabulary)
    parts = {"scheduler": "PNDMScheduler", "text_encoder": "CLIPTextModel", "tokenizer": "CLIPTokenizer"}
    parts |= {"unet": "UNet2DConditionModel", "vae": "AutoencoderKL"}
    index = {name: ["transformers" if "CLIP" in kind else "diffusers", kind] for name, kind in parts.items()}
    write_json(
        folder / "model_index.json",
        {"_class_name": "StableDiffusionInpaintPipeline", "_diffusers_version": "0.8.0", **index},
    )
    return folder


def write_part(folder: Path, config: dict[str, Any], stem: str, weights: dict[str, Tensor]) -> None:
    write_json(folder / "config.json", config)
    save_file(weights, folder / f"{stem}.safetensors", {"format": "pt"})


def write_json(path: Path, value: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2), encoding="utf-8")


def clip_vocabulary() -> dict[str, int]:
    """CLIP's order: the bytes, the bytes that end a word, what is merged, start and end. "!" is 0, SD2's padding."""
    printable = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    others = [chr(256 + k) for k in range(256 - len(printable))]
    letters = [*map(chr, printable), *others]
    merged = [merge.replace(" ", "") for merge in MERGES]
    words = [*letters, *(letter + "</w>" for letter in letters), *merged, "<|startoftext|>", "<|endoftext|>"]
    return {word: k for k, word in enumerate(words)}


def write_tokenizer(folder: Path, vocabulary: dict[str, int]) -> None:
    write_json(folder / "vocab.json", vocabulary)
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *MERGES, ""]), encoding="utf-8")
    marks = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "unk_token": "<|endoftext|>"}
    special = {
        name: {"content": mark, "lstrip": False, "normalized": True, "rstrip": False, "single_word": False}
        for name, mark in marks.items()
    }
    write_json(folder / "special_tokens_map.json", {**special, "pad_token": "!"})
    settings = {"add_prefix_space": False, "do_lower_case": True, "errors": "replace", "model_max_length": 77}
    typed = {name: {"__type": "AddedToken", **token} for name, token in special.items()}
    write_json(
        folder / "tokenizer_config.json",
        {**settings, **typed, "pad_token": "<|endoftext|>", "tokenizer_class": "CLIPTokenizer"},
    )


def _old_name(name: str) -> str:
    if "mid_block.attentions" in name:
        for new, old in NEW_ATTENTION.items():
            name = name.replace(f".{new}.", f".{old}.")
    return name
