"""How actions read memory tokens (`MemoryPass`), and the operations of pi0.5's layers that this needs.

Shapes: B rows, L memory tokens, W width of the action expert, T action tokens, N queries, M keys, H heads of width d.
"""

from __future__ import annotations

import functools
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens

# -- operations -------------------------------------------------------------------------------------------------------


def rms_norm(x: Tensor) -> Tensor:
    """Return x (..., W) with a mean square of one, in float32."""
    return F.rms_norm(x.to(torch.float32), x.shape[-1:], eps=1e-6)


def scaled_and_shifted(normed: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
    """Return normed (B, N, W) scaled and shifted, and the gate (B, 1, W), by scale, shift and gate (B, 1, 3 W)."""
    scale, shift, gate = modulation.chunk(3, dim=-1)
    return torch.addcmul(shift.float(), normed, 1 + scale.float()), gate


def modulated(x: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
    """Return the adaptive norm of x (B, N, W), given scale, shift and gate (B, 1, 3 W), and the gate (B, 1, W)."""
    normed, gate = scaled_and_shifted(rms_norm(x), modulation)
    return normed.to(x.dtype), gate.to(x.dtype)


def rotary(positions: Tensor, frequencies: Tensor) -> Tensor:
    """Return cosine and sine (..., N, d / 2, 2) of positions (..., N) at each frequency (d / 2,)."""
    angles = positions.unsqueeze(-1).to(torch.float32) * frequencies.to(torch.float32)
    return torch.stack([angles.cos(), angles.sin()], dim=-1)


def rotate(x: Tensor, rotations: Tensor) -> Tensor:
    """Return x (..., d) rotated by cosines and sines (..., d / 2, 2); halves are paired as in Gemma.

    The result interleaves the two numbers of each pair, in queries and keys alike, which keeps their products.
    """
    first, second = x.chunk(2, dim=-1)
    cos, sin = rotations.to(x.dtype).unbind(-1)
    return torch.stack([first * cos - second * sin, second * cos + first * sin], dim=-1).flatten(-2)


def hidden(real: Tensor) -> Tensor:
    """Return the bias of attention scores: 0 for tokens that are read (``real``), very low for all others."""
    # Half of the minimum stays finite when a score is added to it.
    return torch.where(real, 0.0, torch.finfo(torch.float32).min / 2)


def attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor, collected: list[Tensor] | None = None) -> Tensor:
    """Return the attention output (B, N, H d) of queries (B, N, H, d) over keys and values (B, M, d).

    ``bias``, as of `hidden`, is (B, 1, M), or (B, N, M) if it differs between queries. The attention weights
    (B, H, N, M) are appended to ``collected``.
    """
    rows, count, heads, width = query.shape
    # All heads share keys and values, so heads are further queries of one product.
    flat, bias = query.reshape(rows, count * heads, width), bias.to(query.dtype)
    if bias.shape[1] > 1:
        bias = bias.repeat_interleave(heads, dim=1)
    # On a CPU a plan has few queries: stored scores are faster then, and actions of recorded evaluations stay the same.
    if collected is None and (query.is_cuda or torch.is_grad_enabled()):
        mask = bias.expand(-1, count * heads, -1)[:, None]
        read = F.scaled_dot_product_attention(flat[:, None], key[:, None], value[:, None], mask)
        return read.view(rows, count, heads * width)
    scores = torch.baddbmm(bias, flat, key.transpose(1, 2), alpha=width**-0.5)
    weights = scores.softmax(dim=-1, dtype=torch.float32)
    if collected is not None:
        collected.append(weights.unflatten(1, (count, heads)).transpose(1, 2))
    return torch.bmm(weights.to(value.dtype), value).view(rows, count, heads * width)


# -- the interface ----------------------------------------------------------------------------------------------------


class Prefix(NamedTuple):
    """The tokens from which actions are planned.

    Attributes:
        tokens: (B, N, D). real: (B, N) bool, False for padding.
        instruction: (B, W), added to the condition of the expert's norms; None: no such term.
        attends: (B, N, N) bool, whether a token (first N) attends to another (last N); None: to all real tokens.
        unread: number of leading tokens to which actions do not attend.
        asked: tokens whose last states are passed to `MemoryPass.read_out`; None: no tokens.
    """

    tokens: Tensor
    real: Tensor
    instruction: Tensor | None = None
    attends: Tensor | None = None
    unread: int = 0
    asked: slice | None = None

    def joined(self, tokens: Tensor, real: Tensor) -> Prefix:
        """Return a prefix with appended tokens and full attention; other attributes get their defaults."""
        more = tokens.to(self.tokens.dtype)
        return Prefix(torch.cat([self.tokens, more], dim=1), torch.cat([self.real, real], dim=1), self.instruction)


class MemoryPass:
    """The memory in one pass of the model. This base class is plain pi0.5, which reads no memory.

    Attributes:
        parts: names of the modules that `extend` adds to the model, each with a dot.
        watches: the parts of the model (``prefix``, ``actions``, ``memory``) whose attention `attention_shares` needs;
            none if it does not report shares.
        outputs: results of the pass other than actions, for `MemoryMechanism.losses`.
        attention: part -> the attention weights of its layers, if the pass is ``watched``; else empty.
    """

    parts: ClassVar[tuple[str, ...]] = ()
    watches: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def extend(cls, model: Any, memory_dim: int, expert_dim: int) -> None:
        """Add modules to ``model``: memory tokens are ``memory_dim`` wide, the action expert ``expert_dim``."""

    def __init__(self, model: Any = None, memory: MemoryTokens | None = None, watched: bool = False) -> None:
        self.model = model
        self.outputs: dict[str, Tensor] = {}
        self.attention: dict[str, list[Tensor]] = {part: [] for part in self.watches} if watched else {}

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Return the model's prefix, given pi0.5's and the index of the token of the robot's state (None: no token)."""
        return prefix

    def actions(self, tokens: Tensor) -> Tensor:
        """Return the action expert's tokens (B, T, W), given pi0.5's; the actions stay the last ones."""
        return tokens

    def condition(self, condition: Tensor) -> Tensor:
        """Return the condition (..., B, W) of the expert's norms, given pi0.5's."""
        return condition

    def feed_forward(self, layer: int, normed: Tensor, inputs: Tensor) -> Tensor:
        """Return the input (B, T, W) of a layer's feed-forward, given pi0.5's.

        ``normed`` (B, T, W) are the tokens at a mean square of one, before pi0.5's scale and shift.
        """
        return inputs

    def read_out(self, states: Tensor) -> None:
        """Receive the last states (B, n, D) of the tokens `Prefix.asked`."""

    def expert_states(self, states: Tensor) -> None:
        """Receive the expert's last states (B, T, W)."""

    def attention_shares(self) -> list[Tensor]:
        """Return the share of attention on each memory token in a watched pass, (B, L) per layer."""
        return []


# -- modulation -------------------------------------------------------------------------------------------------------


_ROPE_BASE = 10_000.0


class RMSNorm(nn.Module):
    """Root-mean-square norm with a learned scale that starts at one, as in Gemma."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return rms_norm(x) * (1.0 + self.weight)


@functools.lru_cache(maxsize=64)
def _places(begin: int, count: int, width: int, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # training may use the cached tensors after a rollout
        frequencies = _ROPE_BASE ** -(torch.arange(width // 2, dtype=torch.float32, device=device) / (width // 2))
        return rotary(torch.arange(begin, begin + count, device=device), frequencies)


def rotate_from(x: Tensor, begin: int) -> Tensor:
    """Apply rotary position embedding to x (..., N, d) at positions ``begin``, ``begin`` + 1, ..."""
    return rotate(x, _places(begin, x.shape[-2], x.shape[-1], x.device))


class MemoryModulator(nn.Module):
    """Cross-attention of action tokens to memory, which returns scale and shift of one feed-forward's input.

    Multi-query attention: ``heads`` query heads of width W / heads, one key-value head; rotary positions 0 ... L-1 for
    memory, L ... L+T-1 for actions. The last Linear starts at zero, so training starts from plain pi0.5.
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

    def keys(self, memory: MemoryTokens) -> tuple[Tensor, Tensor]:
        """Return rotated keys and values, both (B, L, head_dim), of memory of width W."""
        normed = memory.map(self.memory_norm)
        key, value = (normed.map(linear).rows() for linear in (self.key, self.value))
        return rotate_from(key, 0), value

    def forward(
        self, normed: Tensor, memory: MemoryTokens, keys: tuple[Tensor, Tensor], collected: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return scale and shift, both (B, T, W), for actions (B, T, W) whose mean square is one.

        The attention on each memory token (B, L) is appended to ``collected``.
        """
        weights = None if collected is None else list[Tensor]()
        query = rearrange(self.query(normed * (1.0 + self.action_norm.weight)), "b t (h d) -> b h t d", h=self.heads)
        query = rotate_from(query, memory.mask.shape[1]).transpose(1, 2)
        # A finite bias keeps the softmax of a fully masked row finite; the row then reads zeros.
        read = attend(query, keys[0], keys[1].to(query.dtype), hidden(memory.mask)[:, None], weights)
        if collected is not None and weights is not None:
            collected.append(weights[0].mean(dim=(1, 2)) * memory.mask)
        read = read * memory.mask.any(dim=1)[:, None, None]
        scale, shift = self.modulation(self.out(read)).chunk(2, dim=-1)
        return scale, shift


class ModulationPass(MemoryPass):
    """RoboMME's modulator: scale and shift the input of each feed-forward layer of the expert, not the residual."""

    parts = ("memory_to_expert.", "modulators.")
    watches = ("memory",)

    @classmethod
    def extend(cls, model: Any, memory_dim: int, expert_dim: int) -> None:
        model.memory_to_expert = nn.Linear(memory_dim, expert_dim)
        layers = model.paligemma_with_expert.gemma_expert.model.layers
        model.modulators = nn.ModuleList(MemoryModulator(expert_dim) for _ in layers)

    def __init__(self, model: Any, memory: MemoryTokens, watched: bool = False) -> None:
        super().__init__(model, memory, watched)
        self.memory = memory.map(model.memory_to_expert)
        # All denoising steps of a plan share their keys. In training each layer runs once, or twice by checkpointing.
        self.keys = None if torch.is_grad_enabled() else [each.keys(self.memory) for each in model.modulators]

    def feed_forward(self, layer: int, normed: Tensor, inputs: Tensor) -> Tensor:
        modulator = self.model.modulators[layer]
        keys = modulator.keys(self.memory) if self.keys is None else self.keys[layer]
        scale, shift = modulator(normed, self.memory, keys, self.attention.get("memory"))
        return torch.addcmul(shift, inputs, 1 + scale)

    def attention_shares(self) -> list[Tensor]:
        return self.attention["memory"]


# -- context ----------------------------------------------------------------------------------------------------------


class ContextPass(MemoryPass):
    """A pass whose prefix ends with the memory, which attends and is attended to like images and language."""

    watches = ("actions",)

    def __init__(self, model: Any, memory: MemoryTokens, watched: bool = False) -> None:
        super().__init__(model, memory, watched)
        self.memory = memory

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        return prefix.joined(self.memory.rows(), self.memory.mask)

    def attention_shares(self) -> list[Tensor]:
        length = self.memory.mask.shape[1]
        # (B, heads, T, prefix and T), with memory at the prefix's end
        return [
            weights[..., -weights.shape[2] - length : -weights.shape[2]].mean(dim=(1, 2))
            for weights in self.attention["actions"]
        ]
