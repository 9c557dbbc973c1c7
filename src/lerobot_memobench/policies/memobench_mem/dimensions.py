"""The sizes of the policy. Everything that differs between them is a number or a name in this file."""

from __future__ import annotations

from dataclasses import dataclass, field

GRID = 4
"""A remembered picture is pooled to GRID x GRID tokens."""


@dataclass(frozen=True)
class Gemma:
    """One transformer of the pair (names as LeRobot's ``GemmaConfig``)."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class Vision:
    """The SigLIP image tower."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    patch: int
    image: int  # pixels per side of the policy's input


@dataclass(frozen=True)
class Recipe:
    """What is trained how, as far as a size decides it; the first values are the paper's.

    Attributes:
        chunk_size: actions of a plan. n_action_steps: how many of them are taken before the next plan.
        final_lr: learning rate at the end, as a fraction of the highest; below 1 it falls there as a cosine.
        normalization: LeRobot's mode for states and actions.
        objective: how actions are learned (`action_objective`).
    """

    chunk_size: int = 50
    n_action_steps: int = 50
    weight_decay: float = 0.0
    ema_decay: float = 0.999
    final_lr: float = 1.0
    normalization: str = "QUANTILES"
    objective: str = "flow_matching"


@dataclass(frozen=True)
class Dimensions:
    """All dimensions and size-dependent defaults of one size."""

    vlm: Gemma
    expert: Gemma
    vision: Vision
    vocabulary: int
    tokenizer: str  # "words" (built here) or a Hugging Face tokenizer
    tokenizer_max_length: int
    text_encoder: str  # "words" (built here) or a folder or repository of a SigLIP model
    text_dim: int
    learning_rate: float
    recipe: Recipe = field(default_factory=Recipe)


# The VLM's width is also the width d_m of the memory tokens (2048 at full size).
# LeRobot's attention code fixes 8 heads; widths and head dimensions are free.
SIZES = {
    "tiny": Dimensions(
        vlm=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
        expert=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
        vision=Vision(width=96, depth=2, mlp_dim=192, num_heads=4, patch=12, image=96),
        vocabulary=1024,
        tokenizer="words",
        tokenizer_max_length=64,
        text_encoder="words",
        text_dim=64,
        learning_rate=1e-3,
    ),
    "small": Dimensions(
        vlm=Gemma(width=128, depth=3, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
        expert=Gemma(width=128, depth=3, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
        vision=Vision(width=96, depth=2, mlp_dim=192, num_heads=4, patch=12, image=96),
        vocabulary=512,
        tokenizer="words",
        tokenizer_max_length=48,
        text_encoder="words",
        text_dim=64,
        learning_rate=1e-3,
        recipe=Recipe(
            chunk_size=16,
            n_action_steps=6,
            weight_decay=1e-4,
            ema_decay=0.995,
            final_lr=0.02,
            normalization="MEAN_STD",
            objective="regression",
        ),
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
