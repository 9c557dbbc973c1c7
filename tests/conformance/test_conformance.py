"""Conforming policies pass every check, and each flaw of a policy fails its own checks."""

from __future__ import annotations

import os
import re
from collections import deque
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.conformance import subject as module
from lerobot_memobench.conformance.checks import CHECKS, Behaviour, Outcome, run_check, run_checks
from lerobot_memobench.conformance.pytest_class import MemoryConformance
from lerobot_memobench.conformance.streams import TASK, task_of_texts
from lerobot_memobench.conformance.subject import Subject, load_subject
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import OURS, mechanism_names
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.tiny_paligemma import shrink_paligemma

EXAMPLE = ("policy=window", "policy.width=32", "policy.frames=8", "policy.stride=2")
MEM = (
    *("policy=memobench_mem", "policy.size=tiny", "policy.perception=objects", "policy.memory_stride=2"),
    *("policy.memory_settings={frames: 8}", "policy.chunk_size=4", "policy.num_inference_steps=1"),
)


@pytest.fixture(scope="module")
def window(example: Path, objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return load_subject([*EXAMPLE, f"dataset={objects}"], tmp_path_factory.mktemp("window"))


def failed(subject: Subject) -> set[str]:
    return {result.check for result in run_checks(subject) if result.outcome is Outcome.FAILED}


class TestExample(MemoryConformance):
    """A test class as in the guide, with a dataset of its own."""

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def _arguments(cls, example: Path, objects: Path) -> None:
        cls.arguments = (*EXAMPLE, f"dataset={objects}")


def test_example_is_an_installed_package(example: Path) -> None:
    kind = PreTrainedConfig.get_known_choices()["window"]
    assert Path(__import__(kind.__module__).__file__).parent == example


def test_memobench_mem_conforms(objects: Path, tmp_path: Path) -> None:
    results = run_checks(load_subject([*MEM, f"dataset={objects}"], tmp_path))
    assert {result.outcome for result in results} == {Outcome.PASSED}, results


# --- a policy with one flaw ---


def flaws(base: Any) -> dict[str, tuple[type, set[str]]]:
    """Name -> class of a policy with a flaw, and the checks that name it."""

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

    class MixesRows(base):
        def tokens(self, batch: Any) -> Any:
            found = super().tokens(batch)
            return found + found.mean(0) if found.dim() == 2 else found

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

    history = "same history in training"
    compared = {"deterministic given a seed", "reset forgets", "rows are independent", history}
    return {
        "reset": (ForgetsNothing, {"reset forgets"}),
        "memoryless": (ForgetsEverything, {"remembers"}),
        "mixed rows": (
            MixesRows,
            {"rows are independent", "finished rows change no other", "same history in training"},
        ),
        "one queue": (SharesItsQueue, {"rows are independent"}),
        "per chunk": (RemembersPlans, {"remembers every control step", history}),
        "prompt": (DropsThePrompt, {"reads the prompt", history}),
        "late": (ActsLate, {"plans after the prompt"}),
        "finished": (MindsTheFinished, {"finished rows change no other"}),
        "noise": (DrawsItsOwn, compared),
        "needs": (NeedsNothing, {"needs_observation is true"}),
    }


NAMES = ("reset", "memoryless", "mixed rows", "one queue", "per chunk", "prompt", "late", "finished", "noise", "needs")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("exactly", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_flaws_fail_their_checks(name: str, exactly: bool, window: Subject) -> None:
    base = type(window.policy)
    window.policy.__class__, expected = flaws(base)[name]
    try:
        if exactly:
            found = failed(window)
        else:
            behaviour = Behaviour(window)
            check = min(expected)
            found = {check} if run_check(check, behaviour).outcome is Outcome.FAILED else set()
    finally:
        window.policy.__class__ = base
    if not exactly:
        assert found == {check}
    elif name in ("reset", "memoryless", "noise"):  # other checks fail too
        assert found >= expected
    else:
        assert found == expected


def test_other_history_in_training_fails(window: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = window.dataset.reader
    deltas = reader.delta_indices.items()
    later = {key: [d - key.startswith("observation.") for d in found] for key, found in deltas}
    monkeypatch.setattr(reader, "delta_indices", later)
    assert run_check("same history in training", Behaviour(window)).outcome is Outcome.FAILED


@pytest.mark.parametrize("way", ["raises", "present alone"])
def test_checks_that_do_not_apply_are_skipped(way: str, window: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = window.policy
    answer = policy.predict_action_chunk

    def predict(batch: Any) -> Any:
        if way == "raises":
            raise KeyError("observation.images.image")
        names = [key for key in batch if key.startswith("observation.") and not key.endswith("_is_pad")]
        alone = {key: batch[key][:, -1:].expand_as(batch[key]) for key in names}
        pad = torch.ones_like(batch["observation.state_is_pad"])
        pad[:, -1] = False
        return answer({**batch, **alone, "observation.state_is_pad": pad})

    monkeypatch.setattr(policy, "predict_action_chunk", predict)
    result = run_check("same history in training", Behaviour(window))
    assert result.outcome is Outcome.NOT_CHECKED
    assert ("KeyError" if way == "raises" else "present frames") in result.sentence


def test_errors_of_the_policy_fail_checks(window: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    acts = window.policy.select_action

    def broken(batch: Any) -> Any:
        if len(batch["observation.step"]) > 1:
            raise ValueError("no such row")
        return acts(batch)

    monkeypatch.setattr(window.policy, "select_action", broken)
    result = run_check("rows are independent", Behaviour(window))
    assert result.outcome is Outcome.FAILED
    assert "no such row" in result.sentence
    monkeypatch.setattr(window.policy, "select_action", lambda batch: batch["observation.missing"])
    with pytest.raises(MemobenchError, match=r"observation\.missing"):
        Behaviour(window)


# --- on pictures of the real size: LeRobot's policies, ours, the example ---

ACT = (
    *("policy=act", "policy.pretrained_backbone_weights=null", "policy.dim_model=32", "policy.n_heads=2"),
    *("policy.dim_feedforward=64", "policy.n_encoder_layers=1", "policy.n_vae_encoder_layers=1"),
    *("policy.chunk_size=4", "policy.latent_dim=8"),
)
DIFFUSION = (
    *("policy=diffusion", "policy.down_dims=[16,32]", "policy.num_inference_steps=2", "policy.horizon=8"),
    *("policy.diffusion_step_embed_dim=16", "policy.n_groups=4", "policy.pretrained_backbone_weights=null"),
    *("policy.crop_shape=[84,84]", "policy.spatial_softmax_num_keypoints=8"),
)
PI05 = (
    *("policy=pi05", "policy.chunk_size=4", "policy.num_inference_steps=2", "policy.dtype=float32"),
    "policy.tokenizer_max_length=64",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (ACT, ["remembers"]),
        (DIFFUSION, ["reads the prompt"]),
        (PI05, ["remembers"]),
        (("policy=window", "policy.frames=8", "policy.stride=2"), []),
        (("policy=memobench_mem", "policy.size=tiny", "policy.memory_stride=2"), []),
        (("policy=memobench_small",), []),
        (("policy=memobench_small_memoryless",), ["remembers"]),
    ],
    ids=["act", "diffusion", "pi05", "window", "memobench_mem", "memobench_small", "memobench_small_memoryless"],
)
def test_known_policies_fail_known_checks(
    words: tuple[str, ...], wrong: list[str], example: Path, pictures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shrink_paligemma(monkeypatch, "put the milk picked up in the prompt video on the plate")
    results = run_checks(load_subject([*words, f"dataset={pictures}"], pictures.parent))
    assert [result.check for result in results if result.outcome is Outcome.FAILED] == wrong, results
    assert not [result for result in results if result.outcome is Outcome.NOT_CHECKED]


# --- the command ---


def test_command_lists_every_check(example: Path, objects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", *EXAMPLE, f"dataset={objects}"]) == 0
    out = capsys.readouterr().out
    assert all(re.search(rf"{re.escape(name)} +│ passed", out) for name in CHECKS)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["policy=windo"], "'window'"),
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


def test_equal_noise_does_not_depend_on_rows() -> None:
    with module.EqualNoise():
        one, many = torch.randn(1, 4, 7), torch.randn(3, 4, 7)
        assert torch.equal(many, one.expand_as(many))
        assert torch.equal(torch.normal(0.0, 1.0, (2, 7))[0], one[0, 0])
        assert torch.equal(torch.empty(5, 7).normal_()[4], one[0, 0])
    assert not torch.equal(torch.randn(1, 4, 7), one)


# --- every memory ---


def test_memory_of_another_package_runs_an_episode(traces: None) -> None:
    """Frames of pictures are stored in bfloat16, and its weights are float32."""
    config = MemobenchMemConfig(device="cpu", size="tiny", memory="traces")
    assert config.memory_settings == {"traces": 4}
    memory = MemoryPI05(config).memory
    assert memory is not None
    state = memory.init(2)
    for step in range(5):
        frames = torch.randn(2, memory.spec.tokens, memory.spec.dim, dtype=torch.bfloat16)
        state = memory.observe(state, frames, torch.tensor([step, step]))
    places = torch.arange(5).expand(2, 5)
    histories = Histories(frames[:1].expand(5, -1, -1), torch.arange(5), places)
    assert memory.replay(histories).rows().dtype == torch.float32
    assert memory.read(state).rows().shape == (2, 4 * memory.spec.tokens, memory.spec.width)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_streams_use_a_task_of_the_known_texts(level: int) -> None:
    known = {}
    for name in ("put_the_butter_into_the_bowl_from_the_prompt_video", "check_all_three_drawers_of_the_cabinet"):
        task = get_task(name)
        known[task.language] = [checkpoint.language[level] for checkpoint in task.checkpoints]
    assert task_of_texts(known) == "put_the_butter_into_the_bowl_from_the_prompt_video", "it has a prompt"
    assert task_of_texts({"another": ["text"]}) == task_of_texts({}) == TASK


@pytest.mark.slow
@pytest.mark.parametrize("memory", [*OURS, "traces"])
def test_every_memory_conforms(memory: str, traces: None, objects: Path, tmp_path: Path) -> None:
    assert memory in mechanism_names()
    words = ["policy=memobench_mem", f"policy.memory={memory}", "size=tiny", "policy.perception=objects"]
    if memory == "keyframes":
        words.append("policy.memory_stride=2")  # of 10 steps few end within the streams
    subject = load_subject([*words, f"dataset={objects}"], tmp_path)
    if memory == "keyframes":
        balance(subject)
    results = run_checks(subject)
    assert {result.outcome for result in results} == {Outcome.PASSED}, results


def balance(subject: Subject) -> None:
    """Balance the texts of a high level; with random weights it always chooses the same one."""
    high_level = subject.policy.model.memory
    scores: list[Tensor] = []
    ask = high_level.ask_high_level

    def noted(*given: Tensor) -> tuple[Tensor, Tensor]:
        found: tuple[Tensor, Tensor] = ask(*given)
        scores.append(found[0][:, :-1])
        return found

    high_level.ask_high_level = noted
    subject.roll(subject.streams)
    del high_level.ask_high_level
    with torch.no_grad():
        high_level.score.bias -= torch.cat(scores).mean(dim=0)
