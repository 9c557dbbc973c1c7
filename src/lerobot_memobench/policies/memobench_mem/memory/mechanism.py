"""Interface of memory mechanisms, and the histories that they are asked for: in training and in a rollout.

A mechanism is a rule without weights: which frames of an episode are kept, and which of them are read for an action
chunk. Its encoder, which makes memory tokens of the frames read, is learned.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_GRID
from lerobot_memobench.policies.memobench_mem.memory.encoder import MemoryEncoder

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """A frame: its control step since the episode began, and its tokens (P, D) on the CPU."""

    step: int
    tokens: Tensor


class EpisodeFrames(Protocol):
    """The frames of a recorded episode that a rollout would have offered for writing, numbered 0, 1, 2, ..."""

    def load(self, slots: Sequence[int]) -> list[Frame]:
        """Load these frames, and no others."""
        ...


class MemoryMechanism(ABC):
    """A rule by which an episode is remembered.

    Attributes:
        name: by which it is chosen.
        frames: how many frames a chunk reads at most; with 0 none is encoded, and training loads none.
        capacity: how many frames are kept of an episode at most; None where all are, however many come.
    """

    name: ClassVar[str]
    capacity: int | None

    def __init__(self, frames: int) -> None:
        self.frames = frames

    @abstractmethod
    def write(self, kept: list[Frame], frame: Frame) -> None:
        """Take in an episode's next frame: change what is ``kept`` of the earlier ones, in place."""

    @abstractmethod
    def read(self, kept: Sequence[Frame]) -> list[Frame]:
        """Return the frames that a chunk reads of those kept: at most `frames`, the oldest first."""

    def recall(self, episode: EpisodeFrames, slot: int) -> list[Frame]:
        """Return what training reads at an episode's frame ``slot``: what a rollout reads there.

        This loads and writes frames 0 ... ``slot`` one by one. A mechanism whose reading can be told from their number
        alone loads those that it reads instead; a test holds both to the same result.
        """
        kept: list[Frame] = []
        for frame in episode.load(range(slot + 1)):
            self.write(kept, frame)
        return self.read(kept)

    def encoder(self, image_dim: int, memory_dim: int, grid: int = MEMORY_GRID) -> nn.Module:
        """Build what turns frames read into memory tokens.

        It is called with tokens (B, F, P, D), their control steps (B, F) and which frames are real (B, F), and returns
        tokens (B, L, d_m) and their mask (B, L). A recurrent memory goes through the frames here, in their order; one
        that looks at each frame alone says so (``framewise = True``) and is given a frame that many rows read once.

        Args:
            grid: side of the square of a picture's tokens; 0 where tokens have no place in a picture.
        """
        return MemoryEncoder(image_dim, memory_dim, grid)


# -- frames in a batch ------------------------------------------------------------------------------------------------


TOKENS, STEPS, MASK = "memory.tokens", "memory.steps", "memory.mask"
FRAMES = "memory.frames"
"""Numbers (B, F) of remembered frames in the dataset, by which samples of one episode share what they remember; -1
where a row has none."""
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"


class MemoryBatch(NamedTuple):
    """Frames read for B samples: tokens (B, F, P, D), control steps (B, F) int64, mask (B, F) bool."""

    tokens: Tensor
    steps: Tensor
    mask: Tensor

    def to(self, device: torch.device) -> MemoryBatch:
        """Move it to a device."""
        return MemoryBatch(*(tensor.to(device) for tensor in self))


def collate_frames(rows: Sequence[Sequence[Frame]], frames: int) -> MemoryBatch:
    """Right-pad what was read for each sample to ``frames`` frames."""
    like = rows[0][0].tokens
    batch = MemoryBatch(
        tokens=torch.zeros(len(rows), frames, *like.shape, dtype=like.dtype),
        steps=torch.zeros(len(rows), frames, dtype=torch.int64),
        mask=torch.zeros(len(rows), frames, dtype=torch.bool),
    )
    for number, row in enumerate(rows):
        batch.tokens[number, : len(row)] = torch.stack([frame.tokens for frame in row])
        batch.steps[number, : len(row)] = torch.tensor([frame.step for frame in row])
        batch.mask[number, : len(row)] = True
    return batch


# -- training: frames of a feature cache ------------------------------------------------------------------------------


class CachedEpisode:
    """The stored frames of one episode of a feature cache; see `EpisodeFrames`."""

    def __init__(self, cache: FrameLookup, episode: int) -> None:
        self.cache, self.episode = cache, episode

    def load(self, slots: Sequence[int]) -> list[Frame]:
        """Read these frames, and no others, from the cache's file."""
        tokens = self.cache.tokens(self.episode, slots)
        return [Frame(slot * self.cache.meta.stride, one) for slot, one in zip(slots, tokens.unbind(), strict=True)]


def recall_at(cache: FrameLookup, mechanism: MemoryMechanism, episode: int, frame: int) -> list[Frame]:
    """Return what ``mechanism`` reads at a frame of an episode, counted from its start."""
    return mechanism.recall(CachedEpisode(cache, episode), frame // cache.meta.stride)


# -- rollouts: frames of the rows of a vector environment -------------------------------------------------------------


@dataclass
class Row:
    """History of one environment: its last clock, where that is in the episode, and what is kept of it.

    Attributes:
        clock: phase and control step since the phase began. position: control step since the episode began.
        missed: the first step of a frame that was to be written and was not offered; None where all were.
    """

    clock: tuple[int, int] | None = None
    position: int = 0
    frozen: bool = False
    warned: bool = False  # that it is longer than what is kept
    kept: list[Frame] = field(default_factory=list)
    missed: int | None = None


class RolloutMemory:
    """Histories of the rows of a vector environment.

    A row starts anew when its clock goes back (to an earlier phase, or an earlier step of the phase), and is frozen
    while its clock stays the same (its episode is over, or the environment is waiting), whatever the other rows do.

    Args:
        mechanism: what is kept and read.
        stride: every how many control steps a frame is written; an episode's first one always is.
    """

    def __init__(self, mechanism: MemoryMechanism, stride: int) -> None:
        self.mechanism, self.stride = mechanism, stride
        self.rows: list[Row] = []

    def reset(self) -> None:
        """Forget everything."""
        self.rows = []

    def observe(
        self, clocks: Sequence[tuple[int, int]], encode: Callable[[list[int]], Tensor]
    ) -> tuple[list[int], list[bool], list[bool]]:
        """Take in one observation per row.

        Args:
            clocks: of each row its phase (0 prompt, 1 execution) and the control step since that began.
            encode: from row numbers (n,) to their frames' tokens (n, P, D); called at most once, for the rows whose
                frames are written.

        Returns:
            Per row: its control step since the episode began, prompt included; whether a new episode began; and
            whether the row is frozen.
        """
        if len(self.rows) != len(clocks):
            self.rows = [Row() for _ in clocks]
        before = [row.position for row in self.rows]
        started = [self._tick(row, clock) for row, clock in enumerate(clocks)]
        for held, begins, last in zip(self.rows, started, before, strict=True):
            due = (last // self.stride + 1) * self.stride  # the next one that is written
            if not begins and due < held.position and held.missed is None:
                held.missed = due
        steps, frozen = [row.position for row in self.rows], [row.frozen for row in self.rows]
        wanted = [
            row for row, step in enumerate(steps) if not frozen[row] and (started[row] or step % self.stride == 0)
        ]
        if wanted and self.mechanism.frames:
            for number, tokens in zip(wanted, encode(wanted).to("cpu"), strict=True):
                writing, capacity = self.rows[number], self.mechanism.capacity
                if capacity is not None and len(writing.kept) == capacity and not writing.warned:
                    writing.warned = True
                    logger.warning(
                        "An episode has more than %d remembered frames, of which the latest are kept; call "
                        "policy.reset() when an episode begins.",
                        capacity,
                    )
                self.mechanism.write(writing.kept, Frame(steps[number], tokens))
        return steps, started, frozen

    def _tick(self, number: int, clock: tuple[int, int]) -> bool:
        """Set a row's clock; return whether a new episode began."""
        step, last = clock[1], self.rows[number].clock
        if last is None or clock < last:
            self.rows[number] = Row(clock, step)
            return True
        row = self.rows[number]
        row.clock, row.frozen = clock, clock == last
        if not row.frozen:  # a phase begins at step 0, one after the last of the prompt; or its clock counts through
            row.position += step - last[1] if step > last[1] else 1 + step
        return False

    def writes_next(self) -> bool:
        """Whether the frame after a row's present one is written."""
        moving = [row.position for row in self.rows if row.clock is not None and not row.frozen]
        return self.mechanism.frames > 0 and any((step + 1) % self.stride == 0 for step in moving)

    def missed(self, rows: Sequence[int]) -> int | None:
        """Return the first step of some rows' frames that were to be written and were not offered; None: all were."""
        steps = (self.rows[row].missed for row in rows)
        return min((step for step in steps if step is not None), default=None)

    def gather(self, rows: Sequence[int]) -> MemoryBatch:
        """Return what plans of some rows read."""
        return collate_frames([self.mechanism.read(self.rows[row].kept) for row in rows], self.mechanism.frames)
