"""All episodes of an evaluation, in the batches in which they are run, and which of them a part or a run has left."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot_memobench.tasks.task import Task

Range = tuple[int, int]
"""First run of a task and how many: run k is LeRobot's k-th, of the seed ``seed`` + k."""


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


def parse_shard(text: str) -> Shard:
    """Read ``2/8``: parts are counted from 1."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise MemobenchError(
            f"found shard={text}; expected i/n with i from 1 to n, such as shard=1/8 for the first of 8"
        )
    return Shard(int(number), int(count))


@dataclass(frozen=True)
class Place:
    """A task of an evaluation and what LeRobot calls it: suite and number."""

    suite: str
    number: int
    task: Task

    @property
    def key(self) -> tuple[str, int]:
        """What LeRobot calls the task."""
        return self.suite, self.number


@dataclass(frozen=True)
class Grid:
    """All that an evaluation is to run.

    Attributes:
        places: the tasks, in the order in which they are run.
        runs: how many of each.
        batch: environments at once; run k belongs to batch k // ``batch`` of its task.
        first: episode of run 0 (0 in the benchmark's protocol).
    """

    places: tuple[Place, ...]
    runs: int
    batch: int
    first: int = 0

    @property
    def batches(self) -> int:
        """How many batches of each task there are."""
        return -(-self.runs // self.batch)

    def cells(self, shard: Shard | None = None) -> list[tuple[Place, int]]:
        """Return (task, batch) of a shard, or all. Batches are not taken apart: a policy sees whole ones."""
        found = [(place, number) for place in self.places for number in range(self.batches)]
        return found if shard is None else found[shard.of(len(found))]

    def episodes(self, cell: tuple[Place, int]) -> list[tuple[str, int]]:
        """Return (task name, episode) of the runs in a batch."""
        place, number = cell
        runs = range(number * self.batch, min((number + 1) * self.batch, self.runs))
        return [(place.task.name, self.first + run) for run in runs]

    def missing(self, done: Collection[tuple[str, int]], shard: Shard | None = None) -> list[tuple[Place, int]]:
        """Return the batches that hold an episode that is not in ``done``."""
        return [cell for cell in self.cells(shard) if not set(self.episodes(cell)) <= set(done)]

    def ranges(self, cells: Iterable[tuple[Place, int]]) -> dict[tuple[str, int], list[Range]]:
        """Return the runs of these batches, neighbours joined, by LeRobot's name of the task."""
        found: dict[tuple[str, int], list[Range]] = {}
        for place, number in cells:
            start = number * self.batch
            count = min(self.batch, self.runs - start)
            mine = found.setdefault(place.key, [])
            if mine and sum(mine[-1]) == start:
                mine[-1] = (mine[-1][0], mine[-1][1] + count)
            else:
                mine.append((start, count))
        return found


def task_names(places: Sequence[Place], keys: Collection[tuple[str, int]]) -> list[str]:
    """Return the names of the tasks that LeRobot calls by these keys."""
    return [place.task.name for place in places if place.key in keys]
