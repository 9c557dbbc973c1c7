"""Images through the visual encoder: settings, caches, samples, training, checkpoints; the rest is any perception's."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, SIDE, WIDTH, VisualEncoder
from lerobot_memobench.perception.weights import save_detector
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import encoded_key
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.features import FOLDER, cache_dataset
from tests.support.picture_rollouts import (
    CAMERAS,
)
from tests.support.small_policy import batch_of, made_for_training, open_small_training, small_config
from tests.support.synthetic_dataset import LENGTHS

FRAME_BYTES = 2 * GRID**2 * WIDTH
ROUNDED = 2**-7
"""What bfloat16 may round off, as a share of a number."""


def made_detector(path: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    save_detector(Detector(VisualEncoder().eval(), ("cork",)), path)
    return path


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_detector(tmp_path_factory.mktemp("detector") / "detector.safetensors", 1)


@pytest.fixture(scope="module")
def encoder_fields(detector: Path) -> dict[str, Any]:
    return {"size": "small", "visual_encoder": str(detector), "n_action_steps": 3, "memory_stride": 2}


@pytest.fixture(scope="module")
def root(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset; its caches are made once for all tests that do not change them."""
    return copy(dataset_root, tmp_path_factory.mktemp("seen") / "data")


def copy(dataset_root: Path, to: Path) -> Path:
    return shutil.copytree(dataset_root, to, ignore=shutil.ignore_patterns(FOLDER))


@pytest.fixture
def encoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many pictures each pass of a tower saw."""
    seen: list[int] = []
    original = VisualEncoder.forward

    def counting(tower: VisualEncoder, images: torch.Tensor) -> torch.Tensor:
        seen.append(len(images))
        return original(tower, images)

    monkeypatch.setattr(VisualEncoder, "forward", counting)
    return seen


def apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """How far numbers are apart at most, as a share of the largest."""
    return float((one.float() - other.float()).abs().max() / other.float().abs().max())


# -- settings ------------------------------------------------------------------------------------------------------


def test_the_package_encoder_is_the_default_of_small_pixels(tmp_path: Path) -> None:
    random = MemobenchMemConfig(device="cpu", size="small", visual_encoder="random")
    assert (random.memory_stride, random.frames_per_episode, random.task_weights) == (1, 1, None)
    config = MemobenchMemConfig(device="cpu", size="small")
    assert (config.visual_encoder, config.image_size, config.tokens_per_frame) == ("package", (SIDE, SIDE), POOLED**2)
    assert (config.memory_stride, config.frames_per_episode, config.task_weights) == (8, 6, {})
    assert (config.objective, config.state_token) == ("regression", True)
    assert not random.encodes_ahead
    for other in ({"size": "tiny"}, {"size": "pi05"}, {"size": "small", "perception": "objects"}):
        assert MemobenchMemConfig(device="cpu", **other).visual_encoder is None
    config.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).visual_encoder == "package"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"size": "tiny", "visual_encoder": "package"}, "size=small perception=pixels.*leave it out"),
        (
            {"size": "small", "visual_encoder": "package", "image_resolution": (96, 96)},
            f"{SIDE} x {SIDE}.*visual_encoder=random",
        ),
        ({"size": "small", "visual_encoder": "package", "tokens_per_frame": 4}, "tokens_per_frame"),
    ],
)
def test_bad_settings_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        MemobenchMemConfig(device="cpu", **fields)


def test_a_file_that_holds_no_encoder_is_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"there is no file.*python -m research.detector train"):
        cache_dataset(root, small_config(size="small", visual_encoder=str(tmp_path / "absent")))
    save_detector(
        Detector(VisualEncoder((4, 4, 8, 8, 16), (0, 0, 0, 1, 0)), ("cork",)), tmp_path / "narrow.safetensors"
    )
    with pytest.raises(MemobenchError, match=r"widths \(4, 4, 8, 8, 16\).*python -m research.detector train"):
        cache_dataset(root, small_config(size="small", visual_encoder=str(tmp_path / "narrow.safetensors")))


# -- caches --------------------------------------------------------------------------------------------------------


def test_a_cache_that_was_killed_is_finished(
    dataset_root: Path, tmp_path: Path, encoder_fields: dict[str, Any], root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed = copy(dataset_root, tmp_path / "data")
    passes = iter(range(4))
    original = VisualEncoder.forward

    def kill(tower: VisualEncoder, images: torch.Tensor) -> torch.Tensor:
        if next(passes) == 3:
            raise KeyboardInterrupt
        return original(tower, images)

    with monkeypatch.context() as patched:
        patched.setattr(VisualEncoder, "forward", kill)
        with pytest.raises(KeyboardInterrupt):
            cache_dataset(killed, small_config(**encoder_fields), batch_size=40)
    for where in (killed, root):
        cache_dataset(where, small_config(**encoder_fields), batch_size=40)
    made = [path.relative_to(killed) for path in killed.glob(f"{FOLDER}/*/*.safetensors")]
    assert len(made) == 3 * len(LENGTHS)
    assert all((killed / path).read_bytes() == (root / path).read_bytes() for path in made)


# -- samples -------------------------------------------------------------------------------------------------------


def test_a_sample_has_tokens_in_the_place_of_pictures(root: Path, encoder_fields: dict[str, Any]) -> None:
    policy, before, _, dataset = made_for_training(root, **encoder_fields)
    sample, lerobots = dataset[45], dataset.reader.get_item(45)
    assert not set(CAMERAS) & sample.keys()
    assert set(policy.config.image_features) == set(CAMERAS)
    for key in sample.keys() & lerobots.keys():
        assert sample[key] == lerobots[key] if key == "task" else torch.equal(sample[key], lerobots[key]), key
    batch = before(batch_of(dataset, [45, 50]))
    assert all(batch[encoded_key(camera)].shape == (2, GRID**2, WIDTH) for camera in CAMERAS)
    assert batch[FRAMES].shape[1:] == (POOLED**2, WIDTH)
    assert len(batch[FRAMES]) < (batch[PLACES] >= 0).sum(), "moments of an episode share frames"


# -- training and rollouts see alike -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields", [{"align": "framewise"}, {"memory_fusion": "context"}, {"memory_fusion": "none"}], ids=str
)
def test_every_kind_trains_and_the_tower_does_not(
    root: Path, encoder_fields: dict[str, Any], fields: dict[str, Any]
) -> None:
    policy, before, _, dataset = made_for_training(root, **encoder_fields | fields)
    policy.train().forward(before(batch_of(dataset, [10, 30, 50, 80])))[0].backward()
    learning = {id(parameter) for parameter in policy.get_optim_params()}
    assert not any(id(parameter) in learning for parameter in policy.perception.tower.parameters())
    assert all(parameter.grad is not None for parameter in policy.model.memory_parameters().values())
    assert policy.perception.project.weight.grad.any()
    assert not policy.perception.tower.training


# -- checkpoints ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(
    root: Path, encoder_fields: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Any, Any, Any, Path]:
    """A policy whose encoder's file is gone since, as they are where a checkpoint is taken to."""
    folder = tmp_path_factory.mktemp("checkpoint")
    file = shutil.copy(encoder_fields["visual_encoder"], folder / "detector.safetensors")
    policy, before, after, dataset = made_for_training(root, **encoder_fields | {"visual_encoder": str(file)})
    policy.train().forward(before(batch_of(dataset, [10, 30])))
    for part in (policy, before, after):
        part.save_pretrained(folder / "pretrained_model")
    Path(file).unlink()
    return policy, before, dataset, folder / "pretrained_model"


def test_training_resumes_with_the_encoder_of_the_checkpoint(
    saved: tuple[Any, ...], root: Path, encoded: list[int]
) -> None:
    config = PreTrainedConfig.from_pretrained(saved[3])
    config.pretrained_path = saved[3]
    again = open_small_training(root, config)
    again.policy.train().forward(again.processors[0](batch_of(again.samples(), [10, 60])))[0].backward()
    assert encoded == [], "its caches are found by its tower"


def test_another_encoder_than_a_checkpoint_was_trained_with_is_refused(saved: tuple[Any, ...], detector: Path) -> None:
    folder = saved[3]
    for other in (str(detector), "package"):
        config = PreTrainedConfig.from_pretrained(folder, cli_overrides=[f"--visual_encoder={other}"])
        with pytest.raises(MemobenchError, match=r"was trained with.*holds it; leave visual_encoder out"):
            MemobenchMemPolicy.from_pretrained(folder, config=config)
