"""Episodes of LIBERO's suites: initial states, success, and the same episodes by each tool."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from lerobot.scripts import lerobot_eval
from vla_eval.recording import NullEpisodeRecorder

import lerobot_memobench.envs  # noqa: F401 - registers the tasks with gymnasium
from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, initial_states, task_names
from tests.support.libero import record

STOVE = "turn_on_the_stove"
NUMBER = task_names(suite="libero_goal").index(STOVE)
NOTHING = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    made = gymnasium.make(f"memobench/{STOVE}-v0", horizon=3, disable_env_checker=True)
    yield made
    made.close()


def hashes(folder: Path) -> dict[int, str]:
    """Return number -> hash of the initial scene of each logged episode."""
    return {record["episode"]: record["scene_hash"] for record in read_episodes(folder)}


def test_episode_i_starts_in_initial_state_i(env: gymnasium.Env[Any, Any]) -> None:
    inner: MemobenchEnv = env.unwrapped  # type: ignore[assignment]
    reference = Simulation(get_task(STOVE))
    for seed, state in ((7, 0), (12, 5), (7 + 52, 2)):
        observation, _ = env.reset(seed=seed)
        reference.reset(seed, state=initial_states(STOVE)[state])
        assert inner.scene_hash() == reference.scene_hash()
    assert env.observation_space.contains(observation)
    assert {*observation["pixels"]} == {"image", "image2"}


def test_success_ends_an_episode(env: gymnasium.Env[Any, Any]) -> None:
    inner: MemobenchEnv = env.unwrapped  # type: ignore[assignment]
    env.reset(seed=8)
    assert env.step(NOTHING)[1:4] == (0.0, False, False)
    knob = inner.episode.sim.model.joint("flat_stove_1_button").qposadr[0]
    inner.episode.sim.data.qpos[knob] = 1.0  # LIBERO's knob is on from 0.5 rad
    assert env.step(NOTHING)[1:4] == (1.0, True, False)
    record = inner.record()
    assert (record["success"], record["steps"], record["failure"], record["checkpoints"]) == (True, 2, None, [])
    assert not {"lost", "held_steps"} & {*record}


def test_both_commands_and_vla_eval_run_the_same_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot_memobench.vla_eval import MEMOBench

    ours, theirs, harness = (tmp_path / name for name in ("ours", "theirs", "harness"))
    choice = ("task=libero_goal", f"task_ids=[{NUMBER}]", "policy=memobench_random", "horizon=3", "episodes=2")
    assert lerobot(["eval", "env=memobench", *choice, "batch_size=1", "videos=1", f"output_dir={ours}"]) == 0
    assert [path.name for path in (ours / "videos").iterdir()] == [f"{STOVE}.0.mp4"]
    card = json.loads((ours / "evaluation.json").read_text())
    assert card["protocol"].items() >= {"suite": "libero_goal", "convention": "libero", "horizon": 3}.items()
    assert card["policy"]["type"] == "memobench_random"

    line = ["--env.type=memobench", "--env.task=libero_goal", f"--env.task_ids=[{NUMBER}]", "--env.horizon=3"]
    line += ["--policy.type=memobench_random", "--policy.device=cpu", "--policy.push_to_hub=false"]
    line += ["--eval.n_episodes=2", "--eval.batch_size=1", "--seed=7", f"--env.log_dir={theirs}"]
    monkeypatch.setattr("sys.argv", ["lerobot-eval", *line, f"--output_dir={tmp_path / 'lerobot'}"])
    lerobot_eval.main()
    info = json.loads((tmp_path / "lerobot" / "eval_info.json").read_text())
    assert {*info["per_group"]} == {"libero_goal"}

    benchmark = MEMOBench([NUMBER], suite="libero_goal", horizon=3, log_dir=str(harness))
    benchmark._recorder = NullEpisodeRecorder()
    (task,) = benchmark.get_tasks()
    assert task == {"name": STOVE, "suite": "libero_goal"}
    assert benchmark.get_metric_keys() == {"success": "mean"}
    for number in range(2):
        benchmark.reset({**task, "episode_idx": number})
        while not (last := benchmark.step({"actions": NOTHING})).done:
            pass
        assert benchmark.get_step_result(last) == {"success": False, "failure": "cut_off"}
    with pytest.raises(MemobenchError, match="no initial state 50"):
        benchmark.reset({**task, "episode_idx": 50})
    benchmark.cleanup()

    assert hashes(ours) == hashes(theirs) == hashes(harness)
    assert [*hashes(ours)] == [0, 1]
    for folder in (ours, theirs, harness):
        assert memobench(["report", str(folder)]) == 0
        assert json.loads((folder / "report.json").read_text())["memory_types"] == {"libero_goal": {"n": 2, "SR": 0.0}}
    assert (theirs / "report.md").read_text().startswith("# memobench_random")
    assert len({record["policy"] for folder in (ours, theirs) for record in read_episodes(folder)}) == 1


def test_lerobots_environment_observes_what_its_libero_observes() -> None:
    """Names, types and values after the reset are those that LeRobot's `LiberoEnv` gave on stock LIBERO."""
    start = "libero_spatial:0.raw.robot_state."
    kept = {key.removeprefix(start): one for key, one in record("observations").items() if key.startswith(start)}
    (tasks,) = MemobenchEnvConfig(task="libero_spatial", task_ids=[0], robot_state=True).create_envs(1).values()
    (made,) = tasks.values()
    observation, _ = made.reset(seed=[7])
    found = {f"{group}.{key}": one for group, parts in observation["robot_state"].items() for key, one in parts.items()}
    assert {key: (one.shape, one.dtype) for key, one in found.items()} == {
        key: ((1, *one.shape), one.dtype) for key, one in kept.items()
    }
    for key, values in kept.items():
        assert np.abs(found[key][0] - values).max() <= 5e-4, key  # robosuite observes up to 4 ms earlier
    made.close()
