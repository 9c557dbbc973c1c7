"""Memory mechanisms, the histories of a rollout and the memory encoder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_FUSIONS, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import MECHANISMS, make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling, sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MASK,
    STEPS,
    TOKENS,
    Frame,
    MemoryEncoder,
    MemoryMechanism,
)
from lerobot_memobench.policies.memobench_mem.network import FUSIONS
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.policies.memobench_mem.rollout import Rollout

P, D = 3, 2


class Recorded:
    """An episode whose frames are loaded when asked for; it counts them."""

    def __init__(self, length: int, stride: int) -> None:
        values = torch.randn(length, P, D, generator=torch.Generator().manual_seed(length)).to(torch.bfloat16)
        self.frames = [Frame(slot * stride, tokens) for slot, tokens in enumerate(values)]
        self.loaded = 0

    def load(self, slots: Sequence[int]) -> list[Frame]:
        self.loaded += len(slots)
        return [self.frames[slot] for slot in slots]


def same(one: Sequence[Frame], other: Sequence[Frame]) -> bool:
    return [frame.step for frame in one] == [frame.step for frame in other] and all(
        torch.equal(a.tokens, b.tokens) for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("name", MECHANISMS)
@settings(max_examples=60)
@given(frames=st.integers(1, 40), length=st.integers(1, 90), stride=st.integers(1, 4))
def test_training_reads_what_a_rollout_reads(name: str, frames: int, length: int, stride: int) -> None:
    mechanism, episode = make_mechanism(name, frames), Recorded(length, stride)
    kept: list[Frame] = []
    for slot, frame in enumerate(episode.frames):
        mechanism.write(kept, frame)
        read = mechanism.read(kept)
        assert same(mechanism.recall(episode.load, slot), read)
        assert same(MemoryMechanism.recall(mechanism, episode.load, slot), read)
        assert len(read) <= mechanism.frames <= frames
        assert [frame.step for frame in read] == sorted(frame.step for frame in read)
        assert mechanism.capacity is None or len(kept) <= mechanism.capacity


@pytest.mark.parametrize("name", MECHANISMS)
def test_rows_of_a_rollout_and_the_cache_agree(name: str) -> None:
    """The whole way: what a row of a vector environment holds is what the preprocessor looks up for that frame."""
    stride, length = 2, 31
    episode, mechanism = Recorded(-(-length // stride), stride), make_mechanism(name, 5)

    class Cache:
        """One episode, as `FeatureCache` has it."""

        meta = type("Meta", (), {"stride": stride})
        episodes, phase, texts = torch.tensor([0, length]).numpy(), torch.ones(length).numpy(), ()

        def locate(self, index: int) -> tuple[int, int]:
            return 0, index

        def tokens(self, number: int, slots: Sequence[int]) -> torch.Tensor:
            return torch.stack([frame.tokens for frame in episode.load(slots)])

    history = Rollout(mechanism, stride)
    step = GatherMemoryProcessorStep(frames=mechanism.frames, memory=name)
    for now in range(length):
        history.observe([(1, now)], lambda rows, now=now: episode.frames[now // stride].tokens[None])
        gathered = step.gather(Cache(), [now])  # type: ignore[arg-type]
        if mechanism.frames == 0:
            assert not history.rows[0].kept
            assert set(gathered) == {"phase"}
            continue
        for held, looked_up in zip(history.gather([0]), (gathered[key] for key in (TOKENS, STEPS, MASK)), strict=True):
            assert torch.equal(held, looked_up)


def test_frame_sampling_loads_no_more_than_it_reads() -> None:
    episode = Recorded(90, 1)
    make_mechanism("frame_sampling", 8).recall(episode.load, 80)
    assert episode.loaded == 8


def test_what_the_configuration_names_is_there() -> None:
    assert {MemobenchMemConfig(device="cpu", memory_fusion=name).memory for name in MEMORY_FUSIONS} <= set(MECHANISMS)
    assert {*FUSIONS, "none"} == set(MEMORY_FUSIONS)


@pytest.mark.parametrize("name", MECHANISMS)
def test_an_encoder_that_looks_at_each_frame_alone_does(name: str) -> None:
    encoder = make_mechanism(name, 4).encoder(D, 6, grid=0)
    if not getattr(encoder, "framewise", False):
        return
    tokens, steps = torch.randn(2, 4, P, D), torch.randint(0, 90, (2, 4))
    mask = torch.tensor([[True, True, True, True], [True, True, False, False]])
    together, real = encoder(tokens, steps, mask)
    alone, real_alone = encoder(tokens.flatten(0, 1)[:, None], steps.flatten()[:, None], mask.flatten()[:, None])
    assert torch.equal(real, real_alone.reshape(real.shape))
    torch.testing.assert_close(together, alone.reshape(together.shape))


# -- frame sampling ---------------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 3000), st.integers(2, 64))
def test_sampled_frames_are_even_increasing_and_reach_both_ends(step: int, frames: int) -> None:
    chosen = sample_frames(step, frames)
    assert len(chosen) == min(step + 1, frames)
    assert chosen[0] == 0
    assert chosen[-1] == step
    gaps = np.diff(chosen)
    if len(gaps):
        assert gaps.min() >= 1
        assert gaps.max() - gaps.min() <= 1


def test_all_frames_are_kept_while_they_fit() -> None:
    assert sample_frames(31, 32) == list(range(32))
    assert sample_frames(32, 32)[:3] == [0, 1, 2]
    assert len(sample_frames(32, 32)) == 32
    assert sample_frames(62, 32) == list(range(0, 63, 2))
    with pytest.raises(ValueError, match="step"):
        sample_frames(-1, 32)


# -- rows of a rollout ------------------------------------------------------------------------------------------------


def _encode(values: list[float]):  # type: ignore[no-untyped-def]
    return lambda rows: torch.stack([torch.full((16, 2), values[row]) for row in rows])


def acting(*steps: int) -> list[tuple[int, int]]:
    """Return the clocks of rows in their execution."""
    return [(1, step) for step in steps]


def test_rows_start_freeze_and_stay_apart() -> None:
    memory, new, old = Rollout(FrameSampling(4), stride=1), True, False
    assert memory.observe(acting(0, 0), _encode([1.0, 2.0])) == ([0, 0], [new, new], [False, False])
    assert memory.observe(acting(1, 0), _encode([3.0, 99.0])) == ([1, 0], [old, old], [False, True])  # row 1 frozen
    assert memory.observe(acting(2, 1), _encode([5.0, 4.0])) == ([2, 1], [old, old], [False, False])
    assert memory.observe(acting(0, 2), _encode([7.0, 6.0])) == ([0, 2], [new, old], [False, False])  # row 0 begins
    tokens, steps, mask = memory.gather([0, 1])
    assert steps.tolist() == [[0, 0, 0, 0], [0, 1, 2, 0]]
    assert mask.tolist() == [[True, False, False, False], [True, True, True, False]]
    assert tokens[0, 0, 0, 0] == 7
    assert [float(t[0, 0]) for t in tokens[1]] == [2, 4, 6, 0]
    alone, _, _ = memory.gather([1])
    assert torch.equal(alone[0], tokens[1])


def test_stride_and_sampling_of_a_long_history() -> None:
    memory = Rollout(FrameSampling(4), stride=3)
    for step in range(20):
        memory.observe(acting(step), _encode([float(step)]))
    tokens, steps, mask = memory.gather([0])
    assert steps.tolist() == [[0, 6, 12, 18]]
    assert mask.all()
    assert [float(t[0, 0]) for t in tokens[0]] == [0, 6, 12, 18]
    memory.reset()
    assert memory.rows == []


def test_a_frame_that_was_not_offered_is_noticed() -> None:
    memory = Rollout(FrameSampling(4), stride=4)
    for step in (0, 3, 4, 4, 6, 8):  # what lies between two frames that are written may be left out
        memory.observe(acting(step, 1), _encode([1.0, 1.0]))
    assert memory.missed([0, 1]) is None
    memory.observe(acting(13, 6), _encode([1.0, 1.0]))
    assert (memory.missed([0]), memory.missed([1]), memory.missed([0, 1])) == (12, 4, 4)
    memory.observe(acting(14, 0), _encode([1.0, 1.0]))
    assert (memory.missed([0]), memory.missed([1])) == (12, None), "a new episode has missed nothing"


def test_the_clock_starts_again_with_the_execution() -> None:
    """The prompt's frames stay in the history, whose own time goes on; a clock that counts through tells the same."""
    for first in (0, 3):
        memory = Rollout(FrameSampling(9), stride=1)
        clocks = [(0, 0), (0, 1), (0, 2), (1, first), (1, first + 1), (1, first + 1), (1, first + 3)]
        found = [memory.observe([clock], _encode([1.0])) for clock in clocks]
        assert [steps for steps, _, _ in found] == [[0], [1], [2], [3], [4], [4], [6]]
        assert [started for _, started, _ in found] == [[True], *[[False]] * 6]
        assert [frozen for _, _, frozen in found] == [[False]] * 5 + [[True], [False]]
        assert memory.observe([(0, 0)], _encode([1.0])) == ([0], [True], [False])
        assert len(memory.rows[0].kept) == 1


def test_an_execution_without_a_prompt_begins_again_at_step_0() -> None:
    memory = Rollout(FrameSampling(4), stride=1)
    for clock, began in (((1, 0), True), ((1, 1), False), ((1, 0), True), ((1, 0), False)):
        assert memory.observe([clock], _encode([1.0]))[1] == [began]


# -- memory encoder ---------------------------------------------------------------------------------------------------


def position_features(steps: torch.Tensor) -> torch.Tensor:
    """Return sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each, of steps (...): (..., 16, 768)."""
    y, x = torch.meshgrid(torch.arange(4.0) * 4 + 2, torch.arange(4.0) * 4 + 2, indexing="ij")
    places = torch.broadcast_tensors(steps[..., None].to(torch.float64), y.flatten(), x.flatten())
    frequencies = [base ** -(torch.arange(128, dtype=torch.float64) / 127) for base in (10_000.0, 1_000.0, 1_000.0)]
    angles = [place[..., None] * some for place, some in zip(places, frequencies, strict=True)]
    return torch.cat([wave for angle in angles for wave in (angle.sin(), angle.cos())], dim=-1).float()


def test_encoder_shapes_and_mask() -> None:
    encoder = MemoryEncoder(image_dim=6, memory_dim=10)
    mask = torch.tensor([[True, True, False]])
    memory, token_mask = encoder(torch.randn(1, 3, 16, 6), torch.tensor([[0, 1, 0]]), mask)
    assert memory.shape == (1, 48, 10)
    assert token_mask.tolist() == [[True] * 32 + [False] * 16]


@pytest.mark.parametrize(
    "steps", [[[9, 4, 700], [4, 9, 1199]], [[9], [4], [700], [4], [9]]], ids=["rows", "one by one"]
)
def test_encoder_equals_its_formula_token_by_token(steps: list[list[int]]) -> None:
    """concat(image, SiLU(Linear(position))) -> Linear, although the code never builds the concatenations."""
    encoder, seen = MemoryEncoder(image_dim=6, memory_dim=10), torch.tensor(steps)
    tokens = torch.randn(*seen.shape, 16, 6)
    memory, _ = encoder(tokens, seen, torch.ones_like(seen, dtype=torch.bool))
    position = torch.nn.functional.silu(encoder.position(position_features(seen)))
    expected = encoder.project(torch.cat([tokens, position], dim=-1)).flatten(1, 2)
    torch.testing.assert_close(memory, expected, rtol=1e-5, atol=1e-5)
    weights = [*encoder.parameters()]
    for made, by_formula in zip(
        *(torch.autograd.grad(of.square().sum(), weights) for of in (memory, expected)), strict=True
    ):
        torch.testing.assert_close(made, by_formula, rtol=1e-4, atol=1e-4)
