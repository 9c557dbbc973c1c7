"""The oracle's instruction at evaluation is the one a policy was trained on, frame by frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import labels
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.memory_text import NOTHING_YET, with_memory
from tests.support.short_demonstrations import record_demonstration

STOVE = "turn_on_the_stove_and_turn_it_off"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
SEED = 10_000


def expected(name: str, referent: str) -> list[str]:
    """Instructions that training reads for a demonstration's frames."""
    demo = record_demonstration(get_task(name), SEED, images=False, referent=referent)
    return [with_memory(demo.task.language, memory) for memory in labels(demo).memory]


def described(name: str, frames: int, referent: str) -> list[str]:
    """Instructions the environment gives while the expert acts in the same episode."""
    env = MemobenchEnv(
        str(get_task(name).folder),
        oracle_memory=True,
        expert_action=True,
        referent=referent,
        render="fast",
    )
    observation, _ = env.reset(seed=SEED)
    texts = [env.task_description]
    for _ in range(frames - 1):
        observation, *_ = env.step(observation["expert_action"])
        texts.append(env.task_description)
    env.reset(seed=SEED)
    assert env.task_description.endswith(NOTHING_YET)
    env.close()
    return texts


@pytest.mark.parametrize(("name", "referent"), [(STOVE, "fixed"), pytest.param(SWAP, "random", marks=pytest.mark.slow)])
def test_equals_the_dataset_frame_by_frame(name: str, referent: str) -> None:
    texts = expected(name, referent)
    assert len(set(texts)) == 1 + len(get_task(name).checkpoints)
    # A demonstration stays a while after success; the environment ends there, and only until then must both agree.
    last = max(frame for frame, text in enumerate(texts) if text != texts[-1]) + 1
    assert described(name, last, referent) == texts[:last]


def test_without_the_option_the_instruction_stays() -> None:
    env = MemobenchEnv(STOVE, render="fast")
    env.reset(seed=SEED)
    env.step(np.zeros(7, np.float32))
    assert env.task_description == get_task(STOVE).language
    env.close()


@pytest.mark.slow
def test_async_workers_tell_it_too(tmp_path: Path) -> None:
    """LeRobot's evaluation loop calls `task_description` on the vector env at every step."""
    config = MemobenchEnvConfig(
        tasks=STOVE,
        oracle_memory=True,
        expert_action=True,
        referent="fixed",
        render="fast",
        log_dir=str(tmp_path),
    )
    (suite,) = config.create_envs(2, use_async_envs=True).values()
    (env,) = suite.values()
    texts = expected(STOVE, "fixed")
    change = next(frame for frame, text in enumerate(texts) if text != texts[0])
    try:
        observation, _ = env.reset(seed=[SEED, SEED + 1])
        for frame in range(change + 1):
            assert env.call("task_description")[0] == texts[frame]
            observation, *_ = env.step(observation["expert_action"])
    finally:
        env.close()
