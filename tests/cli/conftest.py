"""LeRobot's evaluation without LeRobot's policy and the simulator: what its loop would leave in the log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import EpisodeLog, has_log, read_episodes
from lerobot_memobench.run.arguments import flag_value
from lerobot_memobench.tasks.catalogue import load_task


class Killed(Exception):
    """The run ends here."""


class FakeLeRobot:
    """Stands for LeRobot's command and remembers what it was asked for.

    Attributes:
        calls: flags of each call.
        ran: (task, episode) simulated, in order.
        kill_after: the run ends when so many more episodes are logged.
        changed: fields that records get instead of their usual ones.
    """

    killed = Killed

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from lerobot.scripts import lerobot_eval  # late: tests of other commands need not wait for it

        self.calls: list[list[str]] = []
        self.ran: list[tuple[str, int]] = []
        self.kill_after: int | None = None
        self.changed: dict[str, Any] = {}

        def main() -> None:
            self.evaluate(sys.argv[1:])

        main.__module__ = lerobot_eval.__name__
        monkeypatch.setattr(lerobot_eval, "main", main)
        monkeypatch.setattr(lerobot_eval, "run_one", self.run_one)

    def evaluate(self, flags: list[str]) -> None:
        from lerobot.scripts import lerobot_eval

        from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

        self.calls.append(flags)
        names = {"horizon": int, "seed_base": int, "referent": str, "tasks": str, "task": str, "log_dir": str}
        given = {name: flag_value(flags, f"env.{name}") for name in names}
        config = MemobenchEnvConfig(**{key: names[key](value) for key, value in given.items() if value is not None})
        self.log = EpisodeLog(config.resolved_log_dir(), config.agreed_settings)
        self.resume = flag_value(flags, "env.resume") == "true"
        self.base = config.seed_base
        self.batch = int(flag_value(flags, "eval.batch_size") or 1)
        output = Path(flag_value(flags, "output_dir") or "")
        for suite, number, folder in config.selected():
            self.task = load_task(folder)
            lerobot_eval.run_one(
                suite,
                number,
                None,
                n_episodes=int(flag_value(flags, "eval.n_episodes") or 0),
                start_seed=int(flag_value(flags, "seed") or 0),
                videos_dir=output / "videos",
            )
        output.mkdir(parents=True, exist_ok=True)
        (output / "eval_info.json").write_text("{}")

    def run_one(self, suite: str, number: int, env: Any, **settings: Any) -> Any:
        """Log the episodes of whole batches, but for those that the environment leaves out."""
        count = -(-settings["n_episodes"] // self.batch) * self.batch
        logged = read_episodes(self.log.directory) if self.resume and has_log(self.log.directory) else []
        skipped = {record["episode"] for record in logged if record["task"] == self.task.name}
        for seed in range(settings["start_seed"], settings["start_seed"] + count):
            if seed - self.base in skipped:
                continue
            if self.kill_after is not None:
                if self.kill_after == 0:
                    raise Killed
                self.kill_after -= 1
            self.ran.append((self.task.name, seed - self.base))
            self.log.append(self.record(seed))
        return suite, number, {"successes": [True] * count}

    def record(self, seed: int) -> dict[str, Any]:
        return {
            "task": self.task.name,
            "memory_type": self.task.memory_type,
            "episode": seed - self.base,
            "seed": seed,
            "referent": "fixed",
            "replan_steps": None,
            "success": seed % 2 == 1,
            "steps": 100 + seed,
            "checkpoints": [
                {"operation": c.operation, "first_step": seed, "ordered_step": seed} for c in self.task.checkpoints
            ],
            "failure": None if seed % 2 else "storage_failure",
            "scene_hash": f"{self.task.name[:4]}{seed:012d}",
            "wall_s": 1.0,
            **self.changed,
        }


@pytest.fixture
def fake_lerobot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeLeRobot:
    """LeRobot is replaced, and the present folder is an empty one."""
    import lerobot_policy_memobench  # noqa: F401 - what LeRobot would find by looking through all that is installed

    monkeypatch.setattr("lerobot_memobench.run.arguments.register_plugins", lambda: None)
    monkeypatch.chdir(tmp_path)
    return FakeLeRobot(monkeypatch)
