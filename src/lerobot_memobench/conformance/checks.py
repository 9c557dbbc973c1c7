"""What is asked of a memory policy, each check with one sentence on what is wrong and what to do.

A check changes what the policy observes and compares its actions: those that may not change, and those that must. What
a frame does is seen by showing another episode's frame in its place. A call at which the present frame decides the
action is one at which the policy plans; a frame that decides actions of later plans is remembered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from lerobot_memobench.conformance.streams import Stream
from lerobot_memobench.conformance.subject import Actions, Subject
from lerobot_memobench.errors import MemobenchError

PROBED = 12
"""Execution frames that are replaced, one at a time, to see what each of them decides."""
SHARE, LEAST = 0.01, {"float32": 2e-6, "other": 1e-2}
"""Actions are equal that differ by less than this share of what a memory changes in them, or by rounding, which depends
on how many rows are computed at once and on the precision of the weights."""
RESETS = "reset() is to forget the history and the action queue of every row"
BY_ROW = "keep history and action queue by row, and let each row's phase and step alone say when it begins and plans"


class Outcome(StrEnum):
    """How a check ended."""

    PASSED = "passed"
    FAILED = "failed"
    NO_MEMORY = "no memory"
    NOT_CHECKED = "not checked"


@dataclass(frozen=True)
class Result:
    """What a check found: its name, its outcome, and a sentence."""

    check: str
    outcome: Outcome
    sentence: str


class Refuted(Exception):
    """A check's sentence, where it does not hold."""


class NotAsked(Exception):
    """Why a check does not apply."""

    def __init__(self, sentence: str, outcome: Outcome = Outcome.NOT_CHECKED) -> None:
        super().__init__(sentence)
        self.outcome = outcome


class Behaviour:
    """What a policy did when frames were replaced, measured once for all checks.

    Attributes:
        one, two, three: the streams. A check looks at the row of ``one``.
        alone: the actions (calls, A) of that stream in a batch of its own.

    Raises:
        MemobenchError: the policy does not act at all.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.one, self.two, self.three = subject.streams
        try:
            self.alone: Actions = subject.roll([self.one])[:, 0]
        except MemobenchError:
            raise
        except Exception as error:
            told = f"{type(error).__name__}: {error}"
            raise MemobenchError(
                f"{subject.name} does not act on this benchmark's observations: it raised {told}"
            ) from error

    def changes(self, calls: Iterable[int]) -> Actions:
        """Return by how much each call's action changes, where the second stream's frames are shown at some calls."""
        found = self.subject.roll([self.one.showing(self.two, [*calls])])[:, 0]
        return np.abs(found - self.alone).max(axis=1)

    @cached_property
    def by_frame(self) -> dict[int, Actions]:
        """Execution frame -> by how much each call's action changes when that frame alone is another."""
        frames = range(self.one.start, min(self.one.start + PROBED, len(self.one)))
        return {frame: self.changes([frame]) for frame in frames}

    @cached_property
    def plans(self) -> list[int]:
        """The frames, of those that were replaced, at which the policy plans: they decide their own call's action."""
        return [frame for frame, change in self.by_frame.items() if change[frame] > 0]

    @cached_property
    def all_plans(self) -> list[int]:
        """The frames of the whole stream at which it plans, where it does so at equal intervals; else `plans`."""
        steps = set(np.diff(self.plans).tolist())
        if len(steps) != 1:
            return self.plans
        frames = list(range(self.plans[0], len(self.one), steps.pop()))
        return frames if self.changes(frames[-1:])[frames[-1]] > 0 else self.plans

    @cached_property
    def beside_two(self) -> Actions:
        """The actions (calls, A) of the first stream in the row after the second one."""
        return self.subject.roll([self.two, self.one])[:, 1]

    def later(self, frame: int) -> float:
        """Return by how much a frame changes actions of plans after it."""
        plan = next((plan for plan in self.plans if plan > frame), None)
        return 0.0 if plan is None else float(self.by_frame[frame][plan:].max())

    @cached_property
    def prompt(self) -> float:
        """By how much another prompt changes actions of the execution."""
        start = self.one.start
        return float(self.changes(range(start))[start:].max()) if start else 0.0

    @cached_property
    def memory(self) -> float:
        """By how much frames of the past change actions; 0 where none does."""
        return max([self.prompt, *(self.later(frame) for frame in self.by_frame)])

    @cached_property
    def tolerance(self) -> float:
        """By how much actions may differ and be equal."""
        weights = next(self.subject.policy.parameters(), None)
        precise = weights is None or str(weights.dtype) == "torch.float32"
        effect = self.memory or float(np.abs(self.alone - np.roll(self.alone, 1, axis=0)).max())
        return max(SHARE * effect, LEAST["float32" if precise else "other"])

    def differ(self, one: Actions, other: Actions) -> int | None:
        """Return the first call at which actions differ; None where they are equal."""
        length = min(len(one), len(other))
        calls = np.flatnonzero(~(np.abs(one[:length] - other[:length]) <= self.tolerance).all(axis=-1))
        return int(calls[0]) if len(calls) else None

    def require_memory(self) -> None:
        """Leave a check out where there is no memory."""
        if not self.memory:
            raise NotAsked("it has no memory", Outcome.NO_MEMORY)


def remembers(found: Behaviour) -> str:
    """Actions depend on frames of the past."""
    if found.memory:
        return f"frames of the past change actions by up to {found.memory:.2g}"
    raise Refuted(
        "it has no memory: no earlier frame changes a later action; a policy that is to have none has nothing to mend"
    )


def reads_the_prompt(found: Behaviour) -> str:
    """Actions of the execution depend on the frames of the prompt."""
    found.require_memory()
    if not found.subject.reads_prompt:
        raise Refuted(
            "prompts play within reset and it observes none of them: declare reads_prompt: ClassVar[bool] = True on "
            "the class of its configuration"
        )
    if not found.prompt:
        raise Refuted(
            "another prompt changes no action: take frames in while observation.phase is 0, and keep them when it "
            "becomes 1"
        )
    return f"another prompt changes actions by up to {found.prompt:.2g}"


def plans_anew(found: Behaviour) -> str:
    """The execution begins with a plan of its own first frame."""
    if found.one.start in found.plans:
        return "the first execution frame decides the first action"
    raise Refuted(
        "the first execution frame does not decide the first action, which is left over from the prompt: empty a row's "
        "action queue where observation.phase becomes 1"
    )


def remembers_every_step(found: Behaviour) -> str:
    """Frames between two plans are remembered as well."""
    found.require_memory()
    between = [frame for frame in found.by_frame if frame not in found.plans]
    if not between:
        return "it plans at every control step"
    if any(found.later(frame) for frame in between):
        return "frames between two plans change later ones"
    if any(found.later(frame) for frame in found.plans):
        raise Refuted(
            "frames at which it plans are remembered, those between two plans are not, so its history depends on "
            "n_action_steps: take the frame in at every call of select_action, also while a chunk is left"
        )
    raise NotAsked(
        f"in {len(found.one) - found.one.start} frames of an execution none changes a later plan: it remembers the "
        "prompt alone, or a frame each so many steps; set a smaller stride, as by policy.memory_stride=2"
    )


def rows_are_independent(found: Behaviour) -> str:
    """A row's actions do not depend on the rows beside it, which begin at other steps."""
    roll, one = found.subject.roll, found.one
    beside = roll([found.two, one, found.three])[:, 1]
    others = roll([found.three, one, found.two])[:, 1]
    for other, of in ((others, "other rows beside it"), (found.alone, "none beside it")):
        call = found.differ(beside, other)
        if call is not None:
            raise Refuted(f"at call {call} a row acts otherwise with {of}: {BY_ROW}")
    return "a row acts alike alone and beside others"


def frozen_rows_are_left_alone(found: Behaviour) -> str:
    """A row that is over repeats its last frame, and changes nothing in the others."""
    over = found.two.until(found.two.start + 4)
    call = found.differ(found.subject.roll([over, found.one])[:, 1], found.beside_two)
    if call is not None:
        raise Refuted(
            f"at call {call} a row acts otherwise beside one that is over, whose last frame is repeated: {BY_ROW}"
        )
    return "rows that are over change no other row"


def reset_forgets(found: Behaviour) -> str:
    """An episode does not depend on the one before it."""
    before = []
    for stream in (found.two.until(found.two.start + 4), found.three):
        found.subject.roll([stream])
        before.append(found.subject.roll([found.one])[:, 0])
    call = found.differ(*before)
    if call is not None:
        raise Refuted(f"at call {call} it acts otherwise after another episode: {RESETS}")
    found.subject.roll([found.three, found.two])
    call = found.differ(before[0], found.subject.roll([found.one])[:, 0])
    if call is not None:
        raise Refuted(f"at call {call} it acts otherwise after a batch of more rows: {RESETS}")
    return "an episode is the same after any other"


def same_history_in_training(found: Behaviour) -> str:
    """A training sample's chunk begins as the chunk that is planned at its frame of a rollout."""
    plans = found.all_plans
    if not plans:
        raise NotAsked("no frame decides the action at its own call, so it is not known where a chunk begins")
    try:
        predicted = found.subject.predict(found.one, plans)
    except Exception as error:
        told = str(error).splitlines()[0][:80] if str(error) else ""
        raise NotAsked(
            f"predict_action_chunk takes no training batch ({type(error).__name__}: {told}); let it read the history "
            "that the batch brings, as forward does"
        ) from None
    acted = found.alone[plans]
    call = found.differ(predicted, acted)
    if call is None:
        return f"{len(plans)} training samples are answered as the rollout answered their frames"
    present = np.stack([found.subject.roll([_only(found.one, plan)])[0, 0] for plan in plans])
    if found.memory and found.differ(predicted, present) is None:
        raise NotAsked(
            "predict_action_chunk answers a training batch by its present frames alone; let it read the history that "
            "the batch brings, as forward does"
        )
    raise Refuted(
        f"for frame {plans[call]} a training sample is answered otherwise than the rollout: which frames are in the "
        "history, their padding at the episode's begin, or a normalisation differ between the dataset and the rollout"
    )


def _only(stream: Stream, call: int) -> Stream:
    return Stream(stream.frames[call : call + 1], stream.task, stream.index + call)


def is_deterministic(found: Behaviour) -> str:
    """The same seed gives the same actions."""
    from lerobot.utils.random_utils import set_seed

    rolled = []
    for _ in range(2):
        set_seed(1)
        rolled.append(found.subject.roll([found.one], equal_noise=False)[:, 0])
    call = found.differ(*rolled)
    if call is not None:
        raise Refuted(
            f"at call {call} it acts otherwise a second time, by the same seed: draw noise with torch alone, and let "
            "reset() forget everything"
        )
    return "the same seed gives the same actions"


def says_what_it_needs(found: Behaviour) -> str:
    """Frames that it says it does not need are not read."""
    call = found.differ(found.subject.roll([found.two, found.one], sparing=True)[:, 1], found.beside_two)
    if call is not None:
        raise Refuted(
            f"at call {call} it acts otherwise where frames are left out that it did not need: needs_observation() is "
            "to be true before every frame that is remembered or planned from"
        )
    return "frames that it says it does not need change nothing"


CHECKS: dict[str, Callable[[Behaviour], str]] = {
    "deterministic given a seed": is_deterministic,
    "reset forgets": reset_forgets,
    "remembers": remembers,
    "reads the prompt": reads_the_prompt,
    "plans anew after the prompt": plans_anew,
    "remembers every control step": remembers_every_step,
    "rows are independent": rows_are_independent,
    "finished rows change no other": frozen_rows_are_left_alone,
    "same history in training": same_history_in_training,
    "needs_observation is true": says_what_it_needs,
}
"""Name -> check, what others build on first. It returns a sentence where it holds, and raises `Refuted` or `NotAsked`
with one where it does not."""


def run_check(name: str, found: Behaviour) -> Result:
    """Return what one check finds."""
    try:
        return Result(name, Outcome.PASSED, CHECKS[name](found))
    except Refuted as error:
        return Result(name, Outcome.FAILED, str(error))
    except NotAsked as error:
        return Result(name, error.outcome, str(error))
    except Exception as error:  # of anybody's policy
        return Result(name, Outcome.FAILED, f"the policy raised {type(error).__name__}: {error}")


def run_checks(subject: Subject) -> list[Result]:
    """Return what all checks find, in their order."""
    found = Behaviour(subject)
    return [run_check(name, found) for name in CHECKS]
