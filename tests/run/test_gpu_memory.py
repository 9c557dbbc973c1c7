"""Counting what a training needs of a GPU: against what was measured on one, and what is refused."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import memory
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import Frames
from lerobot_memobench.run import gpu_memory
from lerobot_memobench.run.arguments import read_arguments, resolve_recipe, split_arguments
from lerobot_memobench.run.gpu_memory import (
    DDP,
    FSDP,
    GIB,
    LORA,
    WHOLE,
    Training,
    check_fits,
    disk,
    replace_config,
    training_of,
)

MEASURED = Path(__file__).parents[2] / "docs" / "research" / "full_size_on_one_gpu.jsonl"
ARMS = {
    "paper": "batch_size=1",
    "contrastive": "align=contrastive",
    "no checkpointing": "policy.gradient_checkpointing=false",
    "no memory": "policy.memory_fusion=none",
    "expert only": "policy.train_expert_only=true",
}


def asked(*line: str, gpus: int = 1) -> Training:
    given = resolve_recipe(split_arguments(["config=train_paper", "dataset=local/none", *line]))
    found = training_of(read_arguments("train", given), gpus)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def paper() -> Training:
    return asked("batch_size=16")


@pytest.mark.parametrize("arm", [pytest.param(arm, marks=() if arm == "paper" else pytest.mark.slow) for arm in ARMS])
def test_the_count_is_what_was_measured_and_at_most_four_percent_more(arm: str, paper: Training) -> None:
    rows = [json.loads(line) for line in MEASURED.read_text().splitlines()]
    training = paper if arm == "paper" else asked(ARMS[arm])
    weights = training.weights(WHOLE)
    rows = [row for row in rows if row.get("arm") == arm and "peak_backward_gib" in row]
    assert rows
    for row in rows:
        gpus = 2 if row["ddp"] else 1  # one process under DDP has buckets, too
        found = replace(training, batch=row["batch"], gpus=gpus).need()
        assert weights.trained == row["trained"]
        parts = {"trained_gib": found.weights, "frozen_gib": found.frozen, "adamw_gib": found.optimizer}
        for name, count in {**parts, "average_gib": found.average}.items():
            assert count / GIB == pytest.approx(row[name], abs=0.02), name
        # The optimizer's step made a copy when this was measured, and makes none now.
        measured = max(row["peak_forward_gib"], row["peak_backward_gib"])
        assert 0.995 * measured < found.peak / GIB < 1.04 * measured, row


def test_shards_are_parts_and_the_frozen_stays_whole(paper: Training) -> None:
    two, four = (replace(paper, gpus=gpus, way=FSDP).need() for gpus in (2, 4))
    for part in ("weights", "optimizer", "average", "gradients"):
        assert getattr(two, part) == pytest.approx(2 * getattr(four, part), rel=1e-6)
    assert two.frozen == four.frozen
    assert 0.6 < paper.weights(FSDP).in_units / paper.weights(FSDP).trained < 0.7
    assert four.fits(45 * GIB) is True


def test_adapters_learn_little_and_have_no_average(paper: Training) -> None:
    found = replace(paper, way=LORA).need()
    assert found.average == 0
    assert paper.weights(LORA).trained < paper.weights(WHOLE).trained / 20
    assert found.peak < 20 * GIB


def test_disk_is_what_was_written(paper: Training) -> None:
    written = disk(paper)
    assert written.checkpoints == 8
    assert (written.checkpoint - written.optimizer) / GIB == pytest.approx(25.6, abs=0.1)
    assert written.checkpoint / GIB == pytest.approx(47, abs=0.6)
    assert disk(replace(paper, frames=727)).cache / 2**20 == pytest.approx(45, abs=1)


def test_what_cannot_fit_is_refused_with_what_would(paper: Training) -> None:
    with pytest.raises(MemobenchError, match=r"about 64 GiB .*one GPU.*45; what would fit: memory and .*LORA.*4 such"):
        check_fits(paper, 45 * GIB)
    check_fits(paper, 79 * GIB)
    check_fits(replace(paper, gpus=4, way=FSDP), 45 * GIB)
    dense = replace(paper, batch=64, config=replace_config(paper.config, WHOLE, gradient_checkpointing=False))
    with pytest.raises(MemobenchError, match="what would fit: a smaller batch_size"):
        check_fits(dense, 79 * GIB)


def test_lerobot_train_asks_by_the_gpu_and_the_launcher(monkeypatch: pytest.MonkeyPatch, paper: Training) -> None:
    card = SimpleNamespace(total_memory=45 * GIB)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda rank: card)
    on_gpu = replace(paper, config=copy.copy(paper.config))
    on_gpu.config.device = "cuda"
    monkeypatch.setattr(gpu_memory, "training_of", lambda arguments, gpus: replace(on_gpu, gpus=gpus))
    arguments = read_arguments("train", split_arguments(["policy=memobench_mem", "dataset=local/none"]))
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(MemobenchError, match="DDP"):
        gpu_memory.refuse_too_large(arguments)
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    gpu_memory.refuse_too_large(arguments)
    monkeypatch.delenv("ACCELERATE_USE_FSDP")
    on_gpu.config.device = "cpu"
    gpu_memory.refuse_too_large(arguments)


# -- memories ---------------------------------------------------------------------------------------------------------


def tiny(memory: str, **fields: Any) -> Training:
    return Training(MemobenchMemConfig(size="tiny", device="cpu", memory=memory, **fields), 16)


@pytest.mark.parametrize(
    ("name", "fields", "prefix", "suffix"),
    [
        ("recurrent", {"memory_fusion": "context"}, 32, 0),  # its slots
        pytest.param("motion", {}, 0, 8, marks=pytest.mark.slow),  # queries of foresight
        pytest.param("subgoal", {"subgoals": {"": ["open it now"]}}, 512 + 1 + 4, 0, marks=pytest.mark.slow),
        pytest.param("keyframes", {"subgoals": {"": ["open it now"]}}, 0, 0, marks=pytest.mark.slow),
        pytest.param("frames", {}, 0, 0, marks=pytest.mark.slow),
        pytest.param("bank", {}, 0, 0, marks=pytest.mark.slow),
        pytest.param("fast_weights", {"memory_fusion": "context"}, 8 * 16, 0, marks=pytest.mark.slow),
    ],
)
def test_a_memory_takes_what_its_samples_leave_behind(
    name: str, fields: dict[str, Any], prefix: int, suffix: int
) -> None:
    training = tiny(name, **fields)
    found, without = training.memory, tiny("none")
    assert (found.prefix, found.suffix) == (prefix, suffix)
    assert found.kept > found.stored > 0
    assert training.need().activations >= without.need().activations + 16 * found.kept
    assert training.weights(WHOLE).trained > without.weights(WHOLE).trained
    assert disk(training).cache == found.stored * math.ceil(training.frames / training.config.memory_stride)


@pytest.mark.slow
def test_gradients_through_more_frames_keep_more() -> None:
    made = [tiny("recurrent", memory_settings={"gradient_frames": count}).memory.kept for count in (2, 4, 6)]
    assert made[2] - made[1] == made[1] - made[0] > 0


@pytest.mark.slow
def test_texts_of_a_privileged_memory_are_those_of_the_published_tasks_where_no_dataset_lies() -> None:
    training = asked("policy.memory=subgoal", "policy.memory_fusion=own", "size=tiny")
    texts = training.config.subgoal_texts
    assert len(texts) > 30
    one = tiny("subgoal", subgoals={"": texts[:1]})
    assert training.weights(WHOLE).trained >= one.weights(WHOLE).trained + 128 * (len(texts) - 1)


class Strange(Frames):
    """A package's memory, whose training wants more than frames."""

    def replay(self, histories: Any, query: Any = None) -> Any:
        raise KeyError("weather")


def test_a_memory_that_cannot_be_counted_is_refused_and_may_be_trained(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(memory, "entry_points", lambda group: [EntryPoint("strange", f"{__name__}:Strange", group)])
    assert main(["fit", "policy=memobench_mem", "size=tiny", "policy.memory=strange", "dataset=local/none"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "what memory=strange needs cannot be counted" in told
    assert "KeyError: 'weather'" in told
    training = tiny("strange")
    training.config.size, training.config.device = "pi05", "cuda"
    training.counted[WHOLE] = tiny("frames").weights(WHOLE)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda rank: SimpleNamespace(total_memory=GIB))
    monkeypatch.setattr(gpu_memory, "training_of", lambda *_: training)
    with caplog.at_level("WARNING"):
        gpu_memory.refuse_too_large(read_arguments("train", split_arguments(["policy=memobench_mem"])))
    assert "whether it fits this GPU is not known" in caplog.text


@pytest.mark.slow
def test_the_command_prints_the_count(capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["fit", "config=train_paper", "size=tiny", "batch_size=16", "--gpus", "4", "--gpu-memory", "45"]) == 0
    printed = capsys.readouterr().out
    assert "disk: 8 × checkpoint of" in printed
    assert [line.split()[1] for line in printed.splitlines() if " fits " in line][:2] == [DDP, FSDP]
    assert main(["fit", "config=train_paper", "size=tiny", "batch_size=100000", "--gpu-memory", "45"]) == 1
    assert main(["fit", "config=train_paper", "batch_size=-3"]) == 2
    assert "found batch_size=-3" in capsys.readouterr().err
    assert main(["fit", "policy=act"]) == 2
    assert "memobench_mem" in capsys.readouterr().err
