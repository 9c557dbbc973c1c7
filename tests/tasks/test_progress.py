"""Progress of an episode: steps and order of checkpoints, success. No physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.tasks.catalogue import get_task, load_task
from lerobot_memobench.tasks.formula import Atom, Then
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

FIRST, SECOND = Atom("on", ("butter_1", "bowl_1")), Atom("on", ("bowl_1", "plate_1"))
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
MOVES = [Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))]


def play(task: Task, *states: set[Atom]) -> Progress:
    progress = Progress(task)
    for state in states:
        progress.step(state.__contains__)
    return progress


def facts(progress: Progress) -> tuple[int, bool, int, tuple[bool, ...], list[int | None], list[int | None]]:
    return (
        progress.steps,
        progress.success,
        progress.index,
        progress.satisfied,
        [*progress.first_step],
        [*progress.ordered_step],
    )


def test_in_order_until_reset() -> None:
    progress = Progress(get_task(ASSEMBLY))
    fresh = facts(progress)
    assert fresh == (0, False, 0, (False, False), [None, None], [None, None])
    for state in (set(), {FIRST}, {FIRST}, {FIRST, SECOND}):
        progress.step(state.__contains__)
    assert facts(progress) == (4, True, 2, (True, True), [2, 4], [2, 4])
    progress.step({FIRST}.__contains__)
    assert not progress.success, "success is the present value of the goal"
    progress.reset()
    assert facts(progress) == fresh


def test_out_of_order_counts_from_the_step_that_completes_the_earlier_ones() -> None:
    early = play(get_task(ASSEMBLY), {SECOND}, {FIRST}, set())
    assert (early.first_step, early.ordered_step, early.index) == ([2, 1], [2, None], 1)
    assert play(get_task(ASSEMBLY), {SECOND}, {FIRST, SECOND}).ordered_step == [2, 2]
    assert play(get_task(ASSEMBLY), {SECOND}, {FIRST}, {SECOND}).ordered_step == [2, 3]


def test_latched_checkpoint() -> None:
    on, off = Atom("turnon", ("flat_stove_1",)), Atom("turnoff", ("flat_stove_1",))
    progress = play(get_task("turn_on_the_stove_and_turn_it_off"), {off}, {on}, set(), {off})
    assert (progress.ordered_step, progress.satisfied, progress.success) == ([2, 4], (True, True), True)


def test_nested_then_goal_of_the_swap() -> None:
    one, two, three = MOVES
    progress = play(get_task(SWAP), *[{one}] * 10, *[{one, two}] * 10, *[{two, three}] * 18)
    assert progress.ordered_step == [1, 11, 21]
    assert not progress.success
    assert progress.step({two, three}.__contains__)  # the inner Then is done at step 30 and has held at step 39


def test_two_evaluations_per_step_and_settling() -> None:
    """`Then` takes five steps per child with two evaluations; settling updates formulas but counts no step."""
    both = {FIRST, SECOND}.__contains__
    task = replace(get_task(ASSEMBLY), goal=Then((FIRST, SECOND)))
    assert [Progress(task, 2).step(both)] == [False]
    progress = Progress(task, evaluations=2)
    assert [progress.step(both) for _ in range(10)] == [False] * 9 + [True]
    settled = Progress(task, evaluations=2)
    for _ in range(7):
        settled.settle(both)
    assert (settled.steps, settled.first_step) == (0, [None, None])
    assert [settled.step(both) for _ in range(3)] == [False, False, True]
    assert (settled.steps, settled.first_step) == (3, [1, 1])
    nested = Progress(replace(task, goal=Then((Then((FIRST,)),))), evaluations=2)
    assert [nested.step(both) for _ in range(10)] == [False] * 9 + [True]  # evaluations 10 to 19


def test_task_without_checkpoints(write_task: Callable[..., Path], bddl: str) -> None:
    task = load_task(write_task(bddl, None), require_metadata=False)
    progress = play(task, set(), {Atom("in", ("cup_1", "box_1_top_region"))})
    assert (progress.success, progress.satisfied) == (True, ())


@given(st.lists(st.sets(st.sampled_from([0, 1, 2])), max_size=40))
def test_order_properties(states: list[set[int]]) -> None:
    progress = play(get_task(SWAP), *({MOVES[i] for i in state} for state in states))
    firsts = [next((i + 1 for i, state in enumerate(states) if k in state), None) for k in range(3)]
    assert progress.first_step == firsts
    done = progress.ordered_step[: progress.index]
    assert progress.ordered_step[progress.index :] == [None] * (3 - progress.index)
    earlier = 1
    for k, ordered in enumerate(done):
        assert ordered == next(step for step in range(earlier, len(states) + 1) if k in states[step - 1])
        earlier = ordered
