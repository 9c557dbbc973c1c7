"""Alignment of memory tokens with the text of the current subgoal: objectives, loss, texts and their encoders.

From the paper's appendix on alignment; all in training only. H (B, L, d_m) are memory tokens, the mask (B, L) marks the
real ones, T are text embeddings of width d_t. Vectors with a hat in the paper are L2-normalised; so are they here.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from lerobot_memobench.datasets.frames import LEVEL_COLUMNS, MEMORY_COLUMN, FrameLookup, holds_texts
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SHUFFLE_SEED, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.losses import joint, mean_over_ranks, world_size
from lerobot_memobench.policies.memobench_mem.memory.mechanism import TEXT, TEXT_MASK

logger = logging.getLogger(__name__)

POSITIVE_SIMILARITY = 0.99  # texts more similar than this are the same subgoal
INITIAL_TEMPERATURE = 0.07


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` (..., N, D) over N where ``mask`` (..., N); zero where nothing is marked."""
    weights = rearrange(mask.to(values.dtype), "... n -> ... n 1")
    return (values * weights).sum(dim=-2) / weights.sum(dim=-2).clamp(min=1.0)


def same_text(text: Tensor) -> Tensor:
    """(N, N) bool: which of the normalised text embeddings (N, d_t) say the same."""
    return text @ text.T > POSITIVE_SIMILARITY


class Alignment(nn.Module, ABC):
    """An objective with a head, ``project``: memory vectors to the width of text embeddings."""

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__()
        self.project = nn.Linear(memory_dim, text_dim)

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """Return the arguments of `forward` and `pairs` for a batch; ``text_mask`` marks what has a text.

        Samples of an episode without any text have nothing to align to, and are left out.
        """
        return memory[text_mask], memory_mask[text_mask], text[text_mask]

    @abstractmethod
    def pairs(self, *usable: Tensor) -> tuple[Tensor, Tensor]:
        """Memory vectors and the texts they belong to, both (N, d_t) and normalised."""

    def numbers(self) -> dict[str, float]:
        """What else is worth a line in the log."""
        return {}


class SemanticAlignment(Alignment):
    """Cosine distance between the pooled memory, projected, and its text: mean of 1 - z.T over the batch."""

    def embed(self, memory: Tensor, memory_mask: Tensor) -> Tensor:
        """Normalised projection (B, d_t) of the masked mean over memory tokens."""
        return F.normalize(self.project(masked_mean(memory, memory_mask)), dim=-1)

    def pairs(  # type: ignore[override]  # the tensors of `usable`
        self, memory: Tensor, memory_mask: Tensor, text: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Pooled memories and their texts."""
        return self.embed(memory, memory_mask), F.normalize(text, dim=-1)

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = self.pairs(memory, memory_mask, text)
        return (1.0 - (z * t).sum(dim=-1)).sum() / mean_over_ranks(z.new_tensor(len(z)))


class ContrastiveAlignment(SemanticAlignment):
    """Two-way retrieval within the batch, that of all ranks together.

    Repeated subgoals are positives; rows of targets sum to one.
    """

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(INITIAL_TEMPERATURE)))

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = map(joint, self.pairs(memory, memory_mask, text))
        logits = z @ t.T / self.log_temperature.exp()
        positive = same_text(t).to(logits.dtype)
        target = positive / positive.sum(dim=1, keepdim=True)
        # Both directions weigh pair (memory i, text j) by the row-normalised target, as the paper's Y_ij and Y_ji.
        memory_to_text = -(target * F.log_softmax(logits, dim=1)).sum() / len(z)
        text_to_memory = -(target * F.log_softmax(logits, dim=0)).sum() / len(z)
        return 0.5 * (memory_to_text + text_to_memory)

    def numbers(self) -> dict[str, float]:
        """The learned temperature."""
        return {"align_temperature": self.log_temperature.exp().item()}


class FramewiseAlignment(Alignment):
    """Cosine distance per remembered frame to that frame's own text, recent frames weighing up to twice as much."""

    def __init__(self, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.frames, self.tokens_per_frame = frames, tokens_per_frame

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """All of it: each frame has a text of its own, or is left out by itself."""
        return memory, memory_mask, text, text_mask

    def _frames(self, memory: Tensor, memory_mask: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Frame vectors (B, F, d_t), normalised, and which frames count (B, F): real ones that have a text."""
        tokens = rearrange(memory, "b (f p) d -> b f p d", f=self.frames, p=self.tokens_per_frame)
        token_mask = rearrange(memory_mask, "b (f p) -> b f p", f=self.frames, p=self.tokens_per_frame)
        z = F.normalize(self.project(masked_mean(tokens, token_mask)), dim=-1)
        return z, token_mask.bool().any(dim=-1) & text_mask.bool()

    @staticmethod
    def weights(valid: Tensor) -> Tensor:
        """Recency weights (B, F) from ``valid`` (B, F): 0.5 + 0.5 rank / max(N - 1, 1), zero where not valid."""
        count = valid.sum(dim=1, keepdim=True)
        rank = valid.cumsum(dim=1) - 1
        return (0.5 + 0.5 * rank / (count - 1).clamp(min=1)) * valid

    def pairs(  # type: ignore[override]  # the tensors of `usable`
        self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Valid frames and their texts."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        return z[valid], F.normalize(text, dim=-1)[valid]

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, F*P, d_m), memory_mask (B, F*P), text (B, F, d_t), text_mask (B, F)."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        # A frame without text may hold any numbers, not-a-number too, so they are replaced before they are used.
        text = F.normalize(torch.where(rearrange(valid, "b f -> b f 1"), text, torch.ones_like(text)), dim=-1)
        weights = self.weights(valid)
        return (weights * (1.0 - (z * text).sum(dim=-1))).sum() / mean_over_ranks(weights.sum()).clamp(
            min=0.5 / world_size()
        )


def retrieval_accuracy(memory: Tensor, text: Tensor) -> float:
    """Share of memory vectors (N, d_t) whose nearest text among (N, d_t) says the same as their own (top-1)."""
    if len(memory) == 0:
        return 0.0
    nearest_text = (memory @ text.T).argmax(dim=1)
    return float(same_text(text).gather(1, nearest_text[:, None]).float().mean())


def make_alignment(name: str, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> Alignment | None:
    """Build the objective ``name``; ``none`` gives None.

    Its `Alignment.usable` takes texts (B, d_t) and text_mask (B,) with semantic and contrastive, (B, F, d_t) and
    (B, F) with framewise.
    """
    if name == "none":
        return None
    if name == "framewise":
        return FramewiseAlignment(memory_dim, text_dim, frames, tokens_per_frame)
    return {"semantic": SemanticAlignment, "contrastive": ContrastiveAlignment}[name](memory_dim, text_dim)


# -- loss of a training step ------------------------------------------------------------------------------------------


def alignment_loss(
    alignment: Alignment,
    weight: float,
    batch: Mapping[str, Tensor],
    memory: Tensor,
    mask: Tensor,
    encoder: Sequence[Tensor],
) -> tuple[Tensor, dict[str, float]]:
    """Align memory tokens (B, L, d_m), of which ``mask`` (B, L) is real, with the texts of a batch.

    With several ranks the batch is that of all of them together, and the average of the ranks' losses is its loss.

    Args:
        encoder: parameters of what made the memory; the gradient that they get from this loss is logged.

    Returns:
        The weighted loss (scalar), and numbers to log; none where no sample of any rank has a text.
    """
    memory = memory.to(torch.float32)  # means over hundreds of tokens and cosines, under mixed precision too
    text, text_mask = batch[TEXT].to(memory), batch[TEXT_MASK].to(memory.device)
    if not bool(mean_over_ranks(text_mask.any().float())):
        # Still touch every parameter, so that distributed training sees the same graph on all ranks.
        return 0.0 * torch.stack([parameter.sum() for parameter in alignment.parameters()]).sum(), {}
    usable = alignment.usable(memory, mask, text, text_mask)
    with torch.autocast(memory.device.type, enabled=False):
        loss = alignment(*usable)
    weighted = weight * loss
    logged = {"align_loss": loss.item()}
    if memory.requires_grad and torch.is_grad_enabled():
        # Two matrix products: cheap, and comparable with the gradient norm that LeRobot logs. What had no part in this
        # batch's memory gets zeros.
        gradients = torch.autograd.grad(weighted, list(encoder), retain_graph=True, materialize_grads=True)
        # A rank's gradient is its own rows' share; DDP averages them.
        logged["align_grad_norm"] = mean_over_ranks(parameters_to_vector(gradients)).norm().item()
    with torch.no_grad():
        logged["align_top1"] = retrieval_accuracy(*map(joint, alignment.pairs(*usable)))
    return weighted, logged | alignment.numbers()


# -- subgoal texts of samples -----------------------------------------------------------------------------------------


SEVERAL = 3
"""Subgoals of an episode that can change places in more than one way."""


def require_texts(root: Path, config: MemobenchMemConfig) -> None:
    """Refuse a dataset without the texts that a policy is to learn from, before anything is made of it.

    Raises:
        MemobenchError: it has no subgoals at the level that memory is aligned with, or no oracle memory.
    """
    column = LEVEL_COLUMNS[config.subgoal_level]
    if config.align != "none" and not holds_texts(root, column):
        others = [level for level, name in LEVEL_COLUMNS.items() if holds_texts(root, name)]
        cure = (
            f"it has {' and '.join(others)} ones: name one with --policy.subgoal_level"
            if others
            else ("use --policy.align=none, which needs none, or a dataset that names each frame's subgoal there")
        )
        raise MemobenchError(
            f"The dataset {root} has no {config.subgoal_level} subgoals (no text in a column '{column}'), so "
            f"--policy.align={config.align} has nothing to align memory to; {cure}."
        )
    if config.oracle_memory and not holds_texts(root, MEMORY_COLUMN):
        raise MemobenchError(
            f"The dataset {root} has no text in a column '{MEMORY_COLUMN}', which --policy.oracle_memory=true reads; "
            "leave it out, or generate the dataset again with this version."
        )


def text_rows(lookup: FrameLookup, level: str, align: str, shuffle: bool) -> np.ndarray:
    """Return the row of the cache's embeddings for each frame of the dataset (N,), -1 where it has no subgoal.

    Args:
        level: subgoal level. align: the objective, for the message.
        shuffle: whether subgoals are shuffled (`shuffled_subgoals`).

    Raises:
        MemobenchError: the dataset has no texts, or one only, which cannot be shuffled.
    """
    rows = lookup.text_rows(level)
    if len(lookup.texts) == 0:
        raise MemobenchError(
            f"The dataset of {lookup.root} has no subgoal text, so --policy.align={align} has nothing to "
            "align to; use --policy.align=none, or a dataset with subgoals."
        )
    if not shuffle:
        return rows
    if len(np.unique(rows[rows >= 0])) < 2:
        raise MemobenchError(
            f"The dataset of {lookup.root} has one {level} subgoal, and --policy.shuffle_subgoals=true needs another "
            "one to put in its place; use a dataset of several tasks, or another --policy.subgoal_level."
        )
    shuffled, elsewhere = shuffled_subgoals(rows, lookup.episodes)
    logger.info(
        "%s subgoals are shuffled: in %d of %d episodes among themselves; %d have fewer than %d, which would only be "
        "renamed, and get texts of other episodes",
        level,
        len(lookup.episodes) - 1 - elsewhere,
        len(lookup.episodes) - 1,
        elsewhere,
        SEVERAL,
    )
    return shuffled


def texts_of_frames(lookup: FrameLookup, rows: np.ndarray, frames: Sequence[int]) -> dict[str, Tensor]:
    """Return the texts (B, d_t) of frames of the dataset, and which have one (B,); ``rows`` as from `text_rows`."""
    return _embed(lookup, rows[np.asarray(frames)].astype(np.int64))


def texts_of_histories(
    lookup: FrameLookup, rows: np.ndarray, histories: Sequence[np.ndarray], frames: int
) -> dict[str, Tensor]:
    """Return the texts (B, F, d_t) of remembered frames, right-padded to F, and which have one (B, F)."""
    padded = np.full((len(histories), frames), -1, dtype=np.int64)
    for sample, history in enumerate(histories):
        padded[sample, : len(history)] = rows[history]
    return _embed(lookup, padded)


def _embed(lookup: FrameLookup, rows: np.ndarray) -> dict[str, Tensor]:
    numbers = torch.from_numpy(rows)
    return {TEXT_MASK: numbers >= 0, TEXT: lookup.text_embeddings[numbers.clamp(min=0)]}


def shuffled_subgoals(rows: np.ndarray, episodes: np.ndarray, seed: int = SHUFFLE_SEED) -> tuple[np.ndarray, int]:
    """The paper's control: the subgoals of each episode change places, each keeping its number of frames or not.

    Two that change places do so alike in every episode of their task, and one cannot: texts would be renamed and tell
    what they told before. Episodes with fewer than `SEVERAL` take, each for itself, texts of other episodes instead:
    of other tasks where there are enough, else any of the dataset.

    Args:
        rows: (N,) text number per frame, -1 for none. episodes: (E + 1,) first frame of each episode.
        seed: which shuffle.

    Returns:
        (N,) text numbers, the same in every run with this seed, and the number of episodes that took texts of others.
    """
    shuffled, every, elsewhere = rows.copy(), np.unique(rows[rows >= 0]), 0
    for episode, (start, end) in enumerate(itertools.pairwise(episodes)):
        present = np.unique(rows[start:end])
        present = present[present >= 0]
        chance = np.random.default_rng([seed, episode])
        if len(present) >= SEVERAL:
            # A rotation of a random order moves every subgoal; a plain permutation could leave them where they were.
            order = chance.permutation(present)
            replaced, by = order, np.roll(order, 1)
        else:
            others = np.setdiff1d(every, present)
            pool = others if len(others) >= SEVERAL * len(present) else every
            replaced, by = present, chance.choice(pool, len(present), replace=False)
            elsewhere += 1
        replace = dict(zip(replaced.tolist(), by.tolist(), strict=True))
        shuffled[start:end] = [replace.get(row, -1) for row in rows[start:end].tolist()]
    return shuffled, elsewhere


# -- frozen text encoders of subgoals ---------------------------------------------------------------------------------


_WORD = re.compile(r"\w+|[^\w\s]")


def words(text: str) -> list[str]:
    """Lower-case words and punctuation marks of a text."""
    return _WORD.findall(text.lower())


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
        rows = [torch.stack([self._vector(token) for token in self._tokens(text)]).sum(dim=0) for text in texts]
        return F.normalize(torch.stack(rows), dim=-1)

    def _tokens(self, text: str) -> list[str]:
        tokens = words(text)
        return [*tokens, *(f"{first} {second}" for first, second in itertools.pairwise(tokens))]


class LabelTextEncoder(WordTextEncoder):
    """One random vector per text, whatever its words: a label. What an alignment gains by it is not language's."""

    @property
    def key(self) -> str:
        """Identity of the embeddings."""
        return f"labels-1-{self.dim}"

    def _tokens(self, text: str) -> list[str]:
        return [text]


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
    """``words`` and ``labels`` give the built-in encoders, anything else is a SigLIP model's folder or repository."""
    built_in = {"words": WordTextEncoder, "labels": LabelTextEncoder}
    return built_in[name](dim) if name in built_in else SiglipTextEncoder(name, dim, device)
