"""Perceptual-cognitive memory bank (MemoryVLA): the present looks into a bounded list of timed entries, and joins it.

The variant of Dexbotic's MemoryVLA+, in two streams: perceptual, the P tokens of a frame, and cognitive, one token. A
frame's tokens retrieve from their stream's entries, are fused with what they find by a gate, and become an entry; where
there are too many, the two most similar neighbours become one. An action chunk reads the present, fused in the same
way.

What differs: the cognitive token of the source is the language model's last prompt state, which would be a pass of the
whole backbone for each frame; here one layer reads the frame's tokens and the words by the mean word. The perceptual
stream's squeeze-excite bottleneck is a Linear to the same 256 channels, behind the policy's own pooling. The fused
tokens are memory tokens, read as the policy's ``memory_fusion`` says, and no condition and cross-attention of a
diffusion transformer. Frames are written at a stride, not where chunks begin, so a chunk that begins at such a step
finds its own frame among the entries. Times are control steps everywhere; the source trains by frames and acts by calls.
There is one bank per row, where the source shares one, and no dropout, which the source applies while it acts too.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize, rms_norm

from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
    State,
)

PERCEPTUAL_WIDTH, HEADS, BLOCKS = 256, 4, 2
WAVES, TIME_BASE = 128, 10_000.0


@dataclass
class BankSettings:
    """Settings of `Bank`.

    Attributes:
        length: entries that each stream keeps.
        time_codes: whether the present can tell when an entry was made.
    """

    length: int = 16
    time_codes: bool = True

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"length={self.length} must be at least 1")


class Bank(MemoryMechanism):
    """Two streams of at most ``length`` entries. No gradient passes through what has been written.

    State: of each stream ``<stream>`` (R, length, N, d) and ``<stream>_steps`` (R, length), its entries and their
    control steps (means, where entries were merged), oldest first; ``count`` (R,), how many there are.
    """

    Settings = BankSettings
    stride = 16
    capacity = 16
    asks_present = True
    asks_words = True

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: BankSettings) -> None:
        super().__init__(spec, pool, settings)
        self.capacity = settings.length
        width = min(PERCEPTUAL_WIDTH, spec.dim)
        self.reduce = nn.Linear(spec.dim, width)
        self.summary = Lookup(spec.dim)
        self.perceptual = Stream(width, spec.width, settings.time_codes)
        self.cognitive = Stream(spec.dim, spec.width, settings.time_codes)

    def _streams(self) -> dict[str, Stream]:
        return {"perceptual": self.perceptual, "cognitive": self.cognitive}

    def _present(self, tokens: Tensor, query: Query | None) -> dict[str, Tensor]:
        """Return the present of each stream (R, N, d), of a frame's tokens (R, P, D) and the words."""
        assert query is not None
        assert query.words is not None
        assert query.real is not None
        tokens, words = (rms_norm(of.float(), of.shape[-1:], eps=1e-6) for of in (tokens, query.words))
        weights = query.real.unsqueeze(-1).float()
        mean = (words * weights).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True).clamp(min=1)
        hidden = torch.cat([torch.zeros_like(tokens[..., 0], dtype=torch.bool), ~query.real], dim=1)
        both = torch.cat([tokens, words], dim=1)
        return {"perceptual": self.reduce(tokens), "cognitive": self.summary(mean, both, both, hidden)[0]}

    def init(self, rows: int) -> State:
        """Return empty banks."""
        sizes = {"perceptual": (self.spec.tokens, self.reduce.out_features), "cognitive": (1, self.spec.dim)}
        like = self.reduce.weight
        state = {name: like.new_zeros(rows, self.capacity, *size, dtype=torch.float32) for name, size in sizes.items()}
        state |= {f"{name}_steps": like.new_zeros(rows, self.capacity, dtype=torch.float32) for name in sizes}
        return state | {"count": torch.zeros(rows, dtype=torch.int64, device=like.device)}

    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query | None = None) -> State:
        """Fuse the frame with what it finds, and make an entry of it."""
        count, made = state["count"], {"count": (state["count"] + 1).clamp(max=self.capacity)}
        for name, present in self._present(tokens, query).items():
            entries, steps = state[name], state[f"{name}_steps"]
            fused, _ = self._streams()[name].fuse(present, entries, steps, count, step)
            made[name], made[f"{name}_steps"] = append(entries, steps, count, fused.detach(), step)
        return made

    def read(self, state: State, query: Query | None = None) -> MemoryTokens:
        """Return the present of both streams, fused with what it finds: P perceptual tokens and a cognitive one."""
        assert query is not None
        assert query.tokens is not None
        read, found = [], []
        for name, present in self._present(query.tokens, query).items():
            stream = self._streams()[name]
            fused, weights = stream.fuse(present, state[name], state[f"{name}_steps"], state["count"])
            read.append(stream.out(fused))
            found.append(weights)
        each = torch.cat(read, dim=1)
        return MemoryTokens(each, torch.ones_like(each[..., 0], dtype=torch.bool))


class Lookup(nn.Module):
    """Cross-attention and a feed-forward layer, each added and then normalised; without an output projection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, asking: Tensor, keys: Tensor, values: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return tokens (R, N, d) after a look at M others, and how much each head looked at each: (R, heads N, M).

        Keys and values (R, M, d) are not projected themselves: the query is, by the keys' weights too, and then the sum
        of values. The products are the same, and there are tens of times more keys than queries.

        Args:
            hidden: (R, M) bool, which of them are not looked at.
        """
        of_key, of_value = (one.weight.unflatten(0, (HEADS, -1)) for one in (self.key, self.value))
        query = torch.einsum("rnhe,hed->rhnd", self.query(asking).unflatten(2, (HEADS, -1)), of_key).flatten(1, 2)
        scores = torch.bmm(query, keys.transpose(1, 2)) * of_key.shape[1] ** -0.5
        weights = scores.masked_fill(hidden[:, None], -torch.inf).softmax(dim=2)
        found = torch.bmm(weights, values).unflatten(1, (HEADS, -1))
        asking = self.norms[0](asking + torch.einsum("rhnd,hed->rnhe", found, of_value).flatten(2))
        return self.norms[1](asking + self.mlp(asking)), weights


class Stream(nn.Module):
    """Retrieval from the entries of a stream, the gate of what is found, and the projection to memory tokens."""

    def __init__(self, width: int, memory_width: int, time_codes: bool) -> None:
        super().__init__()
        self.time: nn.Module | None = None
        if time_codes:
            self.time = nn.Sequential(nn.Linear(2 * WAVES, width), nn.SiLU(), nn.Linear(width, width, bias=False))
        self.blocks = nn.ModuleList(Lookup(width) for _ in range(BLOCKS))
        self.gate = nn.Linear(2 * width, width)
        nn.init.normal_(self.gate.weight, std=1e-3)
        nn.init.normal_(self.gate.bias, std=1e-3)
        self.out = nn.Linear(width, memory_width)

    def fuse(
        self, present: Tensor, entries: Tensor, steps: Tensor, count: Tensor, now: Tensor | None = None
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the present fused with what it finds, and how much of that was found in each entry.

        Args:
            present: (R, N, d). entries: (R, L, N, d), of which the first ``count`` (R,) are real. steps: (R, L).
            now: (R,) the present's step, which counts where there are no entries and the present finds itself.

        Returns:
            (R, N, d), and (R, N, L), which sums to one.
        """
        slots = torch.arange(entries.shape[1] + 1, device=count.device)
        hidden = torch.where(slots < slots[-1], slots >= count[:, None], count[:, None] > 0)
        values = torch.cat([entries, present[:, None]], dim=1)
        keys = values
        if self.time is not None:
            now = torch.zeros_like(steps[:, 0]) if now is None else now.to(steps.dtype)
            keys = values + self.time(waves(torch.cat([steps, now[:, None]], dim=1)))[:, :, None]
        keys, values = keys.flatten(1, 2), values.flatten(1, 2)
        hidden = hidden.repeat_interleave(present.shape[1], dim=1)
        found, looked = present, []
        for block in self.blocks:
            found, weights = block(found, keys, values, hidden)
            looked.append(weights)
        gate = self.gate(torch.cat([present, found], dim=2)).sigmoid()
        return found.lerp(present, gate), looked


def waves(steps: Tensor) -> Tensor:
    """Return cosines, then sines, of control steps (...) at frequencies from 1 down to nearly 1/TIME_BASE: (..., 256)."""
    frequencies = TIME_BASE ** -(torch.arange(WAVES, dtype=torch.float32, device=steps.device) / WAVES)
    angles = steps.unsqueeze(-1) * frequencies
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def append(entries: Tensor, steps: Tensor, count: Tensor, new: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
    """Return entries and steps with a new entry; in a full row the two most similar neighbours become their mean.

    Similarity is the cosine of the tokens at the same place, averaged over the places.

    Args:
        entries: (R, L, N, d). steps: (R, L). count: (R,) real ones. new: (R, N, d). now: (R,), its step.
    """
    length = entries.shape[1]
    entries, steps = torch.cat([entries, new[:, None]], dim=1), torch.cat([steps, now[:, None].to(steps.dtype)], dim=1)
    unit = normalize(entries, dim=-1)
    pair = (unit[:, :-1] * unit[:, 1:]).sum(dim=-1).mean(dim=-1).argmax(dim=1)[:, None]  # it and the one behind it
    slots, full, rows = torch.arange(length, device=count.device), (count == length)[:, None], count[:, None]
    kept = torch.where(full, slots + (slots > pair), torch.where(slots == rows, length, slots))
    other = kept + (full & (slots == pair))
    row = torch.arange(len(entries), device=count.device)[:, None]
    return (entries[row, kept] + entries[row, other]) / 2, (steps[row, kept] + steps[row, other]) / 2
