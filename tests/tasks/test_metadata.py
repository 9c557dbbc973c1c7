"""Metadata files: what this project adds to them, and what is malformed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.tasks.task import Prompt

Write = Callable[..., Path]


def test_own_keys(write_task: Write, metadata: dict[str, Any]) -> None:
    metadata |= {
        "memory_type": "object",
        "family": "mine",
        "prompt": {"kind": "pick", "target": "cup_1"},
        "timestep_exec_start_idx": [-1],
        "demo_summary": "Stow the cup.",
        "note": {"kept": True},
    }
    task = load_task(write_task(metadata=metadata, parent="spatial"))
    assert (task.memory_type, task.family, task.demo_summary) == ("object", "mine", "Stow the cup.")
    assert task.prompt == Prompt("pick", "cup_1")
    assert task.metadata["note"] == {"kept": True}
    metadata["prompt"] = None
    assert load_task(write_task(metadata=metadata)).prompt is None


@pytest.mark.parametrize("key", ["memory", "operating_type", "subtask_goals"])
def test_missing_key(write_task: Write, metadata: dict[str, Any], key: str) -> None:
    del metadata[key]
    with pytest.raises(MemobenchError, match=rf"meta\.json lacks '{key}', expected an object that holds"):
        load_task(write_task(metadata=metadata))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"subtask_goals": []}, "at least one formula"),
        ({"subtask_goals": {"and": []}}, "at least one formula"),
        ({"subtask_goals": [["open", "box_1"]]}, "a list of 1 entries"),
        (
            {"subtask_goals": [["open", "box_1"], ["open", "box_2"]]},
            "subtask_goals[1]: found the name 'box_2'",
        ),
        ({"subtask_goals": [["open", "box_1"], 5]}, "subtask_goals[1]: found 5"),
        ({"operating_type": [[0, 0, 0]]}, "a list of 2 entries"),
        ({"operating_type": [[0, 0, 0], [0, 0]]}, "operating_type[1] = [0, 0], expected three labels"),
        ({"operating_type": [[0, 0, 0], [0, 0, 3]]}, "each 0, 1 or 2"),
        ({"operating_type": [[0, 0, 0], [0, 0, True]]}, "each 0, 1 or 2"),
        ({"operating_type": [[0, 0, 0], 1]}, "each 0, 1 or 2"),
        ({"memory": [["a", "b", "c"]]}, "memory = [['a', 'b', 'c']], expected a list of 2 entries"),
        ({"memory": [["a", "b", "c"], ["a", "b"]]}, "memory[1]"),
        ({"memory": [["a", "b", "c"], ["a", "b", " "]]}, "three texts"),
        ({"memory": [["a", "b", "c"], ["a", "b", 3]]}, "three texts"),
        ({"memory": "abc"}, "a list of 2 entries"),
        ({"key_frame": [-1]}, "a list of 2 integers"),
        ({"key_frame": [-1, 0.5]}, "a list of 2 integers"),
        ({"timestep_exec_start_idx": "0"}, "an integer or a list of integers"),
        ({"demo_summary": ["a"]}, "demo_summary = ['a'], expected text"),
        ({"memory_type": "episodic"}, "expected one of temporal, spatial, object, procedural"),
        ({"memory_type": ["temporal"]}, "expected one of"),
        ({"family": 1}, "expected text"),
        ({"prompt": "pick"}, 'expected null or {"kind"'),
        ({"prompt": {"kind": "pick", "target": "cup_1", "x": 1}}, 'expected null or {"kind"'),
        ({"prompt": {"kind": "grab", "target": "cup_1"}}, "one of routine, pick, point, highlight"),
        ({"prompt": {"kind": "pick"}}, "the object that a prompt of kind 'pick' shows"),
        ({"prompt": {"kind": "pick", "target": "cup_9"}}, "a name that the BDDL file declares"),
        ({"prompt": {"kind": "pick", "target": ["cup_1"]}}, "a name that the BDDL file declares"),
        ({"variants": {}}, "a list of objects"),
        ({"variants": [{}]}, "an object with 'memory'"),
        ({"variants": [{"memory": []}]}, "variants[0].memory"),
        ({"variants": [{"memory": "M", "swap": 1}]}, "an object with 'memory'"),
        ({"variants": [{"memory": "M", "substitute": []}]}, "an object of names to names"),
        ({"variants": [{"memory": "M", "substitute": {"cup_1": "cup_7"}}]}, "substitute['cup_1'] = 'cup_7'"),
        (
            {"variants": [{"memory": "M", "substitute": {"cup_1": "box_1_top_region"}}]},
            "expected object or fixture",
        ),
        ({"variants": [{"memory": "M", "order": [0, 0]}]}, "each of 0 to 1 once"),
        ({"variants": [{"memory": "M", "order": "01"}]}, "each of 0 to 1 once"),
        (
            {"variants": [{"memory": "M", "goal": ["open", "nothing"]}]},
            "variants[0].goal: found the name 'nothing'",
        ),
        ({"variants": [{"memory": "M", "subtask_goals": []}]}, "a list of 2 formulas"),
        ({"variants": [{"memory": "M", "replaces_published": 1}]}, "true or false"),
        ({"variants": [{"memory": "M", "demo_summary": 1}]}, "expected text"),
    ],
)
def test_malformed_metadata_is_one_clear_error(
    write_task: Write, metadata: dict[str, Any], change: dict[str, Any], words: str
) -> None:
    for variant in change.get("variants", []):
        if variant.get("memory") == "M":
            variant["memory"] = metadata["memory"]
    folder = write_task(metadata=metadata | change)
    with pytest.raises(MemobenchError) as error:
        load_task(folder)
    message = str(error.value)
    assert message.startswith(str(folder / "task_config.meta.json"))
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1: found no valid JSON"),
        ('{"memory": [\n}', "line 2: found no valid JSON"),
        ("[]", "expected a JSON object"),
        ("null", "expected a JSON object"),
        ('{"memory": 1, "memory": 2}', "the key 'memory' twice"),
        ("[" * 100_000, "JSON"),
        ('{"a": ' + "9" * 5000 + "}", "JSON that cannot be read"),
    ],
)
def test_metadata_that_is_no_json_object(write_task: Write, text: str, words: str) -> None:
    with pytest.raises(MemobenchError) as error:
        load_task(write_task(metadata=text))
    assert words in str(error.value)
