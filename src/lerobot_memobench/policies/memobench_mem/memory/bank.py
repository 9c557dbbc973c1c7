"""Perceptual-cognitive memory bank (MemoryVLA): the present attends to a bounded list of timed entries.

As in Dexbotic's MemoryVLA+, the perceptual stream has the P tokens of a frame, and the cognitive stream one token. A
frame's tokens retrieve from the entries of their stream, are fused with the result by a gate, and become an entry; a
full stream merges its two most similar neighbours. An action chunk reads the present, fused in the same way.
`docs/guides/memory/bank.md` lists the differences from the source.
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

PERCEPTUAL_WIDTH, HEADS, BLOCKS = 256, 4, 2  # channels as in the source, heads as in one of its releases
WAVES, TIME_BASE = 128, 10_000.0


@dataclass
class BankSettings:
    """Settings of `Bank`: the maximum number of entries per stream."""

    length: int = 16

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"length={self.length} must be at least 1")


class Bank(MemoryMechanism):
    """Two streams of at most ``length`` entries. No gradient passes through written entries.

    State: for each stream its entries, ``<stream>`` (R, length, N, d), and their control steps, ``<stream>_steps``
    (R, length), oldest first, averaged when entries are merged; ``count`` (R,), the number of entries.
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
        self.streams = nn.ModuleDict({name: BankStream(width) for name, width in widths.items()})
        self.out = nn.ModuleDict({name: nn.Linear(width, spec.width) for name, width in widths.items()})

    def _present(self, tokens: Tensor) -> dict[str, Tensor]:
        """Return the input (R, N, d) of each stream for a frame's tokens (R, P, D)."""
        tokens = F.rms_norm(tokens.float(), tokens.shape[-1:], eps=1e-6)
        hidden = torch.zeros(tokens.shape[:2], dtype=torch.bool, device=tokens.device)
        summary, _ = self.summary(self.asking.expand(len(tokens), -1, -1), tokens, tokens, hidden)
        return {"perceptual": self.reduce(tokens), "cognitive": summary}

    def init(self, rows: int) -> State:
        sizes = {"perceptual": (self.spec.tokens, self.reduce.out_features), "cognitive": (1, self.spec.dim)}
        device = self.reduce.weight.device
        state = {name: torch.zeros(rows, self.capacity, *size, device=device) for name, size in sizes.items()}
        state |= {f"{name}_steps": torch.zeros(rows, self.capacity, device=device) for name in sizes}
        return state | {"count": torch.zeros(rows, dtype=torch.int64, device=device)}

    @torch.no_grad()
    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        count = state["count"]
        written = {"count": (count + 1).clamp(max=self.capacity)}
        for name, present in self._present(tokens).items():
            entries, steps = state[name], state[f"{name}_steps"]
            fused, _ = self.streams[name](present, entries, steps, count, step)
            written[name], written[f"{name}_steps"] = append(entries, steps, count, fused.float(), step)
        return written

    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        """Return the present fused with its retrieval: P perceptual tokens and one cognitive token."""
        assert query.tokens is not None
        count, read, shares, steps = state["count"], [], [], []
        now = torch.zeros_like(count)  # used only with an empty bank, which no chunk reads
        real = torch.arange(self.capacity, device=count.device) < count[:, None]
        for name, present in self._present(query.tokens).items():
            fused, looked = self.streams[name](present, state[name], state[f"{name}_steps"], count, now)
            read.append(self.out[name](fused))
            of_all, count_of_all = torch.stack(looked).detach().float(), HEADS * len(looked)
            share = reduce(of_all, "b r (h n) (l m) -> r n l", "sum", h=HEADS, m=present.shape[1]) / count_of_all
            shares.append(share[:, :, :-1])  # without the present itself
            steps.append(state[f"{name}_steps"].masked_fill(~real, -1))
        tokens, (perceptual, cognitive) = torch.cat(read, dim=1), shares
        sources = torch.cat([F.pad(perceptual, (0, self.capacity)), F.pad(cognitive, (self.capacity, 0))], dim=1)
        mask = torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device)
        return MemoryTokens(tokens, mask, sources=(sources, torch.cat(steps, dim=1)))


class Lookup(nn.Module):
    """Cross-attention and a feed-forward layer, both with residual and post-norm, without an output projection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, asking: Tensor, keys: Tensor, values: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return tokens (R, N, d) after attention to M others, and the attention weights (R, heads N, M).

        The projections of keys and values (R, M, d) are applied to the query and to the weighted sum instead: the
        products are the same, and there are many times more keys than queries. ``hidden`` (R, M) are masked out.
        """
        of_key, of_value = (linear.weight.unflatten(0, (HEADS, -1)) for linear in (self.key, self.value))
        query = torch.einsum("rnhe,hed->rhnd", self.query(asking).unflatten(2, (HEADS, -1)), of_key).flatten(1, 2)
        scores = torch.bmm(query, keys.transpose(1, 2)) * of_key.shape[1] ** -0.5
        weights = scores.masked_fill(hidden[:, None], -torch.inf).softmax(dim=2)
        read = torch.bmm(weights, values).unflatten(1, (HEADS, -1))
        asking = self.norms[0](asking + torch.einsum("rhnd,hed->rnhe", read, of_value).flatten(2))
        return self.norms[1](asking + self.mlp(asking)), weights


class BankStream(nn.Module):
    """Retrieval from the entries of a stream, and the gate of the result."""

    def __init__(self, width: int) -> None:
        super().__init__()
        # The last layer has no bias, because softmax is invariant to a term shared by all entries.
        self.time = nn.Sequential(nn.Linear(2 * WAVES, width), nn.SiLU(), nn.Linear(width, width, bias=False))
        self.blocks = nn.ModuleList(Lookup(width) for _ in range(BLOCKS))
        self.gate = nn.Linear(2 * width, width)
        nn.init.normal_(self.gate.weight, std=1e-3)
        nn.init.normal_(self.gate.bias, std=1e-3)

    def forward(
        self, present: Tensor, entries: Tensor, steps: Tensor, count: Tensor, now: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the present (R, N, d) fused with its retrieval from the entries, or from itself without entries.

        The first ``count`` (R,) of the entries (R, L, N, d) are real. Also returns for each block the attention of its
        heads to the tokens of the entries and then of the present: (R, heads N, (L + 1) N).
        """
        slots = torch.arange(entries.shape[1] + 1, device=count.device)
        hidden = torch.where(slots < slots[-1], slots >= count[:, None], count[:, None] > 0)
        hidden = hidden.repeat_interleave(present.shape[1], dim=1)
        values = torch.cat([entries, present[:, None]], dim=1)
        keys = values + self.time(waves(torch.cat([steps, now[:, None]], dim=1)))[:, :, None]
        keys, values = keys.flatten(1, 2), values.flatten(1, 2)
        retrieved, looked = present, []
        for block in self.blocks:
            retrieved, weights = block(retrieved, keys, values, hidden)
            looked.append(weights)
        gate = self.gate(torch.cat([present, retrieved], dim=2)).sigmoid()
        return gate * present + (1 - gate) * retrieved, looked


def waves(steps: Tensor) -> Tensor:
    """Return cosines, then sines, of control steps (...), frequencies from 1 down to 1/TIME_BASE: (..., 256)."""
    frequencies = TIME_BASE ** -(torch.arange(WAVES, dtype=torch.float32, device=steps.device) / WAVES)
    angles = steps.unsqueeze(-1) * frequencies
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def append(entries: Tensor, steps: Tensor, count: Tensor, new: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
    """Append an entry (R, N, d) to the entries (R, L, N, d); return entries and their steps (R, L).

    In a full row, the two most similar neighbours are replaced by their mean. Similarity is the cosine of the tokens at
    the same place, averaged over the places.
    """
    length = entries.shape[1]
    entries, steps = torch.cat([entries, new[:, None]], dim=1), torch.cat([steps, now[:, None].to(steps)], dim=1)
    unit = F.normalize(entries, dim=3)
    pair = (unit[:, :-1] * unit[:, 1:]).sum(dim=3).mean(dim=2).argmax(dim=1)[:, None]  # the first of two
    slots, full, free = torch.arange(length, device=count.device), (count == length)[:, None], count[:, None]
    source = torch.where(full, slots + (slots > pair), torch.where(slots == free, length, slots))
    other = source + (full & (slots == pair))
    row = torch.arange(len(entries), device=count.device)[:, None]
    return (entries[row, source] + entries[row, other]) / 2, (steps[row, source] + steps[row, other]) / 2
