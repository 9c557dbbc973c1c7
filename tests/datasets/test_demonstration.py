"""Labels, language rows and hash of a demonstration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import digest, key_frames, labels, persistent_rows
from lerobot_memobench.errors import MemobenchError


def test_texts(make_demo):
    found = labels(make_demo(["01000", "00100", "00010"]))
    assert found["subgoal.intermediate"] == ["did thing 0"] * 2 + ["did thing 1"] + ["did thing 2"] * 2
    assert found["subgoal.fine"][2] == "did thing 1 with the left hand"
    assert found["subgoal.coarse"] == ["coarse 0"] * 2 + ["coarse 1"] + ["coarse 2"] * 2, "the last text remains"
    assert found["checkpoint.operation"].tolist() == [0, 0, 1, 2, -1], "none is left"
    done = ["did thing 0", "did thing 0; did thing 1", "did thing 0; did thing 1; did thing 2"]
    assert found["oracle_memory"] == ["", "", *done]


def test_number_of_checkpoints(make_demo, make_task):
    demo = make_demo(["000"], task=make_task("S"))
    none = replace(demo, task=make_task(""), satisfied=np.zeros((3, 0), dtype=np.bool_))
    found = labels(none)
    assert found["checkpoint.operation"].tolist() == [-1] * 3
    assert found["subgoal.intermediate"] == [demo.task.language] * 3
    assert key_frames(none).shape == (0,)
    with pytest.raises(MemobenchError, match="7 checkpoints"):
        labels(make_demo(["0"] * 7, task=make_task("SSSSSSS")))


def test_labels_equal_a_plain_simulation_of_the_definition(make_demo):
    rng = np.random.default_rng(0)
    for _ in range(100):
        length, count = int(rng.integers(1, 15)), int(rng.integers(1, 4))
        start = int(rng.integers(0, length))
        table = rng.random((count, length)) < 0.2
        table[:, :start] = False
        demo = make_demo(["".join(map(str, row.astype(int))) for row in table], exec_start=start)
        found, completion = labels(demo), key_frames(demo)
        index, seen = 0, set()
        for t in range(length):
            assert found["checkpoint.index"][t] == index
            new = {k for k in range(count) if table[k, t]} - seen
            assert found["checkpoint.event"][t] == bool(new)
            seen |= new
            assert set(np.flatnonzero(found["checkpoint.completed"][t])) == seen
            while index < count and table[index, t]:
                assert completion[index] == t
                index += 1


def test_hash_covers_every_part(make_demo, make_task):
    demo = make_demo(["0010", "0001"], exec_start=1, size=16)
    states, actions, satisfied = demo.states.copy(), demo.actions.copy(), demo.satisfied.copy()
    states[-1, -1] = np.nextafter(states[-1, -1], 9)
    actions[0, 0] *= -1
    satisfied[3] = False
    changes = [
        {"states": states},
        {"actions": actions},
        {"executed": actions},
        {"satisfied": satisfied},
        {"seed": 1},
        {"variant": 1},
        {"exec_start": 2},
        {"success": False},
        {"task": make_task("UU")},
    ]
    assert len({digest(demo), *(digest(replace(demo, **change)) for change in changes)}) == len(changes) + 1
    assert digest(replace(demo, images=None, states=np.asfortranarray(demo.states))) == digest(demo)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": np.zeros((4, 5), dtype=np.float32)}, "states"),
        ({"actions": np.zeros((3, 7), dtype=np.float32)}, "actions"),
        ({"satisfied": np.zeros((4, 3), dtype=np.bool_)}, "satisfied"),
        ({"satisfied": np.ones((4, 2), dtype=np.bool_), "exec_start": 1}, "demonstration prompt"),
        ({"exec_start": 4}, "frame 4 of 4"),
        ({"images": {"image": np.zeros((4, 8, 8, 3), dtype=np.uint8)}}, "images"),
    ],
)
def test_inconsistent_arrays_are_refused(make_demo, change, message):
    with pytest.raises(MemobenchError, match=message):
        replace(make_demo(["0010", "0001"]), **change)


# --- language rows ---


def rows_of(demo, style):
    return [(row["timestamp"], row["content"]) for row in persistent_rows(labels(demo)) if row["style"] == style]


def test_short_lived_texts_get_no_row(make_demo):
    # Checkpoints 0 and 1 complete two frames apart: "did thing 1" is the subtask for 0.1 s only.
    demo = make_demo(["0" * 10 + "1" * 30, "0" * 12 + "1" * 28, "0" * 30 + "1" * 10])
    assert [text for _, text in rows_of(demo, "subtask")] == ["did thing 0", "did thing 2"]
    memory = rows_of(demo, "memory")
    assert [text for _, text in memory] == ["did thing 0; did thing 1", "did thing 0; did thing 1; did thing 2"]
    assert memory[0][0] == float(np.float32(13 / 20)), "not before both are done"
    assert rows_of(make_demo(["0100000000", "0001111111"]), "subtask") == [(0.0, "did thing 1")], "from frame 0 on"


def test_rows_satisfy_lerobots_writer_and_resolvers(make_demo):
    writer = pytest.importorskip("lerobot.annotations.steerable_pipeline.writer")
    from lerobot.datasets import language_render

    rng = np.random.default_rng(3)
    for _ in range(20):
        table = np.zeros((3, 30), dtype=int)
        for k in range(3):
            table[k, int(rng.integers(1, 30)) :] = 1
        rows = persistent_rows(labels(make_demo(["".join(map(str, row)) for row in table])))
        empty = {"camera": None, "tool_calls": None}  # "" and [] here, for lerobot-dataset-viz
        assert [writer._normalize_persistent_row(row | empty) for row in rows] == [row | empty for row in rows]
        assert sorted(rows, key=writer._row_persistent_sort_key) == rows
        for t in np.float32(np.arange(30) / 20).tolist():
            for style in ("subtask", "memory"):
                language_render.emitted_at(t, persistent=rows, events=[], style=style)  # raises for two rows
                active = language_render.active_at(t, persistent=rows, style=style)
                assert style == "memory" or active is not None
