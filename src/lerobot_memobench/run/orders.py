"""How an evaluation is run, beside what is evaluated: resume=, shard=, shards=, workers=, executor= …"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.grid import Shard, parse_shard
from lerobot_memobench.run.short_forms import EVALUATION_WORDS
from lerobot_memobench.run.words import Words, executor_options

PROCESSES = "processes"


@dataclass(frozen=True)
class Orders:
    """How an evaluation is run, as opposed to what is evaluated.

    Attributes:
        verbose: LeRobot's own messages are shown, too.
        resume: go on with the evaluation in the output folder.
        shard: run this part alone.
        shards: run so many parts as jobs of their own, ``workers`` at a time, and merge them; 0: no parts.
        workers: 0: as many as shards.
        executor, executor_options: see `jobs.running.run_jobs`.
    """

    verbose: bool = False
    resume: bool = False
    shard: Shard | None = None
    shards: int = 0
    workers: int = 0
    executor: str = PROCESSES
    executor_options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def any(self) -> bool:
        """Whether something is asked for that only the benchmark's evaluation can do."""
        return self.resume or self.in_parts

    @property
    def in_parts(self) -> bool:
        """Whether a part is run, or all of them as parts."""
        return self.shard is not None or self.shards > 0


def take_orders(words: Words) -> tuple[Orders, Words]:
    """Return the orders in a command line, and the words without them.

    Raises:
        MemobenchError: one that cannot be obeyed.
    """
    given: dict[str, list[str]] = {}
    for key, value in words.settings:
        if key in EVALUATION_WORDS:
            given.setdefault(key, []).append(value)
    rest = [(key, value) for key, value in words.settings if key not in EVALUATION_WORDS]
    last = {key: values[-1] for key, values in given.items()}
    orders = Orders(
        verbose=_boolean("verbose", last.get("verbose", "false")),
        resume=_boolean("resume", last.get("resume", "false")),
        shard=parse_shard(last["shard"]) if "shard" in last else None,
        shards=_count("shards", last.get("shards")),
        workers=_count("workers", last.get("workers")),
        executor=last.get("executor", PROCESSES),
        executor_options=executor_options(given.get("executor_option", [])),
    )
    _check(orders, given)
    return orders, replace(words, settings=rest)


def _check(orders: Orders, given: Mapping[str, Any]) -> None:
    if orders.shards and orders.shard is not None:
        raise MemobenchError(
            f"both shard={orders.shard} and shards={orders.shards} are given; shard= runs one part, shards= all of them"
        )
    idle = [key for key in ("workers", "executor", "executor_option") if key in given]
    if idle and not orders.shards:
        raise MemobenchError(
            f"{idle[0]}= says how parts of an evaluation are run; say how many parts, such as shards=8"
        )


def _count(key: str, text: str | None) -> int:
    if text is None:
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise MemobenchError(f"found {key}={text}; expected a whole number from 1 on")
    return int(text)


def _boolean(key: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise MemobenchError(f"found {key}={text}; expected true or false")
    return text.lower() == "true"
