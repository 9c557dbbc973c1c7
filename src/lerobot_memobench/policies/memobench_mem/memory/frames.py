"""Frame sampling, the paper's memory (RoboMME): a chunk reads frames spread evenly over the episode so far."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MEMORY_GRID,
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
    State,
    with_noise,
)
from lerobot_memobench.policies.memobench_mem.objects import ObjectPool

logger = logging.getLogger(__name__)


def sample_frames(step: int, max_frames: int) -> list[int]:
    """Choose at most ``max_frames`` of the frames 0 ... ``step``, evenly spaced, with the first and the last."""
    if step < max_frames:
        return list(range(step + 1))
    if max_frames == 1:
        return [step]
    return [i * step // (max_frames - 1) for i in range(max_frames)]


@dataclass(eq=False)
class RememberedFrame:
    """A remembered frame at a control step, as ``stored`` (P', D') on the CPU by the encoder."""

    step: int
    stored: Tensor
    tokens: Tensor | None = None
    """Its memory tokens (P, d_m), kept after the first read; only of objects, whose tokens are small."""
    noise: int | None = None
    """Seed of noise on its memory tokens (``corrupt=noise``), because noise would change stored class numbers."""


@dataclass
class FrameSamplingSettings:
    """Settings of `FrameSampling`: the most ``frames`` that a chunk reads, and whether tokens have ``content``.

    Without content they hold only their time: the clock-only control of `docs/guides/controls.md`; with
    ``memory_phase``, also the phase.
    """

    frames: int = 32
    content: bool = True

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ValueError(f"frames={self.frames} must be at least 1")


class FrameSampling(MemoryMechanism):
    """FrameSamp of RoboMME's pi0.5: a chunk reads F of the stored frames, spread evenly, each token with its time.

    Every frame is stored, because each new frame changes the selection; of a very long episode, the latest `capacity`.
    Frames are kept as returned by the encoder, and pooled when they are read.
    """

    Settings = FrameSamplingSettings
    per_frame = True
    capacity = 8192  # 512 MiB at size pi05, 32 MiB at tiny; with every frame remembered, seven minutes at 20 Hz

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: FrameSamplingSettings) -> None:
        super().__init__(spec, pool, settings)
        self.encoder = MemoryEncoder(spec.dim, spec.width, spec.grid)
        self.warned = False

    @classmethod
    def slots(cls, slot: int, settings: FrameSamplingSettings) -> Sequence[int]:
        first = max(0, slot + 1 - cls.capacity)
        return [first + chosen for chosen in sample_frames(slot - first, settings.frames)]

    def init(self, rows: int) -> State:
        return [[] for _ in range(rows)]

    def pooled(self, frames: Tensor) -> Tensor:
        return frames

    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        if not self.warned and any(len(row) == self.capacity for row in state):
            self.warned = True
            logger.warning(
                "An episode has more than %d remembered frames; only the latest are kept. Call policy.reset() when an "
                "episode begins.",
                self.capacity,
            )
        new = [RememberedFrame(now, stored) for now, stored in zip(step.tolist(), tokens.to("cpu"), strict=True)]
        return [[*row[1 - self.capacity :], frame] for row, frame in zip(state, new, strict=True)]

    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        """Return the encoded sampled frames of each row, padded to F."""
        count, device = self.settings.frames, self.encoder.project.weight.device
        rows = [[row[slot] for slot in sample_frames(len(row) - 1, count)] for row in state]
        read = [frame for row in rows for frame in row]
        indices, steps = torch.zeros(len(rows), count, dtype=torch.int64), torch.zeros(len(read), dtype=torch.int64)
        real = torch.arange(count) < torch.tensor([[len(row)] for row in rows])
        indices[real], steps[:] = torch.arange(len(read)), torch.tensor([frame.step for frame in read])
        indices, steps, real = indices.to(device), steps.to(device), real.to(device)
        tokens = self._frame_tokens(read, steps)
        for number, frame in enumerate(read):
            if frame.noise is not None:
                tokens = tokens.clone()
                tokens[number] = with_noise(tokens[number], torch.Generator().manual_seed(frame.noise))
        return self._tokens(tokens[indices].flatten(1, 2), real, steps[indices])

    def _frame_tokens(self, read: list[RememberedFrame], steps: Tensor) -> Tensor:
        new = [number for number, frame in enumerate(read) if frame.tokens is None]
        cached = [frame.tokens for frame in read]
        if new:
            stored = torch.stack([read[number].stored for number in new]).to(steps.device)
            tokens = self._encoded(stored, steps[new])
            if not isinstance(self.pool, ObjectPool):
                return tokens
            for number, cached[number] in zip(new, tokens, strict=True):
                read[number].tokens = cached[number]
        return torch.stack(cached)  # type: ignore[arg-type]  # none is None now

    def join(self, states: Sequence[State]) -> State:
        return [row for state in states for row in state]

    def noised(self, state: State, generator: torch.Generator) -> State:
        seed = generator.initial_seed()
        return [[replace(frame, noise=seed + frame.step) for frame in row] for row in state]

    def replay(self, histories: Histories, query: Query = Query()) -> MemoryTokens:
        """Encode each frame once for all samples that read it."""
        padded = F.pad(histories.places, (0, self.settings.frames - histories.places.shape[1]), value=-1)
        real, places = padded >= 0, padded.clamp(min=0)
        encoded = self._encoded(histories.frames, histories.steps)
        return self._tokens(encoded, real, histories.steps[places])._replace(places=places)

    def _encoded(self, frames: Tensor, steps: Tensor) -> Tensor:
        """Return memory tokens (N, P, d_m) of stored frames (N, P', D') at control steps (N,)."""
        if not self.settings.content and isinstance(self.pool, ObjectPool) and self.pool.phase is not None:
            tokens = self.pool.phases(frames)
        else:
            tokens = self.pool(frames)
            tokens = tokens if self.settings.content else torch.zeros_like(tokens)
        return self.encoder(tokens, steps)

    def _tokens(self, encoded: Tensor, real: Tensor, steps: Tensor) -> MemoryTokens:
        mask, steps = (repeat(of_frames, "b f -> b (f p)", p=self.spec.tokens) for of_frames in (real, steps))
        return MemoryTokens(encoded, mask, steps=steps)


# -- the encoder ------------------------------------------------------------------------------------------------------


POSITION_DIM = 768  # sine and cosine of time, row and column at each frequency
_FREQUENCIES = 128
_TIME_BASE, _SPACE_BASE = 10_000.0, 1_000.0


def _waves(values: Tensor, base: float) -> Tensor:
    """Return sines, then cosines, of values (...) at 128 frequencies from 1 down to 1/base: (..., 256) float32."""
    exponents = torch.arange(_FREQUENCIES, dtype=torch.float32, device=values.device) / (_FREQUENCIES - 1)
    angles = rearrange(values.to(torch.float32), "... -> ... 1") * base**-exponents
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class MemoryEncoder(nn.Module):
    """Map vision tokens and their positions to memory tokens: concat(image, SiLU(Linear(position))) -> Linear.

    A Linear of a concatenation is the sum of Linears of its parts, so the first Linear is applied to F times and 4 + 4
    places instead of F * 16 tokens. Tokens without a ``grid`` are joined with their time only.
    """

    def __init__(self, image_dim: int, memory_dim: int, grid: int = MEMORY_GRID) -> None:
        super().__init__()
        self.grid = grid
        self.position = nn.Linear(POSITION_DIM, POSITION_DIM) if grid else nn.Linear(2 * _FREQUENCIES, memory_dim)
        self.project = nn.Linear(image_dim + self.position.out_features, memory_dim)

    def forward(self, tokens: Tensor, steps: Tensor) -> Tensor:
        """Encode tokens (N, P, D) of frames at control steps (N,) to (N, P, d_m)."""
        of_image, of_position = self.project.weight.split([tokens.shape[-1], self.position.out_features], dim=1)
        image = F.linear(tokens.to(of_image.dtype), of_image, self.project.bias)
        at, of_frame = steps.unique(return_inverse=True)  # many frames of a training batch have equal steps
        return image + F.linear(F.silu(self._positions(at)), of_position).index_select(0, of_frame)

    def _positions(self, steps: Tensor) -> Tensor:
        """Return `position` of each token, (..., 16, 768); without a grid, of the frame's time only, (..., 1, d_m).

        Its input is sin t, cos t, sin y, cos y, sin x, cos x, at 128 frequencies each; y runs over rows.
        """
        weight = self.position.weight
        if not self.grid:
            return rearrange(self.position(_waves(steps, _TIME_BASE).to(weight.dtype)), "... d -> ... 1 d")
        of_time, of_row, of_column = weight.split(2 * _FREQUENCIES, dim=1)
        # The middle of token i of a grid row lies at 4 i + 2 of the 16 patches.
        middles = 4.0 * torch.arange(MEMORY_GRID, dtype=torch.float32, device=steps.device) + 2.0
        grid = _waves(middles, _SPACE_BASE).to(weight.dtype)
        time = F.linear(_waves(steps, _TIME_BASE).to(weight.dtype), of_time, self.position.bias)
        rows = rearrange(F.linear(grid, of_row), "y d -> y 1 d")
        columns = rearrange(F.linear(grid, of_column), "x d -> 1 x d")
        return rearrange(time, "... d -> ... 1 d") + rearrange(rows + columns, "y x d -> (y x) d")
