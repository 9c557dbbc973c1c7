"""How an evaluation is run: the words on the command line that are no settings of LeRobot's."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.arguments import Words
from lerobot_memobench.run.plan import Orders, Shard, take_orders


def orders(*settings: str) -> Orders:
    words = Words([tuple(word.split("=", 1)) for word in settings])  # type: ignore[misc]
    return take_orders(words)[0]


def test_orders_are_taken_out_of_the_settings() -> None:
    words = Words([("env", "memobench"), ("resume", "true"), ("episodes", "3"), ("shard", "2/3")])
    taken, rest = take_orders(words)
    assert rest.settings == [("env", "memobench"), ("episodes", "3")]
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
