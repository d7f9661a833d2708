"""V*: the learned word for one person (textual inversion, sec. 3.3)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ihbench.diffusion.backbone import Backbone
from ihbench.errors import BadInput

TOKEN_OPTION = "--method.inpaint.token"
PHOTO_OF = "a photo of"
ANYBODY = f"{PHOTO_OF} a person"


class SubjectToken(nn.Module):
    """One or more word vectors in the place of a new word. All other words stay as they are, bit for bit.

    Raises `BadInput` for a word that the tokenizer already has; `option` is what the user set.
    """

    def __init__(
        self, backbone: Backbone, word: str, count: int, initial_word: str = "person", option: str = TOKEN_OPTION
    ):
        super().__init__()
        tokenizer, encoder = backbone.tokenizer, backbone.text_encoder
        self.words = new_words(tokenizer, word, count, backbone.name, option)
        first = initial_ids(tokenizer, initial_word)[0]
        tokenizer.add_tokens(self.words, special_tokens=True)
        ids = tokenizer.convert_tokens_to_ids(self.words)
        encoder.resize_token_embeddings(len(tokenizer), mean_resizing=False)
        table = encoder.get_input_embeddings()
        table.weight.requires_grad_(False)
        start = table.weight[first].detach().float()
        self.vectors = nn.Parameter(start.repeat(count, 1))
        self.register_buffer("ids", torch.tensor(ids, device=start.device), persistent=False)
        self._hook = table.register_forward_hook(self._speak)

    ids: Tensor

    @property
    def prompt(self) -> str:
        return " ".join([PHOTO_OF, *self.words])

    def _speak(self, module: nn.Module, inputs: tuple[Any, ...], vectors: Tensor) -> Tensor:
        """Put the learned vectors where their ids stand in `inputs[0]` [B, L]."""
        ids = inputs[0]
        out = vectors
        for k in range(len(self.vectors)):
            here = (ids == self.ids[k])[..., None]
            out = torch.where(here, self.vectors[k].to(vectors.dtype), out)
        return out


def new_words(tokenizer: Any, word: str, count: int, backbone: str, option: str = TOKEN_OPTION) -> list[str]:
    """The words of V*, one a vector. Raises `BadInput` for a word that the tokenizer of `backbone` already has: one
    of its tokens, or what a prompt would speak of as one ("person", which CLIP lists as "person</w>")."""
    words = [f"{word}-{k}" if k else word for k in range(count)]
    vocabulary = tokenizer.get_vocab()
    for new in words:
        ids = tokenizer(new, add_special_tokens=False).input_ids
        if new in vocabulary or (len(ids) == 1 and ids[0] != tokenizer.unk_token_id):
            raise BadInput(
                f"{option} {word}: the vocabulary of {backbone} has {new!r} already; choose a word "
                f"that no prompt uses, such as <someone>"
            )
    return words


def initial_ids(tokenizer: Any, word: str) -> list[int]:
    """The ids of a word without start and end. Raises `BadInput` for a word that the vocabulary lacks."""
    ids = tokenizer(word, add_special_tokens=False).input_ids
    if not ids or ids[0] == tokenizer.unk_token_id != tokenizer.pad_token_id:
        raise BadInput(f"initial word {word!r}: not in the backbone's vocabulary")
    return list(ids)
