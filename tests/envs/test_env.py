"""Contract of the environment: suites, worlds and observation kinds x reset, step, log, resume and batches; faults."""

from __future__ import annotations

import copy
import errno
import json
import logging
import os
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features, preprocess_observation

import lerobot_memobench.envs
from lerobot_memobench.constants import ENDED, EXECUTION, LONGEST_HOLD, NO_CLOCK, PROMPT, UNSEEDED
from lerobot_memobench.datasets.demonstration import labels
from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import line_of, read_episodes, read_lines, read_log, write_episodes
from lerobot_memobench.envs.evaluation_file import differences
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.observations import CHECKPOINTS
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS, RESET, STEPS
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import failure_of
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.memory_text import NOTHING_YET, with_memory
from lerobot_memobench.tasks.task import STRICT
from tests.support.logs import protocol_of
from tests.support.short_demonstrations import record_demonstration
from tools.board.check import first_variant_mismatch

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
STRICT_HIGHLIGHT = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
SEEDS = [20_000, 20_001, 20_002]
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
NEW_ROLLOUT = {"lerobot_new_rollout": True}


def make(name: str = STOVE, **settings: Any) -> MemobenchEnv:
    return MemobenchEnv(name, **{"obs_type": OBJECTS, "seed_base": 20_000, **settings})


def vector(log: Path, rows: int = 3, use_async: bool = False, **settings: Any) -> gym.vector.VectorEnv:
    chosen = {"tasks": STOVE, "obs_type": OBJECTS, "seed_base": 20_000, "horizon": 3, **settings}
    if "task_dir" in settings:
        del chosen["tasks"]
    config = MemobenchEnvConfig(log_dir=str(log), **chosen)
    ((env,),) = (suite.values() for suite in config.create_envs(rows, use_async).values())
    return env


def actions(seed: int, steps: int) -> np.ndarray:
    """Return the actions (steps, 7) of a seed's episode, equal in every batch."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 7)).astype(np.float32)


def flat(observation: dict[str, Any]) -> dict[str, np.ndarray]:
    pixels = observation.get("pixels", {})
    return {name: np.array(value) for name, value in {**observation, **pixels}.items() if name != "pixels"}


def check_equal(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert flat(found).keys() == flat(expected).keys()
    for name, value in flat(expected).items():
        np.testing.assert_array_equal(flat(found)[name], value, err_msg=name)


def play(env: Any, seed: int, steps: int = 3) -> list[dict[str, Any]]:
    """Return the observations of the first execution frames; ends at the horizon."""
    observation, _ = env.reset(seed=seed)
    while not env.episode.action_has_effect:  # prompt or hold
        observation, *_ = env.step(REST)
    found = [observation]
    for action in actions(seed, steps):
        found.append(env.step(action)[0])
    return found


# --- the contract ---

CONTRACT = {
    "published-pixels": (STOVE, PIXELS),
    "published-both": (STOVE, BOTH),
    "prompted-objects": (HIGHLIGHT, OBJECTS),
    "strict-both": (STRICT_HIGHLIGHT, BOTH),
}


@pytest.mark.usefixtures("short_holds")
@pytest.mark.parametrize(("name", "obs_type"), CONTRACT.values(), ids=CONTRACT)
def test_contract_of_reset_step_log_and_resume(tmp_path: Path, name: str, obs_type: str) -> None:
    task = get_task(name)
    settings = {"obs_type": obs_type, "seed_base": 20_000, "horizon": 3}
    strict = task.suite == "strict"
    if strict:
        settings["prompt_in"] = RESET
    env = MemobenchEnv(name, log_dir=str(tmp_path), replan_steps=20, **settings)
    for part in (*env.observation_space.spaces.values(), *env.observation_space.spaces.get("pixels", {}).values()):
        assert isinstance(part, gym.spaces.Dict) or part.is_bounded()
    features = env_to_policy_features(MemobenchEnvConfig(obs_type=obs_type))
    assert sum(each.type is FeatureType.VISUAL for each in features.values()) == (0 if obs_type == OBJECTS else 2)
    assert ("observation.environment_state" in features) == (obs_type != PIXELS)

    frames = play(env, 20_001)
    assert all(env.observation_space.contains(frame) for frame in frames)
    assert (frames[0]["step"], frames[0]["phase"]) == ([NO_CLOCK if strict else 0], [EXECUTION])
    assert frames[-1]["step"] == [ENDED if strict else 3]
    record, after = env.record(), env.scene_hash()
    assert env.render().shape == (320, 512, 3)
    again = play(env, 20_001)
    for frame, expected in zip(again, frames, strict=True):
        check_equal(frame, expected)
    assert env.scene_hash() == after
    play(env, 20_002)
    assert env.scene_hash() != after
    env.reset(seed=20_003)  # not finished: no line
    env.close()

    lines = read_episodes(tmp_path)
    assert [line["episode"] for line in lines] == [1, 2]
    assert line_of(lines[0]) | {"wall_s": 0} == record | {"wall_s": 0}
    assert lines[0].items() >= {"task": name, "memory_type": task.memory_type, "seed": 20_001, "steps": 3}.items()
    assert (lines[0]["success"], lines[0]["failure"], lines[0]["replan_steps"]) == (False, "cut_off", 20)
    assert [each["first_step"] for each in lines[0]["checkpoints"]] == [None] * len(task.checkpoints)
    assert (lines[0]["obs_type"], lines[0]["suite"]) == (obs_type, task.suite)

    config = {**settings, "suite": task.suite, "replan_steps": 20, "prompt_in": env.settings.prompt_in}
    resumed = vector(tmp_path, 2, tasks=name, resume=True, **config)
    observation, _ = resumed.reset(seed=[20_000, 20_001], options=NEW_ROLLOUT)
    assert not any(value[1].any() for value in flat(observation).values()), "a logged row is blank"
    assert flat(observation)["agent_pos"][0].any()
    *_, truncated, info = resumed.step(np.zeros((2, 7), np.float32))
    assert truncated.tolist() == [False, True]
    assert not info["is_success"].any()
    resumed.close()
    with pytest.raises(MemobenchError, match="horizon: 3 and 4"):
        vector(tmp_path, 2, tasks=name, resume=True, **{**config, "horizon": 4})


def roll(env: gym.vector.VectorEnv, seeds: list[int], steps: int) -> tuple[list[str], dict[str, Any]]:
    """Run the episodes to their ends, at most ``steps`` steps."""
    env.reset(seed=seeds, options=NEW_ROLLOUT)
    ended = np.zeros(len(seeds), bool)
    for plan in np.stack([actions(seed, steps) for seed in seeds], axis=1):
        observation, _, over, cut, _ = env.step(plan)
        ended |= over | cut
        if ended.all():
            break
    assert ended.all()
    return list(env.call("scene_hash")), preprocess_observation(observation)


def check_batches(tmp_path: Path, modes: tuple[bool, ...], steps: int, **settings: Any) -> None:
    """Check that rows of a batch equal single episodes, and that they freeze at their end."""
    settings["horizon"] = steps
    if settings.get("suite") == STRICT:
        settings["replan_steps"], steps = 1, steps + 2 * LONGEST_HOLD  # of the start, and of a return home
    alone = vector(tmp_path / "alone", 1, **settings)
    single = [roll(alone, [seed], steps) for seed in SEEDS]
    alone.close()
    assert len({hashes[0] for hashes, _ in single}) == len(SEEDS)
    for use_async in modes:
        env = vector(tmp_path / f"async_{use_async}", len(SEEDS), use_async, **settings)
        try:
            hashes, observation = roll(env, SEEDS, steps)
            assert hashes == [each for found, _ in single for each in found], f"async {use_async}"
            for key, value in observation.items():
                rows = np.concatenate([each[key].numpy() for _, each in single])
                np.testing.assert_array_equal(value.numpy(), rows, err_msg=key)
            env.step(np.ones((len(SEEDS), 7), np.float32))
            assert list(env.call("scene_hash")) == hashes, "ended rows are frozen"
        finally:
            env.close()
        assert len(read_episodes(tmp_path / f"async_{use_async}")) == len(SEEDS)


def test_rows_of_a_batch_equal_single_episodes(tmp_path: Path) -> None:
    check_batches(tmp_path, (False,), 6, tasks=DRAWER, obs_type=BOTH)


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names(suite=None))
def test_batches_in_processes_of_all_tasks(name: str, tmp_path: Path) -> None:
    check_batches(tmp_path, (False, True), 12, tasks=name, suite=get_task(name).suite, prompt_in=RESET, obs_type=BOTH)


# --- prompt ---


def test_prompt_ignores_actions_and_restores_the_scene() -> None:
    runs = []
    for seed in (1, 2):
        env, hashes, lit = make(HIGHLIGHT, horizon=2, reward=CHECKPOINTS), [], 0
        rng = np.random.default_rng(seed)
        observation, info = env.reset(seed=20_000)
        start, objects = env.scene_hash(), ObjectSlots(env.episode.sim)
        assert (observation["phase"], info["phase"]) == ([PROMPT], PROMPT)
        while observation["phase"] == [PROMPT]:
            np.testing.assert_array_equal(observation["environment_state"], objects.observe())
            slots = observation["environment_state"].reshape(SLOTS, WIDTH)
            lit += bool(slots[:, STARTS["highlighted"]].any())
            observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 7).astype(np.float32))
            assert (reward, terminated, truncated) == (0.0, False, False)
            hashes.append(env.scene_hash())
        assert lit
        assert not observation["environment_state"].reshape(SLOTS, WIDTH)[:, STARTS["highlighted"]].any()
        assert observation["step"] == [0], "the length of the prompt is not observable"
        assert hashes[-1] == start
        assert [env.step(REST)[3] for _ in range(2)] == [False, True]
        assert (env.record()["prompt_steps"], env.record()["steps"]) == (len(hashes), 2)
        runs.append(hashes)
    assert runs[0] == runs[1]
    assert len(set(runs[0])) > 20, "the prompt shows a motion"


def test_prompt_in_reset_gives_the_same_execution_log_and_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episode_module, "LONGEST_HOLD", 20)
    name, seed = STRICT_HIGHLIGHT, 20_000
    frames, records, videos = [], [], []
    for where in (STEPS, RESET):
        log = tmp_path / where
        env = make(name, obs_type=BOTH, prompt_in=where, horizon=3, log_dir=str(log), videos=-1)
        prompt = 0 if where == RESET else get_task(name).prompt_steps
        assert env._max_episode_steps == longest(env.settings) + prompt
        assert (env.reset(seed=seed)[1]["phase"] == EXECUTION) == (where == RESET)
        frames.append(play(env, seed))
        env.close()
        (line,) = read_lines(log)
        records.append(line | {"wall_s": 0})
        (video,) = log.rglob("*.mp4")
        videos.append(video.read_bytes())
    for step, expected in zip(frames[1], frames[0], strict=True):
        check_equal(step, expected)
    assert records[0] == records[1]
    assert videos[0] == videos[1]


# --- rewards, instruction, evidence ---


def expert_rewards(env: MemobenchEnv) -> tuple[dict[int, float], int, dict[str, Any]]:
    """Return the non-zero rewards of an expert episode by step, its number of steps and the last info."""
    observation, info = env.reset(seed=7)
    rewards, over = [], False
    while not over:
        observation, reward, terminated, truncated, info = env.step(observation["expert_action"])
        rewards.append(float(reward))
        over = terminated or truncated
    return {step: reward for step, reward in enumerate(rewards, 1) if reward}, len(rewards), info


def test_checkpoints_are_rewarded_once_and_in_order() -> None:
    env = make(reward=CHECKPOINTS, expert_action=True)
    rewards, steps, info = expert_rewards(env)
    first, last = env.episode.progress.ordered_step
    assert info["is_success"]
    assert first < last == steps
    assert rewards == {first: pytest.approx(1 / 3), last: pytest.approx(2 / 3)}
    cut = make(reward=CHECKPOINTS, expert_action=True, horizon=first + 1)
    rewards, _, info = expert_rewards(cut)
    assert (list(rewards), info["checkpoints_completed"], info["is_success"]) == ([first], 1, False)


def test_oracle_instruction_equals_the_dataset_frame_by_frame() -> None:
    demo = record_demonstration(get_task(STOVE), 10_000, images=False, referent="fixed")
    texts = [with_memory(demo.task.language, memory) for memory in labels(demo)["oracle_memory"]]
    assert len(set(texts)) == 1 + len(demo.task.checkpoints)
    last = max(frame for frame, text in enumerate(texts) if text != texts[-1]) + 1  # the environment ends at success
    env = make(oracle_memory=True, expert_action=True)
    observation, _ = env.reset(seed=10_000)
    found = [env.task_description]
    for _ in range(last - 1):
        observation, *_ = env.step(observation["expert_action"])
        found.append(env.task_description)
    assert found == texts[:last]
    env.reset(seed=10_000)
    assert env.task_description.endswith(NOTHING_YET)
    plain = make()
    plain.reset(seed=10_000)
    assert plain.task_description == demo.task.language


@pytest.mark.usefixtures("short_holds")
def test_evidence_runs_each_scene_with_each_variant(tmp_path: Path) -> None:
    settings = {"prompt_in": RESET, "horizon": 1}
    env = make(STRICT_HIGHLIGHT, log_dir=str(tmp_path / "each"), evidence=True, **settings)
    for seed in range(20_000, 20_003):
        play(env, seed, steps=1)
    records = read_episodes(tmp_path / "each")
    found = [(r["episode"], r["seed"], r["variant"]) for r in records]
    assert found == [(0, 20_000, 0), (1, 20_000, 1), (2, 20_001, 0)]
    assert [(r["choice"], r["variants"], r["chance"]) for r in records] == [(None, 2, 0.5)] * 3
    assert first_variant_mismatch(records) is None
    assert first_variant_mismatch([{**records[0], "variant": 1}]) is not None
    drawn = make(STRICT_HIGHLIGHT, log_dir=str(tmp_path / "drawn"), **settings)
    play(drawn, 20_000, steps=1)
    (line,) = read_episodes(tmp_path / "drawn")
    assert "choice" not in line
    assert line["scene_hash"] == records[0]["scene_hash"] == records[1]["scene_hash"] != records[2]["scene_hash"]
    each, once = (protocol_of(tmp_path / name) for name in ("each", "drawn"))
    assert differences(each, once) == ["evidence: True and False"]


# --- frames that are rendered ---


def test_failed_video_leaves_the_log_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The episode of the failed video is not logged, so resuming runs it again."""
    env = make(log_dir=str(tmp_path), videos=-1, horizon=2)

    def no_room(video: VideoRecorder, image: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    play(env, 20_007, 2)
    with monkeypatch.context() as patch:
        patch.setattr(VideoRecorder, "_encode", no_room)
        with pytest.raises(MemobenchError, match="No space left on device"):
            play(env, 20_008, 2)
    play(env, 20_009, 2)
    assert [record["seed"] for record in read_episodes(tmp_path)] == [20_007, 20_009]
    assert len(list((tmp_path / "videos").iterdir())) == 2


# --- resume ---


def test_resume_keeps_outcomes_and_other_rows(tmp_path: Path) -> None:
    def rolled(env: gym.vector.VectorEnv) -> list[dict[str, Any]]:
        found = [env.reset(seed=SEEDS, options=NEW_ROLLOUT)[0]["agent_pos"]]
        for _ in range(3):
            observation, reward, terminated, truncated, _ = env.step(np.full((3, 7), 0.5, np.float32))
            found += [observation["agent_pos"], reward, terminated, truncated]
        env.close()
        return [np.array(each) for each in found]

    whole, log = tmp_path / "whole", tmp_path / "log"
    reference = rolled(vector(whole))
    line = {"task": STOVE, "memory_type": "temporal", "episode": 1, "success": True, "checkpoints": []}
    not_run = {**line, "episode": 2, "success": False, "not_run": "no scene"}
    write_episodes(log, [line, {**line, "task": "another", "episode": 0}, not_run])
    found = rolled(vector(log, resume=True))
    for before, after in zip(reference, found, strict=True):
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert [found[2][1], found[3][1], found[4][1]] == [1.0, True, False], "the logged success ends the row"
    records = [record for record in read_episodes(log) if record["task"] == STOVE]
    assert [(record["episode"], "wall_s" in record) for record in records] == [(0, True), (1, False), (2, True)]
    hashes = {record["episode"]: record["scene_hash"] for record in read_episodes(whole)}
    assert [record["scene_hash"] for record in records if "wall_s" in record] == [hashes[0], hashes[2]]


# --- faults ---


@pytest.mark.parametrize(("bad", "named"), [(np.nan, "not finite"), (None, "shape")])
def test_invalid_action_ends_only_its_own_episode(tmp_path: Path, bad: float | None, named: str) -> None:
    env = vector(tmp_path)
    env.reset(seed=SEEDS, options=NEW_ROLLOUT)
    ends = []
    for step in range(3):
        action = np.tile(REST, (3, 1))
        if step == 1 and bad is None:
            action = action[:, :6]
        elif step == 1:
            action[1] = bad
        *_, terminated, truncated, info = env.step(action)
        assert not terminated.any()
        assert not np.any(info["is_success"])
        ends.append(truncated.tolist())
    env.close()
    cut = [True] * 3 if bad is None else [False, True, False]
    assert ends[:2] == [[False] * 3, cut]
    records = read_episodes(tmp_path)
    assert [record["steps"] for record in records if "fault" in record] == [1] * sum(cut)
    assert [named in record.get("fault", "") for record in records] == cut
    assert [failure_of(record) for record in records if "fault" in record] == ["invalid_action"] * sum(cut)
    assert write_report(tmp_path).summary.failures["invalid_action"] == sum(cut)


@pytest.mark.parametrize("bad", ["up" * 500, [[0], [0, 1]], None])
def test_invalid_action_raises_without_a_log_until_the_next_reset(bad: Any) -> None:
    env = make()
    for _ in range(2):
        env.reset(seed=20_000)
        env.step(REST)
        for action in (bad, REST):
            with pytest.raises(MemobenchError, match="an action") as caught:
                env.step(action)
            assert len(str(caught.value)) < 250


def test_unstable_physics_end_an_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    for log in (None, str(tmp_path)):
        env = make(log_dir=log)
        env.reset(seed=20_000)
        env.step(REST)
        env.episode.sim.data.qvel[0] = 1e12
        if log is None:
            for _ in range(2):
                with pytest.raises(MemobenchError, match="physics"):
                    env.step(REST)
    with caplog.at_level(logging.WARNING):
        *_, terminated, truncated, info = env.step(REST)
    assert (terminated, truncated, info["is_success"]) == (False, True, False)
    assert info["fault"] in caplog.text
    (record,) = read_episodes(tmp_path)
    assert (record["failure"], record["steps"], record["fault"]) == ("unstable_physics", 1, info["fault"])
    hashes = set()
    for each in (env, env, make()):  # later episodes are not affected
        each.reset(seed=20_001)
        assert "fault" not in each.step(REST)[-1]
        hashes.add(each.scene_hash())
    assert len(hashes) == 1


SHELF = """
(define (problem a_pan_in_a_shelf)
  (:language put the frying pan into the shelf)
  (:regions
    (pan_place (:target kitchen_table) (:ranges ((-0.02 -0.02 0.02 0.02))))
    (shelf_place (:target kitchen_table) (:ranges ((-0.02 -0.28 0.02 -0.24))) (:yaw_rotation ((3.1415 3.1415))))
    (top_region (:target shelf_1)))
  (:fixtures kitchen_table - kitchen_table shelf_1 - wooden_two_layer_shelf)
  (:objects pan_1 - chefmate_8_frypan)
  (:init (On pan_1 kitchen_table_pan_place) (On shelf_1 kitchen_table_shelf_place))
  (:goal (In pan_1 shelf_1_top_region)))
"""


def test_task_that_cannot_be_run_enters_no_rate(tmp_path: Path) -> None:
    """The expert reaches into drawers, not into shelves."""
    shelf = tmp_path / "tasks" / "spatial" / "a_shelf"
    shelf.mkdir(parents=True)
    (shelf / "task_config.bddl").write_text(SHELF)
    goal = [["in", "pan_1", "shelf_1_top_region"]]
    meta = {"memory": [["in"] * 3], "operating_type": [[0] * 3], "subtask_goals": goal}
    (shelf / "task_config.meta.json").write_text(json.dumps(meta))
    with pytest.raises(MemobenchError, match="drawers only"):
        make(str(shelf), expert_action=True).reset(seed=20_000)
    log = tmp_path / "log"
    for resume in (False, True):
        env = vector(log, 2, task_dir=str(shelf), expert_action=True, resume=resume)
        env.reset(seed=SEEDS[:2], options=NEW_ROLLOUT)
        *_, terminated, truncated, _ = env.step(np.tile(REST, (2, 1)))
        assert (truncated.all(), terminated.any()) == (True, False)
        env.close()
    assert [line["episode"] for line in read_log(log)] == [0, 1]
    assert read_episodes(log) == []
    with pytest.raises(MemobenchError, match="drawers only"):
        write_report(log)


# --- seeds ---


def test_episodes_without_a_seed_are_outside_all_splits(tmp_path: Path) -> None:
    runs: list[list[str]] = []
    for run in range(2):
        env = vector(tmp_path / str(run), 2, horizon=1)
        env.reset(seed=SEEDS[:2], options=NEW_ROLLOUT)
        seeds, hashes = [], []
        for _ in range(2):
            env.reset(options=NEW_ROLLOUT)
            seeds += [episode.seed for episode in env.get_attr("episode")]
            hashes += env.call("scene_hash")
        assert len({*seeds}) == len({*hashes}) == 4
        assert all(UNSEEDED[0] <= seed < UNSEEDED[1] for seed in seeds)
        env.step(np.tile(REST, (2, 1)))
        env.close()
        runs.append(hashes)
    assert runs[0] == runs[1], "a seed determines the episodes after it"


# --- gymnasium ---


def test_each_task_has_a_gymnasium_id() -> None:
    assert lerobot_memobench.envs
    assert {f"memobench/{name.replace(',', '')}-v0" for name in task_names(suite=None)} <= set(gym.registry)
    env = gym.make(f"lerobot_memobench.envs:memobench/{STOVE}-v0")
    assert env.unwrapped.task == STOVE
    with pytest.raises(gym.error.NameNotFound, match=STOVE):
        gym.make("memobench/turn_on_the_stofe_and_turn_it_off-v0")


def test_gymnasium_prints_no_warning(recwarn: pytest.WarningsRecorder) -> None:
    warnings.simplefilter("always")
    name, settings = "check_the_top_drawer_a_given_number_of_times", {"obs_type": BOTH, "expert_action": True}
    for env in (
        gym.make(f"memobench/{name}-v0", **settings),
        gym.make_vec(f"memobench/{name}-v0", num_envs=2, vectorization_mode="sync", **settings),
    ):
        env.reset(seed=20_000)
        for _ in range(2):
            env.step(env.action_space.sample())
        env.close()
    assert [str(each.message) for each in recwarn] == []


def test_calls_without_a_running_episode_raise_gymnasium_errors() -> None:
    env = make()
    calls = (lambda: env.step(REST), env.render, env.record, env.scene_hash)
    for expected in (ResetNeeded, ClosedEnvironmentError):
        for call in calls:
            with pytest.raises(expected):
                call()
        env.close()
    env.reset(seed=20_000)  # LeRobot reuses closed environments
    env.step(REST)
    before = env.scene_hash()
    for copied in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):  # noqa: S301
        with pytest.raises(ResetNeeded):
            copied.step(REST)
        copied.reset(seed=20_000)
        copied.step(REST)
        assert copied.scene_hash() == before == env.scene_hash()
