"""Keyframes: clusters of nominations, what is kept of them, true keyframes in training, what the high level learns."""

from __future__ import annotations

from statistics import median_low
from typing import Any

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.keyframes import (
    GAP,
    NOMINATED,
    RECENT,
    SHOWN,
    Keyframes,
    representatives,
    shown,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories, Query
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from tests.policies.test_memory import made

STRIDE, TEXTS = 10, 3
ALL = Query(choices=torch.ones(1, TEXTS, dtype=torch.bool))


def test_the_sources_example() -> None:
    assert representatives([3, 1, 10, 3, 4], 5) == [3, 10]
    assert representatives([1, 6, 12], 5) == [1, 12], "a gap of 5 joins, and the lower median counts"
    assert shown([3, 1, 10, 3, 4], 5, 10) == [3], "those of the recent window are hidden"
    assert shown(range(0, 200, 10), 5, 1000) == [*range(120, 200, 10)], "the last eight"


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 60), max_size=40), st.integers(0, 8))
def test_clusters_are_connected_components(nominated: list[int], gap: int) -> None:
    """Single linkage: frames are of one cluster that a chain of nominations, each within the gap, connects."""
    left, expected = set(nominated), []
    while left:
        cluster = {min(left)}
        while more := {one for one in left - cluster if any(abs(one - other) <= gap for other in cluster)}:
            cluster |= more
        left -= cluster
        expected.append(median_low([one for one in nominated if one in cluster]))
    assert representatives(nominated, gap) == expected


def nominating(wanted: Any) -> Keyframes:
    """Return a mechanism whose high level nominates the recent frames (R, RECENT) of which ``wanted`` is true."""
    mechanism = made("keyframes", stride=STRIDE)
    assert isinstance(mechanism, Keyframes)
    mechanism.seen = []  # type: ignore[assignment]

    def ask(frames: Tensor, real: Tensor, choices: Tensor) -> tuple[Tensor, Tensor]:
        mechanism.seen.append(frames[0, :SHOWN, 0, 0][real[0, :SHOWN]].tolist())  # type: ignore[operator, union-attr]
        recent = frames[:, SHOWN:, 0, 0]
        return torch.zeros(len(frames), TEXTS + 1), torch.where(wanted(recent), 1.0, -1.0)

    mechanism.ask_high_level = ask  # type: ignore[method-assign]
    return mechanism


def test_nominations_are_kept_counted_and_shown_as_in_the_source() -> None:
    """Beside the source's rule: an endless sorted list of nominations, of which all clusters are made anew."""
    chance = torch.Generator().manual_seed(0)
    chosen = torch.rand(400, generator=chance) < 0.05

    def wanted(frames: Tensor) -> Tensor:
        return chosen[frames.long()] & (torch.rand(frames.shape, generator=chance) < 0.5)

    asked: list[Tensor] = []

    def noted(frames: Tensor) -> Tensor:
        asked.append(wanted(frames))
        return asked[-1]

    mechanism = nominating(noted)
    state, nominated = mechanism.init(1), list[int]()
    for number in range(400):
        tokens = torch.full((1, mechanism.spec.tokens, mechanism.spec.dim), float(number))
        window = max(0, number - RECENT + 1)
        expected = shown(nominated, GAP, window)
        state = mechanism.write(state, tokens, torch.tensor([number * STRIDE]), ALL)
        assert mechanism.seen[-1] == expected, number  # type: ignore[index]
        recent = torch.arange(number - RECENT + 1, number + 1)
        nominated += recent[asked[-1][0] & (recent >= 0)].tolist()
    assert len(set(nominated)) < NOMINATED
    assert state["votes"].sum() == len(nominated)
    assert max(map(len, mechanism.seen)) == SHOWN  # type: ignore[arg-type]


def test_of_frames_that_are_nominated_without_end_the_latest_are_kept() -> None:
    mechanism = nominating(lambda frames: torch.ones_like(frames, dtype=torch.bool))
    state = mechanism.init(1)
    for number in range(100):
        tokens = torch.full((1, mechanism.spec.tokens, mechanism.spec.dim), float(number))
        state = mechanism.write(state, tokens, torch.tensor([number * STRIDE]), ALL)
    kept = state["steps"][0, :NOMINATED]
    assert torch.equal(kept, torch.arange(100 - NOMINATED, 100) * STRIDE)
    assert torch.equal(state["frames"][0, :NOMINATED, 0, 0] * STRIDE, kept.float())
    assert state["votes"][0, 0] == RECENT, "a frame has a vote for each time that it was recent"


def labelled(labels: list[int], slots: list[int], ahead: bool = True) -> Histories:
    """Return histories of one episode with these labels, to each of some frames; frames tell their numbers."""
    places = torch.full((len(slots), max(slots) + 1), -1)
    for row, slot in enumerate(slots):
        places[row, : slot + 1] = torch.arange(slot + 1)
    following = torch.tensor([[slot + 1 if slot + 1 < len(labels) else -1] for slot in slots])
    frames = torch.arange(float(len(labels)))[:, None, None].expand(-1, 1, 6)
    steps = torch.arange(len(labels)) * STRIDE
    return Histories(frames, steps, places, torch.tensor(labels), following if ahead else None)


def test_true_keyframes_are_the_last_frames_of_segments() -> None:
    mechanism = made("keyframes", stride=STRIDE)
    assert isinstance(mechanism, Keyframes)
    labels = [0] * 7 + [1] * 3 + [-1] * 2 + [2] * 20
    histories = labelled(labels, [3, 8, 31])
    assert histories.subgoals is not None
    rows = torch.nn.functional.pad(histories.subgoals, (0, 1), value=-1)[histories.places]
    slots, keyframe = mechanism._true_frames(rows, torch.tensor([4, 9, 32]))
    none = [-1] * SHOWN
    assert slots[0].tolist() == [*none, *[-1] * 4, 0, 1, 2, 3]
    assert slots[1].tolist() == [*none, *range(1, 9)]
    assert slots[2].tolist() == [*none[1:], 6, *range(24, 32)], "behind a gap no completion is known"
    assert keyframe.int().tolist() == [[0] * 8, [0, 0, 0, 0, 0, 1, 0, 0], [0] * 8]
    mechanism.train()
    torch.manual_seed(0)
    found = torch.stack([mechanism._true_frames(rows, torch.tensor([4, 9, 32]))[0][2, SHOWN - 1] for _ in range(200)])
    assert set(found.tolist()) == {-1, 4, 5, 6, 7, 8}, "some are left out, others moved"


def test_the_high_level_learns_what_comes_next_and_the_low_level_is_told_it() -> None:
    mechanism = made("keyframes", stride=STRIDE)
    assert isinstance(mechanism, Keyframes)
    query = Query(choices=torch.ones(3, TEXTS, dtype=torch.bool), subgoal=torch.tensor([0, 1, 2]))
    histories = labelled([0] * 5 + [1] * 8 + [2] * 8, [4, 8, 20])
    read = mechanism.replay(histories, query)
    tokens, real = mechanism.texts(torch.tensor([1, 1, 2]))  # the first sample's next frame has another
    assert torch.equal(read.each, tokens)
    assert torch.equal(read.mask, real)
    losses = mechanism.losses({})
    assert {name: loss.shape for name, loss in losses.items()} == {"subtask": (3,), "keyframes": (3,)}
    unknown = mechanism.replay(histories._replace(ahead=None), query._replace(subgoal=torch.tensor([-1, 1, 2])))
    assert unknown.mask.sum(dim=1).tolist()[0] == 1, "without a text the empty one is read"
    assert mechanism.losses({})["subtask"][0] == 0
    mechanism.replay(histories._replace(subgoals=None), query)
    assert not mechanism.losses({}), "nothing is true"


def test_it_learns_to_nominate_and_to_say_in_a_rollout() -> None:
    """Trained by true keyframes alone, it acts by its own, says what is next and keeps the segments' ends."""
    mechanism = made("keyframes", stride=STRIDE).train()
    labels = [0] * 12 + [1] * 10 + [2] * 12
    slots = [*range(len(labels))]
    query = Query(choices=torch.ones(len(slots), TEXTS, dtype=torch.bool), subgoal=torch.tensor(labels))
    histories = labelled(labels, slots)
    marked = torch.randn(TEXTS, 1, 6)[labels] + 0.1 * torch.randn(len(labels), 1, 6)
    histories = histories._replace(frames=marked)
    optimizer = torch.optim.Adam(mechanism.parameters(), 3e-3)
    for _ in range(150):
        mechanism.replay(histories, query)
        loss = torch.stack([one.mean() for one in mechanism.losses({}).values()]).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.15
    mechanism.eval()
    state, said = mechanism.init(1), []
    with torch.no_grad():
        for number, frame in enumerate(marked.split(1)):
            state = mechanism.observe(state, frame, torch.tensor([number * STRIDE]), ALL)
            said.append(int(state["said"]))
    assert said[3:10] == [0] * 7
    assert said[14:20] == [1] * 6
    assert said[24:] == [2] * 10
    kept = [step // STRIDE for step, votes in zip(state["steps"][0], state["votes"][0], strict=False) if votes > 0]
    assert {min(abs(int(frame) - end) for end in (11, 21)) for frame in kept} <= {0, 1}
    assert kept


def test_it_is_built_at_full_size() -> None:
    with torch.device("meta"):
        made_at = MemoryPI05(MemobenchMemConfig(device="cpu", size="pi05", memory="keyframes", subgoals={"do": ["it"]}))
    assert made_at.config.memory_stride == STRIDE
