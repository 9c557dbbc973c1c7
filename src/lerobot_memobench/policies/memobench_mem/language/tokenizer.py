"""The tokenizer of sizes without a pretrained one: words, from a list built out of the dataset's tasks."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry, TokenizerProcessorStep
from tokenizers import Regex, Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Split
from tokenizers.processors import TemplateProcessing
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.processing.training_run import training_run

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


@dataclass
@ProcessorStepRegistry.register(name="memobench_word_tokenizer")
class WordTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step with the word tokenizer; its words are saved in the checkpoint's processor file.

    A step that is rebuilt from a checkpoint for training takes the length of that run's prompts, and learns the words
    of its dataset that it does not have, behind its own, which keep their numbers.
    """

    vocabulary: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.vocabulary:
            raise MemobenchError(
                "The checkpoint's preprocessor has no 'vocabulary' for its word tokenizer; save the policy again with "
                "its preprocessor."
            )
        run = training_run()
        if run is not None:
            assert run.config.tokenizer_max_length is not None  # set by the configuration
            self.max_length = run.config.tokenizer_max_length
            self.vocabulary = extend(self.vocabulary, run.prompt_texts(), run.config.dimensions.vocabulary)
        self.tokenizer = make_word_tokenizer(self.vocabulary)
        super().__post_init__()

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        """Do as LeRobot does, with each of the texts once: the samples of a batch share a few instructions."""
        texts = [text] if isinstance(text, str) else text
        row = {different: number for number, different in enumerate(dict.fromkeys(texts))}
        rows = torch.tensor([row[text] for text in texts])
        return {name: of_different[rows] for name, of_different in super()._tokenize_text([*row]).items()}

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds, the words included."""
        return super().get_config() | {"vocabulary": self.vocabulary}
