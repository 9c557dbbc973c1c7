"""The scripts in `examples/`."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote import RemoteConfig, RemotePolicy
from lerobot_memobench.policies.remote_connection import pack, unpack_message
from lerobot_memobench.rollouts.plan import take_run_options
from lerobot_memobench.sim.object_layout import STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, fill_slots
from tests.support import logs
from tests.support.libero import simulate
from tests.support.policy_server import batch

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_ten_minutes_commands_are_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    typed: list[list[str]] = []

    class Done:
        returncode = 0

        def __init__(self, command: list[str], **_: Any) -> None:
            typed.append([Path(command[0]).name, *command[1:]])

        def wait(self) -> int:
            return 0

    monkeypatch.setattr(sys, "argv", ["train_in_ten_minutes.py", "--out", str(tmp_path)])
    monkeypatch.setattr(subprocess, "run", Done)
    monkeypatch.setattr(subprocess, "Popen", Done)
    runpy.run_path(str(EXAMPLES / "train_in_ten_minutes.py"), run_name="__main__")
    (tmp_path / "data").mkdir()
    trainings = [line for command, verb, *line in typed if (command, verb) == ("lerobot", "train")]
    memories = [read_words("train", parse_words(line)).get("policy.memory") for line in trainings]
    assert memories == [None, "none"]
    evaluations = [line for command, verb, *line in typed if (command, verb) == ("lerobot", "eval")]
    for line in evaluations:
        take_run_options(parse_words([word for word in line if not word.startswith("policy=")]))
    assert len(evaluations) == 2


@pytest.mark.slow
def test_ten_minutes_runs_and_resumes(tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / "train_in_ten_minutes.py", "--smoke", "--out", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    for name in ("memory", "no_memory"):
        assert json.loads((tmp_path / f"{name}_rollouts" / "report.json").read_text())["average"]["n"] == 1
    assert "no_memory_rollouts against memory_rollouts" in done.stdout
    trained = (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime
    assert subprocess.run(command, capture_output=True, timeout=500).returncode == 0
    assert (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime == trained


# --- paper/figures.py ---


def test_paper_figures_match_the_papers_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Appendix "Radar Summaries" names the best policy on each axis; the main table gives Pearson's r."""
    report_command = ["report", logs.evaluation(tmp_path / "a", 1), "--format", "json"]
    assert memobench([*map(str, report_command), "--out", str(tmp_path / "report")]) == 0
    report_file = tmp_path / "report" / "report.json"
    monkeypatch.setattr(sys, "argv", ["x", str(report_file), "--out", str(tmp_path)])
    monkeypatch.syspath_prepend(EXAMPLES / "paper")
    script = runpy.run_path(str(EXAMPLES / "paper" / "figures.py"), run_name="__main__")
    assert all((tmp_path / f"{name}.pdf").is_file() for name in ("radar", "correlations", "prefix"))
    rows = [row for row in script["rows_of"](json.loads(report_file.read_text()), "main") if row.published]
    best = script["best_over_replan"](rows)
    highest = [max(best, key=lambda policy, k=k: best[policy][k] or 0.0)[0] for k in range(4)]
    assert highest == ["π0.5 + memory module", "π0.5 + memory module", "MemoryVLA", "HiF-VLA"]
    counts = {metric: len(script["points"](rows, metric)) for metric in ("MSR", "MUR", "MCR")}
    assert counts == {"MSR": 24 * 4, "MUR": 24 * 3, "MCR": 24 * 2}
    assert script["pearson"](script["points"](rows, "MSR")) == pytest.approx(0.587, abs=0.01)
    assert script["pearson"]([(1.0, 0.0, "object")] * 3) is None


# --- recurrent_ppo.py ---


def test_rl_wrapper_rewards_progress_and_checkpoint() -> None:
    """A hand that pushes the knob's ridge turns on the stove; shaping rewards telescope, so they stay small."""
    example = runpy.run_path(str(EXAMPLES / "recurrent_ppo.py"))
    env = example["make"](20_000)
    observation, _ = env.reset(seed=3)
    assert env.unwrapped.episode.seed == 20_000
    offsets = [(0.09, 0.02, 0.14), (0.09, 0.02, 0.005), (-0.09, 0.02, 0.005)]  # from the knob, m
    rewards, knob, done = [], observation[3:6] + observation[:3], False
    for offset in np.repeat(offsets, [10, 6, 18], axis=0):
        action = (knob / 10 + offset - observation[:3] / 10) / 0.05 / 2
        observation, reward, done, truncated, info = env.step(np.clip(action, -1, 1).astype(np.float32))
        assert env.observation_space.contains(observation)
        rewards.append(reward)
        if done:
            break
    assert (done, truncated, info["is_success"], info["checkpoints_completed"]) == (True, False, True, 1)
    assert rewards[-1] > 5 > 1 > max(rewards[:-1])
    env.reset()
    assert env.unwrapped.episode.seed == 20_001
    env.close()


@pytest.mark.slow
def test_recurrent_ppo_learns_and_resumes(tmp_path: Path) -> None:
    command = [sys.executable, EXAMPLES / "recurrent_ppo.py", "--out", tmp_path / "out", "--decisions"]
    printed = []
    for decisions in ("3072", "4096"):
        done = subprocess.run([*command, decisions], capture_output=True, text=True, timeout=550)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
    rewards = [float(value) for value in re.findall(r"mean reward (-?[\d.]+)", "".join(printed))]
    assert len(rewards) == 4
    assert max(rewards[2:]) > rewards[0] + 0.3
    assert ["before training" in text for text in printed] == [True, False], "the second run resumes the first"


# --- openpi_server.py ---


def test_openpi_server_returns_the_actions_of_the_policy() -> None:
    """A policy with a memory, requested at each eighth step; the client raises the server's error."""
    example = runpy.run_path(str(EXAMPLES / "openpi_server.py"))
    served = example["ServedPolicy"]("memobench_strict")
    server = example["make_server"](served, "127.0.0.1", 0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = int(server.socket.getsockname()[1])
    with pytest.raises(MemobenchError, match=r"has no 'observation\.environment_state'"):
        RemotePolicy(RemoteConfig(port=port, keys="observation/state=state,prompt=task")).select_action(batch(0))
    keys = ",".join(f"observation/{name}={name}" for name in ("environment_state", "state", "step"))
    remote = RemotePolicy(RemoteConfig(port=port, n_action_steps=8, keys=f"{keys},prompt=task"))
    rng = np.random.default_rng(5)
    episodes = [[observation_at(step, rng) for step in range(steps)] for steps in (26, 9)]
    answered = [[remote.select_action(observation) for observation in episode] for episode in episodes]
    server.shutdown()
    served.policy.config.n_action_steps = 8
    for episode, actions in zip(episodes, answered, strict=True):
        served.begin()
        local = [served.after(served.policy.select_action(served.before(dict(observation)))) for observation in episode]
        assert torch.equal(torch.cat(local), torch.cat(actions))
        assert len({tuple(action.ravel().tolist()) for action in local}) == len(episode)


def test_openpi_server_computes_object_state_from_libero_state() -> None:
    example = runpy.run_path(str(EXAMPLES / "openpi_server.py"))
    sim = simulate("turn_on_the_stove_and_turn_it_off_near_the_shelf")
    for seed in (20_000, 20_001):
        sim.reset(seed)
        sent = unpack_message(pack({"state": sim.state(), "fixtures": sim.fixture_poses()}))
        slots = example["objects"](sim.task.name, sent["state"], sent["fixtures"])
        assert np.array_equal(slots, ObjectSlots(sim).observe())


def observation_at(step: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a random observation of five objects."""
    objects = rng.uniform(-0.5, 0.5, (5, WIDTH))
    objects[:, STARTS["present"]], objects[:, STARTS["class"]] = 1, rng.integers(0, 30, 5)
    return {
        "observation.environment_state": torch.from_numpy(fill_slots(objects))[None],
        "observation.state": torch.from_numpy(rng.uniform(-0.5, 0.5, (1, 8)).astype(np.float32)),
        "observation.step": torch.tensor([float(step)]),
        "task": ["open the drawer"],
    }
