"""How often each failure class occurs among rollouts; the rule itself is ``tasks.failures``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.metrics.rollouts import Record
from lerobot_memobench.tasks.failures import FAILURES, FAULTS, REFINED_FAILURES, classify
from lerobot_memobench.tasks.task import STRICT_FAILURES

_ALL = (*FAILURES, *REFINED_FAILURES, *STRICT_FAILURES, *FAULTS)


def failure_of(record: Record) -> str | None:
    """Return the failure class of a logged rollout, None for a success.

    A log without the class gets it from its checkpoints. Drift cannot be told from them, so it is then never
    named.
    """
    if record["success"]:
        return None
    logged = record.get("failure")
    if logged is None:
        checkpoints = record["checkpoints"]
        return classify([c["operation"] for c in checkpoints], [c["first_step"] for c in checkpoints], False)
    if logged not in _ALL:
        raise MemobenchError(
            f"a rollout of {record['task']!r} has the unknown failure class {logged!r}, " + nearest(str(logged), _ALL)
        )
    return str(logged)


def failure_counts(records: Iterable[Record]) -> dict[str, int]:
    """Return class -> number of failed rollouts, in the report's order: the paper's classes, others as found."""
    found = Counter(failure_of(record) for record in records)
    return {name: found[name] for name in _ALL if name in FAILURES or found[name]}
