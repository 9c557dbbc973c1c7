"""What ends one episode with a word, and nothing else: actions that are none, physics that break down, a task that the
expert cannot do. And what gymnasium asks of every environment."""

from __future__ import annotations

import copy
import json
import logging
import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import MOST_EPISODES, read_episodes, read_log
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import failure_of
from lerobot_memobench.evaluation.records import read_protocol, read_rollouts
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.protocol import EVALUATION_SEED, UNSEEDED
from lerobot_memobench.run.shards import merge_and_report
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"
SEEDS = [20_000, 20_001, 20_002]
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
SHELF = """
(define (problem a_pan_in_a_shelf)
  (:domain robosuite)
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


def make(**settings: Any) -> MemobenchEnv:
    return MemobenchEnv(STOVE, **{"obs_type": OBJECTS, "seed_base": 20_000, **settings})


def vector(log: Path, rows: int = 3, use_async: bool = False, **settings: Any) -> gym.vector.VectorEnv:
    config = MemobenchEnvConfig(log_dir=str(log), seed_base=20_000, obs_type=OBJECTS, **settings)
    ((env,),) = (suite.values() for suite in config.create_envs(rows, use_async).values())
    return env


# --- episodes that end with a word ---


@pytest.mark.parametrize(
    ("bad", "words", "use_async"),
    [
        (np.nan, "not finite", False),
        pytest.param(np.nan, "not finite", True, marks=pytest.mark.slow),
        (np.inf, "not finite", False),
        (None, "has shape (6,); expected (7,)", False),
    ],
)
def test_an_action_that_is_none_ends_its_episode_alone(
    tmp_path: Path, bad: float | None, words: str, use_async: bool
) -> None:
    """In the second step; what is of another shape is so in all rows."""
    env = vector(tmp_path, use_async=use_async, tasks=STOVE, horizon=4)
    env.reset(seed=SEEDS, options={"lerobot_new_rollout": True})
    ends = []
    for step in range(4):
        actions = np.tile(REST, (3, 1))
        if step == 1:
            actions = actions[:, :6] if bad is None else actions
            actions[1] = actions[1] if bad is None else bad
        *_, terminated, truncated, info = env.step(actions)
        assert not terminated.any()
        assert not np.any(info["is_success"])
        ends.append(truncated.tolist())
    env.close()
    cut = [True] * 3 if bad is None else [False, True, False]
    assert ends == [[False] * 3, cut, [False] * 3, [True] * 3]  # gymnasium resets a row in the step after its end
    records = read_episodes(tmp_path)
    assert [record["steps"] for record in records] == [1 if row else 4 for row in cut]
    assert [words in record.get("fault", "") for record in records] == cut
    assert [failure_of(record) == "invalid_action" for record in records] == cut
    notes = read_rollouts(tmp_path)[1]
    assert len(notes) == 1
    told = "1 rollout was broken off and counts" if sum(cut) == 1 else "3 rollouts were broken off and count"
    assert f"{told} as failed" in notes[0]
    assert words in notes[0]
    assert json.loads(json.dumps(write_report(tmp_path).summary.failures))["invalid_action"] == sum(cut)
    assert words.replace("(", "") in (tmp_path / "report.md").read_text().replace("(", "")


@pytest.mark.parametrize("logged", [True, False])
def test_unstable_physics_end_an_episode_with_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logged: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """MuJoCo would begin the scene anew, and the episode go on in it."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    env = make(log_dir=str(tmp_path) if logged else None)
    env.reset(seed=20_000)
    env.step(REST)
    env.episode.sim.data.qvel[0] = 1e12
    if not logged:
        with pytest.raises(MemobenchError, match=r"^the physics broke down 0\.55 s after .*: Nan, Inf or huge value"):
            env.step(REST)
        with pytest.raises(MemobenchError, match=r"^the episode has ended \(the physics broke down .*reset\(\)$"):
            env.step(REST)
        return
    with caplog.at_level(logging.WARNING):
        *_, terminated, truncated, info = env.step(REST)
    assert (terminated, truncated, info["is_success"]) == (False, True, False)
    assert "the physics broke down" in info["fault"]
    assert f"{STOVE}, episode 0: the physics broke down" in caplog.text
    (record,) = read_episodes(tmp_path)
    assert (record["failure"], record["steps"], record["fault"]) == ("unstable_physics", 1, info["fault"])
    hashes = []
    for _ in range(2):  # nothing of it is left in the episodes after it
        env.reset(seed=20_001)
        assert "fault" not in env.step(REST)[-1]
        hashes.append(env.scene_hash())
    fresh = make()
    fresh.reset(seed=20_001)
    fresh.step(REST)
    assert {*hashes} == {fresh.scene_hash()}


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ("up", r"an action is 'up'; expected 7 numbers, as an array \(7,\)"),
        ([[0], [0, 1]], r"an action is \[\[0\], \[0, 1\]\]; expected 7 numbers"),
        ({"arm": 0}, "an action is {'arm': 0}; expected 7 numbers"),
        ("up" * 500, r"an action is 'upup.{,40}'; expected 7 numbers"),
        (None, r"an action has shape \(\); expected \(7,\)"),
    ],
)
def test_without_a_log_a_bad_action_ends_the_episode_until_the_next_reset(tmp_path: Path, bad: Any, words: str) -> None:
    env = make()
    for _ in range(2):
        env.reset(seed=20_000)
        env.step(REST)
        with pytest.raises(MemobenchError, match=f"^{words}"):
            env.step(bad)
        with pytest.raises(MemobenchError, match=rf"^the episode has ended \({words}.*; begin another by reset\(\)$"):
            env.step(REST)
    logged = make(log_dir=str(tmp_path))
    logged.reset(seed=20_000)
    *_, truncated, info = logged.step(bad)
    assert truncated
    assert re.match(words, info["fault"])
    assert [record["failure"] for record in read_episodes(tmp_path)] == ["invalid_action"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two tasks, the first of which the expert has no motion for."""
    shelf = tmp_path / "tasks" / "spatial" / "a_shelf"
    shelf.mkdir(parents=True)
    (shelf / "task_config.bddl").write_text(SHELF)
    meta = {"memory": [["in"] * 3], "operating_type": [[0] * 3], "key_frame": [-1]}
    meta["subtask_goals"] = [["in", "pan_1", "shelf_1_top_region"]]
    (shelf / "task_config.meta.json").write_text(json.dumps(meta))
    return shelf


@pytest.mark.parametrize("use_async", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_task_that_cannot_be_run_is_counted_as_not_run(folder: Path, tmp_path: Path, use_async: bool) -> None:
    log = tmp_path / "log"
    env = vector(log, 2, use_async, task_dir=str(folder), expert_action=True, horizon=4)
    _, info = env.reset(seed=SEEDS[:2], options={"lerobot_new_rollout": True})
    assert all("the expert places objects into drawers only" in why for why in info["fault"])
    *_, terminated, truncated, info = env.step(np.tile(REST, (2, 1)))
    assert truncated.all()
    assert not terminated.any()
    assert [line["episode"] for line in read_log(log)] == [0, 1]
    assert read_episodes(log) == []
    env.close()
    with pytest.raises(MemobenchError, match=r"no episode in .* could be run; a_shelf was not run.*drawers only"):
        write_report(log)
    again = vector(log, 2, use_async, task_dir=str(folder), expert_action=True, horizon=4, resume=True)
    again.reset(seed=SEEDS[:2], options={"lerobot_new_rollout": True})
    assert again.step(np.tile(REST, (2, 1)))[3].all()  # what the log says
    again.close()
    assert len(read_log(log)) == 2

    other = tmp_path / "other"
    env = vector(other, 1, tasks=STOVE, expert_action=True, horizon=4)
    env.reset(seed=[20_000])
    for _ in range(4):
        env.step(REST[None])
    env.close()
    report = merge_and_report(tmp_path / "merged", [log, other])
    assert report.run.summary.rollouts == 1
    note, nobodys = report.run.notes
    assert nobodys == f"{tmp_path / 'merged'} does not name the policy of its episodes: no part did"
    assert note.startswith("a_shelf was not run, and the figures are without that: the expert places objects")
    for _ in range(2):  # and again from the merged file
        assert write_report(tmp_path / "merged").notes == [note]
        assert json.loads((tmp_path / "merged" / "report.json").read_text())["not_run"] == {"a_shelf": 2}


def test_a_folder_with_a_task_that_cannot_be_run_is_evaluated(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command: the others run, and going on stops nowhere."""
    shutil.copytree(get_task(STOVE).folder, folder.parent / STOVE)
    words = (
        "env=memobench",
        f"env.task_dir={folder.parent}",
        "episodes=1",
        "videos=0",
        "horizon=3",
        f"obs_type={OBJECTS}",
    )
    for more in ((), ("resume=true",)):
        assert main(["eval", *words, "eval.use_async_envs=false", f"output_dir={tmp_path / 'out'}", *more]) == 0
        told = " ".join(capsys.readouterr().out.split())
        assert "note: a_shelf was not run, and the figures are without that: the expert places objects" in told
        assert [record["task"] for record in read_episodes(tmp_path / "out")] == [STOVE]
        assert json.loads((tmp_path / "out" / "report.json").read_text())["not_run"] == {"a_shelf": 1}
    named = json.loads((tmp_path / "out" / "evaluation.json").read_text())["episodes"]
    assert [episode["task"] for episode in named] == ["a_shelf", STOVE]


def test_without_a_log_a_task_that_cannot_be_run_is_an_error(folder: Path) -> None:
    env = MemobenchEnv(str(folder), obs_type=OBJECTS, expert_action=True)
    said = "into drawers only, and 'shelf_1_top_region' is not a drawer"
    with pytest.raises(MemobenchError, match=said):
        env.reset(seed=20_000)


def test_tasks_are_not_chosen_along_with_a_folder_of_them(folder: Path) -> None:
    with pytest.raises(MemobenchError, match="runs every task in that folder"):
        MemobenchEnvConfig(task_dir=str(folder), tasks="object")
    assert len(MemobenchEnvConfig(task_dir=str(folder)).selected()) == 1


# --- seeds ---


def test_episodes_without_a_seed_are_apart_from_all_others(tmp_path: Path) -> None:
    """3 rows x 3 episodes are 9 scenes, none of them of a seed that anybody names, and the same ones once more."""
    found: list[list[str]] = []
    for _ in range(2):
        env = vector(tmp_path / str(len(found)), tasks=STOVE, horizon=1)
        env.reset(seed=SEEDS, options={"lerobot_new_rollout": True})
        seeds, hashes = [], []
        for _ in range(3):
            env.reset(options={"lerobot_new_rollout": True})
            seeds += [episode.seed for episode in env.get_attr("episode")]
            hashes += env.call("scene_hash")
        assert len({*seeds}) == len({*hashes}) == 9
        assert all(UNSEEDED[0] <= seed < UNSEEDED[1] for seed in seeds)
        found.append(hashes)
        env.step(np.tile(REST, (3, 1)))
        env.close()
    assert found[0] == found[1]
    assert read_protocol(tmp_path / "0")["episodes"] <= MOST_EPISODES  # their numbers are no extent
    assert UNSEEDED[0] > 10 * MOST_EPISODES
    assert UNSEEDED[0] > EVALUATION_SEED
    drawn = set()
    for _ in range(2):  # nor do environments that were never given a seed share theirs
        env = make()
        env.reset()
        drawn.add(env.episode.seed)
    assert len(drawn) == 2


# --- what gymnasium asks for ---


@pytest.mark.parametrize("obs_type", [OBJECTS, PIXELS])
@pytest.mark.filterwarnings("ignore:.*A Box observation space.*", "ignore:.*Not able to test alternative render modes")
def test_gymnasium_has_nothing_to_say_against_it(obs_type: str) -> None:
    env = make(obs_type=obs_type)
    check_env(env)
    env.close()


def test_calls_out_of_order_get_gymnasiums_own_errors() -> None:
    env = make()
    for call in (lambda: env.step(REST), env.render, env.record, env.scene_hash):
        with pytest.raises(ResetNeeded):
            call()
    env.close()
    env.close()
    for call in (lambda: env.step(REST), env.render, env.record, env.scene_hash):
        with pytest.raises(ClosedEnvironmentError):
            call()
    env.reset(seed=20_000)  # LeRobot closes environments between the evaluations of a training
    env.step(REST)
    before = env.scene_hash()
    for copied in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):  # noqa: S301
        with pytest.raises(ResetNeeded):
            copied.step(REST)
        copied.reset(seed=20_000)
        copied.step(REST)
        assert copied.scene_hash() == before
        copied.close()
    assert env.scene_hash() == before
    env.step(REST)
