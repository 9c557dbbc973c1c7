"""The evaluation loop without a policy and a simulator: it writes the log that they would leave."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.episode_log import EpisodeLog, has_log, read_episodes
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.rollouts.card import with_checkpoint
from lerobot_memobench.rollouts.plan import Cell, EvaluationPlan
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.tasks.task import Task

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "check_the_top_drawer_of_the_cabinet"


class Killed(Exception):
    """The run ends here."""


class FakeLoop:
    """Replacement of `rollouts.evaluate.evaluate` that records its arguments.

    Attributes:
        plans: of each call. cells: batches of each call.
        ran: (task, episode) simulated, in order.
        kill_after: the run ends when this number of further episodes is logged.
        changed: fields that records get instead of their usual ones.
        unrun: (task, episode) that cannot be run.
        before: called with the plan when a call begins.
    """

    def __init__(self) -> None:
        self.plans: list[EvaluationPlan] = []
        self.cells: list[Sequence[Cell]] = []
        self.ran: list[tuple[str, int]] = []
        self.kill_after: int | None = None
        self.changed: dict[str, Any] = {}
        self.unrun: set[tuple[str, int]] = set()
        self.before: Callable[[EvaluationPlan], object] = lambda plan: None

    def __call__(self, plan: EvaluationPlan, cells: Sequence[Cell], card: dict[str, Any], advance: Any) -> None:
        self.plans.append(plan)
        self.cells.append(cells)
        write_evaluation(plan.log, with_checkpoint(card, plan))
        self.before(plan)
        log = EpisodeLog(plan.log)
        logged = read_episodes(plan.log) if has_log(plan.log) else []
        skipped = {(record["task"], record["episode"]) for record in logged}
        for cell in cells:
            for name, episode in plan.grid.episodes(cell):
                if (name, episode) in skipped:
                    continue
                if self.kill_after is not None:
                    if self.kill_after == 0:
                        raise Killed
                    self.kill_after -= 1
                self.ran.append((name, episode))
                log.append(self.record(load_task(cell[0]), episode, plan.environment.seed_base + episode))
            advance(len(self.ran), len(self.ran), cell[0].name)

    def record(self, task: Task, episode: int, seed: int) -> dict[str, Any]:
        return {
            "task": task.name,
            "memory_type": task.memory_type,
            "episode": episode,
            "seed": seed,
            "success": seed % 2 == 1,
            "steps": 100 + seed % 1000,
            "checkpoints": [
                {"operation": c.operation, "first_step": seed, "ordered_step": seed} for c in task.checkpoints
            ],
            "failure": None if seed % 2 else "storage_failure" if task.checkpoints else "execution_failure",
            "scene_hash": f"{task.name[:4]}{seed:012d}",
            "wall_s": 1.0,
            **({"not_run": "no scene"} if (task.name, episode) in self.unrun else {}),
            **self.changed,
        }

    def killed_after(self, count: int, *words: str) -> None:
        """Run ``lerobot`` and end it after a number of episodes."""
        self.kill_after = count
        with pytest.raises(Killed):
            main(words)
        self.kill_after = None
        self.ran.clear()


@pytest.fixture
def fake_loop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeLoop:
    """The loop is replaced, and the current folder is an empty one."""
    import lerobot_policy_memobench  # noqa: F401 - LeRobot would find it by a search of all installed packages

    monkeypatch.setattr("lerobot_memobench.commands.command_line.register_plugins", lambda: None)
    monkeypatch.chdir(tmp_path)
    fake = FakeLoop()
    monkeypatch.setattr("lerobot_memobench.rollouts.evaluate.evaluate", fake)
    return fake


def make_checkpoint(folder: Path, kind: str = "memobench_random", **config: Any) -> Path:
    """Write a checkpoint folder of a policy that needs no statistics."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"type": kind, "device": "cpu", **config}))
    save_file({"weight": np.zeros(1, np.float32)}, folder / "model.safetensors")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (folder / name).write_text(json.dumps({"name": name, "steps": []}))
    return folder


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def results(folder: str) -> list[Any]:
    """Return log and report of an evaluation, without times."""
    log = [{key: value for key, value in line.items() if key != "wall_s"} for line in read_episodes(Path(folder))]
    return [log, json.loads(Path(folder, "report.json").read_text())]
