"""Texts of checkpoints: those of each task, those of a control (``align_targets``), and their embeddings.

A task is identified by its instruction. For a privileged memory the texts come from the training dataset and are kept
in the policy's configuration (``subgoals``); the environment never reveals which of them is active.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.memory_text import MARK

logger = logging.getLogger(__name__)

SHUFFLE_SEED = 7
SHUFFLED_ALONE = 3
"""Smallest number of subgoals of an episode that are permuted among themselves."""
NO_WORD = "-"
"""Text of a subgoal that shares no word with those of other variants."""


def texts_of(subgoals: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return all texts, sorted; a memory refers to them by their indices."""
    return tuple(sorted({text for own in subgoals.values() for text in own}))


def subgoals_of(texts: Sequence[str], episodes: np.ndarray, tasks: Iterable[Iterable[str]]) -> dict[str, list[str]]:
    """Return instruction -> sorted texts of its checkpoints, given the instructions of each episode."""
    by_task = dict[str, set[str]]()
    for instructions, own in zip(tasks, _of_episodes(texts, episodes), strict=True):
        for task in instructions:
            by_task.setdefault(str(task), set()).update(filter(None, own))
    return {task: sorted(own) for task, own in sorted(by_task.items())}


def _of_episodes(texts: Sequence[str], episodes: np.ndarray) -> list[Sequence[str]]:
    return [texts[start:end] for start, end in itertools.pairwise(episodes.tolist())]


_warned: set[str] = set()
"""Instructions about which this process has logged a warning."""


def choices(subgoals: dict[str, list[str]], tasks: str | Sequence[str]) -> Tensor:
    """Return which of all texts belong to each row's task, (B, S) bool; all texts if an instruction is unknown.

    Args:
        subgoals: instruction -> texts of its checkpoints. tasks: instructions, with or without oracle memory text.
    """
    texts, rows = texts_of(subgoals), dict[str, list[bool]]()
    tasks = [task.partition(MARK)[0] for task in ([tasks] if isinstance(tasks, str) else tasks)]
    for task in dict.fromkeys(tasks):
        own = subgoals.get(task)
        if own is None and task not in _warned:
            _warned.add(task)
            logger.warning("the memory knows no checkpoints of %r; it chooses from those of all tasks", task)
        rows[task] = [own is None or text in own for text in texts]
    return torch.tensor([rows[task] for task in tasks])


# -- texts of a control ------------------------------------------------------------------------------------------------

# A subgoal of a task with variants names a place in the episode and the hidden answer, such as the drawer to open.
# `progress` keeps the first and `answers` the second. Each takes and returns the subgoal (N,) of each frame, "" for
# none; ``episodes`` (E + 1,) holds the first frame of each episode.


def answers(texts: Sequence[str], episodes: np.ndarray) -> list[str]:
    """Return all subgoals of a frame's episode as one text, which is constant in the episode."""
    joined: list[str] = []
    for own in _of_episodes(texts, episodes):
        joined += ["; ".join(filter(None, dict.fromkeys(own)))] * len(own)
    return joined


def progress(texts: Sequence[str], episodes: np.ndarray, tasks: Sequence[str]) -> list[str]:
    """Return each subgoal without the words that differ between the episodes of its task (E,).

    A word is kept if the subgoal at the same place in every episode of the task has it.
    """
    orders = [list(filter(None, dict.fromkeys(own))) for own in _of_episodes(texts, episodes)]
    shared: dict[tuple[str, int], set[str]] = {}
    for task, order in zip(tasks, orders, strict=True):
        for position, text in enumerate(order):
            words = set(text.split())
            shared[task, position] = shared.get((task, position), words) & words
    shortened: list[str] = []
    for task, order, own in zip(tasks, orders, _of_episodes(texts, episodes), strict=True):
        cut = {"": ""}
        for position, text in enumerate(order):
            cut[text] = " ".join(word for word in text.split() if word in shared[task, position]) or NO_WORD
        shortened += [cut[text] for text in own]
    return shortened


def shuffled(texts: Sequence[str], episodes: np.ndarray, seed: int = SHUFFLE_SEED) -> list[str]:
    """Permute the subgoals within each episode: a control of the paper.

    Two subgoals of a task would be exchanged in every episode alike, which renames the texts and keeps their
    information. Episodes with fewer than `SHUFFLED_ALONE` subgoals therefore draw texts of other episodes: of other
    tasks if there are enough, else of the whole dataset.
    """
    every, permuted, elsewhere = sorted({*texts} - {""}), list[str](), 0
    for episode, own in enumerate(_of_episodes(texts, episodes)):
        present = sorted({*own} - {""})
        chance = np.random.default_rng([seed, episode])
        if len(present) >= SHUFFLED_ALONE:
            # A rotation of a random order moves every subgoal.
            order = chance.permutation(present).tolist()
            replace = dict(zip(order, np.roll(order, 1).tolist(), strict=True))
        else:
            absent = [text for text in every if text not in present]
            pool = absent if len(absent) >= SHUFFLED_ALONE * len(present) else every
            replace = dict(zip(present, chance.choice(pool, len(present), replace=False).tolist(), strict=True))
            elsewhere += 1
        permuted += [replace.get(text, "") for text in own]
    logger.info(
        "subgoals are shuffled: %d of %d episodes permute their own; %d have fewer than %d and take texts of other "
        "episodes",
        *(len(episodes) - 1 - elsewhere, len(episodes) - 1, elsewhere, SHUFFLED_ALONE),
    )
    return permuted


# -- frozen encoders ---------------------------------------------------------------------------------------------------

_WORD = re.compile(r"\w+|[^\w\s]")


def words(text: str) -> list[str]:
    """Return the lower-case words and punctuation marks of a text."""
    return _WORD.findall(text.lower())


class WordTextEncoder:
    """Embed a text as the sum of a fixed random vector per word and per pair of neighbouring words.

    Different texts nearly always have cosines well below 0.99.
    """

    name = "words"

    def __init__(self, dim: int) -> None:
        self.dim, self.key = dim, f"{self.name}-1-{dim}"

    def _vector(self, token: str) -> Tensor:
        seed = int.from_bytes(hashlib.blake2b(token.encode(), digest_size=7).digest(), "big")
        return torch.randn(self.dim, generator=torch.Generator().manual_seed(seed))

    def __call__(self, texts: Sequence[str]) -> Tensor:
        rows = [torch.stack([self._vector(token) for token in self._tokens(text)]).sum(dim=0) for text in texts]
        return F.normalize(torch.stack(rows), dim=-1)

    def _tokens(self, text: str) -> list[str]:
        tokens = words(text)
        return [*tokens, *(f"{first} {second}" for first, second in itertools.pairwise(tokens))]


class LabelTextEncoder(WordTextEncoder):
    """Embed each text as one random vector, independent of its words: a control without language."""

    name = "labels"

    def _tokens(self, text: str) -> list[str]:
        return [text]


class SiglipTextEncoder:
    """SigLIP's text tower from a folder or the hub; width 1152 for So400m, as in the paper."""

    def __init__(self, name: str, dim: int, device: str = "cpu") -> None:
        self.name, self.dim, self.device = name, dim, device
        self.key = f"siglip-{name.rstrip('/').rsplit('/', 1)[-1]}-{dim}"  # the model's name without its folder

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> Tensor:
        tokenizer, model = self._load()
        rows = []
        for part in itertools.batched(texts, 64):
            # SigLIP was trained with every text padded to 64 tokens.
            inputs = tokenizer(list(part), padding="max_length", max_length=64, truncation=True, return_tensors="pt")
            rows.append(model(inputs["input_ids"].to(self.device)).pooler_output.float().cpu())
        return torch.cat(rows)

    def _load(self) -> tuple[Any, Any]:
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
    built_in = {encoder.name: encoder for encoder in (WordTextEncoder, LabelTextEncoder)}
    return built_in[name](dim) if name in built_in else SiglipTextEncoder(name, dim, device)
