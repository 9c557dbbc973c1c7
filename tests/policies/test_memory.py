"""Memory mechanisms: what training reads is what a rollout reads; the rows of a rollout; the encoder of frames."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import Tensor, nn
from transformers.initialization import no_init_weights

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import configuration_memobench_mem, memory
from lerobot_memobench.policies.memobench_mem.checkpoints import load_weights
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_FUSIONS, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import OURS, find_mechanism, read_settings
from lerobot_memobench.policies.memobench_mem.memory.frames import Frame, Frames, MemoryEncoder, sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    FRAMES,
    PLACES,
    STEPS,
    Histories,
    MemoryMechanism,
    MemorySpec,
    MemoryTokens,
    Query,
)
from lerobot_memobench.policies.memobench_mem.memory.recurrent import Recurrent
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.motion_fields import MotionField
from lerobot_memobench.policies.memobench_mem.network import FUSIONS
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.policies.memobench_mem.rollout import Rollout
from tests.support.small_policy import small_config

P, D, SUBGOALS = 2, 16, ("close it", "open it", "put it there")


def made(name: str, frames: int = 32, stride: int = 8, seed: int = 0, **changed: Any) -> MemoryMechanism:
    """Build a mechanism behind a small pool, from stored frames (N, 1, 6) to (N, P, D)."""
    torch.manual_seed(seed)
    pool = torch.nn.Sequential(torch.nn.Linear(6, P * D), torch.nn.Unflatten(-1, (P, D)), torch.nn.Flatten(1, 2))
    spec = MemorySpec(dim=D, tokens=P, width=16, expert=16, frames=frames, grid=0, stride=stride, subgoals=SUBGOALS)
    mechanism = find_mechanism(name)
    return mechanism(spec, Moves() if mechanism.asks_motion else pool, read_settings(name, changed)).eval()


class Moves(MotionField):
    """Motion of stored frames (N, 1, 6): by how much each number changes."""

    size, cells, numbers, moved = 6, 6, 1, 1

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(6, D)

    def between(self, before: Tensor, now: Tensor) -> Tensor:
        return (now - before).transpose(1, 2)

    def following(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        moved = frames.squeeze(2).diff(dim=1).unsqueeze(-1)
        return moved, torch.ones(moved.shape[:-1], dtype=torch.bool)

    def tokens(self, fields: Tensor) -> Tensor:
        made: Tensor = self.layer(fields.squeeze(-1))
        return made


def asked(rows: int, seed: int = 1) -> Query:
    """Return the present of some rows, all of it."""
    chance = torch.Generator().manual_seed(seed)
    choices = torch.rand(rows, len(SUBGOALS), generator=chance) < 0.7
    choices[:, 0] = True
    return Query(
        tokens=torch.randn(rows, P, D, generator=chance),
        choices=choices,
    )


def rolled_out(mechanism: MemoryMechanism, frames: Tensor, stride: int, query: Query) -> Any:
    """Return the state of a row after these stored frames (n, 1, 6), one by one."""
    state = mechanism.init(1)
    for number, frame in enumerate(frames.split(1)):
        state = mechanism.observe(state, frame, torch.tensor([number * stride]), query._replace(tokens=None))
    return state


def same(one: MemoryTokens, other: MemoryTokens) -> None:
    """Compare what rows read: the real tokens, and which they are."""
    assert torch.equal(one.mask, other.mask)
    torch.testing.assert_close(one.rows()[one.mask], other.rows()[other.mask], rtol=1e-4, atol=1e-5)
    if one.steps is not None and other.steps is not None:
        assert torch.equal(one.steps[one.mask], other.steps[other.mask])


@pytest.mark.parametrize("name", OURS)
def test_training_reads_what_a_rollout_reads(name: str) -> None:
    """Samples of several episodes, early, late, twice the same, in any order; each equals its own rollout's row."""
    mechanism, stride = made(name), 8
    lengths, samples = (60, 1, 23), ((0, 59), (2, 4), (0, 0), (1, 0), (0, 31), (2, 22), (2, 4), (0, 58))
    stored = torch.randn(sum(lengths), 1, 6)
    first = np.cumsum([0, *lengths])
    chosen = [first[episode] + np.array(mechanism.slots(slot, 32)) for episode, slot in samples]
    places = np.full((len(samples), max(map(len, chosen))), -1)
    for number, read in enumerate(chosen):
        places[number, : len(read)] = read
    steps = torch.cat([torch.arange(length) * stride for length in lengths])
    own = asked(len(lengths))
    present = asked(len(samples), 2)  # its own of each sample; choices are the episode's
    of_episode = [episode for episode, _ in samples]
    query = own.rows(of_episode)._replace(tokens=present.tokens)
    with torch.no_grad():
        together = mechanism.replay(Histories(stored, steps, torch.from_numpy(places)), query)
        states = [
            rolled_out(mechanism, stored[first[episode] : first[episode] + slot + 1], stride, own.rows([episode]))
            for episode, slot in samples
        ]
        apart = [mechanism.read(state, query.rows([row])) for row, state in enumerate(states)]
        joined = mechanism.read(mechanism.join(states), query)
    same(together, joined)
    for row, alone in enumerate(apart):
        same(joined._replace(each=joined.rows()[[row]], mask=joined.mask[[row]], places=None, steps=None), alone)


@pytest.mark.parametrize("name", OURS)
def test_a_checkpoint_fits_a_mechanism_whose_weights_were_not_drawn(name: str) -> None:
    """As a checkpoint is loaded: `no_init_weights` makes torch's initialisers do nothing, and return nothing."""
    drawn = made(name)
    with no_init_weights():
        empty = made(name, seed=1)
    empty.load_state_dict(drawn.state_dict())


@pytest.mark.parametrize("name", OURS)
def test_what_is_kept_has_a_bound(name: str) -> None:
    mechanism = made(name, stride=1)
    bound = min(mechanism.capacity, 300)
    type(mechanism).capacity, kept = bound, type(mechanism).capacity  # none is filled up to thousands here
    try:
        state, sizes = mechanism.init(1), []
        with torch.no_grad():
            for step in range(3 * bound + 40):
                state = mechanism.observe(state, torch.randn(1, 1, 6), torch.tensor([step]), asked(1))
                sizes.append(held(state))
            read = mechanism.read(state, asked(1))
    finally:
        type(mechanism).capacity = kept
    assert sizes[-1] == max(sizes) == sizes[bound + 20]
    assert read.mask.shape == (1, read.rows().shape[1])


def held(state: Any) -> int:
    """Return how many numbers a state holds."""
    if isinstance(state, Tensor):
        return state.numel()
    if isinstance(state, Frame):
        return state.stored.numel()
    return sum(map(held, state.values() if isinstance(state, dict) else state))


@pytest.mark.parametrize("name", OURS)
def test_a_state_is_not_changed_by_what_follows(name: str) -> None:
    mechanism = made(name)
    with torch.no_grad():
        state = rolled_out(mechanism, torch.randn(20, 1, 6), 8, asked(1))
        before = mechanism.read(state, asked(1)).rows()
        mechanism.observe(state, torch.randn(1, 1, 6), torch.tensor([160]), asked(1))
        assert torch.equal(mechanism.read(state, asked(1)).rows(), before)


@pytest.mark.parametrize("name", OURS)
def test_gradients_reach_every_weight(name: str) -> None:
    mechanism = made(name).train()
    stored, places = torch.randn(40, 1, 6), torch.full((2, 40), -1)
    for row, slot in zip(places, (2, 39), strict=True):
        read = torch.tensor(list(mechanism.slots(slot, 32)))
        row[: len(read)] = read
    labels = torch.randint(0, len(SUBGOALS), (40,))
    query = asked(2)._replace(choices=torch.ones(2, len(SUBGOALS), dtype=torch.bool), subgoal=labels[:2])
    if mechanism.asks_present:  # it comes through the pool, too
        query = query._replace(tokens=mechanism.pool(torch.randn(2, 1, 6)))
    read_tokens = mechanism.replay(Histories(stored, torch.arange(40) * 8, places, labels), query)
    own = mechanism.losses({})
    loss = (read_tokens.rows() * torch.randn_like(read_tokens.rows())).sum() + sum(one.sum() for one in own.values())
    loss.backward()
    missed = [key for key, weight in mechanism.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert not missed


def test_rows_of_a_rollout_and_the_cache_agree() -> None:
    """The whole way: what a row of a vector environment holds is what the preprocessor looks up for that frame."""
    stride, length = 2, 31
    stored = torch.randn(-(-length // stride), 1, 6)

    class Cache:
        """One episode, as `FrameLookup` has it."""

        encoded: dict[str, Any] = {}
        columns = encoded
        episodes, phase, texts = np.array([0, length]), np.ones(length), ()

        def __init__(self) -> None:
            self.stride = stride

        def locate(self, index: int) -> tuple[int, int]:
            return 0, index

        def tokens(self, number: int, slots: list[int]) -> Tensor:
            assert len(slots) <= 5, "no more is loaded than is read"
            return stored[slots]

    mechanism, history, step = made("frames", 5, stride), Rollout(True, stride), GatherMemoryProcessorStep(frames=5)
    for now in range(length):
        history.observe([(1, now)], writing(mechanism, history, stored[None, now // stride]))
        gathered = step.gather(Cache(), [now])  # type: ignore[arg-type]
        looked_up = mechanism.replay(Histories(*(gathered[key] for key in (FRAMES, STEPS, PLACES))))
        same(looked_up, mechanism.read(history.rows[0].memory))
    assert set(GatherMemoryProcessorStep(frames=0).gather(Cache(), [3])) == {"phase"}  # type: ignore[arg-type]


def writing(mechanism: MemoryMechanism, rollout: Rollout, frames: Tensor) -> Callable[[list[int]], None]:
    """Return what writes the present frames (rows, ...) to a rollout's rows."""

    def write(rows: list[int]) -> None:
        for row in rows:
            held = rollout.rows[row]
            state = mechanism.init(1) if held.memory is None else held.memory
            held.memory = mechanism.observe(state, frames[[row]], torch.tensor([held.position]))

    return write


def test_what_the_configuration_names_is_there() -> None:
    assert {*FUSIONS, "own", "none"} == set(MEMORY_FUSIONS)
    for name in OURS:
        config = MemobenchMemConfig(device="cpu", memory=name)
        assert (config.memory_fusion == "own") == (find_mechanism(name).fusion is not None)
        assert config.memory_settings == vars(read_settings(name, {}))
    assert MemobenchMemConfig(device="cpu").memory == "frames"
    assert MemobenchMemConfig(device="cpu", memory_fusion="none").memory == "none"
    assert MemobenchMemConfig(device="cpu", memory="none").memory_fusion == "none"


@pytest.mark.parametrize(
    ("asked_for", "told"),
    [
        ({"memory": "bnak"}, "no memory 'bnak'"),
        ({"memory_fusion": "own"}, "cannot be read"),
        ({"memory_settings": {"time_code": False}}, "'time_code', which is no setting of memory=frames"),
        ({"memory_settings": {"time_codes": "perhaps"}}, "time_codes='perhaps' of memory=frames.*expected bool"),
        ({"memory": "bank", "memory_settings": {"length": True}}, "length=True of memory=bank.*expected int"),
        ({"memory": "bank", "memory_settings": {"length": None}}, "length=None of memory=bank.*expected int"),
        ({"memory": "bank", "memory_settings": {"length": {"a": 1}}}, "expected int"),
        ({"memory_settings": {"time_codes": False, "content": False}}, "says nothing"),
    ],
)
def test_a_memory_that_cannot_be_is_refused_in_a_sentence(asked_for: dict[str, Any], told: str) -> None:
    with pytest.raises(MemobenchError, match=told):
        MemobenchMemConfig(device="cpu", **asked_for)


def test_settings_of_the_memory_that_a_checkpoint_had_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(configuration_memobench_mem.logger, "warning", lambda text, *of: told.append(text % of))
    had = MemobenchMemConfig(device="cpu").memory_settings
    for name in set(OURS) - {"frames", "subgoal"}:  # the latter's are the same
        found = MemobenchMemConfig(device="cpu", memory=name, memory_settings=had).memory_settings
        assert found == vars(read_settings(name, {}))
        assert told.pop() == f"memory_settings are those of memory=frames; memory={name} keeps its own"
    kept = {"time_codes": False, "content": True}
    assert MemobenchMemConfig(device="cpu", memory="subgoal", memory_settings=kept).memory_settings == kept
    assert not told
    # LeRobot joins what is given to what a checkpoint holds.
    joined = MemobenchMemConfig(device="cpu", memory="bank", memory_settings={**kept, "length": 4}).memory_settings
    assert joined == {"time_codes": False, "length": 4}
    with pytest.raises(MemobenchError, match="'content', which is no setting of memory=bank"):
        MemobenchMemConfig(device="cpu", memory="bank", memory_settings={"content": True, "length": 4})


def test_a_package_that_brings_no_memory_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    brought = [
        EntryPoint("gone", "no_such_package:Memory", memory.GROUP),
        EntryPoint("other", "pathlib:Path", memory.GROUP),
        EntryPoint("twice", "one_package:Memory", memory.GROUP),
        EntryPoint("twice", "another:Memory", memory.GROUP),
        EntryPoint("unset", f"{__name__}:Unset", memory.GROUP),
        EntryPoint("frames", "pathlib:Path", memory.GROUP),
    ]
    monkeypatch.setattr(memory, "entry_points", lambda group: brought if group == memory.GROUP else [])
    for name, told in (
        ("gone", "cannot be imported"),
        ("other", "no subclass of MemoryMechanism"),
        ("twice", r"several memories 'twice' \(another:Memory and one_package:Memory\)"),
        ("unset", "Settings of the memory 'unset'.*are no dataclass"),
    ):
        with pytest.raises(MemobenchError, match=told):
            find_mechanism(name)
    told_of: list[str] = []
    monkeypatch.setattr(memory.logger, "warning", lambda text, *of: told_of.append(text % of))
    assert find_mechanism.__wrapped__("frames") is Frames
    assert told_of == ["the memory 'frames' of a package (pathlib:Path) is not used: ours has this name"]


class Unset(Frames):
    """A mechanism of another package, whose settings are none."""

    Settings = dict


class Straight(Frames):
    """A mechanism of another package, whose layers have the names that those of frames once had."""

    def __init__(self, spec: MemorySpec, pool: nn.Module, settings: Any) -> None:
        super().__init__(spec, pool, settings)
        self.position, self.project = nn.Linear(2, 2), nn.Linear(2, 2)


class Sampled(Recurrent):
    """A mechanism that is loaded frames spread evenly, and is gone through as if they were all."""

    slots = classmethod(lambda cls, slot, frames: sample_frames(slot, frames))  # type: ignore[assignment]


def test_frames_that_are_no_beginning_of_an_episodes_are_refused() -> None:
    given = read_settings("recurrent", {"gradient_frames": 1})
    built = Sampled(MemorySpec(4, 2, 32, 32, 3, 0, 1), nn.Identity(), given)
    frames, steps = torch.randn(9, 2, 4), torch.arange(9)
    assert built.replay(Histories(frames, steps, torch.tensor([[0, 1, 2], [0, 1, -1]]))).each.isfinite().all()
    with pytest.raises(ValueError, match="slots of Sampled are not the beginning of one sequence"):
        built.replay(Histories(frames, steps, torch.tensor([sample_frames(8, 3), sample_frames(3, 3)])))


def test_only_what_frames_had_is_renamed_in_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    brought = [EntryPoint("straight", f"{__name__}:Straight", memory.GROUP)]
    monkeypatch.setattr(memory, "entry_points", lambda group: brought)
    for name, renamed in (("straight", ("", "")), ("frames", ("model.memory.encoder.", "model.memory."))):
        policy = MemobenchMemPolicy(small_config(memory=name))
        saved = {key: tensor.clone() for key, tensor in policy.state_dict().items()}
        save_file({key.replace(*renamed): tensor for key, tensor in saved.items()}, tmp_path / "weights.safetensors")
        with torch.no_grad():
            for parameter in policy.model.memory_parameters().values():
                parameter.zero_()
        load_weights(policy, tmp_path / "weights.safetensors", name, policy.config)
        assert all(torch.equal(tensor, saved[key]) for key, tensor in policy.state_dict().items())


# -- frames -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("off", "matters"), [({}, "both"), ({"time_codes": False}, "content"), ({"content": False}, "time")]
)
def test_frames_tell_what_they_are_set_to(off: dict[str, bool], matters: str) -> None:
    mechanism, query = made("frames", 4, **off), asked(1)
    with torch.no_grad():
        stored = torch.randn(3, 1, 6)
        read = [
            mechanism.read(rolled_out(mechanism, frames, stride, query)).rows()
            for frames, stride in ((stored, 8), (stored + 1, 8), (stored, 9))
        ]
    assert torch.equal(read[0], read[1]) == (matters == "time")
    assert torch.equal(read[0], read[2]) == (matters == "content")


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


class Rows(Rollout):
    """A rollout whose frames are one number each, kept with their steps."""

    def __init__(self, stride: int) -> None:
        super().__init__(True, stride)

    def see(self, clocks: list[tuple[int, int]], values: list[float]) -> tuple[list[int], list[bool], list[bool]]:
        def write(rows: list[int]) -> None:
            for row in rows:
                held = self.rows[row]
                held.memory = [*(held.memory or []), (held.position, values[row])]

        return self.observe(clocks, write)


def acting(*steps: int) -> list[tuple[int, int]]:
    """Return the clocks of rows in their execution."""
    return [(1, step) for step in steps]


def test_rows_start_freeze_and_stay_apart() -> None:
    memory, new, old = Rows(1), True, False
    assert memory.see(acting(0, 0), [1.0, 2.0]) == ([0, 0], [new, new], [False, False])
    assert memory.see(acting(1, 0), [3.0, 99.0]) == ([1, 0], [old, old], [False, True])  # row 1 frozen
    assert memory.see(acting(2, 1), [5.0, 4.0]) == ([2, 1], [old, old], [False, False])
    assert memory.see(acting(0, 2), [7.0, 6.0]) == ([0, 2], [new, old], [False, False])  # row 0 begins
    assert [row.memory for row in memory.rows] == [[(0, 7.0)], [(0, 2.0), (1, 4.0), (2, 6.0)]]


def test_frames_are_written_every_so_many_steps() -> None:
    memory = Rows(3)
    for step in range(20):
        memory.see(acting(step), [float(step)])
    assert memory.rows[0].memory == [(step, float(step)) for step in (0, 3, 6, 9, 12, 15, 18)]
    memory.reset()
    assert memory.rows == []


def test_a_frame_that_was_not_offered_is_noticed() -> None:
    memory = Rows(4)
    for step in (0, 3, 4, 4, 6, 8):  # what lies between two frames that are written may be left out
        memory.see(acting(step, 1), [1.0, 1.0])
    assert memory.missed([0, 1]) is None
    memory.see(acting(13, 6), [1.0, 1.0])
    assert (memory.missed([0]), memory.missed([1]), memory.missed([0, 1])) == (12, 4, 4)
    memory.see(acting(14, 0), [1.0, 1.0])
    assert (memory.missed([0]), memory.missed([1])) == (12, None), "a new episode has missed nothing"


def test_the_clock_starts_again_with_the_execution() -> None:
    """The prompt's frames stay in the history, whose own time goes on; a clock that counts through tells the same."""
    for first in (0, 3):
        memory = Rows(1)
        clocks = [(0, 0), (0, 1), (0, 2), (1, first), (1, first + 1), (1, first + 1), (1, first + 3)]
        found = [memory.see([clock], [1.0]) for clock in clocks]
        assert [steps for steps, _, _ in found] == [[0], [1], [2], [3], [4], [4], [6]]
        assert [started for _, started, _ in found] == [[True], *[[False]] * 6]
        assert [frozen for _, _, frozen in found] == [[False]] * 5 + [[True], [False]]
        assert memory.see([(0, 0)], [1.0]) == ([0], [True], [False])
        assert memory.rows[0].memory == [(0, 1.0)]


def test_an_execution_without_a_prompt_begins_again_at_step_0() -> None:
    memory = Rows(1)
    for clock, began in (((1, 0), True), ((1, 1), False), ((1, 0), True), ((1, 0), False)):
        assert memory.see([clock], [1.0])[1] == [began]


# -- memory encoder ---------------------------------------------------------------------------------------------------


def position_features(steps: torch.Tensor) -> torch.Tensor:
    """Return sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each, of steps (...): (..., 16, 768)."""
    y, x = torch.meshgrid(torch.arange(4.0) * 4 + 2, torch.arange(4.0) * 4 + 2, indexing="ij")
    places = torch.broadcast_tensors(steps[..., None].to(torch.float64), y.flatten(), x.flatten())
    frequencies = [base ** -(torch.arange(128, dtype=torch.float64) / 127) for base in (10_000.0, 1_000.0, 1_000.0)]
    angles = [place[..., None] * some for place, some in zip(places, frequencies, strict=True)]
    return torch.cat([wave for angle in angles for wave in (angle.sin(), angle.cos())], dim=-1).float()


@pytest.mark.parametrize(
    "steps", [[[9, 4, 700], [4, 9, 1199]], [[9], [4], [700], [4], [9]]], ids=["rows", "one by one"]
)
def test_encoder_equals_its_formula_token_by_token(steps: list[list[int]]) -> None:
    """concat(image, SiLU(Linear(position))) -> Linear, although the code never builds the concatenations."""
    encoder, seen = MemoryEncoder(image_dim=6, memory_dim=10), torch.tensor(steps)
    tokens = torch.randn(*seen.shape, 16, 6)
    memory = encoder(tokens, seen)
    position = torch.nn.functional.silu(encoder.position(position_features(seen)))
    expected = encoder.project(torch.cat([tokens, position], dim=-1))
    torch.testing.assert_close(memory, expected, rtol=1e-5, atol=1e-5)
    weights = [*encoder.parameters()]
    for made, by_formula in zip(
        *(torch.autograd.grad(of.square().sum(), weights) for of in (memory, expected)), strict=True
    ):
        torch.testing.assert_close(made, by_formula, rtol=1e-4, atol=1e-4)
