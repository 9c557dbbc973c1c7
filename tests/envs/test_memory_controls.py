"""Corruption, the prompt shown again, and interference: what the policy observes, and the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.constants import EXECUTION, PROMPT
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import differences, read_evaluation
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import OBJECTS, EnvSettings
from lerobot_memobench.errors import MemobenchError
from tests.support.logs import protocol_of

STOVE = "turn_on_the_stove_and_turn_it_off"
HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
HIDDEN = "find_the_artichoke_hidden_in_one_of_the_drawers"
SEED, HORIZON = 20_000, 4
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)


def played(task: str, **settings: Any) -> list[dict[str, Any]]:
    """Return the observations of an episode at rest, with its instruction and whether memory is corrupted."""
    chosen = {"obs_type": OBJECTS, "seed_base": SEED, "horizon": HORIZON, **settings}
    env = MemobenchEnv(task, **chosen)
    observation, info = env.reset(seed=SEED)
    found, ended = [], False
    while True:
        assert env.observation_space.contains(observation)
        found.append({**observation, "text": env.task_description, "corrupt": info.get("corrupt", False)})
        if ended:
            assert len(found) <= env._max_episode_steps + 1
            env.close()
            return found
        observation, _, over, cut, info = env.step(REST)
        ended = over or cut


def end(env: MemobenchEnv) -> None:
    while not any(env.step(REST)[2:4]):
        pass


def in_phase(frames: list[dict[str, Any]], phase: int) -> list[dict[str, Any]]:
    return [frame for frame in frames if frame["phase"] == phase]


def assert_same_scene(one: dict[str, Any], other: dict[str, Any]) -> None:
    for name in ("environment_state", "agent_pos"):
        np.testing.assert_allclose(one[name], other[name], rtol=0, atol=1e-4, err_msg=name)


def assert_clock_never_goes_back(frames: list[dict[str, Any]]) -> None:
    """A lower clock begins a new episode in a policy with a memory."""
    steps = [int(frame["step"][0]) for frame in in_phase(frames, PROMPT)]
    assert steps == list(range(len(steps)))


def test_the_shipped_policy_is_corrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_memobench.envs.episode.PROMPT_HORIZON", 30)
    settings = [f"tasks={HIGHLIGHT}", "referent=random", "episodes=2", "batch_size=2", "horizon=8", "device=cpu"]
    line = ["eval", "env=memobench", "policy=memobench_strict", *settings, f"output_dir={tmp_path}"]
    assert main([*line, "corrupt=swap", "reshow=true"]) == 0
    lines = read_episodes(tmp_path)
    assert [(each["corrupt"], each["corrupted"], each["steps"]) for each in lines] == [("swap", True, 8)] * 2
    assert read_evaluation(tmp_path, whole=True)["protocol"]["corrupt"] == "swap"
    assert "corrupt=swap" in (tmp_path / "report.md").read_text().splitlines()[0]


@pytest.mark.parametrize("task", [HIGHLIGHT, pytest.param(HIDDEN, marks=pytest.mark.slow)])
def test_the_prompt_is_shown_again_after_the_corruption(task: str) -> None:
    plain, again = played(task), played(task, corrupt="delete", reshow=True)
    assert_clock_never_goes_back(again)
    (at,) = (number for number, frame in enumerate(again) if frame["corrupt"])
    first, second = again[:at], again[at : 2 * at]
    assert at > 20
    for number in range(at):
        assert_same_scene(first[number], plain[number])
        assert_same_scene(second[number], plain[number])
    executed, usual = in_phase(again, EXECUTION), in_phase(plain, EXECUTION)
    assert len(executed) == len(usual) >= HORIZON + 1, "a strict task is held"
    for one, other in zip(executed, usual, strict=True):
        assert_same_scene(one, other)


def test_other_episodes_are_observed_in_the_prompt_phase() -> None:
    plain, between = played(HIGHLIGHT), played(HIGHLIGHT, interference=2)
    assert_clock_never_goes_back(between)
    length = len(in_phase(plain, PROMPT))
    for number in range(length):
        assert_same_scene(between[number], plain[number])
    others = in_phase(between, PROMPT)[length:]
    own = plain[0]["text"]
    texts = list(dict.fromkeys(frame["text"] for frame in others if frame["text"] != own))
    assert len(texts) == 2
    moved = np.ptp([frame["agent_pos"][:3] for frame in others], axis=0)
    assert moved.max() > 0.05, "the arm moves in the other episodes"
    for one, other in zip(in_phase(between, EXECUTION), in_phase(plain, EXECUTION), strict=True):
        assert_same_scene(one, other)
        assert one["text"] == own


def test_log_and_protocol_record_the_controls(tmp_path: Path) -> None:
    chosen: dict[str, Any] = {"obs_type": OBJECTS, "seed_base": SEED, "horizon": 3, "log_dir": str(tmp_path)}
    env = MemobenchEnv(HIGHLIGHT, corrupt="swap", reshow=True, **chosen)
    env.reset(seed=SEED)
    end(env)
    (line,) = read_episodes(tmp_path)
    assert {key: line[key] for key in ("corrupt", "reshow", "corrupted")} == {
        **{"corrupt": "swap", "reshow": True, "corrupted": True}
    }
    standard = EnvSettings(obs_type=OBJECTS, seed_base=SEED, horizon=3).protocol_block
    written = protocol_of(tmp_path)
    assert {each.split(":")[0] for each in differences(written, standard, ignore=("prompt_in",))} == {
        "corrupt",
        "reshow",
    }
    env = MemobenchEnv(HIGHLIGHT, **chosen)
    env.reset(seed=SEED + 1)
    with pytest.raises(MemobenchError, match="another protocol"):
        end(env)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"corrupt": "erase"}, "'erase'"),
    ({"corrupt_step": 3}, "corrupt=none"),
    ({"corrupt": "delete", "corrupt_step": 3, "reshow": True}, "corrupt_step=3"),
    ({"interference": 1, "reshow": True}, "one control"),
    ({"interference": 1, "prompt_in": "reset"}, "reads prompts"),
    ({"reshow": True, "demonstration_prompt": False}, "demonstration_prompt"),
]


@pytest.mark.parametrize(("settings", "named"), BAD)
def test_controls_that_exclude_each_other_are_refused(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(MemobenchError) as caught:
        EnvSettings(**settings)
    assert named in str(caught.value)


def test_only_tasks_with_a_prompt_are_run() -> None:
    chosen = [folder.name for _, _, folder in MemobenchEnvConfig(tasks="all", interference=1).selected()]
    assert HIGHLIGHT in chosen
    assert STOVE not in chosen
    assert len(MemobenchEnvConfig(tasks="all", corrupt="delete", corrupt_step=100).selected()) == 30
    with pytest.raises(MemobenchError, match="no chosen task has one"):
        MemobenchEnvConfig(tasks="temporal", reshow=True).selected()
    with pytest.raises(MemobenchError, match="no demonstration prompt"):
        MemobenchEnv(STOVE, reshow=True)


def test_loops_that_cannot_reach_the_memory_refuse_a_corruption(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="lerobot eval env=memobench"):
        MemobenchEnvConfig(tasks=HIGHLIGHT, corrupt="delete", log_dir=str(tmp_path)).create_envs(1)
