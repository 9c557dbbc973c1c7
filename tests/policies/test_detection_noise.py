"""Detection noise: its sizes, and that it is added in training only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_memobench.policies.memobench_mem import objects
from lerobot_memobench.policies.memobench_mem.detection_noise import (
    FALSE,
    KIND_MISSED,
    MISSED,
    with_detection_noise,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import EXACT, FRAMES
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE, ObjectEncoder
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes, fill_slots
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import batch_of, made_for_training

KIND = {name: classes().index(name) for name in ("butter", "akita_black_bowl", "drawer", "plate", "milk")}
LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def thing(name: str, place: tuple[float, float, float], axes: tuple[float, ...] = LEVEL) -> list[float]:
    return [1.0, KIND[name], *place, *axes, 0.0, 0.0]


def scene(*things: list[float]) -> torch.Tensor:
    return torch.from_numpy(fill_slots(np.array(things))).reshape(1, SLOTS, WIDTH)


TABLE = scene(
    thing("butter", (0.0, 0.1, 0.9)),
    thing("akita_black_bowl", (0.1, -0.1, 0.9)),
    thing("milk", (-0.1, 0.2, 0.95)),
    thing("plate", (0.05, 0.25, 0.9)),
)
FAR = torch.tensor([[0.0, -0.5, 1.3, 0.0, 0.0, 0.0]])


def many(slots: torch.Tensor, hand: torch.Tensor, size: float = 1.0) -> torch.Tensor:
    """Return the noisy slots of a scene in 150 batches of 24."""
    torch.manual_seed(3)
    return torch.cat([with_detection_noise(slots.expand(24, -1, -1), hand.expand(24, -1), size) for _ in range(150)])


def errors(seen: torch.Tensor, slots: torch.Tensor) -> torch.Tensor:
    """Return the errors of places of things, m, up to 5 cm."""
    there = field(seen, "present").squeeze(-1) > 0
    kinds, places = field(seen, "class").squeeze(-1)[there], field(seen, "position")[there]
    real = slots[field(slots, "present").squeeze(-1) > 0]
    found = torch.cat([(places[kinds == one[1]] - one[2:5]).norm(dim=1) for one in real])
    return found[found < 0.05]


def test_size_zero_changes_nothing() -> None:
    assert torch.equal(with_detection_noise(TABLE, FAR, 0.0), TABLE)


def test_errors_have_the_measured_sizes() -> None:
    """Median and 90th percentile of 1.6 and 8 mm; 99 of 100 things are found."""
    seen = many(TABLE, FAR)
    median, ninetieth = np.percentile(errors(seen, TABLE), [50, 90])
    assert 0.0013 < median < 0.0025
    assert 0.005 < ninetieth < 0.01
    there = field(seen, "present") > 0
    found = there.sum() / len(seen) - FALSE
    assert found / 4 == pytest.approx(1 - MISSED - KIND_MISSED, abs=0.02)


def test_errors_are_larger_near_the_hand() -> None:
    one = scene(thing("butter", (0.0, 0.1, 0.9)))
    near = torch.tensor([[0.0, 0.1, 0.95, 0.0, 0.0, 0.0]])
    far_off, at_hand = (errors(many(one, hand), one).median() for hand in (FAR, near))
    assert at_hand > 1.3 * far_off


def test_lifted_things_are_found_too_low() -> None:
    level, lifted = (scene(thing("butter", (0.0, 0.1, 0.909 + height))) for height in (0.0, 0.05))
    off, higher = (errors(many(one, FAR), one).mean() for one in (level, lifted))
    assert higher > off + 0.01
    seen = many(lifted, FAR)
    there = (field(seen, "present").squeeze(-1) > 0) & (field(seen, "class").squeeze(-1) == KIND["butter"])
    x, _, z = (field(seen, "position")[there] - lifted[0, 0, 2:5]).median(dim=0).values
    assert -0.03 < z < -0.008
    assert x / -z == pytest.approx(-0.6586 / (1.6103 - 0.959), rel=0.2)


def test_rotations_are_those_that_a_detector_can_see() -> None:
    tilted = (0.0, 0.6, 0.8, 1.0, 0.0, 0.0)  # x axis to the side and up
    behind = (-0.8, 0.6, 0.0, -0.6, -0.8, 0.0)
    slots = scene(
        thing("akita_black_bowl", (0.1, -0.1, 0.9), behind),
        thing("butter", (0.0, 0.1, 0.9), behind),
        thing("drawer", (0.2, 0.0, 1.0), (0.8, -0.6, 0.0, 0.6, 0.8, 0.0)),
        thing("milk", (-0.1, 0.2, 0.95), tilted),
    )
    axes = field(with_detection_noise(slots, FAR, 0.0), "rotation")[0]
    seen = {name: axes[slots[0, :, 1] == KIND[name]][0].tolist() for name in ("akita_black_bowl", "butter", "drawer")}
    assert seen["akita_black_bowl"] == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0], "round"
    assert seen["butter"] == pytest.approx([0.8, -0.6, 0.0, 0.6, 0.8, 0.0])
    assert seen["drawer"] == pytest.approx([-0.8, 0.6, 0.0, -0.6, -0.8, 0.0])
    milk = axes[slots[0, :, 1] == KIND["milk"]][0]
    assert milk[2] == 0
    assert milk[:2].norm() == pytest.approx(1.0)


def test_slots_are_sorted_and_empty_slots_stay_empty() -> None:
    seen = many(TABLE, FAR, 3.0)
    there = field(seen, "present").squeeze(-1) > 0
    assert not seen[~there].any()
    assert (there.int().diff(dim=1) <= 0).all()
    order = (field(seen, "class").squeeze(-1) + field(seen, "position")[..., 0].clamp(-4, 4) / 10).masked_fill(
        ~there, torch.inf
    )
    assert (order.diff(dim=1).nan_to_num() >= 0).all()
    assert with_detection_noise(torch.zeros(2, SLOTS, WIDTH), FAR.expand(2, -1), 1.0).eq(0).all()


def _batch() -> dict[str, torch.Tensor]:
    """Return two samples of one frame, which is stored too, and one of another."""
    other = scene(thing("butter", (0.2, 0.1, 0.9)))
    slots = torch.cat([TABLE, TABLE, other]).reshape(3, SIZE)
    found = {OBS_ENV_STATE: slots, OBS_RAW_STATE: FAR.expand(3, -1)}
    return {**found, FRAMES: ObjectEncoder(classes(), 32).remember(found, [1])}


def test_errors_are_drawn_once_per_frame() -> None:
    batch = _batch()
    perception = ObjectEncoder(classes(), 32, 1.0).train()
    first, second = perception.observed(batch), perception.observed(batch)
    for seen in (first, second):
        present = seen[OBS_ENV_STATE]
        assert torch.equal(present[0], present[1])
        assert torch.equal(present[0], seen[FRAMES][0, 0, :SIZE])
        assert torch.equal(seen[FRAMES][0, 0, SIZE:], batch[FRAMES][0, 0, SIZE:])
        assert torch.equal(seen[EXACT], batch[FRAMES])
        assert not (present == batch[OBS_ENV_STATE]).all(dim=1).any()
    assert not torch.equal(first[FRAMES], second[FRAMES])
    without = {name: one for name, one in batch.items() if name != FRAMES}
    assert perception.observed(without).keys() == without.keys()


@pytest.mark.parametrize(("noise", "learns"), [(1.0, False), (0.0, True)])
def test_noise_is_added_in_training_only(noise: float, learns: bool) -> None:
    batch = _batch()
    assert ObjectEncoder(classes(), 32, noise).train(learns).observed(batch) is batch


@pytest.mark.parametrize("memory", ["bank", "motion"])
def test_frames_share_their_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, memory: str) -> None:
    drawn: list[int] = []

    def counted(slots: torch.Tensor, hand: torch.Tensor, size: float) -> torch.Tensor:
        drawn.append(len(slots))
        return with_detection_noise(slots, hand, size)

    monkeypatch.setattr(objects, "with_detection_noise", counted)
    settings = {"size": "small", "perception": "objects", "memory_stride": 8}
    policy, before, _, dataset = made_for_training(
        make_object_dataset(tmp_path / "data"), memory=memory, detection_noise=1.0, **settings
    )
    batch = before(batch_of(dataset, [16] * 16))
    policy.train().forward(batch)
    assert drawn == [len(batch[FRAMES])]
    policy.eval().forward(batch)
    assert len(drawn) == 1
