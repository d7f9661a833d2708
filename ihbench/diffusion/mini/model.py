"""The small backbone's architecture: the classes of Stable Diffusion 2 inpainting at a hundredth of its size."""

from __future__ import annotations

from typing import Any

import torch

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.mini.block_transform import BlockTransform

SIZE = 128  # px, height of a crop
TEXT_WIDTH = 128
MAX_TOKENS = 40
CHANNELS = (64, 128, 128)  # at 32², 16², 8²
GUIDE_CHANNELS = 7  # the part map, and what other frames show of the surface: RGB and where
BLANK, START, END, UNKNOWN = "[blank]", "[start]", "[end]", "[unknown]"


def new_mini(words: tuple[str, ...], seed: int) -> Backbone:
    """An untrained backbone whose tokenizer knows `words`."""
    from diffusers import ControlNetModel, DDIMScheduler, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    tokenizer = word_tokenizer(words)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        codec = BlockTransform(block=4, luma=16, chroma=4)
        shape: dict[str, Any] = dict(
            block_out_channels=CHANNELS,
            layers_per_block=1,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
            cross_attention_dim=TEXT_WIDTH,
            attention_head_dim=tuple(c // 32 for c in CHANNELS),
            norm_num_groups=8,
            use_linear_projection=True,
        )
        unet = UNet2DConditionModel(
            in_channels=2 * codec.channels + 1,
            out_channels=codec.channels,
            up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
            **shape,
        )
        controlnet = ControlNetModel(
            in_channels=codec.channels,
            conditioning_channels=GUIDE_CHANNELS,
            conditioning_embedding_out_channels=(8, 16, 32),
            **shape,
        )
        text_encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=len(tokenizer),
                hidden_size=TEXT_WIDTH,
                intermediate_size=2 * TEXT_WIDTH,
                projection_dim=TEXT_WIDTH,
                num_hidden_layers=2,
                num_attention_heads=4,
                max_position_embeddings=MAX_TOKENS,
                pad_token_id=tokenizer.pad_token_id,
                bos_token_id=tokenizer.bos_token_id,
                eos_token_id=tokenizer.eos_token_id,
            )
        )
    scheduler = DDIMScheduler(
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        timestep_spacing="trailing",
        clip_sample=False,
        set_alpha_to_one=True,
    )
    return Backbone(
        "mini", unet, text_encoder, tokenizer, controlnet, codec, scheduler, SIZE, square=False, prefill=True
    )


def word_tokenizer(words: tuple[str, ...]) -> Any:
    """One token a word, in the file format that `AutoTokenizer` reads."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.normalizers import Lowercase
    from tokenizers.pre_tokenizers import Whitespace
    from tokenizers.processors import TemplateProcessing
    from transformers import PreTrainedTokenizerFast

    table = {word: k for k, word in enumerate([BLANK, START, END, UNKNOWN, *words])}
    tokenizer = Tokenizer(WordLevel(table, unk_token=UNKNOWN))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.post_processor = TemplateProcessing(
        single=f"{START} $A {END}", special_tokens=[(START, table[START]), (END, table[END])]
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token=BLANK,
        bos_token=START,
        eos_token=END,
        unk_token=UNKNOWN,
        model_max_length=MAX_TOKENS,
    )
