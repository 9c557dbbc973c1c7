"""The examples run."""

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
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.modeling_remote import RemotePolicy
from lerobot_memobench.policies.remote.transports import pack, unpack
from lerobot_memobench.run.arguments import read_arguments, split_arguments
from lerobot_memobench.run.plan import take_run_options
from lerobot_memobench.sim.object_layout import STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, fill_slots
from tests.support import logs
from tests.support.libero import needs_assets, simulate
from tests.support.remote_case import batch

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_every_command_is_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings that the example types are those of today; nothing is run."""
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
    memories = [read_arguments("train", split_arguments(line)).get("policy.memory") for line in trainings]
    assert memories == [None, "none"]
    evaluations = [line for command, verb, *line in typed if (command, verb) == ("lerobot", "eval")]
    for line in evaluations:
        take_run_options(split_arguments([word for word in line if not word.startswith("policy=")]))
    assert len(evaluations) == 2


@pytest.mark.slow
def test_ten_minutes(tmp_path: Path) -> None:
    words = [sys.executable, EXAMPLES / "train_in_ten_minutes.py", "--smoke", "--out", tmp_path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    for name in ("memory", "no_memory"):
        assert json.loads((tmp_path / f"{name}_rollouts" / "report.json").read_text())["average"]["n"] == 1
    assert "no_memory_rollouts against memory_rollouts" in done.stdout
    # Given again, only what ends well by itself is done again.
    trained = (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime
    assert subprocess.run(words, capture_output=True, timeout=500).returncode == 0
    assert (tmp_path / "memory" / "checkpoints" / "last").stat().st_mtime == trained


# --- paper_figures.py ---


def test_the_papers_figures_show_what_its_text_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Appendix "Radar Summaries": who is highest on each axis; and Pearson's r of its main table."""
    words = [logs.evaluation(tmp_path / "a", 1), "--with", "paper", "--format", "json", "--out", tmp_path / "report"]
    assert memobench(["report", *map(str, words)]) == 0
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "report" / "report.json"), "--out", str(tmp_path)])
    drawn = runpy.run_path(str(EXAMPLES / "paper_figures.py"), run_name="__main__")
    assert all((tmp_path / f"{name}.pdf").is_file() for name in ("radar", "correlations", "prefix"))
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    rows = [row for row in drawn["rows_of"](report, "main") if row.published]
    best = drawn["best_over_replan"](rows)
    highest = [max(best, key=lambda whose, k=k: best[whose][k] or 0.0)[0] for k in range(4)]
    assert highest == ["π0.5 + memory module", "π0.5 + memory module", "MemoryVLA", "HiF-VLA"]
    counts = {metric: len(drawn["points"](rows, metric)) for metric in ("MSR", "MUR", "MCR")}
    assert counts == {"MSR": 24 * 4, "MUR": 24 * 3, "MCR": 24 * 2}
    assert drawn["pearson"](drawn["points"](rows, "MSR")) == pytest.approx(0.587, abs=0.01)
    assert drawn["pearson"]([(1.0, 0.0, "object")] * 3) is None


# --- recurrent_ppo.py ---


def test_the_reinforcement_learners_wrapper_pays_the_way_and_the_checkpoint() -> None:
    """A hand that goes over the knob and pushes its ridge turns the stove on; the scenes are those that were asked for.

    What is paid beside the checkpoint is the difference of a potential, so nothing is gained by going to and fro.
    """
    example = runpy.run_path(str(EXAMPLES / "recurrent_ppo.py"))
    env = example["make"](20_000)
    observation, _ = env.reset(seed=3)
    assert env.unwrapped.episode.seed == 20_000
    aims = [(0.03, -0.08, 0.14), (0.03, -0.08, 0.045), (0.03, 0.06, 0.045)]  # from the knob, m
    rewards, knob, done = [], observation[3:6] + observation[:3], False
    for aim in np.repeat(aims, [8, 6, 20], axis=0):
        action = (knob / 10 + aim - observation[:3] / 10) / 0.05 / 2
        observation, reward, done, truncated, info = env.step(np.clip(action, -1, 1).astype(np.float32))
        assert env.observation_space.contains(observation)
        rewards.append(reward)
        if done:
            break
    assert done
    assert not truncated
    assert info["is_success"]
    assert info["checkpoints_completed"] == 1
    assert rewards[-1] > 5
    assert max(rewards[:-1]) < 1
    env.reset()
    assert env.unwrapped.episode.seed == 20_001
    env.close()


@pytest.mark.slow
def test_recurrent_ppo_learns_and_goes_on(tmp_path: Path) -> None:
    words = [sys.executable, EXAMPLES / "recurrent_ppo.py", "--out", tmp_path / "out", "--decisions"]
    printed = []
    for decisions in ("3072", "4096"):
        done = subprocess.run([*words, decisions], capture_output=True, text=True, timeout=550)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
    rewards = [float(found) for found in re.findall(r"mean reward (-?[\d.]+)", "".join(printed))]
    assert len(rewards) == 4
    assert max(rewards[2:]) > rewards[0] + 0.3
    assert ["before training" in text for text in printed] == [True, False], "the second goes on from the first"


# --- openpi_server.py ---


def test_a_policy_acts_through_openpis_protocol_as_by_itself() -> None:
    """A policy with a memory, asked over the wire at every eighth step; a failure comes back as its last line."""
    example = runpy.run_path(str(EXAMPLES / "openpi_server.py"))
    served = example["ServedPolicy"]("memobench_small")
    server = example["make_server"](served, "127.0.0.1", 0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = int(server.socket.getsockname()[1])
    with pytest.raises(MemobenchError, match=r"has no 'observation\.environment_state'"):
        RemotePolicy(RemoteConfig(port=port, keys="observation/state=state,prompt=task")).select_action(batch(0))
    keys = ",".join(f"observation/{name}={name}" for name in ("environment_state", "state", "step"))
    remote = RemotePolicy(RemoteConfig(port=port, n_action_steps=8, keys=f"{keys},prompt=task"))
    rng = np.random.default_rng(5)
    episodes = [[seen_at(step, rng) for step in range(steps)] for steps in (26, 9)]
    answered = [[remote.select_action(seen) for seen in episode] for episode in episodes]
    server.shutdown()
    served.policy.config.n_action_steps = 8
    for episode, actions in zip(episodes, answered, strict=True):
        served.begin()
        alone = [served.after(served.policy.select_action(served.before(dict(seen)))) for seen in episode]
        assert torch.equal(torch.cat(alone), torch.cat(actions))
        assert len({tuple(action.ravel().tolist()) for action in alone}) == len(episode)


@needs_assets
def test_a_simulator_state_of_libero_is_answered_as_object_state() -> None:
    """What comes over the wire is seen as the scene that it was read from, whose fixtures stand elsewhere."""
    example = runpy.run_path(str(EXAMPLES / "openpi_server.py"))
    sim = simulate("turn_on_the_stove_and_turn_it_off_near_the_shelf")
    for seed in (20_000, 20_001):
        sim.reset(seed)
        sent = unpack(pack({"state": sim.state(), "fixtures": sim.fixture_poses()}))
        seen = example["objects"](sim.task.name, sent["state"], sent["fixtures"])
        assert np.array_equal(seen, ObjectSlots(sim).observe())


def seen_at(step: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return what a policy of object state observes at a step: five things somewhere."""
    things = rng.uniform(-0.5, 0.5, (5, WIDTH))
    things[:, STARTS["present"]], things[:, STARTS["class"]] = 1, rng.integers(0, 30, 5)
    return {
        "observation.environment_state": torch.from_numpy(fill_slots(things))[None],
        "observation.state": torch.from_numpy(rng.uniform(-0.5, 0.5, (1, 8)).astype(np.float32)),
        "observation.step": torch.tensor([float(step)]),
        "task": ["open the drawer"],
    }
