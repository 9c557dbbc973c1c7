"""What an episode came to, as a card keeps it, and whether two runs of it agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

OUTCOME = ("success", "steps", "prompt_steps", "variant", "checkpoints", "failure", "fault", "not_run", "scene_hash")
"""What two runs of the same episode must agree in."""


def outcome(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a card keeps of a line of the log: its identity and what does not depend on the clock."""
    return {
        key: record[key] for key in ("task", "memory_type", "episode", "seed", "referent", *OUTCOME) if key in record
    }


def key_of(record: Mapping[str, Any]) -> tuple[str, int, str]:
    """Return what identifies an episode: task, number, referent."""
    return record["task"], record["episode"], record.get("referent", "fixed")


def disagreement(a: Mapping[str, Any], b: Mapping[str, Any], here: str = "here", there: str = "there") -> str | None:
    """Return in one phrase the first thing in which two records of the same episode differ, None when in nothing.

    The time it took is no difference, nor what one of them leaves out.
    """
    for name in ("seed", "replan_steps", "scene_hash", *OUTCOME):
        if name not in a or name not in b or a[name] == b[name]:
            continue
        if name == "checkpoints" and len(a[name]) == len(b[name]):
            found = _first_checkpoint(a[name], b[name])
        else:
            found = (name, a[name], b[name])
        if found is not None:
            what, mine, other = found
            return f"{a['task']}, episode {a['episode']}: {what} is {mine} {here} and {other} {there}"
    return None


def _first_checkpoint(a: Sequence[Mapping[str, Any]], b: Sequence[Mapping[str, Any]]) -> tuple[str, Any, Any] | None:
    """Return the first thing in which checkpoints differ: what, and its two values."""
    for number, (mine, other) in enumerate(zip(a, b, strict=True), start=1):
        for key in ("operation", "first_step", "ordered_step"):
            if mine.get(key) != other.get(key):
                return f"{key} of checkpoint {number}", mine.get(key), other.get(key)
    return None


def first_disagreement(card: Sequence[Mapping[str, Any]], records: Sequence[Mapping[str, Any]]) -> str | None:
    """Return where a log departs from a card's episodes, None when nowhere."""
    found = {key_of(record): record for record in records}
    for episode in card:
        other = found.get(key_of(episode))
        if other is None:
            return f"{episode['task']}, episode {episode['episode']} is on the card and was not run here"
        problem = disagreement(episode, other, "on the card", "here")
        if problem is not None:
            return problem
    return None
