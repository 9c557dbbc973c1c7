"""Checks of a memory policy. A check changes the policy's observations and compares its actions: some may not change,
others must.

The effect of a frame is measured by replacing it with the last one of another stream, because at home the frames of two
episodes may be equal. If the present frame changes the action of its own call, the policy plans at that call; if a
frame changes actions of later plans, it is remembered.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lerobot_memobench.conformance.streams import Stream
from lerobot_memobench.conformance.subject import Actions, Subject
from lerobot_memobench.envs.observations import reads_prompt
from lerobot_memobench.errors import MemobenchError

PROBED = 12  # execution frames that are replaced, one at a time, to measure their effects
COMPARED = 12  # last plans of a stream that are compared with training, besides those at replaced frames
INTERVALS = (5, 7, 4)
"""Further intervals of plans for the check of frames between them; no stride within a stream is a multiple of all."""
SHARE, LEAST = 0.01, {"float32": 2e-6, "other": 1e-2}
"""Actions are equal if they differ by less than this share of a memory's effect, or by rounding, which depends on the
number of rows in a batch and on the precision of the weights."""
RESETS = "let reset() clear the history and the action queue of every row"
BY_ROW = "keep a history and an action queue for each row, and begin and plan by that row's phase and step alone"

PASSED, FAILED, NO_MEMORY, NOT_CHECKED = "passed", "failed", "no memory", "not checked"

CheckVerdict = tuple[str, str]  # an outcome, and a sentence with the problem and its solution


@dataclass(frozen=True)
class Result:
    """The verdict of a check."""

    check: str
    outcome: str
    sentence: str


class Behaviour:
    """Actions of a policy when frames are replaced, measured once for all checks.

    A check looks at the row of stream ``one``; ``alone``: its actions (calls, A) in a batch of its own. Raise
    `MemobenchError` if the policy does not act at all.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.one, self.two, self.three = subject.streams
        try:
            self.alone: Actions = subject.roll([self.one])[:, 0]
        except MemobenchError:
            raise
        except Exception as error:
            raise MemobenchError(
                f"{subject.name} does not act on this benchmark's observations: {type(error).__name__}: {error}"
            ) from error

    def changes(self, calls: Iterable[int], shown: Stream | None = None) -> Actions:
        """Return the change of each call's action if a stream, or the second one's last frame, is shown at calls."""
        shown = shown or self.two.only(len(self.two) - 1)
        actions = self.subject.roll([self.one.showing(shown, [*calls])])[:, 0]
        return np.abs(actions - self.alone).max(axis=1)

    @cached_property
    def by_frame(self) -> dict[int, Actions]:
        """Execution frame -> change of each call's action if that frame alone is replaced."""
        frames = range(self.one.start, min(self.one.start + PROBED, len(self.one)))
        return {frame: self.changes([frame]) for frame in frames}

    @cached_property
    def plans(self) -> list[int]:
        """The replaced frames at which the policy plans: they change their own call's action."""
        return [frame for frame, change in self.by_frame.items() if change[frame] > 0]

    @cached_property
    def all_plans(self) -> list[int]:
        """The frames of the whole stream at which it plans, if the intervals are equal; else `plans`."""
        steps = set(np.diff(self.plans).tolist())
        if len(steps) != 1:
            return self.plans
        frames = list(range(self.plans[0], len(self.one), steps.pop()))
        return frames if self.changes(frames[-1:])[frames[-1]] > 0 else self.plans

    @cached_property
    def interval(self) -> int | None:
        """Control steps between the past frames that a plan reads; None where they differ, or fewer than two are."""
        plans = self.all_plans
        return only_step([f for f, change in self.by_frame.items() if f < plan and change[plan] > 0] for plan in plans)

    @cached_property
    def after_two(self) -> Actions:
        """The actions (calls, A) of the first stream in the row after the second one."""
        return self.subject.roll([self.two, self.one])[:, 1]

    def later(self, frame: int) -> float:
        """Return the effect of a frame on actions of later plans."""
        plan = next((plan for plan in self.plans if plan > frame), None)
        return 0.0 if plan is None else float(self.by_frame[frame][plan:].max())

    @cached_property
    def prompt(self) -> float:
        """Effect of another prompt on actions of the execution."""
        start = self.one.start
        return float(self.changes(range(start), self.two)[start:].max()) if start else 0.0

    @cached_property
    def memory(self) -> float:
        """Effect of past frames on actions, 0 without a memory."""
        return max([self.prompt, *(self.later(frame) for frame in self.by_frame)])

    @cached_property
    def tolerance(self) -> float:
        """Largest difference of equal actions."""
        weights = next(self.subject.policy.parameters(), None)
        precise = weights is None or str(weights.dtype) == "torch.float32"
        # Without a memory, the scale is that of changes from call to call.
        effect = self.memory or float(np.abs(self.alone - np.roll(self.alone, 1, axis=0)).max())
        return max(SHARE * effect, LEAST["float32" if precise else "other"])

    def differ(self, actions: Actions, other: Actions) -> int | None:
        """Return the first call at which actions differ, None if they are equal."""
        length = min(len(actions), len(other))
        # Not `>`, so that NaN differs.
        calls = np.flatnonzero(~(np.abs(actions[:length] - other[:length]) <= self.tolerance).all(axis=-1))
        return int(calls[0]) if len(calls) else None


def trained_interval(config: Any) -> int | None:
    """Return the control steps between frames of a policy's history in training; None if its configuration has none.

    They are its ``memory_stride``, or the step of its ``observation_delta_indices``.
    """
    stride = getattr(config, "memory_stride", None)
    return only_step([config.observation_delta_indices or []]) if stride is None else int(stride)


def only_step(series: Iterable[Sequence[int]]) -> int | None:
    """Return the difference of successive numbers in every series; None without one, or with several."""
    steps = {int(step) for numbers in series for step in np.diff(numbers)}
    return steps.pop() if len(steps) == 1 else None


def run_check(name: str, behaviour: Behaviour) -> Result:
    """Run one check."""
    try:
        if name in OF_MEMORY and not behaviour.memory:
            return Result(name, NO_MEMORY, "it has no memory")
        return Result(name, *CHECKS[name](behaviour))
    except Exception as error:  # any policy may raise anything
        return Result(name, FAILED, f"the policy raised {type(error).__name__}: {error}")


def run_checks(subject: Subject) -> list[Result]:
    """Run all checks in their order."""
    behaviour = Behaviour(subject)
    return [run_check(name, behaviour) for name in CHECKS]


# --- the checks ---


def _is_deterministic(behaviour: Behaviour) -> CheckVerdict:
    from lerobot.utils.random_utils import set_seed

    rolled = []
    for _ in range(2):
        set_seed(1)
        rolled.append(behaviour.subject.roll([behaviour.one], equal_noise=False)[:, 0])
    call = behaviour.differ(*rolled)
    if call is None:
        return PASSED, "the same seed gives the same actions"
    return FAILED, (
        f"at call {call} it acts differently with the same seed: draw random numbers with torch alone, and let "
        "reset() clear all state"
    )


def _reset_forgets(behaviour: Behaviour) -> CheckVerdict:
    before = []
    for stream in (behaviour.two.until(behaviour.two.start + 4), behaviour.three):
        behaviour.subject.roll([stream])
        before.append(behaviour.subject.roll([behaviour.one])[:, 0])
    call = behaviour.differ(*before)
    if call is not None:
        return FAILED, f"at call {call} it acts differently after another episode: {RESETS}"
    behaviour.subject.roll([behaviour.three, behaviour.two])
    call = behaviour.differ(before[0], behaviour.subject.roll([behaviour.one])[:, 0])
    if call is not None:
        return FAILED, f"at call {call} it acts differently after a batch of more rows: {RESETS}"
    return PASSED, "an episode is the same after any other"


def _remembers(behaviour: Behaviour) -> CheckVerdict:
    if behaviour.memory:
        return PASSED, f"frames of the past change actions by up to {behaviour.memory:.2g}"
    return FAILED, (
        "it has no memory: no earlier frame changes a later action; this is correct for a policy without memory"
    )


def _reads_the_prompt(behaviour: Behaviour) -> CheckVerdict:
    if not reads_prompt(behaviour.subject.policy.config):
        return FAILED, (
            "it observes no prompt, because prompts are played inside reset: declare reads_prompt: ClassVar[bool] = "
            "True on the class of its configuration"
        )
    if not behaviour.one.start:
        return NOT_CHECKED, "no episode of the dataset has a prompt; name one with prompts, or none"
    if behaviour.prompt:
        return PASSED, f"another prompt changes actions by up to {behaviour.prompt:.2g}"
    return FAILED, (
        "another prompt changes no action: remember frames while observation.phase is 0, and keep them when it "
        "becomes 1"
    )


def _plans_after_prompt(behaviour: Behaviour) -> CheckVerdict:
    if behaviour.one.start in behaviour.plans:
        return PASSED, "the first execution frame decides the first action"
    return FAILED, (
        "the first action of the execution does not depend on its first frame, but was planned in the prompt: clear a "
        "row's action queue when observation.phase becomes 1"
    )


def _remembers_every_step(behaviour: Behaviour) -> CheckVerdict:
    subject, verdict = behaviour.subject, _remembers_between_plans(behaviour)
    config = subject.policy.config
    if verdict[0] != FAILED or not hasattr(config, "n_action_steps"):
        return verdict
    usual = config.n_action_steps
    # Where the interval divides a memory's stride, plans read frames of earlier plans alone; so any interval will do.
    for steps in INTERVALS:
        config.n_action_steps = steps
        # A policy may refuse an interval, such as one longer than its chunks.
        with contextlib.suppress(Exception):
            other = _remembers_between_plans(Behaviour(subject))
            if other[0] == PASSED:
                verdict = other
                break
    config.n_action_steps = usual
    return verdict


def _remembers_between_plans(behaviour: Behaviour) -> CheckVerdict:
    between = [frame for frame in behaviour.by_frame if frame not in behaviour.plans]
    if not between:
        return PASSED, "it plans at every control step"
    config = behaviour.subject.policy.config
    trained, found, differ = trained_interval(config), behaviour.interval, ""
    if trained != found and None not in (trained, found):
        differ = f"the history has a frame every {trained} control steps in training and every {found} in rollouts; "
    if any(behaviour.later(frame) for frame in between):
        if differ and config.observation_delta_indices:  # else a memory may choose among the frames that it is shown
            return FAILED, f"{differ}read the frames that observation_delta_indices names"
        return PASSED, "frames between two plans change later ones"
    if any(behaviour.later(frame) for frame in behaviour.plans):
        return FAILED, (
            f"{differ}frames at which it plans are remembered, those between two plans are not, so its history depends "
            "on n_action_steps: remember the frame at every call of select_action, also while actions are queued"
        )
    return NOT_CHECKED, (
        f"none of {len(behaviour.one) - behaviour.one.start} execution frames changes a later plan: it remembers the "
        "prompt alone, or has a long stride; set a smaller one, for example policy.memory_stride=2"
    )


def _rows_are_independent(behaviour: Behaviour) -> CheckVerdict:
    roll, stream = behaviour.subject.roll, behaviour.one
    # The other rows begin at other steps.
    between = roll([behaviour.two, stream, behaviour.three])[:, 1]
    swapped = roll([behaviour.three, stream, behaviour.two])[:, 1]
    for other, batch in ((swapped, "with other rows in its batch"), (behaviour.alone, "alone in its batch")):
        call = behaviour.differ(between, other)
        if call is not None:
            return FAILED, f"at call {call} a row acts differently {batch}: {BY_ROW}"
    return PASSED, "a row acts alike alone and with other rows"


def _finished_rows_change_no_other(behaviour: Behaviour) -> CheckVerdict:
    over = behaviour.two.until(behaviour.two.start + 4)
    call = behaviour.differ(behaviour.subject.roll([over, behaviour.one])[:, 1], behaviour.after_two)
    if call is None:
        return PASSED, "finished rows change no other row"
    return FAILED, (
        f"at call {call} a row acts differently in a batch with a finished row, which repeats its frame: {BY_ROW}"
    )


def _same_history_in_training(behaviour: Behaviour) -> CheckVerdict:
    plans = sorted({*behaviour.plans, *behaviour.all_plans[-COMPARED:]})  # a hold may have thousands
    if not plans:
        return NOT_CHECKED, "no frame changes the action of its own call, so the beginning of a chunk is unknown"
    try:
        predicted = behaviour.subject.predict(behaviour.one, plans)
    except Exception as error:
        reason = str(error).splitlines()[0][:80] if str(error) else ""
        return NOT_CHECKED, (
            f"predict_action_chunk does not accept a training batch ({type(error).__name__}: {reason}); let it read "
            "the history in the batch, as forward does"
        )
    call = behaviour.differ(predicted, behaviour.alone[plans])
    if call is None:
        return PASSED, f"{len(plans)} training samples have the actions of the rollout"
    present = np.stack([behaviour.subject.roll([behaviour.one.only(plan)])[0, 0] for plan in plans])
    if behaviour.memory and behaviour.differ(predicted, present) is None:
        return NOT_CHECKED, (
            "predict_action_chunk reads only the present frames of a training batch; let it read the history in the "
            "batch, as forward does"
        )
    return FAILED, (
        f"for frame {plans[call]} the action of a training sample differs from the rollout's: compare the frames of "
        "the history, the padding at the start of the episode, and the normalisation"
    )


def _needs_observation_is_true(behaviour: Behaviour) -> CheckVerdict:
    sparing = behaviour.subject.roll([behaviour.two, behaviour.one], sparing=True)[:, 1]
    call = behaviour.differ(sparing, behaviour.after_two)
    if call is None:
        return PASSED, "unnecessary frames have no effect"
    return FAILED, (
        f"at call {call} it acts differently without frames that needs_observation() declared unnecessary: return "
        "True before every frame that is remembered or planned from"
    )


CHECKS: dict[str, Callable[[Behaviour], CheckVerdict]] = {
    "deterministic given a seed": _is_deterministic,
    "reset forgets": _reset_forgets,
    "remembers": _remembers,
    "reads the prompt": _reads_the_prompt,
    "plans after the prompt": _plans_after_prompt,
    "remembers every control step": _remembers_every_step,
    "rows are independent": _rows_are_independent,
    "finished rows change no other": _finished_rows_change_no_other,
    "same history in training": _same_history_in_training,
    "needs_observation is true": _needs_observation_is_true,
}
"""Name -> check. Later ones rely on earlier ones."""
OF_MEMORY = ("reads the prompt", "remembers every control step")
"""Checks that are skipped for a policy without a memory."""
