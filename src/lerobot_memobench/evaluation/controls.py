"""Controls: settings in which two evaluations differ on purpose, to test for memory.

`comparison` pairs, tests and reports a control like any two evaluations. Evidence needs only one evaluation
(`evidence`). Granularity compares policies by the language level of the subgoals in their training (`report`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot_memobench.envs.evaluation_file import POLICY
from lerobot_memobench.envs.settings import INTACT
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run

LEAST_GAP = 0.01
"""Smallest gap to 100 % for which a share is given: below it, one rollout would reverse the share."""


@dataclass(frozen=True)
class Control:
    """A setting in which two evaluations differ on purpose.

    Attributes:
        setting: key of the protocol, or of the policy's settings where ``of_policy``.
        default: its value in the first evaluation; the second has another.
        meaning: how to read the difference.
        of_policy: whether the policy's training, not the evaluation, has the setting.
        one_policy: whether both evaluations have to be of one policy.
        gap_closed: whether the share of the gap to 100 % is reported.
        by_checkpoint: whether prefix completion is compared checkpoint by checkpoint.
        value: the setting's only value that is the control; None: every value but the default.
        also: settings that may differ as well, because they are parts of the control.
    """

    title: str
    setting: str
    default: Any
    meaning: str
    of_policy: bool = False
    one_policy: bool = False
    gap_closed: bool = False
    by_checkpoint: bool = False
    value: Any = None
    also: tuple[str, ...] = ()

    def value_in(self, run: Run) -> Any:
        """Return the setting's value in an evaluation, the default where its log does not record it."""
        known = run.protocol[POLICY].get("settings", {}) if self.of_policy else run.protocol
        value = known.get(self.setting, self.default)
        return value if self.value in (None, value) else self.default


CONTROLS = (
    Control(
        "Pauses",
        "pause_steps",
        0,
        "The robot rests at times that the seed draws. The policy observes and does the same, only later. A policy "
        "that reads a clock loses; a policy that remembers events does not.",
        one_policy=True,
    ),
    Control(
        "Slower actions",
        "speed",
        1.0,
        "Each action takes longer, so all events happen later. A policy that reads a clock loses; a policy that "
        "remembers events loses no more than the expert.",
        one_policy=True,
    ),
    Control(
        "Corrupted memory",
        "corrupt",
        INTACT,
        "The memory of the second evaluation's policy was deleted, swapped or made noisy once, at corrupt_step. "
        "Metrics that do not fall do not depend on the memory before that step. With reshow the evidence was shown "
        "again: a policy that recovers falls less than without it.",
        one_policy=True,
        also=("corrupt_step", "reshow"),
    ),
    Control(
        "Prompt shown again",
        "reshow",
        False,
        "The demonstration prompt plays twice in the second evaluation. After a corruption of the memory, a gain is "
        "the policy's recovery; without one, a change is the effect of the longer prompt alone.",
        one_policy=True,
    ),
    Control(
        "Interference",
        "interference",
        0,
        "In the second evaluation the policy observes episodes of other tasks between prompt and execution, without "
        "a reset. A memory of the latest frames loses the prompt; a memory that selects by the task keeps it.",
        one_policy=True,
    ),
    Control(
        "Oracle memory",
        "oracle_memory",
        False,
        "The second policy reads the true memory content. Gap closed is (second − first) / (100 − first): the share "
        "that a perfect memory would recover. It is left out where the gap is under one point.",
        gap_closed=True,
    ),
    Control(
        "Shuffled memory",
        "align_targets",
        "subgoals",
        "The second policy was trained on subgoals in another order; tasks with fewer than three such subgoals on "
        "subgoals of other episodes. c1, c2, … count rollouts in which that checkpoint and all before it were "
        "satisfied.",
        of_policy=True,
        by_checkpoint=True,
        value="shuffled",
    ),
)


def control_between(a: Run, b: Run) -> Control | None:
    """Return the control that two evaluations are, None where none of `CONTROLS` differs.

    Raises:
        MemobenchError: the evaluation with the control comes first, or they are of two policies.
    """
    for control in CONTROLS:
        first, second = control.value_in(a), control.value_in(b)
        if first == second:
            continue
        if first != control.default:
            raise MemobenchError(
                f"{a.folder} was evaluated with {control.setting}={first} and {b.folder} with {control.setting}="
                f"{second}; expected the evaluation with {control.setting}={control.default} first: exchange them"
            )
        for key in ("type", "sha256") if control.one_policy else ():
            of_a, of_b = (run.protocol[POLICY].get(key) for run in (a, b))
            if of_a and of_b and of_a != of_b:
                raise MemobenchError(
                    f"{a.folder} and {b.folder} are of two policies ({key} {str(of_a)[:12]} and {str(of_b)[:12]}); "
                    "expected one policy with and without the control"
                )
        return control
    return None


def oracle_share(first: float | None, second: float | None) -> float | None:
    """Return the share of the gap between ``first`` and 1 that ``second`` closes (paper, oracle memory).

    It is negative where the second is worse, and None where a rate does not apply or the gap is under `LEAST_GAP`.
    """
    if first is None or second is None or 1.0 - first < LEAST_GAP:
        return None
    return (second - first) / (1.0 - first)
