"""Words in: the tiny size's tokenizer, and the frozen encoders that turn subgoals into training targets."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.processor import ProcessorStepRegistry, TokenizerProcessorStep
from torch import Tensor

from lerobot_memobench.errors import MemobenchError

_WORD = re.compile(r"\w+|[^\w\s]")
_SPECIAL = ("<pad>", "<unk>", "<bos>", "<eos>")


def words(text: str) -> list[str]:
    """Lower-case words and punctuation marks of a text."""
    return _WORD.findall(text.lower())


def make_vocabulary(texts: Iterable[str], size: int) -> list[str]:
    """Words for :class:`WordTokenizerProcessorStep`: special tokens, the prompt's frame, states 0-255, then ``texts``.

    The commonest words stay when there are more than ``size`` in all.
    """
    fixed = [*_SPECIAL, *"-:;,.", "task", "state", "action", *map(str, range(256))]
    counts = Counter(word for text in texts for word in words(text))
    for word in fixed:
        counts.pop(word, None)
    ranked = sorted(counts, key=lambda word: (-counts[word], word))
    return fixed + sorted(ranked[: max(0, size - len(fixed))])


def make_word_tokenizer(vocabulary: Sequence[str]) -> Any:
    """A word-level tokenizer from its list of words; unknown words become ``<unk>``. No file and no hub."""
    from tokenizers import Regex, Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.normalizers import Lowercase
    from tokenizers.pre_tokenizers import Split
    from tokenizers.processors import TemplateProcessing
    from transformers import PreTrainedTokenizerFast

    number = {word: row for row, word in enumerate(vocabulary)}
    tokenizer = Tokenizer(WordLevel(number, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Split(Regex(r"\w+|[^\w\s]"), behavior="removed", invert=True)
    tokenizer.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", number["<bos>"])])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>"
    )


@dataclass
@ProcessorStepRegistry.register(name="memobench_word_tokenizer")
class WordTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step with the word tokenizer; its words are saved in the checkpoint's processor file."""

    vocabulary: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.vocabulary:
            raise MemobenchError(
                "The checkpoint's preprocessor has no 'vocabulary' for its word tokenizer; save the policy again with "
                "its preprocessor."
            )
        self.tokenizer = make_word_tokenizer(self.vocabulary)
        super().__post_init__()

    def get_config(self) -> dict[str, Any]:
        return super().get_config() | {"vocabulary": self.vocabulary}


class WordTextEncoder:
    """Fixed embeddings of texts as sums of one random vector per word and per pair of neighbouring words.

    Equal texts get equal vectors, different ones (nearly always) cosines well below 0.99. Needs no weights.
    """

    def __init__(self, dim: int) -> None:
        self.dim = dim

    @property
    def key(self) -> str:
        return f"words-1-{self.dim}"

    def _vector(self, token: str) -> Tensor:
        seed = int.from_bytes(hashlib.blake2b(token.encode(), digest_size=7).digest(), "big")
        return torch.randn(self.dim, generator=torch.Generator().manual_seed(seed))

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """(N, dim) float32, normalised."""
        rows = []
        for text in texts:
            tokens = words(text)
            pairs = [f"{first} {second}" for first, second in itertools.pairwise(tokens)]
            rows.append(torch.stack([self._vector(token) for token in [*tokens, *pairs]]).sum(dim=0))
        return F.normalize(torch.stack(rows), dim=-1)


class SiglipTextEncoder:
    """SigLIP's text tower from a folder or the hub; (N, 1152) for So400m, as in the paper."""

    def __init__(self, name: str, dim: int, device: str = "cpu") -> None:
        self.name, self.dim, self.device = name, dim, device

    @property
    def key(self) -> str:
        return f"siglip-{self.name.rstrip('/').rsplit('/', 1)[-1]}-{self.dim}"

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Pooled text features (N, dim) float32.

        Raises:
            MemobenchError: the weights cannot be loaded, or have another width.
        """
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
        rows = []
        for first in range(0, len(texts), 64):
            part = list(texts[first : first + 64])
            # SigLIP was trained with every text padded to 64 tokens.
            inputs = tokenizer(part, padding="max_length", max_length=64, truncation=True, return_tensors="pt")
            rows.append(model(inputs["input_ids"].to(self.device)).pooler_output.float().cpu())
        return torch.cat(rows)


def make_text_encoder(name: str, dim: int, device: str = "cpu") -> WordTextEncoder | SiglipTextEncoder:
    """``words`` gives the built-in encoder, anything else is a SigLIP model's folder or repository."""
    return WordTextEncoder(dim) if name == "words" else SiglipTextEncoder(name, dim, device)
