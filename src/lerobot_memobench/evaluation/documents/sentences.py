"""What a report says in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.evaluation.documents.tables import figure
from lerobot_memobench.evaluation.metrics.rollouts import Record, policy_inputs
from lerobot_memobench.evaluation.metrics.summary import Summary
from lerobot_memobench.io import count_of


def protocol_sentence(records: Sequence[Record]) -> str:
    """Return how many rollouts there are, of what, under which seeds, referent and replan interval."""
    extent = f"{count_of(len(records), 'rollout')} of {count_of(len({r['task'] for r in records}), 'task')}"
    return ", ".join([extent, *settings_phrases(records)]) + "."


def settings_phrases(records: Sequence[Record]) -> list[str]:
    """Return under which seeds, referent and replan interval rollouts were made, and what was seen, as phrases."""
    seeds = sorted({record["seed"] for record in records if record.get("seed") is not None})
    referents = sorted({str(record.get("referent", "fixed")) for record in records})
    replans = sorted({record["replan_steps"] for record in records if record.get("replan_steps") is not None})
    phrases = []
    if seeds:
        phrases.append(f"seeds {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"seed {seeds[0]}")
    phrases.append(f"referent {', '.join(referents)}")
    if replans:
        phrases.append(f"replan interval {', '.join(map(str, replans))}")
    return [*phrases, inputs_phrase(policy_inputs(records))]


def inputs_phrase(words: str) -> str:
    """Return a policy's inputs, of `rollouts.policy_inputs`, as a phrase."""
    return f"policy inputs: {words}"


def inputs_sentence(words: str) -> str:
    """Return a policy's inputs, of `rollouts.policy_inputs`, as a sentence."""
    return f"Policy inputs: {words}."


def pooled_sentence(summary: Summary) -> str:
    """Return the rates over all checkpoint records; no intervals, since records of one rollout are not independent."""
    parts = [
        f"{metric} {figure(rate.value)} ({count_of(rate.n, 'record')})"
        for metric, rate in summary.pooled.items()
        if metric != "SR" and rate.value is not None
    ]
    overall = summary.pooled_checkpoints
    return (
        f"Pooled over all rollouts, whatever the task: SR {figure(summary.pooled['SR'].value)}, "
        f"checkpoints satisfied {figure(overall.value)} ({count_of(overall.n, 'record')}): {', '.join(parts)}."
    )


def failure_line(summary: Summary) -> str:
    """Return the failures in one line, for under a table."""
    failed = {name: count for name, count in summary.failures.items() if count}
    if not failed:
        return "no failed rollouts"
    return "failed rollouts: " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failed.items())
