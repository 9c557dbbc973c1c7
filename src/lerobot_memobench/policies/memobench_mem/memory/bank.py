"""Perceptual-cognitive memory bank (MemoryVLA): the present looks into a bounded list of timed entries, and joins it.

The variant of Dexbotic's MemoryVLA+, in two streams: perceptual, the P tokens of a frame, and cognitive, one token. A
frame's tokens retrieve from their stream's entries, are fused with what they find by a gate, and become an entry; where
there are too many, the two most similar neighbours become one. An action chunk reads the present, fused in the same
way.

What differs: the cognitive token of the source is the language model's last prompt state, which would be a pass of the
whole backbone for each frame; here one layer makes it, in which a learned token looks at the frame's tokens. It reads
no words: where the prompt spells the robot's state, a training batch has those of its samples' frames alone. The
perceptual stream's squeeze-excite bottleneck is a Linear to the same 256 channels, behind the policy's own pooling. The
fused tokens are memory tokens, read as the policy's ``memory_fusion`` says, where the source has a diffusion
transformer with a condition and a cross-attention of its own. Frames are written at a stride, not where chunks begin,
so a chunk that begins at such a step finds its own frame among the entries. Times are control steps everywhere; the
source trains by frames and acts by calls. Each row has a bank, where rows of the source share one while they act, and
there is no dropout, which the source applies then too.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import reduce
from torch import Tensor, nn

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
    stride = 24
    capacity = 16
    asks_present = True

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: BankSettings) -> None:
        super().__init__(spec, pool, settings)
        self.capacity = settings.length
        widths = {"perceptual": min(PERCEPTUAL_WIDTH, spec.dim), "cognitive": spec.dim}
        self.reduce = nn.Linear(spec.dim, widths["perceptual"])
        self.asking = nn.Parameter(torch.randn(1, 1, spec.dim))
        self.summary = Lookup(spec.dim)
        self.streams = nn.ModuleDict({name: Stream(width, settings.time_codes) for name, width in widths.items()})
        self.out = nn.ModuleDict({name: nn.Linear(width, spec.width) for name, width in widths.items()})

    def _present(self, tokens: Tensor) -> dict[str, Tensor]:
        """Return the present of each stream (R, N, d), of a frame's tokens (R, P, D)."""
        tokens = F.rms_norm(tokens.float(), tokens.shape[-1:], eps=1e-6)
        hidden = torch.zeros(tokens.shape[:2], dtype=torch.bool, device=tokens.device)
        summary, _ = self.summary(self.asking.expand(len(tokens), -1, -1), tokens, tokens, hidden)
        return {"perceptual": self.reduce(tokens), "cognitive": summary}

    def init(self, rows: int) -> State:
        """Return empty banks."""
        sizes = {"perceptual": (self.spec.tokens, self.reduce.out_features), "cognitive": (1, self.spec.dim)}
        device = self.reduce.weight.device
        state = {name: torch.zeros(rows, self.capacity, *size, device=device) for name, size in sizes.items()}
        state |= {f"{name}_steps": torch.zeros(rows, self.capacity, device=device) for name in sizes}
        return state | {"count": torch.zeros(rows, dtype=torch.int64, device=device)}

    @torch.no_grad()
    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query | None = None) -> State:
        """Fuse the frame with what it finds, and make an entry of it."""
        count = state["count"]
        made = {"count": (count + 1).clamp(max=self.capacity)}
        for name, present in self._present(tokens).items():
            entries, steps = state[name], state[f"{name}_steps"]
            fused, _ = self.streams[name](present, entries, steps, count, step)
            made[name], made[f"{name}_steps"] = append(entries, steps, count, fused.float(), step)
        return made

    def read(self, state: State, query: Query | None = None) -> MemoryTokens:
        """Return the present of both streams, fused with what it finds: P perceptual tokens and a cognitive one."""
        assert query is not None
        assert query.tokens is not None
        count, read, shares, steps = state["count"], [], [], []
        now = torch.zeros_like(count)  # of an empty bank alone, which no chunk reads: an episode's first frame is there
        real = torch.arange(self.capacity, device=count.device) < count[:, None]
        for name, present in self._present(query.tokens).items():
            fused, looked = self.streams[name](present, state[name], state[f"{name}_steps"], count, now)
            read.append(self.out[name](fused))
            shares.append(shares_of(looked, present.shape[1]))
            steps.append(state[f"{name}_steps"].masked_fill(~real, -1))
        each, (perceptual, cognitive) = torch.cat(read, dim=1), shares
        sources = torch.cat([F.pad(perceptual, (0, self.capacity)), F.pad(cognitive, (self.capacity, 0))], dim=1)
        mask = torch.ones(each.shape[:2], dtype=torch.bool, device=each.device)
        return MemoryTokens(each, mask, sources=(sources, torch.cat(steps, dim=1)))


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
    """Retrieval from the entries of a stream, and the gate of what is found."""

    def __init__(self, width: int, time_codes: bool) -> None:
        super().__init__()
        self.time: nn.Module | None = None
        if time_codes:  # a last bias would be the same for all entries, which softmax does not see
            self.time = nn.Sequential(nn.Linear(2 * WAVES, width), nn.SiLU(), nn.Linear(width, width, bias=False))
        self.blocks = nn.ModuleList(Lookup(width) for _ in range(BLOCKS))
        self.gate = nn.Linear(2 * width, width)
        nn.init.normal_(self.gate.weight, std=1e-3)
        nn.init.normal_(self.gate.bias, std=1e-3)

    def forward(
        self, present: Tensor, entries: Tensor, steps: Tensor, count: Tensor, now: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the present fused with what it finds in the entries; where there are none, in itself.

        Args:
            present: (R, N, d). entries: (R, L, N, d), of which the first ``count`` (R,) are real. steps: (R, L).
            now: (R,) the present's step.

        Returns:
            (R, N, d), and of each block, how much its heads looked at each token of the entries and, behind them, of
            the present: (R, heads N, (L + 1) N).
        """
        slots = torch.arange(entries.shape[1] + 1, device=count.device)
        hidden = torch.where(slots < slots[-1], slots >= count[:, None], count[:, None] > 0)
        hidden = hidden.repeat_interleave(present.shape[1], dim=1)
        values = torch.cat([entries, present[:, None]], dim=1)
        keys = values
        if self.time is not None:
            keys = values + self.time(waves(torch.cat([steps, now[:, None]], dim=1)))[:, :, None]
        keys, values = keys.flatten(1, 2), values.flatten(1, 2)
        found, looked = present, []
        for block in self.blocks:
            found, weights = block(found, keys, values, hidden)
            looked.append(weights)
        gate = self.gate(torch.cat([present, found], dim=2)).sigmoid()
        return gate * present + (1 - gate) * found, looked


def shares_of(looked: list[Tensor], tokens: int) -> Tensor:
    """Return the share (R, N, L) of each entry, of ``tokens`` N, in what a stream's heads and blocks looked at."""
    of_all = torch.stack(looked).detach().float()
    shares: Tensor = reduce(of_all, "b r (h n) (l m) -> r n l", "sum", h=HEADS, m=tokens) / (HEADS * len(looked))
    return shares[:, :, :-1]


def waves(steps: Tensor) -> Tensor:
    """Return cosines, then sines, of control steps (...), frequencies from 1 down to 1/TIME_BASE: (..., 256)."""
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
    entries, steps = torch.cat([entries, new[:, None]], dim=1), torch.cat([steps, now[:, None].to(steps)], dim=1)
    unit = F.normalize(entries, dim=3)
    pair = (unit[:, :-1] * unit[:, 1:]).sum(dim=3).mean(dim=2).argmax(dim=1)[:, None]  # this one and the next
    slots, full, free = torch.arange(length, device=count.device), (count == length)[:, None], count[:, None]
    kept = torch.where(full, slots + (slots > pair), torch.where(slots == free, length, slots))
    other = kept + (full & (slots == pair))
    row = torch.arange(len(entries), device=count.device)[:, None]
    return (entries[row, kept] + entries[row, other]) / 2, (steps[row, kept] + steps[row, other]) / 2
