"""The sealed test: seeds reserved for the last test of a release. Each start of a policy on them is counted.

A second start is allowed. It is counted when the policy has been loaded, before its first scene, by a line in a file
of the user. A resumed evaluation and the parts of one are one start. The card repeats the line and the number of the
start.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import itertools
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NotRequired

from lerobot_memobench.envs.evaluation_file import SealedStart
from lerobot_memobench.io import Malformed, checked, count_of, explaining_disk_errors, parsed
from lerobot_memobench.jobs.processes import taking_turns
from lerobot_memobench.policies.lerobot_config import SEALED_LEDGER
from lerobot_memobench.protocol import SEALED
from lerobot_memobench.run.card import PACKAGES, versions
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.sim.scene_hash import WORLD

COMMITTED = ("started", "policy", "scenes", "release")
"""Fields of a start that the card repeats."""


class LedgerLine(SealedStart):
    """A start of a sealed evaluation.

    Attributes:
        policy: hash of its checkpoint; without one, of its type and settings.
        release: version of this package.
        folder: of the evaluation.
        scenes: see `scenes_hash`. shard: the part of the evaluation, or None.
    """

    policy: str
    release: str
    folder: str
    scenes: NotRequired[str]
    shard: NotRequired[str | None]


def counted(plan: EvaluationPlan, card: dict[str, Any], note: Callable[[str], None]) -> dict[str, Any]:
    """Return the card with the number of the start; without change outside of the sealed seeds.

    Args:
        note: called with the number, and the date of the earlier start.

    Raises:
        MemobenchError: the ledger cannot be written.
    """
    if plan.split != SEALED:
        return card
    folder = (plan.output if plan.options.shard is None else plan.output.parent).absolute()
    line, ledger = _line_of(card, str(folder)), user_ledger()
    start = card.get("sealed", {})
    if any(start.get(key) != line[key] for key in ("policy", "scenes", "release")):  # else it is resumed
        with explaining_disk_errors(ledger.parent, "sealed tests are counted there, or in $XDG_STATE_HOME/memobench"):
            ledger.parent.mkdir(parents=True, exist_ok=True)
            with taking_turns(ledger.with_suffix(".lock")):
                start = _add(ledger, line)
    note(in_words(start))
    return {**card, "sealed": start}


def _line_of(card: Mapping[str, Any], folder: str) -> dict[str, Any]:
    protocol = card["protocol"]
    return {
        "started": dt.datetime.now(dt.UTC).isoformat(timespec="microseconds"),
        **{name: protocol.get(name) for name in ("suite", WORLD, "referent", "replan_steps")},
        "tasks": len(protocol["tasks"]),
        "episodes": protocol["episodes"],
        "policy": policy_hash(card),
        "release": versions()[PACKAGES[0]],
        "scenes": scenes_hash(card),
        "folder": folder,
        "shard": card["shard"],
    }


def _add(ledger: Path, line: dict[str, Any]) -> dict[str, Any]:
    """Add a start to the ledger; return it with its number and the starts before it, by the ledger's order.

    Times only tell starts apart: a clock may be set back, or stand still.
    """
    lines = [each for each in _lines(ledger) if all(each[key] == line[key] for key in ("policy", "release"))]
    starts = {_start_of(each): each for each in lines}
    parts = [each for each in lines if each["folder"] == line["folder"] and each.get("scenes") == line["scenes"]]
    begun = {each.get("shard") for each in parts if _start_of(each) == _start_of(parts[-1])}
    if begun and line["shard"] is not None and not {None, line["shard"]} & begun:  # another part of that start
        line["started"] = parts[-1]["started"]
    else:
        while _start_of(line) in starts:
            line["started"] = f"{dt.datetime.fromisoformat(line['started']) + dt.timedelta(microseconds=1)}"
    earlier = [starts[key] for key in itertools.takewhile(lambda key: key != _start_of(line), starts)]
    with ledger.open("ab") as file:
        file.write(b"\n" + json.dumps(line).encode() + b"\n")  # the last line may have been cut off
        file.flush()
        os.fsync(file.fileno())
    return {
        **{key: line[key] for key in COMMITTED},
        "run": len(earlier) + 1,
        "earlier": [{key: each[key] for key in SealedStart.__annotations__ if key in each} for each in earlier],
    }


def _start_of(line: Mapping[str, Any]) -> tuple[str, str]:
    return line["started"], line["folder"]


def _lines(ledger: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a ledger that can be read."""
    for line in ledger.read_bytes().splitlines() if ledger.is_file() else ():
        try:
            yield checked(parsed(line), LedgerLine)
        except Malformed:
            continue


def policy_hash(card: Mapping[str, Any]) -> str:
    """Return the hash of a card's checkpoint; without one, of the policy's type, settings and detector."""
    policy = card["policy"]
    return policy.get("sha256") or _hash({key: policy.get(key) for key in ("type", "settings", "detector_sha256")})


def scenes_hash(card: Mapping[str, Any]) -> str:
    """Return one hash for the scenes of an evaluation, from its card: task files, referent, seed, episodes, salt."""
    protocol = card["protocol"]
    return _hash(
        [
            *(card["task_files"], card["policy"].get("seed"), protocol["episodes"]),
            *(protocol.get("referent"), protocol.get("evidence", False), protocol.get(WORLD)),
            *filter(None, [protocol.get("salt")]),  # earlier versions draw none
        ]
    )


def _hash(facts: Any) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def user_ledger() -> Path:
    """Return the file of this user's sealed evaluations on this machine."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "memobench" / SEALED_LEDGER


def in_words(start: Mapping[str, Any]) -> str:
    """Return a sentence on the number of a start and on the start before it."""
    number = f"sealed test: run {start['run']} of this policy with release {start['release']}"
    if not start["earlier"]:
        return number
    last = start["earlier"][-1]
    interval = "" if last["replan_steps"] is None else f", replan interval {last['replan_steps']}"
    return (
        f"{number}; the previous run on {last['started'][:10]}: {last['suite']} suite, "
        f"referent {last['referent']}, {count_of(last['tasks'], 'task')}{interval}"
    )
