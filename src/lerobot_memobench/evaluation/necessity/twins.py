"""Published tasks and their strict twins side by side: what a policy without memory reaches at each."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE, figure
from lerobot_memobench.evaluation.necessity.study import Result
from lerobot_memobench.evaluation.necessity.verdicts import verdict
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import DRAWN, REFERENTS

HEADINGS = (
    *("published task", "best map", "memory needed"),
    *("its twin", "goals", "best map", "best prob.", "as it happens", "expert", "memory needed"),
)


def side_by_side(published: Sequence[Result], strict: Sequence[Result]) -> str:
    """Return a Markdown table with a row per twin, and what it says in all; the published goals are the fixed ones."""
    fixed = {result["task"]: result for result in published if result["referent"] == REFERENTS[0]}
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    for result in strict:
        name = get_task(result["task"]).derived_from or ""
        row = [f"`{name}`", *_published(fixed.get(name)), f"`{result['task']}`", *_strict(result)]
        lines.append("| " + " | ".join(row) + " |")
    lines += ["", bounds(strict)]
    return "\n".join(lines) + "\n"


def _published(result: Result | None) -> list[str]:
    """Return the cells of a published task: the best map in any order that its goal accepts, and the verdict."""
    if result is None or result["in_order"] is None:
        return [NOT_APPLICABLE] * 2
    found = result["any_order"] or result["in_order"]
    return [figure(found["deterministic"]), verdict(result)]


def _strict(result: Result) -> list[str]:
    """Return the cells of a twin."""
    in_order, any_order, expert = result["in_order"], result["any_order"], result["expert"]
    found = [NOT_APPLICABLE] * 2
    if any_order is not None:
        found = [
            f"{figure(any_order['deterministic'])} ({any_order['confirmed']}/{any_order['of']})",
            figure(any_order["stochastic"]) + ("" if any_order["exhausted"] else " ≥"),
        ]
    happens = NOT_APPLICABLE if in_order is None else figure(in_order["as_it_happens"])
    return [str(result["variants"]), *found, happens, f"{expert['success']}/{expert['n']}", verdict(result)]


def bounds(results: Sequence[Result]) -> str:
    """Return in a paragraph how far policies without memory come at tasks whose goal is drawn; "" without any."""
    drawn = [result for result in results if result["referent"] == DRAWN]
    searched = [result for result in drawn if result["any_order"] is not None]
    if not searched:
        return ""
    needed = sum(verdict(result) == "yes" for result in drawn)
    told = [
        f"the {name} at most {figure(max(values))} %, on average {figure(sum(values) / len(values))} %"
        for name, values in (
            ("best fixed map in any order", [result["any_order"]["deterministic"] for result in searched]),
            ("best probabilities in any order", [result["any_order"]["stochastic"] for result in searched]),
            ("best fixed map with the arm as it happens", [result["in_order"]["as_it_happens"] for result in searched]),
        )
    ]
    return f"From pictures alone {needed} of {len(drawn)} tasks were not solved: {'; '.join(told)}."
