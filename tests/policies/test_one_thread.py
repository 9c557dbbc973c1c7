"""One policy, one rollout at a time."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

from lerobot_memobench.errors import MemobenchError
from tests.support.small_policy import made_for_training


@pytest.fixture(scope="module")
def acting(dataset_root: Path) -> Any:
    policy, before, _, dataset = made_for_training(dataset_root, memory_frames=2)
    item = dataset[0]
    observed = {k: v[None] for k, v in item.items() if k.startswith("observation.") and isinstance(v, torch.Tensor)}
    batch = before(observed | {"task": [item["task"]]})
    return policy, lambda: policy.select_action(batch)


def test_a_rollout_in_another_thread_is_refused_and_not_mixed(acting: Any) -> None:
    """What LeRobot does with env.max_parallel_tasks=2."""
    policy, act = acting
    policy.reset()
    act()
    with ThreadPoolExecutor(1) as other:
        other.submit(policy.reset).result()
        other.submit(act).result()
        with pytest.raises(MemobenchError, match="max_parallel_tasks=1"):
            act()


def test_rollouts_one_after_the_other_may_come_from_any_thread(acting: Any) -> None:
    policy, act = acting
    for _ in range(2):
        with ThreadPoolExecutor(1) as other:
            other.submit(policy.reset).result()
            assert other.submit(act).result().shape == (1, 7)
    policy.reset()
    act()
    act()
