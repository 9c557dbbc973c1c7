"""Determine the variant that an execution acts on, and the chance level of a policy without memory.

Evidence episodes run one scene with each variant of a task, so only the past differs. Most variants share an
instruction: the demonstration prompt alone determines the correct answer. A policy without memory gives the same answer
in all variants; its success rate is the chance level.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from lerobot_memobench.tasks.formula import Atom, Formula, atoms
from lerobot_memobench.tasks.progress import Evaluator
from lerobot_memobench.tasks.task import Task


def scene_and_variant(task: Task, episode: int) -> tuple[int, int]:
    """Return scene index (from 0) and variant of an episode; consecutive episodes cycle through a scene's variants."""
    choices = task.random_variants
    return episode // len(choices), choices[episode % len(choices)]


def chance(task: Task) -> float | None:
    """Return the best success rate without memory: always choose the most frequent goal of the instruction.

    None if the instruction determines the goal. Variants that differ in the other hidden object only share a goal.
    """
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
