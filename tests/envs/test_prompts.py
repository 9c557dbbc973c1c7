"""A prompt restored from its file equals the simulated one, bit for bit; files are validated, shared and limited."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs import prompts
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.prompts import PromptPlayer, RestoredPrompt, prompt_file, prompt_player
from lerobot_memobench.envs.settings import BOTH, OBJECTS, STEPS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import STRICT_PROMPT_STEPS, Task

HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
PROCEDURE = "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"
HIDING = "find_the_artichoke_hidden_in_one_of_the_drawers"
TWO_HIDDEN = "find_the_artichoke_or_the_chestnut_hidden_in_two_of_the_drawers"
HORIZON = 3


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Turn the cache on; return the folder of its files."""
    monkeypatch.delenv(prompts.VARIABLE)
    monkeypatch.setattr(prompts, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "prompts"


# --- restored rollouts ---


def facts(env: MemobenchEnv, observation: dict[str, Any], outcome: tuple[Any, ...]) -> dict[str, object]:
    """Return everything that is observable after a control step, numbers as bytes."""
    episode, sim = env.episode, env.episode.sim
    snapshot = sim.snapshot()
    atoms = [Atom("handhome", ()), Atom("asbegun", ()), *(Atom("inplace", (name,)) for name in episode.task.objects)]
    arrays = {
        **{name: value for name, value in observation.items() if name != "pixels"},
        **observation.get("pixels", {}),
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


def rollout(
    name: str, seed: int, log: Path, prompt_in: str, obs_type: str
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the facts of each frame of a short episode, and its log line."""
    settings: dict[str, Any] = {"referent": "random", "obs_type": obs_type, "seed_base": 7}
    env = MemobenchEnv(name, log_dir=str(log), prompt_in=prompt_in, horizon=HORIZON, **settings)
    observation, info = env.reset(seed=seed)
    frames, over = [facts(env, observation, (info,))], False
    while not over:
        rng = np.random.default_rng(env.episode.exec_steps)
        observation, *outcome, info = env.step(rng.uniform(-1, 1, ACTION_DIM).astype(np.float32))
        frames.append(facts(env, observation, (*outcome, info)))
        over = bool(outcome[1] or outcome[2])
    (line,) = read_episodes(log)
    return frames, {key: value for key, value in line.items() if key not in ("wall_s", "written_at")}


@pytest.mark.parametrize(
    ("name", "longest", "obs_type"),
    [
        (HIGHLIGHT, 40, BOTH),
        (HIDING, 60, OBJECTS),
        *(pytest.param(n, None, BOTH, marks=pytest.mark.slow) for n in (HIGHLIGHT, PROCEDURE, TWO_HIDDEN)),
    ],
)
def test_rollouts_are_equal_without_cache_while_writing_and_restored(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, longest: int | None, obs_type: str
) -> None:
    if longest is not None:
        monkeypatch.setattr(episode_module, "PROMPT_HORIZON", longest)
        monkeypatch.setitem(STRICT_PROMPT_STEPS, "hide", longest)
    simulated, step = [0], Simulation.step

    def counted(sim: Simulation, action: Any) -> None:
        simulated[0] += 1
        step(sim, action)

    monkeypatch.setattr(Simulation, "step", counted)
    monkeypatch.setattr(episode_module, "LONGEST_HOLD", 5)
    seed = 20_000
    runs, steps = {}, {}
    for run, off in {"simulated": "off", "written": "", "restored": ""}.items():
        monkeypatch.setenv(prompts.VARIABLE, off)
        simulated[0] = 0
        runs[run] = rollout(name, seed, tmp_path / run, STEPS, obs_type)
        steps[run] = simulated[0]
        assert folder.exists() != bool(off)
    assert steps["simulated"] == steps["written"] > steps["restored"] == STABILISATION_STEPS + HORIZON
    expected, line = runs["simulated"]
    for frames, found in (runs["written"], runs["restored"]):
        assert found == line
        for k, (frame, wanted) in enumerate(zip(frames, expected, strict=True)):
            assert [part for part in wanted if frame[part] != wanted[part]] == [], k
    if longest is None:
        assert line["prompt_shown"]
    assert len([*folder.iterdir()]) == 1


# --- files ---


class ShortPrompt:
    """A prompt of three control steps; ``broken`` raises an error after the first."""

    succeeded = True

    def __init__(self, broken: bool = False) -> None:
        self.broken = broken

    def actions(self) -> Iterator[NDArray[np.float64]]:
        yield 0.5 * np.eye(7)[2]
        if self.broken:
            raise MemobenchError("out of reach")
        yield -0.5 * np.eye(7)[2]
        yield NO_OP


@pytest.fixture(scope="module")
def sim() -> Simulation:
    return Simulation(get_task(HIGHLIGHT))


def play(sim: Simulation, file: Path | None, broken: bool = False) -> tuple[type, bytes]:
    """Play a short prompt; return its class and the simulation's state after it."""
    sim.reset(7)
    prompt = prompt_player(ShortPrompt(broken), sim, 100, file)  # type: ignore[arg-type]
    while not prompt.over:
        prompt.step()
    assert prompt.succeeded
    return type(prompt), sim.snapshot().physics.tobytes()


def arrays(file: Path) -> dict[str, NDArray[Any]]:
    with np.load(file) as stored:
        return dict(stored)


def resave(file: Path, change: dict[str, Any]) -> None:
    np.savez(file, **(arrays(file) | change))


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-200]),
    "another prompt": lambda file: resave(file, {"name": np.array("other.npz")}),
    "another scene": lambda file: resave(file, {"rows": arrays(file)["rows"][:, :-1]}),
    "no step": lambda file: resave(file, {"rows": arrays(file)["rows"][:0]}),
    "pickled": lambda file: resave(file, {"rows": np.array([print], dtype=object)}),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_file_is_written_again(folder: Path, sim: Simulation, damage: str) -> None:
    file = folder / "prompt.npz"
    kind, state = play(sim, file)
    before = arrays(file)
    assert (kind, play(sim, file)) == (PromptPlayer, (RestoredPrompt, state))
    DAMAGE[damage](file)
    assert play(sim, file) == (PromptPlayer, state)
    assert {k: v.tobytes() for k, v in arrays(file).items()} == {k: v.tobytes() for k, v in before.items()}


def test_failed_prompt_and_unwritable_folder_leave_no_file(
    folder: Path, sim: Simulation, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        with pytest.raises(MemobenchError, match="out of reach"):
            play(sim, folder / "prompt.npz", broken=True)
    assert not folder.exists()
    folder.parent.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        found = {play(sim, folder / f"{name}.npz") for name in "ab"}
    assert found == {play(sim, None)}
    assert [str(folder) in record.message for record in caplog.records] == [True]


def test_least_recently_used_files_are_removed(folder: Path, sim: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [folder / f"{name}.npz" for name in "abc"]
    for age, file in enumerate(files):
        play(sim, file)
        os.utime(file, (age, age))
    dead = folder / ".1-0.part.d.npz"
    dead.write_bytes(b"0" * files[0].stat().st_size)
    os.utime(dead, (1, 1))
    assert play(sim, files[0])[0] is RestoredPrompt  # now the newest
    monkeypatch.setattr(prompts, "LARGEST", 3 * files[0].stat().st_size)
    play(sim, folder / "e.npz")
    assert sorted(file.name for file in folder.iterdir()) == ["a.npz", "c.npz", "e.npz"]


def test_file_name_depends_on_everything_that_affects_the_prompt(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr(prompts, "_code", lambda: ("a later MuJoCo",))
    assert len({*files, file()}) == 6
    assert file() == file(dataclasses.replace(task, folder=Path("elsewhere")))
    assert {path.parent for path in files if path} == {folder}
    monkeypatch.setenv(prompts.VARIABLE, "off")
    assert file() is None
