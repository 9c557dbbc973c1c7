"""Conforming policies pass every check, and each flaw of a policy fails its own checks."""

from __future__ import annotations

import os
import re
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.conformance.checks import (
    CHECKS,
    FAILED,
    NOT_CHECKED,
    PASSED,
    Behaviour,
    run_check,
    run_checks,
)
from lerobot_memobench.conformance.pytest_class import MemoryConformance
from lerobot_memobench.conformance.streams import TASK, _episode, write_streams
from lerobot_memobench.conformance.subject import Subject, load_subject
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.lerobot_policies import words_of

EXAMPLE = ("policy=window", "policy.width=32", "policy.frames=8", "policy.stride=2")
MEM = (
    *("policy=memobench_mem", "policy.size=tiny", "policy.perception=objects", "policy.memory_stride=2"),
    *("policy.memory_settings={frames: 8}", "policy.chunk_size=4", "policy.num_inference_steps=1"),
)


@pytest.fixture(scope="module")
def window(example: Path, objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return load_subject([*EXAMPLE, f"dataset={objects}"], tmp_path_factory.mktemp("window"))


class TestExample(MemoryConformance):
    """A test class as in the guide, with a dataset of its own."""

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def _arguments(cls, example: Path, objects: Path) -> None:
        cls.arguments = (*EXAMPLE, f"dataset={objects}")


def test_memobench_mem_conforms(objects: Path, tmp_path: Path) -> None:
    results = run_checks(load_subject([*MEM, f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {PASSED}, results


# --- a strict dataset: holds, and scenes that are equal at home ---

HOME = np.array([0, 0, 1.1, 3.1, 0, 0, 0, 0], np.float32)
MOVING = 13
ON_HOLDS = ("remembers", "reads the prompt", "plans after the prompt", "same history in training")


@pytest.fixture(scope="module")
def strict(objects: Path) -> Path:
    """Four episodes: one without a prompt, then prompted ones; each is held at home, and leaves it slowly."""
    home = _episode(get_task(TASK), 0, 0, False, 1).objects
    made = []
    for seed, (prompt, hold) in enumerate([(0, 30), (4, 13), (5, 14), (7, 12)]):
        own = _episode(get_task(TASK), seed, prompt, False, MOVING)
        order = np.r_[:prompt, np.full(hold, prompt), prompt : prompt + MOVING]
        held = (np.arange(len(order)) >= prompt) & (np.arange(len(order)) < prompt + hold)
        away = np.r_[np.ones(prompt), np.zeros(hold), np.linspace(0, 1, MOVING) ** 2][:, None]
        away = away.astype(np.float32)
        columns = {name: getattr(own, name)[order] for name in ("states", "satisfied")}
        moved = {
            "actions": own.actions[order] * ~held[:, None],
            "proprio": HOME + away * (own.proprio[order] - HOME),
            "objects": home + away * (own.objects[order] - home),
        }
        made.append(replace(own, held=held, **columns, **moved))
    return write_dataset(iter(made), objects.parent / "strict")


def test_memory_conforms_on_holds_and_a_deaf_one_does_not(
    strict: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = load_subject([*MEM, f"dataset={strict}"], tmp_path)
    results = [run_check(check, found) for found in [Behaviour(subject)] for check in ON_HOLDS]
    assert {result.outcome for result in results} == {PASSED}, results

    class DropsThePrompt(type(subject.policy)):  # type: ignore[misc]
        def observe(self, batch: Any) -> Any:
            before = [row.clock for row in self.rollout.envs]
            for row, clock, phase in zip(self.rollout.envs, before, batch["observation.phase"], strict=False):
                if clock is not None and clock[0] == 0 and phase == 1:
                    row.memory = row.stored = None
            return super().observe(batch)

    monkeypatch.setattr(subject.policy, "__class__", DropsThePrompt)
    subject.policy.reset()
    found = Behaviour(subject)
    for check in ("reads the prompt", "same history in training"):
        assert run_check(check, found).outcome is FAILED, check


# --- a policy with one flaw ---


def flaws(base: Any) -> dict[str, type]:
    """Check -> class of a policy that fails it."""

    class ForgetsNothing(base):
        def reset(self) -> None:
            """Keep all rows."""
            self.rows = list(getattr(self, "rows", []))

        def select_action(self, batch: Any, **_: Any) -> Any:
            count = len(batch["observation.step"])
            kept, self.rows = self.rows[count:], self.rows[:count] if len(self.rows) >= count else []
            action = super().select_action(batch)
            self.rows += kept
            return action

    class ForgetsEverything(base):
        def select_action(self, batch: Any, **_: Any) -> Any:
            for row in self.rows:
                row.past.clear()
            return super().select_action(batch)

    class SharesItsQueue(base):
        """One queue for all rows, as LeRobot's policies have: all plan when the first does."""

        def select_action(self, batch: Any, **_: Any) -> Any:
            if any(not row.queue for row in self.rows):
                for row in self.rows:
                    row.queue.clear()
            return super().select_action(batch)

    class RemembersPlans(base):
        def select_action(self, batch: Any, **_: Any) -> Any:
            action = super().select_action(batch)
            for row in self.rows:
                if row.clock[0] == 1 and len(row.queue) != self.config.n_action_steps - 1:
                    row.past.pop()
            return action

    class DropsThePrompt(base):
        def select_action(self, batch: Any, **_: Any) -> Any:
            begins = (batch["observation.phase"] == 1) & (batch["observation.step"] == 0)
            for row, begin in zip(self.rows, begins, strict=False):
                if begin:
                    row.past.clear()
            return super().select_action(batch)

    class ActsLate(base):
        """Actions planned in the prompt are executed afterwards."""

        def reset(self) -> None:
            super().reset()
            self.before: Any = None

        def select_action(self, batch: Any, **_: Any) -> Any:
            action = super().select_action(batch)
            before, self.before = self.before, action
            return action if before is None else before

    class MindsTheFinished(base):
        def select_action(self, batch: Any, **_: Any) -> Any:
            clocks = zip(batch["observation.phase"].tolist(), batch["observation.step"].tolist(), strict=True)
            if any(row.clock == clock for row, clock in zip(self.rows, clocks, strict=False)):
                for row in self.rows:
                    row.queue = deque([torch.zeros(7)])
            return super().select_action(batch)

    class DrawsItsOwn(base):
        def select_action(self, batch: Any, **_: Any) -> Any:
            return super().select_action(batch) + int.from_bytes(os.urandom(2))

    class NeedsNothing(base):
        def needs_observation(self) -> bool:
            return False

    return {
        "reset forgets": ForgetsNothing,
        "remembers": ForgetsEverything,
        "rows are independent": SharesItsQueue,
        "remembers every control step": RemembersPlans,
        "reads the prompt": DropsThePrompt,
        "plans after the prompt": ActsLate,
        "finished rows change no other": MindsTheFinished,
        "deterministic given a seed": DrawsItsOwn,
        "needs_observation is true": NeedsNothing,
    }


@pytest.mark.parametrize("check", sorted(set(CHECKS) - {"same history in training"}))
def test_flaws_fail_their_checks(check: str, window: Subject) -> None:
    base = type(window.policy)
    window.policy.__class__ = flaws(base)[check]
    try:
        assert run_check(check, Behaviour(window)).outcome is FAILED
    finally:
        window.policy.__class__ = base


class ReadsEveryFrame:
    """Its window in rollouts holds successive frames."""

    def window(self: Any, row: Any) -> Any:
        shown = list(row.past)[-self.config.frames :]
        padding = self.config.frames - len(shown)
        return torch.stack([shown[0]] * padding + shown), torch.arange(self.config.frames) < padding


@pytest.mark.parametrize("planted", ["only at plans", "every frame"])
def test_intervals_of_training_and_rollouts_are_named(window: Subject, planted: str) -> None:
    """The window has every second frame in training. At plans alone, every third step, it has every second plan's."""
    base, check = type(window.policy), "remembers every control step"
    conforming = Behaviour(window)
    assert (run_check(check, conforming).outcome, conforming.interval) == (PASSED, 2)
    every = type("ReadsEveryFrame", (ReadsEveryFrame, base), {})
    window.policy.__class__, found = {"only at plans": (flaws(base)[check], 6), "every frame": (every, 1)}[planted]
    try:
        result = run_check(check, Behaviour(window))
    finally:
        window.policy.__class__ = base
    assert result.outcome is FAILED
    assert f"every 2 control steps in training and every {found} in rollouts" in result.sentence


def test_other_history_in_training_fails(window: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = window.dataset.reader
    deltas = reader.delta_indices.items()
    later = {key: [d - key.startswith("observation.") for d in found] for key, found in deltas}
    monkeypatch.setattr(reader, "delta_indices", later)
    assert run_check("same history in training", Behaviour(window)).outcome is FAILED


def test_errors_of_the_policy_fail_checks(window: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    acts = window.policy.select_action

    def broken(batch: Any) -> Any:
        if len(batch["observation.step"]) > 1:
            raise ValueError("no such row")
        return acts(batch)

    monkeypatch.setattr(window.policy, "select_action", broken)
    result = run_check("rows are independent", Behaviour(window))
    assert result.outcome is FAILED
    assert "no such row" in result.sentence
    monkeypatch.setattr(window.policy, "select_action", lambda batch: batch["observation.missing"])
    with pytest.raises(MemobenchError, match=r"observation\.missing"):
        Behaviour(window)


# --- on images of the real size: LeRobot's policies, ours, the example ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (words_of("act"), ["remembers"]),
        (("policy=memobench_strict",), []),
        (("policy=memobench_strict_memoryless",), ["remembers"]),
    ],
    ids=["act", "memobench_strict", "memobench_strict_memoryless"],
)
def test_known_policies_fail_known_checks(words: tuple[str, ...], wrong: list[str], images: Path) -> None:
    results = run_checks(load_subject([*words, f"dataset={images}"], images.parent))
    assert [result.check for result in results if result.outcome is FAILED] == wrong, results
    assert not [result for result in results if result.outcome is NOT_CHECKED]


# --- the command ---


def test_command_lists_every_check(example: Path, objects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", *EXAMPLE, f"dataset={objects}"]) == 0
    out = capsys.readouterr().out
    assert all(re.search(rf"{re.escape(name)} +│ passed", out) for name in CHECKS)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["policy=window", "tasks=all"], "'tasks'"),
        (["policy=window", "policy.widht=3"], "'policy.width'"),
        ([], "policy"),
    ],
)
def test_wrong_settings_are_named(
    words: list[str], named: str, example: Path, objects: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["conformance", *words, f"dataset={objects}"]) == 2
    assert named in capsys.readouterr().err


# --- every memory ---


def test_memory_of_another_package_runs_an_episode(traces: None) -> None:
    """Frames of images are stored in bfloat16, and its weights are float32."""
    config = MemobenchMemConfig(device="cpu", size="tiny", memory="traces")
    assert config.memory_settings == {"traces": 4}
    memory = MemoryPI05(config).memory
    state = memory.init(2)
    for step in range(5):
        frames = torch.randn(2, memory.spec.tokens, memory.spec.dim, dtype=torch.bfloat16)
        state = memory.observe(state, frames, torch.tensor([step, step]))
    places = torch.arange(5).expand(2, 5)
    histories = Histories(frames[:1].expand(5, -1, -1), torch.arange(5), places)
    assert memory.replay(histories).rows().dtype == torch.float32
    assert memory.read(state).rows().shape == (2, 4 * memory.spec.tokens, memory.spec.width)


def test_strides_that_an_interval_divides_conform(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a multiple of the interval, each plan reads frames of earlier plans alone; a flaw is found all the same."""
    data = write_streams(tmp_path / "streams", images=False)
    words = ["policy=window", "policy.width=16", "policy.frames=8", "policy.stride=15", f"dataset={data}"]
    subject = load_subject(words, tmp_path)
    check = "remembers every control step"
    assert run_check(check, Behaviour(subject)).outcome is PASSED
    assert subject.policy.config.n_action_steps == 3
    made: Any = type(subject.policy)

    class Refusing(made):
        def select_action(self, batch: Any, **settings: Any) -> Any:
            if self.config.n_action_steps == 5:
                raise ValueError("no such interval")
            return super().select_action(batch, **settings)

    monkeypatch.setattr(subject.policy, "__class__", Refusing)
    assert run_check(check, Behaviour(subject)).outcome is PASSED, "other intervals are tried"
    monkeypatch.setattr(subject.policy, "__class__", flaws(made)[check])
    assert run_check(check, Behaviour(subject)).outcome is not PASSED


def test_inputs_are_found(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new policy may read images or objects; what both lack is named in a sentence."""
    from lerobot_policy_window import OBJECTS, WindowPolicy

    data = write_streams(tmp_path / "streams", frames=4)
    words = ["policy=window", "policy.width=16", "policy.frames=4", "policy.stride=1", f"dataset={data}"]
    made = WindowPolicy.__init__

    def needing(name: str) -> Any:
        def init(self: Any, config: Any, **settings: Any) -> None:
            assert config.input_features[name]
            made(self, config, **settings)

        return init

    monkeypatch.setattr(WindowPolicy, "__init__", needing(OBJECTS))
    (tmp_path / "one").mkdir()
    assert OBJECTS in load_subject(words, tmp_path / "one").policy.config.input_features
    monkeypatch.setattr(WindowPolicy, "__init__", needing("observation.touch"))
    (tmp_path / "two").mkdir()
    with pytest.raises(MemobenchError, match=r"does not act on .*observation\.touch.*obs_type="):
        load_subject(words, tmp_path / "two")
