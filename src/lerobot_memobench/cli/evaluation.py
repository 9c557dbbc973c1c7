"""An evaluation as the command line asks for it: flags, folders, the grid of episodes, the identity on its card."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_memobench.cli.arguments import Translation, without_flag
from lerobot_memobench.cli.orders import Orders
from lerobot_memobench.cli.plan import Grid, Place
from lerobot_memobench.engine.card import (
    checkpoint_files,
    new_card,
    policy_facts,
    run_facts,
    training_facts,
    tree_hash,
)
from lerobot_memobench.envs.episode_log import has_log, read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import ADAPTER_FILE, WEIGHTS_FILE, checkpoint_folder, looks_local

FOLDERS = ("output_dir", "env.log_dir")
PATHS = ("policy.path", "env.task_dir", "config_path")


@dataclass(frozen=True)
class Evaluation:
    """What is asked for.

    Attributes:
        translation: LeRobot's flags, complete.
        orders: how it is run.
        policy, environment: their configurations; None when a configuration file (``config_path``) holds them.
        grid: the episodes it consists of; None when the environment is.
    """

    translation: Translation
    orders: Orders
    policy: Any
    environment: Any
    grid: Grid | None

    @property
    def output(self) -> Path:
        """Folder of LeRobot's own files."""
        return Path(self.translation.get("output_dir") or "")

    @property
    def log(self) -> Path:
        """Folder of the episode log, the report and the card."""
        return Path(self.translation.get("env.log_dir") or "")

    @property
    def seed(self) -> int | None:
        """Seed of the run; that of the first episode of each task too."""
        return number(self.translation.get("seed"))

    @property
    def batch(self) -> int:
        """Environments at once."""
        return number(self.translation.get("eval.batch_size")) or 1

    @property
    def flags(self) -> list[str]:
        """LeRobot's flags without the folders that are written, those that are read absolute."""
        flags = joined_flags(self.translation.flags)
        for key in FOLDERS:
            flags = without_flag(flags, key)
        for key in PATHS:
            path = Path(self.translation.get(key) or "").expanduser()
            if self.translation.has(key) and path.exists():
                flags = [*without_flag(flags, key), f"--{key}={path.absolute()}"]
        return flags


def number(text: str | None) -> int | None:
    """Return the whole number that a flag's value is, None when it is none."""
    try:
        return int(text) if text is not None else None
    except ValueError:
        return None


def joined_flags(flags: Sequence[str]) -> list[str]:
    """Return ``--key value`` as ``--key=value``."""
    found: list[str] = []
    for flag in flags:
        if not flag.startswith("--") and found and found[-1].startswith("--") and "=" not in found[-1]:
            found[-1] += f"={flag}"
        else:
            found.append(flag)
    return found


def make_grid(translation: Translation, environment: Any) -> Grid:
    """Return the episodes that an evaluation consists of; unknown tasks are told here."""
    from lerobot_memobench.tasks.loading import load_task

    places = tuple(Place(suite, index, load_task(folder)) for suite, index, folder in environment.selected())
    runs, seed = number(translation.get("eval.n_episodes")), number(translation.get("seed"))
    if runs is None or seed is None or runs < 1:
        raise MemobenchError(
            f"found episodes={translation.get('eval.n_episodes')} and seed={translation.get('seed')}; expected whole "
            "numbers, and at least one episode"
        )
    return Grid(places, runs, min(number(translation.get("eval.batch_size")) or 1, runs), seed - environment.seed_base)


def logged(folder: Path, referent: str) -> set[tuple[str, int]]:
    """Return (task, episode) of the episodes in a folder's log."""
    if not has_log(folder):
        return set()
    records = read_episodes(folder)
    return {(record["task"], record["episode"]) for record in records if record.get("referent", "fixed") == referent}


# --- the card ---


def describe(evaluation: Evaluation) -> dict[str, Any]:
    """Return the card of an evaluation before it has found anything. Hashes the checkpoint, opens a GL context."""
    from lerobot_memobench.datasets.generation import task_hash

    grid = evaluation.grid
    protocol: dict[str, Any] = {}
    if grid is not None:
        protocol = {"tasks": sorted(place.task.name for place in grid.places), "episodes": grid.runs}
        protocol |= evaluation.environment.protocol
    card = new_card(
        protocol=protocol,
        policy=policy_facts(encoded(evaluation.policy), evaluation.seed) if evaluation.policy is not None else {},
        checkpoint=None,
        trained_on=None,
        task_files={place.task.name: task_hash(place.task) for place in grid.places} if grid is not None else {},
        flags=evaluation.flags,
        runs=[
            run_facts(
                evaluation.orders.command or ("lerobot", "eval", *evaluation.translation.flags),
                evaluation.batch,
                gl_facts(),
            )
        ],
        shard=str(evaluation.orders.shard) if evaluation.orders.shard is not None else None,
    )
    return with_checkpoint(card, evaluation.translation.get("policy.path"))


def with_checkpoint(card: dict[str, Any], path: str | None) -> dict[str, Any]:
    """Return a card with what is known of the checkpoint; a repository's is known once LeRobot has fetched it."""
    folder = policy_folder(path)
    if path is None or folder is None or "sha256" in card["policy"]:
        return card
    files = checkpoint_files(folder)
    if not any(name in files for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        return card
    revision = folder.name if folder.parent.name == "snapshots" else None
    return {
        **card,
        "policy": {**card["policy"], "sha256": tree_hash(files)},
        "checkpoint": {"path": path, "revision": revision, "files": files},
        "trained_on": training_facts(folder),
    }


def gl_facts() -> dict[str, str]:
    """Return what draws the pictures here; opens a GL context."""
    from lerobot_memobench.sim.rendering import gl_backend, renderer_name

    return {"GL backend": gl_backend(), "GL renderer": renderer_name()}


def encoded(policy: Any) -> dict[str, Any]:
    """Return a policy's configuration as plain JSON values."""
    import draccus

    found = json.loads(json.dumps(draccus.encode(policy), default=str))
    assert isinstance(found, dict)
    return {**found, "type": policy.type}


def policy_folder(path: str | None) -> Path | None:
    """Return the folder of a checkpoint: here, or where the hub's cache keeps a repository; None when not here."""
    if path is None:
        return None
    here = checkpoint_folder(path)
    if here is not None:
        return here
    if looks_local(path):
        return None
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(path, "config.json")
    return Path(cached).parent if isinstance(cached, str) else None
