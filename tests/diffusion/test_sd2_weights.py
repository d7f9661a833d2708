"""Stable Diffusion 2 inpainting weights: a miniature with its layers and files is loaded; bad folders are refused."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import (
    AutoencoderKL,
    ControlNetModel,
    DDIMScheduler,
    StableDiffusionInpaintPipeline,
    UNet2DConditionModel,
)
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import AutoTokenizer, CLIPTextModel

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.diffusion_batch import DiffusionBatch
from ihbench.diffusion.sampling import sample
from ihbench.diffusion.sd2_weights import load_sd2
from ihbench.diffusion.subject_token import SubjectToken
from ihbench.errors import BadInput
from tests.diffusion.sd2_miniature import make_miniature, write_json

UNET_FILE = "unet/diffusion_pytorch_model.safetensors"
VAE_FILE = "vae/diffusion_pytorch_model.safetensors"
TEXT_FILE = "text_encoder/model.safetensors"


@pytest.fixture(scope="module")
def miniature(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_miniature(tmp_path_factory.mktemp("sd2") / "whole")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The four-channel base model."""
    return make_miniature(tmp_path_factory.mktemp("sd2") / "base", seed=5, in_channels=4)


@pytest.fixture(scope="module")
def loaded(miniature: Path) -> Backbone:
    """To be looked at, not to be changed."""
    return load(miniature)


@pytest.fixture
def copy(miniature: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(miniature, tmp_path / "copy"))


def load(folder: Path | str, *args: Any, **options: Any) -> Backbone:
    return load_sd2(str(folder), *args, device="cpu", **options)


def refusal(folder: Path | str, *args: Any, **options: Any) -> str:
    with pytest.raises(BadInput) as caught:
        load(folder, *args, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def set_config(path: Path, **changes: Any) -> None:
    config = json.loads(path.read_text(encoding="utf-8"))
    write_json(path, {k: v for k, v in {**config, **changes}.items() if v != "drop"})


def change_weights(file: Path, change: Callable[[dict[str, Tensor]], Any]) -> None:
    weights = load_file(file)
    change(weights)
    save_file(weights, file, {"format": "pt"})


def given(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two images in [-1, 1], their hidden pixels (whole blocks of 8), their part maps in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(2, 3, 64, 64, generator=generator) * 2 - 1
    hidden = torch.zeros(2, 1, 64, 64)
    hidden[:, :, 16:40, 8:32] = 1
    return images, hidden, torch.rand(2, 3, 64, 64, generator=generator)


def predicted(backbone: Backbone, use_parts: bool = False) -> Tensor:
    images, hidden, parts = given()
    noisy = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        text = backbone.text(["a photo of a person", "dots"])
        condition = backbone.condition(images, hidden)
        return backbone.predict(noisy, torch.tensor([20, 700]), condition, text, parts if use_parts else None)


def same_weights(ours: torch.nn.Module, theirs: torch.nn.Module) -> bool:
    a, b = ours.state_dict(), theirs.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def copy_of(controlnet: Any) -> Any:
    made: Any = ControlNetModel.from_config(controlnet.config)
    made.load_state_dict(controlnet.state_dict())
    return made


# --- what a good folder gives ---


def test_every_part_is_what_the_libraries_own_loaders_read(miniature: Path, loaded: Backbone) -> None:
    """With old names of the VAE's attention and the text encoder's prefix: files are as diffusers 0.8 wrote them."""
    assert "decoder.mid_block.attentions.0.proj_attn.weight" in load_file(miniature / VAE_FILE)
    backbone = loaded
    assert same_weights(backbone.unet, UNet2DConditionModel.from_pretrained(miniature / "unet"))
    assert same_weights(backbone.codec.vae, AutoencoderKL.from_pretrained(miniature / "vae"))
    assert same_weights(backbone.text_encoder, CLIPTextModel.from_pretrained(miniature / "text_encoder"))
    prompt = ["A photo of a person, dotted"]
    theirs = AutoTokenizer.from_pretrained(miniature / "tokenizer")(prompt, padding="max_length", return_tensors="pt")
    ids = backbone.token_ids(prompt)
    assert ids.tolist() == theirs.input_ids.tolist()
    assert ids.shape == (1, 77)
    assert ids[0, -1] == 0  # "!", SD2's padding
    pieces = backbone.tokenizer.convert_ids_to_tokens(ids[0, :6].tolist())
    assert pieces == ["<|startoftext|>", "a</w>", "photo</w>", "of</w>", "a</w>", "person</w>"]


def test_the_backbone_is_frozen_and_says_its_size(loaded: Backbone) -> None:
    backbone = loaded
    parts = (backbone.unet, backbone.controlnet, backbone.text_encoder, backbone.codec.vae)
    assert not any(part.training or any(p.requires_grad for p in part.parameters()) for part in parts)
    assert not any(t.is_meta for part in parts for t in [*part.parameters(), *part.buffers()])
    assert (backbone.name, backbone.size, backbone.square, backbone.dtype) == ("sd2", 64, True, torch.float32)
    images, hidden, _ = given()
    latents = backbone.codec.encode(images)
    assert latents.shape == (2, 4, 8, 8)
    assert backbone.codec.decode(latents).shape == images.shape
    assert backbone.condition(images, hidden).shape == (2, 5, 8, 8)
    assert predicted(backbone, use_parts=True).shape == (2, 4, 8, 8)


def test_two_loads_are_the_same_and_touch_no_random_state(miniature: Path, loaded: Backbone) -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state()
    again = load(miniature)
    assert torch.equal(torch.get_rng_state(), before)
    assert same_weights(loaded.controlnet, again.controlnet)
    assert torch.equal(predicted(loaded, use_parts=True), predicted(again, use_parts=True))


def test_sampling_gives_what_the_inpainting_pipeline_of_diffusers_gives(
    miniature: Path, loaded: Backbone, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Channel order, mask, schedule, scaling: the same image, from the same noise."""
    monkeypatch.setattr(DiagonalGaussianDistribution, "sample", lambda self, generator=None: self.mode())
    images, hidden, _ = given()
    noise = torch.randn(4, 8, 8, generator=torch.Generator().manual_seed(2))
    pipeline: Any = StableDiffusionInpaintPipeline.from_pretrained(
        miniature, safety_checker=None, feature_extractor=None, image_encoder=None
    )
    pipeline.scheduler = DDIMScheduler.from_config(pipeline.scheduler.config)
    pipeline.set_progress_bar_config(disable=True)
    theirs = pipeline(
        prompt=["a photo of a person"] * 2, negative_prompt=["dots"] * 2, image=images / 2 + 0.5, mask_image=hidden,
        height=64, width=64, latents=noise.expand(2, -1, -1, -1).clone(), num_inference_steps=3, guidance_scale=4.0,
        output_type="pt",
    ).images  # fmt: skip
    nothing = torch.zeros_like(images)
    seen = torch.zeros_like(hidden).expand(-1, 4, -1, -1)
    batch = DiffusionBatch(pixels=images, unknown=hidden, person=torch.zeros_like(hidden), parts=nothing, seen=seen)
    ours = sample(
        loaded, batch, noise, "a photo of a person", steps=3, use_parts=False, guidance=4.0, negative="dots"
    )
    assert (ours / 2 + 0.5 - theirs).abs().max() < 1e-4
    assert ours.std() > 0.02


def test_scheduler_keeps_schedule_and_prediction_type(miniature: Path, loaded: Backbone, tmp_path: Path) -> None:
    theirs: Any = DDIMScheduler.from_pretrained(miniature / "scheduler")
    ours = loaded.scheduler
    assert torch.equal(ours.alphas_cumprod, theirs.alphas_cumprod)
    assert ours.final_alpha_cumprod == theirs.final_alpha_cumprod < 1
    assert (ours.config.prediction_type, ours.config.steps_offset, ours.config.clip_sample) == ("epsilon", 1, False)
    folder = make_miniature(tmp_path / "v", prediction_type="v_prediction")
    set_config(folder / "scheduler" / "scheduler_config.json", clip_sample="drop")
    backbone = load(folder)
    assert not backbone.scheduler.config.clip_sample  # DDIM's own default would clip latents
    latents, noise, t = torch.randn(1, 4, 8, 8), torch.randn(1, 4, 8, 8), torch.tensor([400])
    alpha = backbone.scheduler.alphas_cumprod[400]
    assert torch.allclose(backbone.target(latents, noise, t), alpha.sqrt() * noise - (1 - alpha).sqrt() * latents)


def test_training_lowers_the_loss(miniature: Path) -> None:
    backbone = load(miniature)
    images, hidden, parts = given()
    backbone.unet.requires_grad_(True)
    backbone.controlnet.requires_grad_(True)
    trained = [*backbone.unet.parameters(), *backbone.controlnet.parameters()]
    optimizer = torch.optim.AdamW(trained, lr=1e-3)
    with torch.no_grad():
        latents, condition = backbone.codec.encode(images), backbone.condition(images, hidden)
        text = backbone.text(["a photo of a person"]).expand(2, -1, -1)
    noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(0))
    timesteps = torch.tensor([100, 600])
    noisy = backbone.scheduler.add_noise(latents, noise, timesteps)
    losses = []
    for _ in range(10):
        optimizer.zero_grad()
        said = backbone.predict(noisy, timesteps, condition, text, parts)
        loss = (said - backbone.target(latents, noise, timesteps)).square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, 1e9, error_if_nonfinite=True)
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]
    assert backbone.controlnet.controlnet_mid_block.weight.any()  # the part map is heard from now on


def test_a_new_word_joins_the_clip_vocabulary(miniature: Path) -> None:
    backbone = load(miniature)
    before = backbone.text(["a photo of a person"])
    token = SubjectToken(backbone, "<someone>", 2)
    assert backbone.tokenizer.convert_ids_to_tokens(backbone.token_ids([token.prompt])[0, 4:7].tolist()) == [
        "<someone>", "<someone>-1", "<|endoftext|>",
    ]  # fmt: skip
    assert torch.equal(backbone.text(["a photo of a person"]), before)
    backbone.text([token.prompt]).sum().backward()
    assert token.vectors.grad is not None
    assert token.vectors.grad.abs().sum() > 0
    for word in ("person</w>", "person", "Photo"):  # as CLIP lists it, and as a prompt has it
        with pytest.raises(BadInput, match=f"has '{word}' already"):
            SubjectToken(load(miniature), word, 1)


# --- types, files, places ---


def test_half_types_keep_the_vae_in_single(miniature: Path) -> None:
    backbone = load(miniature, dtype="bf16")
    assert backbone.dtype == backbone.text_encoder.dtype == backbone.controlnet.dtype == torch.bfloat16
    assert backbone.codec.vae.dtype == torch.float32  # force_upcast, the default
    images, hidden, parts = given()
    backbone.unet.requires_grad_(True)
    latents = backbone.codec.encode(images)
    timesteps, text = torch.tensor([20, 700]), backbone.text(["a photo", "dots"])
    said = backbone.predict(latents, timesteps, backbone.condition(images, hidden), text, parts)
    said.float().square().mean().backward()
    assert said.dtype == torch.bfloat16
    assert backbone.unet.conv_in.weight.grad.isfinite().all()
    assert "expected auto, fp32, fp16, bf16" in refusal(miniature, dtype="int8")


def test_a_vae_without_force_upcast_is_halved_too(copy: Path) -> None:
    set_config(copy / "vae" / "config.json", force_upcast=False)
    assert load(copy, dtype="bf16").codec.vae.dtype == torch.bfloat16


def test_memory_lean_computes_the_same(miniature: Path, loaded: Backbone) -> None:
    lean = load(miniature, memory_lean=True)
    assert torch.allclose(predicted(loaded, use_parts=True), predicted(lean, use_parts=True), atol=1e-6)
    assert lean.unet.is_gradient_checkpointing
    assert lean.controlnet.is_gradient_checkpointing


@pytest.mark.parametrize("variant", ["fp16", "bf16"])
def test_file_names_with_a_variant(copy: Path, loaded: Backbone, variant: str) -> None:
    half = {"fp16": torch.float16, "bf16": torch.bfloat16}[variant]
    for name in (UNET_FILE, VAE_FILE, TEXT_FILE):
        file = copy / name
        save_file(
            {k: v.to(half) if v.is_floating_point() else v for k, v in load_file(file).items()},
            file.with_suffix(f".{variant}.safetensors"),
        )
        file.unlink()
    backbone = load(copy)
    assert backbone.dtype == torch.float32
    assert torch.equal(backbone.unet.conv_in.weight, loaded.unet.conv_in.weight.to(half).float())


@pytest.mark.parametrize("variant", [None, "fp16"])
def test_shards(copy: Path, loaded: Backbone, variant: str | None) -> None:
    whole = loaded.unet
    (copy / UNET_FILE).unlink()
    whole.save_pretrained(copy / "unet", max_shard_size="1MB", variant=variant)
    assert len(list((copy / "unet").glob("*.safetensors"))) > 2
    assert same_weights(load(copy).unet, whole)
    shards = sorted((copy / "unet").glob("*.safetensors"))
    shards[0].rename(copy / "elsewhere.safetensors")
    assert f"lists {shards[0].name}, which" in refusal(copy)
    index = next((copy / "unet").glob("*.index*.json"))
    table = json.loads(index.read_text())["weight_map"]
    moved = {name: "../elsewhere.safetensors" if file == shards[0].name else file for name, file in table.items()}
    set_config(index, weight_map=moved)
    assert "expected names of safetensors beside it, found '../elsewhere.safetensors'" in refusal(copy)


def test_hub_ids_are_looked_up_in_the_cache_alone(
    miniature: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_network(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("asked the network")

    monkeypatch.setattr(socket, "socket", no_network)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    message = refusal("somebody/sd2-inpainting")
    assert str(tmp_path) in message
    assert "downloads nothing" in message
    cached = tmp_path / "models--somebody--sd2-inpainting"
    (cached / "refs").mkdir(parents=True)
    (cached / "refs" / "main").write_text("c0ffee")
    (cached / "snapshots").mkdir()
    (cached / "snapshots" / "c0ffee").symlink_to(miniature)
    assert load("somebody/sd2-inpainting").size == 64
    assert "no such folder" in refusal(tmp_path / "nowhere")
    assert "no such folder" in refusal("nowhere")


# --- the ControlNet ---


def test_a_fresh_controlnet_changes_nothing(miniature: Path, base: Path, loaded: Backbone) -> None:
    assert torch.equal(predicted(loaded), predicted(loaded, use_parts=True))
    backbone = load(miniature, control=str(base))
    assert torch.equal(predicted(backbone), predicted(backbone, use_parts=True))
    with torch.no_grad():
        backbone.controlnet.controlnet_mid_block.weight.fill_(0.1)
    assert not torch.equal(predicted(backbone), predicted(backbone, use_parts=True))


def test_a_controlnet_of_the_inpainting_unet_copies_all_but_five_channels(loaded: Backbone) -> None:
    unet, controlnet = loaded.unet, loaded.controlnet
    assert controlnet.config.in_channels == 4
    assert torch.equal(controlnet.conv_in.weight, unet.conv_in.weight[:, :4])
    assert torch.equal(controlnet.conv_in.bias, unet.conv_in.bias)
    for part in ("time_embedding", "down_blocks", "mid_block"):
        assert same_weights(getattr(controlnet, part), getattr(unet, part))
    theirs = {p.data_ptr() for p in unet.parameters()}  # training one leaves the other
    assert not any(p.data_ptr() in theirs for p in controlnet.parameters())


@pytest.mark.parametrize("part", ["", "unet"])
def test_a_controlnet_of_the_base_unet_is_from_unet(miniature: Path, base: Path, part: str) -> None:
    """The base may be given as the whole model or its UNet alone."""
    ours = load(miniature, control=str(base / part)).controlnet.state_dict()
    theirs = ControlNetModel.from_unet(UNet2DConditionModel.from_pretrained(base / "unet")).state_dict()
    assert ours.keys() == theirs.keys()
    drawn = [name for name in ours if not torch.equal(ours[name], theirs[name])]
    assert drawn
    assert all(name.startswith("controlnet_cond_embedding.") for name in drawn)


def test_a_controlnet_of_ones_own(miniature: Path, loaded: Backbone, tmp_path: Path) -> None:
    made = copy_of(loaded.controlnet)
    with torch.no_grad():
        made.controlnet_mid_block.weight.normal_()
    made.save_pretrained(tmp_path / "control")
    backbone = load(miniature, control=str(tmp_path / "control"))
    assert same_weights(backbone.controlnet, made)
    assert not torch.equal(predicted(backbone), predicted(backbone, use_parts=True))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"in_channels": 9}, "in_channels is 9, expected 4"),
        ({"conditioning_channels": 1}, "takes 1 channels at 8 px"),
        ({"conditioning_embedding_out_channels": [16, 32, 96]}, "takes 3 channels at 4 px"),
        ({"block_out_channels": [16, 32, 32, 64]}, "block_out_channels is"),
        ({"cross_attention_dim": 64}, "cross_attention_dim is 64, but the inpainting UNet has 32"),
        ({"layers_per_block": 1}, "layers_per_block is 1"),
        ({"_class_name": "T2IAdapter"}, "T2IAdapter; expected a ControlNet"),
    ],
)
def test_a_controlnet_of_another_model(
    miniature: Path, loaded: Backbone, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    loaded.controlnet.save_config(tmp_path)
    set_config(tmp_path / "config.json", **changes)
    assert said in refusal(miniature, control=str(tmp_path))


def test_a_base_that_is_none(miniature: Path, tmp_path: Path) -> None:
    assert "in_channels is 9, expected 4" in refusal(miniature, control=str(miniature))
    assert "lacks config.json" in refusal(miniature, control=str(tmp_path))
    shutil.copy(miniature / "unet" / "config.json", tmp_path)
    set_config(tmp_path / "config.json", in_channels=4, block_out_channels=[16, 32, 32, 64])
    assert "block_out_channels is" in refusal(miniature, control=str(tmp_path))


# --- other models: seen from config.json, before a weight is read ---


@pytest.mark.parametrize(
    ("part", "changes", "said"),
    [
        ("unet", {"in_channels": 4}, "this is the base model, not the inpainting one"),
        ("unet", {"in_channels": 5}, "in_channels is 5, expected 9"),
        ("unet", {"out_channels": 8}, "out_channels 8"),
        ("unet", {"attention_head_dim": 8, "use_linear_projection": "drop"}, "this is Stable Diffusion 1.5"),
        ("unet", {"cross_attention_dim": 768}, "this is Stable Diffusion 1.5"),
        ("unet", {"addition_embed_type": "text_time"}, "this is SDXL"),
        ("unet", {"_class_name": "UNetSpatioTemporalConditionModel"}, "expected UNet2DConditionModel"),
        ("unet", {"cross_attention_dim": 64}, "hidden_size is 32, but the UNet reads text of width 64"),
        ("unet", {"down_block_types": ["NoSuchBlock"] * 4}, "not a usable configuration"),
        ("vae", {"latent_channels": 16}, "AutoencoderKL with 16 latent channels"),
        ("vae", {"_class_name": "VQModel"}, "VQModel with 4 latent channels"),
        ("text_encoder", {"model_type": "t5"}, "model_type is t5"),
        ("text_encoder", {"hidden_size": 64}, "hidden_size is 64"),
        ("text_encoder", {"vocab_size": 100}, "524 tokens, but the text encoder has 100"),
    ],
)
def test_another_model(copy: Path, part: str, changes: dict[str, Any], said: str) -> None:
    for name in (UNET_FILE, VAE_FILE, TEXT_FILE):
        (copy / name).write_bytes(b"")
    set_config(copy / part / "config.json", **changes)
    assert said in refusal(copy)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"beta_schedule": "drop", "_class_name": "FlowMatchEulerDiscreteScheduler"}, "without beta_schedule"),
        ({"prediction_type": "sample"}, "prediction_type is sample"),
        ({"beta_schedule": "made_up"}, "not a usable configuration"),
    ],
)
def test_another_scheduler(copy: Path, changes: dict[str, Any], said: str) -> None:
    set_config(copy / "scheduler" / "scheduler_config.json", **changes)
    assert said in refusal(copy)


def test_other_layouts(copy: Path) -> None:
    assert "one part of a model; give the folder above it" in refusal(copy / "unet")
    assert "a single file; expected a folder in diffusers layout" in refusal(copy / UNET_FILE)
    (copy / "transformer").mkdir()
    assert "transformer/" in refusal(copy)
    (copy / "text_encoder_2").mkdir()
    assert "this is SDXL" in refusal(copy)


# --- spoilt folders ---


def test_all_that_is_missing_in_one_line(copy: Path) -> None:
    shutil.rmtree(copy / "text_encoder")
    assert "lacks text_encoder/; expected Stable Diffusion 2 inpainting in diffusers layout" in refusal(copy)
    (copy / UNET_FILE).unlink()
    (copy / "tokenizer" / "merges.txt").unlink()
    (copy / "scheduler" / "scheduler_config.json").unlink()
    (copy / "vae" / "config.json").unlink()
    message = refusal(copy)
    for name in (UNET_FILE, "vae/config.json", "tokenizer/merges.txt", "scheduler/scheduler_config.json"):
        assert name in message


def test_pickles_are_refused(copy: Path) -> None:
    (copy / VAE_FILE).rename(copy / "vae" / "diffusion_pytorch_model.bin")
    message = refusal(copy)
    assert "has pickles" in message
    assert VAE_FILE in message
    assert "safe_serialization=True" in message


def test_a_file_cut_short(copy: Path) -> None:
    file = copy / VAE_FILE
    file.write_bytes(file.read_bytes()[:-1000])
    assert f"{file}: not a whole safetensors file" in refusal(copy)
    file.write_bytes(b"")
    assert f"{file}: not a whole safetensors file" in refusal(copy)
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 334643276\n")
    assert "git lfs pull" in refusal(copy)


def test_tensors_that_do_not_fit(copy: Path) -> None:
    name = "mid_block.resnets.0.conv1.weight"
    change_weights(copy / UNET_FILE, lambda weights: weights.update({name: torch.zeros(32, 32, 1, 1)}))
    assert f"1 have another shape ({name} is [32, 32, 1, 1], not [32, 32, 3, 3])" in refusal(copy)
    change_weights(copy / UNET_FILE, lambda weights: weights.__delitem__(name))
    assert f"tensors are missing ({name})" in refusal(copy)
    change_weights(
        copy / UNET_FILE, lambda w: w.update({name: torch.zeros(32, 32, 3, 3), "more.weight": torch.ones(1)})
    )
    assert "1 are not of this model (more.weight)" in refusal(copy)


def test_a_whole_clip_for_the_text_encoder_is_fine(copy: Path) -> None:
    extras = {"logit_scale": torch.ones(1), "vision_model.layer.weight": torch.ones(2)}
    change_weights(copy / TEXT_FILE, lambda weights: weights.update(extras))
    load(copy)


def test_numbers_that_are_none(copy: Path) -> None:
    name, file = "conv_out.bias", copy / UNET_FILE
    change_weights(file, lambda weights: weights[name].fill_(1e6))
    load(copy)
    assert "too large for torch.float16" in refusal(copy, dtype="fp16")
    change_weights(file, lambda weights: weights[name][0].fill_(float("nan")))
    assert f"{file}: {name} has NaN or infinite values" in refusal(copy)
    change_weights(file, lambda weights: weights.update({name: torch.zeros(4, dtype=torch.int8)}))
    assert "stored as torch.int8" in refusal(copy)


def test_texts_that_do_not_parse(copy: Path) -> None:
    (copy / "tokenizer" / "vocab.json").write_text("{")
    assert "not a readable CLIP tokenizer" in refusal(copy)
    (copy / "vae" / "config.json").write_text("[]")
    assert "expected a JSON object, found list" in refusal(copy)
    (copy / "vae" / "config.json").write_bytes(b"\xff\xfe{")
    assert "not readable as JSON" in refusal(copy)


def test_too_little_memory(miniature: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **options: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    monkeypatch.setattr(torch.nn.Module, "load_state_dict", full)
    assert "too little free memory" in refusal(miniature)
