"""The rows of a rollout: their action queues, one thread, and LeRobot's real-time chunking."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.rollout.inference.rtc import supports_rtc_inference

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.rollout import Row
from lerobot_memobench.protocol import CONTROL_HZ
from tests.support.memory import remembered, trained_on
from tests.support.object_dataset import make_object_dataset
from tests.support.small_policy import made_for_training

STATE = torch.tensor([0.1, 0.2, 1.0, 3.13, 0.1, 0.0, 0.04, -0.04])
AXIS = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0])


def carried_out(*states: torch.Tensor | None) -> list[int]:
    """Return how much is carried out of plans of 16 actions, made one after another where the robot is so."""
    row, counts = Row(), []
    for state in states:
        row.begin_chunk(torch.zeros(16, 7), 6, state)
        counts.append(len(row.queue))
        row.queue.clear()
    return counts


def moved(index: int, by: float) -> torch.Tensor:
    return STATE + by * torch.eye(8)[index]


@pytest.mark.parametrize(
    "where", [STATE, moved(2, 0.005), moved(6, 0.005), moved(4, 0.05), STATE - 2 * STATE * AXIS * 1.0035]
)
def test_a_hand_that_stands_still_carries_out_all(where: torch.Tensor) -> None:
    """The last one is turned by nearly the same angle, past half a turn: its axis points the other way."""
    assert carried_out(STATE, where) == [6, 16]


@pytest.mark.parametrize("where", [moved(2, 0.01), moved(7, 0.01), moved(4, 0.2)])
def test_a_hand_or_a_finger_that_moves_carries_out_some(where: torch.Tensor) -> None:
    assert carried_out(STATE, where) == [6, 6]


def test_without_a_state_and_after_a_plan_was_dropped_it_is_some() -> None:
    assert carried_out(None, None) == [6, 6]
    row = Row()
    row.begin_chunk(torch.zeros(16, 7), 6, STATE)
    row.drop_chunk()
    row.begin_chunk(torch.zeros(16, 7), 6, STATE)
    assert len(row.queue) == 6


# -- one thread -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def acting(dataset_root: Path) -> Any:
    policy, before, _, dataset = made_for_training(dataset_root, memory_frames=2)
    item = dataset[0]
    observed = {k: v[None] for k, v in item.items() if k.startswith("observation.") and isinstance(v, torch.Tensor)}
    batch = before(observed | {"task": [item["task"]]})
    return policy, lambda: policy.select_action(batch)


def test_a_rollout_in_another_thread_is_refused_and_not_mixed(acting: Any) -> None:
    """What LeRobot does with env.max_parallel_tasks=2."""
    policy, act = acting
    policy.reset()
    act()
    with ThreadPoolExecutor(1) as other:
        other.submit(policy.reset).result()
        other.submit(act).result()
        with pytest.raises(MemobenchError, match="max_parallel_tasks=1"):
            act()


def test_rollouts_one_after_the_other_may_come_from_any_thread(acting: Any) -> None:
    policy, act = acting
    for _ in range(2):
        with ThreadPoolExecutor(1) as other:
            other.submit(policy.reset).result()
            assert other.submit(act).result().shape == (1, 7)
    policy.reset()
    act()
    act()


def test_a_new_instruction_drops_planned_actions_and_keeps_the_history(acting: Any) -> None:
    policy, act = acting
    policy.reset()
    act()
    (row,) = policy.rollout.rows
    history = row.memory
    assert row.queue
    policy.drop_queued_actions()
    assert not row.queue
    assert row.memory is history


# -- real-time chunking -----------------------------------------------------------------------------------------------

OBJECTS: dict[str, Any] = {"perception": "objects", "size": "small", "n_action_steps": 3, "memory_stride": 2}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_object_dataset(tmp_path_factory.mktemp("objects") / "data")


def observation(dataset: Any, index: int, **clock: float) -> dict[str, Any]:
    """What a robot without a clock shows, or one with it."""
    names = ("observation.state", "observation.environment_state")
    told = {f"observation.{name}": torch.tensor([[value]]) for name, value in clock.items()}
    return {name: dataset[index][name][None] for name in names} | told | {"task": [dataset[index]["task"]]}


def chunking(policy: Any) -> Any:
    """As lerobot/rollout/context.py turns it on, after loading."""
    policy.config.rtc_config = RTCConfig(enabled=True, execution_horizon=3)
    policy.init_rtc_processor()
    policy.reset()
    return policy


@pytest.mark.parametrize(
    ("objective", "memory_fusion", "supported"),
    [("regression", "none", False), ("flow_matching", "modulation", True), ("flow_matching", "none", True)],
)
def test_what_is_supported_is_said(root: Path, objective: str, memory_fusion: str, supported: bool) -> None:
    policy = made_for_training(root, **OBJECTS, objective=objective, memory_fusion=memory_fusion)[0]
    assert policy.supports_rtc() == supports_rtc_inference(policy) == supported


def test_a_guided_plan_continues_the_last_one(root: Path) -> None:
    fields = OBJECTS | {"objective": "flow_matching", "memory_fusion": "none", "num_inference_steps": 10}
    policy, before, _, dataset = made_for_training(root, **fields)
    policy.reset()
    batch = before(observation(dataset, 0))
    noise = torch.randn(1, policy.config.chunk_size, 32, generator=torch.Generator().manual_seed(0))
    free = policy.predict_action_chunk(batch, noise=noise)
    left_over = free[0] + 0.5
    chunking(policy)
    guided = policy.predict_action_chunk(batch, noise=noise, inference_delay=3, prev_chunk_left_over=left_over)
    apart = [float((plan[0, :3] - left_over[:3]).abs().mean()) for plan in (free, guided)]
    assert apart[0] == pytest.approx(0.5)
    assert apart[1] < 0.1


@pytest.mark.parametrize("clock", [True, False])
def test_a_guided_plan_reads_its_memory(root: Path, clock: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One observation per plan is what it remembers, at the step or time at which it was seen."""
    fields = OBJECTS | {"objective": "flow_matching", "num_inference_steps": 10, "open_gate": True}
    policy, before, _, dataset = made_for_training(root, **fields)
    chunking(policy)
    noise = torch.randn(1, policy.config.chunk_size, 32, generator=torch.Generator().manual_seed(0))

    def planned(first: int) -> tuple[torch.Tensor, torch.Tensor]:
        """The free and the guided plan at step 7, after a plan at step 0 that saw another frame."""
        found = []
        for left_over in (None, torch.full((3, 7), 0.5)):
            policy.reset()
            for step, seen in ((0, first), (7, 7)):
                monkeypatch.setattr("time.monotonic", lambda step=step: 100.0 + step / CONTROL_HZ)
                batch = before(observation(dataset, seen, **({"step": float(step)} if clock else {})))
                guidance = {} if step == 0 else {"inference_delay": 3, "prev_chunk_left_over": left_over}
                plan = policy.predict_action_chunk(batch, noise=noise, **guidance)
            found.append(plan)
        return found[0], found[1]

    free, guided = planned(0)
    assert [step for _, steps in remembered(policy, [0]) for step in steps] == [0, 7]
    apart = [float((plan[0, :3] - 0.5).abs().mean()) for plan in (free, guided)]
    assert apart[1] < 0.1 < apart[0]
    assert not torch.equal(guided, planned(20)[1]), "the guided plan depends on what was seen before"


def test_regression_refuses_to_be_guided(root: Path) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS, memory_fusion="none")
    with pytest.raises(MemobenchError, match=r"denoising.*inference\.type=sync.*flow_matching"):
        chunking(policy).predict_action_chunk(before(observation(dataset, 0)), inference_delay=3)


def test_a_memory_that_is_offered_one_frame_per_plan_is_refused(root: Path) -> None:
    """By LeRobot's real-time chunking, its policy server, or anybody: two plans and nothing in between."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    policy.reset()
    policy.predict_action_chunk(before(observation(dataset, 0)))
    with pytest.raises(MemobenchError, match=r"two plans with no observation between.*inference\.type=sync.*observe"):
        policy.predict_action_chunk(before(observation(dataset, 6)))
    policy.reset()
    policy.predict_action_chunk(before(observation(dataset, 0, step=0.0)))
    with pytest.raises(MemobenchError, match=r"every 2 control steps, and was not shown step 2 of this episode"):
        policy.predict_action_chunk(before(observation(dataset, 6, step=6.0)))
    without = made_for_training(root, **OBJECTS, memory_fusion="none")[0]
    without.reset()
    for index in (0, 6):
        without.predict_action_chunk(before(observation(dataset, index)))


@pytest.mark.parametrize("clock", [True, False])
def test_a_memory_that_is_offered_every_frame_is_that_of_training(root: Path, clock: bool) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    policy.reset()
    plans = []
    for step in range(13):
        batch = before(observation(dataset, step, **({"step": float(step)} if clock else {})))
        policy.observe(batch)
        if step % 6 == 0:
            plans.append(policy.predict_action_chunk(batch))
    trained = before(torch.utils.data.default_collate([dataset[12]]))
    assert remembered(policy, [0])[0][1] == trained_on(trained)[0][1]
    policy.reset()
    stepwise = []
    for step in range(13):  # as LeRobot's synchronous rollout
        for row in policy.rollout.rows:
            row.queue.clear()
        action = policy.select_action(before(observation(dataset, step)))
        if step % 6 == 0:
            stepwise.append(action)
    assert all(torch.allclose(plan[:, 0], action, atol=1e-5) for plan, action in zip(plans, stepwise, strict=True))
