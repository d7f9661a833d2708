"""The folder of a `mini` backbone, looked at without reading a weight or importing diffusers."""

from __future__ import annotations

from pathlib import Path

from ihbench.diffusion.checkpoint import CONVERT, Config, has_pickles, read_json, weight_files
from ihbench.diffusion.text_encoder import TEXT_STEM
from ihbench.errors import BadInput
from ihbench.files.paths import user_path

SHIPPED = Path(__file__).parent / "shipped"
STEM = "diffusion_pytorch_model"
STEMS = {"unet": STEM, "controlnet": STEM, "codec": STEM, "text_encoder": TEXT_STEM}
PARTS = (*STEMS, "tokenizer", "scheduler")
CLASSES = {"unet": "UNet2DConditionModel", "controlnet": "ControlNetModel", "codec": "BlockTransform"}
HOW = "`ihbench train-mini --out DIR` makes one"


def check_mini(folder: Path) -> tuple[Path, dict[str, Config]]:
    """The folder and its parts' configurations. Raises `BadInput` for one that lacks a part, has pickles for weights,
    or holds another model, such as Stable Diffusion."""
    folder = user_path(folder)
    missing = [name for name in PARTS if not (folder / name).is_dir()]
    if missing:
        raise BadInput(f"{folder}: not a mini backbone, lacks {', '.join(missing)}; {HOW}")
    configs = {}
    for part, stem in STEMS.items():
        configs[part] = read_json(folder / part / "config.json")
        if not weight_files(folder / part, stem):
            why = f"only pickles, which are refused; {CONVERT}" if has_pickles(folder / part) else "no such file"
            raise BadInput(f"{folder / part}: expected {stem}.safetensors, found {why}")
    for part, expected in CLASSES.items():
        if configs[part].get("_class_name") != expected:
            kind = configs[part].get("_class_name")
            raise BadInput(f"{folder / part}: {kind}, expected {expected}: not a mini backbone; {HOW}")
    _check_channels(folder, configs)
    return folder, configs


def _check_channels(folder: Path, configs: dict[str, Config]) -> None:
    """Whether the parts fit each other."""
    codec, unet, control = configs["codec"], configs["unet"], configs["controlnet"]
    try:
        channels = int(codec["luma"]) + 2 * int(codec["chroma"])
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{folder / 'codec' / 'config.json'}: expected the numbers luma and chroma; {HOW}") from error
    width = configs["text_encoder"].get("hidden_size")
    wanted = (
        ("unet", "in_channels", unet.get("in_channels"), 2 * channels + 1),  # latents, mask, masked latents
        ("unet", "out_channels", unet.get("out_channels"), channels),
        ("unet", "cross_attention_dim", unet.get("cross_attention_dim"), width),
        ("controlnet", "in_channels", control.get("in_channels"), channels),
        ("controlnet", "cross_attention_dim", control.get("cross_attention_dim"), width),
    )
    for part, field, found, expected in wanted:
        if found != expected:
            raise BadInput(
                f"{folder / part / 'config.json'}: {field} is {found}, expected {expected} to go with the codec's "
                f"{channels} channels and the text's width {width}; take all parts from one training"
            )
