"""Bars and differences of evaluations that need not be of the same size: those of the note on thirty tasks.

    python scripts/learned_figure.py "with memory=outputs/eval/small" "without memory=outputs/eval/memoryless" \
        --out outputs/learned.png

Bars are of all rollouts of the tasks that all arms have; differences from the first arm, and the table by task, of the
episodes that they have.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lerobot_memobench.datasets.lerobot_format.card import markdown
from lerobot_memobench.evaluation.metrics import Record, by_task
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.tasks.failures import REFERENCE_DRIFT
from research.learning.experiments import prompted
from research.learning.results import SCOPES, contrasts, contrasts_table, draw, outcomes_of, outcomes_table


def shared(arms: dict[str, list[Record]]) -> dict[str, list[Record]]:
    """Return the rollouts of the episodes that all arms have."""
    keys = {name: {(one["task"], one["seed"]) for one in records} for name, records in arms.items()}
    common = set.intersection(*keys.values())
    return {name: [one for one in records if (one["task"], one["seed"]) in common] for name, records in arms.items()}


def of_shared_tasks(arms: dict[str, list[Record]]) -> dict[str, list[Record]]:
    """Return the rollouts of the tasks that all arms have."""
    common = set.intersection(*({one["task"] for one in records} for records in arms.values()))
    if not common:
        raise SystemExit(f"{', '.join(arms)} have no task in common; name evaluations of the same tasks")
    return {name: [one for one in records if one["task"] in common] for name, records in arms.items()}


def differences(arms: dict[str, list[Record]]) -> str:
    """Return a table of all arms against the first, on shared episodes of all tasks and of the prompted ones."""
    reference, parts = next(iter(arms)), []
    for title, tasks in (("all tasks", None), ("prompted tasks", set(prompted()))):
        chosen = shared({k: [one for one in own if not tasks or one["task"] in tasks] for k, own in arms.items()})
        count = len(chosen[reference])
        if count:
            table = contrasts_table(contrasts({k: [own] for k, own in chosen.items()}, reference), reference)
            parts.append(f"{title}, {count} shared episodes\n\n{table}")
    return "\n\n".join(parts)


def tasks_table(arms: dict[str, list[Record]]) -> str:
    """Return how many of the shared episodes of each task are solved, and in how many a wrong referent was taken."""
    found = {name: by_task(records) for name, records in shared(arms).items()}
    return markdown(
        ("task", *arms), [[task, *(_told(own[task]) for own in found.values())] for task in found[next(iter(arms))]]
    )


def _told(records: Sequence[Record]) -> str:
    wrong = sum(one.get("failure") == REFERENCE_DRIFT for one in records)
    return f"{sum(one['success'] for one in records)} of {len(records)}" + (f", {wrong} wrong" if wrong else "")


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", nargs="+", help="NAME=FOLDER of an evaluation")
    parser.add_argument("--out", type=Path, required=True, help="the picture")
    given = parser.parse_args()
    arms = of_shared_tasks({run.name: list(run.records) for run in read_runs(given.arms)})
    found = {name: outcomes_of([records]) for name, records in arms.items()}
    draw(found, given.out)
    means = {name: {scope: one[scope] for scope in one if scope in SCOPES} for name, one in found.items()}
    print(outcomes_table(means), differences(arms), tasks_table(arms), sep="\n\n")


if __name__ == "__main__":
    main()
