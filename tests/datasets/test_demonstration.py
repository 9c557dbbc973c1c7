from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import digest, labels
from lerobot_memobench.errors import MemobenchError


def bits(values) -> str:
    return "".join(str(int(v)) for v in values)


def test_checkpoints_in_order(make_demo):
    # frame              0123456789
    demo = make_demo(["0011000000", "0000011111", "0000000001"])
    found = labels(demo)
    assert found.key_frames.tolist() == [2, 5, 9]
    assert bits(found.index) == "0001112222"  # frames before t: the event's own frame does not count yet
    assert found.operation.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 2]
    assert bits(found.event) == "0010010001"
    assert bits(found.completed[:, 0]) == "0011111111"  # includes frame t, and stays
    assert bits(found.completed[:, 1]) == "0000011111"
    assert bits(found.completed[:, 2]) == "0000000001"
    assert not found.completed[:, 3:].any()
    assert bits(found.phase) == "1111111111"


def test_texts(make_demo):
    found = labels(make_demo(["01000", "00100", "00010"]))
    assert found.simple_subgoal == ["did thing 0"] * 2 + ["did thing 1"] + ["did thing 2"] * 2
    assert found.grounded_subgoal[2] == "did thing 1 with the left hand"
    assert found.operation.tolist() == [0, 0, 1, 2, -1], "none is left"
    assert found.coarse_subgoal == ["coarse 0"] * 2 + ["coarse 1"] + ["coarse 2"] * 2, "the last one's stays"
    assert found.memory == [
        "",
        "",
        "did thing 0",
        "did thing 0; did thing 1",
        "did thing 0; did thing 1; did thing 2",
    ]


def test_prompt_frames(make_demo):
    found = labels(make_demo(["000001", "000000"], exec_start=3))
    assert bits(found.phase) == "000111"
    assert bits(found.index) == "000000"
    assert not found.completed[:3].any()
    assert set(found.memory) == {""}
    assert found.key_frames.tolist() == [5, -1]  # frames of the episode, prompt included


def test_task_without_checkpoints(make_demo, make_task):
    demo = make_demo(["000"], task=make_task("S"))
    bare = replace(demo, task=make_task(""), satisfied=np.zeros((3, 0), dtype=np.bool_))
    found = labels(bare)
    assert found.operation.tolist() == [-1] * 3
    assert found.simple_subgoal == [bare.task.language] * 3
    assert not found.event.any()
    assert found.key_frames.shape == (0,)


def test_columns_are_typed_and_complete(make_demo):
    columns = labels(make_demo(["0010", "0001"])).columns()
    kinds = {name: c.dtype.name for name, c in columns.items() if isinstance(c, np.ndarray)}
    assert kinds == {
        "observation.phase": "float32",
        "observation.step": "float32",
        "checkpoint.index": "int64",
        "checkpoint.operation": "int64",
        "checkpoint.completed": "bool",
        "checkpoint.event": "bool",
    }
    assert set(columns) - set(kinds) == {"simple_subgoal", "grounded_subgoal", "coarse_subgoal", "memory"}
    assert all(len(column) == 4 for column in columns.values())


def test_too_many_checkpoints(make_demo, make_task):
    with pytest.raises(MemobenchError, match="7 checkpoints"):
        labels(make_demo(["0"] * 7, task=make_task("SSSSSSS")))


def test_labels_match_a_plain_simulation_of_the_definition(make_demo):
    rng = np.random.default_rng(0)
    for _ in range(200):
        length, count = int(rng.integers(1, 15)), int(rng.integers(1, 4))
        start = int(rng.integers(0, length))
        table = rng.random((count, length)) < 0.2
        table[:, :start] = False
        found = labels(make_demo(["".join(map(str, row.astype(int))) for row in table], exec_start=start))
        index, seen = 0, set()
        for t in range(length):
            assert found.index[t] == index
            new = {k for k in range(count) if table[k, t]} - seen
            assert found.event[t] == bool(new)
            seen |= new
            assert set(np.flatnonzero(found.completed[t])) == seen
            while index < count and table[index, t]:
                assert found.key_frames[index] == t
                index += 1


def test_labels_of_a_frame_are_those_of_the_frames_up_to_it(make_demo):
    whole, part = (
        labels(make_demo(["000010", "011111"], exec_start=1)),
        labels(make_demo(["00001", "01111"], exec_start=1)),
    )
    for name, column in part.columns().items():
        assert np.array_equal(np.asarray(column), np.asarray(whole.columns()[name])[:5]), name


def test_digest_sees_every_part(make_demo, make_task):
    demo = make_demo(["0010", "0001"], exec_start=1)
    same = make_demo(["0010", "0001"], exec_start=1)
    assert digest(demo) == digest(same)
    assert len(digest(demo)) == 64
    changed_state = demo.states.copy()
    changed_state[-1, -1] = np.nextafter(changed_state[-1, -1], 9)
    changed_action = demo.actions.copy()
    changed_action[0, 0] *= -1
    satisfied = demo.satisfied.copy()
    satisfied[3] = False
    others = [
        replace(demo, states=changed_state),
        replace(demo, actions=changed_action),
        replace(demo, satisfied=satisfied),
        replace(demo, seed=1),
        replace(demo, variant=1),
        replace(demo, exec_start=2),
        replace(demo, success=False),
        replace(demo, task=make_task("UU")),
    ]
    assert len({digest(demo), *(digest(other) for other in others)}) == len(others) + 1
    # Images and memory layout are no part of it.
    assert digest(replace(demo, states=np.asfortranarray(demo.states))) == digest(demo)
    shown = make_demo(["0010", "0001"], exec_start=1, size=16)
    assert digest(replace(shown, images=None)) == digest(shown)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": np.zeros((4, 5), dtype=np.float32)}, "states has type float32"),
        ({"actions": np.zeros((3, 7), dtype=np.float32)}, "actions has type float32 and shape"),
        ({"actions": np.zeros((4, 6), dtype=np.float32)}, "actions"),
        ({"proprio": np.zeros((4, 8))}, "proprio has type float64"),
        ({"satisfied": np.zeros((4, 3), dtype=np.bool_)}, "satisfied"),
        ({"satisfied": np.ones((4, 2), dtype=np.bool_), "exec_start": 1}, "demonstration prompt"),
        ({"exec_start": 4}, "execution starts at frame 4 of 4"),
        ({"images": {"image": np.zeros((4, 8, 8, 3), dtype=np.uint8)}}, "images"),
        ({"images": {"image": np.zeros((4, 8, 8), dtype=np.uint8)}}, "images"),
    ],
)
def test_inconsistent_arrays_are_named(make_demo, change, message):
    with pytest.raises(MemobenchError, match=message):
        replace(make_demo(["0010", "0001"]), **change)
