"""Ground-truth memory text in the prompt, one of the paper's controls."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun, require_cache
from lerobot_memobench.tasks.memory_text import MARK, with_memory


@dataclass
@ProcessorStepRegistry.register(name="memobench_oracle_memory")
class OracleMemoryProcessorStep(ProcessorStep):
    """The paper's control: ground-truth memory text behind the instruction, before the prompt is tokenized.

    Training samples take it from the dataset's column ``memory``. In a rollout the environment, which alone knows what
    has been done, writes the same words into its instruction; one that does not is refused, because the policy would
    be scored without the memory it was trained on. A step that is not ``enabled`` does nothing; one that is told to
    ``follow`` a training does as its policy says.
    """

    enabled: bool = True
    cache: FrameLookup | None = field(default=None, repr=False)

    _run: TrainingRun | None = field(default=None, init=False, repr=False)

    def follow(self, run: TrainingRun) -> None:
        """Read memory texts out of a run's cache, if its policy does, unless there is a cache of its own."""
        if self.cache is None:
            self._run, self.enabled = run, run.config.oracle_memory

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with memory text in its tasks.

        Raises:
            MemobenchError: a rollout's instruction brings none.
        """
        if not self.enabled:
            return transition
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        tasks = extra.get("task") or []
        if "index" in extra and transition.get(TransitionKey.ACTION) is not None:
            cache = require_cache(self.cache, self._run)
            memories = cache.memory_texts(extra["index"].reshape(-1).tolist())
            tasks = [with_memory(task, memory) for task, memory in zip(tasks, memories, strict=True)]
        elif not tasks or not all(MARK in task for task in tasks):
            raise MemobenchError(
                "This policy was trained with oracle_memory=true and the environment gives no memory text; evaluate it "
                "with --env.oracle_memory=true."
            )
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, "task": tasks}
        return transition

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds."""
        return {"enabled": self.enabled}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features
