"""The scripts in `examples/`."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.datasets.card import FAMILIES, LENGTH_BUCKETS
from lerobot_memobench.envs.video import VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import METRICS
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.policies.remote import RemoteConfig, RemotePolicy
from lerobot_memobench.policies.remote_connection import pack, unpack_message
from lerobot_memobench.rollouts.plan import take_run_options
from lerobot_memobench.sim.object_layout import STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, fill_slots
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import MEMORY_TYPES
from tests.support import logs
from tests.support.libero import simulate
from tests.support.logs import rollout, write_log
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


# --- demo.py ---

DEMO = EXAMPLES / "demo.py"
FAILURES: dict[str, dict[int, str]] = {
    "expert": {},
    "with_memory": {3: "reference_drift"},
    "without_memory": {1: "reference_drift", 2: "reference_drift", 3: "storage_failure"},
}
"""Evaluation of the second part -> failed episode -> failure class."""


@pytest.fixture(scope="module")
def demo() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(DEMO)))


def video(path: Path, length: int, grey: int | None = None) -> Path:
    """Write a video of one grey level, or from black to white."""
    recorder = VideoRecorder(path)
    for k in range(length):
        recorder.add(np.full((32, 64, 3), 255 * k // (length - 1) if grey is None else grey, np.uint8))
    recorder.finish()
    return path


def evaluate(demo: SimpleNamespace, words: list[str]) -> None:
    """Write the output files of an evaluation command."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    folder = Path(given["output_dir"])
    if folder.name == "expert" and folder.parent.name != "memory":
        for name in demo.TASKS:
            video(folder / "videos" / f"{name}.0.mp4", 12)
        return
    ends = [FAILURES[folder.name].get(k) for k in range(5)]
    records = [
        rollout(demo.STRICT_TASK, "object", "S", [not end], not end, k, failure=end) for k, end in enumerate(ends)
    ]
    write_log(folder, records)
    video(folder / "videos" / f"{demo.STRICT_TASK}.1.mp4", 6, 100)  # the first episode with different outcomes


def test_demo_writes_images_and_table(demo: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def fake_run(command: list[str], **_: Any) -> None:
        commands.append(command)
        evaluate(demo, command)

    monkeypatch.setattr(subprocess, "run", fake_run)
    monkeypatch.setattr(sys, "argv", ["demo.py", "--out", str(tmp_path)])
    demo.main()
    assert {path.name for path in tmp_path.iterdir()} == {
        *("expert", "memory", "contact_sheet.png", "memory.mp4", "memory.png", "memory.md")
    }
    assert [Path(command[0]).name for command in commands] == ["lerobot"] * 4
    for command in commands:
        take_run_options(parse_words([word for word in command[2:] if not word.startswith("policy=")]))
    # The evaluations of the second part differ only in policy and folder.
    varied = ("policy=", "output_dir=")
    assert len({tuple(word for word in command if not word.startswith(varied)) for command in commands[1:]}) == 1
    assert [get_task(name).memory_type for name in demo.TASKS] == ["temporal", "spatial", "object", "procedural"]
    assert "| without memory | 2/5 |" in (tmp_path / "memory.md").read_text()
    with Image.open(tmp_path / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet.convert("L")).astype(int)
    assert pixels.shape == (4 * 160, demo.FRAMES_PER_VIDEO * demo.COLUMN_WIDTH)
    means = pixels[:160].reshape(160, demo.FRAMES_PER_VIDEO, -1).mean(axis=(0, 2))
    assert (np.diff(means) >= 0).all(), "frames are in order of time"
    assert (means[0] < 20, means[-1] > 235) == (True, True), "first and last frames are included"


# --- the paper's tables ---

PUBLISHED = runpy.run_path(str(EXAMPLES / "paper" / "published.py"))
published_rows, RAW = PUBLISHED["published_rows"], PUBLISHED["RAW"]
ROWS = published_rows()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.table}-{row.model}-{row.replan_steps}")
def test_published_averages_are_the_mean_of_applicable_memory_types(row: Any) -> None:
    assert tuple(row.memory_types) == MEMORY_TYPES
    for metric in METRICS:
        values = [value for figures in row.memory_types.values() if (value := figures[metric]) is not None]
        # The paper rounds the memory types as well as their mean.
        assert row.average[metric] == pytest.approx(sum(values) / len(values), abs=0.1 + 1e-9), metric


def test_an_operation_is_published_where_the_catalogue_has_it() -> None:
    from lerobot_memobench.tasks.catalogue import get_task, task_names

    for memory_type in MEMORY_TYPES:
        operations = {label for name in task_names(memory_type) for label in get_task(name).operations}
        for row in ROWS:
            published = {m for m, value in row.memory_types[memory_type].items() if value is not None}
            assert published == {"SR"} | {f"M{operation}R" for operation in operations}


def test_the_text_quotes_the_tables() -> None:
    """Sentences of the paper's section on results, each against the rows."""

    def figure(model: str, replan: int, read: Callable[[Any], float | None], table: str = "main") -> object:
        (row,) = [r for r in published_rows(table) if r.model == model and r.replan_steps == replan]
        return read(row)

    module = "pi05 + RoboMME Memory Module"
    assert figure(module, 5, lambda r: r.average["SR"]) == 31.9
    assert figure("pi05", 50, lambda r: r.average["SR"]) == 20.8
    assert figure("pi0", 5, lambda r: r.memory_types["temporal"]["MSR"]) == 94.0
    assert figure("MemoryVLA", 20, lambda r: r.average["MUR"]) == 49.9
    assert figure("Contrastive Memory Alignment", 5, lambda r: r.average["SR"], "alignment") == 34.7


def test_failures_add_up() -> None:
    counts = dict(RAW["failure_taxonomy"])
    assert counts.pop("rollouts") == sum(counts.values()) == 150


def test_demonstration_statistics_add_up() -> None:
    families = [RAW["demo_statistics"][name] for name in MEMORY_TYPES]
    total = RAW["demo_statistics"]["total"]
    assert sum(f["steps"] for f in families) == total["steps"] == 927_444
    assert sum(f["episodes"] for f in families) == sum(LENGTH_BUCKETS.values()) == total["episodes"]
    assert sum(f["gib"] for f in families) == pytest.approx(total["gib"], abs=0.01)
    for family in families:
        assert family["mean"] == pytest.approx(family["steps"] / family["episodes"], abs=0.1)


def test_cards_of_datasets_have_the_papers_statistics() -> None:
    published = RAW["demo_statistics"].items()
    assert {name: tuple(v for key, v in row.items() if key != "gib") for name, row in published} == FAMILIES
    least = {int(name.rstrip("+").split("-")[0]): count for name, count in RAW["length_buckets"].items()}
    assert least == LENGTH_BUCKETS


def test_tables_with_evaluations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paper: "oracle memory closes 45.5% of the MUR gap and 54.9% of the MCR gap, but only 20.2% of the MSR gap"."""
    monkeypatch.syspath_prepend(EXAMPLES / "paper")
    example = runpy.run_path(str(EXAMPLES / "paper" / "tables.py"))
    (run,) = read_runs([logs.evaluation(tmp_path / "a")])
    changed = replace(run, protocol={**run.protocol, "horizon": 600, "suite": "strict"})
    assert example["departures"](changed)[len(example["departures"](run)) :] == [
        *("suite strict, not published", "horizon 600, not 1200"),
    ]
    report = example["paper_report"]([run])
    text = WRITERS["markdown"](report)
    assert "| paper: π0.5 + memory module | pixels | 5 | 9.8 | 92.0 | 32.2 | 10.0 |" in text
    assert text.count("| paper: ") == 43
    assert "| stale memory first update | 63 | 42.0" in text
    (average,) = [line for line in text.splitlines() if line.startswith("| **average**")]
    assert [cell.strip("* ") for cell in average.split("|")][-4:-1] == ["20.2", "45.5", "54.9"]
    assert "| shuffled | 90.0 | 24.0 | 2.0 |" in text
    assert r"$\pi_{0.5}$ + memory module" in WRITERS["latex"](report)
