"""Keyframes: clusters of nominations, kept frames, true keyframes in training, and losses of the high level."""

from __future__ import annotations

from statistics import median_low
from typing import Any

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.keyframes import (
    GAP,
    NOMINATED,
    RECENT,
    SHOWN,
    Keyframes,
    representatives,
    shown_keyframes,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories, Query
from tests.policies.test_memory import made

STRIDE, TEXTS = 10, 3
ALL = Query(choices=torch.ones(1, TEXTS, dtype=torch.bool))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 60), max_size=40), st.integers(0, 8))
def test_clusters_are_connected_components(nominated: list[int], gap: int) -> None:
    """Single linkage with the maximum distance ``gap``."""
    left, expected = set(nominated), []
    while left:
        cluster = {min(left)}
        while more := {one for one in left - cluster if any(abs(one - other) <= gap for other in cluster)}:
            cluster |= more
        left -= cluster
        expected.append(median_low([one for one in nominated if one in cluster]))
    assert representatives(nominated, gap) == expected


def nominating(wanted: Any) -> Keyframes:
    """Return a mechanism whose high level nominates the recent frames (R, RECENT) selected by ``wanted``."""
    mechanism = made("keyframes", stride=STRIDE)
    assert isinstance(mechanism, Keyframes)
    mechanism.seen = []  # type: ignore[assignment]

    def ask(frames: Tensor, real: Tensor, choices: Tensor) -> tuple[Tensor, Tensor]:
        mechanism.seen.append(frames[0, :SHOWN, 0, 0][real[0, :SHOWN]].tolist())  # type: ignore[operator, union-attr]
        recent = frames[:, SHOWN:, 0, 0]
        return torch.zeros(len(frames), TEXTS + 1), torch.where(wanted(recent), 1.0, -1.0)

    mechanism.ask_high_level = ask  # type: ignore[method-assign]
    return mechanism


def test_shown_keyframes_equal_those_of_an_unbounded_list() -> None:
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
        expected = shown_keyframes(nominated, GAP, window)
        state = mechanism.write(state, tokens, torch.tensor([number * STRIDE]), ALL)
        assert mechanism.seen[-1] == expected, number  # type: ignore[index]
        recent = torch.arange(number - RECENT + 1, number + 1)
        nominated += recent[asked[-1][0] & (recent >= 0)].tolist()
    assert len(set(nominated)) < NOMINATED
    assert state["votes"].sum() == len(nominated)
    assert max(map(len, mechanism.seen)) == SHOWN  # type: ignore[arg-type]


def labelled(labels: list[int], slots: list[int], ahead: bool = True) -> Histories:
    """Return histories of one episode with these labels, one per slot; frames hold their indices."""
    places = torch.full((len(slots), max(slots) + 1), -1)
    for row, slot in enumerate(slots):
        places[row, : slot + 1] = torch.arange(slot + 1)
    following = torch.tensor([[slot + 1 if slot + 1 < len(labels) else -1] for slot in slots])
    frames = torch.arange(float(len(labels)))[:, None, None].expand(-1, 1, 6)
    steps = torch.arange(len(labels)) * STRIDE
    return Histories(frames, steps, places, torch.tensor(labels), following if ahead else None)


def test_true_keyframes_end_segments() -> None:
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
    assert slots[2].tolist() == [*none[1:], 6, *range(24, 32)]
    assert keyframe.int().tolist() == [[0] * 8, [0, 0, 0, 0, 0, 1, 0, 0], [0] * 8]
    mechanism.train()
    torch.manual_seed(0)
    found = torch.stack([mechanism._true_frames(rows, torch.tensor([4, 9, 32]))[0][2, SHOWN - 1] for _ in range(200)])
    assert set(found.tolist()) == {-1, 4, 5, 6, 7, 8}


def test_labels_are_those_of_the_next_frame() -> None:
    mechanism = made("keyframes", stride=STRIDE)
    assert isinstance(mechanism, Keyframes)
    query = Query(choices=torch.ones(3, TEXTS, dtype=torch.bool), subgoal=torch.tensor([0, 1, 2]))
    histories = labelled([0] * 5 + [1] * 8 + [2] * 8, [4, 8, 20])
    read = mechanism.replay(histories, query)
    tokens, real = mechanism.texts(torch.tensor([1, 1, 2]))  # the first sample's next frame has another label
    assert torch.equal(read.each, tokens)
    assert torch.equal(read.mask, real)
    losses = mechanism.losses({})
    assert {name: loss.shape for name, loss in losses.items()} == {"subtask": (3,), "keyframes": (3,)}
    unknown = mechanism.replay(histories._replace(ahead=None), query._replace(subgoal=torch.tensor([-1, 1, 2])))
    assert unknown.mask.sum(dim=1).tolist()[0] == 1
    assert mechanism.losses({})["subtask"][0] == 0
    mechanism.replay(histories._replace(subgoals=None), query)
    assert not mechanism.losses({})
