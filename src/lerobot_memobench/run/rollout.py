"""Roll out a policy in a batch of environments, one episode per row.

The loop is LeRobot's: observation, processors, ``select_action``, processors, step. It skips unneeded work: pictures
are drawn only where the policy reads them, and the processors of observations do not run at a step whose action is
already planned. LeRobot seeds once per run; here the caller seeds each batch, so that an evaluation that is resumed or
shared among machines draws the same numbers as an undisturbed one.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.envs import check_env_attributes_and_types, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION, OBS_IMAGES
from numpy.typing import NDArray

from lerobot_memobench.envs.settings import INTACT
from lerobot_memobench.protocol import CLOCK

PIXELS, PHASE, STEP = "pixels", "phase", "step"
"""Keys of the environment's observations; ``phase`` is 0 in the demonstration prompt and 1 in the execution."""
KEEPS_ITS_NOISE = ("memobench_mem",)
"""Policies that seed the noise of each episode from torch's initial seed: it must remain the seed of the run."""

Ended = Callable[[NDArray[np.bool_]], None]
"""Called after each step with the finished rows (B,)."""


@dataclass(frozen=True)
class Actor:
    """A policy between its processors.

    Attributes:
        policy: of LeRobot's interface.
        before: processors of observations: the environment's, then the policy's.
        after: processors of actions: the policy's, then the environment's.
    """

    policy: Any
    before: Sequence[Callable[[Any], Any]]
    after: Sequence[Callable[[Any], Any]]

    def inputs(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the policy's inputs for an observation under LeRobot's names."""
        for process in self.before:
            observation = process(observation)
        return observation

    def act(self, inputs: dict[str, Any]) -> NDArray[np.float32]:
        """Return the environment's actions (B, A)."""
        with torch.inference_mode():
            action = self.policy.select_action(inputs)
        policys, environments = self.after
        found: NDArray[np.float32] = environments({ACTION: policys(action)})[ACTION].to("cpu").numpy()
        return found


def roll(env: Any, actor: Actor, seeds: Sequence[int], ended: Ended | None = None, corrupt: str = INTACT) -> None:
    """Run one episode in each row; the environments write the log.

    Args:
        env: vector environment of `MemobenchEnvConfig`.
        seeds: one per row.
        corrupt: what happens to the memory of rows when their environments report so, see `EnvSettings`.
    """
    actor.policy.reset()
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
        self._needed, self._ready = needs_observation(actor.policy), has_planned_action(actor.policy)
        self._drawn, self._planned = True, False  # after the environment's reset
        self._pictures: dict[str, torch.Tensor] = {}
        self._last: dict[str, Any] = {}
        self._phase: NDArray[np.float32] | None = None

    def announce(self) -> None:
        """Announce to the environment, before its step, whether the policy needs the observation after it."""
        needed, self._planned = self._needed(), self._ready()
        if needed != self._drawn:
            self._env.call("need_observation", needed)
            self._drawn = needed

    def of(self, observation: dict[str, Any], drawn: bool = False) -> dict[str, Any]:
        """Return the policy's inputs; ``drawn``: the environment drew this frame without being asked.

        Where its next action is planned, they are the previous inputs with the present clock. Where it reads no
        pictures, they contain the previous pictures.
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
            self._pictures = {key: value for key, value in converted.items() if key.startswith(OBS_IMAGES)}
        else:
            converted = preprocess_observation({key: value for key, value in observation.items() if key != PIXELS})
            converted = {**self._pictures, **converted}
        converted["task"] = list(self._env.call("task_description"))
        self._last = self._actor.inputs(converted)
        return self._last


# --- the observations that a policy needs ---


@dataclass(frozen=True)
class ChunkPolicy:
    """One of LeRobot's policies that plan action chunks.

    Attributes:
        planned: returns whether a policy's next action is planned.
        read: `digest` of each version of ``select_action`` for which ``planned`` was written.
    """

    planned: Callable[[Any], bool]
    read: tuple[str, ...]


KNOWN: dict[tuple[str, str], ChunkPolicy] = {
    ("lerobot.policies.act.modeling_act", "ACTPolicy"): ChunkPolicy(
        lambda policy: policy.config.temporal_ensemble_coeff is None and bool(policy._action_queue), ("031085d1a22c",)
    ),
    ("lerobot.policies.pi0.modeling_pi0", "PI0Policy"): ChunkPolicy(
        lambda policy: bool(policy._action_queue), ("a330b536084c",)
    ),
    # Its visual memory reads the pictures of every step.
    ("lerobot.policies.pi05.modeling_pi05", "PI05Policy"): ChunkPolicy(
        lambda policy: not getattr(policy.config, "use_visual_memory", False) and bool(policy._action_queue),
        ("a330b536084c", "41d18fe29b12"),
    ),
    ("lerobot.policies.smolvla.modeling_smolvla", "SmolVLAPolicy"): ChunkPolicy(
        lambda policy: bool(policy._queues[ACTION]), ("3b7b12d0066f",)
    ),
}
"""By module and class."""


def needs_observation(policy: Any) -> Callable[[], bool]:
    """Return the check, made after an action, whether a policy reads the next pictures or objects.

    A policy defines it as a method of that name. Of LeRobot's policies, those whose source is known need an
    observation when no action is planned; any other policy needs every observation.
    """
    own: Callable[[], bool] | None = getattr(policy, "needs_observation", None)
    if own is not None:
        return own
    planned = has_planned_action(policy)
    return lambda: not planned()


def has_planned_action(policy: Any) -> Callable[[], bool]:
    """Return the check, made after an action, whether a policy has planned the next one.

    Its ``select_action`` then reads ``observation.phase`` and ``observation.step`` only. A policy defines it as a
    method of that name. LeRobot's policies are recognised by the source of ``select_action``, since a subclass may act
    differently (`diffusion` queues pictures at every step); for any other policy the answer is no.
    """
    own: Callable[[], bool] | None = getattr(policy, "has_planned_action", None)
    if own is not None:
        return own
    acts: Any = getattr(type(policy), "select_action", None)
    for (module, name), known in KNOWN.items():
        # A module that was not imported has no policy here.
        theirs: Any = getattr(getattr(sys.modules.get(module), name, None), "select_action", None)
        if theirs is not None and acts is theirs and digest(theirs) in known.read:
            return lambda: known.planned(policy)
    return lambda: False


def digest(function: Callable[..., Any]) -> str | None:
    """Return the first digits of the hash of a function's source; None without a source."""
    try:
        source = inspect.getsource(inspect.unwrap(function))
    except (OSError, TypeError):
        return None
    return hashlib.sha256(source.encode()).hexdigest()[:12]


# --- random numbers ---


class BatchSeeds:
    """Seed the generators of a batch: Python's, NumPy's, torch's and the policy's own.

    Args:
        seed: of the run.
    """

    def __init__(self, policy: Any, seed: int) -> None:
        self._policy, self._seed = policy, seed
        # The seeds of the policy's own generators may come from its settings: they are included.
        owned = vars(policy).items()
        self._own = {name: value.initial_seed() for name, value in owned if isinstance(value, torch.Generator)}

    def begin(self, task: str, first: int) -> None:
        """Seed for the batch of a task whose first episode has the seed ``first``."""
        from lerobot.utils.random_utils import set_seed

        if getattr(self._policy, "name", None) in KEEPS_ITS_NOISE:
            return
        set_seed(batch_seed(self._seed, task, first))
        for name, own in self._own.items():
            getattr(self._policy, name).manual_seed(batch_seed(self._seed, task, first, own))


def batch_seed(seed: int, task: str, first: int, *more: int) -> int:
    """Return the seed (32 bits) of the batch of a task whose first episode has the seed ``first``."""
    text = " ".join(str(part) for part in (seed, task, first, *more))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big")
