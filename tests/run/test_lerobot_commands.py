"""The commands of the installed LeRobot."""

from __future__ import annotations

import os

import lerobot.scripts.lerobot_eval
import lerobot.scripts.lerobot_train
import pytest
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_memobench.run.lerobot_commands import config_class, lerobot_commands, load_command


def test_every_command_of_lerobot_is_there() -> None:
    assert {"train", "eval", "record", "dataset-viz", "edit-dataset", "info"} <= set(lerobot_commands())


def test_their_configurations_are_found() -> None:
    assert config_class(lerobot.scripts.lerobot_eval.main) is EvalPipelineConfig
    assert config_class(lerobot.scripts.lerobot_train.main) is TrainPipelineConfig


@pytest.mark.parametrize("chosen", [None, "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"])
def test_torch_waits_briefly_in_evaluations_unless_told_otherwise(
    chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {"HOME": "/nowhere"} | ({chosen: "ACTIVE"} if chosen else {})
    monkeypatch.setattr(os, "environ", dict(before))
    load_command("train")
    assert os.environ.get("GOMP_SPINCOUNT") == before.get("GOMP_SPINCOUNT")
    load_command("eval")
    assert os.environ.get("GOMP_SPINCOUNT") == (before.get("GOMP_SPINCOUNT") if chosen else "2000")
    assert os.environ.get("OMP_WAIT_POLICY") == before.get("OMP_WAIT_POLICY")
