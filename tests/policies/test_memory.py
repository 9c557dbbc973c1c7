"""Memory mechanisms: one contract for all of them, packages that add one, frame sampling and its encoder."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from transformers.initialization import no_init_weights

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import memory
from lerobot_memobench.policies.memobench_mem.memory import OURS, find_mechanism, mechanism_settings
from lerobot_memobench.policies.memobench_mem.memory.frames import (
    FrameSampling,
    MemoryEncoder,
    RememberedFrame,
    sample_frames,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
)
from lerobot_memobench.policies.memobench_mem.memory.motion import MotionField

P, D, SUBGOALS = 2, 16, ("close it", "open it", "put it there")


def made(name: str, stride: int = 8, seed: int = 0, **changed: Any) -> MemoryMechanism:
    """Build a mechanism with a small pool from stored frames (N, 1, 6) to (N, P, D)."""
    torch.manual_seed(seed)
    pool = nn.Sequential(nn.Linear(6, P * D), nn.Unflatten(-1, (P, D)), nn.Flatten(1, 2))
    spec = MemorySpec(dim=D, tokens=P, width=16, expert=16, grid=0, stride=stride, subgoals=SUBGOALS)
    mechanism = find_mechanism(name)
    return mechanism(spec, Moves() if mechanism.asks_motion else pool, mechanism_settings(name, changed)).eval()


class Moves(MotionField):
    """Motion of stored frames (N, 1, 6): the change of each number."""

    size, cells, numbers, moved = 6, 6, 1, 1

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(6, D)

    def between(self, before: Tensor, now: Tensor) -> Tensor:
        return (now - before).transpose(1, 2)

    def following(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        moved = frames.squeeze(2).diff(dim=1).unsqueeze(-1)
        return moved, torch.ones(moved.shape[:-1], dtype=torch.bool)

    def tokens(self, fields: Tensor) -> Tensor:
        made: Tensor = self.layer(fields.squeeze(-1))
        return made


def present(rows: int, seed: int = 1) -> Query:
    """Return tokens and choices of some rows."""
    generator = torch.Generator().manual_seed(seed)
    choices = torch.rand(rows, len(SUBGOALS), generator=generator) < 0.7
    choices[:, 0] = True
    return Query(tokens=torch.randn(rows, P, D, generator=generator), choices=choices)


def rolled_out(mechanism: MemoryMechanism, frames: Tensor, stride: int, query: Query) -> Any:
    """Return the state of a row after these stored frames (n, 1, 6)."""
    state = mechanism.init(1)
    for number, frame in enumerate(frames.split(1)):
        state = mechanism.observe(state, frame, torch.tensor([number * stride]), query._replace(tokens=None))
    return state


def assert_same(one: MemoryTokens, other: MemoryTokens) -> None:
    assert torch.equal(one.mask, other.mask)
    torch.testing.assert_close(one.rows()[one.mask], other.rows()[other.mask], rtol=1e-4, atol=1e-5)
    if one.steps is not None and other.steps is not None:
        assert torch.equal(one.steps[one.mask], other.steps[other.mask])


# -- the contract --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OURS)
def test_replay_equals_rollouts_and_rows_are_independent(name: str) -> None:
    """Samples of several episodes, early, late, repeated, in any order."""
    mechanism, stride = made(name), 8
    lengths, samples = (60, 1, 23), ((0, 59), (2, 4), (0, 0), (1, 0), (0, 31), (2, 22), (2, 4), (0, 58))
    stored = torch.randn(sum(lengths), 1, 6)
    first = np.cumsum([0, *lengths])
    chosen = [first[episode] + np.array(mechanism.slots(slot, mechanism.settings)) for episode, slot in samples]
    places = np.full((len(samples), max(map(len, chosen))), -1)
    for number, read in enumerate(chosen):
        places[number, : len(read)] = read
    steps = torch.cat([torch.arange(length) * stride for length in lengths])
    own = present(len(lengths))
    query = own.rows([episode for episode, _ in samples])._replace(tokens=present(len(samples), 2).tokens)
    with torch.no_grad():
        together = mechanism.replay(Histories(stored, steps, torch.from_numpy(places)), query)
        states = [
            rolled_out(mechanism, stored[first[episode] : first[episode] + slot + 1], stride, own.rows([episode]))
            for episode, slot in samples
        ]
        apart = [mechanism.read(state, query.rows([row])) for row, state in enumerate(states)]
        joined = mechanism.read(mechanism.join(states), query)
    assert_same(together, joined)
    for row, alone in enumerate(apart):
        assert_same(joined._replace(each=joined.rows()[[row]], mask=joined.mask[[row]], places=None, steps=None), alone)


@pytest.mark.parametrize("name", OURS)
def test_state_is_bounded_and_not_changed_by_later_frames(name: str) -> None:
    mechanism = made(name, stride=1)
    bound = min(mechanism.capacity, 100)
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr(type(mechanism), "capacity", bound)  # to reach it in a few frames
        state, sizes = mechanism.init(1), []
        for step in range(2 * bound + 40):
            before = mechanism.read(state, present(1)).rows() if step == 20 else None
            later = mechanism.observe(state, torch.randn(1, 1, 6), torch.tensor([step]), present(1))
            if before is not None:
                assert torch.equal(mechanism.read(state, present(1)).rows(), before)
            state = later
            sizes.append(count_numbers(state))
        read = mechanism.read(state, present(1))
    assert sizes[-1] == max(sizes) == sizes[bound + 20]
    assert read.mask.shape == (1, read.rows().shape[1])


def count_numbers(state: Any) -> int:
    if isinstance(state, Tensor):
        return state.numel()
    if isinstance(state, RememberedFrame):
        return state.stored.numel()
    return sum(map(count_numbers, state.values() if isinstance(state, dict) else state))


@pytest.mark.parametrize("name", OURS)
def test_gradients_reach_every_weight_and_weights_can_be_loaded(name: str) -> None:
    mechanism = made(name).train()
    stored, places = torch.randn(40, 1, 6), torch.full((2, 40), -1)
    for row, slot in zip(places, (2, 39), strict=True):
        read = torch.tensor(list(mechanism.slots(slot, mechanism.settings)))
        row[: len(read)] = read
    labels = torch.randint(0, len(SUBGOALS), (40,))
    query = present(2)._replace(choices=torch.ones(2, len(SUBGOALS), dtype=torch.bool), subgoal=labels[:2])
    if mechanism.asks_present:  # the present passes through the pool as well
        query = query._replace(tokens=mechanism.pool(torch.randn(2, 1, 6)))
    read_tokens = mechanism.replay(Histories(stored, torch.arange(40) * 8, places, labels), query)
    own = mechanism.losses({})
    loss = (read_tokens.rows() * torch.randn_like(read_tokens.rows())).sum() + sum(one.sum() for one in own.values())
    loss.backward()
    assert not [key for key, weight in mechanism.named_parameters() if weight.grad is None or not weight.grad.any()]
    with no_init_weights():  # as a checkpoint is loaded
        empty = made(name, seed=1)
    empty.load_state_dict(mechanism.state_dict())


def test_packages_that_add_a_broken_memory_are_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    added = [
        EntryPoint("gone", "no_such_package:Memory", memory.GROUP),
        EntryPoint("twice", "one_package:Memory", memory.GROUP),
        EntryPoint("twice", "another:Memory", memory.GROUP),
        EntryPoint("frames", "pathlib:Path", memory.GROUP),
    ]
    monkeypatch.setattr(memory, "entry_points", lambda group: added if group == memory.GROUP else [])
    for name, named in (("gone", "no_such_package"), ("twice", "another:Memory.*one_package:Memory")):
        with pytest.raises(MemobenchError, match=f"'{name}'.*{named}"):
            find_mechanism(name)
    assert find_mechanism.__wrapped__("frames") is FrameSampling
    assert "pathlib:Path" in caplog.text


# -- frames --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", [True, False])
def test_tokens_of_frames_hold_time_and_content(content: bool) -> None:
    mechanism, query = made("frames", frames=4, content=content), present(1)
    stored = torch.randn(3, 1, 6)
    with torch.no_grad():
        read = [
            mechanism.read(rolled_out(mechanism, frames, stride, query)).rows()
            for frames, stride in ((stored, 8), (stored + 1, 8), (stored, 9))
        ]
    assert torch.equal(read[0], read[1]) != content
    assert not torch.equal(read[0], read[2])


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 3000), st.integers(2, 64))
def test_sampled_frames_are_even_and_reach_both_ends(step: int, frames: int) -> None:
    chosen = sample_frames(step, frames)
    assert len(chosen) == min(step + 1, frames)
    assert (chosen[0], chosen[-1]) == (0, step)
    gaps = np.diff(chosen)
    assert not len(gaps) or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)


def position_features(steps: Tensor) -> Tensor:
    """Return sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each, of steps (...): (..., 16, 768)."""
    y, x = torch.meshgrid(torch.arange(4.0) * 4 + 2, torch.arange(4.0) * 4 + 2, indexing="ij")
    places = torch.broadcast_tensors(steps[..., None].to(torch.float64), y.flatten(), x.flatten())
    frequencies = [base ** -(torch.arange(128, dtype=torch.float64) / 127) for base in (10_000.0, 1_000.0, 1_000.0)]
    angles = [place[..., None] * some for place, some in zip(places, frequencies, strict=True)]
    return torch.cat([wave for angle in angles for wave in (angle.sin(), angle.cos())], dim=-1).float()


def test_encoder_equals_its_formula() -> None:
    """concat(image, SiLU(Linear(position))) -> Linear, computed without the concatenation."""
    encoder, at = MemoryEncoder(image_dim=6, memory_dim=10), torch.tensor([9, 4, 700, 4, 9])
    tokens = torch.randn(*at.shape, 16, 6)
    position = torch.nn.functional.silu(encoder.position(position_features(at)))
    expected, found = encoder.project(torch.cat([tokens, position], dim=-1)), encoder(tokens, at)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    weights = [*encoder.parameters()]
    gradients = (torch.autograd.grad(of.square().sum(), weights) for of in (found, expected))
    for one, by_formula in zip(*gradients, strict=True):
        torch.testing.assert_close(one, by_formula, rtol=1e-4, atol=1e-4)
