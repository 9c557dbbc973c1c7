"""Detections in pictures: settings, caches, samples, rollouts, and policies that never saw a picture."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from safetensors.torch import load_file

from lerobot_memobench.envs.observations import obs_type_of
from lerobot_memobench.envs.settings import PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import DETECTED, VIEWS
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.training.data import open_datasets, open_training
from lerobot_memobench.training.features import FOLDER, TOKENS, cache_dataset, episode_file
from tests.support.object_dataset import make_object_dataset
from tests.support.picture_rollouts import (
    made_detector,
    observed,
    pictures_of,
)
from tests.support.small_policy import batch_of, made_for_training, small_config, train_config
from tests.support.synthetic_dataset import CAMERAS, LENGTHS, make_dataset

ROUNDED = 2**-15
"""What two bfloat16 numbers leave of one, as a share of it."""


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_detector(tmp_path_factory.mktemp("detector") / "detector.safetensors", 1)


@pytest.fixture(scope="module")
def finding(detector: Path) -> dict[str, Any]:
    return {
        "perception": "objects",
        "size": "small",
        "detector": str(detector),
        "n_action_steps": 3,
        "memory_stride": 2,
    }


@pytest.fixture(scope="module")
def root(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, in which nothing says what objects there are."""
    to = tmp_path_factory.mktemp("seen") / "data"
    return shutil.copytree(dataset_root, to, ignore=shutil.ignore_patterns(FOLDER))


# -- settings ------------------------------------------------------------------------------------------------------


def test_objects_are_detected_where_a_detector_is_named(tmp_path: Path) -> None:
    told = MemobenchMemConfig(device="cpu", size="small", perception="objects")
    found = MemobenchMemConfig(device="cpu", size="small", perception="objects", detector="package")
    for config, finds in ((told, False), (found, True)):
        assert (config.uses_detector, config.uses_pictures, config.encodes_ahead) == (finds,) * 3
        assert not config.uses_visual_encoder
        assert (config.memory_stride, config.frames_per_episode, config.tokens_per_frame) == (8, 6, 2)
    assert obs_type_of(found) == PIXELS
    assert obs_type_of(told) != PIXELS
    found.save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).uses_detector
    with pytest.raises(MemobenchError, match=r"detector=random .*name package or a file"):
        MemobenchMemConfig(device="cpu", size="small", perception="objects", detector="random")


def test_a_file_that_holds_no_detector_is_refused(root: Path, finding: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"there is no file.*python -m research.detector train"):
        made_for_training(root, **finding | {"detector": str(tmp_path / "absent")})
    with pytest.raises(MemobenchError, match="or name a detector"):
        cache_dataset(root, small_config(size="small", perception="objects"))


# -- caches and samples --------------------------------------------------------------------------------------------


def test_detections_are_kept_for_every_frame(
    root: Path, finding: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cache_dataset(root, small_config(**finding))
    kept = [load_file(episode_file(folder, number))[TOKENS] for number in range(len(LENGTHS))]
    assert [tuple(one.shape) for one in kept] == [(length, 2, SIZE) for length in LENGTHS]

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a video was opened")

    with monkeypatch.context() as patched:
        patched.setattr("lerobot.datasets.dataset_reader.decode_video_frames", refuse)
        policy, before, _, dataset = made_for_training(root, **finding)
        assert set(policy.config.input_features) == {OBS_STATE, *VIEWS}
        batch = before(batch_of(dataset, [45, 50]))
    seen = [policy.perception.detect(pictures_of(root, index), batch["observation.raw_state"][row : row + 1])
            for row, index in enumerate((45, 50))]  # fmt: skip
    truth = torch.cat(seen)
    assert truth.any()
    assert torch.allclose(batch[DETECTED], truth, rtol=ROUNDED, atol=1e-7)
    assert not torch.equal(seen[0], seen[1])
    assert len(batch[FRAMES]) < (batch[PLACES] >= 0).sum(), "moments of an episode share frames"


@pytest.mark.slow
def test_detections_are_of_the_cameras_by_their_names_in_the_dataset(
    root: Path, finding: dict[str, Any], tmp_path: Path
) -> None:
    names = ("observation.front", "observation.hand")
    other = make_dataset(tmp_path / "other", cameras=names)
    config = train_config(other, small_config(**finding), rename_map=dict(zip(names, CAMERAS, strict=True)))
    open_training(config, open_datasets(config))
    (named_otherwise,) = (other / FOLDER).iterdir()
    folder = cache_dataset(root, small_config(**finding))
    for number in range(len(LENGTHS)):
        assert episode_file(named_otherwise, number).read_bytes() == episode_file(folder, number).read_bytes()


def test_a_dataset_without_pictures_is_refused(finding: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="holds no pictures, which a detector and perception=pixels need"):
        made_for_training(make_object_dataset(tmp_path / "blind"), **finding)


def test_a_dataset_with_one_camera_is_refused(finding: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"no camera 'observation\.images\.wrist_image'"):
        made_for_training(make_object_dataset(tmp_path / "filmed", pictures=True), **finding)


# -- policies that were trained on what the environment tells ------------------------------------------------------


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint that has never seen a picture."""
    folder = tmp_path_factory.mktemp("blind")
    data = make_object_dataset(folder / "data")
    fields = {"perception": "objects", "size": "small", "n_action_steps": 3, "memory_stride": 2}
    policy, before, after, _ = made_for_training(data, **fields)
    for part in (policy, before, after):
        part.save_pretrained(folder / "checkpoint")
    return folder / "checkpoint"


def loaded(checkpoint: Path, *overrides: str) -> tuple[MemobenchMemPolicy, Any]:
    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=list(overrides))
    policy = MemobenchMemPolicy.from_pretrained(checkpoint, config=config)
    before, _ = make_pre_post_processors(policy.config, str(checkpoint))
    return policy, before


def test_they_act_from_pictures_as_from_what_is_found_in_them(
    blind: Path, detector: Path, root: Path, finding: dict[str, Any]
) -> None:
    _, _, _, dataset = made_for_training(root, **finding)
    given, told = loaded(blind)
    finds, seeing = loaded(blind, f"--detector={detector}")
    assert set(finds.config.image_features) == {*VIEWS}
    for frame in range(8):
        batch = observed(root, dataset, frame)
        slots = finds.perception.detect(batch, batch[OBS_STATE])
        objects = {key: value for key, value in batch.items() if key not in VIEWS} | {OBS_ENV_STATE: slots}
        assert torch.equal(given.select_action(told(objects)), finds.select_action(seeing(batch)))
    with pytest.raises(MemobenchError, match=r"no 'observation\.images\.wrist_image', which the detector reads"):
        finds.perception.detect({next(iter(VIEWS)): torch.zeros(1, 3, 48, 48)}, torch.zeros(1, 8))


def test_what_the_environment_tells_is_not_looked_at(blind: Path, detector: Path, root: Path) -> None:
    finds, before = loaded(blind, f"--detector={detector}")
    batch = {**pictures_of(root, 3), OBS_STATE: torch.zeros(1, 8), "task": ["put"], "observation.step": torch.zeros(1)}
    batch["observation.phase"] = torch.ones(1)
    found = []
    for slots in (torch.zeros(1, SIZE), torch.ones(1, SIZE)):
        finds.reset()
        found.append(finds.select_action(before(batch | {OBS_ENV_STATE: slots})))
    assert torch.equal(*found)


def test_a_checkpoint_names_its_detector_and_takes_others(
    root: Path, finding: dict[str, Any], detector: Path, tmp_path: Path
) -> None:
    policy, before, after, _ = made_for_training(root, **finding)
    for part in (policy, before, after):
        part.save_pretrained(tmp_path / "checkpoint")
    told, _ = loaded(tmp_path / "checkpoint")
    assert told.config.detector == str(detector)
    assert told.state_dict().keys() == policy.state_dict().keys()
    assert not any("tower" in name for name in told.state_dict())
    others, _ = loaded(tmp_path / "checkpoint", f"--detector={made_detector(tmp_path / 'others.safetensors', 2)}")
    assert others.perception.key != told.perception.key
