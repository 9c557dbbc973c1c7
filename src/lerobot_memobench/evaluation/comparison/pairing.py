"""Which episodes do two evaluations share? Their rollouts in pairs: the same task, number and referent under both."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.rollouts import Record, operations
from lerobot_memobench.evaluation.records.protocol import SETTINGS
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.io import count_of

SCENES = "scene_hash"
ALLOWED = (*(name for name in SETTINGS if name != "suite"), SCENES)
"""What may differ between both when asked for by name."""

Pair = tuple[Record, Record]


def common_episodes(a: Run, b: Run, allow: Collection[str] = ()) -> list[Pair]:
    """Return the episodes that both hold: same task, number and referent.

    Args:
        allow: which of `ALLOWED` may differ.

    Raises:
        MemobenchError: there are none, or a pair differs in its checkpoints.
    """

    def key(record: Record) -> tuple[str, int, str]:
        referent = "" if "referent" in allow else str(record.get("referent", "fixed"))
        return record["task"], record["episode"], referent

    others = {key(record): record for record in b.records}
    pairs = [(record, others[key(record)]) for record in a.records if key(record) in others]
    if not pairs:
        raise MemobenchError(
            f"{a.folder} and {b.folder} have no episode in common; expected evaluations of the same tasks, episodes "
            "and referent"
        )
    for mine, other in pairs:
        if operations(mine) != operations(other):
            raise MemobenchError(
                f"{mine['task']!r} has other checkpoints in {a.folder} ({operations(mine)}) than in {b.folder} "
                f"({operations(other)}); compare evaluations of one version of the task"
            )
    return pairs


def unlike_pairs(pairs: Sequence[Pair], allow: Collection[str]) -> dict[str, str]:
    """Return what makes an episode and differs in pairs: the name that allows it -> it in words.

    A side that does not tell it does not differ. Other seeds have other scenes, which need no name of their own.
    """
    for field, name, what in (("seed", "seed_base", "seeds"), ("scene_hash", SCENES, "initial scenes")):
        different = [(x, y) for x, y in pairs if None not in (x.get(field), y.get(field)) and x[field] != y[field]]
        if different and not {name, "seed_base"} & set(allow):
            x, y = different[0]
            return {
                name: f"{len(different)} of {len(pairs)} pairs do not have the same {what}, the first is {x['task']}, "
                f"episode {x['episode']} ({field} {x[field]} and {y[field]})"
            }
    return {}


# --- rollouts of one replan interval ---


def by_replan(records: Sequence[Record]) -> dict[int | None, list[Record]]:
    """Group rollouts by replan interval, ascending; unknown intervals last."""
    groups: dict[int | None, list[Record]] = {}
    for record in records:
        groups.setdefault(record.get("replan_steps"), []).append(record)
    return dict(sorted(groups.items(), key=lambda item: (item[0] is None, item[0] or 0)))


def paired(a: Sequence[Record], b: Sequence[Record]) -> tuple[list[Record], list[Record], int]:
    """Return the rollouts of episodes that both have, in one order, and how many of either had no partner.

    Raises:
        MemobenchError: no episode is in both, or one is in either of them twice.
    """
    tables = []
    for records in (a, b):
        table: dict[tuple[Any, ...], Record] = {}
        for record in records:
            key = (record["task"], record.get("referent", "fixed"), record["episode"], record.get("seed"))
            if key in table:
                raise MemobenchError(
                    f"episode {record['episode']} of {record['task']!r} was given twice under one replan interval; "
                    "name each evaluation once"
                )
            table[key] = record
        tables.append(table)
    common = [key for key in tables[0] if key in tables[1]]
    if not common:
        raise MemobenchError(
            f"the evaluations have no episode in common ({len(a)} and {count_of(len(b), 'rollout')}); compare "
            "evaluations of the same tasks, seeds and referent"
        )
    alone = len(tables[0]) + len(tables[1]) - 2 * len(common)
    return [tables[0][key] for key in common], [tables[1][key] for key in common], alone
