"""Recurrence (RoboMME's RMT): a fixed number of slots reads each remembered frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import rotate_from
from lerobot_memobench.policies.memobench_mem.memory.frames import MemoryEncoder
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
    State,
)

HIDDEN = 512
"""Maximum width of a recurrence, as in the source."""
HEADS = 8
SLOTS_OF_WIDTH = 4
"""Width of memory tokens per slot: 512 slots at size pi05, as in the source, and 32 at small."""


@dataclass
class RecurrenceSettings:
    """Settings of a recurrence: the number of last frames through which gradients pass."""

    gradient_frames: int = 16

    def __post_init__(self) -> None:
        if self.gradient_frames < 1:
            raise ValueError(
                f"gradient_frames={self.gradient_frames} must be at least 1, or the memory would not learn"
            )


@dataclass
class RecurrentSettings(RecurrenceSettings):
    """Settings of `Recurrent`: the number of slots; None: a quarter of the width of memory tokens."""

    slots: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slots is not None and self.slots < 1:
            raise ValueError(f"slots={self.slots} must be at least 1")


class Recurrent(MemoryMechanism):
    """RMT of RoboMME's pi0.5: slots attend to the frame and to themselves, with a norm after the residual.

    For a frame X and slots S: Z = LN_pre([X; S]); O is softmax attention of the slots' rows of Z to all of Z, with
    rotary positions along [X; S] and one key-value head; S <- LN_post(O W_o + S). Slots are carried over from one
    remembered frame to the next. `docs/guides/memory/recurrent.md` lists all differences from the source.
    """

    Settings = RecurrentSettings
    stride = 16
    capacity = 1  # the slots

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: RecurrentSettings) -> None:
        super().__init__(spec, pool, settings)
        width, count = min(HIDDEN, spec.width), settings.slots or spec.width // SLOTS_OF_WIDTH
        self.gradient_frames = settings.gradient_frames
        self.encoder = MemoryEncoder(spec.dim, width, spec.grid)
        self.initial = nn.Parameter(torch.empty(count, width))
        nn.init.normal_(self.initial, std=width**-0.5)
        self.pre_norm, self.post_norm = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.query, self.key_value = projection(width, width), projection(width, 2 * width // HEADS)
        self.attended = projection(width, width, std=0.005)
        self.out = nn.Linear(width, spec.width)

    def init(self, rows: int) -> State:
        return {"slots": repeat(self.initial, "s d -> r s d", r=rows)}

    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        slots: Tensor = state["slots"]
        frame = self.encoder(tokens, step)
        count, length = slots.shape[1], frame.shape[1] + slots.shape[1]
        both = self.pre_norm(torch.cat([frame, slots], dim=1))
        key, value = self.key_value(both).chunk(2, dim=-1)
        queries = rearrange(self.query(both[:, -count:]), "r s (h d) -> r h s d", h=HEADS)
        # All heads share the keys, so they are computed as one head with more rows, faster than torch's kernel.
        queries = rotate_from(queries, length - count).flatten(1, 2) * key.shape[-1] ** -0.5
        weights = (queries @ rotate_from(key, 0).mT).softmax(dim=-1)
        read = rearrange(weights @ value, "r (h s) d -> r s (h d)", h=HEADS)
        return {"slots": self.post_norm(self.attended(read) + slots)}

    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        tokens: Tensor = self.out(state["slots"])
        return MemoryTokens(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device))


def projection(inputs: int, outputs: int, std: float = 0.02) -> nn.Linear:
    """Return a linear layer without bias, with weights drawn from N(0, std^2)."""
    linear = nn.Linear(inputs, outputs, bias=False)
    nn.init.normal_(linear.weight, std=std)
    return linear
