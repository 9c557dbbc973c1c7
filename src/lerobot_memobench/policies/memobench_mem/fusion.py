"""How actions read memory tokens: the interface `MemoryFusion`, and its two kinds.

`Modulation` scales and shifts what every layer of the action expert feeds forward (RoboMME's modulator); `Context` puts
memory into the prefix. Shapes: B rows, L memory tokens, W width of the action expert, T action tokens.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, cast

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens

if TYPE_CHECKING:
    from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch

Prefix = tuple[Tensor, Tensor, Tensor]
"""LeRobot's prefix: embeddings (B, N, D), which of them are real (B, N), and where attention blocks begin (B, N)."""
Suffix = tuple[Tensor, Tensor, Tensor, Tensor]
"""The same of the action expert's tokens (B, T, W), and the condition (B, W) of its norms."""


UNREAD = "unread"
"""Attribute of attention modules that learn in one kernel: of how many of the first tokens nobody reads the result."""


class MemoryFusion(ABC):
    """A way by which actions read memory tokens; made once for a model, to which it may add parameters.

    Attributes:
        attends_fused: whether training attends in one kernel (`network.attend_fused`), as a long prefix is quicker.
        tells_reads: whether `watched` can say how much each token was read.
    """

    attends_fused: ClassVar[bool] = False
    tells_reads: ClassVar[bool] = False

    @abstractmethod
    def __init__(self, model: nn.Module, memory_dim: int, expert_dim: int) -> None:
        """Make ``model`` ready: memory tokens are ``memory_dim`` wide, the action expert ``expert_dim``."""

    @abstractmethod
    def hand_over(self, memory: MemoryTokens) -> None:
        """Take the memory, of width d_m, that the next passes read."""

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Return the model's prefix, given LeRobot's.

        Args:
            state: place of the token of the robot's state; None: there is none.
        """
        return prefix

    def suffix(self, suffix: Suffix) -> Suffix:
        """Return the model's suffix, given LeRobot's; the actions stay its last tokens."""
        return suffix

    def attention(self, mask: Tensor) -> Tensor:
        """Return what is added to attention (B, 1, queries, keys), given LeRobot's: 0, or very low where none is paid.

        Queries are the last of the keys: of the prefix, of prefix and actions, or of actions alone.
        """
        return mask

    def read_out(self, states: Tensor) -> None:  # noqa: B027 (most need nothing of it)
        """Take the last states of a prefix (B, N, D)."""

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


@contextmanager
def hooked(modules: Iterable[nn.Module], note: Callable[[Any, Any, Any], None]) -> Iterator[None]:
    """Call ``note(module, inputs, outputs)`` after each pass of some modules, while this lasts."""
    with ExitStack() as hooks:
        for module in modules:
            hooks.callback(module.register_forward_hook(note).remove)
        yield


# -- modulation -------------------------------------------------------------------------------------------------------


_ROPE_BASE = 10_000.0


class RMSNorm(nn.Module):
    """Root-mean-square norm with a learned scale that starts at one (Gemma's form)."""

    def __init__(self, width: int, eps: float = 1e-6) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        """Norm of x (..., W), in float32."""
        x = x.to(torch.float32)
        return x * torch.rsqrt(x.square().mean(dim=-1, keepdim=True) + self.eps) * (1.0 + self.weight)


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Rotary position embedding of x (B, heads, N, d) at positions (N,), halves paired as in Gemma."""
    half = x.shape[-1] // 2
    frequencies = _ROPE_BASE ** -(torch.arange(half, dtype=torch.float32, device=x.device) / half)
    angles = torch.outer(positions.to(torch.float32), frequencies)
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    first, second = x.chunk(2, dim=-1)
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

    def keys(self, memory: MemoryTokens) -> tuple[Tensor, Tensor]:
        """Rotated keys and values, both (B, 1, L, head_dim), of memory of width W."""
        normed = memory.through(self.memory_norm)
        key, value = (rearrange(normed.through(linear).rows(), "b l d -> b 1 l d") for linear in (self.key, self.value))
        return rotate(key, torch.arange(key.shape[2], device=key.device)), value

    def forward(
        self, actions: Tensor, memory: MemoryTokens, keys: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Scale and shift, both (B, T, W), for actions (B, T, W) from memory of width W.

        ``keys`` are those of the same memory, if they have been computed before. A row whose memory is all masked
        reads zeros.
        """
        mask, count = memory.mask, actions.shape[1]
        key, value = self.keys(memory) if keys is None else keys
        query, bias = self._queries(actions, mask)
        read = F.scaled_dot_product_attention(
            query,
            repeat(key, "b 1 l d -> b h l d", h=self.heads),
            repeat(value, "b 1 l d -> b h l d", h=self.heads).to(query.dtype),
            attn_mask=repeat(bias, "b l -> b h t l", h=self.heads, t=count),
        )
        read = read * rearrange(mask.any(dim=1).to(read.dtype), "b -> b 1 1 1")
        read = self.out(rearrange(read, "b h t d -> b t (h d)"))
        scale, shift = self.modulation(read).chunk(2, dim=-1)
        return scale, shift

    def _queries(self, actions: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rotated queries of actions (B, heads, T, head_dim), and what is added to their scores (B, L)."""
        count, length = actions.shape[1], mask.shape[1]
        query = rearrange(self.query(self.action_norm(actions)), "b t (h d) -> b h t d", h=self.heads)
        query = rotate(query, torch.arange(length, length + count, device=actions.device))
        # A finite bias keeps the softmax of an all-masked row finite; its result is then set to zero.
        bias = torch.zeros_like(mask, dtype=query.dtype).masked_fill(~mask, torch.finfo(query.dtype).min / 2)
        return query, bias

    def weights(self, actions: Tensor, memory: MemoryTokens, keys: tuple[Tensor, Tensor]) -> Tensor:
        """Return how much `forward` reads of each memory token (B, L): the mean over heads and actions."""
        query, bias = self._queries(actions, memory.mask)
        scores = query @ keys[0].transpose(-1, -2) * self.head_dim**-0.5 + rearrange(bias, "b l -> b 1 1 l")
        return scores.softmax(dim=-1).mean(dim=(1, 2)) * memory.mask


@dataclass
class SharedMemory:
    """What every modulated layer reads during one forward pass: memory at the expert's width.

    It is kept until the next pass replaces it, because gradient checkpointing runs layers again in ``backward``. In a
    rollout the layers' keys of this memory are kept as well: all denoising steps of a plan read the same memory.
    """

    memory: MemoryTokens | None = None
    keys: dict[nn.Module, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def set(self, memory: MemoryTokens) -> None:
        """Begin a pass over another memory."""
        self.memory = memory
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

    def __init__(self, norm: nn.Module, modulator: MemoryModulator, state: SharedMemory) -> None:
        super().__init__()
        self.norm = norm
        self.modulator = modulator
        self.state = state

    def forward(self, x: Tensor, cond: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Normalised and modulated x (B, T, W), and LeRobot's gate."""
        normed, gate = self.norm(x, cond=cond)
        if self.state.memory is None:
            return normed, gate
        keys = self.state.keys_of(self.modulator)
        scale, shift = self.modulator(x, self.state.memory, keys)
        return (normed * (1.0 + scale) + shift).to(normed.dtype), gate


class Modulation(MemoryFusion):
    """Memory at the expert's width, and a modulated norm in each of the expert's layers.

    Wrapped norms are one level deeper than in plain pi0.5.
    """

    tells_reads = True

    def __init__(self, model: PI05Pytorch, memory_dim: int, expert_dim: int) -> None:
        self.model, self.shared = model, SharedMemory()
        model.memory_to_expert = nn.Linear(memory_dim, expert_dim)
        for layer in model.paligemma_with_expert.gemma_expert.model.layers:
            layer.post_attention_layernorm = ModulatedNorm(
                layer.post_attention_layernorm, MemoryModulator(expert_dim), self.shared
            )

    def hand_over(self, memory: MemoryTokens) -> None:
        """Begin a pass over this memory in every layer."""
        self.shared.set(memory.through(cast(nn.Linear, self.model.memory_to_expert)))

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
        with hooked(self.modulators, lambda modulator, inputs, _: found.append(modulator.weights(*inputs))):
            yield found

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

    def __init__(self, model: PI05Pytorch, memory_dim: int, expert_dim: int) -> None:
        self.model, self.memory = model, cast("MemoryTokens | None", None)

    def hand_over(self, memory: MemoryTokens) -> None:
        """Keep this memory for the next prefix."""
        self.memory = memory

    def prefix(self, prefix: Prefix, state: int | None = None) -> Prefix:
        """Append the memory, which attends and is attended like images and language."""
        if self.memory is None:
            return prefix
        embeddings, real, blocks = prefix
        mask = self.memory.mask
        return (
            torch.cat([embeddings, self.memory.rows().to(embeddings.dtype)], dim=1),
            torch.cat([real, mask], dim=1),
            torch.cat([blocks, torch.zeros_like(mask)], dim=1),
        )

    @contextmanager
    def watched(self) -> Iterator[list[Tensor]]:
        """Yield how much actions attend to each token: a share of all that they attend to."""
        found: list[Tensor] = []

        def note(attention: Any, inputs: Any, outputs: tuple[Tensor, Tensor]) -> None:
            assert self.memory is not None
            weights, length = outputs[1], self.memory.mask.shape[1]  # (B, heads, T, prefix and T), memory at its end
            actions = weights.shape[2]
            found.append(weights[..., -actions - length : -actions].mean(dim=(1, 2)))

        with hooked([layer.self_attn for layer in self.model.paligemma_with_expert.gemma_expert.model.layers], note):
            yield found
