"""Tokenizers of text prompts (pretrained, or of words from the dataset's tasks), and frozen text encoders of subgoals.

A tokenizer warns of what it loses: words that it does not know, and what its length cuts off.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from lerobot.processor import ProcessorStepRegistry, TokenizerProcessorStep
from tokenizers import Regex, Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Split
from tokenizers.processors import TemplateProcessing
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.sampler import TrainingRun
from lerobot_memobench.tasks.memory_text import MARK

logger = logging.getLogger(__name__)

_WORD = re.compile(r"\w+|[^\w\s]")
_SPECIAL = ("<pad>", "<unk>", "<bos>", "<eos>")


def words(text: str) -> list[str]:
    """Lower-case words and punctuation marks of a text."""
    return _WORD.findall(text.lower())


def make_vocabulary(texts: Iterable[str], size: int) -> list[str]:
    """Words for :class:`WordTokenizerProcessorStep`: special tokens, the prompt's frame, states 0-255, then ``texts``.

    The commonest words stay when there are more than ``size`` in all.
    """
    return extend([*_SPECIAL, *"-:;,.", "task", "state", "action", *map(str, range(256))], texts, size)


def extend(vocabulary: Sequence[str], texts: Iterable[str], size: int) -> list[str]:
    """Return a vocabulary and behind it, sorted, the words of ``texts`` that it lacks: the commonest up to ``size``."""
    counts = Counter(word for text in texts for word in words(text))
    for word in vocabulary:
        counts.pop(word, None)
    ranked = sorted(counts, key=lambda word: (-counts[word], word))
    return [*vocabulary, *sorted(ranked[: max(0, size - len(vocabulary))])]


def make_word_tokenizer(vocabulary: Sequence[str]) -> Any:
    """A word-level tokenizer from its list of words; unknown words become ``<unk>``. No file and no hub."""
    from transformers import PreTrainedTokenizerFast  # slow to import, and the other size needs none of it

    number = {word: row for row, word in enumerate(vocabulary)}
    tokenizer = Tokenizer(WordLevel(number, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Split(Regex(r"\w+|[^\w\s]"), behavior="removed", invert=True)
    tokenizer.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", number["<bos>"])])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>"
    )


_told: set[str] = set()
"""Texts, instructions and words about which this process has been warned."""


def warn_of_losses(tokenizer: Any, text: str, max_length: int, full: bool) -> None:
    """Warn of what a policy does not read of a prompt: unknown words, each once per process; and what is cut off, once
    per instruction: numbers of the state and memory texts differ from step to step.

    Args:
        full: the prompt takes all of ``max_length`` tokens, and may have had more.
    """
    prompt = text.partition(", State: ")[0]
    instruction = prompt.partition(MARK)[0].removeprefix("Task: ")
    if f"read {prompt}" in _told and (not full or f"cut {instruction}" in _told):
        return
    coded = tokenizer(text, return_offsets_mapping=True)
    spans = list(zip(coded["input_ids"], coded["offset_mapping"], strict=True))
    unknown = dict.fromkeys(text[a:b].lower() for token, (a, b) in spans if token == tokenizer.unk_token_id)
    new = [repr(word) for word in unknown if f"word {word}" not in _told]
    if new:
        logger.warning(
            "the policy does not know %s in %r, and reads unknown words all alike; it can act on these only after "
            "training on instructions that hold them",
            ", ".join(new),
            instruction,
        )
    if len(spans) > max_length and f"cut {instruction}" not in _told:
        logger.warning(
            "the prompt of %r has %d tokens and the policy reads %d (policy.tokenizer_max_length when it is trained); "
            "cut off: %r",
            instruction,
            len(spans),
            max_length,
            text[spans[max_length][1][0] :],
        )
        _told.add(f"cut {instruction}")
    _told.update(f"word {word}" for word in unknown)
    _told.add(f"read {prompt}")


@dataclass
@ProcessorStepRegistry.register(name="memobench_tokenizer")
class PromptTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step, which warns of what it loses of a prompt."""

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        found: dict[str, Tensor] = super()._tokenize_text(text)
        # A full row may have been cut off. Both are looked at in numbers first: this runs at every step.
        tokenizer, full = self.input_tokenizer, found["attention_mask"].bool().all(dim=-1)
        unknown = (found["input_ids"] == (-1 if tokenizer.unk_token_id is None else tokenizer.unk_token_id)).any(dim=-1)
        for row in (unknown | full).nonzero().flatten().tolist():
            warn_of_losses(tokenizer, text if isinstance(text, str) else text[row], self.max_length, bool(full[row]))
        return found


@dataclass
@ProcessorStepRegistry.register(name="memobench_word_tokenizer")
class WordTokenizerProcessorStep(PromptTokenizerProcessorStep):
    """LeRobot's tokenizer step with the word tokenizer; its words are saved in the checkpoint's processor file.

    A step that is told to ``follow`` a training takes the length of its prompts, and learns the words of its dataset
    that it does not have, behind its own, which keep their numbers.
    """

    vocabulary: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.vocabulary:
            raise MemobenchError(
                "The checkpoint's preprocessor has no 'vocabulary' for its word tokenizer; save the policy again with "
                "its preprocessor."
            )
        self.tokenizer = make_word_tokenizer(self.vocabulary)
        super().__post_init__()

    def follow(self, run: TrainingRun) -> None:
        """Learn the words of a run's prompts, and take their length."""
        assert run.config.tokenizer_max_length is not None  # set by the configuration
        self.max_length = run.config.tokenizer_max_length
        self.vocabulary = extend(self.vocabulary, run.prompt_texts(), run.config.dimensions.vocabulary)
        self.__post_init__()

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        """Do as LeRobot does, with each of the texts once: the samples of a batch share a few instructions."""
        texts = [text] if isinstance(text, str) else text
        row = {different: number for number, different in enumerate(dict.fromkeys(texts))}
        rows = torch.tensor([row[text] for text in texts])
        return {name: of_different[rows] for name, of_different in super()._tokenize_text([*row]).items()}

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds, the words included."""
        return super().get_config() | {"vocabulary": self.vocabulary}


# -- frozen text encoders of subgoals ---------------------------------------------------------------------------------


class WordTextEncoder:
    """Fixed embeddings of texts as sums of one random vector per word and per pair of neighbouring words.

    Equal texts get equal vectors, different ones (nearly always) cosines well below 0.99. Needs no weights.
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
        """Identity of the embeddings: the model's name, wherever it lies."""
        return f"siglip-{self.name.rstrip('/').rsplit('/', 1)[-1]}-{self.dim}"

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Pooled text features (N, dim) float32.

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
        """Tokenizer and model."""
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
    """``words`` gives the built-in encoder, anything else is a SigLIP model's folder or repository."""
    return WordTextEncoder(dim) if name == "words" else SiglipTextEncoder(name, dim, device)
