"""What a rollout sees of the synthetic dataset's videos, beside what training reads; shared by tests of detector."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_STATE

from lerobot_memobench.datasets.feature_cache.frames import frame_reader
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.perception.weights import save_detector
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MASK, STEPS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from research.detector.labels import kinds
from tests.support.small_policy import batch_of, made_for_training
from tests.support.synthetic_dataset import LENGTHS

CAMERAS = ("observation.images.image", "observation.images.wrist_image")
STARTS = np.cumsum([0, *LENGTHS])
"""First frames of the episodes."""


def made_detector(path: Path, seed: int) -> Path:
    """Write detector that find something everywhere."""
    torch.manual_seed(seed)
    detector = Detector(VisualEncoder().eval(), kinds())
    torch.nn.init.zeros_(detector.fine_heads.heatmap.bias)
    save_detector(detector, path)
    return path


def pictures_of(root: Path, index: int) -> dict[str, torch.Tensor]:
    """Return both cameras' pictures of a frame, (1, 3, H, W), as the videos show it."""
    episode = int(np.searchsorted(STARTS, index, "right")) - 1
    return {camera: frame_reader(root, camera)(episode, [int(index - STARTS[episode])]) for camera in CAMERAS}


def observed(root: Path, dataset: Any, index: int) -> dict[str, Any]:
    """Return a rollout's observation at a frame."""
    step = float(index - STARTS[int(np.searchsorted(STARTS, index, "right")) - 1])
    clock = {"observation.step": torch.tensor([step]), "observation.phase": torch.ones(1)}
    state = {OBS_STATE: dataset.hf_dataset[index][OBS_STATE][None]}
    return {**pictures_of(root, index), **state, **clock, "task": [dataset[index]["task"]]}


def trained_and_acted(root: Path, made: tuple[Any, ...]) -> tuple[dict[str, Any], dict[str, Any], torch.Tensor]:
    """Return the batch that training reads at a frame, the one of a rollout there, and what that remembers by then.

    It remembers the same steps.
    """
    policy, before, _, dataset = made
    index = int(STARTS[1]) + 14
    trained = before(batch_of(dataset, [index]))
    for frame in range(int(STARTS[1]), index + 1):
        acted = before(observed(root, dataset, frame))
        policy.observe(acted)
    tokens, steps, mask = policy.history.gather([0])
    assert torch.equal(steps, trained[STEPS])
    assert torch.equal(mask, trained[MASK])
    return trained, acted, tokens


def acts_as_its_checkpoint(root: Path, policy: Any, before: Any, dataset: Any, folder: Path) -> None:
    """Compare what a policy and its checkpoint in a folder do."""
    again = MemobenchMemPolicy.from_pretrained(folder)
    pre, _ = make_pre_post_processors(again.config, pretrained_path=str(folder))
    assert again.perception.key == policy.perception.key
    actions: list[list[torch.Tensor]] = []
    for actor, step in ((policy, before), (again, pre)):
        actor.reset()
        actions.append([actor.select_action(step(observed(root, dataset, index))) for index in range(4)])
    assert all(torch.allclose(one, other, atol=1e-6) for one, other in zip(*actions, strict=True))
    assert actions[0][-1].any()


def refuses_pictures_in_a_batch(root: Path, settings: dict[str, Any]) -> None:
    """As LeRobot's loader processes make them, which know nothing of what was seen."""
    policy, before, _, dataset = made_for_training(root, **settings)
    batch = before(torch.utils.data.default_collate([DatasetReader.get_item.__wrapped__(dataset.reader, 45)]))
    with pytest.raises(MemobenchError, match=r"has pictures, which this policy does not read.*--num_workers=0"):
        policy.train().forward(batch)
