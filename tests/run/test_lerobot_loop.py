"""What LeRobot's loop is made to do: parts of a task, and draws that depend on a batch alone."""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
import random
from contextlib import nullcontext
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.scripts import lerobot_eval

from lerobot_memobench import lerobot_hooks
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run import rollout as rollouts
from lerobot_memobench.run.rollout import (
    KEEPS_FRAMES,
    KNOWN,
    LOOPS,
    RECORDS,
    batch_seed,
    needs_observation,
    sparing,
    steered,
)


class Env:
    def call(self, name: str) -> list[str]:
        assert name == "task"
        return ["a_task", "a_task"]


# --- what is relied on: where one of these fails, LeRobot's loop is another one ---

MODULE = "src/lerobot_memobench/run/rollout.py, and lerobot/scripts/lerobot_eval.py beside it"

PARAMETERS = {
    "run_one": {
        "n_episodes": "_only() asks for part of a task by it",
        "start_seed": "_only() begins a part by it: run k of a task has the seed start_seed + k",
        "videos_dir": "_only() gives each of several parts films of its own by it, _unfilmed() takes it away",
        "max_episodes_rendered": "_unfilmed() lets none be rendered by it",
        "policy": "_unfilmed() asks it whether it makes videos of its own",
        "recording_dir": "_only() gives each of several parts recordings of its own by it",
    },
    "rollout": {
        "env": "_seeded() asks it for the task",
        "policy": "_seeded() seeds its generators",
        "seeds": "_seeded() knows the batch by its first one",
        **dict.fromkeys(KEEPS_FRAMES, "sparing() leaves LeRobot's own loop to it"),
        **dict.fromkeys(RECORDS, "sparing() records the batch by it"),
        "preprocessor": "sparing() takes observations through it",
        "postprocessor": "sparing() takes actions through it",
        "env_preprocessor": "sparing() takes observations through it",
        "env_postprocessor": "sparing() takes actions through it",
    },
}

LOOKING = "src/lerobot_memobench/run/rollout.py says by it when the policy looks at pictures"

CALLS = {
    ("eval_policy", "rollout("): "looks rollout up in its module for each batch, where _seeded() stands",
    ("eval_policy", "env=env"): "passes rollout's arguments by name, as _seeded() reads them",
    ("eval_policy", "policy=policy"): "passes rollout's arguments by name, as _seeded() reads them",
    ("eval_policy", "seeds=list(seeds)"): "gives a batch the seeds of its episodes",
    ("eval_policy_all", "run_one,"): "looks run_one up in its module when it begins, where _only() stands",
    ("eval_policy_all", "start_seed=start_seed"): "gives every task the run's seed",
    (
        "rollout",
        "disable=inside_slurm()",
    ): "draws no bar in a batch job, which calm_output() makes it take itself to be in",
}

READ = {
    "lerobot.scripts.lerobot_eval.rollout": (
        LOOPS,
        "src/lerobot_memobench/run/rollout.py takes the same steps in the same order",
    ),
    "lerobot.envs.utils.preprocess_observation": (
        ("10196a71b8af",),
        "src/lerobot_memobench/run/rollout.py keeps the pictures that it makes, by their names",
    ),
    **{f"{module}.{name}.select_action": (policy.read, LOOKING) for (module, name), policy in KNOWN.items()},
    "lerobot.policies.smolvla.modeling_smolvla.SmolVLAPolicy._prepare_batch": (("57d81cd4cddd",), LOOKING),
}
"""Function that was read -> the first digits of its source's hash in LeRobot 0.6.1 and its main where they differ, and
what was written by it."""


def test_this_is_a_lerobot_whose_loop_is_known() -> None:
    found = metadata.version("lerobot")
    assert found in lerobot_hooks.READ, (
        f"lerobot {found} is installed. Read {MODULE}: does it still do what the tests below say? Compare the film and "
        "the log of one killed and resumed evaluation (tests/cli/test_killed_evaluation.py), then add it to READ"
    )


@pytest.mark.parametrize("function", PARAMETERS)
def test_lerobot_takes_what_is_passed_to_it(function: str) -> None:
    found = inspect.signature(getattr(lerobot_eval, function)).parameters
    for name, why in PARAMETERS[function].items():
        assert name in found, f"lerobot_eval.{function} has no {name} any more, and {why}. Look at {MODULE}"


@pytest.mark.parametrize(("function", "call"), CALLS)
def test_lerobot_calls_what_is_put_in_its_place(function: str, call: str) -> None:
    source = inspect.getsource(getattr(lerobot_eval, function))
    assert call in source, (
        f"lerobot_eval.{function} holds no {call!r} any more; it was relied on that it {CALLS[function, call]}. "
        f"Look at {MODULE}"
    )


@pytest.mark.parametrize("function", READ)
def test_lerobot_does_what_was_read(function: str) -> None:
    found, (known, why) = lerobot_hooks.digest(pkgutil.resolve_name(function)), READ[function]
    assert found in known, f"{function} is another one ({found}), and {why}: read it again, then note its hash"


def test_another_lerobot_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "0.8.0")
    before = lerobot_eval.run_one, lerobot_eval.rollout
    with (
        pytest.raises(MemobenchError, match=r"lerobot 0\.8\.0 is installed.* install lerobot==0\.6\.1"),
        steered(7, {}),
    ):
        pass
    assert (lerobot_eval.run_one, lerobot_eval.rollout) == before


# --- a version that nobody has read ---


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "0.7.5")


@pytest.mark.usefixtures("unread")
@pytest.mark.parametrize("hook", lerobot_hooks.there(), ids=lambda hook: hook.name)
def test_an_unread_version_that_calls_the_same_functions_is_taken(hook: lerobot_hooks.Hook) -> None:
    lerobot_hooks.install(hook, lambda theirs: theirs)()


@pytest.mark.usefixtures("unread")
def test_an_unread_version_that_calls_another_function_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_eval, "run_one", lambda *_, **named: None)  # a place that no hook has stood in
    odd = dataclasses.replace(lerobot_hooks.RUN_ONE, by_name=("episodes",))
    with pytest.raises(MemobenchError, match=r"lerobot_eval does not call run_one\(episodes=\) any more.*make setup"):
        lerobot_hooks.install(odd, lambda theirs: theirs)


def test_an_unread_loop_rolls_out_itself_and_gets_every_picture() -> None:
    calls: list[dict[str, Any]] = []
    policy = SimpleNamespace(parameters=tuple)
    sparing(lambda env, policy, **named: calls.append(named), lambda: True)(env=None, policy=policy, seeds=[1])
    assert calls == [{"seeds": [1]}]


class Queueing:
    """A policy of LeRobot's as far as the loop asks."""

    name = "act"

    def parameters(self) -> tuple[()]:
        return ()


@pytest.mark.parametrize("queue", ["_action_queue", "_queues", None])
def test_two_rollouts_at_once_share_no_queue(queue: str | None) -> None:
    """As with env.max_parallel_tasks=2."""
    policy, calls = Queueing(), []
    if queue is not None:
        setattr(policy, queue, [])

    def rollout(env: Any, policy: Any, again: bool = False) -> None:
        calls.append(again)
        if again:
            run(env=env, policy=policy)

    run = sparing(rollout, lambda: True)
    for _ in range(2):  # one after the other
        run(env=None, policy=policy)
    with pytest.raises(MemobenchError, match="act has one queue") if queue else nullcontext():
        run(env=None, policy=policy, again=True)
    run(env=None, policy=policy)
    assert calls == [False, False, True, False] + [False] * (queue is None)


@pytest.mark.parametrize("read", [True, False])
def test_an_unread_policy_needs_every_observation(read: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.policies.act.modeling_act import ACTPolicy

    policy = ACTPolicy.__new__(ACTPolicy)
    vars(policy).update(config=SimpleNamespace(temporal_ensemble_coeff=None), _action_queue=[1])
    monkeypatch.setattr(rollouts, "is_read", lambda function, known: read)
    assert needs_observation(policy)() is not read


def test_a_visual_memory_needs_every_observation() -> None:
    """Between two chunks too: its queue takes in one picture per control step."""
    pi05 = KNOWN["lerobot.policies.pi05.modeling_pi05", "PI05Policy"]
    acting = {
        memory: SimpleNamespace(config=SimpleNamespace(use_visual_memory=memory), _action_queue=[1])
        for memory in (False, True)
    }
    assert {memory: pi05.needs(policy) for memory, policy in acting.items()} == {False: False, True: True}


# --- what it is made to do ---


def test_ranges_are_run_one_by_one_and_joined(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[dict[str, Any]] = []

    def run_one(group: str, number: int, env: Any, **settings: Any) -> Any:
        calls.append({"task": (group, number), **settings})
        return group, number, {"successes": [True] * settings["n_episodes"], "video_paths": []}

    monkeypatch.setattr(lerobot_eval, "run_one", run_one)
    policy = SimpleNamespace(config=SimpleNamespace(save_predicted_video=True))
    settings = {"n_episodes": 50, "start_seed": 7, "videos_dir": tmp_path, "recording_dir": None, "policy": policy}
    with steered(7, {("temporal", 1): [(0, 4), (20, 2)], ("temporal", 2): [(10, 5)]}):
        assert lerobot_eval.run_one("temporal", 0, None, **settings) == ("temporal", 0, {})
        assert lerobot_eval.run_one("temporal", 1, None, **settings)[2] == {"successes": [True] * 6, "video_paths": []}
        lerobot_eval.run_one("temporal", 2, None, **settings)
    assert [(c["task"][1], c["start_seed"], c["n_episodes"], c["videos_dir"]) for c in calls] == [
        (1, 7, 4, tmp_path / "from_0"),
        (1, 27, 2, tmp_path / "from_20"),
        (2, 17, 5, tmp_path),
    ]
    assert lerobot_eval.run_one is run_one


@pytest.mark.parametrize("ranges", [None, {("temporal", 1): [(0, 4)]}], ids=["all", "part"])
def test_lerobot_renders_no_films_of_its_own(ranges: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(lerobot_eval, "run_one", lambda *task, **settings: (*task[:2], calls.append(settings) or {}))
    settings = {"n_episodes": 50, "start_seed": 7, "videos_dir": tmp_path, "max_episodes_rendered": 10}
    with steered(7, ranges):
        lerobot_eval.run_one("temporal", 1, None, **settings)
    ((rendered, folder, count),) = [(c["max_episodes_rendered"], c["videos_dir"], c["n_episodes"]) for c in calls]
    assert (rendered, folder, count) == (0, None, 50 if ranges is None else 4)


def test_what_keeps_frames_is_left_to_lerobots_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where not only the policy looks: a world model's videos, observations that are returned."""
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(lerobot_eval, "rollout", lambda env, policy, **settings: calls.append(settings))
    with steered(None):
        for name in KEEPS_FRAMES:
            lerobot_eval.rollout(env=None, policy=None, **{name: object()})
    assert [next(iter(settings)) for settings in calls] == list(KEEPS_FRAMES)


def draws(first: int, history: int = 0, seed: int | None = 7, name: str = "diffusion", own: int = 0) -> list[float]:
    """What a policy draws in the batch that starts at ``first``, after a history of other draws."""
    policy = SimpleNamespace(name=name, _generator=torch.Generator().manual_seed(own))
    found: list[float] = []

    def rollout(env: Any, policy: Any, seeds: list[int]) -> None:
        found[:] = [
            torch.rand(1).item(),
            random.random(),
            np.random.rand(),  # noqa: NPY002 - what LeRobot seeds
            torch.rand(1, generator=policy._generator).item(),
        ]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_eval, "rollout", rollout)
        patch.setattr("lerobot_memobench.run.rollout.sparing", lambda theirs, *_: theirs)
        torch.manual_seed(7)
        torch.rand(history)
        with steered(seed):
            for k in range(3 if history else 0):
                lerobot_eval.rollout(env=Env(), policy=policy, seeds=[100 + k])
            lerobot_eval.rollout(env=Env(), policy=policy, seeds=[first, first + 1])
    return found


def test_draws_do_not_depend_on_what_ran_before() -> None:
    assert draws(27) == draws(27, history=5)
    assert all(a != b for a, b in zip(draws(27), draws(28), strict=True))
    assert all(a != b for a, b in zip(draws(27), draws(27, seed=8), strict=True))


def test_a_policys_own_seed_still_counts() -> None:
    assert draws(27, own=1)[3] == draws(27, own=1, history=5)[3] != draws(27, own=2)[3]


def test_a_policy_that_seeds_its_noise_itself_keeps_the_runs_seed() -> None:
    kept: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_eval, "rollout", lambda env, policy, seeds: kept.append(torch.initial_seed()))
        patch.setattr("lerobot_memobench.run.rollout.sparing", lambda theirs, *_: theirs)
        torch.manual_seed(7)
        with steered(7):
            lerobot_eval.rollout(env=Env(), policy=SimpleNamespace(name="memobench_mem"), seeds=[9])
    assert kept == [7]


def test_batch_seeds_are_told_apart_and_fit_numpy() -> None:
    seeds = {batch_seed(7, task, first) for task in ("a", "b") for first in range(500)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**32 for seed in seeds)
