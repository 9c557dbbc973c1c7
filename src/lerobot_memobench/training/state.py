"""The state of a training in a checkpoint: step, optimizer, schedule and random state.

Names and formats are those of LeRobot 0.6 and of its main branch, which read each other's files. The functions that
write all of them at once differ between the two.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot.optim import load_optimizer_state, load_scheduler_state, save_optimizer_state, save_scheduler_state
from lerobot.utils.constants import TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.io_utils import write_json
from lerobot.utils.random_utils import save_rng_state

from lerobot_memobench.policies.checkpoint import read_json


def save_state(checkpoint: Path, progress: dict[str, int], optimizer: Any, scheduler: Any) -> None:
    """Write ``training_state`` of a checkpoint, the optimizer's parameter groups last.

    Args:
        progress: ``step`` and, per update, ``batch_size`` of a process and ``num_processes``.
        scheduler: of the learning rate, or None.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    folder.mkdir(parents=True, exist_ok=True)
    write_json({**progress, "dp_world_size": progress["num_processes"]}, folder / TRAINING_STEP)
    save_rng_state(folder)
    if scheduler is not None:
        save_scheduler_state(scheduler, folder)
    save_optimizer_state(optimizer, folder)


def load_state(checkpoint: Path, optimizer: Any, scheduler: Any) -> dict[str, int]:
    """Restore optimizer and schedule of a checkpoint; return its ``progress``.

    The random state is not restored: each update sets its own (`loop.train`).

    Raises:
        MemobenchError: the checkpoint's step cannot be read.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    progress = read_json(folder / TRAINING_STEP)
    load_optimizer_state(optimizer, folder)
    if scheduler is not None:
        load_scheduler_state(scheduler, folder)
    return progress
