"""What ``lerobot eval env=memobench`` takes beside LeRobot's settings: resume=, shard=, shards=, executor= …"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from lerobot_memobench.cli.arguments import EVALUATION_WORDS, Words
from lerobot_memobench.cli.data import executor_options
from lerobot_memobench.errors import MemobenchError

PROCESSES = "processes"


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1 on) of ``count``."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def folder(self) -> str:
        """Name of its folder in that of the evaluation."""
        return f"shard-{self.number}-of-{self.count}"

    def of(self, length: int) -> slice:
        """Return which of ``length`` things are its: contiguous, the parts' sizes at most one apart."""
        return slice((self.number - 1) * length // self.count, self.number * length // self.count)


@dataclass(frozen=True)
class Orders:
    """How an evaluation is run, as opposed to what is evaluated.

    Attributes:
        resume: go on with the evaluation in the output folder.
        shard: run this part alone.
        shards: run so many parts as jobs of their own, ``workers`` at a time, and merge them; 0: no parts.
        workers: 0: as many as shards.
        executor, executor_options: see `datasets.running.run_jobs`.
        command: the command line as it was given, for the card.
    """

    resume: bool = False
    shard: Shard | None = None
    shards: int = 0
    workers: int = 0
    executor: str = PROCESSES
    executor_options: dict[str, Any] = field(default_factory=dict)
    command: tuple[str, ...] = ()

    @property
    def any(self) -> bool:
        return self.resume or self.shard is not None or self.shards > 0


def take_orders(words: Words, command: Sequence[str]) -> Orders:
    """Take the orders out of a command line's settings.

    Raises:
        MemobenchError: one that cannot be obeyed.
    """
    given: dict[str, list[str]] = {}
    for key, value in words.settings:
        if key in EVALUATION_WORDS:
            given.setdefault(key, []).append(value)
    words.settings = [(key, value) for key, value in words.settings if key not in EVALUATION_WORDS]
    last = {key: values[-1] for key, values in given.items()}
    orders = Orders(
        resume=_boolean("resume", last.get("resume", "false")),
        shard=parse_shard(last["shard"]) if "shard" in last else None,
        shards=_count("shards", last["shards"]) if "shards" in last else 0,
        workers=_count("workers", last["workers"]) if "workers" in last else 0,
        executor=last.get("executor", PROCESSES),
        executor_options=executor_options(given.get("executor_option", [])),
        command=tuple(command),
    )
    if orders.shards and orders.shard is not None:
        raise MemobenchError(
            f"both shard={orders.shard} and shards={orders.shards} are given; shard= runs one part, shards= all of them"
        )
    idle = [key for key in ("workers", "executor", "executor_option") if key in given]
    if idle and not orders.shards:
        raise MemobenchError(
            f"{idle[0]}= says how parts of an evaluation are run; say how many parts, such as shards=8"
        )
    return orders


def parse_shard(text: str) -> Shard:
    """Read ``2/8``: parts are counted from 1."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise MemobenchError(
            f"found shard={text}; expected i/n with i from 1 to n, such as shard=1/8 for the first of 8"
        )
    return Shard(int(number), int(count))


def _count(key: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise MemobenchError(f"found {key}={text}; expected a whole number from 1 on")
    return int(text)


def _boolean(key: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise MemobenchError(f"found {key}={text}; expected true or false")
    return text.lower() == "true"
