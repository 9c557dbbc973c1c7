"""DAgger (Ross et al. 2011): the learner and the expert act in turn, and the expert labels every frame.

The executed actions are kept for replay. The learner moves the arm, and fingers that are shut stay so while it keeps
them shut. Else they do as the expert says, or its plan would be left behind.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError

TURN_STEPS = (8, 48)
"""A turn of the expert, or of the learner, takes at least the first, and less than the second, number of steps."""


class Loaded(NamedTuple):
    """A policy with its processors of LeRobot's."""

    policy: Any
    preprocessor: Any
    postprocessor: Any


@lru_cache(maxsize=1)
def load_learner(checkpoint: str) -> Loaded:
    """Return the policy of a checkpoint folder, as LeRobot loads it, to act on one core.

    Raises:
        MemobenchError: it reads the oracle memory, which demonstrations do not have.
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


class Learner:
    """A policy in one episode, prompt included; its turns are a function of the generator's numbers alone."""

    def __init__(self, checkpoint: str, rng: np.random.Generator) -> None:
        self._policy, self._preprocessor, self._postprocessor = load_learner(checkpoint)
        self._policy.reset()
        self._rng = rng
        self._acts, self._left = bool(rng.random() < 0.5), 0
        self._wanted: NDArray[np.float32] = np.zeros(7, np.float32)
        self._shut = False  # the fingers were last told to close

    def observe(
        self, episode: Episode, objects: NDArray[np.float32], pictures: dict[str, NDArray[np.uint8]] | None
    ) -> None:
        """Give the policy the present frame: visible objects (SIZE,), and the cameras where they are recorded.

        Raises:
            MemobenchError: it needs an observation that is not recorded.
        """
        import torch
        from lerobot.envs import preprocess_observation

        observation: dict[str, Any] = {
            "environment_state": objects[None],
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
                f"the policy reads {', '.join(missing)}, which is not recorded; leave out --no-images, or name a "
                "policy that reads objects"
            )
        batch["task"] = [episode.task.language]
        with torch.inference_mode():
            action = self._policy.select_action(self._preprocessor(batch))
        self._wanted = np.clip(self._postprocessor(action)[0].numpy(), -1.0, 1.0)

    def executed(self, action: NDArray[np.float32], at_detent: bool = False) -> NDArray[np.float32]:
        """Return the action (7,) to execute in place of the expert's. Call once per step, after `observe`.

        Args:
            at_detent: makes no difference: a policy may leave home too soon.
        """
        if not self._left:
            self._acts, self._left = not self._acts, int(self._rng.integers(*TURN_STEPS))
        self._left -= 1
        fingers = self._wanted[6] if self._acts and self._shut and self._wanted[6] > 0 else action[6]
        self._shut = bool(fingers > 0)
        return np.append((self._wanted if self._acts else action)[:6], fingers).astype(np.float32)
