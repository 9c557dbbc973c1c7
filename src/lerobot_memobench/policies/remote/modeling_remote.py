"""A policy server as a LeRobot policy: each environment of a batch has a connection and an episode of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from operator import call
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE, OBS_STR
from numpy.typing import NDArray
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.modeling_baselines import UntrainedPolicy
from lerobot_memobench.policies.compatibility import begins_episode, is_frozen
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.session import Row, Session
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, EXECUTION

Action = NDArray[np.float32]
MOST_THREADS = 256
"""Largest number of servers that are asked at a time; threads are started as they are needed."""


class Actor:
    """State of one environment: its episode, its session with the server and its queued actions.

    ``phase`` and ``step`` of an observation mark the beginning and the end of an episode (`begins_episode`,
    `is_frozen`). Without them, an episode begins with the policy's reset.
    """

    def __init__(self, config: RemoteConfig, session: Session) -> None:
        self.config, self.session = config, session
        self.forget()

    def forget(self) -> None:
        """Begin a rollout: the next observation is of another episode."""
        self._clock: tuple[int, int] | None = None
        self._prompt = self._rests = False
        self._queue: deque[Action] = deque()

    def act(self, row: Row) -> Action:
        """Return the action (7,) for the present observation, queued or of a new answer."""
        step, phase = row.scalar("step"), row.scalar("phase")
        last, self._clock = self._clock, self._now(step, phase)
        begins = begins_episode(last, self._clock)
        self._rests = (not begins and is_frozen(last, self._clock)) or (step is not None and row.blank)
        if self._rests:
            return np.zeros(ACTION_DIM, np.float32)  # the episode has ended, or is not simulated
        if begins:
            self.session.begin(row)
            self._queue.clear()
            self._prompt = False
        if phase not in (None, EXECUTION):
            return self._see_prompt(row, self._clock[1])
        if self._prompt:
            self.session.execution_starts()
            self._prompt = False
        if self._queue:
            if self.config.spoken.buffers:
                self.session.watch(row)
        else:
            self._queue.extend(self.session.ask(row)[: self.config.n_action_steps])
        return self._queue.popleft()

    def _now(self, step: int | None, phase: int | None) -> tuple[int, int]:
        """Return the phase and its control step."""
        if step is None:
            return EXECUTION, 0 if self._clock is None else self._clock[1] + 1
        return EXECUTION if phase is None else phase, step

    def needs_observation(self) -> bool:
        """Return whether the next observation's pictures are sent. Those of the first execution step always are."""
        if self._rests or self._clock is None:
            return not self._rests
        if self._prompt:
            return self._shows_prompt(self._clock[1] + 1)
        return self.config.spoken.buffers or not self._queue

    def _shows_prompt(self, step: int) -> bool:
        """Return whether the prompt's frame at a step is sent."""
        return self.config.send_prompt and step % self.config.prompt_stride == 0

    def _see_prompt(self, row: Row, step: int) -> Action:
        """Send a frame of the prompt, in which actions have no effect."""
        self._prompt = True
        if self._shows_prompt(step):
            waits = self.config.spoken.buffers or self.config.spoken.history
            (self.session.watch if waits else self.session.ask)(row)
        return np.zeros(ACTION_DIM, np.float32)


class RemotePolicy(UntrainedPolicy):
    """A policy that asks a server; see `RemoteConfig`. ``select_action`` returns (B, 7) float32."""

    config_class = RemoteConfig
    name = "memobench_remote"
    why_not_trained = "runs in a server and cannot be trained here"

    def __init__(self, config: RemoteConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: RemoteConfig = config
        self._actors: list[Actor] = []
        self._cameras = dict(zip(CAMERAS, config.image_features, strict=False))  # LeRobot's, in the environment's order

    def reset(self) -> None:
        """Begin a rollout. Connections stay open; a missing server is an error before any simulation."""
        if not self._actors:
            self._add_actor()
        self._actors[0].session.connect()
        for actor in self._actors:
            actor.forget()

    def needs_observation(self) -> bool:
        """Return whether the next observation's pictures are sent to a server."""
        return any(actor.needs_observation() for actor in self._actors)

    def _add_actor(self) -> None:
        addresses = self.config.addresses()
        self._actors.append(Actor(self.config, Session(self.config, addresses[len(self._actors) % len(addresses)])))

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action (B, 7) in [-1, 1] of each environment; servers are asked in parallel.

        Raises:
            MemobenchError: a server fails or does not return, or its memory cannot serve the batch.
        """
        rows, batch = _size(batch), _flat(batch)
        limit = self.config.max_environments
        if limit is not None and rows > limit:
            raise MemobenchError(
                f"a {self.config.dialect} server has one memory for all of its connections, and {rows} environments "
                f"would share {limit}; use batch_size={limit}, or name {rows} servers by policy.servers=host:port,…"
            )
        while len(self._actors) < rows:
            self._add_actor()
        jobs = [partial(actor.act, Row(batch, k, self._cameras)) for k, actor in enumerate(self._actors[:rows])]
        return torch.from_numpy(np.stack([job() for job in jobs] if rows == 1 else [*self._pool.map(call, jobs)]))

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(MOST_THREADS, "policy-server")


def _flat(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a batch whose parts of ``robot_state`` have names with dots, such as ``robot_state.joints.pos``."""
    nested = f"{OBS_STR}.robot_state"
    parts = {f"{nested}.{group}.{key}": one for group, of in batch.get(nested, {}).items() for key, one in of.items()}
    return {name: value for name, value in batch.items() if name != nested} | parts


def _size(batch: Mapping[str, Any]) -> int:
    """Return the number of environments in a batch."""
    if OBS_STATE in batch:
        return len(batch[OBS_STATE])
    return len(next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim))
