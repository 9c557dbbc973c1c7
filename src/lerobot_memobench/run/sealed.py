"""The sealed test: seeds that nobody chose anything by, run once per release; how often they were is counted.

Nothing is refused: a second look is allowed, and counted. A start is counted before its first scene is shown, when the
policy has been loaded. Its line goes to the user's ledger and, where its folder can be written to, to one beside the
checkpoint, with which it travels. An evaluation that goes on with its log, and the parts of one, are one start.

The card repeats the line: which policy, by the hash of the files that it loads, on which scenes, when, and the number.
That is a commitment, which a board of results can check against the card, and no lock: a user owns the machine.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NotRequired

from lerobot_memobench.envs.evaluation_file import SealedStart
from lerobot_memobench.io import Malformed, checked, count_of, file_hash, parsed, telling_of_the_disk
from lerobot_memobench.jobs.processes import taking_turns
from lerobot_memobench.policies.checkpoint import (
    ADAPTER_FILE,
    CONFIG_FILE,
    POSTPROCESSOR_FILE,
    PREPROCESSOR_FILE,
    WEIGHTS_FILE,
    local_folder,
    portable_path,
)
from lerobot_memobench.policies.lerobot_config import SEALED_LEDGER, tree_hash
from lerobot_memobench.protocol import SEALED
from lerobot_memobench.run.machine import PACKAGES, versions
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.tasks.task import MEMOBENCH

LOADED = (
    *(CONFIG_FILE, WEIGHTS_FILE, "adapter_config.json", ADAPTER_FILE),
    *(PREPROCESSOR_FILE, POSTPROCESSOR_FILE),
)
"""Files of a checkpoint that LeRobot opens by their name; they name the others."""
REPEATED = ("suite", "referent", "replan_steps")
"""Settings of the protocol that a ledger's line repeats; the world too, where it is not the package's own."""


class LedgerLine(SealedStart):
    """A start of a sealed evaluation.

    Attributes:
        policy: hash of what it loads; of a policy without a checkpoint, of its type and settings.
        release: version of this package.
        folder: where the evaluation was written.
        scenes: see `scenes_hash`. shard: the part of the evaluation, or None.
    """

    policy: str
    release: str
    folder: str
    scenes: NotRequired[str]
    shard: NotRequired[str | None]


def counted(plan: EvaluationPlan, card: dict[str, Any], tell: Callable[[str], None]) -> dict[str, Any]:
    """Return a card with the number of the start, where the first scene of a sealed evaluation is next.

    Args:
        tell: called with the number, and the date of the earlier start.

    Raises:
        MemobenchError: the ledger cannot be written.
    """
    if plan.split != SEALED:
        return card
    folder = (plan.output if plan.options.shard is None else plan.output.parent).absolute()
    ledger = user_ledger()
    with telling_of_the_disk(ledger.parent, "the ledger of sealed tests lies there, or in $XDG_STATE_HOME/memobench"):
        ledger.parent.mkdir(parents=True, exist_ok=True)
        with taking_turns(ledger.with_suffix(".lock")):
            found = _start(plan, card, str(folder))
    tell(in_words(found))
    episodes = card.pop("episodes")  # they stay the last of a card
    return {**card, "sealed": found, "episodes": episodes}


def _start(plan: EvaluationPlan, card: Mapping[str, Any], folder: str) -> dict[str, Any]:
    """Return the start that a run belongs to, with its number; a new one gets a line in the ledgers."""
    start = {
        "started": dt.datetime.now(dt.UTC).isoformat(timespec="microseconds"),
        **{name: card["protocol"].get(name) for name in REPEATED},
        **_world(card["protocol"]),
        "tasks": len(card["protocol"]["tasks"]),
        "episodes": card["protocol"]["episodes"],
    }
    whose = {"policy": _identity(card["policy"], plan.policy_path), "release": versions()[PACKAGES[0]]}
    line = {**start, **whose, "scenes": scenes_hash(card), "folder": folder, "shard": card["shard"]}
    places = [user_ledger(), *_beside_the_checkpoint(plan.policy_path)]
    lines = [line for place in places for line in _lines(place) if whose.items() <= line.items()]
    if _goes_on(card.get("sealed", {}), line, lines):
        return dict(card["sealed"])
    starts = {(line["started"], line["folder"]): line for line in lines}
    if (joined := _joined(line, lines)) is not None:
        line["started"] = joined
        starts = {key: found for key, found in starts.items() if key < (joined, folder)}
    for place in places:
        _append(place, line)
    earlier = [
        {key: found[key] for key in SealedStart.__annotations__ if key in found} for _, found in sorted(starts.items())
    ]
    kept = {key: line[key] for key in ("started", "policy", "scenes", "release")}
    return {**kept, "run": len(earlier) + 1, "earlier": earlier}


def _goes_on(card: Mapping[str, Any], line: Mapping[str, Any], lines: Iterable[Mapping[str, Any]]) -> bool:
    """Return whether a run is of the start on its card: same policy, same scenes, and the folder is not a copy."""
    alike = all(card.get(key) == line[key] for key in ("policy", "scenes", "release"))
    same = [other["folder"] for other in lines if other["started"] == card.get("started")]
    return alike and all(folder == line["folder"] for folder in same)


def _joined(line: Mapping[str, Any], lines: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the time of the start that a part belongs to, the last of its folder; None for a new one."""
    there = [other for other in lines if other["folder"] == line["folder"]]
    last: str | None = max((other["started"] for other in there), default=None)
    if line["shard"] is None or last is None:
        return None
    parts = [other for other in there if other["started"] == last]
    new = all(
        other.get("scenes") == line["scenes"] and other.get("shard") not in (None, line["shard"]) for other in parts
    )
    return last if new else None


def _world(protocol: Mapping[str, Any]) -> dict[str, str]:
    """Return the world of the scenes, nothing where it is the package's own: lines of before hold none."""
    return {} if protocol.get("world", MEMOBENCH) == MEMOBENCH else {"world": protocol["world"]}


def scenes_hash(card: Mapping[str, Any]) -> str:
    """Return one hash for the scenes of an evaluation, of what its card says: task files, referent, seed, episodes."""
    protocol = card["protocol"]
    told = [
        *(card["task_files"], card["policy"].get("seed"), protocol["episodes"]),
        *(protocol.get("referent"), protocol.get("evidence", False), *_world(protocol).values()),
    ]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _append(ledger: Path, line: Mapping[str, Any]) -> None:
    """Write a line to the disk, after the end of one that was cut off."""
    with ledger.open("ab+") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
        torn = file.read(1) not in (b"", b"\n")
        file.write(b"\n" * torn + json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


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


def _identity(policy: Mapping[str, Any], path: str | None) -> str:
    """Return the hash of what a policy loads, and of nothing else in its folder; without one, of type and settings."""
    folder = None if path is None else local_folder(path)
    if folder is None:
        told = {key: policy.get(key) for key in ("type", "settings", "detector_sha256")}
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    loaded = {name: folder / name for name in LOADED if (folder / name).is_file()}
    texts = [file.read_text(errors="replace") for file in loaded.values() if file.suffix == ".json"]
    files = [file for file in folder.iterdir() if file.is_file()]
    named = {file.name: file for file in files if any(f'"{file.name}"' in text for text in texts)}
    detector = {key: policy[key] for key in ("detector_sha256",) if policy.get(key)}
    return tree_hash({name: file_hash(file) for name, file in {**loaded, **named}.items()} | detector)


def _lines(ledger: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a ledger that can be read."""
    if not ledger.is_file():
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
    world = f"world {last['world']}, " if "world" in last else ""
    every = "" if last["replan_steps"] is None else f", replan interval {last['replan_steps']}"
    return (
        f"{first}; the last before it on {last['started'][:10]}: {last['suite']} suite, {world}"
        f"referent {last['referent']}, {count_of(last['tasks'], 'task')}{every}"
    )
