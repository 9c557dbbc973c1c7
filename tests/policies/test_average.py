"""Trained weights, their average and its number of updates: one state per part, from a checkpoint or a state dict."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_memobench.policies.memobench_mem.average import WeightAverage
from lerobot_memobench.policies.memobench_mem.fusion import plain_name
from lerobot_memobench.policies.memobench_mem.memory import NONE, OURS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, made_for_training

OBJECTS = {"size": "small", "perception": "objects", "memory_frames": 32}
OWN = ("--memory_stride=null", "--memory_fusion=null", "--subgoals=null")
SETTINGS = {
    "slots": ("recurrent", {"memory_settings": {"slots": 16}}),
    "time codes": ("recurrent", {"memory_settings": {"time_codes": False}}),
    "fusion": ("frames", {"memory_fusion": "context"}),
    "level": ("subgoal", {"subgoals": None, "subgoal_level": "coarse"}),
    "texts": ("keyframes", {"subgoals": None, "subgoal_level": "coarse"}),
}
"""Other settings of one memory, which make another memory of it."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_object_dataset(tmp_path_factory.mktemp("data") / "objects")


@pytest.fixture(scope="module")
def checkpoints(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return a checkpoint of a memory and its average, whose trained weights are not the averaged ones."""
    made: dict[str, tuple[Path, WeightAverage]] = {}

    def of(memory: str) -> tuple[Path, WeightAverage]:
        if memory not in made:
            policy, before, after, _ = made_for_training(root, memory=memory, **OBJECTS)
            policy.average = WeightAverage(policy.trained_parameters(), 0.9)
            for _ in range(3):
                with torch.no_grad():
                    for parameter in policy.average.parameters.values():
                        parameter.add_(torch.randn_like(parameter))
                policy.update()
            folder = tmp_path_factory.mktemp(memory)
            for part in (policy, before, after):
                part.save_pretrained(folder)
            made[memory] = folder, policy.average
        return made[memory]

    return of


def _begun(folder: Path, root: Path, *cli: str, **changed: Any) -> MemobenchMemPolicy:
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=[*cli])
    for name, value in changed.items():
        setattr(config, name, {**config.memory_settings, **value} if name == "memory_settings" else value)  # type: ignore[attr-defined]
    return MemobenchMemPolicy.from_pretrained(
        folder, config=config, dataset_meta=LeRobotDatasetMetadata("x", root=root)
    )


def _check(policy: MemobenchMemPolicy, before: WeightAverage, *, restarts: bool) -> None:
    average = policy.average
    assert average is not None
    of_memory = {f"model.{name}" for name in policy.model.memory_names()} & average.parameters.keys()
    assert of_memory or policy.config.memory == NONE
    held = {plain_name(name): name for name in before.parameters}
    for name, live in average.parameters.items():
        old = held.get(plain_name(name))
        if restarts and name in of_memory:
            assert torch.equal(live, average.average[name]), name
            assert average.counts[name] == 0
            same = old is not None and live.shape == before.parameters[old].shape
            assert not same or not torch.equal(live, before.parameters[old]), name
        else:
            assert old is not None, name
            assert torch.equal(live, before.parameters[old]), name
            assert torch.equal(average.average[name], before.average[old]), name
            assert average.counts[name] == 3


NAMES = [*OURS, NONE]
PAIRS = [
    pytest.param(old, new, marks=() if NAMES.index(new) == NAMES.index(old) + 1 else pytest.mark.slow)
    for old in OURS
    for new in NAMES
]
"""Every memory after every other; one after each is quick enough for the default tests."""


@pytest.mark.parametrize(("old", "new"), PAIRS)
def test_another_memory_starts_from_initial_weights(checkpoints: Any, root: Path, old: str, new: str) -> None:
    folder, before = checkpoints(old)
    _check(_begun(folder, root, f"--memory={new}", *OWN), before, restarts=old != new)


@pytest.mark.parametrize("changed", SETTINGS)
def test_other_settings_make_another_memory(checkpoints: Any, root: Path, changed: str) -> None:
    memory, settings = SETTINGS[changed]
    folder, before = checkpoints(memory)
    _check(_begun(folder, root, **settings), before, restarts=True)


def test_a_checkpoint_keeps_the_updates_of_each_part(checkpoints: Any, root: Path, tmp_path: Path) -> None:
    policy = _begun(checkpoints("frames")[0], root, "--memory=recurrent", *OWN)
    policy.update()
    policy.save_pretrained(tmp_path)
    found, average = _begun(tmp_path, root).average, policy.average
    assert average is not None
    assert found is not None
    assert set(average.counts.values()) == {1, 4}
    assert found.counts == average.counts
    assert all(torch.equal(found.average[name], one) for name, one in average.average.items())


@pytest.fixture
def trained(root: Path) -> tuple[MemobenchMemPolicy, dict[str, Any]]:
    """Return a policy after two updates, and a batch."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    batch = before(batch_of(dataset, [12, 25]))
    optimizer = torch.optim.SGD(policy.get_optim_params(), lr=0.1)
    for _ in range(2):
        policy.train().forward(batch)[0].backward()
        optimizer.step()
        policy.update()
    return policy.eval(), batch


def test_loaded_weights_act(trained: tuple[MemobenchMemPolicy, dict[str, Any]]) -> None:
    policy, batch = trained
    assert policy.average is not None
    name, other = [*policy.average.parameters][:2]
    averaged = policy.average.average[other].clone()
    policy.load_state_dict({name: torch.full_like(policy.average.parameters[name], 2.0)}, strict=False)
    assert (policy.average.average[name] == 2.0).all()
    assert (policy.average.counts[name], policy.average.counts[other]) == (0, 2)
    assert torch.equal(policy.average.average[other], averaged)
    fresh = MemobenchMemPolicy(policy.config)
    expected = fresh.predict_action_chunk(batch)
    assert not torch.equal(policy.predict_action_chunk(batch), expected)
    policy.load_state_dict(fresh.state_dict())
    assert torch.equal(policy.predict_action_chunk(batch), expected)


@pytest.mark.parametrize("memory", [NONE, *OURS])
def test_a_copy_acts_and_learns_by_itself(root: Path, memory: str) -> None:
    policy, before, _, dataset = made_for_training(root, memory=memory, **OBJECTS)
    batch = before(batch_of(dataset, [12, 25]))
    loss, _ = policy.train().forward(batch)
    policy.update()
    twin = copy.deepcopy(policy)
    loss.backward()
    assert policy.average is not None
    assert twin.average is not None
    assert twin.run is policy.run
    assert dict(twin.named_parameters()).items() >= twin.average.parameters.items()
    first = policy.predict_action_chunk(batch)
    assert torch.equal(twin.predict_action_chunk(batch), first)
    twin.train().forward(batch)[0].backward()
    torch.optim.SGD(twin.get_optim_params(), lr=1.0).step()
    twin.update()
    assert torch.equal(policy.predict_action_chunk(batch), first)
    assert not torch.equal(twin.predict_action_chunk(batch), first)
