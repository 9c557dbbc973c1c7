"""Dimensions and defaults of each size of ``memobench_mem``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

FLOW_MATCHING, REGRESSION = "flow_matching", "regression"
"""Values of ``objective``."""


@dataclass(frozen=True)
class Gemma:
    """Dimensions of one of the two transformers, named as in LeRobot's ``GemmaConfig``."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class Vision:
    """Dimensions of the SigLIP image tower."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    patch: int
    image: int  # pixels per side of the policy's input


PAPERS: Mapping[str, Any] = {
    "chunk_size": 50,
    "n_action_steps": 50,
    "optimizer_weight_decay": 0.0,
    "ema_decay": 0.999,
    "objective": FLOW_MATCHING,
}
"""The paper's values of the fields whose defaults depend on the size."""


@dataclass(frozen=True)
class Dimensions:
    """All dimensions and size-dependent defaults of one size."""

    vlm: Gemma
    expert: Gemma
    vision: Vision
    vocabulary: int
    tokenizer: str  # "words" (built here) or a Hugging Face tokenizer
    tokenizer_max_length: int
    text_encoder: str  # "words" or "labels" (built here) or a folder or repository of a SigLIP model
    text_dim: int
    learning_rate: float
    normalization: str = "QUANTILES"  # LeRobot's mode for states and actions
    final_learning_rate: float = 1.0  # at the end, as a fraction of the highest; 1: it stays constant
    defaults: Mapping[str, Any] = field(default_factory=lambda: PAPERS)


# The VLM's width is also the width d_m of the memory tokens (2048 at full size).
# LeRobot's attention code fixes 8 heads; widths and head dimensions are free.
_TINY = Dimensions(
    vlm=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
    expert=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
    vision=Vision(width=96, depth=2, mlp_dim=192, num_heads=4, patch=12, image=96),
    vocabulary=1024,
    tokenizer="words",
    tokenizer_max_length=64,
    text_encoder="words",
    text_dim=64,
    learning_rate=1e-3,
)
SIZES = {
    "tiny": _TINY,
    "small": replace(
        _TINY,
        vlm=replace(_TINY.vlm, depth=3),
        expert=replace(_TINY.expert, depth=3),
        vocabulary=512,
        tokenizer_max_length=48,
        normalization="MEAN_STD",
        final_learning_rate=0.02,
        defaults={
            "chunk_size": 16,
            "n_action_steps": 6,
            "optimizer_weight_decay": 1e-4,
            "ema_decay": 0.995,
            "objective": REGRESSION,
        },
    ),
    "pi05": Dimensions(
        vlm=Gemma(width=2048, depth=18, mlp_dim=16_384, num_heads=8, num_kv_heads=1, head_dim=256),
        expert=Gemma(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
        vision=Vision(width=1152, depth=27, mlp_dim=4304, num_heads=16, patch=14, image=224),
        vocabulary=257_152,
        tokenizer="google/paligemma-3b-pt-224",
        tokenizer_max_length=200,
        text_encoder="google/siglip-so400m-patch14-224",
        text_dim=1152,
        learning_rate=5e-5,
    ),
}
