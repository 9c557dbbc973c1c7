"""Frozen text encoders of subgoals: hashed words, random labels, or SigLIP's text tower."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_memobench.errors import MemobenchError

_WORD = re.compile(r"\w+|[^\w\s]")


def words(text: str) -> list[str]:
    """Return the lower-case words and punctuation marks of a text."""
    return _WORD.findall(text.lower())


class WordTextEncoder:
    """Embed a text as the sum of a fixed random vector per word and per pair of neighbouring words.

    Different texts nearly always have cosines well below 0.99.
    """

    def __init__(self, dim: int) -> None:
        self.dim = dim

    @property
    def key(self) -> str:
        """Identity of the embeddings."""
        return f"words-1-{self.dim}"

    def _vector(self, token: str) -> Tensor:
        seed = int.from_bytes(hashlib.blake2b(token.encode(), digest_size=7).digest(), "big")
        return torch.randn(self.dim, generator=torch.Generator().manual_seed(seed))

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Return normalised embeddings (N, dim), float32."""
        rows = [torch.stack([self._vector(token) for token in self._tokens(text)]).sum(dim=0) for text in texts]
        return F.normalize(torch.stack(rows), dim=-1)

    def _tokens(self, text: str) -> list[str]:
        tokens = words(text)
        return [*tokens, *(f"{first} {second}" for first, second in itertools.pairwise(tokens))]


class LabelTextEncoder(WordTextEncoder):
    """Embed each text as one random vector, independent of its words: a control without language."""

    @property
    def key(self) -> str:
        """Identity of the embeddings."""
        return f"labels-1-{self.dim}"

    def _tokens(self, text: str) -> list[str]:
        return [text]


class SiglipTextEncoder:
    """SigLIP's text tower from a folder or the hub; width 1152 for So400m, as in the paper."""

    def __init__(self, name: str, dim: int, device: str = "cpu") -> None:
        self.name, self.dim, self.device = name, dim, device

    @property
    def key(self) -> str:
        """Identity of the embeddings: the model's name without its folder."""
        return f"siglip-{self.name.rstrip('/').rsplit('/', 1)[-1]}-{self.dim}"

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Return pooled text features (N, dim), float32.

        Raises:
            MemobenchError: the weights cannot be loaded, or have another width.
        """
        tokenizer, model = self._load()
        rows = []
        for part in itertools.batched(texts, 64):
            # SigLIP was trained with every text padded to 64 tokens.
            inputs = tokenizer(list(part), padding="max_length", max_length=64, truncation=True, return_tensors="pt")
            rows.append(model(inputs["input_ids"].to(self.device)).pooler_output.float().cpu())
        return torch.cat(rows)

    def _load(self) -> tuple[Any, Any]:
        """Return tokenizer and model."""
        from transformers import AutoTokenizer, SiglipTextModel

        try:
            tokenizer = AutoTokenizer.from_pretrained(self.name)
            model = SiglipTextModel.from_pretrained(self.name, dtype=torch.float32).to(self.device).eval()
        except (OSError, ValueError) as error:
            raise MemobenchError(
                f"The text encoder '{self.name}' could not be loaded ({type(error).__name__}): give a folder with a "
                "SigLIP model by --policy.text_encoder, or make the hub reachable."
            ) from error
        if model.config.hidden_size != self.dim:
            raise MemobenchError(
                f"The text encoder '{self.name}' gives {model.config.hidden_size} numbers per text and this size "
                f"needs {self.dim}; choose another with --policy.text_encoder."
            )
        return tokenizer, model


def make_text_encoder(name: str, dim: int, device: str = "cpu") -> WordTextEncoder | SiglipTextEncoder:
    """Build a text encoder: ``words``, ``labels``, or the folder or repository of a SigLIP model."""
    built_in = {"words": WordTextEncoder, "labels": LabelTextEncoder}
    return built_in[name](dim) if name in built_in else SiglipTextEncoder(name, dim, device)
