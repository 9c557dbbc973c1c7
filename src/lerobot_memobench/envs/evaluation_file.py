"""The file of an evaluation, ``evaluation.json``: all facts that its episodes share.

`lerobot eval` writes all of it (`rollouts.card`). LeRobot's own commands and vla-evaluation-harness write protocol and
policy only, when the first episode ends. Outcomes are in the log alone (`episode_log`).
"""

from __future__ import annotations

import json
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from annotated_types import Ge, Le, MinLen

from lerobot_memobench.envs.settings import GOALS, HOLD, NOT_COMPARED, SCENE_HASHES, EnvSettings
from lerobot_memobench.errors import MemobenchError, cut
from lerobot_memobench.io import write_file
from lerobot_memobench.untrusted import LARGEST, Count, Name, Number, Whole, is_there, read_json

EVALUATION_FILE = "evaluation.json"
FORMAT = 3
INPUTS, POLICY = "inputs", "policy"
"""Key of the policy's inputs in the protocol (`observations.policy_inputs`), and of the policy."""
EXTENT = ("tasks", "episodes")
"""Extent of an evaluation. It may differ between compared evaluations, which use their common episodes."""
OF_ONE_EVALUATION = ("prompt_in", "window_steps", "delay_steps", "camera_name_mapping", "robot_state", INPUTS, "salt")
"""Settings that follow from the policy, and the salt, which the start of a sealed evaluation draws. They may differ
between compared evaluations, not between parts of one."""
MOST_EPISODES = 100_000  # largest number of episodes of one task; bounds the memory that a damaged file can request


@dataclass(frozen=True)
class Acting:
    """The policy of an evaluation, as its file names it. It is unknown in gymnasium and in LeRobot's trainings."""

    policy: Mapping[str, Any] = field(default_factory=dict)  # `Policy`
    inputs: str | None = None  # in words
    seeds: range | None = None  # of the requested episodes; whole batches are run, and others are not logged

    def counts(self, seed: int) -> bool:
        """Return whether the episode of a seed was requested."""
        return self.seeds is None or seed in self.seeds


UNKNOWN_POLICY = Acting()

# --- its schema ---

_CHECKED: dict[Any, Any] = {int: Count, float: Number, str: Name, bool: bool, dict[str, str]: dict[Name, Name]}
"""Type of a setting -> type of its value in a file."""


def _checked(hint: Any) -> Any:
    """Return the type of a value in a file; null is allowed only where the setting may be None."""
    kinds = typing.get_args(hint)
    return _CHECKED[kinds[0]] | None if type(None) in kinds else _CHECKED[hint]


_HINTS = typing.get_type_hints(EnvSettings)
_FIELDS: dict[str, Any] = {
    **{
        setting.name: _checked(_HINTS[setting.name])
        for setting in fields(EnvSettings)
        if setting.name not in NOT_COMPARED
    },
    **{HOLD: Count, GOALS: Count, SCENE_HASHES: Count, INPUTS: Name},
}
Settings: Any = TypedDict("Settings", _FIELDS, total=False)  # type: ignore[misc]
"""Settings that must agree between two evaluations to be compared."""


class Protocol(Settings, total=False):
    """The protocol of an evaluation; one of `lerobot eval` contains ``tasks`` and ``episodes``."""

    tasks: list[Name]  # names, sorted
    episodes: Annotated[int, Ge(0), Le(MOST_EPISODES)]  # number requested per task


class PolicySettings(TypedDict, total=False):
    """The fields of a policy's configuration that reports and `memobench rerun` read."""

    n_action_steps: Count | None
    perception: str | None
    detector: str | None


class Policy(TypedDict, total=False):
    """Identity of a policy; {} if unknown."""

    type: Name | None  # type registered with LeRobot
    identity: Name  # the type, and a hash over the checkpoint and the settings that differ from it
    seed: Whole | None  # LeRobot's seed in this evaluation
    settings: PolicySettings  # complete configuration
    sha256: str | None  # hash over the checkpoint's files
    detector_sha256: str  # hash of the detector's weights


class ModelFiles(TypedDict):
    """Location of a policy's weights, and the hash of each file."""

    path: str  # folder, repository, or name of a policy of the package
    revision: NotRequired[str | None]  # commit of a repository
    files: NotRequired[dict[str, str]]  # name -> SHA-256


class Start(TypedDict):
    """One start of the evaluation, on one machine."""

    command: list[str]  # words of the command line
    batch_size: Annotated[int, Ge(1), Le(LARGEST)]  # number of parallel environments
    versions: dict[str, str]  # versions of Python and packages
    git_commit: str | None  # commit of this package, in a checkout
    machine: dict[str, Any]  # processor, cores, GPU, operating system
    times: NotRequired[Count]  # number of equal starts


class CardSettings(TypedDict, total=False):
    """Settings of an evaluation that its protocol does not hold, see `rollouts.plan.EvaluationSettings`."""

    __pydantic_config__ = {"extra": "forbid"}  # type: ignore[misc]

    env: dict[str, Any]  # other fields of `MemobenchEnvConfig`, such as tasks and videos
    # ``path`` or ``type``, and the given settings of the policy's configuration
    policy: dict[str, str | bool | float | list[Any] | None]
    batch_size: Annotated[int, Ge(0), Le(512)] | None  # environments at once
    use_async_envs: bool | None  # whether each has a process of its own
    rename_map: dict[str, str]  # names of the environment's observations -> names of the policy's


class Card(TypedDict):
    """The content of the file. To resume, merge or rerun an evaluation, all fields are required."""

    format: Literal[3]  # version of the format
    protocol: Protocol  # tasks, episodes, and the settings that must agree between two evaluations to be compared
    policy: Policy  # facts that must agree to resume the evaluation
    written: NotRequired[str]  # time
    checkpoint: NotRequired[ModelFiles | None]  # of the policy; None for a policy without one
    trained_on: NotRequired[dict[str, Any] | None]  # LeRobot's settings of the training dataset
    task_files: NotRequired[dict[str, str]]  # task -> hash of its files
    settings: NotRequired[CardSettings]  # what `memobench rerun` repeats besides the protocol
    shard: NotRequired[str | None]  # part of a larger evaluation, or None
    runs: NotRequired[Annotated[list[Start], MinLen(1)]]  # each start, on each machine


# --- reading and writing ---

ADVICE = "expected an evaluation's file as `lerobot eval` writes it"


def read_evaluation(place: Path, *, whole: bool = False) -> dict[str, Any]:
    """Return the content of an evaluation's file; ``place``: its folder, or the file.

    With ``whole``, require everything that resuming and repeating need.
    """
    file = _file_of(place)
    try:
        card: dict[str, Any] = read_json(file, Card, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{file} cannot be read (it is missing); {ADVICE}") from None
    if whole:
        require_whole(place, card)
    return card


def require_whole(place: Path, card: Mapping[str, Any]) -> None:
    """Refuse a card, read from ``place``, that lacks something that resuming and repeating need."""
    missing = [name for name in Card.__annotations__ if name not in card]
    missing += [f"{name} in protocol" for name in EXTENT if name not in card["protocol"]]
    if missing:
        raise MemobenchError(f"{_file_of(place)}: found no {', '.join(missing)}; {ADVICE}")


def _file_of(place: Path) -> Path:
    return place / EVALUATION_FILE if place.is_dir() or not is_there(place) else place


def has_evaluation(folder: Path) -> bool:
    """Return whether a folder contains an evaluation's file."""
    return is_there(folder / EVALUATION_FILE)


def facts_of(settings: EnvSettings, acting: Acting) -> dict[str, Any]:
    """Return the content of the file for environments of these settings, without facts of `lerobot eval`."""
    inputs = {} if acting.inputs is None else {INPUTS: acting.inputs}
    return {"format": FORMAT, "protocol": {**settings.protocol_block, **inputs}, POLICY: dict(acting.policy)}


def check_facts(folder: Path, facts: Mapping[str, Any]) -> None:
    """Refuse a folder with an evaluation of another protocol or policy."""
    if not has_evaluation(folder):
        return
    if unequal := differences_of_parts(read_evaluation(folder), facts):
        what = "policy" if all(difference.startswith(f"{POLICY}.") for difference in unequal) else "protocol"
        raise MemobenchError(
            f"{folder} holds episodes of another {what} ({'; '.join(unequal)}, the first value being that of the "
            "episodes there); evaluate into another folder"
        )


def write_facts(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write the file of an evaluation; keep an existing one. Errors as of `check_facts`."""
    check_facts(folder, facts)
    if not has_evaluation(folder):
        write_evaluation(folder, facts)


def write_evaluation(folder: Path, card: Mapping[str, Any]) -> None:
    """Write the file of an evaluation atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / EVALUATION_FILE, json.dumps(card, indent=1) + "\n", durable=True)


# --- agreement of two evaluations ---


def differences(
    a: Mapping[str, Any], b: Mapping[str, Any], *, extent: bool = False, ignore: Collection[str] = ()
) -> list[str]:
    """Return the settings in which two protocols differ, each as ``horizon: 1200 and 600``.

    A setting that one protocol omits is no difference. Neither is the version of scene hashes (`other_hashes`), nor,
    without ``extent``, tasks and number of episodes.
    """
    left_out = {*ignore, POLICY, SCENE_HASHES, *(() if extent else EXTENT)}
    return _differing({name: value for name, value in a.items() if name not in left_out}, b)


def differences_of_parts(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Return the settings, and facts of the policy, in which the files of two parts of one evaluation differ."""
    settings = {name: value for name, value in a["protocol"].items() if name not in EXTENT}
    return _differing(settings, b["protocol"]) + _differing(a[POLICY], b[POLICY], f"{POLICY}.")


def _differing(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    unequal = []
    for key, value in a.items():
        if key not in b or b[key] == value:
            continue
        other = b[key]
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            unequal += _differing(value, other, f"{prefix}{key}.")
        else:
            unequal.append(f"{cut(f'{prefix}{key}')}: {_text(value)} and {_text(other)}")
    return unequal


def _text(value: Any) -> str:
    if not isinstance(value, list):
        return cut(str(value))
    shown = ", ".join(cut(str(item)) for item in value[:3])
    return f"{shown}, … ({len(value)})" if len(value) > 3 else shown
