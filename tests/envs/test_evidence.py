"""Each scene with each of a task's variants, as the environment runs and logs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.episode_log import differences, read_episodes, read_log
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import OBJECTS, RESET
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import seed_base
from lerobot_memobench.run.card import drawn_otherwise
from lerobot_memobench.tasks.catalogue import get_task

MILK = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
STOVE = "turn_on_the_stove_and_turn_it_off"


def episodes(folder: Path, seeds: range, **settings: Any) -> list[dict[str, Any]]:
    """Run episodes in which nothing is done."""
    env = MemobenchEnv(
        MILK, obs_type=OBJECTS, prompt_in=RESET, horizon=1, seed_base=20_000, log_dir=str(folder), **settings
    )
    for seed in seeds:
        env.reset(seed=seed)
        env.step(np.zeros(7, np.float32))
    return read_episodes(folder)


def test_a_scene_is_run_with_each_variant_before_the_next(tmp_path: Path) -> None:
    records = episodes(tmp_path / "each", range(20_000, 20_004), evidence=True)
    assert [(r["episode"], r["seed"], r["variant"]) for r in records] == [
        (0, 20_000, 0),
        (1, 20_000, 1),
        (2, 20_001, 0),
        (3, 20_001, 1),
    ]
    assert len({r["scene_hash"] for r in records}) == 2
    assert [(r["choice"], r["variants"], r["chance"]) for r in records] == [(None, 2, 0.5)] * 4
    assert drawn_otherwise(records) is None
    assert drawn_otherwise([{**records[0], "variant": 1}]) is not None
    (drawn,) = episodes(tmp_path / "drawn", range(20_000, 20_001))
    assert "choice" not in drawn
    assert drawn["scene_hash"] == records[0]["scene_hash"], "only the past differs"
    each, once = (protocol_of(tmp_path / name) for name in ("each", "drawn"))
    assert differences(each, once) == ["evidence: True and False"]


def test_an_episode_that_cannot_be_run_names_its_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise MemobenchError("no simulator")

    monkeypatch.setattr(Episode, "reset", fails)
    episodes(tmp_path, range(20_002, 20_004), evidence=True)
    assert [(r["episode"], r["seed"], seed_base(r)) for r in read_log(tmp_path)] == [
        (2, 20_001, 20_000),
        (3, 20_001, 20_000),
    ]


def test_who_follows_the_prompt_chooses_what_it_showed(tmp_path: Path) -> None:
    env = MemobenchEnv(MILK, obs_type=OBJECTS, prompt_in=RESET, expert_action=True, evidence=True, seed_base=20_000)
    observation, _ = env.reset(seed=20_001)
    ended = False
    while not ended:
        observation, _, terminated, truncated, _ = env.step(observation["expert_action"])
        ended = terminated or truncated
    record = env.record()
    assert record["success"]
    assert record["choice"] == record["variant"] == 1


def test_the_published_goal_alone_is_no_evidence() -> None:
    with pytest.raises(MemobenchError, match="say referent=random"):
        MemobenchEnvConfig(evidence=True)
    with pytest.raises(MemobenchError, match="say referent=random"):
        MemobenchEnv(str(get_task(MILK).derived_from), evidence=True)
    assert MemobenchEnvConfig(evidence=True, suite="strict").settings.protocol_block["evidence"] is True


def test_tasks_without_variants_are_left_out() -> None:
    config = MemobenchEnvConfig(evidence=True, referent="random", tasks=f"object,{STOVE}")
    names = [folder.name for *_, folder in config.selected()]
    assert len(names) == 5
    assert all(get_task(name).num_variants > 1 for name in names)
    with pytest.raises(MemobenchError, match="none of the chosen tasks has any"):
        MemobenchEnvConfig(evidence=True, referent="random", tasks=STOVE).selected()
