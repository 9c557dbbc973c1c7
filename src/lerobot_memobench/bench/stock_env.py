"""Stock robosuite as a gym environment that LeRobot's loop can step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.bench.sides import STOCK_CAMERAS, make_current
from lerobot_memobench.envs.observations import METADATA, action_space, observation_space
from lerobot_memobench.protocol import CAMERAS


class StockEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """Stock robosuite as LeRobot's loop wants it, with our observation's names."""

    metadata = METADATA
    task = task_description = "pick_place"

    def __init__(self, stock: Any, steps: int) -> None:
        self.render_mode, self._stock, self._max_episode_steps = "rgb_array", stock, steps
        self.observation_space, self.action_space = observation_space(False), action_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start anew."""
        super().reset(seed=seed)
        make_current(self._stock)
        self._step = 0
        return self._observed(self._stock.reset()), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take one control step."""
        make_current(self._stock)
        self._step += 1
        found, reward, _, _ = self._stock.step(action)
        return self._observed(found), float(reward), False, self._step >= self._max_episode_steps, {"is_success": False}

    def _observed(self, found: dict[str, Any]) -> dict[str, Any]:
        self._pictures = {key: found[f"{camera}_image"] for key, camera in zip(CAMERAS, STOCK_CAMERAS, strict=True)}
        hand = (found["robot0_eef_pos"], found["robot0_eef_quat"][:3], found["robot0_gripper_qpos"])
        still = np.ones(1, np.float32)
        return {"pixels": self._pictures, "agent_pos": np.concatenate(hand, dtype=np.float32), "phase": still} | {
            "step": still * self._step
        }

    def render(self) -> NDArray[np.uint8]:
        """Return both cameras side by side."""
        return np.hstack(list(self._pictures.values()))
