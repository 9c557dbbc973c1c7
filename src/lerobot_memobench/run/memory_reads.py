"""What the action chunks of a rollout read of their policy's memory, written down as each episode ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.memory_reads import Chunk, reads_file, write_reads
from lerobot_memobench.run.plan import EvaluationPlan, check_memory_reads


@dataclass(frozen=True)
class ReadLog:
    """Writes the reads of an evaluation's episodes.

    Attributes:
        folder: of the episode log. seed_base: seed of episode 0. referent: of every episode.
    """

    folder: Path
    seed_base: int
    referent: str

    @classmethod
    def of(cls, plan: EvaluationPlan) -> ReadLog | None:
        """Return that of an evaluation; None where none is asked for."""
        if not plan.options.memory_reads:
            return None
        return cls(plan.log, plan.environment.seed_base, plan.environment.referent)

    @contextmanager
    def noting(self, task: str, policy: Any, seeds: Sequence[int]) -> Iterator[Callable[[NDArray[np.bool_]], None]]:
        """Watch a batch of rollouts; the function that is yielded writes the reads of episodes that are over (rows,).

        An episode that the log held already observes nothing, plans nothing, and keeps the file that it has.

        Raises:
            MemobenchError: the policy does not tell what it reads.
        """
        check_memory_reads(policy)
        written = np.zeros(len(seeds), bool)

        def ended(over: NDArray[np.bool_]) -> None:
            if (over == written).all():
                return
            rows = policy.memory_reads()
            for row in np.flatnonzero(over & ~written):
                written[row] = True
                if row < len(rows) and rows[row]:
                    self._write(task, seeds[row], rows[row])

        policy.watch_memory()
        try:
            yield ended
            ended(np.ones(len(seeds), bool))
        finally:
            policy.watch_memory(False)

    def _write(self, task: str, seed: int, chunks: Sequence[Any]) -> None:
        found: list[Chunk] = [
            {"step": chunk.step, "entries": [*chunk.entries], "weights": [*chunk.weights]} for chunk in chunks
        ]
        path = reads_file(self.folder, task, seed - self.seed_base)
        write_reads(path, {"seed": seed, "referent": self.referent, "chunks": found})
