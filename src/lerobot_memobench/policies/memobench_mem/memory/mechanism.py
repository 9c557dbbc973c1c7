"""Interface of memory mechanisms: what is kept of an episode, how it is read, and how training goes through the past.

A mechanism is a module with weights of its own. In a rollout each row has a state, which `write` changes once per
remembered frame and `read` turns into memory tokens once per action chunk. In training `replay` does the same for the
samples of a batch, from frames loaded as a rollout would have written them; gradients pass through a bounded number of
the last ones.

Shapes: B samples, R rows, U different frames, F frames of a sample's history, P tokens per frame, D their width, d_m
width of memory tokens, L memory tokens of a row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.products import exact_products

MEMORY_GRID = 4
"""A remembered picture is pooled to MEMORY_GRID x MEMORY_GRID tokens."""

# -- in a batch -------------------------------------------------------------------------------------------------------

FRAMES, STEPS, PLACES = "memory.frames", "memory.steps", "memory.places"
"""Histories of a training batch: see `Histories`."""
EXACT = "memory.exact"
"""Frames without detection noise, where the others have some."""
AHEAD = "memory.ahead"
"""Frames that follow the histories, for mechanisms that learn to foresee them (`MemoryMechanism.ahead`)."""
SUBGOAL, SUBGOALS, CHOICES = "memory.subgoal", "memory.subgoals", "memory.choices"
"""Labels for mechanisms that learn from checkpoints (`MemoryMechanism.privileged`), as numbers of texts; -1: none. Of
each sample (B,), of each frame (U,), and which texts are its task's (B, S) bool, which a rollout has too."""
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"


class Histories(NamedTuple):
    """What B samples remember, frames that several share once.

    Attributes:
        frames: (U, P, D') stored frames. steps: (U,) their control steps since their episodes began, int64.
        places: (B, F) which of them each sample remembers, oldest first; -1 behind the last.
        subgoals: (U,) number of the text that is a frame's subgoal, -1: none; with `MemoryMechanism.privileged`.
        ahead: (B, n) which frames follow those, -1 behind the episode's last; with `MemoryMechanism.ahead`.
        exact: (U, P, D') the frames without detection noise, for labels; None: ``frames`` have none.
    """

    frames: Tensor
    steps: Tensor
    places: Tensor
    subgoals: Tensor | None = None
    ahead: Tensor | None = None
    exact: Tensor | None = None

    def to(self, device: torch.device) -> Histories:
        """Move them to a device."""
        return Histories(*(None if part is None else part.to(device) for part in self))  # type: ignore[arg-type]


class Query(NamedTuple):
    """The present of R rows, by which memory may be written and read.

    Attributes:
        tokens: (R, P, D) of the present observation, as of a remembered frame; if a mechanism `asks_present`.
        choices: (R, S) bool, which of the S subgoals are the task's; with `MemoryMechanism.privileged`.
        subgoal: (R,) which is the present one, -1: none; of training samples alone.
    """

    tokens: Tensor | None = None
    choices: Tensor | None = None
    subgoal: Tensor | None = None

    def rows(self, chosen: Any) -> Query:
        """Return some rows."""
        return Query(*(None if part is None else part[chosen] for part in self))


class MemoryTokens(NamedTuple):
    """Tokens that B rows read, L each.

    Attributes:
        each: (B, L, d), or (U, P, d) of U frames.
        mask: (B, L) bool, which are real.
        places: (B, F), which of the U frames each row reads, with F P = L; None where ``each`` lies in rows.
        steps: (B, L), control step of the frame that a token is of, -1 where it is of none; None: of none.
        sources: where a token is made of several entries of a memory, the share of each, (B, L, E), and the control
            steps of these, (B, E), -1 where there is none; for looking at, without gradients.
        query: the present that they were read by, where the mechanism's own fusion asks for it.
    """

    each: Tensor
    mask: Tensor
    places: Tensor | None = None
    steps: Tensor | None = None
    sources: tuple[Tensor, Tensor] | None = None
    query: Query | None = None

    def through(self, made: Callable[[Tensor], Tensor]) -> MemoryTokens:
        """Return what is made of every token by itself."""
        return self._replace(each=made(self.each))

    def rows(self) -> Tensor:
        """Return what each row reads, (B, L, d)."""
        if self.places is None:
            return self.each
        return self.each.index_select(0, self.places.flatten()).unflatten(0, self.places.shape).flatten(1, 2)


# -- the interface ----------------------------------------------------------------------------------------------------


State = Any
"""What is kept of R rows: a dict of tensors (R, ...), unless a mechanism has its own ``join`` and ``replay``."""


@dataclass(frozen=True)
class MemorySpec:
    """What a mechanism is built for.

    Attributes:
        dim: D, width of a frame's tokens. tokens: P, their number. width: d_m, of memory tokens.
        expert: width of the action expert. frames: F at most, of what a chunk reads.
        grid: side of the square of a picture's tokens; 0 where tokens have no place in a picture.
        stride: control steps from one written frame to the next.
        subgoals: texts of the checkpoints, where the mechanism is `MemoryMechanism.privileged`.
    """

    dim: int
    tokens: int
    width: int
    expert: int
    frames: int
    grid: int
    stride: int
    subgoals: tuple[str, ...] = ()


@dataclass
class NoSettings:
    """Settings of a mechanism that has none."""


class MemoryMechanism(nn.Module, ABC):
    """A way to remember an episode.

    Attributes:
        Settings: a dataclass of what may be set (``policy.memory_settings``), each with a default.
        stride: control steps from one written frame to the next where nobody says, perhaps by the perception; None: as
            `frames`.
        asks_present: whether it reads by tokens of the present observation.
        asks_motion: whether it remembers what moves: its pool is a `motion_fields.MotionField`, and what is stored of a
            picture is a thumbnail.
        ahead: how many stored frames that follow are loaded in training, as labels.
        privileged: whether it learns from the checkpoints' texts; a rollout is told the texts of its task, in no order.
        fusion: its own way in which actions read it (``policy.memory_fusion=own``), a `fusion.MemoryFusion`; None: any
            other of these.
        gradient_frames: through how many of the last frames gradients pass at most.
        per_frame: whether memory tokens are P of each frame read, oldest first, as ``align=framewise`` needs.
        reads_text: whether memory tokens are words of a checkpoint's text, of the true one in training: no alignment.
        capacity: how many entries are kept of an episode at most.
    """

    Settings: ClassVar[type] = NoSettings
    stride: ClassVar[int | Mapping[str, int] | None] = None
    asks_present: ClassVar[bool] = False
    asks_motion: ClassVar[bool] = False
    ahead: ClassVar[int] = 0
    privileged: ClassVar[bool] = False
    fusion: ClassVar[Any] = None
    per_frame: ClassVar[bool] = False
    reads_text: ClassVar[bool] = False
    gradient_frames: int = 0
    capacity: int

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: Any) -> None:
        """Build it.

        Args:
            pool: from N stored frames (N, P', D') to their tokens (N, P, D). It learns, and is part of the memory.
            settings: an instance of `Settings`.
        """
        super().__init__()
        self.spec, self.pool, self.settings = spec, pool, settings

    # -- a rollout ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def init(self, rows: int) -> State:
        """Return the state of rows whose episodes begin."""

    @abstractmethod
    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query | None = None) -> State:
        """Return the state after each row's next frame; ``state`` itself is not changed.

        Args:
            tokens: (R, P, D) of the frame, as `pooled` returns them. step: (R,) control step since the episode began.
            query: choices of the rows.
        """

    @abstractmethod
    def read(self, state: State, query: Query | None = None) -> MemoryTokens:
        """Return the tokens that a chunk reads, (R, L, d_m), L being the same for all states."""

    def observe(self, state: State, frames: Tensor, step: Tensor, query: Query | None = None) -> State:
        """Return the state after each row's next stored frame (R, P', D')."""
        return self.write(state, self.pooled(frames), step, query)

    def pooled(self, frames: Tensor) -> Tensor:
        """Return the tokens (N, P, D) of stored frames (N, P', D'), at least as precise as the mechanism's weights.

        Frames of pictures are stored in bfloat16; weights are float32 in a training, and mostly in a rollout.
        """
        tokens: Tensor = self.pool(frames)
        own = next((one for name, one in self.named_parameters() if not name.startswith("pool.")), tokens)
        return tokens.to(torch.promote_types(tokens.dtype, own.dtype))

    def join(self, states: Sequence[State]) -> State:
        """Return one state of the rows of several."""
        return {name: torch.cat([state[name] for state in states]) for name in states[0]}

    # -- a training --------------------------------------------------------------------------------------------------

    @classmethod
    def slots(cls, slot: int, frames: int) -> Sequence[int]:
        """Return which of an episode's frames 0 ... ``slot`` are loaded to read at the last; all, where nobody knows.

        Args:
            frames: F of the specification.
        """
        return range(slot + 1)

    def replay(self, histories: Histories, query: Query | None = None) -> MemoryTokens:
        """Return what B samples read, as rollouts would that have written the same frames.

        Frames but the last `gradient_frames` of each sample are written without gradients, once for all samples of an
        episode. Histories must begin at the same frame for all samples of an episode.

        Args:
            query: the samples' present.
        """
        return self.read(self.state_after(histories, query), query)

    def state_after(self, histories: Histories, query: Query | None = None) -> State:
        """Return the states of B samples, each after the last frame of its history."""
        count = (histories.places >= 0).sum(dim=1)
        begin = (count - self.gradient_frames).clamp(min=0)
        with torch.no_grad(), exact_products():
            state = self._before(histories, begin, query)
        if not self.gradient_frames:
            return state
        fresh = self.init(len(begin))  # whose gradients count where nothing was written before
        early = begin == 0
        state = {name: torch.where(_like(early, of), fresh[name], of) for name, of in state.items()}
        ahead = begin[:, None] + torch.arange(int((count - begin).max()), device=begin.device)
        places = histories.places.gather(1, ahead.clamp(max=histories.places.shape[1] - 1))
        order = (count - begin).argsort(descending=True, stable=True)  # those that end drop off the end
        written = self._written(
            _rows(state, order), histories, places[order], (count - begin)[order], _of(query, order)
        )
        return _rows(self.join(written[::-1]), order.argsort())

    def _before(self, histories: Histories, begin: Tensor, query: Query | None) -> State:
        """Return the states of B samples, each after the first ``begin`` (B,) frames of its history.

        Each episode is gone through once, as far as its latest sample asks.
        """
        first, episode = histories.places[:, 0].unique(return_inverse=True)
        until = torch.zeros_like(first).scatter_reduce(0, episode, begin, "amax")
        latest = torch.zeros_like(first)
        ends = begin == until[episode]
        latest[episode[ends]] = ends.nonzero().flatten()  # a sample of each episode, which asks the furthest
        order = until.argsort(descending=True, stable=True)
        samples, row_of = latest[order], order.argsort()[episode]
        read = torch.arange(histories.places.shape[1], device=begin.device) < begin[:, None]
        if ((histories.places != histories.places[latest[episode]]) & read).any():
            raise ValueError(
                f"slots of {type(self).__name__} are not the beginning of one sequence for all samples of an episode "
                "that have the first in common; replay goes through that once, so write one of your own"
            )
        stops: dict[int, list[int]] = {}
        for sample, stop in enumerate(begin.tolist()):
            stops.setdefault(stop, []).append(sample)
        found = self._written(
            self.init(len(order)),
            histories,
            histories.places[samples],
            until[order],
            _of(query, samples),
            stops,
            row_of,
        )
        back = torch.tensor([sample for stop in sorted(stops) for sample in stops[stop]], device=begin.device)
        return _rows(self.join(found), back.argsort())

    def _written(
        self,
        state: State,
        histories: Histories,
        places: Tensor,
        counts: Tensor,
        query: Query | None,
        stops: dict[int, list[int]] | None = None,
        row_of: Tensor | None = None,
    ) -> list[State]:
        """Write the first ``counts`` (R,) frames, descending, of the rows' ``places`` (R, T); return states on the way.

        Returns:
            Without ``stops`` those of the rows that end, after 0, 1, ... frames; else those of samples by ``stops``
            (after so many frames, these), which go with the rows ``row_of`` (B,).
        """
        needed, where = places.clamp(min=0).unique(return_inverse=True)
        pooled, steps = self.pooled(histories.frames[needed]), histories.steps[needed]
        left, found = counts.tolist(), []
        for time in range(left[0] + 1):
            still = sum(count > time for count in left)
            if stops is None and still < len(left):
                found.append(_rows(state, slice(still, len(left))))
            if stops is not None and time in stops:
                assert row_of is not None
                found.append(_rows(state, row_of[stops[time]]))
            left, state = left[:still], _rows(state, slice(still))
            if still:
                now, part = where[:still, time], _of(query, slice(still))
                state = self.write(state, pooled[now], steps[now], part)
        return found

    # -- what it learns by itself -------------------------------------------------------------------------------------

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return losses of its own by their names, (B,) each and weighted; called after `replay` and the actions'.

        Where a loss is only measured, a privileged memory replays the histories with labels, and then without them: the
        actions follow its own choice.

        Args:
            batch: the training batch, and what its fusion made beside actions (`Reading.outputs`).
        """
        return {}


def _rows(state: dict[str, Tensor], chosen: Any) -> dict[str, Tensor]:
    return {name: tensor[chosen] for name, tensor in state.items()}


def _of(query: Query | None, chosen: Any) -> Query | None:
    return None if query is None else query.rows(chosen)


def _like(rows: Tensor, other: Tensor) -> Tensor:
    """Return ``rows`` (R,) with as many dimensions as another tensor (R, ...)."""
    return rows.reshape(-1, *[1] * (other.ndim - 1))
