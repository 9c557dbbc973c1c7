"""LeRobot's trainer in the process of the test, which has its imports already and can watch the policy."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import draccus
import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts import lerobot_train

from lerobot_memobench.training import trainer


def run_in_this_process(config: TrainPipelineConfig) -> int:
    with pytest.MonkeyPatch.context() as patch:
        path = config.checkpoint_path
        patch.setattr(sys, "argv", ["trainer", *([f"--config_path={path / 'pretrained_model'}"] if path else [])])
        patch.setattr(sys, "stdin", io.StringIO(json.dumps(draccus.encode(config))))
        patch.setattr(trainer, "register_plugins", lambda: None)
        patch.setattr(lerobot_train, "make_train_eval_datasets", None)  # restored at the end
        trainer.main()
    return 0


@contextmanager
def trainer_in_this_process() -> Iterator[None]:
    """Let ``lerobot train`` call LeRobot's trainer instead of starting a process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "run_lerobot", run_in_this_process)
        yield
