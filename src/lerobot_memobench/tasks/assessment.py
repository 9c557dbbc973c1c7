"""Assess an execution: the variant that it acts on, the chance level without memory, and the class of its failure.

Evidence episodes run one scene with each variant of a task, so only the past differs. Most variants share an
instruction: the demonstration prompt alone determines the correct answer. A policy without memory gives the same answer
in all variants; its success rate is the chance level.

Failures are classified by checkpoints (paper, failure taxonomy). Two classes extend the paper's five, which would
misclassify these rollouts: a procedure in another order than the prompt's, and a horizon below the protocol's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from lerobot_memobench.tasks.formula import Atom, Formula, Never, Round, Then, When, atoms, walk
from lerobot_memobench.tasks.progress import Evaluator
from lerobot_memobench.tasks.task import HAND, MISCOUNT, STRICT, Task

REFERENCE_DRIFT = "reference_drift"  # the policy acted on a wrong referent
WRONG_ORDER = "wrong_order"
"""The steps of a procedure, or the events of an ordering task, were done in another order than asked for."""
CUT_OFF = "cut_off"  # a horizon below the protocol's ended the rollout; its memory is not assessed

#: Failure classes of the published tasks, in the order of the report.
FAILURES = (
    "storage_failure",
    "stale_memory",
    "compression_collapse",
    REFERENCE_DRIFT,
    "execution_failure",
)
REFINED_FAILURES = (WRONG_ORDER, CUT_OFF)  # classes in addition to the paper's; reports name those that occur

INVALID_ACTION, UNSTABLE_PHYSICS = "invalid_action", "unstable_physics"
FAULTS = (INVALID_ACTION, UNSTABLE_PHYSICS)  # classes of aborted rollouts, which do not assess memory

_BY_OPERATION = {"S": "storage_failure", "U": "stale_memory", "C": "compression_collapse"}


# --- variants ---


def scene_and_variant(task: Task, episode: int) -> tuple[int, int]:
    """Return scene index (from 0) and variant of an episode; consecutive episodes cycle through a scene's variants."""
    choices = task.random_variants
    return episode // len(choices), choices[episode % len(choices)]


def chance(task: Task) -> float | None:
    """Return the best success rate without memory: always choose the most frequent goal of the instruction.

    None if the instruction determines the goal.
    """
    # Variants that differ in the other hidden object only share a goal.
    goals: dict[str, Counter[Formula]] = {}
    for variant in _variants(task):
        goals.setdefault(variant.language, Counter())[variant.goal] += 1
    if all(len(counts) == 1 for counts in goals.values()):
        return None
    return sum(max(counts.values()) for counts in goals.values()) / len(task.random_variants)


def _variants(task: Task) -> list[Task]:
    return [task.variant(k) for k in task.random_variants]


class Choice:
    """Determine the variant an execution acts on; call ``step`` once per execution step.

    The sequence of lifted objects and moved joints decides. If it fits the goal of one variant only, that variant is
    chosen; if it fits none, the answer is wrong. If goals handle the same objects in the same order (one object,
    several places), the first goal to become true is chosen, or the only one that is still reachable. Candidates are
    the variants with the instruction of ``task``, or all variants if the instruction determines the goal (a count).
    """

    def __init__(self, task: Task) -> None:
        variants = _variants(task)
        same = [variant for variant in variants if variant.language == task.language]
        candidates = same if len({variant.goal for variant in same}) > 1 else variants
        # Variants that share a goal are represented by the one that is run, else by the first.
        indices = {variant.goal: variant.variant_index for variant in reversed(candidates)}
        self._variants = indices | {task.goal: task.variant_index}
        self._evaluator = Evaluator(self._variants)
        self._first: int | None = None
        self._fitting = {
            variant.variant_index: handled_atoms(variant)
            for variant in candidates
            if variant.variant_index in self._variants.values()
        }
        self._watched = list(dict.fromkeys(atom for order in self._fitting.values() for atom in order))
        self._handled: list[Atom] = []

    def step(self, holds: Callable[[Atom], bool]) -> None:
        """Evaluate the state after one control step."""
        if len(self._fitting) < 2 or self._first is not None:
            return
        for atom in self._watched:
            if atom not in self._handled and holds(atom):
                self._handled.append(atom)
                fits = {k: order for k, order in self._fitting.items() if order[: len(self._handled)] == self._handled}
                self._fitting = fits
        if len(self._fitting) < 2:
            return
        reached = self._evaluator.step(holds)
        self._first = next((k for k, now in zip(self._variants.values(), reached, strict=True) if now), None)

    @property
    def fitting(self) -> dict[int, list[Atom]]:
        """Variants that still fit, each with the atoms of `handled_atoms`; before the first step all candidates."""
        return self._fitting

    @property
    def answered(self) -> bool:
        """Whether an answer was given, including answers that fit no variant."""
        return self.variant is not None or not self._fitting

    @property
    def variant(self) -> int | None:
        """Chosen variant; None without an answer or for an answer that fits no variant."""
        if self._first is not None or not self._fitting:
            return self._first
        if len(self._fitting) == 1:
            return next(iter(self._fitting))
        settled = zip(self._variants.values(), self._evaluator.settled, strict=True)
        left = [k for k, value in settled if value is not False]
        return left[0] if len(left) == 1 else None


def handled_atoms(task: Task) -> list[Atom]:
    """Return atoms for the objects lifted and joints moved by a task's checkpoints, in order, without repetitions."""
    handled = []
    for atom in (atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)):
        if atom.predicate in ("on", "in"):
            handled.append(Atom("lifted", atom.args[:1]))
        elif atom.predicate in ("open", "turnon"):
            handled.append(Atom("ajar", atom.args))
    return list(dict.fromkeys(handled))


# --- failures ---


def classify_failure(
    task: Task,
    first_steps: Sequence[int | None],
    success: bool,
    drift: bool = False,
    lost: Formula | None = None,
    cut_off: bool = False,
    ordered: bool = False,
) -> str | None:
    """Return the failure class of an execution of ``task``, None for a success.

    Args:
        first_steps: (K,) first execution step at which each checkpoint's predicate held; None for never.
        drift: whether a wrong answer was given (object and procedural tasks).
        lost, ordered: `Progress.broken` and `Progress.ordered` of strict tasks.
        cut_off: whether a horizon below the protocol's ended the episode.
    """
    if lost and (spoilt := _spoilt(task, first_steps, lost)) is not None:
        return spoilt
    failure = classify(task.operations, first_steps, success, drift)
    if failure in (None, REFERENCE_DRIFT):
        return failure
    if task.memory_type == "procedural" and asks_order(task.goal) and _out_of_order(first_steps):
        return WRONG_ORDER
    if cut_off and (not first_steps or None in first_steps):
        return CUT_OFF
    return HAND if None in first_steps and _memory_served(task, first_steps, ordered) else failure


def _spoilt(task: Task, first_steps: Sequence[int | None], lost: Formula) -> str | None:
    """Return the class of a strict rollout by the part of the goal that it broke; None: by its checkpoints."""
    if isinstance(lost, Never) and any(atom.predicate == "handhome" for atom in atoms(lost)):
        return HAND  # came home and left something ajar
    if task.spoilt_as is not None or task.memory_type != "temporal":
        return task.spoilt_as
    if not isinstance(lost, When):
        return MISCOUNT
    # The earlier event was complete, and only the hand's return was missing.
    before = [part for part in walk(lost) if isinstance(part, Round)]
    complete = [
        step is not None and any(isinstance(part, Round) and part.children == event.children[:-1] for event in before)
        for checkpoint, step in zip(task.checkpoints, first_steps, strict=True)
        for part in walk(checkpoint.goal)
    ]
    return HAND if any(complete) else WRONG_ORDER


def _memory_served(task: Task, first_steps: Sequence[int | None], ordered: bool) -> bool:
    """Return whether a strict rollout did all that it had to remember, so that the missing part is the hand's."""
    if task.suite != STRICT or task.memory_type not in ("temporal", "spatial"):
        return False
    # Before the first event there is nothing to remember; a hidden thing is where its drawer is opened.
    return ordered or (first_steps[0] is None) == (task.memory_type == "temporal")


def classify(
    operations: Sequence[str], first_steps: Sequence[int | None], success: bool, drift: bool = False
) -> str | None:
    """Return the paper's class from the operation labels ("S", "U" or "C") of the checkpoints."""
    if success:
        return None
    for operation, first_step in zip(operations, first_steps, strict=True):
        if first_step is None:
            return REFERENCE_DRIFT if drift else _BY_OPERATION[operation]
    return "execution_failure"  # with all checkpoints satisfied, the memory did not fail


def asks_order(goal: Formula) -> bool:
    """Return whether a goal asks for an order of its parts."""
    return any(isinstance(part, Then | When | Round) for part in walk(goal))


def _out_of_order(first_steps: Sequence[int | None]) -> bool:
    reached = [step for step in first_steps if step is not None]
    return reached != sorted(reached) or None in first_steps[: len(reached)]
