"""Tasks as data: equality, and variants."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import BOWL, get_task, load_task
from lerobot_memobench.tasks.formula import Atom, format_formula, parse_formula
from lerobot_memobench.tasks.memory_text import memory_text, with_memory
from lerobot_memobench.tasks.task import Prompt

Write = Callable[..., Path]


def test_equal_hashable_and_picklable(write_task: Write) -> None:
    folder = write_task()
    task, again = load_task(folder), load_task(str(folder))
    assert task == again
    assert hash(task) == hash(again)
    assert pickle.loads(pickle.dumps(task)) == task  # noqa: S301 - our own bytes, as worker processes do


def test_variants(write_task: Write, metadata: dict[str, Any]) -> None:
    metadata["prompt"] = {"kind": "pick", "target": "cup_1"}
    texts = [["g", "h", "i"], ["j", "k", "l"]]
    metadata["variants"] = [
        {
            "substitute": {"cup_1": "cup_2", "cup_2": "cup_1"},
            "memory": texts,
            "demo_summary": "The other cup.",
        },
        {
            "order": [1, 0],
            "goal": {"then": [["open", "box_1_top_region"], ["close", "box_1_top_region"]]},
            "memory": texts,
        },
        {"subtask_goals": [["open", "box_1_top_region"], ["on", "cup_2", "cup_1"]], "memory": texts},
    ]
    task = load_task(write_task(metadata=metadata))
    assert (task.num_variants, task.random_variants) == (4, (0, 1, 2, 3))
    other = task.variant(1)
    assert format_formula(other.goal) == "(And (In cup_2 box_1_top_region) (Not (Open box_1_top_region)))"
    assert other.checkpoints[1].goal == parse_formula({"and": ["in", "cup_2", "box_1_top_region"]})
    assert other.checkpoints[1].language == ("j", "k", "l")
    assert other.prompt == Prompt("pick", "cup_2")
    assert (other.demo_summary, other.operations, other.variant_index) == ("The other cup.", "SC", 1)
    assert other != task
    assert (other.name, other.language, other.init) == (task.name, task.language, task.init)
    assert other.variant(0) is task
    assert other.variant(2) == task.variant(2)
    turned = task.variant(2)
    assert [c.goal for c in turned.checkpoints] == [c.goal for c in reversed(task.checkpoints)]
    assert turned.operations == task.operations  # labels belong to the position in the routine
    assert format_formula(turned.goal) == "(Then (Open box_1_top_region) (Close box_1_top_region))"
    assert turned.prompt == task.prompt
    assert task.variant(3).checkpoints[1].goal == Atom("on", ("cup_2", "cup_1"))
    assert task.variant(3).goal == task.goal
    for k in (-1, 4):
        with pytest.raises(MemobenchError, match="variants 0 to 3"):
            task.variant(k)
    metadata["variants"][1]["replaces_published"] = True
    assert load_task(write_task(metadata=metadata)).random_variants == (1, 2, 3)


# --- memory text ---


def test_memory_grows_by_one_intermediate_text_per_checkpoint() -> None:
    task = get_task("turn_on_the_stove_and_turn_it_off")
    texts = [checkpoint.language[1] for checkpoint in task.checkpoints]
    assert memory_text(task, 0) == ""
    assert memory_text(task, 1) == texts[0]
    assert memory_text(task, len(texts)) == "; ".join(texts)


def test_prompt_says_that_nothing_is_done_yet() -> None:
    assert with_memory("Put it back", "") == "Put it back Memory: nothing yet"
    assert with_memory("Put it back", "took it") == "Put it back Memory: took it"


def test_a_task_keeps_its_world_through_variants() -> None:
    published = get_task(BOWL)
    there = published.variant(1).in_world("libero")
    assert there.world == there.variant(0).world == there.variant(2).world == "libero"
    assert there.variant(0) == published.in_world("libero") != published
    assert published.world == "memobench"
