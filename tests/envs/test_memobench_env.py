"""The environment as LeRobot steps it: determinism in batches, prompt phase, freezing, logging, bad input."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EXECUTION, PROMPT, PROMPT_HORIZON
from lerobot_memobench.tasks.catalogue import task_names

DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
STOVE = "turn_on_the_stove_and_turn_it_off"
HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
SEEDS = [7, 8, 9, 10]


def make(name: str, **settings: Any) -> MemobenchEnv:
    return MemobenchEnv(name, **settings)


def actions(seed: int, steps: int) -> np.ndarray:
    """Return the actions (steps, 7) of a seed's episode, the same in every batch."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 7)).astype(np.float32)


def vector(name: str, batch: int, log_dir: Path, use_async: bool = False, **settings: Any) -> gym.vector.VectorEnv:
    config = MemobenchEnvConfig(tasks=name, log_dir=str(log_dir), **settings)
    envs = config.create_envs(batch, use_async)
    (suite,) = envs.values()
    (env,) = suite.values()
    return env


def roll(env: gym.vector.VectorEnv, seeds: list[int], steps: int) -> tuple[list[str], dict[str, Any]]:
    """Return hashes and the last observation of episodes stepped together."""
    env.reset(seed=seeds)
    plans = np.stack([actions(seed, steps) for seed in seeds], axis=1)
    for plan in plans:
        observation, *_ = env.step(plan)
    return list(env.call("scene_hash")), observation


def check_batches(name: str, tmp_path: Path, steps: int, seeds: list[int], **settings: Any) -> None:
    alone = vector(name, 1, tmp_path / "alone", **settings)
    hashes, images = [], []
    for seed in seeds:
        (found,), observation = roll(alone, [seed], steps)
        hashes.append(found)
        images.append(observation["pixels"]["wrist_image"][0].copy())
    alone.close()
    assert len(set(hashes)) == len(seeds)
    for use_async in (False, True):
        env = vector(name, len(seeds), tmp_path / f"async_{use_async}", use_async, **settings)
        try:
            together, observation = roll(env, seeds, steps)
            assert together == hashes, f"async {use_async}"
            np.testing.assert_array_equal(observation["pixels"]["wrist_image"], np.stack(images))
        finally:
            env.close()


def test_batch_of_one_and_two_sync_and_async(tmp_path: Path) -> None:
    check_batches(DRAWER, tmp_path, 12, SEEDS[:2])


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names())
def test_batches_of_all_tasks(name: str, tmp_path: Path) -> None:
    check_batches(name, tmp_path, 30, SEEDS)


OF_EACH_FAMILY = [
    "check_the_top_drawer_a_given_number_of_times",
    "turn_the_stove_on_and_off_once_then_put_the_frying_pan_on_it",
    "find_the_charger_hidden_in_one_of_the_drawers",
    "find_the_charger_or_the_cap_hidden_in_two_of_the_drawers",
    "put_only_the_milk_pointed_out_in_the_prompt_video_on_the_plate",
    "assemble_strictly_in_the_order_demonstrated_in_the_prompt_video",
]


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names(suite="strict"))
def test_batches_of_strict_tasks(name: str, tmp_path: Path) -> None:
    """The prompt is played in the reset: what is compared is the execution, after things were hidden."""
    seeds = SEEDS if name in OF_EACH_FAMILY else SEEDS[:2]
    check_batches(name, tmp_path, 12, seeds, suite="strict", prompt_in="reset")


def test_prompt_plays_whatever_the_policy_does() -> None:
    """Actions have no effect during the prompt; afterwards the scene is what it was, and only then does time count."""
    ends = []
    for seed in (1, 2):
        env = make(HIGHLIGHT, horizon=3)
        rng = np.random.default_rng(seed)
        observation, info = env.reset(seed=7)
        start = env.scene_hash()
        first_image = observation["pixels"]["image"].copy()
        assert info["phase"] == PROMPT
        hashes = []
        while observation["phase"] == [PROMPT]:
            observation, _, terminated, truncated, info = env.step(rng.uniform(-1, 1, 7).astype(np.float32))
            assert not terminated
            assert not truncated
            hashes.append(env.scene_hash())
            assert len(hashes) <= PROMPT_HORIZON
        assert observation["step"] == [0], "how long a prompt was would tell what it showed"
        assert env.scene_hash() == start
        np.testing.assert_array_equal(observation["pixels"]["image"], first_image)
        for step in range(3):
            assert env.episode.exec_steps == step
            observation, _, terminated, truncated, info = env.step(np.zeros(7, np.float32))
        assert truncated
        assert env.record()["prompt_steps"] == len(hashes)
        assert env.record()["steps"] == 3
        ends.append(hashes)
        env.close()
    assert ends[0] == ends[1]
    assert len(set(ends[0])) > 20, "the prompt shows nothing"


def test_a_prompt_within_reset_changes_nothing_but_who_sees_it(tmp_path: Path) -> None:
    """Log, film and the first execution frame are those of a prompt that was stepped through."""
    shown, records, films = [], [], []
    for where in ("steps", "reset"):
        log = tmp_path / where
        env = make(HIGHLIGHT, prompt_in=where, horizon=3, log_dir=str(log), videos=1)
        observation, info = env.reset(seed=7)
        if where == "reset":
            assert env._max_episode_steps == 3
            assert info["phase"] == EXECUTION
        while observation["phase"] == [PROMPT]:
            observation, *_ = env.step(np.ones(7, np.float32))
        shown.append(observation | {"scene": env.scene_hash()})
        for action in actions(7, 3):
            env.step(action)
        env.close()
        (record,) = read_episodes(log)
        records.append({key: value for key, value in record.items() if key != "wall_s"})
        films.append((log / "videos" / f"{HIGHLIGHT}.0.mp4").read_bytes())
    for key in ("agent_pos", "phase", "step"):
        np.testing.assert_array_equal(shown[0][key], shown[1][key])
    for camera, picture in shown[0]["pixels"].items():
        np.testing.assert_array_equal(picture, shown[1]["pixels"][camera])
    assert shown[0]["scene"] == shown[1]["scene"]
    assert records[0] == records[1]
    assert records[0]["prompt_steps"] == 66
    assert films[0] == films[1]


def test_highlight_is_seen_in_the_prompt_only() -> None:
    env = make(HIGHLIGHT)
    observation, _ = env.reset(seed=7)
    still = observation["pixels"]["image"].astype(int)
    most = 0.0
    while observation["phase"] == [PROMPT]:
        observation, *_ = env.step(np.zeros(7, np.float32))
        most = max(most, float((np.abs(observation["pixels"]["image"] - still).max(axis=2) > 20).mean()))
    assert most > 0.003
    np.testing.assert_array_equal(observation["pixels"]["image"], still)
    env.close()


@pytest.mark.parametrize("use_async", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_rows_freeze_when_their_episode_ends(tmp_path: Path, use_async: bool) -> None:
    env = vector(DRAWER, 2, tmp_path, use_async, horizon=2)
    try:
        env.reset(seed=[7, 8])
        for _ in range(2):
            _, _, terminated, truncated, _ = env.step(np.zeros((2, 7), np.float32))
        assert truncated.all()
        assert not terminated.any()
        before = env.call("scene_hash")
        for _ in range(3):
            env.step(np.ones((2, 7), np.float32))
        assert env.call("scene_hash") == before
    finally:
        env.close()
    assert len(read_episodes(tmp_path)) == 2


def test_the_first_episodes_are_recorded_or_all(tmp_path: Path) -> None:
    for settings, recorded in (({}, []), ({"videos": 2}, [0, 1]), ({"videos": -1}, [-1, 0, 1, 2])):
        folder = tmp_path / str(len(recorded))
        env = make(STOVE, log_dir=str(folder), horizon=1, render="fast", **settings)
        for seed in (6, 7, 8, 9):
            env.reset(seed=seed)
            env.step(np.zeros(7, np.float32))
        env.close()
        assert {video.name for video in folder.rglob("*.mp4")} == {f"{STOVE}.{number}.mp4" for number in recorded}


def test_a_video_that_cannot_be_written_leaves_the_log_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was run before is there with its videos; the episode at hand is not in the log, so that it is run again."""
    env = make(STOVE, log_dir=str(tmp_path), videos=-1, horizon=3, render="fast")

    def run(seed: int) -> None:
        env.reset(seed=seed)
        for action in actions(seed, 3):
            env.step(action)

    def no_room(video: VideoRecorder, picture: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    run(20_007)
    with monkeypatch.context() as patch:
        patch.setattr(VideoRecorder, "_encode", no_room)
        with pytest.raises(MemobenchError, match=r"cannot be written \(No space left on device\)"):
            run(20_008)
    assert [record["seed"] for record in read_episodes(tmp_path)] == [20_007]
    run(20_009)
    env.close()
    assert [record["seed"] for record in read_episodes(tmp_path)] == [20_007, 20_009]
    assert len(list((tmp_path / "videos").iterdir())) == 2


def test_log_holds_the_finished_episodes(tmp_path: Path) -> None:
    env = make(DRAWER, log_dir=str(tmp_path), horizon=4, replan_steps=20)
    hashes = []
    for seed in (7, 8):
        env.reset(seed=seed)
        hashes.append(env.scene_hash())
        for _ in range(4):
            env.step(np.zeros(7, np.float32))
    env.reset(seed=9)  # cut short: no line
    env.step(np.zeros(7, np.float32))
    env.close()
    records = read_episodes(tmp_path)
    assert [(r["task"], r["episode"], r["seed"], r["scene_hash"]) for r in records] == [
        (DRAWER, 0, 7, hashes[0]),
        (DRAWER, 1, 8, hashes[1]),
    ]
    record = records[0]
    assert record["memory_type"] == "spatial"
    assert record["steps"] == 4
    assert record["success"] is False
    assert record["replan_steps"] == 20
    assert record["prompt_steps"] == 0
    assert [checkpoint["first_step"] for checkpoint in record["checkpoints"]] == [None] * 3
    assert record["failure"] == "cut_off"


def test_render_is_annotated() -> None:
    env = make(STOVE)
    env.reset(seed=7)
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape[0] > 256
    assert frame.shape[1:] == (512, 3)
    env.close()
