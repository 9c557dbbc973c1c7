"""The commands of the installed LeRobot."""

from __future__ import annotations

import lerobot.scripts.lerobot_eval
import lerobot.scripts.lerobot_train
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.settings.lerobot_commands import config_class, lerobot_commands


def test_every_command_of_lerobot_is_there() -> None:
    assert {"train", "eval", "record", "dataset-viz", "edit-dataset", "info"} <= set(lerobot_commands())


def test_their_configurations_are_found() -> None:
    assert config_class(lerobot.scripts.lerobot_eval.main) is EvalPipelineConfig
    assert config_class(lerobot.scripts.lerobot_train.main) is TrainPipelineConfig
