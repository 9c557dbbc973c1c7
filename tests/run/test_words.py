"""A command line is taken apart."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import executor_options, split_words


def test_words_are_taken_apart() -> None:
    words = split_words(["env=memobench", "--policy.type", "act", "-v", "--seed=3", "tasks=a=b", "--resume"])
    assert words.settings == [("env", "memobench"), ("tasks", "a=b")]
    assert words.flags == ["--policy.type", "act", "-v", "--seed=3", "--resume"]
    assert not words.wants_help


@pytest.mark.parametrize("word", ["memobench", "=x", "", "a b=c", "=="])
def test_a_word_that_is_neither_is_refused(word: str) -> None:
    with pytest.raises(MemobenchError, match="expected key=value"):
        split_words(["env=memobench", word])


def test_executor_options() -> None:
    assert executor_options(["partition=cpu", "mem_per_cpu_gb=4", "env_command=a=b"]) == {
        "partition": "cpu",
        "mem_per_cpu_gb": 4,
        "env_command": "a=b",
    }
    told = executor_options(["requeue=false", "with_srun=True", "condaenv=none", "qos="])
    assert told == {"requeue": False, "with_srun": True, "condaenv": None, "qos": ""}
    with pytest.raises(MemobenchError, match="expected key=value"):
        executor_options(["partition"])
