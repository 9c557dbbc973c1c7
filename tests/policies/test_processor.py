"""Tokenizers of prompts with their warnings, text encoders of subgoals, and oracle memory in the prompt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies import make_pre_post_processors

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import processor_memobench_mem
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import (
    WordTokenizerProcessorStep,
    make_vocabulary,
    make_word_tokenizer,
)
from lerobot_memobench.policies.memobench_mem.texts import WordTextEncoder, make_text_encoder, words
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.memory_text import memory_text, with_memory
from tests.support.small_policy import batch_of, made_for_training, small_config


def test_word_tokenizer() -> None:
    vocabulary = make_vocabulary(["Put the bowl away, then wait.", "put the lid on"], 1024)
    tokenizer = make_word_tokenizer(vocabulary)
    ids = tokenizer("Task: put the BOWL, State: -1 255 7;\nAction: zebra").input_ids
    assert tokenizer.convert_ids_to_tokens(ids) == [
        *("<bos>", "task", ":", "put", "the", "bowl", ",", "state", ":", "-", "1", "255", "7", ";", "action", ":"),
        "<unk>",
    ]
    assert len(make_vocabulary((f"word{i}" for i in range(5000)), 1024)) == 1024


def step_of(texts: list[str], length: int = 24) -> WordTokenizerProcessorStep:
    return WordTokenizerProcessorStep(vocabulary=make_vocabulary(texts, 1024), max_length=length, padding="max_length")


@pytest.fixture
def warnings(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    monkeypatch.setattr(processor_memobench_mem, "_warned", set())
    return caplog


def test_each_unknown_word_is_logged_once(warnings: pytest.LogCaptureFixture) -> None:
    step = step_of(["Switch the stove on."])
    for _ in range(3):
        step._tokenize_text(["Switch the stove on.", "Switch the stove on twice, then once."])
    (message,) = warnings.messages
    assert "'twice', 'then', 'once'" in message
    step._tokenize_text("Task: Turn the stove on once, State: 1 2;")
    assert "'turn'" in warnings.messages[1]
    assert "'once'," not in warnings.messages[1]


def test_cut_prompts_are_logged_once_per_instruction(warnings: pytest.LogCaptureFixture) -> None:
    prompt = "Task: Switch the stove on. Memory: the stove was on, State: {} 12 200;\nAction: "
    step = step_of([prompt], length=14)
    for state in (7, 8, 9):
        step._tokenize_text([prompt.format(state)])
    (message,) = warnings.messages
    assert "23 tokens" in message
    assert ", State: 7 12 200;" in message


def test_text_encoders_distinguish_texts() -> None:
    texts = ["pick up the red cup", "pick up the green cup", "put a on b", "put b on a", "pick up the red cup"]
    vectors = WordTextEncoder(64)(texts)
    similarity = (vectors @ vectors.T).fill_diagonal_(0)
    assert similarity[0, 4] > 0.999
    similarity[0, 4] = similarity[4, 0] = 0
    assert similarity.max() < 0.99
    labels, hashed = (make_text_encoder(name, 512)(texts) for name in ("labels", "words"))
    assert labels[0] @ labels[4] > 0.999
    assert abs(labels[0] @ labels[1]) < 0.2 < hashed[0] @ hashed[1]
    assert make_text_encoder("labels", 512).key != make_text_encoder("words", 512).key
    with pytest.raises(MemobenchError, match="no-such-model"):
        make_text_encoder("no-such-model", 512)(texts)


# -- oracle memory -------------------------------------------------------------------------------------------------


def prompt_of(before: Any, batch: dict[str, Any], row: int) -> str:
    """Return the words that the policy reads."""
    step = next(step for step in before.steps if hasattr(step, "vocabulary"))
    ids = batch["observation.language.tokens"][row][batch["observation.language.attention_mask"][row].bool()]
    return " ".join(step.tokenizer.convert_ids_to_tokens(ids.tolist()))


def test_oracle_memory_is_read_in_training_and_in_rollouts(root: Path, tmp_path: Path) -> None:
    policy, before, after, dataset = made_for_training(
        root, size="small", perception="objects", memory="none", oracle_memory=True
    )
    batch = before(batch_of(dataset, [10, 50]))
    memory = dataset.hf_dataset[10]["oracle_memory"]
    assert f"memory : {memory}" in prompt_of(before, batch, 0)
    for part in (policy, before, after):
        part.save_pretrained(tmp_path / "it")
    again, _ = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path / "it"))
    item = dataset[10]
    keys = ("observation.state", "observation.environment_state")
    frame = {key: item[key][None] for key in keys} | {"task": [with_memory(item["task"], memory)]}
    seen = again(frame)
    assert torch.equal(seen["observation.language.tokens"][0], batch["observation.language.tokens"][0])
    assert MemobenchMemPolicy.from_pretrained(tmp_path / "it").select_action(seen).isfinite().all()
    with pytest.raises(MemobenchError, match=r"env\.oracle_memory=true"):
        again(frame | {"task": [item["task"]]})


def test_longest_memory_text_fits_into_the_prompt() -> None:
    texts = [
        with_memory(task.language, memory_text(task, len(task.checkpoints))) for task in map(get_task, task_names())
    ]
    frame = words("Task: , State: " + "255 " * 8 + ";\nAction: ")
    length = small_config(oracle_memory=True).tokenizer_max_length
    assert max(len(words(text)) for text in texts) + len(frame) + 1 <= length
