"""What an evaluation was run under, read back from its folder, and in what two of them differ."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.protocol import EXTENT, OF_THE_POLICY, POLICY, SETTINGS, differences, read_protocol_file
from lerobot_memobench.errors import MemobenchError

__all__ = [
    "CARD_FILE",
    "EXTENT",
    "OF_THE_POLICY",
    "POLICY",
    "SETTINGS",
    "differences",
    "protocol_of_log",
    "read_card",
    "read_protocol",
]

CARD_FILE = "card.json"


def read_protocol(folder: str | Path) -> dict[str, Any]:
    """Return the protocol of the evaluation in ``folder``.

    Keys: ``tasks`` (names, sorted) and ``episodes`` (per task; the largest number where they differ) as asked for, or
    as found in the log where nobody wrote down what was asked for; ``seed_base``, ``referent``, ``prompt_video``,
    ``prompt_in``, ``horizon``, ``replan_steps``, ``render``, ``render_every`` as far as they are known; ``policy``,
    what is known of the policy ({} for plain ``lerobot-eval``).

    Raises:
        MemobenchError: there is no evaluation in the folder.
    """
    folder = Path(folder)
    card = read_card(folder / CARD_FILE) if (folder / CARD_FILE).is_file() else {}
    told: dict[str, Any] = {**card.get("protocol", {}), **read_protocol_file(folder)}
    if not set(EXTENT) <= set(told) or not set(SETTINGS) <= set(told):
        told = {**protocol_of_log(read_episodes(folder)), **told}
    return {**told, POLICY: card.get(POLICY, {})}


def protocol_of_log(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a log tells of its protocol; settings in which its episodes differ are lists."""
    found: dict[str, Any] = {
        "tasks": sorted({record["task"] for record in records}),
        "episodes": max((record["episode"] + 1 for record in records), default=0),
    }
    if all(record.get("seed") is not None for record in records):
        _note(found, "seed_base", [record["seed"] - record["episode"] for record in records])
    for key in ("referent", "replan_steps"):
        _note(found, key, [record[key] for record in records if key in record])
    return found


def _note(found: dict[str, Any], key: str, values: list[Any]) -> None:
    distinct = list(dict.fromkeys(values))
    if distinct:
        found[key] = distinct[0] if len(distinct) == 1 else sorted(distinct, key=str)


def read_card(path: Path) -> dict[str, Any]:
    """Return a result card (see ``evaluation.card``).

    Raises:
        MemobenchError: it is missing or none.
    """
    try:
        found = json.loads(path.read_text())
    except OSError as error:
        raise MemobenchError(f"the card {path} cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise MemobenchError(f"the card {path} is not JSON ({error})") from None
    if not isinstance(found, dict) or not isinstance(found.get("protocol"), dict):
        raise MemobenchError(f"{path} is no result card; expected a {CARD_FILE} that `lerobot eval` wrote")
    return found
