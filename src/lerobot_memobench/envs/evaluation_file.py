"""The file of an evaluation, ``evaluation.json``: protocol, policy, settings, starts and outcomes.

`lerobot eval` writes all of it (`run.card`). LeRobot's own commands and vla-evaluation-harness write the protocol only,
when the first episode ends. Earlier versions wrote ``card.json`` and ``protocol.json``; both are still read.
"""

from __future__ import annotations

import json
import typing
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from annotated_types import Ge, Le, MinLen

from lerobot_memobench.envs.episode_log import (
    INPUTS,
    POLICY,
    CheckpointRecord,
    Episodes,
    Outcome,
    differences,
)
from lerobot_memobench.envs.settings import GOALS, HOLD, NOT_COMPARED, SCENE_HASHES, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import LARGEST, Count, Name, Number, Whole, is_there, read_json, write_file
from lerobot_memobench.sim.scene_hash import WORLD

EVALUATION_FILE = "evaluation.json"
EARLIER_CARD, EARLIER_PROTOCOL = "card.json", "protocol.json"
FORMAT = 2
"""1: the card of earlier versions, with LeRobot's flags instead of settings."""

# --- the protocol ---

_CHECKED: dict[Any, Any] = {
    int: Count | None | list[Count | None],
    float: Number | None,
    str: Name | None | list[Name | None],
    bool: bool | None,
    dict[str, str]: dict[Name, Name] | None | list[dict[Name, Name] | None],
}
"""Type of a setting -> type of its value in a file; joined parts may differ and then give a list."""


_HINTS = typing.get_type_hints(EnvSettings)
_FIELDS: dict[str, Any] = {
    **{
        each.name: _CHECKED[next(iter(typing.get_args(_HINTS[each.name])), _HINTS[each.name])]
        for each in fields(EnvSettings)
        if each.name not in NOT_COMPARED
    },
    **{WORLD: Name | list[Name], HOLD: Count | None, GOALS: Count, SCENE_HASHES: Count, INPUTS: Name | None},
}
Settings: Any = TypedDict("Settings", _FIELDS, total=False)  # type: ignore[misc]
"""Settings that must agree between two evaluations to be compared, as a file holds them."""


class PolicyIdentity(TypedDict, total=False):
    """Identity of the policy in a protocol without a card, see `episode_log.Acting`."""

    type: Name | None
    identity: Name
    sha256: str | None


class Protocol(Settings, total=False):
    """The protocol of an evaluation; a resumable one contains ``tasks`` and ``episodes``.

    Attributes:
        tasks: names, sorted.
        episodes: number requested per task.
        policy: identity of the policy.
    """

    tasks: list[Name]
    episodes: Episodes
    policy: PolicyIdentity


# --- the other parts ---


class PolicySettings(TypedDict, total=False):
    """The fields of a policy's configuration that reports and `memobench rerun` read."""

    n_action_steps: Count | None
    perception: str | None
    detector: str | None


class Policy(TypedDict, total=False):
    """Identity of a policy; {} if unknown.

    Attributes:
        type: type registered with LeRobot.
        seed: LeRobot's seed in this evaluation.
        settings: complete configuration.
        sha256: hash over the checkpoint's files.
        detector_sha256: hash of the detector's weights.
    """

    type: Name | None
    seed: Whole | None
    settings: PolicySettings
    sha256: str | None
    detector_sha256: str


class Checkpoint(TypedDict):
    """Location of a policy's weights, and the hash of each file.

    Attributes:
        path: folder, repository, or name of a policy of the package.
        revision: commit of a repository.
        files: name -> SHA-256.
    """

    path: str
    revision: NotRequired[str | None]
    files: NotRequired[dict[str, str]]


class Start(TypedDict, total=False):
    """One start of the evaluation, on one machine.

    Attributes:
        command: words of the command line.
        batch_size: number of parallel environments.
        versions: versions of Python and packages.
        git_commit: commit of this package, in a checkout.
        machine: processor, cores, GPU, operating system.
        gl: OpenGL renderer; earlier versions only.
        times: number of equal starts.
    """

    command: list[str]
    batch_size: Annotated[int, Ge(1), Le(LARGEST)]
    versions: dict[str, str]
    git_commit: str | None
    machine: dict[str, Any]
    gl: dict[str, Any]
    times: Count


class CardEpisode(Outcome):
    """Outcome of an episode.

    Attributes:
        task: name in the catalogue.
        episode: number of the episode, from 0.
        memory_type: temporal, spatial, object or procedural.
        success: whether the goal held at the end.
        checkpoints: memory checkpoints in the task's order.
    """

    task: Name
    episode: Whole
    memory_type: NotRequired[str]
    success: NotRequired[bool]
    checkpoints: NotRequired[list[CheckpointRecord]]


class Card(TypedDict):
    """The content of the file. To resume, merge or rerun an evaluation, all fields of `WHOLE` are required.

    Attributes:
        format: version of the format.
        written: time.
        protocol: tasks, episodes, and the settings that must agree between two evaluations to be compared.
        policy: facts that must agree to resume the evaluation.
        checkpoint: of the policy; None for a policy without one.
        trained_on: LeRobot's settings of the training dataset.
        task_files: task -> hash of its files.
        flags: format 1: LeRobot's flags, without folders.
        settings: format 2: settings of environment, policy and evaluation; `memobench rerun` repeats them.
        shard: part of a larger evaluation, or None.
        runs: each start, on each machine.
        episodes: outcomes.
    """

    format: NotRequired[Literal[1, 2]]
    written: NotRequired[str]
    protocol: Protocol
    policy: NotRequired[Policy]
    checkpoint: NotRequired[Checkpoint | None]
    trained_on: NotRequired[dict[str, Any] | None]
    task_files: NotRequired[dict[str, str]]
    flags: NotRequired[list[str]]
    settings: NotRequired[dict[str, Any]]
    shard: NotRequired[str | None]
    runs: NotRequired[Annotated[list[Start], MinLen(1)]]
    episodes: NotRequired[list[CardEpisode]]


WHOLE = ("format", "policy", "checkpoint", "trained_on", "task_files", "shard", "runs", "episodes")
WHOLE_PROTOCOL = ("tasks", "episodes")
WHOLE_START = ("command", "batch_size", "versions", "git_commit", "machine")

# --- reading ---


def read_evaluation(place: Path, *, whole: bool = False) -> dict[str, Any]:
    """Return the content of an evaluation's file, or of the files of an earlier version.

    Args:
        place: folder of the evaluation, or a file.
        whole: require everything that resuming and repeating need. Otherwise a folder without a file gives {}.

    Raises:
        MemobenchError: the file is missing, incomplete or malformed.
    """
    file = place / EVALUATION_FILE if place.is_dir() or not is_there(place) else place
    advice = "expected an evaluation's file as `lerobot eval` writes it"
    found: dict[str, Any]
    if not is_there(file) and (not whole or is_there(place / EARLIER_CARD)):
        found, file = _earlier(place), place / EARLIER_CARD
    else:
        try:
            found = read_json(file, Card, advice)
        except FileNotFoundError:
            raise MemobenchError(f"{file} cannot be read (it is missing); {advice}") from None
    if whole and (missing := _missing(found)):
        raise MemobenchError(f"{file}: found no {', '.join(missing)}; {advice}")
    return found


def _missing(card: Mapping[str, Any]) -> list[str]:
    """Return the absent fields that resuming and repeating need."""
    missing = [key for key in WHOLE if key not in card]
    missing += [f"{key} in protocol" for key in WHOLE_PROTOCOL if key not in card["protocol"]]
    starts = card.get("runs", [])
    return missing + [
        f"{key} in runs[{k}]" for k, start in enumerate(starts) for key in WHOLE_START if key not in start
    ]


def _earlier(folder: Path) -> dict[str, Any]:
    """Return the files of earlier versions, merged into one."""
    found: dict[str, Any] = {}
    for name, kind in ((EARLIER_CARD, Card), (EARLIER_PROTOCOL, Protocol)):
        if is_there(folder / name):
            held = read_json(folder / name, kind, "remove the file, or evaluate into another folder")
            held = held if name == EARLIER_CARD else {"protocol": held}
            found = {**found, **held, "protocol": {**found.get("protocol", {}), **held["protocol"]}}
    return found


# --- the protocol of a folder ---


def protocol_of(folder: Path) -> dict[str, Any]:
    """Return the protocol of an evaluation's file, {} without a file."""
    found: dict[str, Any] = read_evaluation(folder).get("protocol", {})
    return found


def check_protocol(folder: Path, protocol: Mapping[str, Any]) -> bool:
    """Return whether the folder already contains this protocol; raise if it contains another one."""
    earlier = protocol_of(folder)
    found = differences(earlier, protocol, policy=True) if earlier else []
    if found:
        what = "policy" if all(each.startswith(f"{POLICY}.") for each in found) else "protocol"
        raise MemobenchError(
            f"{folder} holds episodes of another {what} ({'; '.join(found)}, the first value being that of the "
            "episodes there); evaluate into another folder"
        )
    return bool(earlier)


def write_protocol(folder: Path, protocol: Mapping[str, Any]) -> None:
    """Write the protocol of an evaluation without a card; keep an equal file, and raise for another protocol."""
    if not check_protocol(folder, protocol):
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"format": FORMAT, "protocol": dict(protocol)}, indent=1) + "\n"
        write_file(folder / EVALUATION_FILE, text, durable=True)
