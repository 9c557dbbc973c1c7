"""What is measured on a policy: how well its memory tells the active subgoal, and how far its actions are off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import repeat
from lerobot.policies import make_pre_post_processors
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_memobench.datasets.feature_cache.reading import RecordedFrames
from lerobot_memobench.policies.memobench_mem.alignment.objectives import masked_mean
from lerobot_memobench.policies.memobench_mem.memory.batch import FRAMES, MASK, STEPS, TOKENS, MemoryBatch
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun
from lerobot_memobench.policies.memobench_mem.recorded_items import item
from lerobot_memobench.studies.alignment.questions import Asked, Questions
from lerobot_memobench.studies.alignment.readouts import choose_readout, top1

EVALUATION_BATCH = 32


class Measures:
    """Questions about a dataset's frames, put to finished policies that see objects.

    Args:
        frames: of the dataset. meta: its metadata, as LeRobot has it. tasks: names of its tasks.
    """

    def __init__(self, frames: RecordedFrames, meta: Any, tasks: tuple[str, ...], questions: Questions) -> None:
        self.frames, self.meta, self.tasks, self.questions = frames, meta, tasks, questions

    def of_checkpoint(self, folder: Path) -> dict[str, Any]:
        """Measure the policy of a checkpoint, by its averaged weights."""
        policy = MemobenchMemPolicy.from_pretrained(folder)
        before, _ = make_pre_post_processors(policy.config, pretrained_path=str(folder))
        TrainingRun(policy.config, self.frames, self.meta).follow(before.steps)  # what it looks up
        found: dict[str, Any] = self.of_memory(policy, before) if policy.config.memory != "none" else {}
        return found | {"action_loss": self.action_loss(policy, before)}

    # -- the active subgoal ----------------------------------------------------------------------------------------

    def of_memory(self, policy: MemobenchMemPolicy, before: Any) -> dict[str, Any]:
        """Ask the memory of a policy, whose preprocessor is ``before``, for the active subgoal."""
        fit, test = (self._vectors(policy, before, asked) for asked in (self.questions.fit, self.questions.test))
        found: dict[str, Any] = {name: self._readout(fit[name], test[name]) for name in ("memory", "last_frame")}
        return found | {name: self._scores(test[name]) for name in ("head",) if name in test}

    @torch.no_grad()
    def _vectors(self, policy: MemobenchMemPolicy, before: Any, asked: Asked) -> dict[str, Tensor]:
        """Vectors (N, D) of each frame: ``memory``, ``last_frame``, and with a head its ``head`` embedding (N, d_t)."""
        parts: dict[str, list[Tensor]] = {}
        for _, batch in self._batches(policy, before, asked):
            seen = MemoryBatch(batch[TOKENS], batch[STEPS], batch[MASK]).to(next(policy.parameters()).device)
            memory, mask = policy.model.set_memory(*seen, numbers=batch[FRAMES].to(seen.mask.device))
            newest = torch.zeros_like(seen.mask)
            newest[torch.arange(len(newest)), seen.mask.sum(dim=1) - 1] = True
            last = repeat(newest, "b f -> b (f p)", p=memory.shape[1] // newest.shape[1])
            found = {"memory": masked_mean(memory, mask), "last_frame": masked_mean(memory, last)}
            if policy.alignment is not None:
                found["head"] = policy.alignment.answer(memory, mask, last)
            for name, vectors in found.items():
                parts.setdefault(name, []).append(vectors.cpu())
        return {name: torch.cat(vectors) for name, vectors in parts.items()}

    def _readout(self, fit: Tensor, test: Tensor) -> dict[str, Any]:
        """Held-out top-1 of the closed-form readout: among all candidates, and among those of the frame's task."""
        own = self.questions.fit
        readout = choose_readout(fit, own.labels, self.questions.candidates, own.episodes)
        return {**self._scores(readout(test)), "penalty": readout.penalty}

    def _scores(self, embeddings: Tensor) -> dict[str, Any]:
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
            "by_task": {self.tasks[int(task)]: within(task) for task in np.unique(asked.tasks)},
        }

    # -- actions ---------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def action_loss(self, policy: MemobenchMemPolicy, before: Any) -> float:
        """The policy's own loss of its actions on held-out frames; with flow matching, of the same noise for all."""
        losses, sizes = [], []
        for number, batch in self._batches(policy, before, self.questions.test):
            torch.manual_seed(10_000 + number)
            _, logged = policy.forward(batch)
            losses.append(logged["action_loss"])
            sizes.append(len(batch["action"]))
        return float(np.average(losses, weights=sizes))

    def _batches(
        self, policy: MemobenchMemPolicy, before: Any, asked: Asked
    ) -> Iterator[tuple[int, dict[str, Tensor]]]:
        """Numbered batches of these frames, as LeRobot's loader and the preprocessor make them."""
        deltas = {"action": policy.config.action_delta_indices}
        for first in range(0, len(asked.indices), EVALUATION_BATCH):
            part = asked.indices[first : first + EVALUATION_BATCH].tolist()
            samples = default_collate([item(self.frames, self.meta, deltas, number) for number in part])
            yield first // EVALUATION_BATCH, before(samples)
