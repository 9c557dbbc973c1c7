"""The demo's second part: a task that begins with a prompt, under the expert, a policy with a memory and one without.

The policies are those that come with the package. All three see the same episodes, of the first evaluation seeds, and
the table counts them all: so many that a policy without a memory, which guesses, stands out. Objects are told as
numbers, so that only the few filmed ones are drawn. Film and strip are of the first of these that did not end alike
for all, or else of the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.observations import OBJECTS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.rollouts import saw
from lerobot_memobench.io import write_file
from lerobot_memobench.policies.checkpoint import shipped_policies
from lerobot_memobench.run.folder import VIDEOS
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.run.planning import plan_line
from lerobot_memobench.run.side_by_side import side_by_side, strip
from lerobot_memobench.tasks.catalogue import BOWL
from lerobot_memobench.tasks.failures import REFERENCE_DRIFT

WHO: dict[str, tuple[str, ...]] = {
    "expert": (),
    "with memory": ("policy=memobench_small",),
    "without memory": ("policy=memobench_small_memoryless",),
}
"""Who acts -> what is said of it to `lerobot eval`."""
EPISODES, FILMS, HORIZON = 12, 3, 400
"""Of each; how many of them are filmed; and how many steps one may take. The expert takes about 150."""
MEMORY_FILM, MEMORY_STRIP, MEMORY_TABLE = "memory.mp4", "memory.png", "memory.md"


@dataclass(frozen=True)
class Told:
    """How somebody's episodes ended: whether each was solved, how many failed at a wrong referent; and what it saw."""

    solved: tuple[bool, ...]
    wrong: int
    saw: str


def has_policies() -> bool:
    """Return whether the package brings the trained policies that are compared."""
    return {word.partition("=")[2] for words in WHO.values() for word in words} <= set(shipped_policies())


def memory_plan(name: str, folder: Path) -> EvaluationPlan:
    """Return the plan of one's evaluation."""
    words = ["env=memobench", *WHO[name], f"tasks={BOWL}", "referent=random", f"horizon={HORIZON}"]
    seen = f"obs_type={OBJECTS}"
    return plan_line([*words, seen, f"episodes={EPISODES}", f"films={FILMS}", f"output_dir={folder}"])


def compare_memories(work: Path, out: Path, evaluate: Callable[[str, Path], int]) -> dict[str, Told]:
    """Evaluate all, each in a folder of its own in ``work``; write film, strip and table into ``out``.

    Args:
        evaluate: runs one's evaluation in a folder and returns its exit status.

    Raises:
        MemobenchError: an evaluation failed.
    """
    told: dict[str, Told] = {}
    folders = {name: work / name.replace(" ", "_") for name in WHO}
    for name, folder in folders.items():
        if evaluate(name, folder):
            raise MemobenchError(f"the evaluation {name} has failed; see its messages above")
        told[name] = _told(folder)
    ends = enumerate(zip(*(one.solved[:FILMS] for one in told.values()), strict=True))
    shown = next((episode for episode, solved in ends if len({*solved}) > 1), 0)
    films = {
        name: (folder / VIDEOS / f"{BOWL}.{shown}.mp4", told[name].solved[shown]) for name, folder in folders.items()
    }
    out.mkdir(parents=True, exist_ok=True)
    side_by_side(films, out / MEMORY_FILM)
    strip(films).save(out / MEMORY_STRIP, optimize=True)
    write_file(out / MEMORY_TABLE, table(told))
    return told


def _told(folder: Path) -> Told:
    records = read_episodes(folder)
    return Told(
        solved=tuple(bool(record["success"]) for record in sorted(records, key=itemgetter("episode"))),
        wrong=sum(not record["success"] and record.get("failure") == REFERENCE_DRIFT for record in records),
        saw=saw(records),
    )


def table(told: dict[str, Told]) -> str:
    """Return who solved how many of the episodes, and how many failed at a wrong bowl, as Markdown."""
    rows = [f"| {name} | {sum(one.solved)}/{len(one.solved)} | {one.wrong} | {one.saw} |" for name, one in told.items()]
    head = "| butter into the bowl that the prompt showed, of three | solved | wrong bowl | saw |"
    return "\n".join([head, "|---|---|---|---|", *rows]) + "\n"
