"""A scene with each of a task's variants: only the past differs. Which variant did an execution choose to act on?

The instruction of most variants is the same, so the right answer follows from the past alone, from the demonstration
prompt. A policy without the past that cannot look before it chooses gives the same answer in all variants. Its rate of
right ones is the chance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import Atom, Formula, atoms
from lerobot_memobench.tasks.progress import Evaluator
from lerobot_memobench.tasks.task import REFERENTS, Task


def scene_and_variant(task: Task, episode: int) -> tuple[int, int]:
    """Return which scene an episode has, from 0 on, and which variant: each scene goes through all of them."""
    choices = task.random_variants
    return episode // len(choices), choices[episode % len(choices)]


def check_referent(prefix: str, referent: str) -> None:
    """Refuse to run each variant where the published one alone is asked for; ``prefix`` stands before a setting's name.

    Raises:
        MemobenchError: it is.
    """
    if referent == REFERENTS[0]:
        raise MemobenchError(
            f"{prefix}evidence=true runs each scene with each variant, and {prefix}referent={referent} the published "
            f"one alone; say referent={REFERENTS[1]}"
        )


def chance(task: Task) -> float | None:
    """Return the best rate without the past: the most frequent goal of each instruction. None where it tells the goal.

    Two hidden things may have the same goal in several variants: where the other one lies changes nothing.
    """
    goals: dict[str, Counter[Formula]] = {}
    for variant in _variants(task):
        goals.setdefault(variant.language, Counter())[variant.goal] += 1
    if all(len(each) == 1 for each in goals.values()):
        return None
    return sum(max(each.values()) for each in goals.values()) / len(task.random_variants)


def _variants(task: Task) -> list[Task]:
    return [task.variant(k) for k in task.random_variants]


class Choice:
    """Follows which variant an execution acts on; call ``step`` once per execution step.

    The answer is given by the objects that are lifted and the joints that are moved, in order: when they fit one goal
    alone, it is chosen; when they fit none, the answer is wrong. Where the goals handle the same things in the same
    order (one object, several places), the goal that comes true first is chosen, or the only one that still can.

    Args:
        task: the variant that is being run. The execution chooses among those of its instruction; among all of them
            where the instruction leaves no choice, such as how often something is to be done.
    """

    def __init__(self, task: Task) -> None:
        variants = _variants(task)
        same = [one for one in variants if one.language == task.language]
        rivals = same if len({one.goal for one in same}) > 1 else variants
        # Of variants that share a goal, the one that is run stands for it, else the first.
        self._variants = {one.goal: one.variant_index for one in reversed(rivals)} | {task.goal: task.variant_index}
        self._evaluator = Evaluator(self._variants)
        self._first: int | None = None
        self._fitting = {
            one.variant_index: handled(one) for one in rivals if one.variant_index in self._variants.values()
        }
        self._watched = list(dict.fromkeys(atom for order in self._fitting.values() for atom in order))
        self._handled: list[Atom] = []

    def step(self, holds: Callable[[Atom], bool]) -> None:
        """Take in the state after one control step."""
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
        """Whether an answer was given, though it may be none of the variants'."""
        return self.variant is not None or not self._fitting

    @property
    def variant(self) -> int | None:
        """The variant that was chosen; None where nothing was, or none of them."""
        if self._first is not None or not self._fitting:
            return self._first
        if len(self._fitting) == 1:
            return next(iter(self._fitting))
        settled = zip(self._variants.values(), self._evaluator.settled, strict=True)
        left = [k for k, value in settled if value is not False]
        return left[0] if len(left) == 1 else None


def handled(task: Task) -> list[Atom]:
    """Return the objects that a task's checkpoints lift and the joints that they move, in order, each once."""
    found = []
    for atom in (atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)):
        if atom.predicate in ("on", "in"):
            found.append(Atom("lifted", atom.args[:1]))
        elif atom.predicate in ("open", "turnon"):
            found.append(Atom("ajar", atom.args))
    return list(dict.fromkeys(found))
