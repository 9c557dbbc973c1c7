"""`needs_observation`: observations that a policy does not need have no effect on its actions."""

from __future__ import annotations

import itertools
import pkgutil
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_memobench.policies.baselines import (
    MemobenchExpertConfig,
    MemobenchExpertPolicy,
    MemobenchRandomConfig,
    MemobenchRandomPolicy,
)
from lerobot_memobench.rollouts.rollout import CHUNKED, ActionQueue, plans_chunks
from tests.support.lerobot_policies import make_config
from tests.support.policy_server import PolicyServer, counting, make
from tests.support.small_policy import made_for_training

CAMERAS = ("observation.images.image", "observation.images.wrist_image")
SIDES = {"image": 96, "wrist_image": 96}
STEPS, PLAN = 10, 3
Row = tuple[int, int]
"""Control step and phase of an environment."""


def observation(rows: Sequence[Row], time: int, **more: Any) -> dict[str, Any]:
    """Return an observation as LeRobot's loop does, with new images at each step."""
    generator = torch.Generator().manual_seed(time)
    return {
        **{key: torch.rand(len(rows), 3, 96, 96, generator=generator) for key in CAMERAS},
        "observation.state": torch.rand(len(rows), 8, generator=generator),
        "observation.step": torch.tensor([[float(step)] for step, _ in rows]),
        "observation.phase": torch.tensor([[float(phase)] for _, phase in rows]),
        "observation.expert_action": torch.rand(len(rows), 7, generator=generator),
        "observation.language.tokens": torch.ones(len(rows), 8, dtype=torch.long),
        "observation.language.attention_mask": torch.ones(len(rows), 8, dtype=torch.bool),
        "task": ["turn on the stove"] * len(rows),
        **more,
    }


def acted(
    policy: Any, clock: Callable[[int], Sequence[Row]], blind: bool, before: Callable[[Any], Any] = lambda batch: batch
) -> tuple[Tensor, list[int]]:
    """Return a rollout's actions (time, rows, 7), and the times of needed observations.

    Args:
        blind: replace images that are not needed by NaN. The first frames of an episode and of its execution are
            always shown.
    """
    torch.manual_seed(0)
    queue, seen, actions = ActionQueue(policy), [], []
    queue.reset()
    shown, phases = True, None
    for time in range(STEPS):
        rows = clock(time)
        shown = shown or phases != [phase for _, phase in rows]
        phases = [phase for _, phase in rows]
        batch = observation(rows, time)
        if shown:
            seen.append(time)
        elif blind:
            batch |= {key: torch.full((len(rows), 3, 96, 96), torch.nan) for key in CAMERAS}
        actions.append(queue.select(before(batch)))
        shown = queue.needs_observation()
    return torch.stack(actions), seen


def check(policy: Any, clock: Callable[[int], Sequence[Row]], looked: Sequence[int], **more: Any) -> None:
    blind, seen = acted(policy, clock, blind=True, **more)
    assert seen == list(looked)
    assert blind.isfinite().all()
    assert torch.equal(blind, acted(policy, clock, blind=False, **more)[0])


def execution(time: int) -> list[Row]:
    """Return the clocks of two environments without prompt."""
    return [(time, 1), (time, 1)]


def prompts(time: int) -> list[Row]:
    """Return the clocks of two environments with prompts of 3 and 5 steps; the first ends at step 8."""
    return [(min(time, 8), int(time >= 3)), (time, int(time >= 5))]


EVERY_PLAN = range(0, STEPS, PLAN)


def act(**fields: Any) -> Any:
    return get_policy_class("act")(make_config("act", SIDES, **{"n_action_steps": PLAN} | fields))


def test_act() -> None:
    check(act(), execution, EVERY_PLAN)
    check(act(temporal_ensemble_coeff=0.01, n_action_steps=1), execution, range(STEPS))


@pytest.mark.parametrize("name", CHUNKED)
def test_a_queued_plan_has_the_actions_of_lerobot(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot may change ``select_action``: here it plans by the number of plans before."""
    kind = pkgutil.resolve_name(name)
    monkeypatch.setattr(kind, "eval", lambda self: self)

    def made() -> Any:
        policy, plans = kind.__new__(kind), itertools.count()
        torch.nn.Module.__init__(policy)
        policy.config = SimpleNamespace(temporal_ensemble_coeff=None, n_action_steps=PLAN, rtc_config=None)
        policy._action_queue, policy._queues = deque(), {ACTION: deque(maxlen=PLAN)}
        policy._prepare_batch = lambda batch: batch
        plan = lambda batch, *_: torch.arange(2 * 7 * 7.0).view(2, 7, 7) + 1000 * next(plans)  # noqa: E731
        policy.predict_action_chunk = policy._get_action_chunk = plan
        policy.reset = lambda: None
        return policy

    alone, queue = made(), ActionQueue(made())
    for _ in range(2 * PLAN + 1):
        assert torch.equal(queue.select({}), alone.select_action({}))


def test_unknown_policies_need_every_observation() -> None:
    class Watchful(type(act())):  # type: ignore[misc]
        def select_action(self, batch: dict[str, Tensor]) -> Tensor:
            return super().select_action(batch)  # type: ignore[no-any-return]

    policy = act()
    assert plans_chunks(policy)
    assert not needs_after_a_plan(policy)
    policy.config.temporal_ensemble_coeff = 0.01
    assert not plans_chunks(policy)
    policy.config.temporal_ensemble_coeff = None
    policy.__class__ = Watchful
    assert needs_after_a_plan(policy)
    assert ActionQueue(object()).needs_observation()


def needs_after_a_plan(policy: Any) -> bool:
    queue = ActionQueue(policy)
    queue.reset()
    queue.select(observation(execution(0), 0))
    return queue.needs_observation()


def test_baselines_need_no_observations() -> None:
    check(MemobenchExpertPolicy(MemobenchExpertConfig()), prompts, [0, 3, 5])
    policy = MemobenchRandomPolicy(MemobenchRandomConfig())
    assert acted(policy, prompts, blind=True)[1] == [0, 3, 5]


def test_memory_needs_stored_frames_and_plans(dataset_root: Path) -> None:
    """Every fourth frame is remembered. Plans begin at 3 and 5 and last three steps; row 0 would replan at 9."""
    policy, before, _, _ = made_for_training(dataset_root, n_action_steps=PLAN, memory_stride=4)
    check(policy, prompts, [0, 3, 4, 5, 6, 8, 9], before=before)


@pytest.mark.parametrize(
    ("fields", "looked"),
    [({"dialect": "openpi", "history_every": 2}, [0, 2, 3, 4, 5, 6, 8, 9]), ({"dialect": "robomme"}, range(STEPS))],
    ids=["openpi", "robomme"],
)
def test_servers_get_needed_observations(fields: dict[str, Any], looked: Sequence[int]) -> None:
    with PolicyServer(counting) as one, PolicyServer(counting) as other:
        servers = f"127.0.0.1:{one.port},127.0.0.1:{other.port}"
        policy = make(one, servers=servers, n_action_steps=PLAN, **fields)
        check(policy, prompts, looked)
