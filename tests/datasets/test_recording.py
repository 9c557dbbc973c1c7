"""Recording, perturbation and generation in the simulator, without images."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels
from lerobot_memobench.datasets.generation import generate
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import is_dataset
from lerobot_memobench.datasets.lerobot_format.reading import read_episode
from lerobot_memobench.datasets.recording import HOLD_FRAMES, PATIENCE, Perturbation
from lerobot_memobench.datasets.validate import replay
from lerobot_memobench.envs.episode import Episode, first_execution_step
from lerobot_memobench.protocol import CAMERAS, NO_CLOCK
from lerobot_memobench.sim.object_layout import SLOTS, STARTS
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.datasets.conftest import BUTTER, STOVE
from tests.support.kills import hashes
from tests.support.short_demonstrations import beginning, record_demonstration

HIDDEN = "find_the_tomato_hidden_in_one_of_the_drawers"
HIGHLIGHT = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
SEED = 10_000
IDLING_SEED = SEED + 2
"""Seed with few rounds and a short rest."""
RUNS = Path(__file__).parents[2] / "results" / "demonstrations.parquet"
FULL_RUNS = {"published": "demonstration", "strict": "strict demonstration"}
"""Suite -> run of 1,500 demonstrations with hashes; the strict ones are from before idling."""


def kept_hashes(suite: str) -> pd.DataFrame:
    """Return task, seed and hash of the kept demonstrations of a suite."""
    table: pd.DataFrame = pd.read_parquet(RUNS)
    return table[table["run"] == FULL_RUNS[suite]]


@pytest.mark.parametrize(("suite", "solved"), [("published", 1_500), ("strict", 1_499)])
def test_committed_runs_are_complete(suite, solved):
    table = kept_hashes(suite)
    assert set(table["task"]) == set(task_names(suite=suite))
    assert all(list(seeds) == list(range(SEED, SEED + 50)) for _, seeds in table.groupby("task")["seed"])
    found = table["sha256"].dropna()
    assert len(found) == found.nunique() == table["solved"].sum() == solved
    assert found.str.fullmatch("[0-9a-f]{64}").all()


@pytest.fixture(scope="module")
def moved() -> Demonstration:
    """A perturbed demonstration with a highlight in its prompt."""
    return record_demonstration(get_task(MILK), SEED + 1, images=False, referent="random", perturb=True)


def test_recorded_demonstration(stove):
    assert replay(stove) is None
    found = labels(stove)
    assert (stove.success, stove.exec_start, found.operation[-1]) == (True, 0, -1)
    assert (found.key_frames >= 0).all()
    assert (np.diff(found.key_frames) >= 0).all()
    assert found.key_frames[-1] <= len(stove) - HOLD_FRAMES
    # After success the knob is still turned for some steps, then released.
    assert stove.actions[-HOLD_FRAMES, 3:6].min() < -0.2
    np.testing.assert_array_equal(stove.actions[[-HOLD_FRAMES, -1], 6], [1, -1])
    assert np.abs(stove.actions).max() <= 1
    assert digest(record_demonstration(get_task(STOVE), SEED, images=False)) == digest(stove), "repeatable"


def test_prompt_ends_in_the_start_state():
    demo = record_demonstration(get_task(BUTTER), SEED, images=False)
    assert demo.success
    assert replay(demo) is None
    start = demo.exec_start
    assert 0 < start < len(demo)
    np.testing.assert_array_equal(demo.states[start], demo.states[0])
    assert not np.array_equal(demo.states[start - 1], demo.states[0])
    assert not demo.satisfied[:start].any()
    without = record_demonstration(get_task(BUTTER), SEED, images=False, demonstration_prompt=False)
    assert (without.exec_start, without.scene_hash) == (0, demo.scene_hash)


@pytest.mark.parametrize("name", [COUNTING, pytest.param(HIGHLIGHT, marks=pytest.mark.slow)])
def test_idle_frames(name):
    """Their actions are zeros, the scene rests in the execution's first state, and the execution has no clock."""
    demo = record_demonstration(get_task(name), IDLING_SEED, images=False, referent="drawn", perturb=True)
    begins, found = first_execution_step(get_task(name), IDLING_SEED, True), labels(demo)
    assert demo.success
    assert demo.exec_start == begins > 0
    np.testing.assert_array_equal(found.step, [*range(begins), *[NO_CLOCK] * (len(demo) - begins)])
    np.testing.assert_array_equal(found.phase, np.arange(len(demo)) >= begins)
    idle = ~demo.actions.any(axis=1)
    rest = int(np.flatnonzero(idle)[0])
    assert (rest == 0) == (demo.task.prompt is None)
    np.testing.assert_array_equal(np.flatnonzero(idle), np.arange(rest, begins))
    for column in (demo.states, demo.proprio, demo.objects):
        assert (column[rest:begins] == column[begins]).all()
    assert replay(demo) is None


@pytest.mark.slow
def test_replay_of_a_hiding_agrees():
    """Hidden objects are restored to the bit, with and without an observation between the last step and the reset."""
    assert replay(record_demonstration(get_task(HIDDEN), SEED, images=False, referent="drawn")) is None


def test_perturbed_demonstration(moved, tmp_path):
    assert moved.success
    assert moved.variant == moved.task.variant_index
    off = np.abs(moved.executed - moved.actions)
    assert not off[: moved.exec_start].any(), "the prompt is not perturbed"
    assert (off[moved.exec_start : -HOLD_FRAMES, :6].max(axis=1) > 0).mean() > 0.9
    labelled, applied = moved.actions[moved.exec_start :, 6], moved.executed[moved.exec_start :, 6]
    assert (applied <= labelled).all(), "fingers may open early, but do not close early"
    assert replay(moved) is None
    lit = moved.objects.reshape(len(moved), SLOTS, -1)[..., STARTS["highlighted"]].any(axis=1)
    assert lit[: moved.exec_start].any()
    assert not lit[moved.exec_start :].any()
    demo = beginning(moved, moved.exec_start + 20)
    np.testing.assert_array_equal(demo.states, moved.states[: len(demo)])
    episode = read_episode(write_dataset([demo], tmp_path / "ds"), 0)
    np.testing.assert_array_equal(episode.columns["executed_action"], demo.applied)
    np.testing.assert_array_equal(episode.columns["action"], demo.actions)
    assert replay(episode) is None
    seen = episode.columns.pop("observation.environment_state")
    seen[moved.exec_start, 3] += 0.01
    for column in ("observation.environment_state", "privileged.environment_state"):
        found = replay(replace(episode, columns=episode.columns | {column: seen}))
        assert (found.column, found.frame) == (column, moved.exec_start)


@pytest.mark.slow
def test_perturbed_arm_comes_to_rest_at_home():
    """Otherwise rounds of a counting task would neither begin nor end."""
    counted = record_demonstration(get_task(COUNTING), SEED + 1, images=False, referent="random", perturb=True)
    assert counted.success
    assert np.abs(counted.applied - counted.actions)[:, :6].max(axis=1).any()


def test_shares_of_perturbations():
    """A third of the episodes is clean; of the others' grasps a fifth is pushed up, 15 % turned, a twentieth dropped.

    A fifth of the openings is late.
    """
    zero, opens, closes = (np.array([0, 0, 0, 0, 0, 0, grip], np.float32) for grip in (0, -1, 1))
    clean = [not Perturbation(np.random.default_rng(seed)).executed(zero).any() for seed in range(600)]
    assert 150 < sum(clean) < 250
    up, turned, dropped, late = 0, 0, 0, 0
    for seed in range(1000):
        moves = Perturbation(np.random.default_rng(seed))
        assert moves.executed(opens)[6] < 0
        done = np.array([moves.executed(closes) for _ in range(60)])
        up += done[:4, 2].mean() > 0.5
        turned += (waits := int((done[:6, 6] < 0).sum())) > 0
        assert waits == 0 or (3 <= waits < 6 and (done[:waits, 6] < 0).all())
        let_go = np.flatnonzero(done[6:, 6] < 0)
        dropped += len(let_go) > 0
        assert len(let_go) in (0, 8)
        assert not (let_go < 8).any(), "after the grasp"
        stays = np.flatnonzero([moves.executed(opens)[6] > 0 for _ in range(20)])
        late += len(stays) > 0
        assert len(stays) == 0 or (3 <= len(stays) < 16 and stays[-1] == len(stays) - 1)
    assert 0.08 < up / 1000 < 0.2
    assert 0.06 < turned / 1000 < 0.15
    assert 0.02 < dropped / 1000 < 0.05
    assert 0.09 < late / 1000 < 0.18


def test_episode_ends_after_the_experts_plan(monkeypatch):
    """Long before the horizon, if the goal is not reached."""
    monkeypatch.setattr(Episode, "expert_action", lambda episode: np.zeros(7, dtype=np.float32))
    monkeypatch.setattr(Episode, "expert_done", property(lambda episode: episode.exec_steps >= 30))
    demo = record_demonstration(get_task(STOVE), SEED, images=False)
    assert not demo.success
    assert len(demo) == 30 + PATIENCE + HOLD_FRAMES


def children(pid: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found += [int(entry.name), *children(int(entry.name))]
    return found


def alive(pid: int) -> bool:
    try:
        return (Path(f"/proc/{pid}") / "stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_killed_command_ends_its_workers_and_resumes(tmp_path):
    """kill -9 of the command ends its two workers; the resumed run equals an undisturbed one with one worker."""
    out, task = tmp_path / "ds", get_task(STOVE)
    pid = os.fork()
    if not pid:
        with contextlib.suppress(BaseException):
            generate([task], 3, out, images=False, workers=2)
        os._exit(1)
    try:
        deadline = time.monotonic() + 300
        while not list(out.glob(".staging/episodes/[0-9]*")):
            assert os.waitpid(pid, os.WNOHANG)[0] == 0
            assert time.monotonic() < deadline
            time.sleep(0.05)
        workers = children(pid)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    assert workers
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "workers outlived the command"
        time.sleep(0.05)
    assert not is_dataset(out)
    summary = generate([task], 3, out, images=False, workers=1)
    assert summary.exit_status == 0
    generate([task], 3, tmp_path / "undisturbed", images=False, workers=1)
    assert hashes(out) == hashes(tmp_path / "undisturbed")


RECORD = """
import sys
from pathlib import Path
from lerobot_memobench.datasets.recording import RecordingJob, RecordingSettings
from lerobot_memobench.datasets.staging import staged
from lerobot_memobench.tasks.catalogue import get_task

job = RecordingJob(get_task(sys.argv[1]), int(sys.argv[2]), RecordingSettings(images=False), Path(sys.argv[3]))
job.run()
made = staged(job)
print(made.failure or made.info["digest"])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("suite", "name"), [("published", name) for name in task_names()])
def test_committed_run_is_repeated(suite, name, tmp_path):
    """The first seed of each task has the committed hash, or the committed reason of failure.

    OpenBLAS selects its kernels, which round differently, by processor, unless a variable is set before NumPy is
    imported; therefore another process records.
    """
    environment = {**os.environ, "OPENBLAS_CORETYPE": "Haswell"}
    command = [sys.executable, "-c", RECORD, name, str(SEED), str(tmp_path / "episode")]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    table = kept_hashes(suite)
    assert run.stdout.strip() == table.loc[(table["task"] == name) & (table["seed"] == SEED), "sha256"].item()


@pytest.mark.slow
def test_decoded_frames_equal_the_simulators(tmp_path):
    """Decode an episode's video and render its states again."""
    from lerobot.datasets import LeRobotDataset

    task = get_task(STOVE)
    generate([task], 1, tmp_path / "ds")
    dataset = LeRobotDataset("local/test", root=tmp_path / "ds")
    episode = read_episode(tmp_path / "ds", 0)
    sim = Simulation(task)
    sim.reset(SEED)
    for t in range(0, len(dataset), 7):
        sim.set_state(episode.columns["states"][t])
        for name, camera in CAMERAS.items():
            seen = (dataset[t][f"observation.images.{name}"] * 255).permute(1, 2, 0).numpy()
            error = ((sim.render(camera).astype(np.float32) - seen) ** 2).mean()
            assert 10 * np.log10(255**2 / error) > 32, (t, name)
