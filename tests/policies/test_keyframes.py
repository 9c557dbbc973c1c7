"""Keyframes: a rollout's bounded votes show the keyframes that a list of all nominations would."""

from __future__ import annotations

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.keyframes import GAP, NOMINATED, RECENT, SHOWN, shown_keyframes
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Query
from tests.policies.test_memory import made

STRIDE, TEXTS = 10, 3
ALL = Query(choices=torch.ones(1, TEXTS, dtype=torch.bool))


def test_shown_keyframes_equal_those_of_an_unbounded_list() -> None:
    """The high level nominates some of the chosen frames each time."""
    chance = torch.Generator().manual_seed(0)
    chosen = torch.rand(400, generator=chance) < 0.05
    shown: list[list[float]] = []
    nominations: list[Tensor] = []

    def ask(frames: Tensor, real: Tensor, choices: Tensor) -> tuple[Tensor, Tensor]:
        shown.append(frames[0, :SHOWN, 0, 0][real[0, :SHOWN]].tolist())
        recent = frames[:, SHOWN:, 0, 0]
        nominations.append(chosen[recent.long()] & (torch.rand(recent.shape, generator=chance) < 0.5))
        return torch.zeros(len(frames), TEXTS + 1), torch.where(nominations[-1], 1.0, -1.0)

    mechanism = made("keyframes", stride=STRIDE)
    mechanism.ask_high_level = ask  # type: ignore[assignment]
    state, nominated = mechanism.init(1), list[int]()
    for number in range(400):
        tokens = torch.full((1, mechanism.spec.tokens, mechanism.spec.dim), float(number))
        expected = shown_keyframes(nominated, GAP, max(0, number - RECENT + 1))
        state = mechanism.write(state, tokens, torch.tensor([number * STRIDE]), ALL)
        assert shown[-1] == expected, number
        recent = torch.arange(number - RECENT + 1, number + 1)
        nominated += recent[nominations[-1][0] & (recent >= 0)].tolist()
    assert len(set(nominated)) < NOMINATED
    assert state["votes"].sum() == len(nominated)
    assert max(map(len, shown)) == SHOWN
