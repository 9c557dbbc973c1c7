"""What an evaluation was run under, read back from its folder, and in what two of them differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import (
    EXTENT,
    MOST_EPISODES,
    OF_THE_POLICY,
    POLICY,
    SETTINGS,
    differences,
    read_episodes,
    read_protocol_file,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.card_schema import Card, WholeCard
from lerobot_memobench.io import read_json
from lerobot_memobench.tasks.task import PUBLISHED

__all__ = [
    "CARD_FILE",
    "EXTENT",
    "OF_THE_POLICY",
    "POLICY",
    "SETTINGS",
    "differences",
    "one_suite",
    "protocol_of_log",
    "read_card",
    "read_protocol",
]

CARD_FILE = "card.json"


def read_protocol(folder: str | Path) -> dict[str, Any]:
    """Return the protocol of the evaluation in ``folder``.

    Keys: ``tasks`` (names, sorted) and ``episodes`` (per task; the largest number where they differ) as asked for, or
    as found in the log where nobody wrote down what was asked for; ``suite``; ``seed_base``, ``referent``,
    ``demonstration_prompt``, ``prompt_in``, ``horizon``, ``replan_steps``, ``render``, ``render_every`` as
    far as known; ``inputs``, of the policy; ``policy``, what is known of the policy ({} where nobody wrote it down).

    Raises:
        MemobenchError: there is no evaluation in the folder.
    """
    folder = Path(folder)
    card = read_card(folder / CARD_FILE) if (folder / CARD_FILE).is_file() else {}
    told: dict[str, Any] = {**card.get("protocol", {}), **read_protocol_file(folder)}
    if not {*EXTENT, *SETTINGS} - {"suite"} <= set(told):  # without a suite it is of the time when there was one
        told = {**protocol_of_log(read_episodes(folder)), **told}
    return {**told, POLICY: card.get(POLICY) or told.get(POLICY) or {}}


def protocol_of_log(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a log tells of its protocol; settings in which its episodes differ are lists."""
    numbers = (record["episode"] + 1 for record in records)
    found: dict[str, Any] = {
        "tasks": sorted({record["task"] for record in records}),
        "episodes": max((number for number in numbers if number <= MOST_EPISODES), default=0),  # others have no number
    }
    if all(record.get("seed") is not None for record in records):
        _note(found, "seed_base", [record["seed"] - record["episode"] for record in records])
    if (suite := one_suite(records)) != PUBLISHED:
        found["suite"] = suite
    for key in ("referent", "replan_steps"):
        _note(found, key, [record[key] for record in records if key in record])
    return found


def one_suite(records: Iterable[Mapping[str, Any]]) -> str:
    """Return the suite of an evaluation's rollouts.

    Raises:
        MemobenchError: they are of several.
    """
    there = {record.get("suite", PUBLISHED) for record in records} or {PUBLISHED}
    if len(there) > 1:
        raise MemobenchError(
            f"the rollouts are of the suites {' and '.join(sorted(there))}; report each suite by itself"
        )
    (suite,) = there
    return str(suite)


def _note(found: dict[str, Any], key: str, values: list[Any]) -> None:
    distinct = list(dict.fromkeys(values))
    if distinct:
        found[key] = distinct[0] if len(distinct) == 1 else sorted(distinct, key=str)


def read_card(path: Path, *, whole: bool = False) -> dict[str, Any]:
    """Return a result card (see ``engine.card``).

    Args:
        whole: nothing of it may be left out, as reports allow.

    Raises:
        MemobenchError: it is missing or none.
    """
    try:
        found: dict[str, Any] = read_json(
            path, WholeCard if whole else Card, "it is no result card as `lerobot eval` writes it"
        )
    except FileNotFoundError:
        raise MemobenchError(
            f"the card {path} cannot be read (it is missing); name a {CARD_FILE} that `lerobot eval` wrote"
        ) from None
    return found
