"""Agreement of two records of an episode: of two logs, or of a log and a result card."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from lerobot_memobench.envs.episode_log import key_of

SCENES = "scene_hash"
OUTCOME = (
    *("success", "steps", "prompt_steps", "variant", "choice", "checkpoints", "failure", "fault", "not_run"),
    *("stand_ins", SCENES),
)
"""Fields in which two runs of the same episode must agree."""


def outcome(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a log line that a card keeps: its identity and its outcome, without times."""
    identity = ("task", "memory_type", "episode", "seed", "referent", "difficulty", "salt")
    return {key: record[key] for key in (*identity, *OUTCOME) if key in record}


def disagreement(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    here: str = "here",
    there: str = "there",
    ignore: Collection[str] = (),
) -> str | None:
    """Return a phrase for the first difference of two records of the same episode, None where they agree.

    Times, fields to ``ignore``, and fields that one of them lacks, do not count.
    """
    if ("not_run" in a) != ("not_run" in b):
        return f"{_name(a)} was not run {here if 'not_run' in a else there}"
    for name in ("seed", "replan_steps", *OUTCOME):
        if name in ignore or name not in a or name not in b or a[name] == b[name]:
            continue
        if name == "checkpoints" and len(a[name]) == len(b[name]):
            found = _first_checkpoint(a[name], b[name])
        else:
            found = (name, a[name], b[name])
        if found is not None:
            field, mine, other = found
            return f"{_name(a)}: {field} is {mine} {here} and {other} {there}"
    return None


def _first_checkpoint(a: Sequence[Mapping[str, Any]], b: Sequence[Mapping[str, Any]]) -> tuple[str, Any, Any] | None:
    """Return the first difference of checkpoints: its name and both values."""
    for number, (mine, other) in enumerate(zip(a, b, strict=True), start=1):
        for key in ("operation", "first_step", "ordered_step"):
            if mine.get(key) != other.get(key):
                return f"{key} of checkpoint {number}", mine.get(key), other.get(key)
    return None


def disagreements(
    card: Sequence[Mapping[str, Any]],
    records: Sequence[Mapping[str, Any]],
    there: str = "in the log",
    ignore: Collection[str] = (),
) -> list[str]:
    """Return a phrase for each episode that differs between a card and a log, or that one of them lacks."""
    logged, named = ({key_of(each): each for each in some} for some in (records, card))
    found = []
    for key in sorted({*logged, *named}):
        if key not in logged:
            found.append(f"{_name(named[key])} is on the card and not {there}")
        elif key not in named:
            found.append(f"{_name(logged[key])} is {there} and not on the card")
        elif (problem := disagreement(named[key], logged[key], "on the card", there, ignore)) is not None:
            found.append(problem)
    return found


def _name(record: Mapping[str, Any]) -> str:
    return f"{record['task']}, episode {record['episode']}"
