"""Every memory mechanism conforms, ours and that of the example, which is installed as anybody's package."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from lerobot_memobench.conformance.checks import Outcome, run_checks
from lerobot_memobench.conformance.streams import TASK, task_of_texts
from lerobot_memobench.conformance.subject import Subject, load_subject
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import OURS, mechanism_names
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.tasks.catalogue import get_task


def test_a_memory_of_another_package_is_built_and_goes_through_an_episode(traces: None) -> None:
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
def test_a_trained_memory_is_shown_a_task_whose_checkpoints_it_can_say(level: int) -> None:
    """Else the dataset that is made for it is one that it would refuse to learn from."""
    known = {}
    for name in ("put_the_butter_into_the_bowl_from_the_prompt_video", "check_all_three_drawers_of_the_cabinet"):
        task = get_task(name)
        known[task.language] = [checkpoint.language[level] for checkpoint in task.checkpoints]
    assert task_of_texts(known) == "put_the_butter_into_the_bowl_from_the_prompt_video", "it has a prompt"
    assert task_of_texts({"another": ["text"]}) == task_of_texts({}) == TASK


@pytest.mark.slow
@pytest.mark.parametrize("memory", [*OURS, "traces"])
def test_it_conforms(memory: str, traces: None, objects: Path, tmp_path: Path) -> None:
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
    """Let a high level say each text as often: by weights as they are drawn it says one, whatever the frames show."""
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
