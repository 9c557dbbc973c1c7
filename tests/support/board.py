"""Evaluations and submissions for tests of the board, without a simulation, and changes of them."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_memobench.board.submission import CARD, LOG
from lerobot_memobench.constants import EVIDENCE_EPISODES
from lerobot_memobench.datasets.generate import task_hash
from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.policies.checkpoint import tree_hash
from lerobot_memobench.tasks.assessment import chance, scene_and_variant
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import STRICT
from tests.support.logs import card

Json = dict[str, Any]
TASKS = task_names(suite=STRICT)
ABOUT: Json = {"model": "One", "submitter": "@one", "date": "2026-11-28", "training_data": "1,500 demonstrations"}
ABOUT |= {"supervised_with_answer": False}
VERSIONS = {"lerobot_policy_memobench": "0.2.0", "lerobot": "0.6.1", "mujoco": "3.9.0"}
FILES = {"config.json": "1" * 64, "model.safetensors": "2" * 64}
IMAGES = {"observation.images.image": {"type": "VISUAL", "shape": [3, 256, 256]}}
SETTINGS = {"n_action_steps": 5, "input_features": IMAGES}
SALT = "5" * 32


# --- a valid evaluation and its submission ---


def scene_of(name: str, seed: int) -> str:
    return hashlib.sha256(f"{name}, {seed}".encode()).hexdigest()[:16]


def line(name: str, episode: int, first: int, speed: int, **settings: Any) -> Json:
    """A rollout of a task: every third one fails at its first checkpoint."""
    published = get_task(name)
    scene, seed = episode, first + episode
    fixed = settings.get("referent") == "fixed"
    task = published if fixed else referent_of(published, seed)
    suite = {"lost": False, "held_steps": 0} if published.suite == STRICT else {}
    prompt_steps = published.prompt_steps if suite else 200 * (task.prompt is not None)
    if settings.get("evidence"):
        scene, variant = scene_and_variant(published, episode)
        seed, task = first + scene, published.variant(variant)
    success, only = episode % 3 > 0, len(published.random_variants) == 1
    steps = speed * len(task.checkpoints) + scene if success else 1200
    goals = [checkpoint.goal for checkpoint in task.checkpoints]
    marks = [speed * (k + 1) + scene if success or (k and goals[k] != task.goal) else None for k in range(len(goals))]
    choice = {"choice": task.variant_index if success or only else None, "answered": success or only}
    choice |= {"variants": len(published.random_variants), "chance": chance(published)}
    return {
        **{"task": name, "memory_type": task.memory_type, "episode": episode, "seed": seed},
        **{"variant": task.variant_index, "prompt_shown": None if task.prompt is None else True},
        **{"prompt_steps": prompt_steps, "steps": steps, "success": success},
        **(choice if settings.get("evidence") else {}),
        **({"paused_steps": steps // 50 * 100} if settings.get("pause_steps") else {}),
        "checkpoints": [
            {"operation": c.operation, "first_step": step, "ordered_step": step if success else None}
            for c, step in zip(task.checkpoints, marks, strict=True)
        ],
        **{"failure": None if success else "storage_failure", **suite},
        **{"scene_hash": scene_of(name, seed), "wall_s": 2.0},
    }


def evaluation(folder: Path, first: int = 7, speed: int = 50, suite: str = STRICT, **settings: Any) -> Path:
    """Write the folder of an evaluation of a suite: 10 episodes of each task, 36 with evidence."""
    names = task_names(suite=suite)
    count = EVIDENCE_EPISODES if settings.get("evidence") else 10
    records = [line(name, episode, first, speed, **settings) for name in names for episode in range(count)]
    block = EnvSettings(suite=suite, seed_base=first, replan_steps=5, **settings).protocol_block
    content = card(
        {"tasks": sorted(names), "episodes": count, **block, "inputs": "pixels"},
        {"type": "act", "seed": first, "settings": SETTINGS, "sha256": tree_hash(FILES)},
        checkpoint={"path": "user/one", "revision": "abc", "files": FILES},
        trained_on={"repo_id": "user/data", "revision": "def"},
        task_files={name: task_hash(get_task(name)) for name in names},
        runs=[{"command": ["lerobot"], "batch_size": 1, "versions": VERSIONS, "git_commit": None, "machine": {}}],
    )
    write_evaluation(folder, content)
    write_episodes(folder, records)
    return folder


# --- changes of a submission ---


def first_failure(records: list[Json]) -> Json:
    return next(record for record in records if not record["success"])


def in_log(change: Callable[[list[Json]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        lines = [json.loads(each) for each in gzip.decompress((folder / LOG).read_bytes()).splitlines()]
        change(lines)
        (folder / LOG).write_bytes(gzip.compress("".join(json.dumps(each) + "\n" for each in lines).encode()))

    return apply


def in_card(change: Callable[[Json], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        content = json.loads((folder / CARD).read_text())
        change(content)
        (folder / CARD).write_text(json.dumps(content))

    return apply


def both(*changes: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: [change(folder) for change in changes]


def stating(key: str, value: Any) -> Callable[[Path], None]:
    return in_card(lambda content: content["submission"].__setitem__(key, value))


def sealed(folder: Path) -> None:
    """Move all seeds to the sealed ones, with a salt and the variants that both draw."""

    def move(records: list[Json]) -> None:
        for record in records:
            record["seed"] = 100_007 + record["episode"]
            task = get_task(record["task"])
            record["variant"] = referent_of(task, record["seed"], SALT).variant_index
            record["scene_hash"] = scene_of(task.name, record["seed"])

    in_log(move)(folder)
    protocol = {"seed_base": 100_007, "salt": SALT}
    in_card(lambda card: (card["protocol"].update(protocol), card["policy"].update(seed=100_007)))(folder)
