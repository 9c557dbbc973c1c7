"""Read a plan off a goal that counts events or asks for their order: what to do, how often, when to come home."""

from __future__ import annotations

from itertools import chain

from lerobot_memobench.tasks.formula import (
    And,
    Atom,
    Exactly,
    Formula,
    Hold,
    Never,
    Not,
    Or,
    Round,
    Then,
    When,
    children,
)

Step = Atom | Hold
"""An atom to bring about, or a rest: a `Hold` whose child is so already."""

_NOT_BROUGHT_ABOUT = ("inplace",)
"""Predicates that an expert keeps true by leaving things alone."""


def counts(formula: Formula) -> bool:
    """Return whether a formula asks how often something has come about."""
    return isinstance(formula, Exactly) or any(counts(child) for child in children(formula))


def plan_of(formula: Formula) -> list[Step]:
    """Return the steps that make a formula true, in order.

    What the parts of an ``And`` have in common is done once: counting the rounds that began at home, and counting
    all rounds, is one counting.
    """
    match formula:
        case Atom():
            return [] if formula.predicate in _NOT_BROUGHT_ABOUT else [formula]
        case Not() | Never():
            return []
        case And(parts):
            return _together([plan_of(part) for part in sorted(parts, key=_rank)])
        case Or(parts):
            return plan_of(parts[0])
        case Then(parts) | Round(parts):
            return list(chain.from_iterable(plan_of(part) for part in parts))
        case Exactly(number, child):
            return plan_of(child) * number
        case Hold(child=child):
            return [*plan_of(child), formula]
        case When((moment, then)):
            return [*plan_of(then), *plan_of(moment)]
    raise TypeError(f"not a formula: {formula!r}")


def _rank(formula: Formula) -> int:
    """What has to be so before another thing is begun goes first; where things belong goes before what is shut."""
    places = isinstance(formula, Atom) and formula.predicate in ("in", "on")
    return 0 if isinstance(formula, When) else 1 if places else 2


def _together(plans: list[list[Step]]) -> list[Step]:
    """Return one plan that holds all of them, each step that two have in common once."""
    whole: list[Step] = []
    for plan in plans:
        if not _within(plan, whole):
            common = next(n for n in range(len(plan), -1, -1) if n == 0 or whole[-n:] == plan[:n])
            whole += plan[common:]
    return whole


def _within(plan: list[Step], whole: list[Step]) -> bool:
    """Return whether all steps of a plan occur in another, in order."""
    left = iter(whole)
    return all(step in left for step in plan)
