"""How actions read memory tokens: the interface `MemoryFusion`, and its two kinds.

`Modulation` scales and shifts what every layer of the action expert feeds forward (RoboMME's modulator); `Context` puts
memory into the prefix. Shapes: B rows, L memory tokens, W width of the action expert, T action tokens.
"""

from __future__ import annotations

import functools
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, cast

import torch
from einops import rearrange
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.layers import attend, hidden, rms_norm, rotary, rotate
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens


class Prefix(NamedTuple):
    """What actions are planned from.

    Attributes:
        tokens: (B, N, D). real: (B, N), which of them are no padding.
        attends: (B, N, N) bool, which (last) of them each (first) attends to; None: all to all that are real.
        unread: how many of the first ones actions do not attend to.
        asked: the tokens whose last states are asked for by `MemoryFusion.read_out`; None: of none.
    """

    tokens: Tensor
    real: Tensor
    attends: Tensor | None = None
    unread: int = 0
    asked: slice | None = None

    def joined(self, tokens: Tensor, real: Tensor) -> Prefix:
        """Return it with more tokens behind, as all attend to."""
        more = tokens.to(self.tokens.dtype)
        return Prefix(torch.cat([self.tokens, more], dim=1), torch.cat([self.real, real], dim=1))


class MemoryFusion(ABC):
    """A way by which actions read memory tokens; made once for a model, to which it may add parameters.

    Attributes:
        tells_reads: whether `watched` can say how much each token was read.
    """

    tells_reads: ClassVar[bool] = False

    @abstractmethod
    def __init__(self, model: nn.Module, memory_dim: int, expert_dim: int) -> None:
        """Make ``model`` ready: memory tokens are ``memory_dim`` wide, the action expert ``expert_dim``."""

    @abstractmethod
    def hand_over(self, memory: MemoryTokens) -> None:
        """Take the memory, of width d_m, that the next passes read."""

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Return the model's prefix, given pi0.5's.

        Args:
            state: place of the token of the robot's state; None: there is none.
        """
        return prefix

    def actions(self, tokens: Tensor) -> Tensor:
        """Return the action expert's tokens (B, T, W), given pi0.5's; the actions stay the last ones."""
        return tokens

    def condition(self, condition: Tensor) -> Tensor:
        """Return the condition (..., B, W) of the expert's norms, given pi0.5's."""
        return condition

    def read_out(self, states: Tensor) -> None:  # noqa: B027 (most need nothing of it)
        """Take the last states (B, n, D) of the prefix's tokens that it asked for."""

    def made(self, states: Tensor) -> None:  # noqa: B027
        """Take the expert's last states (B, T, W)."""

    def outputs(self) -> dict[str, Tensor]:
        """Return what the last pass made beside actions, for `MemoryMechanism.losses`."""
        return {}

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield a list to which passes add meanwhile how much they read of each token, (B, L) per layer."""
        yield []

    def owns(self, name: str) -> bool:
        """Say whether a parameter of the model is this fusion's, and no part of pi0.5."""
        return False

    def place_of(self, name: str) -> str:
        """Return the name in this model of a parameter of plain pi0.5."""
        return name


# -- modulation -------------------------------------------------------------------------------------------------------


_ROPE_BASE = 10_000.0


class RMSNorm(nn.Module):
    """Root-mean-square norm with a learned scale that starts at one (Gemma's form)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Norm of x (..., W), in float32."""
        return rms_norm(x) * (1.0 + self.weight)


@functools.lru_cache(maxsize=64)
def _places(begin: int, count: int, width: int, device: torch.device) -> Tensor:
    """Return the rotations of ``count`` positions from ``begin`` on, for vectors of this width."""
    with torch.inference_mode(False):  # a training may use them after a rollout
        frequencies = _ROPE_BASE ** -(torch.arange(width // 2, dtype=torch.float32, device=device) / (width // 2))
        return rotary(torch.arange(begin, begin + count, device=device), frequencies)


def rotate_from(x: Tensor, begin: int) -> Tensor:
    """Rotary position embedding of x (..., N, d), whose positions are ``begin``, ``begin`` + 1, ..."""
    places = _places.__wrapped__ if torch.compiler.is_compiling() else _places  # else torch warns of the cache
    return rotate(x, places(begin, x.shape[-2], x.shape[-1], x.device))


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

    def keys(self, memory: MemoryTokens) -> tuple[Tensor, Tensor]:
        """Rotated keys and values, both (B, L, head_dim), of memory of width W."""
        normed = memory.through(self.memory_norm)
        key, value = (normed.through(linear).rows() for linear in (self.key, self.value))
        return rotate_from(key, 0), value

    def forward(
        self, actions: Tensor, memory: MemoryTokens, keys: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Scale and shift, both (B, T, W), for actions (B, T, W) from memory of width W.

        ``keys`` are those of the same memory, if they have been computed before. A row whose memory is all masked
        reads zeros.
        """
        return self.read(rms_norm(actions), memory, self.keys(memory) if keys is None else keys)

    def read(
        self, normed: Tensor, memory: MemoryTokens, keys: tuple[Tensor, Tensor], found: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Do as `forward`, of actions whose mean square is one; add to ``found`` how much is read, (B, L)."""
        weights: list[Tensor] | None = None if found is None else []
        query = rearrange(self.query(normed * (1.0 + self.action_norm.weight)), "b t (h d) -> b h t d", h=self.heads)
        query = rotate_from(query, memory.mask.shape[1]).transpose(1, 2)
        # A finite bias keeps the softmax of an all-masked row finite; its result is then set to zero.
        read = attend(query, keys[0], keys[1].to(query.dtype), hidden(memory.mask)[:, None], weights)
        if found is not None and weights is not None:
            found.append(weights[0].mean(dim=(1, 2)) * memory.mask)
        read = read * memory.mask.any(dim=1)[:, None, None]
        scale, shift = self.modulation(self.out(read)).chunk(2, dim=-1)
        return scale, shift


@dataclass
class SharedMemory:
    """What every modulated layer reads during one forward pass: memory at the expert's width.

    It is kept until the next pass replaces it, because gradient checkpointing runs layers again in ``backward``. In a
    rollout the layers' keys of this memory are kept as well: all denoising steps of a plan read the same memory.

    Attributes:
        found: takes how much of each token each layer reads, where somebody looks.
    """

    memory: MemoryTokens | None = None
    keys: dict[nn.Module, tuple[Tensor, Tensor]] = field(default_factory=dict)
    found: list[Tensor] | None = None

    def set(self, memory: MemoryTokens, modulators: Iterable[MemoryModulator] = ()) -> None:
        """Begin a pass over another memory; the keys of these are made once where no gradients are wanted."""
        self.memory = memory
        self.keys = {} if torch.is_grad_enabled() else {one: one.keys(memory) for one in modulators}

    def keys_of(self, modulator: MemoryModulator) -> tuple[Tensor, Tensor]:
        """Keys and values of a layer."""
        assert self.memory is not None
        return self.keys[modulator] if modulator in self.keys else modulator.keys(self.memory)


class ModulatedNorm(nn.Module):
    """LeRobot's norm before an expert layer's feed-forward, followed by the memory's modulation.

    The residual stays outside, so x <- norm(x) * (1 + scale) + shift here touches nothing else.
    """

    def __init__(self, norm: nn.Module, modulator: MemoryModulator, state: SharedMemory) -> None:
        super().__init__()
        self.norm = norm
        self.modulator = modulator
        self.state = state

    def forward(self, x: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised and modulated x (B, T, W), and the norm's gate (B, 1, W).

        Args:
            modulation: (B, 1, 3 W), scale, shift and gate of the norm itself.
        """
        scale, shift, gate = modulation.float().chunk(3, dim=-1)
        normed = rms_norm(x)
        made = torch.addcmul(shift, normed, 1 + scale)
        if self.state.memory is not None:
            keys = self.state.keys_of(self.modulator)
            scale, shift = self.modulator.read(normed, self.state.memory, keys, self.state.found)
            made = torch.addcmul(shift, made, 1 + scale)
        return made.to(x.dtype), gate.to(x.dtype)


class Modulation(MemoryFusion):
    """Memory at the expert's width, and a modulated norm in each of the expert's layers.

    Wrapped norms are one level deeper than in plain pi0.5.
    """

    tells_reads = True

    def __init__(self, model: Any, memory_dim: int, expert_dim: int) -> None:
        self.model, self.shared = model, SharedMemory()
        model.memory_to_expert = nn.Linear(memory_dim, expert_dim)
        for layer in model.paligemma_with_expert.gemma_expert.model.layers:
            layer.post_attention_layernorm = ModulatedNorm(
                layer.post_attention_layernorm, MemoryModulator(expert_dim), self.shared
            )

    def hand_over(self, memory: MemoryTokens) -> None:
        """Begin a pass over this memory in every layer."""
        self.shared.set(memory.through(cast(nn.Linear, self.model.memory_to_expert)), self.modulators)

    @property
    def modulators(self) -> list[MemoryModulator]:
        """Those of the expert's layers."""
        layers = self.model.paligemma_with_expert.gemma_expert.model.layers
        return [layer.post_attention_layernorm.modulator for layer in layers]

    def open_gate(self) -> None:
        """Draw what starts at zero, so that memory gets gradients from the first update on."""
        for modulator in self.modulators:
            modulator.modulation.reset_parameters()

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield how much the modulators look at each token."""
        found: list[Tensor] = []
        self.shared.found = found
        try:
            yield found
        finally:
            self.shared.found = None

    def owns(self, name: str) -> bool:
        """Say whether a parameter is the projection's or a modulator's."""
        return name.startswith("memory_to_expert.") or ".modulator." in name

    def place_of(self, name: str) -> str:
        """Return a wrapped norm's parameters under their name here."""
        if ".gemma_expert." not in name:
            return name
        return re.sub(r"post_attention_layernorm\.(dense|weight)", r"post_attention_layernorm.norm.\1", name)


def plain_name(name: str) -> str:
    """Return the name in plain pi0.5 of a parameter of any fusion's model."""
    return name.replace("post_attention_layernorm.norm.", "post_attention_layernorm.")


# -- context ----------------------------------------------------------------------------------------------------------


class Context(MemoryFusion):
    """The whole prefix and the actions attend to memory tokens; nothing is added to the model."""

    tells_reads = True

    def __init__(self, model: Any, memory_dim: int, expert_dim: int) -> None:
        self.model, self.memory = model, cast("MemoryTokens | None", None)

    def hand_over(self, memory: MemoryTokens) -> None:
        """Keep this memory for the next prefix."""
        self.memory = memory

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Append the memory, which attends and is attended like images and language."""
        if self.memory is None:
            return prefix
        return prefix.joined(self.memory.rows(), self.memory.mask)

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield how much actions attend to each token: a share of all that they attend to."""
        assert self.memory is not None
        length = self.memory.mask.shape[1]
        found: list[Tensor] = []
        with self.model.paligemma_with_expert.watched() as (_, of_actions):
            yield found
        for weights in of_actions:  # (B, heads, T, prefix and T), memory at the prefix's end
            actions = weights.shape[2]
            found.append(weights[..., -actions - length : -actions].mean(dim=(1, 2)))
