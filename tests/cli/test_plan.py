"""Which episodes are run, in which batches: every part of an evaluation, and what a killed one has left."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.cli.arguments import Words
from lerobot_memobench.cli.orders import Orders, Shard, parse_shard, take_orders
from lerobot_memobench.cli.plan import Grid, Place, task_names
from lerobot_memobench.errors import MemobenchError


def place(name: str, number: int = 0) -> Place:
    return Place("temporal", number, cast(Any, SimpleNamespace(name=name)))


def grid(tasks: str = "ab", runs: int = 10, batch: int = 4, first: int = 0) -> Grid:
    return Grid(tuple(place(name, k) for k, name in enumerate(tasks)), runs, batch, first)


# --- the grid ---


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


# --- the words on the command line ---


def orders(*settings: str) -> Orders:
    words = Words([tuple(word.split("=", 1)) for word in settings])  # type: ignore[misc]
    return take_orders(words, ["lerobot", "eval", *settings])


def test_orders_are_taken_out_of_the_settings() -> None:
    words = Words([("env", "memobench"), ("resume", "true"), ("episodes", "3"), ("shard", "2/3")])
    taken = take_orders(words, ["lerobot", "eval"])
    assert words.settings == [("env", "memobench"), ("episodes", "3")]
    assert (taken.resume, taken.shard, taken.any) == (True, Shard(2, 3), True)
    assert not orders().any


def test_executors_and_their_options() -> None:
    taken = orders("shards=8", "workers=2", "executor=slurm", "executor_option=partition=gpu", "executor_option=mem=4")
    assert (taken.shards, taken.workers, taken.executor) == (8, 2, "slurm")
    assert taken.executor_options == {"partition": "gpu", "mem": 4}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("shard=0/4", "i from 1 to n"),
        ("shard=5/4", "i from 1 to n"),
        ("shard=2", "i from 1 to n"),
        ("shard=a/b", "i from 1 to n"),
        ("shard=-1/4", "i from 1 to n"),
        ("shards=0", "from 1 on"),
        ("shards=many", "from 1 on"),
        ("resume=yes", "true or false"),
        ("executor=slurm", "shards=8"),
        ("workers=3", "shards=8"),
    ],
)
def test_orders_that_cannot_be_obeyed(word: str, message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        orders(word)


def test_one_part_or_all_of_them() -> None:
    with pytest.raises(MemobenchError, match="one part"):
        orders("shard=1/2", "shards=2")


def test_parts_have_folders_that_sort() -> None:
    assert parse_shard("3/12").folder == "shard-3-of-12"
