"""The result card of an evaluation: what is needed to understand, repeat and check it, in ``card.json``.

::

    protocol      tasks, episodes, and the settings that must agree for two evaluations to compare
    policy        type, settings, seed, hash of its checkpoint: what must agree for an evaluation to be gone on with
    checkpoint    where it was, hash of each file;  trained_on: the dataset it was trained on
    task_files    hash of each task's files
    flags         LeRobot's flags, complete but for folders: `memobench rerun` repeats them;  shard: the part, or null
    runs          each start, on each machine: command line, versions, commit, machine, GL
    episodes      what was found: outcome, checkpoints' steps and scene hash of every episode

It is written when an evaluation starts, and again with what was found when it ends. ``card.md`` is the same for people.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.evaluation.records.protocol import CARD_FILE
from lerobot_memobench.io import write_file
from lerobot_memobench.run.card_markdown import markdown
from lerobot_memobench.run.outcomes import outcome

FORMAT = 1
CARD_MARKDOWN = "card.md"


def new_card(
    *,
    protocol: Mapping[str, Any],
    policy: Mapping[str, Any],
    checkpoint: Mapping[str, Any] | None,
    trained_on: Mapping[str, Any] | None,
    task_files: Mapping[str, str],
    flags: Sequence[str],
    runs: Sequence[Mapping[str, Any]],
    shard: str | None = None,
) -> dict[str, Any]:
    """Return the card of an evaluation that has found nothing yet."""
    return {
        "format": FORMAT,
        "written": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "protocol": dict(protocol),
        "policy": dict(policy),
        "checkpoint": checkpoint,
        "trained_on": trained_on,
        "task_files": dict(task_files),
        "flags": list(flags),
        "shard": shard,
        "runs": joined_runs(runs),
        "episodes": [],
    }


def extended(card: Mapping[str, Any], other: Mapping[str, Any], *, again: bool = True) -> dict[str, Any]:
    """Return a card for both of two runs of one evaluation: extent, runs and tasks' hashes of both.

    Args:
        again: whether an equal run is one more start, or the same start told twice.
    """
    a, b = card["protocol"], other["protocol"]
    extent = {"tasks": sorted({*a["tasks"], *b["tasks"]}), "episodes": max(a["episodes"], b["episodes"])}
    return {
        **card,
        "protocol": {**b, **a, **extent},
        "policy": card["policy"] or other["policy"],
        "checkpoint": card["checkpoint"] or other["checkpoint"],
        "trained_on": card["trained_on"] or other["trained_on"],
        "task_files": {**card["task_files"], **other["task_files"]},
        "flags": _flags(card, extent),
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
    }


def _flags(card: Mapping[str, Any], extent: Mapping[str, Any]) -> list[str]:
    """Return a card's flags, changed to a wider extent where it is wider."""
    flags = list(card["flags"])
    if extent["episodes"] != card["protocol"]["episodes"]:
        flags = [flag for flag in flags if not flag.startswith("--eval.n_episodes=")]
        flags.append(f"--eval.n_episodes={extent['episodes']}")
    if extent["tasks"] != sorted(card["protocol"]["tasks"]):
        flags = [flag for flag in flags if not flag.startswith(("--env.task=", "--env.tasks="))]
        flags.append(f"--env.tasks={','.join(extent['tasks'])}")
    return flags


def joined_runs(runs: Iterable[Mapping[str, Any]], again: bool = True) -> list[dict[str, Any]]:
    """Return runs without repetitions; ``times`` says how often one was started."""
    found: list[dict[str, Any]] = []
    for run in runs:
        same = next((r for r in found if all(r.get(key) == run.get(key) for key in {*r, *run} - {"times"})), None)
        if same is None:
            found.append({**run, "times": run.get("times", 1)})
        else:
            times = run.get("times", 1)
            same["times"] = same["times"] + times if again else max(same["times"], times)
    return found


def with_episodes(card: Mapping[str, Any], records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a card that holds what was found."""
    return {**card, "episodes": [outcome(record) for record in records]}


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write ``card.json`` and ``card.md``, each whole or not at all."""
    write_file(folder / CARD_FILE, _json(card), durable=True)
    write_file(folder / CARD_MARKDOWN, markdown(card), durable=True)


def remove_card(folder: Path) -> None:
    """Remove the card of a folder, if there is one."""
    for name in (CARD_FILE, CARD_MARKDOWN):
        (folder / name).unlink(missing_ok=True)


def _json(card: Mapping[str, Any]) -> str:
    """Return the card as JSON with one episode a line: there may be 1,500."""
    episodes = ",\n".join(f"  {json.dumps(episode)}" for episode in card["episodes"])
    text = json.dumps({**card, "episodes": []}, indent=1)
    return (
        text.replace('"episodes": []\n}', f'"episodes": [\n{episodes}\n ]\n}}' if episodes else '"episodes": []\n}')
        + "\n"
    )
