"""A trained policy drives for some steps at a time: demonstrations of how to go on from where it brings the arm.

What is learned at each frame is what the expert does there (DAgger, Ross et al. 2011); what was executed is kept for
replay. The policy moves the arm, and fingers that are shut stay so while it keeps them shut. Else they do as the expert
says, or its plan would be left behind.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError

SPELL = (8, 48)
"""The expert, or the policy, drives at least the first, and less than the second, number of steps at a time."""


class Loaded(NamedTuple):
    """A policy, and what LeRobot puts before and behind it."""

    policy: Any
    before: Any
    behind: Any


@lru_cache(maxsize=1)
def load_driver(checkpoint: str) -> Loaded:
    """Return the policy of a checkpoint folder, as LeRobot loads it, to act on one core.

    Raises:
        MemobenchError: it is told by its instruction what has been done, which nobody tells it here.
    """
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.device = "cpu"
    if getattr(config, "oracle_memory", False):
        raise MemobenchError(
            f"the policy {checkpoint} reads in its instruction what has been done (policy.oracle_memory=true), which "
            "demonstrations do not have; name one without"
        )
    torch.set_num_threads(1)  # a worker is one of as many as there are cores
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    override = {"device_processor": {"device": "cpu"}}
    return Loaded(policy, *make_pre_post_processors(config, checkpoint, preprocessor_overrides=override))


class Driver:
    """A policy in one episode, prompt included; when it drives is a function of the generator's numbers alone."""

    def __init__(self, checkpoint: str, rng: np.random.Generator) -> None:
        self._policy, self._before, self._behind = load_driver(checkpoint)
        self._policy.reset()
        self._rng = rng
        self._drives, self._left = bool(rng.random() < 0.5), 0
        self._wanted: NDArray[np.float32] = np.zeros(7, np.float32)
        self._shut = False  # the fingers were last told to close

    def look(self, episode: Episode, seen: NDArray[np.float32], pictures: dict[str, NDArray[np.uint8]] | None) -> None:
        """Show the policy the present frame: the visible objects, and the cameras where they are recorded.

        Raises:
            MemobenchError: it wants to see what is not recorded.
        """
        import torch
        from lerobot.envs import preprocess_observation

        observation: dict[str, Any] = {
            "environment_state": seen[None],
            "agent_pos": episode.sim.proprio()[None],
            "phase": np.array([[episode.phase]], np.float32),
            "step": np.array([[episode.clock]], np.float32),
        }
        if pictures is not None:
            observation["pixels"] = {name: picture[None] for name, picture in pictures.items()}
        batch = preprocess_observation(observation)
        missing = [key for key in self._policy.config.input_features if key not in batch]
        if missing:
            raise MemobenchError(
                f"the policy looks at {', '.join(missing)}, which is not recorded; leave out --no-images, or name a "
                "policy that sees objects"
            )
        batch["task"] = [episode.task.language]
        with torch.inference_mode():
            action = self._policy.select_action(self._before(batch))
        self._wanted = np.clip(self._behind(action)[0].numpy(), -1.0, 1.0)

    def moved(self, action: NDArray[np.float32], at_detent: bool = False) -> NDArray[np.float32]:
        """Return what is executed in place of the expert's action (7,). Ask once per step, after `look`.

        Args:
            at_detent: makes no difference: a policy may leave home too soon.
        """
        if not self._left:
            self._drives, self._left = not self._drives, int(self._rng.integers(*SPELL))
        self._left -= 1
        fingers = self._wanted[6] if self._drives and self._shut and self._wanted[6] > 0 else action[6]
        self._shut = bool(fingers > 0)
        return np.append((self._wanted if self._drives else action)[:6], fingers).astype(np.float32)
