"""What rollouts did: checkpoint by checkpoint, task by task, under one protocol or several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.task import MEMORY_TYPES

Record = Mapping[str, Any]
"""A rollout: one line of the episode log."""


def operations(record: Record) -> str:
    """Return the labels of a rollout's checkpoints, such as "SUU"."""
    return "".join(checkpoint["operation"] for checkpoint in record["checkpoints"])


def satisfied(record: Record) -> list[bool]:
    """Return per checkpoint whether its predicate held at some step of the execution, (K,)."""
    return [checkpoint["first_step"] is not None for checkpoint in record["checkpoints"]]


def completed_in_order(record: Record) -> list[bool]:
    """Return per checkpoint whether it held while all earlier ones were complete, (K,)."""
    return [checkpoint.get("ordered_step") is not None for checkpoint in record["checkpoints"]]


def prefix(values: Sequence[bool]) -> list[bool]:
    """Return per checkpoint whether it and all earlier ones are true, (K,)."""
    return [all(values[: k + 1]) for k in range(len(values))]


def by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by task, in the order of memory types and then of names."""
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record["task"], []).append(record)
    for name, group in grouped.items():
        _check_one_version(name, group)
    order = {memory_type: k for k, memory_type in enumerate(MEMORY_TYPES)}
    return dict(sorted(grouped.items(), key=lambda item: (order[item[1][0]["memory_type"]], item[0])))


def _check_one_version(name: str, group: Sequence[Record]) -> None:
    """Refuse rollouts of one task that do not agree on what the task is."""
    for what, found in (
        ("memory_type", {record["memory_type"] for record in group}),
        ("operations", {operations(record) for record in group}),
    ):
        if len(found) > 1:
            raise MemobenchError(
                f"rollouts of {name!r} disagree on their {what} ({', '.join(sorted(found))}); "
                "report logs of different versions of a task separately"
            )
    if group[0]["memory_type"] not in MEMORY_TYPES:
        raise MemobenchError(
            f"rollouts of {name!r} have the memory type {group[0]['memory_type']!r}; expected one of "
            + ", ".join(MEMORY_TYPES)
        )


NOT_RECORDED = "not recorded"
"""What is said of a policy of which nobody wrote down its inputs."""


def policy_inputs(records: Iterable[Record]) -> str:
    """Return the policy's inputs, by the rollouts' own words; of how many it is unknown where some tell it."""
    told = Counter(str(record.get("inputs") or NOT_RECORDED) for record in records)
    unknown = told.pop(NOT_RECORDED, 0)
    parts = [*sorted(told), *([f"of {count_of(unknown, 'rollout')} it is {NOT_RECORDED}"] if told and unknown else [])]
    return "; ".join(parts) or NOT_RECORDED


PROTOCOL: dict[str, Callable[[Record], Any]] = {
    "referent settings": lambda record: str(record.get("referent")),
    "replan intervals": lambda record: str(record.get("replan_steps")),
    "policy inputs": lambda record: record.get("inputs"),
    "seeds of episode 0": lambda record: None if record.get("seed") is None else record["seed"] - record["episode"],
}
"""What should agree within one report -> what a record says of it, None where nothing, which is no difference."""

OWNER = ("policy", "run")
"""Fields of a record that say whose it is."""


def mixtures(records: Iterable[Record]) -> list[str]:
    """Return a sentence for each part of the protocol in which rollouts differ: their mean mixes unlike things."""
    records = list(records)
    notes = []
    for words, told in PROTOCOL.items():
        found = sorted({told(record) for record in records} - {None})
        if len(found) > 1:
            listed = ", ".join(map(str, found[:5])) + (", …" if len(found) > 5 else "")
            notes.append(f"The rollouts mix {words} ({listed}); the figures are over all of them.")
    known = [field for field in OWNER if any(record.get(field) for record in records)]
    nobodys = sum(any(not record.get(field) for field in known) for record in records)
    if nobodys:
        said = "does not say whose it is" if nobodys == 1 else "do not say whose they are"
        notes.append(f"{count_of(nobodys, 'rollout')} of {len(records)} {said}; the figures are over all of them.")
    return notes


def faults(records: Iterable[Record]) -> list[str]:
    """Return a sentence for each task of which rollouts were broken off, and so failed, with the first reason."""
    found: dict[str, list[Record]] = {}
    for record in records:
        if record.get("fault"):
            found.setdefault(record["task"], []).append(record)
    return [
        f"{task}: {count_of(len(group), 'rollout')} {'was' if len(group) == 1 else 'were'} broken off and "
        f"{'counts' if len(group) == 1 else 'count'} as failed, the first in episode "
        f"{group[0]['episode']}: {group[0]['fault']}"
        for task, group in found.items()
    ]
