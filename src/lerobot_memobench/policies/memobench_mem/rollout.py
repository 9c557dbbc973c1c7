"""Environments of a rollout: each has its memory, its action chunk and the seed of its noise, independent of others."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.envs.lerobot import begins_episode, is_frozen
from lerobot_memobench.policies.memobench_mem.objects import HAND_DIM, rotation
from lerobot_memobench.policies.memory_reads import Chunk

STALLED, PER_RADIAN = 0.006, 0.1
"""Movement between two chunks below which the hand counts as stalled, m, and the length that a radian counts, m."""


@dataclass
class EnvMemory:
    """The episode of one environment of a batch."""

    clock: tuple[int, int] | None = None  # phase and control step since the phase began
    position: int = 0  # control step since the episode began
    frozen: bool = False
    memory: Any = None  # state of the memory mechanism; None before the first frame
    intact: Any = None  # its state before a corruption
    emptied: bool = False  # whether the next frame is the memory's first, after a corruption
    stored: Tensor | None = None  # the last written frame
    missed: int | None = None  # step of the first frame that should have been written and was not observed
    seed: int = 0
    queue: deque[Tensor] = field(default_factory=deque)  # remaining planned actions
    planned: tuple[Any, Sequence[Tensor], Tensor] | None = None  # the last plan: memory, other inputs, chunk (n, A)
    last: Tensor | None = None  # the last action (A,)
    pose: Tensor | None = None  # of the hand when the last chunk was planned
    skipped: int = 0  # actions of that chunk that were left out
    reads: list[Chunk] = field(default_factory=list)  # memory reads of the chunks, if they are watched

    def drop_chunk(self) -> None:
        """Discard planned actions; the action is zero until the next plan."""
        self.queue.clear()
        self.last = self.pose = None

    def repeats(self, inputs: Sequence[Tensor]) -> bool:
        """Return whether the last plan had the same memory and ``inputs``."""
        if self.planned is None or self.missed is not None:
            return False
        memory, last, _ = self.planned
        return memory is self.memory and all(map(torch.equal, last, inputs))

    def begin_chunk(self, chunk: Tensor, count: int, state: Tensor | None = None) -> None:
        """Queue the first ``count`` actions of a chunk (n, A), or the following ones if the hand has stalled.

        A hand that replans the same action after too few steps could stall forever. A hand whose pose is bit-identical
        has not stalled: the environment holds it, or it rests. A plan has ``count`` actions in all cases, as the policy
        declares to the environment, so that plans stay in step with its holds. ``state`` (8,) is the robot's, m and
        rad, to compare with that of the last chunk; None: never stalled.
        """
        pose = None
        if state is not None:
            rotated = rotation(state[None, 3:HAND_DIM]).flatten() * PER_RADIAN
            pose = torch.cat([state[:3], rotated, state[HAND_DIM:]]).cpu()
        last, self.pose = self.pose, pose
        moved = 0.0 if pose is None or last is None else float((pose - last).abs().max())
        self.skipped = min(self.skipped + count, len(chunk) - count) if 0 < moved < STALLED else 0
        self.queue.extend(chunk[self.skipped : self.skipped + count])

    def draw_seed(self, observed: Iterable[Tensor]) -> None:
        """Set the seed of the episode's noise from its first observation and the process's seed."""
        # 56 bits, so that the seed plus a position is within torch's range.
        digest = hashlib.blake2b(str(torch.initial_seed()).encode(), digest_size=7)
        for value in observed:
            digest.update(value.detach().to("cpu").contiguous().numpy().tobytes())
        self.seed = int.from_bytes(digest.digest(), "big")

    def noise(self, shape: tuple[int, int]) -> Tensor:
        """Return noise on the CPU for a chunk at the present position."""
        return torch.randn(shape, generator=torch.Generator().manual_seed(self.seed + self.position))


class Rollout:
    """The environments of a vector environment; every ``stride``-th frame is written, or none if not ``remembers``.

    An episode's first frame is always written. If observations have no clock, each observation is a control step.
    """

    def __init__(self, remembers: bool, stride: int) -> None:
        self.remembers, self.stride = remembers, stride
        self.envs: list[EnvMemory] = []

    def observe(self, clocks: Sequence[tuple[int, int]], write: Callable[[list[int]], None]) -> list[bool]:
        """Process the clock of each environment, as of `EnvMemory`; return in which of them a new episode began.

        ``write`` writes the frames of given environments; it is called at most once.
        """
        if len(self.envs) != len(clocks):
            self.envs = [EnvMemory() for _ in clocks]
        before = [env.position for env in self.envs]
        started = [self._tick(number, clock) for number, clock in enumerate(clocks)]
        due = list[int]()
        for number, (env, begins, last) in enumerate(zip(self.envs, started, before, strict=True)):
            following = (last // self.stride + 1) * self.stride  # the next written step
            if not begins and following < env.position and env.missed is None:
                env.missed = following
            if not env.frozen and (begins or env.emptied or env.position % self.stride == 0):
                due.append(number)
                env.emptied = False
        if due and self.remembers:
            write(due)
        return started

    def _tick(self, number: int, clock: tuple[int, int]) -> bool:
        env, step = self.envs[number], clock[1]
        last = env.clock
        if begins_episode(last, clock):
            self.envs[number] = EnvMemory(clock, max(step, 0))
            return True
        assert last is not None  # else an episode begins
        env.clock, env.frozen = clock, is_frozen(last, clock)
        if not env.frozen:  # the execution's clock starts at 0, continues the prompt's, or is missing
            env.position += step - last[1] if step > last[1] >= 0 else 1 + max(step, 0)
        return False

    def corrupt(self, numbers: Sequence[int], changed: Callable[[int], Any]) -> None:
        """Replace the memories of environments by ``changed``; None: a memory begins with its next frame."""
        for number in numbers:
            self.envs[number].intact = self.envs[number].memory
        for number in numbers:
            self.envs[number].memory = changed(number)
            self.envs[number].emptied = self.envs[number].memory is None

    def next_env_memory(self, number: int) -> Any:
        """Return the memory of the next environment of the batch, as it was before a corruption."""
        other = self.envs[(number + 1) % len(self.envs)]
        return other.memory if other.intact is None else other.intact

    def writes_next(self) -> bool:
        """Return whether the next frame of any environment will be written."""
        moving = [env.position for env in self.envs if env.clock is not None and not env.frozen]
        return self.remembers and any((step + 1) % self.stride == 0 for step in moving)

    def missed(self, numbers: Sequence[int]) -> int | None:
        """Return the first step that should have been written and was not observed in these environments."""
        steps = (self.envs[number].missed for number in numbers)
        return min((step for step in steps if step is not None), default=None)
