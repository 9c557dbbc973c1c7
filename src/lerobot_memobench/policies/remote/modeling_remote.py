"""A policy server as a LeRobot policy: each environment of a batch has a connection and an episode of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from numpy.typing import NDArray
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.modeling_baselines import UntrainedPolicy
from lerobot_memobench.policies.compatibility import begins_episode, is_frozen
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.session import Row, Session
from lerobot_memobench.protocol import ACTION_DIM, EXECUTION

Action = NDArray[np.float32]


class Actor:
    """One environment: when its episode begins, when the server is asked, which action is next.

    By ``phase`` and ``step`` of an observation it knows when an episode begins and whether it has ended
    (`begins_episode`, `is_frozen`). In an environment without them an episode begins with the policy's reset.
    """

    def __init__(self, config: RemoteConfig, session: Session) -> None:
        self.config, self.session = config, session
        self.forget()

    def forget(self) -> None:
        """A rollout begins: whatever comes next is another episode."""
        self._clock: tuple[int, int] | None = None
        self._prompt = self._rests = False
        self._queue: deque[Action] = deque()

    def act(self, row: Row) -> Action:
        """Return the action (7,) for the present observation; the server may be asked."""
        step, phase = row.scalar("step"), row.scalar("phase")
        last, self._clock = self._clock, self._now(step, phase)
        begins = begins_episode(last, self._clock)
        self._rests = (not begins and is_frozen(last, self._clock)) or (step is not None and row.blank)
        if self._rests:
            return np.zeros(ACTION_DIM, np.float32)  # the episode has ended, or was never run
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
        """Return the phase and the control step since it began."""
        if step is None:
            return EXECUTION, 0 if self._clock is None else self._clock[1] + 1
        return EXECUTION if phase is None else phase, step

    def needs_observation(self) -> bool:
        """Whether the server is sent the pictures of the next observation; the first of an execution it always is."""
        if self._rests or self._clock is None:
            return not self._rests
        if self._prompt:
            return self._shows_prompt(self._clock[1] + 1)
        return self.config.spoken.buffers or not self._queue

    def _shows_prompt(self, step: int) -> bool:
        """Whether the server sees the prompt's frame at a step."""
        return self.config.send_prompt and step % self.config.prompt_stride == 0

    def _see_prompt(self, row: Row, step: int) -> Action:
        """Show the server the prompt, in which actions have no effect."""
        self._prompt = True
        if self._shows_prompt(step):
            waits = self.config.spoken.buffers or self.config.spoken.history
            (self.session.watch if waits else self.session.ask)(row)
        return np.zeros(ACTION_DIM, np.float32)


class RemotePolicy(UntrainedPolicy):
    """Parameter-less policy that asks a server; see `RemoteConfig`. ``select_action`` returns (B, 7) float32."""

    config_class = RemoteConfig
    name = "memobench_remote"
    why_not_trained = "runs in a server and cannot be trained here"

    def __init__(self, config: RemoteConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: RemoteConfig = config
        self._actors: list[Actor] = []
        self._pool: ThreadPoolExecutor | None = None
        self._threads = 0

    def reset(self) -> None:
        """Begin a rollout. Connections stay; a missing server is an error before anything is simulated."""
        if not self._actors:
            self._add_actor()
        self._actors[0].session.connect()
        for actor in self._actors:
            actor.forget()

    def needs_observation(self) -> bool:
        """Whether a server is sent the pictures of the next observation."""
        return any(actor.needs_observation() for actor in self._actors)

    def _add_actor(self) -> None:
        addresses = self.config.addresses()
        self._actors.append(Actor(self.config, Session(self.config, addresses[len(self._actors) % len(addresses)])))

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action (B, 7) in [-1, 1] of each environment; servers are asked at the same time.

        Raises:
            MemobenchError: a server fails or stays away, or the batch is larger than its one memory can serve.
        """
        rows = _size(batch)
        limit = self.config.max_environments
        if limit is not None and rows > limit:
            raise MemobenchError(
                f"a {self.config.dialect} server keeps one memory for all who ask it, and {rows} environments would "
                f"share {limit}; use batch_size={limit}, or name {rows} servers by policy.servers=host:port,…"
            )
        while len(self._actors) < rows:
            self._add_actor()
        jobs = [partial(actor.act, Row(batch, k)) for k, actor in enumerate(self._actors[:rows])]
        return torch.from_numpy(np.stack([job() for job in jobs] if rows == 1 else self._together(jobs)))

    def _together(self, jobs: list[partial[Action]]) -> list[Action]:
        if self._pool is None or self._threads < len(jobs):
            if self._pool is not None:
                self._pool.shutdown()
            self._pool, self._threads = ThreadPoolExecutor(len(jobs), "policy-server"), len(jobs)
        return list(self._pool.map(lambda job: job(), jobs))


def _size(batch: Mapping[str, Any]) -> int:
    """Return how many environments a batch holds."""
    if OBS_STATE in batch:
        return len(batch[OBS_STATE])
    return len(next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim))
