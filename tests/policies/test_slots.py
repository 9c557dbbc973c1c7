"""Slots as tokens: geometry, absence, and what is pooled of a remembered frame."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lerobot_memobench.policies.memobench_mem.memory.encoder import MemoryEncoder, PooledMemoryEncoder
from lerobot_memobench.policies.memobench_mem.objects import (
    FEATURES,
    OBS_RAW_STATE,
    ObjectEncoder,
    ObjectPool,
    SlotEncoder,
    frame_row,
    rotation,
    slot_features,
)
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.sim.object_slots import classes
from tests.support.object_dataset import slots_at, state_at

KINDS = len(classes())
PLACES = np.array([[0.0, 0.1, 0.9], [0.1, -0.1, 0.95], [-0.1, 0.0, 1.0]])


def seen(places: np.ndarray = PLACES, lit: int | None = None, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(slots_at(np.random.default_rng(seed), places, lit))


def hand(place: tuple[float, float, float] = (0.0, 0.0, 1.1)) -> torch.Tensor:
    return torch.from_numpy(state_at(np.array(place)))


def test_rotations_are_scipys() -> None:
    turns = np.random.default_rng(1).normal(size=(20, 3)) * 2
    expected = torch.from_numpy(Rotation.from_rotvec(turns).as_matrix()).float()
    assert torch.allclose(rotation(torch.from_numpy(turns).float()), expected, atol=1e-5)
    assert torch.equal(rotation(torch.zeros(1, 3))[0], torch.eye(3))


def test_what_is_told_from_the_hand_moves_and_turns_with_it() -> None:
    """Turned and moved together, hand and thing stay the same to each other; what is told of the world changes."""
    turn = Rotation.from_rotvec([0.2, -0.3, 1.0])
    pose = Rotation.from_rotvec([3.0, 0.3, 0.1])
    thing = seen().reshape(SLOTS, WIDTH)[1:2].double()
    start = torch.tensor([[0.02, -0.08, 0.97, *pose.as_rotvec()]])
    moved, gone = thing.clone(), np.array([0.1, 0.2, -0.1])
    for first in (2, 5, 8):
        shift = gone if first == 2 else 0.0
        moved[0, first : first + 3] = torch.from_numpy(turn.apply(thing[0, first : first + 3].numpy()) + shift)
    end = torch.tensor([[*(turn.apply(start[0, :3].numpy()) + gone), *(turn * pose).as_rotvec()]])
    before, after = slot_features(thing.float(), start.float()), slot_features(moved.float(), end.float())
    assert before.shape == (1, FEATURES)
    own = [*range(12, 18), *range(24, 30)]  # near, in the hand's frame; axes in the hand's frame
    assert torch.allclose(before[:, own], after[:, own], atol=1e-4)
    assert (before[:, :12] - after[:, :12]).abs().max() > 0.1


def test_a_millimetre_beside_the_hand_is_seen() -> None:
    """Through the whole of memory, where bfloat16 would hold places to 4 mm."""
    perception = ObjectEncoder(classes(), 2, 32)
    memory = perception.memory(torch.nn.Identity())
    assert isinstance(memory, PooledMemoryEncoder)
    moved = PLACES + np.array([0.001, 0, 0])
    rows = [
        perception.remember({"observation.environment_state": one[None], OBS_RAW_STATE: hand()[None]}, [0])
        for one in (seen(), seen(moved))
    ]
    assert rows[0].dtype == torch.float32
    assert (rows[0] - rows[1]).abs().max() > 0.0009
    assert not torch.equal(memory.pool(rows[0][:, 0]), memory.pool(rows[1][:, 0]))


def test_an_empty_slot_is_no_token_whatever_it_holds() -> None:
    perception = ObjectEncoder(classes(), 2, 32).eval()  # in training empty slots are left out
    noisy = seen().clone().reshape(SLOTS, WIDTH)
    noisy[3:, 1:] = 7.0
    both = torch.stack([seen(), noisy.reshape(-1)])
    batch = {"observation.environment_state": both, OBS_RAW_STATE: hand().expand(2, -1)}
    (part,), (mask,) = perception.present(batch)
    tokens = perception.prefix(part)
    assert mask.tolist() == [[True] * 3 + [False] * (SLOTS - 3)] * 2
    assert torch.equal(tokens[0], tokens[1])
    assert not tokens[0, 3:].any()
    assert tokens[0, :3].abs().sum(dim=1).min() > 0
    pool = ObjectPool(perception.order, perception.kinds, 2, 32)
    pooled = pool(perception.remember(batch, [0, 1])[:, 0])
    assert torch.allclose(pooled[0], pooled[1], rtol=0, atol=1e-6), "the size of a token is rounded"
    nothing = pool(frame_row(torch.zeros(1, SIZE), hand()[None], torch.ones(1))[:, 0])
    assert nothing.isfinite().all()


def test_frames_are_pooled_whatever_the_order_of_their_things() -> None:
    pool = ObjectPool(range(KINDS), KINDS + 1, 2, 32)
    slots = seen(lit=1).reshape(SLOTS, WIDTH)
    rows = torch.stack([slots, slots[torch.randperm(SLOTS)]]).reshape(2, SIZE)
    pooled = pool(frame_row(rows, hand().expand(2, -1), torch.ones(2))[:, 0])
    assert torch.allclose(pooled[0], pooled[1], atol=1e-6)
    unlit = pool(frame_row(seen()[None], hand()[None], torch.ones(1))[:, 0])
    prompt = pool(frame_row(seen(lit=1)[None], hand()[None], torch.zeros(1))[:, 0])
    assert (pooled[0] - unlit[0]).abs().max() > 1e-4, "the highlight is seen"
    assert (pooled[0] - prompt[0]).abs().max() > 1e-4, "so is the phase"


def test_a_frame_that_many_read_is_encoded_once() -> None:
    class Counting(ObjectPool):
        count = 0

        def forward(self, frames: torch.Tensor) -> torch.Tensor:
            Counting.count += len(frames)
            return super().forward(frames)

    class Pass(torch.nn.Module):
        def forward(self, tokens: torch.Tensor, steps: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return tokens, mask

    memory = PooledMemoryEncoder(Counting(range(KINDS), KINDS + 1, 2, 16), Pass())
    stored = torch.cat([frame_row(seen(seed=n)[None], hand()[None], torch.ones(1)) for n in range(5)])
    numbers = torch.tensor([[0, 1, 2, 3], [0, 2, 4, -1]])
    frames = stored[numbers] * (numbers >= 0)[..., None, None]
    mask = numbers >= 0
    alone, _ = memory(frames, numbers, mask)
    assert Counting.count == 8
    Counting.count = 0
    shared = memory.shared(frames, numbers, mask, numbers)
    assert Counting.count == 6  # five frames, and the one that is none
    assert torch.allclose(alone, shared.rows(), atol=1e-6)


def test_a_frame_that_many_read_has_its_time_and_is_told_it_once() -> None:
    class Counting(MemoryEncoder):
        count = 0

        def forward(self, tokens: torch.Tensor, *rest: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            Counting.count += tokens.shape[0] * tokens.shape[1]
            return super().forward(tokens, *rest)

    memory = PooledMemoryEncoder(ObjectPool(range(KINDS), KINDS + 1, 2, 16), Counting(16, 24, grid=0))
    stored = torch.cat([frame_row(seen(seed=n)[None], hand()[None], torch.ones(1)) for n in range(5)])
    numbers = torch.tensor([[10, 11, 13, 14], [10, 12, -1, -1]])
    mask, steps = numbers >= 0, (numbers - 10).clamp(min=0) * 8
    frames = stored[(numbers - 10).clamp(min=0)] * mask[..., None, None]
    alone, real = memory(frames, steps, mask)
    assert Counting.count == 8
    Counting.count = 0
    shared = memory.shared(frames, steps, mask, numbers)
    assert Counting.count == 6
    assert torch.equal(real, shared.mask)
    assert torch.allclose(alone, shared.rows(), atol=1e-6)


def test_classes_keep_their_meaning_when_others_come() -> None:
    """A policy knows the classes it was trained with by name; one it does not know is another, not its neighbour."""
    trained = [name for name in classes() if name != classes()[2]]
    perception = ObjectEncoder(trained, 2, 16)
    assert [perception.order[classes().index(name)] for name in trained] == list(range(len(trained)))
    assert perception.order[2] == len(trained)
    encoder = SlotEncoder(perception.order, perception.kinds, 8, 16)
    assert encoder.kind.num_embeddings == len(trained) + 1


def test_which_thing_was_lit_can_be_learned() -> None:
    """A scene in which nothing is lit now, remembered after frames in which one thing was: where is that one?"""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    memory = PooledMemoryEncoder(ObjectPool(range(KINDS), KINDS + 1, 2, 32), MemoryEncoder(32, 32, grid=0))
    head = torch.nn.Linear(32, 2)
    optimizer = torch.optim.Adam([*memory.parameters(), *head.parameters()], lr=3e-3)
    steps, real, losses = torch.arange(2).expand(32, 2), torch.ones(32, 2, dtype=torch.bool), []
    for _ in range(150):
        places, lit = rng.uniform(-0.3, 0.3, (32, 3, 3)) + np.array([0, 0, 0.9]), rng.integers(3, size=32)
        shown = [slots_at(rng, here, which) for here, thing in zip(places, lit, strict=True) for which in (thing, None)]
        rows = frame_row(torch.from_numpy(np.stack(shown)), hand().expand(64, -1), torch.tensor([0.0, 1.0] * 32))
        tokens, _ = memory(rows.unflatten(0, (32, 2)), steps, real)
        wanted = torch.from_numpy(places[np.arange(32), lit, :2]).float() / 0.17
        loss = (head(tokens.mean(dim=1)) - wanted).square().mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-20:]) < 0.3 * np.mean(losses[:10]), "guessing keeps the whole variance"
