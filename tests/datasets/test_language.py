from __future__ import annotations

import re

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import labels, persistent_rows
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.memory_text import IMPERATIVES, memory_text, subtask_texts


def rows_of(demo, style):
    return [(row["timestamp"], row["content"]) for row in persistent_rows(labels(demo)) if row["style"] == style]


def test_rows_follow_the_text_columns(make_demo):
    demo = make_demo(["0" * 10 + "1" * 30, "0" * 30 + "1" * 10])
    f32 = [float(np.float32(frame / 20)) for frame in (0, 11, 31)]
    assert rows_of(demo, "subtask") == [(f32[0], "did thing 0"), (f32[1], "did thing 1")]
    assert rows_of(demo, "memory") == [(f32[1], "did thing 0"), (f32[2], "did thing 0; did thing 1")]


def test_rows_are_what_lerobots_writer_accepts(make_demo):
    writer = pytest.importorskip("lerobot.annotations.steerable_pipeline.writer")
    rows = persistent_rows(labels(make_demo(["0" * 10 + "1" * 30, "0" * 30 + "1" * 10])))
    # Its only objection is that nothing is "" and [] here, for lerobot-dataset-viz's sake, and not None.
    assert all((row["camera"], row["tool_calls"]) == ("", []) for row in rows)
    nothing = {"camera": None, "tool_calls": None}
    assert [writer._normalize_persistent_row(row | nothing) for row in rows] == [row | nothing for row in rows]
    assert sorted(rows, key=writer._row_persistent_sort_key) == rows


def test_short_lived_texts_get_no_row(make_demo):
    # Checkpoints 0 and 1 complete two frames apart: "did thing 1" is worked on for 0.1 s only.
    demo = make_demo(["0" * 10 + "1" * 30, "0" * 12 + "1" * 28, "0" * 30 + "1" * 10])
    assert [text for _, text in rows_of(demo, "subtask")] == ["did thing 0", "did thing 2"]
    memory = rows_of(demo, "memory")
    assert [text for _, text in memory] == [
        "did thing 0; did thing 1",
        "did thing 0; did thing 1; did thing 2",
    ]
    assert memory[0][0] == float(np.float32(13 / 20))  # its own time: nothing is remembered too early


def test_a_text_is_active_from_the_first_frame_on(make_demo):
    demo = make_demo(["0100000000", "0001111111"])
    assert rows_of(demo, "subtask") == [(0.0, "did thing 1")]


def test_lerobots_resolvers_never_find_two_rows(make_demo):
    render = pytest.importorskip("lerobot.datasets.language_render")
    rng = np.random.default_rng(3)
    for _ in range(50):
        table = np.zeros((3, 30), dtype=int)
        for k in range(3):
            table[k, int(rng.integers(1, 30)) :] = 1
        demo = make_demo(["".join(map(str, row)) for row in table])
        rows = persistent_rows(labels(demo))
        for t in np.float32(np.arange(30) / 20).tolist():
            for style in ("subtask", "memory"):
                render.emitted_at(t, persistent=rows, events=[], style=style)
                active = render.active_at(t, persistent=rows, style=style)
                assert style == "memory" or active is not None


VERBS = "|".join(set(IMPERATIVES) - set(IMPERATIVES.values()))
PAST = re.compile(rf"(?:^|; |\band |\bthen |^.*, and )({VERBS})\b")


def variants(suite):
    return [task.variant(k) for task in map(get_task, task_names(suite=suite)) for k in range(task.num_variants)]


@pytest.mark.parametrize(("suite", "count"), [("published", 30), ("strict", 30)])
def test_subtasks_are_instructions_and_memories_are_not(suite, count):
    """Of every checkpoint of every variant: no past tense, nothing that is done already, nothing said twice."""
    assert len(task_names(suite=suite)) == count
    for task in variants(suite):
        told = subtask_texts(task)
        assert len(told) == len(task.checkpoints)
        for k, (text, checkpoint) in enumerate(zip(told, task.checkpoints, strict=True)):
            assert text.split()[0] in IMPERATIVES.values(), text
            assert not PAST.search(text), text
            assert not re.search(r"by now|in all|each once|the one time", text), text
            assert text not in told[:k], "each asks for something else"
            assert checkpoint.language[1].split()[0] in IMPERATIVES, "the memory says it in the past tense"
        assert memory_text(task, len(told)).startswith(task.checkpoints[0].language[1])


@pytest.mark.parametrize(
    ("name", "variant", "told"),
    [
        (
            "turn_the_stove_on_and_off_a_given_number_of_times",
            2,
            [
                "switch the stove on and off again for the first time",
                "switch the stove on and off again for the second time",
                "switch the stove on and off again for the third time",
                "come to rest",
            ],
        ),
        (
            "find_the_tomato_hidden_in_one_of_the_drawers",
            2,
            [
                "pull out the bottom drawer, where the tomato was hidden",
                "take the tomato out of the bottom drawer",
                "put the tomato from the bottom drawer on the table",
            ],
        ),
    ],
)
def test_what_a_subtask_says(name, variant, told):
    assert subtask_texts(get_task(name).variant(variant)) == told
