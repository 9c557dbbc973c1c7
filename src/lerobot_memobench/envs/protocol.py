"""The protocol that an episode log was made under: one small file beside it, written with the first episode.

The log's lines tell what happened; what they leave out and what decides whether two evaluations may be compared (the
horizon, the rendering) is told here once, also by plain ``lerobot-eval`` and from async workers.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Name, Whole, cut, read_json, write_file
from lerobot_memobench.tasks.task import PUBLISHED

PROTOCOL_FILE = "protocol.json"


SETTINGS = (
    "suite",
    "seed_base",
    "obs_type",
    "referent",
    "prompt_video",
    "prompt_in",
    "horizon",
    "replan_steps",
    "render",
    "render_every",
    "oracle_memory",
)
"""What must agree for two evaluations to be one, or to be compared."""

SAW = "saw"
"""What the policy saw, in the words of `obs_types.what_is_seen`; absent where nobody wrote it down."""

OF_THE_POLICY = ("prompt_in", SAW)
"""What follows from what a policy can take in: evaluations of two policies may differ in it, which is told, the parts
of one may not."""

EXTENT = ("tasks", "episodes")
"""How much was run: it may differ, the episodes in common still compare."""

POLICY = "policy"

MOST_EPISODES = 100_000
"""Of one task. Every episode that was asked for and is missing is counted, so a file must not ask for any number."""


Episodes = Annotated[int, Ge(0), Le(MOST_EPISODES)]


class Settings(TypedDict, total=False):
    """Under what it was run; a setting in which joined episodes differ is a list of its values."""

    suite: Name
    seed_base: Whole | list[Whole]
    obs_type: Name | None
    referent: Name | list[Name]
    prompt_video: bool | None
    horizon: Count | None
    replan_steps: Count | list[Count | None] | None
    render: Name | None
    render_every: Count | None
    oracle_memory: bool | None
    saw: Name | None


class PolicyIdentity(TypedDict, total=False):
    """Whose episodes they are, of evaluations without a card: see `acting.Acting`."""

    type: Name | None
    identity: Name
    sha256: str | None


class Protocol(Settings, total=False):
    """What ``protocol.json`` and a card may say."""

    tasks: list[Name]
    episodes: Episodes
    policy: PolicyIdentity


class WholeProtocol(Settings):
    """What a card must say from which an evaluation is gone on with: how much was asked for."""

    tasks: list[Name]
    episodes: Episodes


def differences(
    a: Mapping[str, Any],
    b: Mapping[str, Any],
    *,
    extent: bool = False,
    policy: bool = False,
    ignore: Collection[str] = (),
) -> list[str]:
    """Return the settings in which two protocols differ, each as ``horizon: 1200 and 600``.

    A setting that one of them does not tell (logs of other tools) is not a difference. Where the suite is not told it
    is the published one: there was no other.

    Args:
        extent: whether tasks and number of episodes are compared as well.
        policy: whether what is known of the policy is.
        ignore: settings that may differ.
    """
    left_out = {*ignore, POLICY, *(() if extent else EXTENT)}
    told = {"suite": PUBLISHED, **a}
    found = _differing({k: v for k, v in told.items() if k not in left_out}, {"suite": PUBLISHED, **b})
    if policy:
        found += _differing(a.get(POLICY) or {}, b.get(POLICY) or {}, f"{POLICY}.")
    return found


def _differing(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in a.items():
        if key not in b or b[key] == value:
            continue
        other = b[key]
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            found += _differing(value, other, f"{prefix}{key}.")
        else:
            found.append(f"{cut(f'{prefix}{key}')}: {_text(value)} and {_text(other)}")
    return found


def _text(value: Any) -> str:
    if not isinstance(value, list):
        return cut(str(value))
    shown = ", ".join(cut(str(each)) for each in value[:3])
    return f"{shown}, … ({len(value)})" if len(value) > 3 else shown


def read_protocol_file(directory: Path) -> dict[str, Any]:
    """Return the settings written beside a log, {} where there are none.

    Raises:
        MemobenchError: the file is none of this package's.
    """
    try:
        found: dict[str, Any] = read_json(
            directory / PROTOCOL_FILE, Protocol, "remove the file, or evaluate into another folder"
        )
    except FileNotFoundError:
        return {}
    return found


def check_protocol(directory: Path, settings: Mapping[str, Any]) -> bool:
    """Return whether the folder holds this protocol already; raise where it holds another one."""
    earlier = read_protocol_file(directory)
    found = differences(earlier, settings, policy=True) if earlier else []
    if found:
        what = "policy" if all(each.startswith(f"{POLICY}.") for each in found) else "protocol"
        raise MemobenchError(
            f"{directory} holds episodes of another {what} ({'; '.join(found)}, the first value being that of the "
            "episodes there); evaluate into another folder"
        )
    return bool(earlier)


def write_protocol(directory: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings beside a log, whole or not at all; leave equal ones as they are, refuse others."""
    if check_protocol(directory, settings):
        return
    write_file(directory / PROTOCOL_FILE, json.dumps(dict(settings), indent=1) + "\n", durable=True)
