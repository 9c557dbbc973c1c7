"""Which episodes are run, in which batches: every part of an evaluation, and what a killed one has left."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.run.plan import Grid, Place, Shard, parse_shard, task_names


def place(name: str, number: int = 0) -> Place:
    return Place("temporal", number, cast(Any, SimpleNamespace(name=name)))


def grid(tasks: str = "ab", runs: int = 10, batch: int = 4, first: int = 0) -> Grid:
    return Grid(tuple(place(name, k) for k, name in enumerate(tasks)), runs, batch, first)


def test_a_whole_evaluation_is_one_range_per_task() -> None:
    assert grid().ranges(grid().cells()) == {("temporal", 0): [(0, 10)], ("temporal", 1): [(0, 10)]}


def test_batches_are_not_taken_apart() -> None:
    done = {("a", k) for k in range(10)} - {("a", 5)} | {("b", k) for k in range(4)}
    left = grid().missing(done)
    assert [(p.task.name, number) for p, number in left] == [("a", 1), ("b", 1), ("b", 2)]
    assert grid().ranges(left) == {("temporal", 0): [(4, 4)], ("temporal", 1): [(4, 6)]}


def test_holes_are_ranges_of_their_own() -> None:
    done = {("a", k) for k in range(4, 8)}
    assert grid("a").ranges(grid("a").missing(done)) == {("temporal", 0): [(0, 4), (8, 2)]}


def test_nothing_is_left_of_a_complete_evaluation() -> None:
    whole = {(name, k) for name in "ab" for k in range(10)}
    assert grid().missing(whole) == []
    assert grid().missing(whole | {("c", 0), ("a", 11)}) == []


def test_episodes_count_from_the_first() -> None:
    later = grid("a", runs=3, batch=2, first=5)
    assert [later.episodes(cell) for cell in later.cells()] == [[("a", 5), ("a", 6)], [("a", 7)]]


def test_names_of_the_tasks_that_are_left() -> None:
    assert task_names(grid("abc").places, {("temporal", 2), ("temporal", 0)}) == ["a", "c"]


@given(
    tasks=st.integers(1, 5), runs=st.integers(1, 60), batch=st.integers(1, 70), count=st.integers(1, 12), data=st.data()
)
def test_parts_make_up_the_whole(tasks: int, runs: int, batch: int, count: int, data: st.DataObject) -> None:
    whole = grid("abcde"[:tasks], runs, min(batch, runs))
    parts = [whole.cells(Shard(k, count)) for k in range(1, count + 1)]
    assert [cell for part in parts for cell in part] == whole.cells()
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    episodes = [episode for part in parts for cell in part for episode in whole.episodes(cell)]
    assert episodes == [(name, k) for name in "abcde"[:tasks] for k in range(runs)]
    done = data.draw(st.sets(st.sampled_from(episodes)))
    run = {
        (whole.places[key[1]].task.name, k)
        for number in range(1, count + 1)
        for key, ranges in whole.ranges(whole.missing(done, Shard(number, count))).items()
        for start, length in ranges
        for k in range(start, start + length)
    }
    assert run | done == set(episodes)
    assert all(start % whole.batch == 0 for ranges in whole.ranges(whole.missing(done)).values() for start, _ in ranges)


def test_parts_have_folders_that_sort() -> None:
    assert parse_shard("3/12").folder == "shard-3-of-12"
