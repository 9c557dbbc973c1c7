"""The evaluation loop without a policy and a simulator: it writes the log that they would leave."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, has_log, read_episodes
from lerobot_memobench.envs.evaluation_file import write_protocol
from lerobot_memobench.run.plan import Cell, EvaluationPlan
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.tasks.task import Task


class Killed(Exception):
    """The run ends here."""


class FakeLoop:
    """Stands for `run.evaluate.evaluate` and remembers what it was asked for.

    Attributes:
        plans: of each call. cells: batches of each call.
        ran: (task, episode) simulated, in order.
        kill_after: the run ends when so many more episodes are logged.
        changed: fields that records get instead of their usual ones.
        before: called with the plan when a call begins.
    """

    killed = Killed

    def __init__(self) -> None:
        self.plans: list[EvaluationPlan] = []
        self.cells: list[Sequence[Cell]] = []
        self.ran: list[tuple[str, int]] = []
        self.kill_after: int | None = None
        self.changed: dict[str, Any] = {}
        self.before: Callable[[EvaluationPlan], object] = lambda plan: None

    def __call__(self, plan: EvaluationPlan, cells: Sequence[Cell], begin: Callable[[], None], advance: Any) -> None:
        self.plans.append(plan)
        self.cells.append(cells)
        begin()
        self.before(plan)
        log = EpisodeLog(plan.log, partial(write_protocol, plan.log, plan.environment.settings.protocol_block))
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
                log.append(self.record(load_task(cell[0].folder), episode, plan.environment.seed_base + episode))
            advance(len(self.ran), len(self.ran), cell[0].name)

    def value(self, key: str) -> str | None:
        """Return a setting of the last plan, by LeRobot's key, as text."""
        plan = self.plans[-1]
        words = dict(word.removeprefix("--").split("=", 1) for word in plan.settings.words)
        return {"output_dir": str(plan.output), "env.log_dir": str(plan.log)}.get(key, words.get(key))

    def record(self, task: Task, episode: int, seed: int) -> dict[str, Any]:
        return {
            "task": task.name,
            "memory_type": task.memory_type,
            "episode": episode,
            "seed": seed,
            "referent": "fixed",
            "replan_steps": None,
            "success": seed % 2 == 1,
            "steps": 100 + seed,
            "checkpoints": [
                {"operation": c.operation, "first_step": seed, "ordered_step": seed} for c in task.checkpoints
            ],
            "failure": None if seed % 2 else "storage_failure",
            "scene_hash": f"{task.name[:4]}{seed:012d}",
            "wall_s": 1.0,
            **self.changed,
        }


@pytest.fixture
def fake_loop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeLoop:
    """The loop is replaced, and the present folder is an empty one."""
    import lerobot_policy_memobench  # noqa: F401 - what LeRobot would find by looking through all that is installed

    for module in ("arguments", "settings"):
        monkeypatch.setattr(f"lerobot_memobench.run.{module}.register_plugins", lambda: None)
    monkeypatch.chdir(tmp_path)
    fake = FakeLoop()
    monkeypatch.setattr("lerobot_memobench.run.run.evaluate", fake)
    return fake
