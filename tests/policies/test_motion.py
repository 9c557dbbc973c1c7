"""Memory of motion: block matching, displacements of objects, hindsight, and foresight in the expert."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    AHEAD,
    PLACES,
    Histories,
    MemorySpec,
    NoSettings,
)
from lerobot_memobench.policies.memobench_mem.memory.motion import (
    BLOCK,
    BLOCKS,
    FORESIGHT,
    FORESIGHT_WEIGHT,
    HINDSIGHT,
    MOVED,
    OFFSETS,
    PER_STEP,
    REACH,
    UNCHANGED,
    ImageMotion,
    Motion,
    ObjectMotion,
    match_blocks,
)
from lerobot_memobench.policies.memobench_mem.objects import frame_row
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.sim.object_layout import SLOTS, WIDTH
from tests.support.small_policy import batch_of, made_for_training

# -- images ---------------------------------------------------------------------------------------------------------


def matched_slowly(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Match block by block and offset by offset."""
    around, found = np.pad(before, REACH, mode="edge"), np.zeros((BLOCKS, BLOCKS, 2))
    for row in range(BLOCKS):
        for column in range(BLOCKS):
            top, left = BLOCK * row, BLOCK * column
            block = now[top : top + BLOCK, left : left + BLOCK]
            if np.abs(block - before[top : top + BLOCK, left : left + BLOCK]).mean() <= UNCHANGED:
                continue
            costs = []
            for y, x in OFFSETS:
                first, second = top + REACH + y, left + REACH + x
                costs.append(np.abs(block - around[first : first + BLOCK, second : second + BLOCK]).sum())
            y, x = OFFSETS[int(np.argmin(costs))]
            found[row, column] = -x, -y
    return found


def test_blocks_equal_a_slow_search() -> None:
    chance = np.random.default_rng(0)
    before = np.kron(chance.integers(0, 256, (3, 22, 22)), np.ones((3, 3)))[:, :THUMBNAIL, :THUMBNAIL]
    ways = ((1, -2), (0, 4), (5, 0))
    now = np.stack([np.roll(image, by, (0, 1)) for image, by in zip(before, ways, strict=True)])
    now[:, :30] = before[:, :30]  # half of the image does not move
    now[:, :30] += chance.integers(0, 3, now[:, :30].shape)
    found = match_blocks(torch.tensor(before), torch.tensor(now))
    np.testing.assert_array_equal(found, [matched_slowly(*pair) for pair in zip(before, now, strict=True)])
    assert not found[:, :7].any()
    assert (found[0, 9:15, 2:14] == torch.tensor([-2.0, 1.0])).all()
    assert (found[1, 9:15, 2:14] == torch.tensor([4.0, 0.0])).all()


# -- objects ----------------------------------------------------------------------------------------------------------


def stored(*frames: list[tuple[float, ...]], hand: float = 0.0) -> Tensor:
    """Return stored frames (n, 1, D') of things: class, x, joint and optionally y."""
    slots = torch.zeros(len(frames), SLOTS, WIDTH)
    for slot, things in zip(slots, frames, strict=True):
        for row, (kind, x, joint, *y) in enumerate(sorted(things)):
            slot[row, [0, 1, 2, 3, 11]] = torch.tensor([1.0, kind, x, *(y or [0.0]), joint])
    state = torch.zeros(len(frames), 8)
    state[:, 1] = torch.arange(len(frames)) * hand
    return frame_row(slots.flatten(1), state, torch.ones(len(frames)))


def field_of_objects() -> ObjectMotion:
    torch.manual_seed(0)
    return ObjectMotion(list(range(100)), 100, 32, HINDSIGHT).eval()


def moved(field: Tensor) -> Tensor:
    """Return displacement along x, change of the joint, and whether it is known, for each cell."""
    return torch.stack([field[..., 0] / PER_STEP, field[..., 3] / PER_STEP, field[..., MOVED]], dim=-1)


def test_frames_of_a_batch_may_be_strided() -> None:
    """Those of a training are slices of longer histories."""
    field, frames = ImageMotion(16, 8), torch.randint(0, 255, (3, 4, THUMBNAIL**2), dtype=torch.uint8)
    strided = frames[:, :2].transpose(0, 1)
    assert torch.equal(field.between(strided, strided), field.between(strided.contiguous(), strided.contiguous()))
    assert field.following(frames)[0].shape == (3, 3, BLOCKS**2, 2)


def test_things_are_matched_by_class_and_place() -> None:
    """A drawer opens, a bowl disappears, two cups move, and a third cup appears."""
    before, now = stored(
        [(0, 0.0, 0.1), (3, 0.0, 0.0), (5, 0.0, 0.0), (5, 0.3, 0.0)],
        [(0, 0.02, 0.15), (5, -0.1, 0.0), (5, 0.01, 0.0), (5, 0.31, 0.0)],
        hand=0.03,
    ).split(1)
    field = field_of_objects().between(before, now)[0]
    expected = [[0.02, 0.05, 1], [0, 0, 0], [0.01, 0, 1], [0.01, 0, 1]]
    torch.testing.assert_close(moved(field[:4]), torch.tensor(expected))
    assert not field[4:-1, : MOVED + 1].any()
    torch.testing.assert_close(field[-1, :5], torch.tensor([0, 0.03 * PER_STEP, 0, 0, 1]))


# -- hindsight --------------------------------------------------------------------------------------------------------


def hindsight() -> Motion:
    spec = MemorySpec(dim=32, tokens=2, width=32, expert=32, grid=0, stride=1)
    return Motion(spec, field_of_objects(), NoSettings()).eval()


def walked(steps: int) -> Tensor:
    """Return stored frames of an accelerating cup."""
    return stored(*([(5, 0.001 * step * step, 0.0)] for step in range(steps)))


def written(memory: Motion, frames: Tensor) -> dict[str, Tensor]:
    state = memory.init(1)
    for step, frame in enumerate(frames.split(1)):
        state = memory.observe(state, frame, torch.tensor([step]))
    return state


@pytest.mark.parametrize(
    ("frames", "kept"), [(1, [0] * 8), (3, [1] * 7 + [3]), (9, range(1, 16, 2)), (12, range(7, 22, 2))]
)
def test_last_eight_motions_are_kept(frames: int, kept: Sequence[int]) -> None:
    motions = written(hindsight(), walked(frames))["motions"][0, :, 0, 0]
    torch.testing.assert_close(motions / PER_STEP, torch.tensor([*kept]) * 0.001)


# -- foresight --------------------------------------------------------------------------------------------------------


def test_following_frames_are_loaded_within_the_episode() -> None:
    class Cache:
        """A `FrameLookup` of two episodes."""

        encoded: dict[str, Any] = {}
        columns = encoded
        episodes, phase, texts, stride = np.array([0, 41, 60]), np.ones(60), (), 4

        def locate(self, index: int) -> tuple[int, int]:
            return (0, index) if index < 41 else (1, index - 41)

        def tokens(self, number: int, slots: list[int]) -> Tensor:
            return torch.tensor([[[100.0 * number + slot]] for slot in slots])

    step = GatherMemoryProcessorStep(config=MemobenchMemConfig(device="cpu", memory="motion", memory_stride=4))
    found = step.gather(Cache(), [21, 60 - 1])  # type: ignore[arg-type]
    frames = found["memory.frames"].flatten()
    assert [frames[row[row >= 0]].tolist() for row in found[PLACES]] == [[*range(6)], [*range(100, 105)]]
    assert [frames[row[row >= 0]].tolist() for row in found[AHEAD]] == [[*range(6, 11)], []]
    assert found[AHEAD].shape == (2, FORESIGHT)


def test_loss_counts_known_following_motions() -> None:
    memory, frames = hindsight(), walked(12)
    places = torch.tensor([[0, 1, 2, -1], [8, 9, 10, 11], [7, 8, 9, 10]])
    ahead = torch.full((3, FORESIGHT), -1)
    ahead[0], ahead[2, 0] = torch.arange(3, 11), 11
    memory.replay(Histories(frames, torch.arange(12), places, None, ahead))
    foreseen = torch.randn(3, FORESIGHT, memory.field.cells, MOVED)
    (loss,) = memory.losses({"memory.foreseen": foreseen.flatten(2)}).values()
    truth = torch.zeros(2, FORESIGHT, 2, MOVED)  # of the cup, and of the hand, which does not move
    truth[0, :, 0, 0], truth[1, 0, 0, 0] = 0.001 * PER_STEP * (2 * torch.arange(2, 10) + 1), 0.021 * PER_STEP
    errors = (foreseen[[0, 2]][:, :, [0, -1]] - truth).abs()
    expected = [errors[0].mean(), 0, errors[1, 0].mean()]
    torch.testing.assert_close(loss, FORESIGHT_WEIGHT * torch.tensor(expected))
    assert not memory.losses({"memory.foreseen": foreseen.flatten(2)})


@pytest.fixture(scope="module")
def trained(root: Path) -> tuple[Any, dict[str, Any]]:
    """A small policy of objects, and a preprocessed training batch."""
    fields = {"size": "small", "perception": "objects", "memory": "motion"}
    policy, before, _, dataset = made_for_training(root, **fields)
    return policy, before(batch_of(dataset, [10, 30, 39, 50]))


def test_hindsight_has_no_effect_before_training(trained: tuple[Any, dict[str, Any]]) -> None:
    policy, batch = trained
    assert policy.config.memory_stride == 1
    alone = {**batch, PLACES: batch[PLACES][:, :1]}

    def losses() -> list[float]:
        policy.eval()
        with torch.no_grad():
            return [policy.forward(given)[1]["action_loss"] for given in (batch, alone)]

    one, other = losses()
    assert one == pytest.approx(other)
    policy.train()
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3)
    foreseen = []
    for _ in range(6):
        loss, logged = policy.forward(batch)
        foreseen.append(logged["memory_foresight_loss"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert foreseen[-1] < 0.97 * foreseen[0]
    learned = policy.model.memory_parameters().items()
    still = [name for name, weights in learned if weights.grad is None or not weights.grad.any()]
    unseen = "memory.pool.score.bias"  # softmax is invariant to it
    assert not [name for name in still if name.startswith(("memory.", "foresight.")) and name != unseen]
    one, other = losses()
    assert one != pytest.approx(other)


def test_motion_of_images_is_aligned(dataset_root: Path) -> None:
    """Gradients of its convolutions are not contiguous."""
    policy, before, _, dataset = made_for_training(dataset_root, size="small", memory="motion", align="contrastive")
    _, logged = policy.train()(before(batch_of(dataset, [5, 9, 12, 15])))
    assert logged["align_grad_norm"] > 0
