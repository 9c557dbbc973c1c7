"""Put a card to the test: run the evaluation that it describes once more and compare every episode."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, read_card
from lerobot_memobench.policies.checkpoint import local_folder
from lerobot_memobench.run.card_flags import allowed_flags
from lerobot_memobench.run.flags import flag_value
from lerobot_memobench.run.machine import gl_facts, versions
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.run.planning import plan_line
from lerobot_memobench.run.policy_identity import checkpoint_files, eyes_hash, tree_hash


def repeatable_card(path: Path, server: str | None = None) -> dict[str, Any]:
    """Return the card of an evaluation that has ended, from its file or its folder, with flags that may be repeated.

    Args:
        server: where the policy's server is here (``host:port``, or several with commas); as on the card when None.

    Raises:
        MemobenchError: there is none, it holds nothing to compare with, or what no card may ask for (`card_flags`).
    """
    path = path / CARD_FILE if path.is_dir() else path
    card = read_card(path, whole=True)
    if not card["episodes"]:
        raise MemobenchError(f"{path} holds no episodes to compare with; expected that of an evaluation that has ended")
    return {**card, "flags": allowed_flags(card.get("flags"), server)}


def plan_of_card(card: Mapping[str, Any], out: Path | None = None) -> EvaluationPlan:
    """Return the plan of a card's evaluation, to be run in ``out``, or in a folder of the present time."""
    out = out or Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_rerun"
    shard = [] if card["shard"] is None else [f"shard={card['shard']}"]
    return plan_line([*card["flags"], f"output_dir={out}", *shard])


def check_policy(card: Mapping[str, Any]) -> None:
    """Refuse to repeat an evaluation with another policy.

    Raises:
        MemobenchError: the checkpoint is another one, or nobody knows which it was.
    """
    given = flag_value(card["flags"], "policy.path")
    if given is None:
        return
    folder = local_folder(given)
    assert folder is not None  # `repeatable_card` has found it
    found, told = tree_hash(checkpoint_files(folder)), card["policy"].get("sha256")
    if found != told:
        raise MemobenchError(
            f"the checkpoint {given} is not the one that was evaluated (sha256 {found[:12]}, on the card "
            f"{str(told)[:12]}); its results would be another policy's"
        )
    settings, eyes = card["policy"].get("settings", {}), card["policy"].get("eyes_sha256")
    here = eyes_hash(settings)
    if here != eyes:
        raise MemobenchError(
            f"the eyes {settings.get('eyes')} are not those that were looked through (sha256 {str(here)[:12]}, on the "
            f"card {str(eyes)[:12]}); the results would be another policy's"
        )


def differences_here(card: Mapping[str, Any]) -> list[str]:
    """Return in what this machine differs from those that a card's runs were made on."""
    here = {**versions(), **(gl_facts() if any(run["gl"] for run in card["runs"]) else {})}
    notes = []
    for run in card["runs"]:
        told = {**run["versions"], **run["gl"]}
        changed = [
            f"{name} {version} (here {here[name]})"
            for name, version in told.items()
            if here.get(name, version) != version
        ]
        if changed:
            notes.append(f"the card's run used {', '.join(changed)}; results may depend on it")
    return list(dict.fromkeys(notes))
