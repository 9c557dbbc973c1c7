"""Success of a trained policy without a memory, read from evaluations.

The study's ceilings are those of decisions that the expert takes. A policy that learned, and sees its hand at every
step, may find a way that no search found; so its rate is reported with the bounds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.evaluation.headline import policy_name
from lerobot_memobench.evaluation.metrics import Rate, Record
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.tables import figure
from lerobot_memobench.tasks.catalogue import get_task
from research.necessity.study import Result

Evaluated = Mapping[tuple[str, str], tuple[str, Sequence[Record]]]
"""(task, referent) -> the policy's name and its rollouts."""


def read_evaluations(folders: Sequence[Path]) -> Evaluated:
    """Return the rollouts of evaluations of policies without a memory; of a task that is in several, the last's.

    Raises:
        MemobenchError: a folder holds no evaluation.
    """
    found: dict[tuple[str, str], tuple[str, list[Record]]] = {}
    for folder in folders:
        (run,) = read_runs([folder])
        mine: dict[tuple[str, str], list[Record]] = {}
        for record in run.records:
            mine.setdefault((record["task"], str(record.get("referent", "fixed"))), []).append(record)
        found |= {key: (policy_name(run), records) for key, records in mine.items()}
    return found


def with_evaluations(results: Sequence[Result], evaluated: Evaluated) -> list[Result]:
    """Return the results, each with the success of the trained policy (``trained``), where it is known."""
    return [{**result, "trained": _of(result, evaluated)} for result in results]


def _of(result: Result, evaluated: Evaluated) -> dict[str, Any] | None:
    task = get_task(result["task"])
    referents = (result["referent"],) if task.num_variants > 1 else ("fixed", "random")
    found = next((evaluated[task.name, one] for one in referents if (task.name, one) in evaluated), None)
    if found is None:
        return None
    name, records = found
    choices = task.random_variants if result["referent"] != "fixed" else (0,)
    shown = Counter(record.get("variant", 0) for record in records)
    counts = [shown[k] for k in choices]
    return {
        "policy": name,
        "success": sum(record["success"] for record in records),
        "n": len(records),
        "balanced": max(counts) - min(counts) <= 1,
    }


def in_words(trained: Mapping[str, Any] | None) -> str:
    """Return a rate, its interval and the number of scenes; "" without an evaluation."""
    if trained is None:
        return ""
    rate = Rate(trained["success"] / trained["n"], trained["n"])
    assert rate.interval is not None
    low, high = rate.interval
    note = "" if trained["balanced"] else ", variants out of balance"
    return f"{figure(rate.value)} [{figure(low)}–{figure(high)}] of {trained['n']}{note}"
