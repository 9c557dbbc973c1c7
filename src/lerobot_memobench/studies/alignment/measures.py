"""What is measured on a policy: how well its memory tells the active subgoal, and how far its actions are off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from einops import reduce, repeat
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import MemoryCache
from lerobot_memobench.policies.memobench_mem.alignment.objectives import masked_mean
from lerobot_memobench.policies.memobench_mem.memory.batch import MASK, STEPS, TOKENS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processing.gather_memory import GatherMemoryProcessorStep
from lerobot_memobench.studies.alignment.frames import Frames
from lerobot_memobench.studies.alignment.questions import Asked, Questions
from lerobot_memobench.studies.alignment.readouts import choose_readout, top1

EVALUATION_BATCH = 32


class Measures:
    """Questions about a dataset's frames, put to frozen policies.

    Args:
        remembered: frames of history that the policies see. action_batches: of `EVALUATION_BATCH` held-out frames.
    """

    def __init__(
        self, cache: MemoryCache, frames: Frames, questions: Questions, remembered: int, action_batches: int
    ) -> None:
        self.cache, self.frames, self.questions, self.action_batches = cache, frames, questions, action_batches
        self.gather = GatherMemoryProcessorStep(frames=remembered, align="none", cache=cache)

    def of_policy(self, policy: MemobenchMemPolicy, before: Any) -> dict[str, Any]:
        """Measure a policy, whose preprocessor is ``before``."""
        fit, test = self.vectors(policy, self.questions.fit), self.vectors(policy, self.questions.test)
        found: dict[str, Any] = {name: self.readout(fit[name], test[name]) for name in ("memory", "last_frame")}
        if "head" in test:
            found["head"] = self.scores(test["head"])
        return found | {"action_loss": self.action_loss(policy, before)}

    # -- the active subgoal ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def vectors(self, policy: MemobenchMemPolicy, asked: Asked) -> dict[str, Tensor]:
        """Vectors (N, D) of each frame: ``memory``, ``last_frame``, and with a head its ``head`` embedding (N, d_t)."""
        parts: dict[str, list[Tensor]] = {}
        for memory, mask, last in self._memories(policy, asked):
            found = {"memory": masked_mean(memory, mask), "last_frame": masked_mean(memory, last)}
            if policy.alignment is not None:
                found["head"] = policy.alignment.answer(memory, mask, last)
            for name, vectors in found.items():
                parts.setdefault(name, []).append(vectors)
        return {name: torch.cat(vectors) for name, vectors in parts.items()}

    def _memories(self, policy: MemobenchMemPolicy, asked: Asked) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Memory tokens (n, L, d_m), their mask (n, L), and the mask of the newest frame's alone, in parts."""
        for first in range(0, len(asked.indices), EVALUATION_BATCH):
            part = self.gather.gather(self.cache, asked.indices[first : first + EVALUATION_BATCH].tolist())
            frames = part[MASK]
            memory, mask = policy.model.memory(part[TOKENS], part[STEPS], frames)
            newest = torch.zeros_like(frames)
            newest[torch.arange(len(frames)), frames.sum(dim=1) - 1] = True
            yield memory, mask, repeat(newest, "b f -> b (f p)", p=memory.shape[1] // frames.shape[1])

    @torch.no_grad()
    def tower(self, asked: Asked) -> tuple[Tensor, Tensor]:
        """Mean of the tower's own tokens over the history, and over the last frame: (N, D) each, without a clock."""
        history, newest = [], []
        for index in asked.indices.tolist():
            part = self.gather.gather(self.cache, [index])
            tokens = part[TOKENS][0][part[MASK][0]].float()
            history.append(reduce(tokens, "f p d -> d", "mean"))
            newest.append(reduce(tokens[-1], "p d -> d", "mean"))
        return torch.stack(history), torch.stack(newest)

    def readout(self, fit: Tensor, test: Tensor) -> dict[str, Any]:
        """Held-out top-1 of the closed-form readout: among all candidates, and among those of the frame's task."""
        own = self.questions.fit
        readout = choose_readout(fit, own.labels, self.questions.candidates, own.episodes)
        return {**self.scores(readout(test)), "penalty": readout.penalty}

    def scores(self, embeddings: Tensor) -> dict[str, Any]:
        """Held-out top-1 of embeddings (N, d_t) of the test frames."""
        embeddings = torch.nn.functional.normalize(embeddings, dim=-1)
        asked, candidates = self.questions.test, self.questions.candidates

        def within(task: int) -> float:
            """Top-1 of a task's frames, among its own subgoals."""
            own = asked.tasks == task
            return top1(embeddings[own], asked.labels[own], candidates, asked.allowed[own])

        return {
            "all": top1(embeddings, asked.labels, candidates),
            "own_task": top1(embeddings, asked.labels, candidates, asked.allowed),
            "by_task": {self.frames.task_texts[int(task)]: within(task) for task in np.unique(asked.tasks)},
        }

    # -- actions ---------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def action_loss(self, policy: MemobenchMemPolicy, before: Any) -> float:
        """Flow-matching loss on held-out execution frames, with the same noise and times for every policy."""
        asked = self.questions.test.indices
        count = self.action_batches * EVALUATION_BATCH
        chosen = asked[np.linspace(0, len(asked) - 1, min(count, len(asked))).round().astype(int)]
        losses, sizes = [], []
        for number, first in enumerate(range(0, len(chosen), EVALUATION_BATCH)):
            part = chosen[first : first + EVALUATION_BATCH]
            torch.manual_seed(10_000 + number)
            _, logged = policy.forward(before(self.frames.batch(part, policy.config.chunk_size)))
            losses.append(logged["action_loss"])
            sizes.append(len(part))
        return float(np.average(losses, weights=sizes))
