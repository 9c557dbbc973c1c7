"""Checkpoints over an episode: when, and in which order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.tasks import Atom, Progress, Task, get_task

FIRST, SECOND = Atom("on", ("butter_1", "bowl_1")), Atom("on", ("bowl_1", "plate_1"))
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"


def play(task: Task, *states: set[Atom]) -> Progress:
    progress = Progress(task)
    for state in states:
        progress.step(state.__contains__)
    return progress


def test_before_the_first_step() -> None:
    progress = Progress(get_task(ASSEMBLY))
    assert (progress.steps, progress.success, progress.index) == (0, False, 0)
    assert progress.satisfied == (False, False)
    assert progress.first_step == progress.ordered_step == [None, None]


def test_in_order() -> None:
    progress = play(get_task(ASSEMBLY), set(), {FIRST}, {FIRST}, {FIRST, SECOND})
    assert progress.first_step == progress.ordered_step == [2, 4]
    assert (progress.steps, progress.success, progress.index, progress.satisfied) == (
        4,
        True,
        2,
        (True, True),
    )


def test_out_of_order_counts_from_the_step_at_which_the_earlier_are_complete() -> None:
    early = play(get_task(ASSEMBLY), {SECOND}, {FIRST}, set())
    assert early.first_step == [2, 1]
    assert early.ordered_step == [2, None]
    assert early.index == 1
    held = play(get_task(ASSEMBLY), {SECOND}, {FIRST, SECOND})
    assert held.ordered_step == [2, 2]  # both complete in one step
    later = play(get_task(ASSEMBLY), {SECOND}, {FIRST}, {SECOND})
    assert later.ordered_step == [2, 3]
    assert not later.success


def test_success_is_the_goal_now() -> None:
    progress = Progress(get_task(ASSEMBLY))
    assert progress.step({FIRST, SECOND}.__contains__) is True
    assert progress.step({FIRST}.__contains__) is False
    assert progress.success is False
    assert progress.ordered_step == [1, 1]


def test_latched_checkpoint() -> None:
    on, off = Atom("turnon", ("flat_stove_1",)), Atom("turnoff", ("flat_stove_1",))
    progress = play(get_task("turn_on_the_stove_and_turn_it_off"), {off}, {on}, set(), {off})
    assert progress.first_step == progress.ordered_step == [2, 4]
    assert progress.satisfied == (True, True)
    assert progress.success


def test_then_goal_of_the_swap() -> None:
    one, two, three = (
        Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))
    )
    progress = play(get_task(SWAP), *[{one}] * 10, *[{one, two}] * 10, *[{two, three}] * 18)
    assert progress.ordered_step == [1, 11, 21]
    assert not progress.success
    assert progress.step({two, three}.__contains__)  # inner Then done at step 30, held ten steps at step 39
    assert not play(get_task(SWAP), *[{one, two, three}] * 9).success


def test_reset() -> None:
    progress = play(get_task(ASSEMBLY), {FIRST, SECOND})
    progress.reset()
    assert (progress.steps, progress.success, progress.index, progress.first_step) == (
        0,
        False,
        0,
        [None, None],
    )


def test_task_without_checkpoints(write_task: Callable[..., Path], bddl: str) -> None:
    from lerobot_memobench.tasks import load_task

    task = load_task(write_task(bddl, None), require_metadata=False)
    progress = play(task, set(), {Atom("in", ("cup_1", "box_1_top_region"))})
    assert progress.success
    assert progress.satisfied == ()


@given(st.lists(st.sets(st.sampled_from([0, 1, 2])), max_size=40))
def test_order_properties(states: list[Any]) -> None:
    task = get_task(SWAP)
    parts = [
        Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))
    ]
    progress = play(task, *({parts[i] for i in state} for state in states))
    done = [step for step in progress.ordered_step if step is not None]
    assert done == sorted(done)
    assert len(done) == progress.index
    assert progress.ordered_step[progress.index :] == [None] * (3 - progress.index)
    for k, ordered in enumerate(progress.ordered_step):
        first = progress.first_step[k]
        expected = next((i + 1 for i, state in enumerate(states) if k in state), None)
        assert first == expected
        if ordered is not None:
            assert first is not None
            assert ordered >= first
            assert k in states[ordered - 1]
            assert all(step is not None and step <= ordered for step in progress.first_step[:k])
