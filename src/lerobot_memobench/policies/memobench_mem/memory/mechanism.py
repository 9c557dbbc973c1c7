"""Interface of memory mechanisms: how to keep an episode, how to read it, and how training replays it.

In a rollout each row has a state: `write` updates it once per remembered frame, and `read` turns it into memory tokens
once per action chunk. In training `replay` computes the same for the samples of a batch, from the frames that a rollout
would have written; gradients pass through a bounded number of the last frames.

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

MEMORY_GRID = 4
"""A remembered image is pooled to MEMORY_GRID x MEMORY_GRID tokens."""
OBJECT_TOKENS = 2
"""The objects of a remembered frame are pooled to this number of tokens."""

# -- keys of a batch --------------------------------------------------------------------------------------------------

FRAMES, STEPS, PLACES, EXACT, AHEAD = (f"memory.{name}" for name in ("frames", "steps", "places", "exact", "ahead"))
"""Parts of the `Histories` of a training batch."""
SUBGOAL, SUBGOALS, CHOICES = "memory.subgoal", "memory.subgoals", "memory.choices"
"""For mechanisms that learn from texts (`MemoryMechanism.privileged`): the index of the active text, -1 for none, of
each sample (B,) and of each frame (U,); and which texts belong to the sample's task, (B, S) bool, also in rollouts."""
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"


class Histories(NamedTuple):
    """Remembered frames of B samples; frames shared by several samples are stored once.

    Attributes:
        frames: (U, P, D'), as stored, before pooling. steps: (U,) int64, control steps since their episodes began.
        places: (B, F) indices of each sample's frames, oldest first, padded by -1.
        subgoals: (U,) index of each frame's subgoal text, -1: none; with `MemoryMechanism.privileged`.
        ahead: (B, n) indices of the frames that follow, -1 after the episode's end; with `MemoryMechanism.ahead`.
        exact: (U, P, D') the frames without detection noise, for labels; None: ``frames`` have no noise.
    """

    frames: Tensor
    steps: Tensor
    places: Tensor
    subgoals: Tensor | None = None
    ahead: Tensor | None = None
    exact: Tensor | None = None

    def to(self, device: torch.device) -> Histories:
        return Histories(*(None if part is None else part.to(device) for part in self))  # type: ignore[arg-type]


class Query(NamedTuple):
    """The present of R rows, as an input of writing and reading.

    Attributes:
        tokens: (R, P, D) of the present observation, as of a remembered frame; with `MemoryMechanism.asks_present`.
        choices: (R, S) bool, which of the S texts belong to the task; with `MemoryMechanism.privileged`.
        subgoal: (R,) index of the active text, -1: none; only in training.
    """

    tokens: Tensor | None = None
    choices: Tensor | None = None
    subgoal: Tensor | None = None

    def rows(self, chosen: Any) -> Query:
        return Query(*(None if part is None else part[chosen] for part in self))


class MemoryTokens(NamedTuple):
    """Memory tokens of B rows, L each.

    Attributes:
        each: (B, L, d), or (U, P, d) of U frames.
        mask: (B, L) bool, False for padding.
        places: (B, F) indices of each row's frames, with F P = L; None if ``each`` is (B, L, d).
        steps: (B, L), control step of each token's frame, -1 for a token without a frame; None: no token has a frame.
        sources: if a token mixes several entries of a memory: the share of each entry, (B, L, E), and the entries'
            control steps, (B, E), -1 for padding. For memory reads, without gradients.
        query: the present, if the mechanism's own fusion needs it.
    """

    each: Tensor
    mask: Tensor
    places: Tensor | None = None
    steps: Tensor | None = None
    sources: tuple[Tensor, Tensor] | None = None
    query: Query | None = None

    def map(self, module: Callable[[Tensor], Tensor]) -> MemoryTokens:
        return self._replace(each=module(self.each))

    def rows(self) -> Tensor:
        """Return the tokens of each row, (B, L, d)."""
        if self.places is None:
            return self.each
        return self.each.index_select(0, self.places.flatten()).unflatten(0, self.places.shape).flatten(1, 2)


# -- the interface ----------------------------------------------------------------------------------------------------


State = Any
"""Memory of R rows: a dict of tensors (R, ...), unless a mechanism defines its own ``join`` and ``replay``."""


@dataclass(frozen=True)
class MemorySpec:
    """Dimensions for which a mechanism is built."""

    dim: int  # D, width of a frame's tokens
    tokens: int  # P, their number
    width: int  # d_m, of memory tokens
    expert: int  # width of the action expert
    grid: int  # side of the square of an image's tokens; 0 if tokens have no place in an image
    stride: int  # control steps between written frames
    subgoals: tuple[str, ...] = ()  # texts of the checkpoints; with `MemoryMechanism.privileged`


@dataclass
class NoSettings:
    """A mechanism has no settings."""


class MemoryMechanism(nn.Module, ABC):
    """Base class of memory mechanisms.

    Attributes:
        Settings: a dataclass of the settings (``policy.memory_settings``), each with a default.
        stride: default number of control steps between written frames, or one per perception; None: as `frames`.
        asks_present: whether `read` needs tokens of the present observation.
        asks_motion: whether the memory stores motion: its pool is a `motion.MotionField`, and a stored image
            is a thumbnail.
        ahead: number of following frames that training loads as labels.
        privileged: whether it learns from texts of checkpoints. A rollout gets the texts of its task, in no order.
        fusion: its own `fusion.MemoryPass` (``policy.memory_fusion=own``); None: any general one.
        gradient_frames: maximum number of last frames through which gradients pass.
        per_frame: whether memory tokens are P of each frame read, oldest first, as ``align=framewise`` needs.
        reads_text: whether memory tokens are words of a checkpoint's text; then no alignment is possible.
        capacity: maximum number of entries kept of an episode.
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
        """Build it; ``pool`` maps N stored frames (N, P', D') to tokens (N, P, D), and is trained as a part."""
        super().__init__()
        self.spec, self.pool, self.settings = spec, pool, settings

    @classmethod
    def make_pool(cls, observations: Any, spec: MemorySpec) -> nn.Module:
        """Return the pool for the stored frames of an `encoders.ObservationEncoder`."""
        return observations.pool()

    # -- a rollout ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def init(self, rows: int) -> State:
        """Return the initial state of rows."""

    @abstractmethod
    def write(self, state: State, tokens: Tensor, step: Tensor, query: Query = Query()) -> State:
        """Return the state after each row's next frame, without changing ``state``.

        ``tokens`` (R, P, D) are those of the frame, as of `pooled`; ``step`` (R,) counts since the episode began;
        ``query`` holds choices only.
        """

    @abstractmethod
    def read(self, state: State, query: Query = Query()) -> MemoryTokens:
        """Return the tokens that a chunk reads, (R, L, d_m), with the same L for all states."""

    def observe(self, state: State, frames: Tensor, step: Tensor, query: Query = Query()) -> State:
        """Return the state after each row's next stored frame (R, P', D')."""
        return self.write(state, self.pooled(frames), step, query)

    def pooled(self, frames: Tensor) -> Tensor:
        """Return the tokens (N, P, D) of stored frames (N, P', D'), at least in the precision of the weights."""
        tokens: Tensor = self.pool(frames)  # images are stored in bfloat16
        own = next((parameter for name, parameter in self.named_parameters() if not name.startswith("pool.")), tokens)
        return tokens.to(torch.promote_types(tokens.dtype, own.dtype))

    def join(self, states: Sequence[State]) -> State:
        return {name: torch.cat([state[name] for state in states]) for name in states[0]}

    def noised(self, state: State, generator: torch.Generator) -> State:
        """Return the state with noise on what it holds of frames, not on times and counts (``corrupt=noise``)."""
        contents = {name: value for name, value in state.items() if not name.endswith("steps")}
        return {**state, **{name: with_noise(value, generator) for name, value in contents.items()}}

    # -- a training --------------------------------------------------------------------------------------------------

    @classmethod
    def slots(cls, slot: int, settings: Any) -> Sequence[int]:
        """Return which of an episode's frames 0 ... ``slot`` training loads to read at the last; by default all."""
        return range(slot + 1)

    def replay(self, histories: Histories, query: Query = Query()) -> MemoryTokens:
        """Return what B samples read, equal to rollouts that wrote the same frames.

        All but the last `gradient_frames` of each sample are written without gradients, once for all samples of an
        episode, whose histories must begin at the same frame.
        """
        count = (histories.places >= 0).sum(dim=1)
        begin = (count - self.gradient_frames).clamp(min=0)
        with torch.no_grad():
            state = self._state_before(histories, begin, query)
        if self.gradient_frames:
            fresh = self.init(len(begin))  # with gradients, for samples without earlier frames
            early = begin == 0
            state = {
                name: torch.where(early.reshape(-1, *[1] * (of.ndim - 1)), fresh[name], of)
                for name, of in state.items()
            }
            left = count - begin
            ahead = begin[:, None] + torch.arange(int(left.max()), device=begin.device)
            places = histories.places.gather(1, ahead.clamp(max=histories.places.shape[1] - 1))
            state = self._written(state, histories, places, query, left, torch.arange(len(left), device=left.device))
        return self.read(state, query)

    def _state_before(self, histories: Histories, begin: Tensor, query: Query) -> State:
        """Return the states of B samples after the first ``begin`` (B,) frames of their histories.

        Each episode is written once, up to its latest sample.
        """
        first, episode = histories.places[:, 0].unique(return_inverse=True)
        until = torch.zeros_like(first).scatter_reduce(0, episode, begin, "amax")
        latest = torch.zeros_like(first)
        ends = begin == until[episode]
        latest[episode[ends]] = ends.nonzero().flatten()  # the latest sample of each episode
        read = torch.arange(histories.places.shape[1], device=begin.device) < begin[:, None]
        if ((histories.places != histories.places[latest[episode]]) & read).any():
            raise ValueError(
                f"{type(self).__name__}.slots returns different sequences for samples of one episode with the same "
                "first frame; the default replay needs prefixes of one sequence, so define your own replay"
            )
        places, own = histories.places[latest], query.rows(latest)
        return self._written(self.init(len(first)), histories, places, own, begin, episode)

    def _written(
        self, state: State, histories: Histories, places: Tensor, query: Query, stops: Tensor, row_of: Tensor
    ) -> State:
        """Write the frames of R rows, ``places`` (R, T); return the states of B samples on the way.

        A sample's state is that of row ``row_of`` (B,) after ``stops`` (B,) frames.
        """
        counts = torch.zeros_like(places[:, 0]).scatter_reduce(0, row_of, stops, "amax")
        order = counts.argsort(descending=True, stable=True)  # finished rows are dropped from the end
        state, row_of, ends = _rows(state, order), order.argsort()[row_of], counts[order].tolist()
        needed, where = places[order].clamp(min=0).unique(return_inverse=True)
        pooled, steps = self.pooled(histories.frames[needed]), histories.steps[needed]
        query, states, samples = query.rows(order), [], []
        for time in range(ends[0] + 1):
            samples.append((stops == time).nonzero().flatten())
            if len(samples[-1]):
                states.append(_rows(state, row_of[samples[-1]]))
            going = sum(end > time for end in ends)
            state = _rows(state, slice(going))
            if going:
                now = where[:going, time]
                state = self.write(state, pooled[now], steps[now], query.rows(slice(going)))
        return _rows(self.join(states), torch.cat(samples).argsort())

    # -- losses -------------------------------------------------------------------------------------

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the mechanism's own losses by name, (B,) each and weighted; called after `replay` and the actions.

        ``batch`` also holds `MemoryPass.outputs` of its fusion.
        """
        return {}


def with_noise(values: Tensor, generator: torch.Generator) -> Tensor:
    """Return values plus normal noise of their own standard deviation; integers are returned unchanged."""
    if not values.is_floating_point() or values.numel() < 2:
        return values
    noise = torch.randn(values.shape, generator=generator).to(values)
    return values + values.std() * noise


def _rows(state: dict[str, Tensor], chosen: Any) -> dict[str, Tensor]:
    return {name: tensor[chosen] for name, tensor in state.items()}
