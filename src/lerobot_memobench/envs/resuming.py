"""Episodes that the log holds already are not run again: their rows of a batch tell how they ended, and rest."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_memobench.envs.annotate import BAND
from lerobot_memobench.envs.episode_log import has_log, read_log
from lerobot_memobench.envs.observations import blank
from lerobot_memobench.protocol import EXECUTION, IMAGE_SIZE


class SkipLogged(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose logged episodes end at their first step, as the log says, without being simulated.

    The batch keeps its size and every other row its place, so a policy gives the rows that do run the actions that it
    would have given them in an undisturbed evaluation. Observations of a skipped episode are blank.

    Args:
        env: a `MemobenchEnv`.
        log_dir: folder of the log, read once, at the first reset.
        referent, seed_base: as the environment's own.
    """

    def __init__(self, env: gym.Env[Any, Any], log_dir: Path, referent: str, seed_base: int) -> None:
        super().__init__(env)
        self._log_dir, self._referent, self._seed_base = log_dir, referent, seed_base
        self._logged: dict[int, dict[str, Any]] | None = None
        self._skipped: dict[str, Any] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the episode of a seed, or let it rest where the log holds it."""
        self._skipped = None if seed is None else self._records().get(seed - self._seed_base)
        if self._skipped is None:
            return self.env.reset(seed=seed, options=options)
        return blank(self.observation_space), self._info(False)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance, or end as the log says."""
        if self._skipped is None:
            return self.env.step(action)
        success = self._skipped["success"]
        return blank(self.observation_space), float(success), success, not success, self._info(success)

    def render(self) -> Any:
        """Return what the environment shows; black while it rests."""
        if self._skipped is None:
            return self.env.render()
        return np.zeros((BAND + IMAGE_SIZE, 2 * IMAGE_SIZE, 3), np.uint8)

    def _info(self, success: bool) -> dict[str, Any]:
        return {"is_success": success, "phase": EXECUTION, "checkpoints_completed": 0}

    def _records(self) -> dict[int, dict[str, Any]]:
        """Episode -> line of the log, of this environment's task and referent."""
        if self._logged is None:
            records = read_log(self._log_dir) if has_log(self._log_dir) else []
            name = self.get_wrapper_attr("task")
            self._logged = {
                record["episode"]: record
                for record in records
                if record["task"] == name and record.get("referent", "fixed") == self._referent
            }
        return self._logged


def skip_logged(
    make: Callable[[], gym.Env[Any, Any]], log_dir: Path, referent: str, seed_base: int
) -> Callable[[], SkipLogged]:
    """Wrap an environment's factory."""
    return partial(_make, make, log_dir, referent, seed_base)


def _make(make: Callable[[], gym.Env[Any, Any]], log_dir: Path, referent: str, seed_base: int) -> SkipLogged:
    return SkipLogged(make(), log_dir, referent, seed_base)
