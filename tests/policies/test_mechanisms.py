"""Every registered memory mechanism: bounded, and the same in training as in a rollout."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_FUSIONS, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import MECHANISMS, make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    MASK,
    STEPS,
    TOKENS,
    Frame,
    MemoryMechanism,
    RolloutMemory,
)
from lerobot_memobench.policies.memobench_mem.network import FUSIONS
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep

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
        assert same(mechanism.recall(episode, slot), read)
        assert same(MemoryMechanism.recall(mechanism, episode, slot), read)
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

    history = RolloutMemory(mechanism, stride)
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
    make_mechanism("frame_sampling", 8).recall(episode, 80)
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
