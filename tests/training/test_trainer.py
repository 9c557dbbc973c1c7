"""LeRobot's own trainer: its view of a dataset, and samples in main memory, equal to LeRobot's."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy_config
from lerobot.scripts import lerobot_train
from torch.utils.data import DataLoader

from lerobot_memobench.commands.command_line import parse_words, read_words
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import OBJECTS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.training import trainer
from lerobot_memobench.training.trainer import keep_in_memory, open_trainer_datasets, prepare
from tests.support.held_dataset import make_held_dataset

STATE, SLOTS, IMAGE = "observation.state", "observation.environment_state", "observation.images.image"
FEATURES = {STATE: PolicyFeature(FeatureType.STATE, (8,)), SLOTS: PolicyFeature(FeatureType.ENV, (208,))}
DELTAS = {STATE: [-0.2, -0.05, 0.0], SLOTS: [-0.2, -0.05, 0.0], "action": [0.0, 0.05, 0.1]}


@pytest.mark.parametrize("episodes", [None, [1, 2]])
def test_samples_equal_lerobots(objects: Path, episodes: list[int] | None) -> None:
    """Rows at the bounds of episodes, whose histories and chunks are padded."""
    theirs, ours = (
        LeRobotDataset("local/data", root=objects, episodes=episodes, delta_timestamps=DELTAS) for _ in range(2)
    )
    keep_in_memory(ours)
    rows = [0, 1, 4, 22, 23, 24, len(theirs) - 1]
    for row, found in zip(rows, ours.__getitems__(rows), strict=True):
        for one in (found, ours[row]):
            expected = theirs[row]
            assert one.keys() == expected.keys()
            for name, value in expected.items():
                same = torch.equal(one[name], value) if isinstance(value, torch.Tensor) else one[name] == value
                assert same, (row, name)


def opened(root: Path, features: dict[str, PolicyFeature] | None = None) -> tuple[TrainPipelineConfig, Any]:
    policy = make_policy_config("act", device="cpu", push_to_hub=False, input_features=features)
    config = TrainPipelineConfig(DatasetConfig("local/data", root=str(root)), policy=policy, num_workers=4)
    return config, open_trainer_datasets(config)[0]


def test_policies_without_images_train_from_memory(objects: Path, imaged: Path) -> None:
    for root, features in ((objects, None), (imaged, FEATURES)):
        config, dataset = opened(root, features)
        del dataset.reader.hf_dataset  # not read any more
        batch = next(iter(DataLoader(dataset, batch_size=5)))
        assert (len(batch["action"]), config.num_workers) == (5, 0)
        assert not [name for name in batch if name.startswith("observation.images")]
    config, dataset = opened(imaged)
    assert config.num_workers == 4
    assert "observation.images.image" in dataset[3]


def test_lerobots_trainer_opens_them(monkeypatch: pytest.MonkeyPatch) -> None:
    received: list[Any] = []

    def train(config: TrainPipelineConfig) -> None:
        received[:] = [config, lerobot_train.make_train_eval_datasets, sys.argv[1:]]

    theirs = lerobot_train.make_train_eval_datasets
    policy = make_policy_config("act", device="cpu", push_to_hub=False)
    config = TrainPipelineConfig(DatasetConfig("local/data"), policy=policy, steps=1, resume=True)
    config.checkpoint_path = Path("run")
    monkeypatch.setattr(lerobot_train, "train", train)
    trainer.run_lerobot(config)
    assert received == [config, open_trainer_datasets, ["--config_path=run/pretrained_model"]]
    assert lerobot_train.make_train_eval_datasets is theirs


@pytest.mark.parametrize(("policy", "plan"), [("vqbet", (5, 5)), ("gaussian_actor", (1, 1))])
def test_environments_of_a_training_get_the_plans_of_its_policy(
    monkeypatch: pytest.MonkeyPatch, policy: str, plan: tuple[int, int]
) -> None:
    """LeRobot's trainer opens them without the policy, and holds of strict tasks depend on its plans."""
    dataset = SimpleNamespace(meta=SimpleNamespace(camera_keys=["observation.images.image"]))
    monkeypatch.setattr(trainer, "make_train_eval_datasets", lambda config: (dataset, None))
    environment = MemobenchEnvConfig(suite="strict")
    config = make_policy_config(policy, device="cpu", push_to_hub=False)
    open_trainer_datasets(TrainPipelineConfig(DatasetConfig("local/data"), env=environment, policy=config))
    assert (environment.replan_steps, environment.window_steps) == plan


# -- the view of a training --------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def config_of(root: Path, *words: str) -> TrainPipelineConfig:
    config: TrainPipelineConfig = read_words("train", parse_words([*words, "device=cpu", f"dataset={root}"])).build()
    return config


def test_chosen_episodes_are_those_of_the_dataset(tmp_path: Path) -> None:
    config = config_of(make_held_dataset(tmp_path / "held"), "policy=act", "episodes=[1]")
    assert prepare(config, None, None, print).dataset.episodes == [2, 3]


def test_trainings_share_a_view(imaged: Path) -> None:
    given, notes = config_of(imaged, "policy=act"), list[str]()
    for _ in range(2):
        folder = Path(str(prepare(given, None, OBJECTS, notes.append).dataset.root))
    assert {*LeRobotDataset("local/data", root=folder).meta.features} & {STATE, SLOTS, IMAGE} == {STATE, SLOTS}
    assert not [note for note in notes if "pixels" in note]
    assert [*folder.parent.iterdir()] == [folder]
    inputs = prepare(given, True, None, notes.append).policy.input_features
    assert IMAGE in inputs
    assert "observation.phase" not in inputs
    (note,) = (note for note in notes if "pixels" in note)
    assert "observation_height=48 observation_width=48" in note
    given.dataset.episodes = [7]
    with pytest.raises(MemobenchError, match=r"episodes=\[7\]"):
        prepare(given, None, None, notes.append)


@pytest.mark.parametrize(
    ("words", "named"),
    [(["policy=vqbet"], "policy=vqbet cannot read"), (["policy=xvla", "env=memobench"], "processors of LIBERO")],
)
def test_inputs_that_a_policy_cannot_have_are_refused(
    synthetic: Path, cache: Path, words: list[str], named: str
) -> None:
    with pytest.raises(MemobenchError, match=named):
        prepare(config_of(synthetic, *words), None, None, print)
    assert not [*cache.rglob("info.json")]
