"""Roll out a policy in a batch of environments, one episode per row.

The loop is LeRobot's: observation, processors, ``select_action``, processors, step. It skips unneeded work: it queues
the plans of LeRobot's policies, draws images only where the policy reads them, and runs the processors of
observations only where the next action is not planned. LeRobot seeds once per run; here the caller seeds each batch, so
that an evaluation that is resumed or shared among machines draws the same numbers as an undisturbed one.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.envs import check_env_attributes_and_types, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION, OBS_IMAGES
from lerobot.utils.random_utils import set_seed
from numpy.typing import NDArray

from lerobot_memobench.constants import CLOCK
from lerobot_memobench.envs.settings import INTACT

PIXELS, PHASE, STEP = "pixels", "phase", "step"
"""Keys of the environment's observations; ``phase`` is 0 in the demonstration prompt and 1 in the execution."""
KEEPS_ITS_NOISE = ("memobench_mem",)
"""Policies that seed the noise of each episode from torch's initial seed: it must remain the seed of the run."""

CHUNKED = (
    "lerobot.policies.act.modeling_act.ACTPolicy",
    "lerobot.policies.pi0.modeling_pi0.PI0Policy",
    "lerobot.policies.pi05.modeling_pi05.PI05Policy",
    "lerobot.policies.smolvla.modeling_smolvla.SmolVLAPolicy",
)
"""LeRobot's policies whose plans the loop queues."""

Ended = Callable[[NDArray[np.bool_]], None]
"""Called after each step with the finished rows (B,)."""


class ActionQueue:
    """The actions of a policy, step by step.

    A plan of LeRobot's policies in `CHUNKED` is queued here, so that no observation is needed until the queue is empty;
    any other policy selects each action by itself. It may define ``needs_observation``: whether, after an action, it
    reads the next images or objects; and ``has_planned_action``: whether its next ``select_action`` reads the clock
    alone.
    """

    def __init__(self, policy: Any) -> None:
        self._policy = policy
        self._queue: deque[torch.Tensor] | None = deque() if plans_chunks(policy) else None

    def reset(self) -> None:
        """Begin episodes."""
        self._policy.reset()
        if self._queue is not None:
            self._queue.clear()

    def select(self, inputs: dict[str, Any]) -> torch.Tensor:
        """Return the actions (B, A) for the policy's inputs."""
        with torch.inference_mode():
            if self._queue is None:
                action: torch.Tensor = self._policy.select_action(inputs)
                return action
            if not self._queue:
                chunk = self._policy.predict_action_chunk(inputs)[:, : self._policy.config.n_action_steps]
                self._queue.extend(chunk.transpose(0, 1))
            return self._queue.popleft()

    def needs_observation(self) -> bool:
        """Return after an action whether the policy reads the next images or objects."""
        own = getattr(self._policy, "needs_observation", None)
        return not self.has_planned_action() if own is None else bool(own())

    def has_planned_action(self) -> bool:
        """Return after an action whether the next one is planned."""
        own = getattr(self._policy, "has_planned_action", None)
        return bool(self._queue) if own is None else bool(own())


def plans_chunks(policy: Any) -> bool:
    """Return whether the ``select_action`` of a policy is a queue of its ``predict_action_chunk``, and no more.

    Subclasses may act differently. ACT's temporal ensemble and π0.5's visual memory read every observation.
    """
    kind, config = type(policy), getattr(policy, "config", None)
    return (
        f"{kind.__module__}.{kind.__name__}" in CHUNKED
        and getattr(config, "temporal_ensemble_coeff", None) is None
        and not getattr(config, "use_visual_memory", False)
        and not getattr(getattr(config, "rtc_config", None), "enabled", False)
    )


class Actor:
    """A policy of LeRobot's interface between processors of observations and of actions.

    The environment's are first for observations (``before``), the policy's for actions (``after``).
    """

    def __init__(
        self, policy: Any, before: Sequence[Callable[[Any], Any]], after: Sequence[Callable[[Any], Any]]
    ) -> None:
        self.policy, self.before, self.after = policy, before, after
        self.actions = ActionQueue(policy)

    def inputs(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the policy's inputs for an observation under LeRobot's names."""
        for process in self.before:
            observation = process(observation)
        return observation

    def act(self, inputs: dict[str, Any]) -> NDArray[np.float32]:
        """Return the environment's actions (B, A)."""
        policy_post, env_post = self.after
        action = env_post({ACTION: policy_post(self.actions.select(inputs))})[ACTION]
        actions: NDArray[np.float32] = action.cpu().numpy()
        return actions


def roll(env: Any, actor: Actor, seeds: Sequence[int], ended: Ended | None = None, corrupt: str = INTACT) -> None:
    """Run one episode in each row; the environments write the log.

    Args:
        env: vector environment of `MemobenchEnvConfig`. seeds: one per row.
        corrupt: what happens to the memory of rows when their environments report so, see `EnvSettings`.
    """
    actor.actions.reset()
    # Without the option a frozen row would stay frozen for this rollout.
    observation, _ = env.reset(seed=list(seeds), options={NEW_ROLLOUT_OPTION: True})
    limit = env.call("_max_episode_steps")[0]
    check_env_attributes_and_types(env)
    inputs = Inputs(env, actor)
    done = np.zeros(env.num_envs, bool)
    corrupted: list[int] = []
    for step in range(1, limit + 1):
        if corrupted:
            actor.policy.corrupt_memory(corrupt, corrupted)
        action = actor.act(inputs.of(observation, drawn=bool(corrupted)))
        inputs.announce()
        observation, _, terminated, truncated, info = env.step(action)
        corrupted = np.flatnonzero(info.get("corrupt", ())).tolist()
        done = done | terminated | truncated | (step == limit)
        if ended is not None:
            ended(done)
        if done.all():
            break


class Inputs:
    """The inputs of a policy during a rollout, updated as often as the policy needs."""

    def __init__(self, env: Any, actor: Actor) -> None:
        self._env, self._actor = env, actor
        self._drawn, self._planned = True, False  # after the environment's reset
        self._images: dict[str, torch.Tensor] = {}
        self._last: dict[str, Any] = {}
        self._phase: NDArray[np.float32] | None = None

    def announce(self) -> None:
        """Announce to the environment, before its step, whether the policy needs the observation after it."""
        actions = self._actor.actions
        needed, self._planned = actions.needs_observation(), actions.has_planned_action()
        if needed != self._drawn:
            self._env.call("need_observation", needed)
            self._drawn = needed

    def of(self, observation: dict[str, Any], drawn: bool = False) -> dict[str, Any]:
        """Return the policy's inputs; ``drawn``: the environment drew this frame without being asked.

        Where its next action is planned, they are the previous inputs with the present clock. Where it reads no
        images, they contain the previous images.
        """
        begins = drawn or self._phase is None or bool((observation[PHASE] != self._phase).any())
        self._phase = np.array(observation[PHASE])
        if self._planned and not begins:
            now = {
                key: torch.as_tensor(observation[name]).reshape(-1).to(self._last[key])
                for key, name in zip(CLOCK, (PHASE, STEP), strict=True)
                if key in self._last  # a processor may drop it
            }
            return {**self._last, **now}
        if begins or self._drawn:  # the first frame of an execution is always drawn: a policy cannot foresee it
            converted = preprocess_observation(observation)
            self._images = {key: value for key, value in converted.items() if key.startswith(OBS_IMAGES)}
        else:
            converted = preprocess_observation({key: value for key, value in observation.items() if key != PIXELS})
            converted = {**self._images, **converted}
        converted["task"] = list(self._env.call("task_description"))
        self._last = self._actor.inputs(converted)
        return self._last


# --- random numbers ---


class BatchSeeds:
    """Seed the generators of a batch by the seed of the run: Python's, NumPy's, torch's and the policy's own."""

    def __init__(self, policy: Any, seed: int) -> None:
        self._policy, self._seed = policy, seed
        # The seeds of the policy's own generators may come from its settings: they are included.
        owned = vars(policy).items()
        self._own = {name: value.initial_seed() for name, value in owned if isinstance(value, torch.Generator)}

    def begin(self, task: str, first: int) -> None:
        """Seed for the batch of a task whose first episode has the seed ``first``."""
        if getattr(self._policy, "name", None) in KEEPS_ITS_NOISE:
            return
        set_seed(batch_seed(self._seed, task, first))
        for name, own in self._own.items():
            getattr(self._policy, name).manual_seed(batch_seed(self._seed, task, first, own))


def batch_seed(seed: int, task: str, first: int, *more: int) -> int:
    """Return the seed (32 bits) of the batch of a task whose first episode has the seed ``first``."""
    text = " ".join(str(part) for part in (seed, task, first, *more))
    # NumPy's legacy generator takes no more than 32 bits.
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big")
