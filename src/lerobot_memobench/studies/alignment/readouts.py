"""How well a memory tells which subgoal is active: linear readouts of frozen vectors, and a head's own answer.

A readout is fitted in closed form on frozen vectors of training episodes, for every policy alike, so that policies
trained without an alignment can be compared with those that have a head of their own. It has the form of the heads: a
linear map to the text embedding, answered by the nearest candidate text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

PENALTIES = tuple(10.0**k for k in range(-4, 3))
FOLDS = 3


@dataclass(frozen=True)
class Readout:
    """Ridge regression from standardised vectors to text embeddings."""

    mean: Tensor  # (D,)
    scale: Tensor  # (D,)
    weight: Tensor  # (D, d_t)
    bias: Tensor  # (d_t,)
    penalty: float

    def __call__(self, vectors: Tensor) -> Tensor:
        """Predicted embeddings (N, d_t) of vectors (N, D), normalised."""
        return F.normalize((vectors.double() - self.mean) / self.scale @ self.weight + self.bias, dim=-1)


def fit_readout(vectors: Tensor, texts: Tensor, penalty: float) -> Readout:
    """Fit vectors (N, D) to texts (N, d_t); ``penalty`` is relative to N, as every input has variance 1."""
    vectors, texts = vectors.double(), texts.double()
    mean, scale = vectors.mean(dim=0), vectors.std(dim=0).clamp(min=1e-8)
    inputs, bias = (vectors - mean) / scale, texts.mean(dim=0)
    gram = inputs.T @ inputs + penalty * len(inputs) * torch.eye(inputs.shape[1], dtype=torch.float64)
    weight = torch.linalg.solve(gram, inputs.T @ (texts - bias))
    return Readout(mean, scale, weight, bias, penalty)


def choose_readout(vectors: Tensor, labels: Tensor, candidates: Tensor, episodes: Tensor) -> Readout:
    """Fit a readout whose penalty was chosen on the training episodes alone.

    Args:
        vectors: (N, D). labels: (N,) row of ``candidates`` that is right.
        candidates: (C, d_t) text embeddings.
        episodes: (N,) a number per episode; whole episodes are left out, a third of them at a time.
    """
    folds = episodes % FOLDS

    def score(penalty: float) -> float:
        """How many frames of left-out episodes are told right."""
        right = 0.0
        for fold in range(FOLDS):
            out = folds == fold
            if not bool(out.any()) or bool(out.all()):
                continue
            readout = fit_readout(vectors[~out], candidates[labels[~out]], penalty)
            right += float((nearest(readout(vectors[out]), candidates) == labels[out]).sum())
        return right

    best = max(PENALTIES, key=lambda penalty: (score(penalty), penalty))  # of equals, the simpler readout
    return fit_readout(vectors, candidates[labels], best)


def nearest(embeddings: Tensor, candidates: Tensor, allowed: Tensor | None = None) -> Tensor:
    """Row (N,) of the candidate (C, d_t) nearest to each embedding (N, d_t), among those ``allowed`` (N, C)."""
    similarity = embeddings.double() @ F.normalize(candidates.double(), dim=-1).T
    if allowed is not None:
        similarity = similarity.masked_fill(~allowed, -torch.inf)
    return similarity.argmax(dim=1)


def top1(embeddings: Tensor, labels: Tensor, candidates: Tensor, allowed: Tensor | None = None) -> float:
    """Share of embeddings (N, d_t) whose nearest candidate is the right one."""
    return float((nearest(embeddings, candidates, allowed) == labels).double().mean())


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and sample standard deviation; None for a single value, which has none."""
    tensor = torch.tensor(values, dtype=torch.float64)
    return float(tensor.mean()), float(tensor.std()) if len(values) > 1 else None
