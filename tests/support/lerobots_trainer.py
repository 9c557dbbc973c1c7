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

from lerobot_memobench.training import command


def run_in_this_process(config: TrainPipelineConfig, config_path: str | None) -> int:
    from lerobot_memobench.training import samples

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["samples", *([f"--config_path={config_path}"] if config.resume else [])])
        patch.setattr(sys, "stdin", io.StringIO(json.dumps(draccus.encode(config))))
        patch.setattr(samples, "register_plugins", lambda: None)
        patch.setattr(samples.lerobot_train, "make_train_eval_datasets", samples.open_datasets)
        samples.main()
    return 0


@contextmanager
def trainer_in_this_process() -> Iterator[None]:
    """Let ``lerobot train`` call LeRobot's trainer instead of starting a process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "run_lerobot", run_in_this_process)
        yield
