"""The sealed test: seeds that nobody chose anything by, run once per release; how often they were is counted.

Nothing is refused: a second look is allowed, and told. Each start of a sealed evaluation is a line in the user's ledger
and, where its folder can be written to, in one beside the checkpoint, with which it travels. An evaluation that goes on
and the parts of one are one start: ``sealed.json`` in its folder says which, and its card repeats it.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.acting import SEALED_LEDGER, SEALED_RUN
from lerobot_memobench.evaluation.records import SealedRun, SealedStart
from lerobot_memobench.io import Malformed, checked, count_of, is_there, parsed, read_json, write_file
from lerobot_memobench.jobs.processes import taking_turns
from lerobot_memobench.policies.checkpoint import local_folder, portable_path
from lerobot_memobench.protocol import SEALED
from lerobot_memobench.run.machine import PACKAGES, versions
from lerobot_memobench.run.plan import EvaluationPlan

RUN_FILE = SEALED_RUN
REPEATED = ("suite", "referent", "replan_steps")
"""Settings of the protocol that a ledger's line repeats."""


class LedgerLine(SealedStart):
    """A start of a sealed evaluation.

    Attributes:
        policy: hash of its checkpoint; of a policy without one, of its type and settings.
        release: version of this package.
        folder: where the evaluation was written.
    """

    policy: str
    release: str
    folder: str


def counted(plan: EvaluationPlan, card: dict[str, Any], tell: Callable[[str], None]) -> dict[str, Any]:
    """Return the card of a sealed evaluation with the number of its start; others' as they are.

    Args:
        tell: told the number, and when the earlier starts were.
    """
    if plan.split != SEALED:
        return card
    folder = (plan.output if plan.options.shard is None else plan.output.parent).absolute()
    ledger = user_ledger()
    ledger.parent.mkdir(parents=True, exist_ok=True)
    with taking_turns(ledger.with_suffix(".lock")):
        if not is_there(folder / RUN_FILE):
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / RUN_FILE, json.dumps(_new_start(plan, card, folder), indent=1) + "\n")
        told = read_json(folder / RUN_FILE, SealedRun, "remove the folder and begin anew")
    tell(in_words(told))
    episodes = card.pop("episodes")  # they stay the last of a card
    return {**card, "sealed": told, "episodes": episodes}


def _new_start(plan: EvaluationPlan, card: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Write a start into the ledgers; return its number and the starts before it."""
    policy, release = _identity(card["policy"]), versions()[PACKAGES[0]]
    places = [user_ledger(), *_beside_the_checkpoint(plan.policy_path)]
    lines = {line["started"] + line["folder"]: line for place in places for line in _lines(place)}
    earlier = [line for line in lines.values() if (line["policy"], line["release"]) == (policy, release)]
    start = {
        "started": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        **{name: card["protocol"].get(name) for name in REPEATED},
        "tasks": len(card["protocol"]["tasks"]),
        "episodes": card["protocol"]["episodes"],
    }
    line = json.dumps({**start, "policy": policy, "release": release, "folder": str(folder)}) + "\n"
    for place in places:
        with place.open("a") as file:
            file.write(line)
    before = [{key: line[key] for key in start} for line in sorted(earlier, key=lambda line: line["started"])]
    return {"release": release, "run": len(earlier) + 1, "earlier": before}


def user_ledger() -> Path:
    """Return the file of this user's sealed evaluations on this machine."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "memobench" / SEALED_LEDGER


def _beside_the_checkpoint(path: str | None) -> Iterator[Path]:
    """Yield the ledger of a checkpoint in a folder of the user's own: not of the package's, nor of the hub's cache."""
    folder = None if path is None else local_folder(path)
    if folder is None or portable_path(str(path)) != path or folder.parent.name == "snapshots":
        return
    if os.access(folder, os.W_OK):
        yield folder / SEALED_LEDGER


def _identity(policy: Mapping[str, Any]) -> str:
    """Return what tells a policy from another: the hash of its checkpoint, else of its type and settings."""
    told = {key: policy.get(key) for key in ("type", "settings", "detector_sha256")}
    found: str = policy.get("sha256") or hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    return found


def _lines(ledger: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a ledger that can be read."""
    if not is_there(ledger):
        return
    for line in ledger.read_bytes().splitlines():
        try:
            yield checked(parsed(line), LedgerLine)
        except Malformed:
            continue


def in_words(told: Mapping[str, Any]) -> str:
    """Return a sentence on which start of a policy's sealed evaluation this is."""
    first = f"sealed test: run {told['run']} of this policy with release {told['release']}"
    if not told["earlier"]:
        return first
    last = told["earlier"][-1]
    every = "" if last["replan_steps"] is None else f", replan interval {last['replan_steps']}"
    return (
        f"{first}; the last before it on {last['started'][:10]}: {last['suite']} suite, referent {last['referent']}, "
        f"{count_of(last['tasks'], 'task')}{every}"
    )
