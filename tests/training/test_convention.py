"""Datasets of LIBERO's convention in training, views and conformance."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy_config

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.conformance.subject import load_subject
from lerobot_memobench.datasets.lerobot_format.layout import read_info
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.objects import VIEWS
from lerobot_memobench.sim.convention import convention_of
from lerobot_memobench.training.configuration import check_environment
from lerobot_memobench.training.features import detections
from lerobot_memobench.training.view import Choice, write_view
from tests.support.fake_loop import make_checkpoint

NAMES = ("observation.images.image", "observation.images.image2")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same short episodes in both conventions."""
    folder = tmp_path_factory.mktemp("conventions")
    return {name: write_streams(folder / name, frames=3, convention=name) for name in ("upright", "libero")}


def checkpoint(folder: Path, *cameras: str) -> Path:
    features = {f"observation.images.{name}": {"type": "VISUAL", "shape": [3, 256, 256]} for name in cameras}
    return make_checkpoint(folder / "act", "act", input_features=features)


def test_a_view_keeps_the_convention(both: dict[str, Path], tmp_path: Path) -> None:
    for name, folder in both.items():
        write_view(folder, tmp_path / name, Choice())
        assert convention_of(read_info(tmp_path / name)["features"]) == name
    upright, libero = (LeRobotDataset("local/view", root=tmp_path / name)[4] for name in both)
    for here, there in zip(NAMES, VIEWS, strict=True):
        assert (libero[here] - upright[there].flip(-1)).abs().mean() < 0.01
        assert (libero[here] - upright[there]).abs().mean() > 0.05


def test_evaluations_during_a_training_follow_the_dataset(both: dict[str, Path]) -> None:
    policy = make_policy_config("act", device="cpu", push_to_hub=False)
    for name, folder in both.items():
        meta = LeRobotDataset("local/data", root=folder).meta
        for convention in both:
            config: Any = SimpleNamespace(policy=policy, env=MemobenchEnvConfig(convention=convention), rename_map={})
            if convention == name:
                check_environment(config, meta, meta.features)
            else:
                with pytest.raises(MemobenchError, match=f"set env.convention={name}"):
                    check_environment(config, meta, meta.features)


def test_a_detector_reads_upright_pictures(both: dict[str, Path]) -> None:
    with pytest.raises(MemobenchError, match="a detector reads upright ones"):
        detections(both["libero"], lambda *_: None, dict(zip(VIEWS, NAMES, strict=True)), "observation.state")  # type: ignore[arg-type]


def test_conformance_needs_the_checkpoints_convention(
    both: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a dataset, its observations have it."""
    theirs, ours = checkpoint(tmp_path, "image", "image2"), checkpoint(tmp_path / "ours", "image", "wrist_image")
    for path, other in ((theirs, "upright"), (ours, "libero")):
        with pytest.raises(MemobenchError, match=f"expects pictures of convention=.*, and found {other}"):
            load_subject([f"policy={path}", f"dataset={both[other]}"], tmp_path)
    monkeypatch.setattr("lerobot_memobench.conformance.subject.check_weights", lambda *_: 1 / 0)
    with pytest.raises(MemobenchError, match="division by zero"):  # after the observations were written
        load_subject([f"policy={theirs}"], tmp_path)
    assert convention_of(read_info(tmp_path / "streams")["features"]) == "libero"
