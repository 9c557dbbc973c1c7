"""Ground-truth memory text in the prompt, one of the paper's controls."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from lerobot_memobench.datasets.memory_cache import MemoryCache
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.processing.training_cache import require_cache
from lerobot_memobench.tasks.memory_text import MARK, with_memory


@dataclass
@ProcessorStepRegistry.register(name="memobench_oracle_memory")
class OracleMemoryProcessorStep(ProcessorStep):
    """The paper's control: ground-truth memory text behind the instruction, before the prompt is tokenized.

    Training samples take it from the dataset's column ``memory``. In a rollout the environment, which alone knows what
    has been done, writes the same words into its instruction; one that does not is refused, because the policy would
    be scored without the memory it was trained on.
    """

    cache: MemoryCache | None = field(default=None, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with memory text in its tasks.

        Raises:
            MemobenchError: a rollout's instruction brings none.
        """
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        tasks = extra.get("task") or []
        if "index" in extra and transition.get(TransitionKey.ACTION) is not None:
            memories = require_cache(self.cache).memory_texts(extra["index"].reshape(-1).tolist())
            tasks = [with_memory(task, memory) for task, memory in zip(tasks, memories, strict=True)]
        elif not tasks or not all(MARK in task for task in tasks):
            raise MemobenchError(
                "This policy was trained with oracle_memory=true and the environment gives no memory text; evaluate it "
                "with --env.oracle_memory=true."
            )
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, "task": tasks}
        return transition

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features
