"""CLIP's text encoder on disk: the tensors of either naming, of a text encoder alone or of a whole CLIP."""

from __future__ import annotations

from pathlib import Path

from ihbench.diffusion.checkpoint import Config, UnreadModule, empty_module

TEXT_STEM = "model"
FIELDS = (
    "vocab_size", "hidden_size", "intermediate_size", "projection_dim", "num_hidden_layers", "num_attention_heads",
    "max_position_embeddings", "hidden_act", "layer_norm_eps", "attention_dropout", "pad_token_id", "bos_token_id",
    "eos_token_id",
)  # fmt: skip
EXTRAS = ("vision_model.", "visual_projection.", "text_projection.", "logit_scale")  # of a whole CLIP


def unread_text_encoder(folder: Path, config: Config) -> UnreadModule:
    """The encoder of a folder whose configuration was read. Raises `BadInput` for tensors that do not fit it."""
    from transformers import CLIPTextConfig, CLIPTextModel

    # only known fields: a configuration may also name code or files elsewhere
    fields = {name: value for name, value in config.items() if name in FIELDS}
    text = empty_module(folder, lambda: CLIPTextModel(CLIPTextConfig(**fields)))
    prefix = "text_model." if any(name.startswith("text_model.") for name in text.state_dict()) else ""

    def rename(stored: str) -> str | None:
        if stored.startswith(EXTRAS) or stored.endswith("position_ids"):
            return None
        return prefix + stored.removeprefix("text_model.")  # transformers 5 has dropped the prefix

    return UnreadModule(text, folder, TEXT_STEM, rename)
