"""Fast weights (RoboMME's TTT): each row has a linear map that takes a gradient step for each remembered frame."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.frames import MemoryEncoder
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
    State,
)
from lerobot_memobench.policies.memobench_mem.memory.recurrent import HIDDEN, RecurrenceSettings, projection

HEADS, FRAMES_READ = 2, 8  # frames 16 control steps apart: a chunk reads the last 128 steps directly
BASE_RATE, MAX_RATE, MAX_STEP = 0.01, 0.1, 5.0
"""Initial and maximum rate of the inner step, and maximum norm of a head's step."""


class FastWeights(MemoryMechanism):
    """TTT of RoboMME's pi0.5: weights W, b of each head that map a token's key to its value, learned while acting.

    A frame is one gradient step on |R(k W + b) - (v - k)|^2 / 2, with R an RMS norm whose learned scale and shift the
    step does not change. Each token has its own rate, and the steps of W and of b have a norm of at most 5. Then
    y = R(q W + b) + q, and the token's output is x + LN_post(y) W_o. A chunk reads the outputs of the last 8 frames;
    earlier frames are kept in W and b only. W and b are carried over from one remembered frame to the next.
    `docs/guides/memory/fast_weights.md` lists all differences from the source.
    """

    Settings = RecurrenceSettings
    stride = 16
    capacity = FRAMES_READ

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: RecurrenceSettings) -> None:
        super().__init__(spec, pool, settings)
        self.width = min(HIDDEN, spec.width)
        self.gradient_frames = settings.gradient_frames
        of_head = self.width // HEADS
        self.encoder = MemoryEncoder(spec.dim, self.width, spec.grid)
        self.query, self.key = (projection(self.width, self.width) for _ in range(2))
        self.value, self.attended = (projection(self.width, self.width, std=0.01) for _ in range(2))
        self.query_norm, self.key_norm, self.value_norm = (nn.LayerNorm(of_head, eps=1e-6) for _ in range(3))
        self.rate = nn.Linear(self.width, HEADS)
        nn.init.normal_(self.rate.weight, std=0.02)
        nn.init.constant_(self.rate.bias, math.log(math.expm1(BASE_RATE)))  # softplus of it is the base rate
        self.weight = nn.Parameter(torch.empty(HEADS, of_head, of_head))
        nn.init.normal_(self.weight, std=of_head**-0.5)
        self.bias = nn.Parameter(torch.zeros(HEADS, 1, of_head))
        self.scale, self.shift = (nn.Parameter(torch.zeros(HEADS, 1, of_head)) for _ in range(2))
        self.post_norm = nn.LayerNorm(self.width, eps=1e-6)
        self.out = nn.Linear(self.width, spec.width)

    def init(self, rows: int) -> State:
        outputs = self.bias.new_zeros(rows, FRAMES_READ, self.spec.tokens, self.width)
        return {
            "weight": repeat(self.weight, "... -> r ...", r=rows),
            "bias": repeat(self.bias, "... -> r ...", r=rows),
            "outputs": outputs,
            "steps": torch.full((rows, FRAMES_READ), -1, device=outputs.device),
        }

    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        """Take a gradient step on the frame, apply the weights to it, and drop the oldest frame's output."""
        frame = self.encoder(tokens, step)
        layers = (self.query_norm, self.query), (self.key_norm, self.key), (self.value_norm, self.value)
        queries, key, value = (
            norm(rearrange(linear(frame), "r p (h d) -> r h p d", h=HEADS)) for norm, linear in layers
        )
        rate = rearrange(F.softplus(self.rate(frame)).clamp(max=MAX_RATE), "r p h -> r h p 1")
        with torch.autocast(frame.device.type, enabled=False):  # a step is about a hundredth of the weights
            key, value, queries, rate = (part.to(state["weight"]) for part in (key, value, queries, rate))
            weight, bias = self._learned(state["weight"], state["bias"], key, value, rate)
            applied, _ = self._normed(queries @ weight + bias)
        retrieved = rearrange(applied + queries, "r h p d -> r p (h d)")
        output = frame + self.attended(self.post_norm(retrieved))
        return {
            "weight": weight,
            "bias": bias,
            "outputs": torch.cat([state["outputs"][:, 1:], output.unsqueeze(1).to(state["outputs"])], dim=1),
            "steps": torch.cat([state["steps"][:, 1:], step.unsqueeze(1)], dim=1),
        }

    def _learned(self, weight: Tensor, bias: Tensor, key: Tensor, value: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Return the weights (R, H, d, d) and biases (R, H, 1, d) after one step on keys and values (R, H, P, d).

        Its gradients are written out: it needs no autograd in a rollout, and training differentiates through it.
        """
        predicted, (unit, root) = self._normed(key @ weight + bias)
        error = (predicted - (value - key)) * (1 + self.scale)
        step = rate * root * (error - unit * (error * unit).mean(dim=-1, keepdim=True))
        return weight - _shortened(key.mT @ step), bias - _shortened(step.sum(dim=-2, keepdim=True))

    def _normed(self, z: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return R(z); z at unit size, and the factor that scaled it."""
        root = torch.rsqrt(z.square().mean(dim=-1, keepdim=True) + 1e-8)
        unit = z * root
        return unit * (1 + self.scale) + self.shift, (unit, root)

    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        tokens: Tensor = self.out(state["outputs"].flatten(1, 2))
        steps = repeat(state["steps"], "r f -> r (f p)", p=self.spec.tokens)
        return MemoryTokens(tokens, steps >= 0, steps=steps)


def _shortened(step: Tensor) -> Tensor:
    """Return the steps of each row and head (R, H, ...), with norms of at most `MAX_STEP`."""
    length = torch.linalg.vector_norm(step, dim=(-2, -1), keepdim=True)
    return step * (MAX_STEP / length.clamp(min=MAX_STEP))
