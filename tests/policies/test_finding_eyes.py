"""Eyes whose finds stand beside their tokens: settings, caches, samples, training, rollouts, checkpoints."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.datasets.feature_cache import building
from lerobot_memobench.datasets.feature_cache.layout import FOLDER
from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED
from lerobot_memobench.envs.observations import PIXELS, obs_type_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.tower import GRID, POOLED, WIDTH, Tower
from lerobot_memobench.policies.memobench_mem.caching import cache_dataset, open_frames
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.batch import MASK, TOKENS
from lerobot_memobench.policies.memobench_mem.perception.eyes import seen_key
from lerobot_memobench.policies.memobench_mem.perception.finding_eyes import NUMBERS
from lerobot_memobench.policies.memobench_mem.perception.found import FOUND, ObjectsInPictures
from lerobot_memobench.policies.memobench_mem.perception.slots import HAND_DIM
from lerobot_memobench.sim.object_slots import SIZE
from tests.support.object_dataset import make_object_dataset
from tests.support.picture_rollouts import CAMERAS, acts_as_its_checkpoint, made_eyes, trained_and_acted
from tests.support.small_policy import batch_of, made_for_training, small_config
from tests.support.synthetic_dataset import LENGTHS

ROUNDED = 2**-7
"""What bfloat16 may round off, as a share of a number."""


@pytest.fixture(scope="module")
def finding(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    eyes = made_eyes(tmp_path_factory.mktemp("eyes") / "eyes.safetensors", 1)
    return {"size": "small", "eyes": str(eyes), "finds": True, "n_action_steps": 3, "memory_stride": 2}


@pytest.fixture(scope="module")
def root(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, in which nothing says what objects there are."""
    to = tmp_path_factory.mktemp("seen") / "data"
    return shutil.copytree(dataset_root, to, ignore=shutil.ignore_patterns(FOLDER))


def test_pictures_are_all_that_is_needed(tmp_path: Path) -> None:
    config = MemobenchMemConfig(device="cpu", size="small", finds=True, whole_plan_if_still=True)
    assert (config.eyes, config.sees_tokens, config.finds_objects, config.sees_slots) == ("package", True, True, True)
    assert obs_type_of(config) == PIXELS
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).finds


@pytest.mark.parametrize(
    "fields", [{"size": "tiny"}, {"size": "small", "eyes": "random"}, {"size": "small", "perception": "objects"}]
)
def test_finds_without_tokens_of_eyes_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(MemobenchError, match=r"--policy\.finds=true is for pictures.*leave it out"):
        MemobenchMemConfig(device="cpu", finds=True, **fields)


@pytest.mark.parametrize(
    "fields", [{"tokens_dropped": 0.5}, {"finds": True, "tokens_dropped": 1.5}, {"finds": True, "tokens_dropped": -0.5}]
)
def test_tokens_are_dropped_beside_finds_alone(fields: dict[str, Any]) -> None:
    with pytest.raises(MemobenchError, match=r"--policy\.tokens_dropped=-?\d\.5 must be in \[0, 1\].*leave it out"):
        MemobenchMemConfig(device="cpu", size="small", **fields)


def test_a_sample_has_both_and_a_remembered_frame_too(
    root: Path, finding: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    how = ["--size", "small", "--stride", "2", "--device", "cpu"]
    assert main(["cache", str(root), "--finds", "--eyes", finding["eyes"], *how]) == 0
    assert len(list((root / FOLDER).glob("*/tokens.bin"))) == len(CAMERAS) + 2

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a video was opened")

    with monkeypatch.context() as patched:
        patched.setattr("lerobot.datasets.dataset_reader.decode_video_frames", refuse)
        patched.setattr("lerobot_memobench.datasets.feature_cache.building.frame_reader", refuse)
        policy, before, _, dataset = made_for_training(root, **finding)
        assert set(policy.config.input_features) == {OBS_STATE, *CAMERAS}
        batch = before(batch_of(dataset, [45, 50]))
    assert all(batch[seen_key(camera)].shape == (2, GRID**2, WIDTH) for camera in CAMERAS)
    assert batch[FOUND].shape == (2, SIZE)
    assert batch[FOUND].any()
    assert batch[TOKENS].shape[2:] == (1, NUMBERS + SIZE + HAND_DIM + 1)
    newest = batch[TOKENS][torch.arange(2), batch[MASK].sum(dim=1) - 1, 0]
    # Every second frame is remembered, and this is its episode's eleventh: the newest that it remembers is itself.
    assert torch.equal(newest[1, NUMBERS : NUMBERS + SIZE], batch[FOUND][1])
    pooled = policy.perception.pooled(batch[seen_key(CAMERAS[0])])
    assert torch.equal(newest[1, :NUMBERS], pooled[1].float().flatten())
    memory, _ = policy._read_memory(batch)
    assert memory.shape[1] == policy.config.memory_frames * POOLED**2


def test_of_two_trainings_one_finds_and_the_other_sees(
    root: Path, dataset_root: Path, finding: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, *_ = made_for_training(root, **finding)
    other = shutil.copytree(dataset_root, tmp_path / "data", ignore=shutil.ignore_patterns(FOLDER))
    begun, waits, go = threading.Event(), threading.Event(), threading.Event()
    looked, finds = {"first": 0, "second": 0}, {"first": 0, "second": 0}
    find, see = ObjectsInPictures.__call__, Tower.forward

    def held(look: ObjectsInPictures, pictures: Any, states: torch.Tensor) -> torch.Tensor:
        finds[threading.current_thread().name] += len(states)
        begun.set()
        assert go.wait(60)
        return find(look, pictures, states)

    def counting(tower: Tower, images: torch.Tensor) -> torch.Tensor:
        looked[threading.current_thread().name] += len(images)
        return see(tower, images)

    monkeypatch.setattr(ObjectsInPictures, "__call__", held)
    monkeypatch.setattr(Tower, "forward", counting)
    monkeypatch.setattr(building.logger, "warning", lambda *_: waits.set())
    opened: dict[str, Any] = {}

    def train() -> None:
        opened[threading.current_thread().name] = open_frames(other, policy.config, policy.perception)

    first, second = (threading.Thread(target=train, name=name, daemon=True) for name in looked)
    first.start()
    assert begun.wait(60)
    second.start()
    assert waits.wait(60)
    assert looked == {"first": 0, "second": sum(LENGTHS) * len(CAMERAS)}
    go.set()
    first.join(60)
    second.join(60)
    assert finds == {"first": sum(LENGTHS), "second": 0}
    assert looked["first"] == 0
    assert torch.equal(*(opened[name].columns[FOUND] for name in ("first", "second")))


def test_a_rollout_sees_and_remembers_what_training_reads(root: Path, finding: dict[str, Any]) -> None:
    made = made_for_training(root, **finding)
    trained, acted, tokens = trained_and_acted(root, made)
    policy = made[0]
    read, kept = (stored.split([NUMBERS, SIZE, HAND_DIM + 1], dim=-1) for stored in (trained[TOKENS], tokens))
    assert (read[0] - kept[0]).abs().max() <= ROUNDED * kept[0].abs().max()
    assert torch.allclose(read[1], kept[1], rtol=2**-15, atol=1e-6)
    (of_cache, real), (of_pictures, shown) = (policy.perception.present(batch) for batch in (trained, acted))
    assert len(of_cache) == len(CAMERAS) + 1
    assert all(torch.equal(one, other) for one, other in zip(real, shown, strict=True))
    for one, other in zip(of_cache, of_pictures, strict=True):
        assert (one.float() - other.float()).abs().max() <= ROUNDED * other.float().abs().max()


@pytest.mark.parametrize(
    "fields", [{"align": "framewise"}, {"integration": "context"}, {"integration": "none"}], ids=str
)
def test_every_kind_trains_and_the_eyes_do_not(root: Path, finding: dict[str, Any], fields: dict[str, Any]) -> None:
    policy, before, _, dataset = made_for_training(root, **finding | fields)
    policy.train().forward(before(batch_of(dataset, [10, 30, 50, 80])))[0].backward()
    assert all(parameter.grad is not None for parameter in policy.model.memory_parameters().values())
    assert policy.perception.project.weight.grad.any()
    assert policy.perception.finds.slot.mlp[0].weight.grad.any()
    assert not any("look" in name for name, _ in policy.named_parameters()), "eyes that find are no part of it"


def test_without_tokens_it_learns_of_finds_alone_and_acts_by_both(root: Path, finding: dict[str, Any]) -> None:
    policy, before, _, dataset = made_for_training(root, **finding, align="semantic", tokens_dropped=1.0)
    batch = before(batch_of(dataset, [10, 30, 50, 80]))
    eyes, pool = policy.perception, policy.model.memory.pool
    policy.train().forward(batch)[0].backward()
    assert eyes.project.weight.grad is None
    assert pool.tokens.project.weight.grad is None
    assert eyes.finds.slot.mlp[0].weight.grad.any()
    assert pool.finds.slot.mlp[0].weight.grad.any()
    policy.update()
    policy.eval()
    assert len(eyes.present(batch)[0]) == len(CAMERAS) + 1
    others = batch[TOKENS].clone()
    others[..., :NUMBERS] += 1.0
    assert not torch.allclose(pool(others[0]), pool(batch[TOKENS][0]))


def test_present_and_memory_are_without_tokens_as_often_as_was_asked(root: Path, finding: dict[str, Any]) -> None:
    policy, before, _, dataset = made_for_training(root, **finding, tokens_dropped=0.5)
    batch = before(batch_of(dataset, [10, 30]))
    policy.train()
    torch.manual_seed(0)
    frames = batch[TOKENS][0]
    alone = policy.model.memory.pool.finds(frames[..., NUMBERS:])
    seen = [len(policy.perception.present(batch)[0]) == 1 for _ in range(40)]
    remembered = [torch.equal(policy.model.memory.pool(frames), alone) for _ in range(40)]
    assert 10 <= sum(seen) <= 30
    assert 10 <= sum(remembered) <= 30
    assert seen != remembered, "they are drawn apart"


def test_told_objects_with_errors_stand_for_found_ones_in_training(
    root: Path, finding: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("something was sought")

    monkeypatch.setattr(ObjectsInPictures, "__call__", refuse)
    fields = finding | {"sight_errors": 1.0}
    told_root = make_object_dataset(tmp_path / "told", pictures=True)
    cache_dataset(told_root, small_config(**fields))
    policy, before, _, dataset = made_for_training(told_root, **fields)
    assert OBS_ENV_STATE not in policy.config.input_features
    batch = before(batch_of(dataset, [10, 30]))
    told = torch.stack([torch.as_tensor(dataset.hf_dataset[row][PRIVILEGED]) for row in (10, 30)])
    assert torch.equal(batch[FOUND], told)
    frames = batch[TOKENS][0]
    policy.train()
    torch.manual_seed(0)
    assert not torch.equal(*(policy.perception.present(batch)[0][-1] for _ in range(2)))
    assert not torch.equal(*(policy.model.memory.pool(frames) for _ in range(2)))
    policy.forward(batch)[0].backward()
    policy.eval()
    seen = policy.perception.present(batch)[0][-1]
    assert torch.equal(seen[:, :-HAND_DIM], told)
    assert torch.equal(*(policy.model.memory.pool(frames) for _ in range(2)))
    with pytest.raises(MemobenchError, match=r"no column 'observation\.environment_state'.*no --policy\.sight_errors"):
        made_for_training(root, **fields)


def test_a_checkpoint_acts_as_the_policy_did(root: Path, finding: dict[str, Any], tmp_path: Path) -> None:
    policy, before, after, dataset = made_for_training(root, **finding)
    policy.train().forward(before(batch_of(dataset, [10, 30])))
    policy.update()
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    acts_as_its_checkpoint(root, policy, before, dataset, tmp_path)
