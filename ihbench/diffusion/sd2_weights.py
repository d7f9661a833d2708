"""The `sd2` backbone: the user's own Stable Diffusion 2 inpainting weights.

The folder is in diffusers layout, safetensors only:

    model_index.json                                  (not needed)
    unet/          config.json  diffusion_pytorch_model.safetensors   9 input channels
    vae/           config.json  diffusion_pytorch_model.safetensors
    text_encoder/  config.json  model.safetensors
    tokenizer/     tokenizer_config.json, and vocab.json with merges.txt, or tokenizer.json
    scheduler/     scheduler_config.json

File names with a variant (`…model.fp16.safetensors`) and shards are found too. Every `config.json`, and the header
of every weights file, is checked before a weight is read; the layers are those of Stable Diffusion 2, the widths are
free, so that a miniature goes through the same door. The modules are built here from the checked configurations, not
by `from_pretrained`, which makes up what a file lacks and may ask the hub.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ihbench.diffusion.backbone import Backbone, LatentAutoencoder
from ihbench.diffusion.checkpoint import (
    CONVERT,
    Config,
    UnreadModule,
    empty_module,
    find_folder,
    has_pickles,
    read_json,
    readable,
    weight_files,
)
from ihbench.diffusion.memory import said_when_full
from ihbench.diffusion.part_controlnet import new_controlnet
from ihbench.diffusion.text_encoder import TEXT_STEM, unread_text_encoder
from ihbench.errors import BadInput

STEMS = {"unet": "diffusion_pytorch_model", "vae": "diffusion_pytorch_model", "text_encoder": TEXT_STEM}
SWITCHES = "--method.inpaint."  # what messages call the switches by: before "weights" and "control-weights"
LAYOUT = (
    "expected Stable Diffusion 2 inpainting in diffusers layout: unet/, vae/, text_encoder/ (config.json and "
    "safetensors in each), tokenizer/, scheduler/scheduler_config.json"
)
WRONG_MODEL = "expected Stable Diffusion 2 inpainting"
CONTROL_WANTED = (
    "expected a ControlNet for Stable Diffusion 2 or its 4-channel base UNet; without one a ControlNet is made from "
    "the inpainting UNet"
)
DTYPES = {"fp32": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
ENCODER_SHAPE = (
    "block_out_channels", "down_block_types", "layers_per_block", "cross_attention_dim", "attention_head_dim",
    "use_linear_projection",
)  # fmt: skip
# of a VAE before diffusers 0.14
OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}


@dataclass(frozen=True)
class LookedAt:
    """Weights that fit together by their configurations and headers; none of them is read yet."""

    folder: Path
    unet: UnreadModule
    vae: UnreadModule
    text_encoder: UnreadModule
    controlnet: UnreadModule | None
    base_unet: UnreadModule | None  # to make a ControlNet from
    tokenizer: Any
    scheduler: Any
    vae_upcast: bool  # whether the VAE stays in fp32, whatever the rest is in


def look_at_sd2(weights: str, control: str | None = None, switches: str = SWITCHES) -> LookedAt:
    """The folder or cached hub id `weights`, and the ControlNet of `control` or the UNet in its place, after
    everything was checked that needs no weight to be read. Raises `BadInput`, see `load_sd2`."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    folder = find_folder(weights, f"{switches}weights")
    _check_layout(folder)
    configs = {part: read_json(folder / part / "config.json") for part in STEMS}
    _check_model(folder, configs, switches)
    scheduler, tokenizer = _scheduler(folder), _tokenizer(folder, configs["text_encoder"])
    unet_module: Any = empty_module(folder / "unet", lambda: UNet2DConditionModel.from_config(configs["unet"]))
    unet = UnreadModule(unet_module, folder / "unet", STEMS["unet"])
    vae_module: Any = empty_module(folder / "vae", lambda: AutoencoderKL.from_config(configs["vae"]))
    vae = UnreadModule(vae_module, folder / "vae", STEMS["vae"], _vae_name)
    text_encoder = unread_text_encoder(folder / "text_encoder", configs["text_encoder"])
    controlnet, base_unet = _unread_control(control, unet_module.config, vae_module.config, switches)
    upcast = bool(vae_module.config["force_upcast"])
    return LookedAt(folder, unet, vae, text_encoder, controlnet, base_unet, tokenizer, scheduler, upcast)


def load_sd2(
    weights: str,
    control: str | None = None,
    *,
    device: torch.device | str,
    dtype: str = "auto",
    memory_lean: bool = False,
    switches: str = SWITCHES,
) -> Backbone:
    """The backbone of the folder or cached hub id `weights`, frozen, on `device`.

    The ControlNet is `control` (its folder), or made from the four-channel Stable Diffusion 2 UNet that `control`
    holds, or else from the inpainting UNet. `dtype` is fp32, fp16, bf16, or auto: on CUDA bf16, where it lacks that
    fp16, elsewhere fp32. A VAE with `force_upcast` (its default) stays in fp32. `memory_lean` checkpoints gradients,
    and has the VAE take one image at a time, large ones in tiles: slower, same results within rounding.

    Raises `BadInput` for a folder that is incomplete, another model, pickled, cut short, inconsistent or not finite,
    and when the device has too little memory.
    """
    device = torch.device(device)
    number = _number_type(dtype, device)
    parts = look_at_sd2(weights, control, switches)
    vae_number = torch.float32 if parts.vae_upcast else number
    too_small = f"{switches}weights {parts.folder}: {device} has too little free memory for these weights"
    with said_when_full(f"{too_small}; free some, or use another GPU"):
        # part by part, so that no more than one is in memory twice
        text_encoder = parts.text_encoder.read(device, number)
        vae = parts.vae.read(device, vae_number)
        unet = parts.unet.read(device, number)
        if parts.controlnet is not None:
            controlnet = parts.controlnet.read(device, number)
        elif parts.base_unet is not None:
            controlnet = new_controlnet(parts.base_unet.read(torch.device("cpu"), number), 4, device, number)
        else:
            controlnet = new_controlnet(unet, 4, device, number)
    if memory_lean:
        # attention is not sliced: torch's fused attention takes less memory whole (64² tokens, 5 heads, with
        # gradients: 110 MB, sliced 930 MB, and half the time)
        unet.enable_gradient_checkpointing()
        controlnet.enable_gradient_checkpointing()
        vae.enable_slicing()
        vae.enable_tiling()
    if device.type == "cuda":
        for module in (unet, controlnet, vae):
            module.to(memory_format=torch.channels_last)
    codec = LatentAutoencoder(vae)
    size = int(unet.config["sample_size"] or 64) * codec.block
    return Backbone("sd2", unet, text_encoder, parts.tokenizer, controlnet, codec, parts.scheduler, size, square=True)


def _number_type(dtype: str, device: torch.device) -> torch.dtype:
    if dtype != "auto":
        if dtype not in DTYPES:
            raise BadInput(f"dtype {dtype!r}: expected auto, {', '.join(DTYPES)}")
        return DTYPES[dtype]
    if device.type != "cuda":
        return torch.float32
    native = torch.cuda.get_device_capability(device)[0] >= 8  # is_bf16_supported counts emulation too
    return torch.bfloat16 if native else torch.float16


# --- before a weight is read ---


def _check_layout(folder: Path) -> None:
    """Everything that is missing, in one line."""
    _refuse(
        folder,
        ((folder / "text_encoder_2").is_dir(), "this is SDXL (it has text_encoder_2/)"),
        ((folder / "transformer").is_dir(), "this is a model with a transformer/ for a UNet"),
    )
    if (folder / "config.json").is_file() and not (folder / "unet").is_dir():
        raise BadInput(f"{folder}: this is one part of a model; give the folder above it; {LAYOUT}")
    lacking, pickled = [], []
    for part, stem in STEMS.items():
        if not (folder / part).is_dir():
            lacking.append(f"{part}/")
            continue
        if not (folder / part / "config.json").is_file():
            lacking.append(f"{part}/config.json")
        if not weight_files(folder / part, stem):
            (pickled if has_pickles(folder / part) else lacking).append(f"{part}/{stem}.safetensors")
    tokenizer = folder / "tokenizer"
    if not tokenizer.is_dir():
        lacking.append("tokenizer/")
    elif not (tokenizer / "tokenizer.json").is_file():
        lacking += [f"tokenizer/{n}" for n in ("vocab.json", "merges.txt") if not (tokenizer / n).is_file()]
    if not (folder / "scheduler" / "scheduler_config.json").is_file():
        lacking.append("scheduler/scheduler_config.json")
    if lacking:
        raise BadInput(f"{folder}: lacks {', '.join(lacking)}; {LAYOUT}")
    if pickled:
        raise BadInput(
            f"{folder}: has pickles (.bin, .ckpt, .pt) for {', '.join(pickled)}; they are refused; {CONVERT}"
        )


def _check_model(folder: Path, configs: dict[str, Config], switches: str) -> None:
    """Stable Diffusion 2 inpainting by its layers; widths are only compared with each other."""
    unet, vae, text = configs["unet"], configs["vae"], configs["text_encoder"]
    _check_sd2_unet(folder / "unet" / "config.json", unet)
    channels, latents = unet.get("in_channels"), vae.get("latent_channels")
    _refuse(
        folder / "unet" / "config.json",
        (
            channels == 4,
            f"in_channels is 4: this is the base model, not the inpainting one (9); it may be given as "
            f"{switches}control-weights",
        ),
        (channels != 9, f"in_channels is {channels}, expected 9 (latents, mask, masked latents)"),
    )
    _refuse(
        folder / "vae" / "config.json",
        (
            vae.get("_class_name") != "AutoencoderKL" or latents != 4,
            f"{vae.get('_class_name')} with {latents} latent channels, expected AutoencoderKL with 4",
        ),
    )
    where, width = folder / "text_encoder" / "config.json", unet["cross_attention_dim"]
    kind = text.get("model_type", "clip_text_model")
    _refuse(where, (kind != "clip_text_model", f"model_type is {kind}, expected clip_text_model"))
    if text.get("hidden_size") != width:
        raise BadInput(
            f"{where}: hidden_size is {text.get('hidden_size')}, but the UNet reads text of width {width} "
            f"(cross_attention_dim); take both from one source"
        )


def _check_sd2_unet(where: Path, unet: Config) -> None:
    """What sets the UNet of Stable Diffusion 2 apart, whatever its width and its input channels."""
    kind, out, width = (unet.get(name) for name in ("_class_name", "out_channels", "cross_attention_dim"))
    heads = unet.get("attention_head_dim")
    _refuse(
        where,
        (kind != "UNet2DConditionModel", f"{kind}, expected UNet2DConditionModel"),
        (unet.get("addition_embed_type") == "text_time" or width == 2048, "this is SDXL"),
        (
            not unet.get("use_linear_projection") or not isinstance(heads, list) or width == 768,
            f"this is Stable Diffusion 1.5 or a model like it (attention_head_dim {heads}, cross_attention_dim "
            f"{width})",
        ),
        (
            not isinstance(width, int) or out != 4,
            f"out_channels {out}, cross_attention_dim {width}; expected 4 and one number",
        ),
    )


def _refuse(where: Path, *rules: tuple[bool, str]) -> None:
    """Raises `BadInput` for the first rule that is met: this is another model."""
    for is_met, why in rules:
        if is_met:
            raise BadInput(f"{where}: {why}; {WRONG_MODEL}")


def _vae_name(stored: str) -> str:
    head, _, last = stored.rpartition(".")
    owner, _, layer = head.rpartition(".")
    return f"{owner}.{OLD_ATTENTION[layer]}.{last}" if layer in OLD_ATTENTION else stored


def _unread_control(
    control: str | None, unet: Config, vae: Config, switches: str
) -> tuple[UnreadModule | None, UnreadModule | None]:
    """The ControlNet of `control`, or the UNet to make one from; neither when neither is given. `unet` and `vae` are
    the configurations that it has to go with."""
    from diffusers import ControlNetModel, UNet2DConditionModel

    if not control:
        return None, None
    folder = find_folder(control, f"{switches}control-weights")
    for part in ("unet", "controlnet"):
        if not (folder / "config.json").is_file() and (folder / part / "config.json").is_file():
            folder = folder / part
    where = folder / "config.json"
    if not where.is_file():
        raise BadInput(f"{switches}control-weights {folder}: lacks config.json; {CONTROL_WANTED}")
    config = read_json(where)
    kind = config.get("_class_name")
    if kind == "UNet2DConditionModel":
        _check_sd2_unet(where, config)
        module = empty_module(folder, lambda: UNet2DConditionModel.from_config(config))
    elif kind == "ControlNetModel":
        module = empty_module(folder, lambda: ControlNetModel.from_config(config))
        colours, per_latent = (
            module.config["conditioning_channels"],
            _halvings("conditioning_embedding", module.config),
        )
        if (colours, per_latent) != (3, _halvings("block", vae)):
            raise BadInput(
                f"{where}: takes {colours} channels at {per_latent} px a latent pixel, expected 3 (the part map is "
                f"RGB) at {_halvings('block', vae)}; {CONTROL_WANTED}"
            )
    else:
        raise BadInput(f"{where}: {kind}; {CONTROL_WANTED}")
    if module.config["in_channels"] != 4:
        raise BadInput(
            f"{where}: in_channels is {module.config['in_channels']}, expected 4 (the noisy latents); "
            f"{CONTROL_WANTED}"
        )
    for name in ENCODER_SHAPE:
        theirs, ours = module.config[name], unet[name]
        if _listed(theirs) != _listed(ours):
            raise BadInput(f"{where}: {name} is {theirs}, but the inpainting UNet has {ours}; {CONTROL_WANTED}")
    unread = UnreadModule(module, folder, STEMS["unet"])
    return (None, unread) if kind == "UNet2DConditionModel" else (unread, None)


def _halvings(what: str, config: Config) -> int:
    """Pixels along a latent pixel."""
    return 2 ** (len(config[f"{what}_out_channels"]) - 1)


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _scheduler(folder: Path) -> Any:
    """DDIM with the noise schedule and the prediction type that the weights were trained with."""
    import inspect

    from diffusers import DDIMScheduler

    where = folder / "scheduler" / "scheduler_config.json"
    config = read_json(where)
    prediction = config.get("prediction_type", "epsilon")
    _refuse(
        where,
        ("beta_schedule" not in config, f"{config.get('_class_name')} without beta_schedule"),
        (
            prediction not in ("epsilon", "v_prediction"),
            f"prediction_type is {prediction}, expected epsilon or v_prediction",
        ),
    )
    known = inspect.signature(DDIMScheduler.__init__).parameters
    fields = {name: value for name, value in config.items() if name in known}
    # other schedulers do not name it, and DDIM's own default clips, which is wrong for latents
    fields.setdefault("clip_sample", False)
    with readable(f"{where}: not a usable configuration"):
        return DDIMScheduler(**fields)


def _tokenizer(folder: Path, text: Config) -> Any:
    """CLIP's tokenizer. `CLIPTokenizerFast` reads both layouts in transformers 4, and is `CLIPTokenizer` in 5."""
    from transformers import CLIPTokenizerFast  # type: ignore[attr-defined]  # made on the fly in 5

    where = folder / "tokenizer"
    with readable(f"{where}: not a readable CLIP tokenizer"):
        tokenizer: Any = CLIPTokenizerFast.from_pretrained(str(where), local_files_only=True)
    size = text.get("vocab_size")
    if not isinstance(size, int) or len(tokenizer) > size:
        raise BadInput(
            f"{where}: {len(tokenizer)} tokens, but the text encoder has {size} (vocab_size); take both from one "
            f"source"
        )
    return tokenizer
