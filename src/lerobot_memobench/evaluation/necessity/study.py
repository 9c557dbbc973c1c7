"""Memory necessity of one task, from simulated episodes to a JSON object; resumable scene by scene.

One file is kept per scene and one per search, so that a killed run goes on, and a run of more scenes uses those there
are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lerobot_memobench.evaluation.necessity.any_order import search
from lerobot_memobench.evaluation.necessity.demonstrations import follow
from lerobot_memobench.evaluation.necessity.kept import Kept, KeptScene, KeptSearch
from lerobot_memobench.evaluation.necessity.laboratory import Laboratory
from lerobot_memobench.evaluation.necessity.question import Settings, fingerprint, variants_of
from lerobot_memobench.evaluation.necessity.scene import EXAMPLES, Scene
from lerobot_memobench.io import draft_of, file_name
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation

Piece = Literal["scene", "search"]
"""What is made and kept one at a time, for each seed."""

Result = Mapping[str, Any]
"""What is found about a task: JSON values."""


def study(task: Task, referent: str, settings: Settings, out: Path) -> Result:
    """Return the result of a task under a referent setting; what is not on disk yet is simulated."""
    return Study(task, referent, settings, out).result()


class Study:
    """One task under one referent setting: what is on disk is read, the rest is simulated and kept.

    Scenes and searches do not depend on one another; processes may make them in one folder.
    """

    def __init__(self, task: Task, referent: str, settings: Settings, out: Path) -> None:
        self.task, self.referent, self.settings, self.out = task, referent, settings, out
        self.variants = variants_of(task, referent)

    def piece(self, piece: Piece, seed: int) -> Kept:
        """Return what a scene's demonstrations show, or which ways to the goal are found from its start in any order.

        It is on disk, or made when it is asked for.
        """
        if piece == "scene":
            mark, path = fingerprint(self.task, self.referent, self.settings), self._path(str(seed))
            return Kept(path, KeptScene, mark, lambda: self._observe(seed))
        mark, path = fingerprint(self.task, self.referent, self.settings, seed), self._path(f"search.{seed}")
        return Kept(path, KeptSearch, mark, lambda: self._explore(seed))

    @property
    def searched(self) -> bool:
        """Whether other ways to the goal are looked for: without need of a memory there is no search."""
        in_order = _mean_of([scene["in_order"] for scene in self._all("scene") if scene["in_order"]])
        return in_order is not None and in_order["deterministic"] < 1.0 and self.settings.budget > 0

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
    """Return what the scenes of a task say together."""
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
    """Return what the searches of a task say together; the policy is the first one's."""
    return {
        **{key: sum(found[key] for found in searches) / len(searches) for key in ("deterministic", "stochastic")},
        **{key: sum(found[key] for found in searches) for key in ("confirmed", "of")},
        **{key: all(found[key] for found in searches) for key in ("complete", "exhausted")},
        "policy": searches[0]["policy"],
    }


def _mean_of(tables: Sequence[dict[str, float]]) -> dict[str, float] | None:
    if not tables:
        return None
    return {key: sum(table[key] for table in tables) / len(tables) for key in tables[0]}


# --- on disk ---


def pictures_path(out: Path, task: str, referent: str, seed: int) -> Path:
    """Return where a scene's first aliased pair lies: a strip of both moments, two cameras each.

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
