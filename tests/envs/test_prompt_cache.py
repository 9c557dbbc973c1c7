"""A prompt that is restored from its file equals the simulated one, to the bit; files are data, and bounded."""

from __future__ import annotations

import dataclasses
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs import prompt_cache
from lerobot_memobench.envs.episode import Episode, first_execution_step
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.prompt_cache import Prompt, RestoredPrompt, prompt_file, prompt_of
from lerobot_memobench.envs.settings import BOTH, OBJECTS, RESET, STEPS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import ACTION_DIM, PROMPT
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import STRICT_PROMPT_STEPS, Task

HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
ROUTINE = "put_the_butter_into_the_bowl_from_the_prompt_video"
PROCEDURE = "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"
HIDING = "find_the_artichoke_hidden_in_one_of_the_drawers"
TWO_HIDDEN = "find_the_artichoke_or_the_chestnut_hidden_in_two_of_the_drawers"
HORIZON = 5


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Turn the cache on; return the folder of its files."""
    monkeypatch.delenv(prompt_cache.VARIABLE)
    monkeypatch.setattr(prompt_cache, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "prompts"


# --- equal to the bit ---


def facts(env: MemobenchEnv, observation: dict[str, Any], outcome: tuple[Any, ...]) -> dict[str, bytes | object]:
    """Return all that may be asked after a control step, as bytes where it is numbers."""
    episode, sim = env.episode, env.episode.sim
    snapshot = sim.snapshot()
    task = episode.task
    atoms = [Atom("handhome", ()), Atom("asbegun", ()), *(Atom("inplace", (name,)) for name in task.objects)]
    arrays = {
        **{name: value for name, value in observation.items() if name != "pixels"},
        **observation["pixels"],
        "state": sim.state(),
        "physics": snapshot.physics,
        "goal": np.concatenate([snapshot.goal_position, snapshot.goal_rotation.ravel(), snapshot.gripper]),
        "applied": episode.applied_action,
        "bodies": sim.data.xpos,
        "contacts": np.column_stack([sim.data.contact.geom, sim.data.contact.dist]),
        "bias": sim.data.qfrc_bias,
    }
    return {
        **{name: np.ascontiguousarray(value).tobytes() for name, value in arrays.items()},
        "atoms": [sim.holds(atom) for atom in atoms],
        "highlights": sim.highlights,
        "hash": (env.scene_hash(), episode.scene_hash),
        "outcome": outcome,
        "goes on": snapshot.goes_on,
    }


def rollout(name: str, seed: int, log: Path, prompt_in: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Run one short episode; return the facts of each of its frames, and its line in the log."""
    settings: dict[str, Any] = {
        "referent": "random",
        "render": "fast",
        "obs_type": BOTH,
        "horizon": HORIZON,
        "seed_base": 7,
    }
    env = MemobenchEnv(name, log_dir=str(log), prompt_in=prompt_in, **settings)
    observation, info = env.reset(seed=seed)
    frames, over = [facts(env, observation, (info,))], False
    while not over:
        rng = np.random.default_rng(env.episode.exec_steps)
        observation, *outcome, info = env.step(rng.uniform(-1, 1, ACTION_DIM).astype(np.float32))
        frames.append(facts(env, observation, (*outcome, info)))
        over = bool(outcome[1] or outcome[2])
    (line,) = read_episodes(log)
    return frames, {key: value for key, value in line.items() if key not in ("wall_s", "written_at")}


def count_steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list with the number of simulated control steps so far."""
    count, step = [0], Simulation.step

    def counted(sim: Simulation, action: Any) -> None:
        count[0] += 1
        step(sim, action)

    monkeypatch.setattr(Simulation, "step", counted)
    return count


def seed_that_idles_little(name: str) -> int:
    """Return the first seed for trying out after whose prompt the robot idles a second at most."""
    task = get_task(name)
    return next(s for s in range(20_000, 21_000) if first_execution_step(task, s, True) - (task.prompt_steps or 0) < 20)


@pytest.mark.parametrize(
    ("name", "longest"),
    [
        (HIGHLIGHT, None),
        (PROCEDURE, 60),
        (HIDING, 90),
        *(pytest.param(name, None, marks=pytest.mark.slow) for name in (ROUTINE, PROCEDURE, HIDING, TWO_HIDDEN)),
    ],
)
def test_a_rollout_is_the_same_without_the_cache_while_it_is_written_and_from_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, longest: int | None
) -> None:
    if longest is not None:
        monkeypatch.setattr(episode_module, "PROMPT_HORIZON", longest)
        monkeypatch.setitem(STRICT_PROMPT_STEPS, "hide", longest)
    seed, count, runs, steps = seed_that_idles_little(name), count_steps(monkeypatch), {}, {}
    for run, off in {"simulated": "off", "written": "", "restored": ""}.items():
        monkeypatch.setenv(prompt_cache.VARIABLE, off)
        count[0] = 0
        runs[run] = rollout(name, seed, tmp_path / run, STEPS)
        steps[run] = count[0]
        assert folder.exists() != bool(off)
    assert steps["simulated"] == steps["written"] > steps["restored"] == STABILISATION_STEPS + HORIZON
    simulated, line = runs["simulated"]
    for frames, found in (runs["written"], runs["restored"]):
        assert found == line
        for k, (frame, expected) in enumerate(zip(frames, simulated, strict=True)):
            assert [part for part in expected if frame[part] != expected[part]] == [], k
    if longest is None:
        assert line["prompt_shown"]
        assert all(frame["goes on"] for frame in simulated[1:40]) != (get_task(name).idles)  # home's detent
    frames, found = rollout(name, seed, tmp_path / "its end", RESET)
    assert found == line
    assert len(frames) == 1 + HORIZON
    for frame, expected in zip(frames, simulated[line["prompt_steps"] :], strict=True):
        assert [part for part in expected if frame[part] != expected[part] and part != "outcome"] == []
    assert len([*folder.iterdir()]) == 1


# --- files: short prompts of a scene, without pictures ---


class Nod:
    """A prompt of three control steps; ``broken`` ends it by an error."""

    shown = True

    def __init__(self, broken: bool = False) -> None:
        self.broken = broken

    def actions(self) -> Iterator[NDArray[np.float64]]:
        """Yield up, down, rest."""
        yield 0.5 * np.eye(7)[2]
        if self.broken:
            raise MemobenchError("out of reach")
        yield -0.5 * np.eye(7)[2]
        yield NO_OP


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(get_task(HIGHLIGHT))


def play(sim: Simulation, file: Path | None, broken: bool = False) -> tuple[type, bytes]:
    """Play a short prompt; return by what, and the simulation's state after it."""
    sim.reset(7)
    prompt = prompt_of(Nod(broken), sim, 100, file)  # type: ignore[arg-type]
    while not prompt.over:
        prompt.step()
    assert prompt.shown
    return type(prompt), sim.snapshot().physics.tobytes()


def arrays(file: Path) -> dict[str, NDArray[Any]]:
    with np.load(file) as stored:
        return dict(stored)


def resave(file: Path, change: dict[str, Any]) -> None:
    np.savez(file, **(arrays(file) | change))


DAMAGE: dict[str, Callable[[Path], object]] = {
    "empty": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-200]),
    "a bit": lambda file: file.write_bytes(b"".join([(b := file.read_bytes())[:900], bytes([b[900] ^ 1]), b[901:]])),
    "text": lambda file: file.write_text("no prompt"),
    "one array": lambda file: file.write_bytes(np.lib.format.magic(1, 0)),
    "of another prompt": lambda file: resave(file, {"name": np.array("other.npz")}),
    "of another scene": lambda file: resave(file, {"physics": arrays(file)["physics"][:, :-1]}),
    "in single precision": lambda file: resave(file, {"physics": arrays(file)["physics"].astype(np.float32)}),
    "without a step": lambda file: resave(file, {k: v[:0] for k, v in arrays(file).items() if v.ndim}),
    "pickled": lambda file: resave(file, {"actions": np.array([print], dtype=object)}),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_or_foreign_file_is_ignored_and_written_again(folder: Path, sim: Simulation, damage: str) -> None:
    file = folder / "prompt.npz"
    kind, state = play(sim, file)
    before = arrays(file)
    assert (kind, play(sim, file)) == (Prompt, (RestoredPrompt, state))
    DAMAGE[damage](file)
    assert play(sim, file) == (Prompt, state)
    assert {k: v.tobytes() for k, v in arrays(file).items()} == {k: v.tobytes() for k, v in before.items()}


def test_a_prompt_that_raised_an_error_raises_it_again_and_is_not_kept(folder: Path, sim: Simulation) -> None:
    for _ in range(2):
        with pytest.raises(MemobenchError, match="out of reach"):
            play(sim, folder / "prompt.npz", broken=True)
    sim.reset(7)
    prompt = prompt_of(Nod(broken=True), sim, 100, folder / "prompt.npz")  # type: ignore[arg-type]
    with pytest.raises(MemobenchError):
        prompt.step()
    while not prompt.over:  # a caller that goes on
        prompt.step()
    assert not folder.exists()


def test_the_files_used_least_recently_are_removed(
    folder: Path, sim: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [folder / f"{name}.npz" for name in "abc"]
    for age, file in enumerate(files):
        play(sim, file)
        os.utime(file, (age, age))
    dead = folder / ".1-0.part.d.npz"
    dead.write_bytes(b"0" * files[0].stat().st_size)
    os.utime(dead, (1, 1))
    assert play(sim, files[0])[0] is RestoredPrompt  # which makes it the newest
    monkeypatch.setattr(prompt_cache, "LARGEST", 3 * files[0].stat().st_size)
    play(sim, folder / "e.npz")
    assert sorted(file.name for file in folder.iterdir()) == ["a.npz", "c.npz", "e.npz"]


def test_a_folder_that_takes_nothing_costs_a_warning(
    folder: Path, sim: Simulation, caplog: pytest.LogCaptureFixture
) -> None:
    folder.parent.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        kinds = {play(sim, folder / f"{name}.npz") for name in "ab"}
    assert kinds == {play(sim, None)}
    assert [str(folder) in record.message and "=off" in record.message for record in caplog.records] == [True]


# --- what a file is of ---


def test_a_prompt_is_known_by_all_that_it_depends_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = get_task(HIGHLIGHT)

    def file(task: Task = task, seed: int = 7, scene: str = "0") -> Path | None:
        return prompt_file(task, seed, scene)

    prompt = dataclasses.replace(task.prompt, target="plate_1") if task.prompt else None
    files = [
        file(),
        file(task.variant(1)),
        file(seed=8),
        file(scene="1"),
        file(dataclasses.replace(task, prompt=prompt)),
    ]
    monkeypatch.setattr(prompt_cache, "_code", lambda: ("a later MuJoCo",))
    assert len({*files, file()}) == 6
    assert file() == file(dataclasses.replace(task, folder=Path("elsewhere")))
    assert {path.parent for path in files if path} == {folder}
    monkeypatch.setenv(prompt_cache.VARIABLE, "off")
    assert file() is None


def test_only_prompts_of_named_seeds_are_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode_module, "PROMPT_HORIZON", 3)
    env = MemobenchEnv(HIGHLIGHT, obs_type=OBJECTS, prompt_in=RESET)
    env.reset()
    assert not folder.exists()
    env.reset(seed=7)
    env.reset(seed=7, options={})
    assert len([*folder.iterdir()]) == 1


PROCESS = """
import sys
from pathlib import Path
from lerobot_memobench.envs import episode, prompt_cache
from lerobot_memobench.tasks.catalogue import get_task
prompt_cache.cache_folder = lambda: Path(sys.argv[1])
episode.PROMPT_HORIZON = 12
playing = episode.Episode(get_task(sys.argv[2]))
playing.reset(7, keep_prompt=True)
while playing.phase == 0:
    before = playing.sim.scene_hash()
    playing.step(None)
print(before)
"""


def test_processes_share_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two at once, which hash texts by other seeds; then this one, which simulates nothing."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", PROCESS, str(folder.parent), HIGHLIGHT],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        )
        for seed in "12"
    ]
    first, second = (process.communicate()[0] for process in processes)
    assert first == second
    assert [file.suffix for file in folder.iterdir()] == [".npz"]
    count, episode = count_steps(monkeypatch), Episode(get_task(HIGHLIGHT))
    episode.reset(7, keep_prompt=True)
    while episode.phase == PROMPT:
        before = episode.sim.scene_hash()
        episode.step(NO_OP)
    assert (before, count) == (first.strip(), [STABILISATION_STEPS])
