"""The visual memory: which frames, their tokens, how the action expert reads them, and the history of a rollout.

Source: spec policy.md, which follows RoboMME's pi0.5 memory module (frame sampling with modulation). Shapes: B rows,
F frames, P = 16 tokens per frame, L = F * P, D width of the vision tokens, d_m width of memory tokens, W width of
the action expert, T action tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor, nn

GRID = 4  # a frame is pooled to GRID x GRID tokens
POSITION_DIM = 768
_FREQUENCIES = 128
_TIME_BASE, _SPACE_BASE = 10_000.0, 1_000.0
_ROPE_BASE = 10_000.0


def sample_frames(step: int, max_frames: int) -> list[int]:
    """Choose at most ``max_frames`` of the frames 0 ... ``step``, evenly, first and last included.

    All of them while there are no more than ``max_frames``. Indices are rounded down and strictly increase.
    """
    if step < 0 or max_frames < 1:
        raise ValueError(f"step must be >= 0 and max_frames >= 1, got {step} and {max_frames}")
    if step < max_frames:
        return list(range(step + 1))
    if max_frames == 1:
        return [step]
    return [i * step // (max_frames - 1) for i in range(max_frames)]


def position_features(steps: Tensor) -> Tensor:
    """Sinusoids of control step and grid place: (..., ) int steps -> (..., 16, 768) float32.

    Order: sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each from 1 down to 1/base. Token i of a grid row
    lies at 4 i + 2 of the 16 patches (its middle), y runs over rows.
    """
    shape = (*steps.shape, GRID, GRID, 2 * _FREQUENCIES)
    time = _waves(steps, _TIME_BASE)[..., None, None, :].expand(shape)
    grid = _grid_waves(steps.device)
    rows = grid[:, None, :].expand(shape)
    columns = grid[None, :, :].expand(shape)
    return torch.cat([time, rows, columns], dim=-1).flatten(-3, -2)


def _waves(values: Tensor, base: float) -> Tensor:
    """Sines, then cosines, of values (...) at 128 frequencies from 1 down to 1/base: (..., 256) float32."""
    exponents = torch.arange(_FREQUENCIES, dtype=torch.float32, device=values.device) / (_FREQUENCIES - 1)
    angles = values.to(torch.float32).unsqueeze(-1) * base**-exponents
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def _grid_waves(device: torch.device) -> Tensor:
    """Waves (4, 256) of the rows, or columns, of the token grid."""
    return _waves(4.0 * torch.arange(GRID, dtype=torch.float32, device=device) + 2.0, _SPACE_BASE)


def pool_tokens(tokens: Tensor) -> Tensor:
    """Mean-pool the patch tokens of square images (N, g*g, D) to (N, 16, D); g is a multiple of 4 (16 at full size)."""
    count, patches, width = tokens.shape
    side = round(patches**0.5)
    if side * side != patches or side % GRID:
        raise ValueError(f"cannot pool {patches} tokens to a {GRID}x{GRID} grid")
    block = side // GRID
    grid = tokens.reshape(count, GRID, block, GRID, block, width)
    return grid.mean(dim=(2, 4)).reshape(count, GRID * GRID, width)


class MemoryEncoder(nn.Module):
    """Vision tokens and their positions to memory tokens: concat(image, SiLU(Linear(position))) -> Linear.

    A Linear of a concatenation is the sum of its parts' Linears. The 16 tokens of a frame share their time and all
    frames share their grid, so the first Linear is applied to F times and 4 + 4 places instead of F * 16 tokens.
    """

    def __init__(self, image_dim: int, memory_dim: int) -> None:
        super().__init__()
        self.position = nn.Linear(POSITION_DIM, POSITION_DIM)
        self.project = nn.Linear(image_dim + POSITION_DIM, memory_dim)

    def forward(self, tokens: Tensor, steps: Tensor, frame_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encode tokens (B, F, P, D) seen at control steps (B, F).

        Returns:
            H (B, F*P, d_m) float32 and its mask (B, F*P) bool, from ``frame_mask`` (B, F).
        """
        weight = self.position.weight
        of_time, of_row, of_column = weight.split(2 * _FREQUENCIES, dim=1)
        grid = _grid_waves(steps.device).to(weight.dtype)
        time = F.linear(_waves(steps, _TIME_BASE).to(weight.dtype), of_time, self.position.bias)
        place = F.linear(grid, of_row)[:, None, :] + F.linear(grid, of_column)[None, :, :]
        position = F.silu(time.unsqueeze(-2) + place.flatten(0, 1))
        of_image, of_position = self.project.weight.split([tokens.shape[-1], POSITION_DIM], dim=1)
        image = tokens.to(self.project.weight.dtype)
        encoded = F.linear(image, of_image, self.project.bias) + F.linear(position, of_position)
        return encoded.flatten(1, 2), frame_mask.bool().repeat_interleave(tokens.shape[2], dim=1)


class RMSNorm(nn.Module):
    """Root-mean-square norm with a learned scale that starts at one (Gemma's form)."""

    def __init__(self, width: int, eps: float = 1e-6) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        x = x.to(torch.float32)
        return x * torch.rsqrt(x.square().mean(dim=-1, keepdim=True) + self.eps) * (1.0 + self.weight)


def _rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary position embedding of x (B, heads, N, d) at positions (N,), halves paired as in Gemma."""
    half = x.shape[-1] // 2
    frequencies = _ROPE_BASE ** -(torch.arange(half, dtype=torch.float32, device=x.device) / half)
    angles = positions.to(torch.float32)[:, None] * frequencies
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    first, second = x[..., :half], x[..., half:]
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1)


class MemoryModulator(nn.Module):
    """Action tokens look into memory and come back with a scale and a shift for one feed-forward's input.

    Multi-query attention: ``heads`` query heads of width W / heads, one key-value head; rotary positions 0 ... L-1 for
    memory, L ... L+T-1 for actions. The last Linear starts at zero, so that training starts from plain pi0.5.
    """

    def __init__(self, width: int, heads: int = 4) -> None:
        super().__init__()
        self.heads, self.head_dim = heads, width // heads
        self.action_norm = RMSNorm(width)
        self.memory_norm = RMSNorm(width)
        self.query = nn.Linear(width, heads * self.head_dim, bias=False)
        self.key = nn.Linear(width, self.head_dim, bias=False)
        self.value = nn.Linear(width, self.head_dim, bias=False)
        self.out = nn.Linear(heads * self.head_dim, width, bias=False)
        self.modulation = nn.Linear(width, 2 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def keys(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Rotated keys and values, both (B, 1, L, head_dim), of memory (B, L, W)."""
        normed = self.memory_norm(memory)
        key = _rotate(self.key(normed).unsqueeze(1), torch.arange(memory.shape[1], device=memory.device))
        return key, self.value(normed).unsqueeze(1)

    def forward(
        self, actions: Tensor, memory: Tensor, mask: Tensor, keys: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Scale and shift, both (B, T, W), for actions (B, T, W) from memory (B, L, W) with mask (B, L).

        ``keys`` are those of the same memory, if they have been computed before. A row whose memory is all masked
        reads zeros.
        """
        batch, count, _ = actions.shape
        length = memory.shape[1]
        key, value = self.keys(memory) if keys is None else keys
        query = self.query(self.action_norm(actions)).view(batch, count, self.heads, self.head_dim).transpose(1, 2)
        query = _rotate(query, torch.arange(length, length + count, device=actions.device))
        # A finite bias keeps the softmax of an all-masked row finite; its result is then set to zero.
        bias = torch.zeros_like(mask, dtype=query.dtype).masked_fill(~mask, torch.finfo(query.dtype).min / 2)
        read = F.scaled_dot_product_attention(
            query,
            key.expand(-1, self.heads, -1, -1),
            value.expand(-1, self.heads, -1, -1).to(query.dtype),
            attn_mask=bias[:, None, None, :].expand(-1, self.heads, count, -1),
        )
        read = read * mask.any(dim=1).to(read.dtype)[:, None, None, None]
        read = self.out(read.transpose(1, 2).flatten(2))
        scale, shift = self.modulation(read).chunk(2, dim=-1)
        return scale, shift


@dataclass
class MemoryState:
    """What every modulated layer reads during one forward pass: memory at the expert's width, and its mask.

    It is kept until the next pass replaces it, because gradient checkpointing runs layers again in ``backward``. In a
    rollout the layers' keys of this memory are kept as well: all denoising steps of a plan read the same memory.
    """

    memory: Tensor | None = None  # (B, L, W)
    mask: Tensor | None = None  # (B, L) bool
    keys: dict[nn.Module, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def set(self, memory: Tensor, mask: Tensor) -> None:
        """Begin a pass over another memory."""
        self.memory, self.mask = memory, mask
        self.keys.clear()

    def keys_of(self, modulator: MemoryModulator) -> tuple[Tensor, Tensor]:
        """Keys and values of a layer; computed once per memory where no gradients are wanted."""
        assert self.memory is not None
        if torch.is_grad_enabled():
            return modulator.keys(self.memory)
        if modulator not in self.keys:
            self.keys[modulator] = modulator.keys(self.memory)
        return self.keys[modulator]


class ModulatedNorm(nn.Module):
    """LeRobot's norm before an expert layer's feed-forward, followed by the memory's modulation.

    Both of pi0.5's paths (joint training and denoising over cached keys) call ``norm(x, cond=...)`` right before the
    feed-forward and keep the residual outside, so x <- norm(x) * (1 + scale) + shift here touches nothing else.
    """

    def __init__(self, norm: nn.Module, modulator: MemoryModulator, state: MemoryState) -> None:
        super().__init__()
        self.norm = norm
        self.modulator = modulator
        self.state = state

    def forward(self, x: Tensor, cond: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Normalised and modulated x (B, T, W), and LeRobot's gate."""
        normed, gate = self.norm(x, cond=cond)
        if self.state.memory is None or self.state.mask is None:
            return normed, gate
        keys = self.state.keys_of(self.modulator)
        scale, shift = self.modulator(x, self.state.memory, self.state.mask, keys)
        return (normed * (1.0 + scale) + shift).to(normed.dtype), gate


@dataclass
class _Row:
    """History of one environment."""

    last_step: int | None = None
    steps: list[int] = field(default_factory=list)
    tokens: list[Tensor] = field(default_factory=list)  # each (P, D) bfloat16 on the CPU


class RolloutMemory:
    """Histories of the rows of a vector environment, each by its own clock.

    A row starts anew when its step goes back (step 0), and is frozen while its step stays the same (its episode is
    over, or the environment is waiting), whatever the other rows do.
    """

    def __init__(self, frames: int, stride: int) -> None:
        self.frames, self.stride = frames, stride
        self.rows: list[_Row] = []

    def reset(self) -> None:
        """Forget everything."""
        self.rows = []

    def observe(
        self, steps: Sequence[int], encode: Callable[[list[int]], Tensor] | None
    ) -> tuple[list[bool], list[bool]]:
        """Take in one observation per row.

        Args:
            steps: control step of each row since its episode began.
            encode: from row numbers (n,) to their frames' tokens (n, P, D); called once, for the rows that need it.
                None remembers no frames and only follows the rows' clocks.

        Returns:
            Per row: whether a new episode began, and whether the row is frozen.
        """
        if len(self.rows) != len(steps):
            self.rows = [_Row() for _ in steps]
        started, frozen = [], []
        wanted = []
        for number, step in enumerate(steps):
            row = self.rows[number]
            started.append(row.last_step is None or step < row.last_step)
            if started[-1]:
                row = self.rows[number] = _Row()
            frozen.append(row.last_step == step)
            if not frozen[-1] and (step % self.stride == 0 or not row.steps):
                wanted.append(number)
            row.last_step = step
        if wanted and encode is not None:
            for number, tokens in zip(wanted, encode(wanted).to("cpu", torch.bfloat16), strict=True):
                self.rows[number].steps.append(steps[number])
                self.rows[number].tokens.append(tokens)
        return started, frozen

    def gather(self, rows: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Memory of some rows: tokens (n, F, P, D) bfloat16, steps (n, F) int64, mask (n, F) bool, right-padded."""
        return collate_frames(
            [
                ([row.tokens[i] for i in chosen], [row.steps[i] for i in chosen])
                for row in (self.rows[number] for number in rows)
                for chosen in [sample_frames(len(row.steps) - 1, self.frames)]
            ],
            self.frames,
        )


def collate_frames(
    rows: Sequence[tuple[Sequence[Tensor], Sequence[int]]], frames: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Right-pad rows of (frame tokens, each (P, D); control steps) to tokens (B, F, P, D), steps and mask (B, F)."""
    shape = rows[0][0][0].shape
    tokens = torch.zeros(len(rows), frames, *shape, dtype=torch.bfloat16)
    steps = torch.zeros(len(rows), frames, dtype=torch.int64)
    mask = torch.zeros(len(rows), frames, dtype=torch.bool)
    for number, (row_tokens, row_steps) in enumerate(rows):
        count = len(row_steps)
        tokens[number, :count] = torch.stack(list(row_tokens))
        steps[number, :count] = torch.tensor(row_steps)
        mask[number, :count] = True
    return tokens, steps, mask
