"""Rewrite a memobench_mem checkpoint of an earlier version: remove settings that this version does not have.

    python -m lerobot_memobench.policies.update_checkpoint CHECKPOINT ...

All of these settings concern training alone, so the policy acts as before. A training can be resumed if it used the
values that remain.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.policies.checkpoint import CONFIG_FILE, REMOVED_FIELDS, checkpoint_folder, read_json
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import ALIGN_WEIGHTS, SHUFFLE_SEED, SIZES

TRAIN_CONFIG = "train_config.json"
REMAINING: Mapping[str, Callable[[Mapping[str, Any]], tuple[Any, ...]]] = {
    "feature_cache_dir": lambda saved: (saved["feature_cache_dir"],),
    "shuffle_seed": lambda saved: (SHUFFLE_SEED,) if saved.get("shuffle_subgoals") else (saved["shuffle_seed"],),
    "align_weight": lambda saved: (ALIGN_WEIGHTS[saved.get("align", "none")], None, 0.0),
    "min_lr_ratio": lambda saved: (SIZES[saved.get("size", "tiny")].final_learning_rate, None),
}
"""Removed field -> its values that mean what this version does."""


def update_checkpoint(folder: Path) -> list[str]:
    """Remove the fields of earlier versions from a checkpoint's files.

    Returns:
        A note for each field whose value differed from what this version trains with.
    """
    path, notes = folder / CONFIG_FILE, []
    policy = read_json(path)
    for name in sorted(REMOVED_FIELDS & policy.keys()):
        values = REMAINING[name](policy)
        if policy[name] not in values:
            notes.append(f"{name} was {policy[name]}; a training from this checkpoint goes on with {values[0]}")
    write_file(path, json.dumps(_current(policy), indent=4))
    training = folder / TRAIN_CONFIG
    if training.is_file():
        config = read_json(training)
        write_file(training, json.dumps(config | {"policy": _current(config["policy"])}, indent=4))
    return notes


def _current(policy: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in policy.items() if name not in REMOVED_FIELDS}


def main(names: Sequence[str]) -> None:
    """Update checkpoints, or the last ones of training runs."""
    for name in names:
        folder = checkpoint_folder(name)
        if folder is None:
            raise MemobenchError(f"{name} is no checkpoint folder; give one that holds {CONFIG_FILE}")
        for note in update_checkpoint(folder):
            print(f"note: {note}")
        print(f"updated: {folder}")


if __name__ == "__main__":
    main(sys.argv[1:])
