"""The file of an evaluation, ``evaluation.json``: protocol, policy, settings, starts and outcomes.

`lerobot eval` writes the whole of it (`run.card`). LeRobot's own commands and vla-evaluation-harness write the protocol
alone, when the first episode ends. Earlier versions wrote ``card.json`` and ``protocol.json`` instead; both are read.
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
from lerobot_memobench.envs.settings import GOALS, IDLE, NOT_COMPARED, EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import LARGEST, Count, Name, Number, Whole, is_there, read_json, write_file

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
}
"""Type of a setting -> type of its value in a file; parts that were joined may differ."""


_HINTS = typing.get_type_hints(EnvSettings)
_FIELDS: dict[str, Any] = {
    **{
        each.name: _CHECKED[next(iter(typing.get_args(_HINTS[each.name])), _HINTS[each.name])]
        for each in fields(EnvSettings)
        if each.name not in NOT_COMPARED
    },
    **{IDLE: Count | None, GOALS: Count, INPUTS: Name | None},
}
Settings: Any = TypedDict("Settings", _FIELDS, total=False)  # type: ignore[misc]
"""Settings of an evaluation that must agree for two of them to compare, as a file holds them."""


class PolicyIdentity(TypedDict, total=False):
    """Whose episodes they are, of evaluations without a card: see `acting.Acting`."""

    type: Name | None
    identity: Name
    sha256: str | None


class Protocol(Settings, total=False):
    """The protocol of an evaluation.

    Attributes:
        tasks: their names, sorted.
        episodes: asked for of each task.
        policy: whose episodes they are.
    """

    tasks: list[Name]
    episodes: Episodes
    policy: PolicyIdentity


class WholeProtocol(Settings):
    """The protocol of an evaluation that can be gone on with: it holds the extent that was asked for.

    Attributes:
        tasks: their names, sorted.
        episodes: asked for of each task.
    """

    tasks: list[Name]
    episodes: Episodes


# --- the other parts ---


class PolicySettings(TypedDict, total=False):
    """Whatever a policy can be set to; what reports and `memobench rerun` read of it."""

    n_action_steps: Count | None
    perception: str | None
    detector: str | None


class Policy(TypedDict, total=False):
    """What identifies a policy; {} where nothing is known of it.

    Attributes:
        type: as it is registered with LeRobot.
        seed: LeRobot's, of this evaluation.
        settings: its whole configuration.
        sha256: hash over the checkpoint's files.
        detector_sha256: hash of its detector's weights.
    """

    type: Name | None
    seed: Whole | None
    settings: PolicySettings
    sha256: str | None
    detector_sha256: str


class Checkpoint(TypedDict):
    """Where a policy's weights were, and the hash of each file.

    Attributes:
        path: folder, repository, or name of a policy of the package.
        revision: commit of a repository's copy.
        files: name -> SHA-256.
    """

    path: str
    revision: NotRequired[str | None]
    files: NotRequired[dict[str, str]]


BatchSize = Annotated[int, Ge(1), Le(LARGEST)]


class Start(TypedDict):
    """One start of the evaluation, on one machine.

    Attributes:
        command: as it was typed.
        batch_size: environments at once.
        versions: of Python and packages.
        git_commit: of a checkout of this package.
        machine: processor, cores, GPU, system.
        gl: what drew the pictures, of cards from when OpenGL could; {} where none were drawn.
        times: starts that were alike.
    """

    command: list[str]
    batch_size: BatchSize
    versions: dict[str, str]
    git_commit: str | None
    machine: dict[str, Any]
    gl: NotRequired[dict[str, Any]]
    times: NotRequired[Count]


class SealedStart(TypedDict):
    """A start of an evaluation on the sealed seeds.

    Attributes:
        started: when.
        suite: published or strict.
        world: of scenes that are not the package's own: libero.
        referent: fixed, random or drawn.
        replan_steps: actions executed per prediction; None for the policy's own number.
        tasks: how many.
        episodes: of each.
    """

    started: str
    suite: Name
    world: NotRequired[Name]
    referent: Name
    replan_steps: Count | None
    tasks: Count
    episodes: Count


class SealedRun(TypedDict):
    """How often a policy was started on the sealed seeds (`memobench test-sealed`).

    Attributes:
        started: when. policy: hash of what it loads. scenes: hash of task files, referent, seed and episodes.
        release: of this package.
        run: this start's number, from 1 on, among those of the policy with the release.
        earlier: the starts before it.
    """

    started: NotRequired[str]
    policy: NotRequired[str]
    scenes: NotRequired[str]
    release: str
    run: Count
    earlier: list[SealedStart]


class CardEpisode(Outcome):
    """What an episode came to.

    Attributes:
        task: name in the catalogue.
        episode: its number.
        memory_type: temporal, spatial, object or procedural.
        success: whether the goal held at the end.
        checkpoints: the memory checkpoints, in the task's order.
    """

    task: Name
    episode: Whole
    memory_type: NotRequired[str]
    success: NotRequired[bool]
    checkpoints: NotRequired[list[CheckpointRecord]]


class StartFacts(TypedDict, total=False):
    """What is taken from a start where the rest of it does not matter."""

    command: list[str]
    batch_size: BatchSize
    versions: dict[str, str]


class Card(TypedDict):
    """What reports take from a card: all but the protocol may be absent."""

    protocol: Protocol
    policy: NotRequired[Policy]
    checkpoint: NotRequired[Checkpoint | None]
    runs: NotRequired[list[StartFacts]]
    sealed: NotRequired[SealedRun]
    episodes: NotRequired[list[CardEpisode]]


class WholeCard(TypedDict):
    """A card from which an evaluation is gone on with, merged or repeated.

    Attributes:
        format: of the card: 1.
        written: when.
        protocol: tasks, episodes, and the settings that must agree for two evaluations to compare.
        policy: what must agree for an evaluation to be gone on with.
        checkpoint: of the policy; None where it has none.
        trained_on: LeRobot's settings of the dataset that it was trained on.
        task_files: task -> hash of its files.
        flags: of format 1: LeRobot's flags, complete but for folders.
        settings: of format 2: of environment, policy and evaluation; `memobench rerun` repeats them.
        shard: the part, or None.
        runs: each start, on each machine.
        sealed: of an evaluation on the sealed seeds: how often they were looked at.
        episodes: what was found.
    """

    format: Literal[1, 2]
    written: NotRequired[str]
    protocol: WholeProtocol
    policy: Policy
    checkpoint: Checkpoint | None
    trained_on: dict[str, Any] | None
    task_files: dict[str, str]
    flags: NotRequired[list[str]]
    settings: NotRequired[dict[str, Any]]
    shard: str | None
    runs: Annotated[list[Start], MinLen(1)]
    sealed: NotRequired[SealedRun]
    episodes: list[CardEpisode]


# --- reading ---


def read_evaluation(place: Path, *, whole: bool = False) -> dict[str, Any]:
    """Return the file of an evaluation, or the files of an earlier version joined.

    Args:
        place: folder of the evaluation, or a file.
        whole: nothing may be missing. Otherwise a folder without any of these files gives {}.

    Raises:
        MemobenchError: it is missing or has another form.
    """
    schema = WholeCard if whole else Card
    file = place / EVALUATION_FILE if place.is_dir() or not is_there(place) else place
    if not is_there(file) and (not whole or is_there(place / EARLIER_CARD)):
        return _earlier(place, schema)
    advice = "expected an evaluation's file as `lerobot eval` writes it"
    try:
        found: dict[str, Any] = read_json(file, schema, advice)
    except FileNotFoundError:
        raise MemobenchError(f"{file} cannot be read (it is missing); {advice}") from None
    return found


def _earlier(folder: Path, schema: Any) -> dict[str, Any]:
    """Return the files that earlier versions wrote, as one."""
    found: dict[str, Any] = {}
    for name, kind in ((EARLIER_CARD, schema), (EARLIER_PROTOCOL, Protocol)):
        if is_there(folder / name):
            held = read_json(folder / name, kind, "remove the file, or evaluate into another folder")
            held = held if name == EARLIER_CARD else {"protocol": held}
            found = {**found, **held, "protocol": {**found.get("protocol", {}), **held["protocol"]}}
    return found


# --- the protocol of a folder ---


def protocol_of(folder: Path) -> dict[str, Any]:
    """Return the protocol that an evaluation's file holds, {} without one."""
    found: dict[str, Any] = read_evaluation(folder).get("protocol", {})
    return found


def check_protocol(folder: Path, protocol: Mapping[str, Any]) -> bool:
    """Return whether the folder holds this protocol already; raise where it holds another one."""
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
    """Write the protocol of an evaluation without a card; leave an equal one as it is, refuse another."""
    if not check_protocol(folder, protocol):
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"format": FORMAT, "protocol": dict(protocol)}, indent=1) + "\n"
        write_file(folder / EVALUATION_FILE, text, durable=True)
