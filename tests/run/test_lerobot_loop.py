"""What is relied on of LeRobot beside its interfaces, and the seeds of batches."""

from __future__ import annotations

import pkgutil
import random
from importlib import metadata
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_memobench.run import rollout as rollouts
from lerobot_memobench.run.rollout import KNOWN, BatchSeeds, batch_seed, digest, has_planned_action, needs_observation

LOOKING = "run/rollout.py says by it when a policy needs an observation"

READ = {
    "lerobot.envs.utils.preprocess_observation": (
        ("10196a71b8af",),
        "run/rollout.py keeps the pictures that it makes, by their names",
    ),
    **{f"{module}.{name}.select_action": (policy.read, LOOKING) for (module, name), policy in KNOWN.items()},
    "lerobot.policies.smolvla.modeling_smolvla.SmolVLAPolicy._prepare_batch": (("57d81cd4cddd",), LOOKING),
}
"""Function that was read -> the first digits of its source's hash in LeRobot 0.6.1 and its main where they differ, and
what was written by it."""


@pytest.mark.parametrize("function", READ)
def test_lerobot_does_what_was_read(function: str) -> None:
    found, (known, why) = digest(pkgutil.resolve_name(function)), READ[function]
    assert found in known, f"{function} is another one ({found}), and {why}: read it again, then note its hash"


# --- a version that nobody has read ---


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "0.7.5")


@pytest.mark.parametrize("read", [True, False])
def test_an_unread_policy_needs_every_observation(read: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.policies.act.modeling_act import ACTPolicy

    policy = ACTPolicy.__new__(ACTPolicy)
    vars(policy).update(config=SimpleNamespace(temporal_ensemble_coeff=None), _action_queue=[1])
    if not read:
        monkeypatch.setattr(rollouts, "digest", lambda function: "another")
    assert (needs_observation(policy)(), has_planned_action(policy)()) == (not read, read)


def test_a_visual_memory_needs_every_observation() -> None:
    """Between two chunks too: its queue takes in one picture per control step."""
    pi05 = KNOWN["lerobot.policies.pi05.modeling_pi05", "PI05Policy"]
    acting = {
        memory: SimpleNamespace(config=SimpleNamespace(use_visual_memory=memory), _action_queue=[1])
        for memory in (False, True)
    }
    assert {memory: pi05.planned(policy) for memory, policy in acting.items()} == {False: True, True: False}


# --- seeds ---


def draws(first: int, history: int = 0, seed: int = 7, own: int = 0) -> list[float]:
    """What a policy draws in the batch that starts at ``first``, after a history of other draws."""
    policy = SimpleNamespace(name="diffusion", _generator=torch.Generator().manual_seed(own))
    seeds = BatchSeeds(policy, seed)
    torch.manual_seed(7)
    torch.rand(history)
    for k in range(3 if history else 0):
        seeds.begin("a_task", 100 + k)
        torch.rand(1, generator=policy._generator)
    seeds.begin("a_task", first)
    return [
        torch.rand(1).item(),
        random.random(),
        np.random.rand(),  # noqa: NPY002 - what LeRobot seeds
        torch.rand(1, generator=policy._generator).item(),
    ]


def test_draws_do_not_depend_on_what_ran_before() -> None:
    assert draws(27) == draws(27, history=5)
    assert all(a != b for a, b in zip(draws(27), draws(28), strict=True))
    assert all(a != b for a, b in zip(draws(27), draws(27, seed=8), strict=True))


def test_a_policys_own_seed_still_counts() -> None:
    assert draws(27, own=1)[3] == draws(27, own=1, history=5)[3] != draws(27, own=2)[3]


def test_a_policy_that_seeds_its_noise_itself_keeps_the_runs_seed() -> None:
    torch.manual_seed(7)
    BatchSeeds(SimpleNamespace(name="memobench_mem"), 7).begin("a_task", 9)
    assert torch.initial_seed() == 7


def test_batch_seeds_are_told_apart_and_fit_numpy() -> None:
    seeds = {batch_seed(7, task, first) for task in ("a", "b") for first in range(500)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**32 for seed in seeds)
