"""Memory of motion: block matching, displacements of objects, hindsight, and foresight in the expert."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.encoders import THUMBNAIL
from lerobot_memobench.policies.memobench_mem.memory.mechanism import PLACES
from lerobot_memobench.policies.memobench_mem.memory.motion import (
    BLOCK,
    BLOCKS,
    HINDSIGHT,
    MOVED,
    OFFSETS,
    PER_STEP,
    REACH,
    UNCHANGED,
    ObjectMotion,
    match_blocks,
)
from lerobot_memobench.policies.memobench_mem.objects import frame_row
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


def stored(*frames: list[tuple[float, ...]]) -> Tensor:
    """Return stored frames (n, 1, D') of things (class, x, joint), and of a hand that moves by 0.03 m."""
    slots = torch.zeros(len(frames), SLOTS, WIDTH)
    for slot, things in zip(slots, frames, strict=True):
        for row, (kind, x, joint) in enumerate(sorted(things)):
            slot[row, [0, 1, 2, 11]] = torch.tensor([1.0, kind, x, joint])
    state = torch.zeros(len(frames), 8)
    state[:, 1] = torch.arange(len(frames)) * 0.03
    return frame_row(slots.flatten(1), state, torch.ones(len(frames)))


def test_things_are_matched_by_class_and_place() -> None:
    """A drawer opens, a bowl disappears, two cups move, and a third cup appears."""
    before, now = stored(
        [(0, 0.0, 0.1), (3, 0.0, 0.0), (5, 0.0, 0.0), (5, 0.3, 0.0)],
        [(0, 0.02, 0.15), (5, -0.1, 0.0), (5, 0.01, 0.0), (5, 0.31, 0.0)],
    ).split(1)
    field = ObjectMotion(list(range(100)), 100, 32, HINDSIGHT).between(before, now)[0]
    found = torch.stack([field[:4, 0] / PER_STEP, field[:4, 3] / PER_STEP, field[:4, MOVED]], dim=-1)
    torch.testing.assert_close(found, torch.tensor([[0.02, 0.05, 1], [0, 0, 0], [0.01, 0, 1], [0.01, 0, 1]]))
    assert not field[4:-1, : MOVED + 1].any()
    torch.testing.assert_close(field[-1, :5], torch.tensor([0, 0.03 * PER_STEP, 0, 0, 1]))


# -- hindsight and foresight ------------------------------------------------------------------------------------------


def test_hindsight_has_no_effect_before_training(root: Path) -> None:
    policy, before, _, dataset = made_for_training(root, size="small", perception="objects", memory="motion")
    batch = before(batch_of(dataset, [10, 30, 39, 50]))
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
