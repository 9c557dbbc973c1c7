"""A memory mechanism in a package of its own: averages of the frames' tokens, which fade at several learned speeds."""

from dataclasses import dataclass

import torch
from torch import nn

from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism, MemoryTokens


@dataclass
class TracesSettings:
    """How many averages there are; the first fades by half with every frame, each other one four times slower."""

    traces: int = 4


class Traces(MemoryMechanism):
    """Keeps P vectors per trace, however long the episode is; a chunk reads them all."""

    Settings = TracesSettings
    capacity = 1  # of frames; the state never grows
    gradient_frames = 16

    def __init__(self, spec, pool, settings):
        super().__init__(spec, pool, settings)
        halved = torch.tensor([0.5 / 4**trace for trace in range(settings.traces)])
        self.speed = nn.Parameter(torch.logit(halved))
        self.project = nn.Linear(spec.dim, spec.width)
        self.trace = nn.Parameter(torch.randn(settings.traces, 1, spec.width))  # which one a token is of

    def init(self, rows):
        traces, (tokens, dim) = self.settings.traces, (self.spec.tokens, self.spec.dim)
        return {"traces": self.speed.new_zeros(rows, traces, tokens, dim)}

    def write(self, state, tokens, step, query=None):
        speed = self.speed.sigmoid().reshape(-1, 1, 1)
        return {"traces": torch.lerp(state["traces"], tokens[:, None], speed)}

    def read(self, state, query=None):
        tokens = (self.project(state["traces"]) + self.trace).flatten(1, 2)
        return MemoryTokens(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device))
