"""Memory necessity of one task, from simulated episodes to a JSON object; of many tasks, in several processes.

One file is kept per scene and one per search, so that a killed run goes on, and a run of more scenes uses those there
are. Anything else in such a file is made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

from annotated_types import Len, MaxLen

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Number, Whole, draft_of, file_name, read_json, write_file
from lerobot_memobench.jobs.processes import ProgressCallback
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.tasks.task import Task
from research.necessity.demonstrations import follow
from research.necessity.exploration import Laboratory, search
from research.necessity.scene import EXAMPLES, Scene
from research.necessity.settings import Settings, fingerprint, variants_of

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation


# --- types of kept results ---


@dataclass(frozen=True)
class Kept:
    """A result on disk, or still to be made.

    Attributes:
        path: its file.
        schema: of what types it is. fingerprint: of the question that it answers.
        make: makes it.
    """

    path: Path
    schema: Any
    fingerprint: str
    make: Callable[[], dict[str, Any]]

    def found(self) -> dict[str, Any] | None:
        """Return the content of the file if it is a result of these settings, else None."""
        try:
            found: dict[str, Any] = read_json(self.path, self.schema, "it is made again")
        except (FileNotFoundError, MemobenchError):
            return None
        return found if found["fingerprint"] == self.fingerprint else None

    def get(self) -> dict[str, Any]:
        """Return the result, made and written where there is none.

        Raises:
            MemobenchError: there is a folder in its place.
        """
        found = self.found()
        if found is None:
            if self.path.is_dir():
                raise MemobenchError(f"{self.path} is a folder, expected a result; remove it, or name another --out")
            found = {"fingerprint": self.fingerprint, **self.make()}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_file(self.path, json.dumps(found, indent=1) + "\n")
        return found


class Said(TypedDict):
    """A frame of an aliased pair."""

    variant: Count
    step: Count
    answer: str


class Example(TypedDict):
    """An aliased pair."""

    seed: Whole
    a: Said
    b: Said


Nothing = Annotated[dict[str, Any], MaxLen(0)]
"""Where no demonstration succeeded."""
Aliased = Annotated[dict[Literal["at_home", "pixel_exact", "as_it_happens", "with_step"], Number], Len(4, 4)]
"""Pictures at which more than one answer is right."""
InOrder = Annotated[
    dict[Literal["chance", "deterministic", "stochastic", "pixel_exact", "as_it_happens", "with_step"], Number],
    Len(6, 6),
]
"""How far policies without memory come in the demonstrated order."""


class KeptScene(TypedDict):
    """`Scene.result`."""

    fingerprint: str
    seed: Whole
    solved: Count
    decisions: Count
    aliased: Nothing | Aliased
    in_order: Nothing | InOrder
    examples: list[Example]
    largest_same: Number
    smallest_different: Number


class Rule(TypedDict):
    """Answer of a map at these combinations of atoms."""

    when: list[str]
    do: str


class KeptSearch(TypedDict):
    """`any_order.search`."""

    fingerprint: str
    deterministic: Number
    stochastic: Number
    confirmed: Count
    of: Count
    complete: bool
    exhausted: bool
    unexplored: Count
    policy: list[Rule]


# --- the study of one task ---

Piece = Literal["scene", "search"]
"""Pieces of a study, one per seed."""

Result = Mapping[str, Any]
"""Result of a task: JSON values."""


class Study:
    """One task under one referent setting: kept results are read, others simulated and kept.

    Scenes and searches do not depend on one another; processes may make them in one folder.
    """

    def __init__(self, task: Task, referent: str, settings: Settings, out: Path) -> None:
        self.task, self.referent, self.settings, self.out = task, referent, settings, out
        self.variants = variants_of(task, referent)

    def piece(self, piece: Piece, seed: int) -> Kept:
        """Return the result of a scene's demonstrations, or of the search from its start in any order.

        It is on disk, or made when it is asked for.
        """
        if piece == "scene":
            mark, path = fingerprint(self.task, self.referent, self.settings), self._path(str(seed))
            return Kept(path, KeptScene, mark, lambda: self._observe(seed))
        mark, path = fingerprint(self.task, self.referent, self.settings, seed), self._path(f"search.{seed}")
        return Kept(path, KeptSearch, mark, lambda: self._explore(seed))

    @property
    def searched(self) -> bool:
        """Whether other ways to the goal are searched: not where observations decide all."""
        in_order = _mean_of([scene["in_order"] for scene in self._all("scene") if scene["in_order"]])
        return in_order is not None and in_order["as_it_happens"] < 1.0 and self.settings.budget > 0

    def result(self) -> Result:
        """Return what scenes and searches say together."""
        return {
            "task": self.task.name,
            "memory_type": self.task.memory_type,
            "referent": self.referent,
            "settings": asdict(self.settings),
            "has_variants": self.task.num_variants > 1,
            **_over_scenes(self._all("scene"), len(self.variants)),
            "any_order": _over_searches(self._all("search")) if self.searched else None,
        }

    def _all(self, piece: Piece) -> list[dict[str, Any]]:
        return [self.piece(piece, seed).get() for seed in self.settings.seeds]

    def _path(self, what: str) -> Path:
        return self.out / "results" / f"{self.task.name}.{self.referent}.{what}.json"

    def _observe(self, seed: int) -> dict[str, Any]:
        sim = self._simulation()
        shown = [follow(variant, sim, seed, self.settings.horizon) for variant in self.variants]
        scene = Scene(self.variants, shown, self.settings.tolerance)
        _write_pair(scene, pictures_path(self.out, self.task.name, self.referent, seed))
        return scene.result(seed)

    def _explore(self, seed: int) -> dict[str, Any]:
        return search(Laboratory(self.variants, self._simulation(), seed), self.settings)

    def _simulation(self) -> Simulation:
        from lerobot_memobench.sim.simulation import Simulation

        return Simulation(self.task)


def _over_scenes(scenes: Sequence[Mapping[str, Any]], variants: int) -> dict[str, Any]:
    """Return the joint result of a task's scenes."""
    solved = sum(scene["solved"] for scene in scenes)
    return {
        "variants": variants,
        "expert": {"n": variants * len(scenes), "success": solved},
        "decisions": sum(scene["decisions"] for scene in scenes) / max(1, solved),
        "aliased": _mean_of([scene["aliased"] for scene in scenes if scene["aliased"]]),
        "in_order": _mean_of([scene["in_order"] for scene in scenes if scene["in_order"]]),
        "examples": [example for scene in scenes for example in scene["examples"]][:EXAMPLES],
        "largest_same": max(scene["largest_same"] for scene in scenes),
        "smallest_different": min(scene["smallest_different"] for scene in scenes),
    }


def _over_searches(searches: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the joint result of a task's searches; the policy is the first one's."""
    return {
        **{key: sum(found[key] for found in searches) / len(searches) for key in ("deterministic", "stochastic")},
        **{key: sum(found[key] for found in searches) for key in ("confirmed", "of", "unexplored")},
        "cut_off": sum(not found["exhausted"] for found in searches),
        "searches": len(searches),
        **{key: all(found[key] for found in searches) for key in ("complete", "exhausted")},
        "policy": searches[0]["policy"],
    }


def _mean_of(tables: Sequence[dict[str, float]]) -> dict[str, float] | None:
    if not tables:
        return None
    return {key: sum(table[key] for table in tables) / len(tables) for key in tables[0]}


# --- on disk ---


def pictures_path(out: Path, task: str, referent: str, seed: int) -> Path:
    """Return where a scene's first aliased pair lies: a strip of both frames, two cameras each.

    Raises:
        MemobenchError: the names, which may come from a file of results, lead elsewhere.
    """
    return out / "pictures" / file_name(f"{task}.{referent}.{seed}.png", f"the name of a picture of results in {out}")


def _write_pair(scene: Scene, path: Path) -> None:
    """Write a scene's first aliased pair, where it has one."""
    strip = scene.strip()
    if strip is None:
        return
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    with draft_of(path) as draft:
        Image.fromarray(strip).save(draft, optimize=True)


# --- pieces of work for several processes ---

PIECES: dict[Piece, str] = {"scene": "scenes", "search": "searches"}
"""In the order in which they are made, and what several are called."""


@dataclass(frozen=True)
class PieceJob:
    """One piece of a study as `jobs` runs it.

    Attributes:
        study: of one task under one setting.
        piece: name of the piece. seed: of its scene.
    """

    study: Study
    piece: Piece
    seed: int

    @property
    def folder(self) -> Path:
        """The file of the piece."""
        return self.study.piece(self.piece, self.seed).path

    @property
    def task_name(self) -> str:
        """The task and the piece."""
        return f"{self.piece} of {self.study.task.name}, referent {self.study.referent}"

    def run(self) -> None:
        """Make the piece and keep it."""
        self.study.piece(self.piece, self.seed).get()

    def finished(self) -> bool:
        """Whether the piece is there."""
        return self.study.piece(self.piece, self.seed).found() is not None

    def failure(self) -> None:
        """A piece that cannot be made is an error."""


def make(studies: Sequence[Study], piece: Piece, workers: int, progress: ProgressCallback | None = None) -> None:
    """Make one piece of every scene of the studies, those that are there excepted; searches only where asked for."""
    asked = [study for study in studies if piece == "scene" or study.searched]
    jobs = [PieceJob(study, piece, seed) for study in asked for seed in study.settings.seeds]
    if jobs:
        run_jobs(jobs, workers=workers, progress=progress)
