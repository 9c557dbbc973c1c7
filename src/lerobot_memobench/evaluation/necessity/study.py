"""Memory necessity of one task, from simulated episodes to a JSON object; resumable scene by scene."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.evaluation.necessity import decisions
from lerobot_memobench.evaluation.necessity.aliasing import (
    Decision,
    History,
    aliased,
    chance,
    classes,
    deterministic_ceiling,
    stochastic_ceiling,
)
from lerobot_memobench.evaluation.necessity.decisions import Demonstration, Laboratory, Moment
from lerobot_memobench.evaluation.necessity.search import best_map, best_probabilities
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation

VERSION = 1
"""Raised when results change, so that old ones are made again."""
REFERENTS = ("fixed", "random")
PIXEL_EXACT = 2
"""Largest channel difference of pictures that count as exactly the same, of 255: shading rounds differently."""
SAME_HAND = 0.01
"""Difference of the proprioception (m, rad) up to which the arm is where it was, as things happen."""
EXAMPLES = 3


@dataclass(frozen=True)
class Settings:
    """What a result depends on, besides the task.

    Attributes:
        episodes: scenes (seeds) per task; with `referent=random` each is demonstrated once per variant.
        seed_base: the first of their seeds.
        tolerance: share of pixels without a like pixel within two, up to which pictures look the same.
        budget: control steps after which the search for other ways to the goal begins no new state; 0 leaves it out.
        horizon: execution steps.
    """

    episodes: int = 3
    seed_base: int = 7
    tolerance: float = 0.005
    budget: int = 10_000
    horizon: int = decisions.HORIZON


def variants_of(task: Task, referent: str) -> list[Task]:
    """Return the goals that may lie behind the same start: the published one, or all that a random referent draws."""
    if referent == "fixed" or task.num_variants == 1:
        return [task]
    return [task.variant(k) for k in task.random_variants]


# --- results on disk ---
# One file per scene and one per search, so that a killed run goes on, and a run of more scenes uses those there are.


def pictures_path(out: Path, task: str, referent: str, seed: int) -> Path:
    """Return where a scene's first aliased pair lies: a strip of both moments, two cameras each."""
    return out / "pictures" / f"{task}.{referent}.{seed}.png"


def fingerprint(task: Task, referent: str, settings: Settings, search: bool = False) -> str:
    """Return what a scene's result, or that of the search, must carry to be an answer to the same question."""
    other = ("episodes", "seed_base") if search else ("episodes", "seed_base", "budget")
    asked = {key: value for key, value in asdict(settings).items() if key not in other}
    if search:
        asked["seed"] = settings.seed_base
    said = json.dumps([VERSION, referent, asked, task.bddl_text, task.metadata], sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def _kept(path: Path, mark: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what ``path`` holds if it answers this question, else what ``make`` returns, written there."""
    try:
        found = json.loads(path.read_text())
        if isinstance(found, dict) and found.get("fingerprint") == mark:
            return found
    except (OSError, ValueError):
        pass
    result = {"fingerprint": mark, **make()}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    draft.write_text(json.dumps(result, indent=1) + "\n")
    os.replace(draft, path)
    return result


# --- one task ---


def study(task: Task, referent: str, settings: Settings, out: Path) -> dict[str, Any]:
    """Return the result of a task under a referent setting; what is not on disk yet is simulated."""
    variants, mark = variants_of(task, referent), fingerprint(task, referent, settings)
    simulation: list[Simulation] = []

    def sim() -> Simulation:
        from lerobot_memobench.sim.simulation import Simulation

        if not simulation:
            simulation.append(Simulation(task))
        return simulation[0]

    def observe(seed: int) -> dict[str, Any]:
        shown = [decisions.follow(variant, sim(), seed, settings.horizon) for variant in variants]
        scene = _Scene(variants, shown, settings.tolerance)
        strip = scene.strip()
        if strip is not None:
            from PIL import Image

            path = pictures_path(out, task.name, referent, seed)
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(strip).save(path, optimize=True)
        return scene.result(seed)

    def search() -> dict[str, Any]:
        return _any_order(Laboratory(variants, sim(), settings.seed_base), settings)

    stem = out / "results" / f"{task.name}.{referent}"
    seeds = range(settings.seed_base, settings.seed_base + settings.episodes)
    scenes = [_kept(stem.with_name(f"{stem.name}.{seed}.json"), mark, partial(observe, seed)) for seed in seeds]
    in_order = _mean_of([scene["in_order"] for scene in scenes if scene["in_order"]])
    any_order = None
    if in_order is not None and in_order["deterministic"] < 1.0 and settings.budget:
        found = fingerprint(task, referent, settings, search=True)
        any_order = _kept(stem.with_name(f"{stem.name}.search.json"), found, search)
    solved = max(1, sum(scene["solved"] for scene in scenes))
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "referent": referent,
        "settings": asdict(settings),
        "has_variants": task.num_variants > 1,
        "variants": len(variants),
        "expert": {"n": len(variants) * len(scenes), "success": sum(scene["solved"] for scene in scenes)},
        "decisions": sum(scene["decisions"] for scene in scenes) / solved,
        "aliased": _mean_of([scene["aliased"] for scene in scenes if scene["aliased"]]),
        "in_order": in_order,
        "examples": [example for scene in scenes for example in scene["examples"]][:EXAMPLES],
        "largest_same": max(scene["largest_same"] for scene in scenes),
        "smallest_different": min(scene["smallest_different"] for scene in scenes),
        "any_order": any_order,
    }


class _Scene:
    """The demonstrations of all variants from one start, and which of their moments look the same."""

    def __init__(self, variants: Sequence[Task], shown: Sequence[Demonstration], tolerance: float) -> None:
        self._owners: list[int] = []
        self._moments: list[Moment] = []
        for variant, demonstration in zip(variants, shown, strict=True):
            if demonstration.success:  # what a failed one did is no answer to learn
                self._moments += demonstration.moments
                self._owners += [variant.variant_index] * len(demonstration.moments)
        self._differences = decisions.differences([moment.at_home for moment in self._moments])
        count = len(self._moments)
        exact, seen = np.zeros((count, count)), np.ones((count, count))
        for i, j in combinations(range(count), 2):
            a, b = self._moments[i], self._moments[j]
            exact[i, j] = exact[j, i] = decisions.largest_pixel_difference(a.at_home, b.at_home)
            if np.abs(a.proprio - b.proprio).max() <= SAME_HAND:
                seen[i, j] = seen[j, i] = decisions.difference(a.seen, b.seen)
        self._pictures = classes(self._differences, tolerance)
        self.histories = self._histories(self._pictures)
        apart = ~np.equal.outer(self._pictures, self._pictures)
        self.gap = (
            float(self._differences[~apart].max(initial=0.0)),
            float(self._differences[apart].min(initial=1.0)),
        )
        self.ceilings: dict[str, float] = {}
        self.counts: dict[str, float] = {}
        if self.histories:
            as_exact = self._histories(classes(exact, PIXEL_EXACT))
            self.ceilings = {
                "chance": chance(self.histories),
                "deterministic": deterministic_ceiling(self.histories),
                "stochastic": stochastic_ceiling(self.histories),
                "pixel_exact": deterministic_ceiling(as_exact),
                "as_it_happens": deterministic_ceiling(self._histories(classes(seen, tolerance))),
            }
            self.counts = {
                "at_home": len(aliased(self.histories)),
                "pixel_exact": len(aliased(as_exact)),
                "as_it_happens": len(aliased(self._histories(classes(seen, tolerance)))),
            }

    def _histories(self, pictures: Sequence[int]) -> list[History]:
        rows: dict[int, list[Decision]] = {}
        for owner, moment, picture in zip(self._owners, self._moments, pictures, strict=True):
            rows.setdefault(owner, []).append(Decision(picture, moment.answer))
        return [tuple(row) for row in rows.values()]

    def _pairs(self) -> list[tuple[int, int]]:
        """Moments that look the same and ask for different answers."""
        return [
            (i, j)
            for i, j in combinations(range(len(self._moments)), 2)
            if self._pictures[i] == self._pictures[j] and self._moments[i].answer != self._moments[j].answer
        ]

    def result(self, seed: int) -> dict[str, Any]:
        """Return what is kept of a scene."""
        return {
            "seed": seed,
            "solved": len(self.histories),
            "decisions": sum(len(history) for history in self.histories),
            "aliased": self.counts,
            "in_order": self.ceilings,
            "examples": self._examples(seed)[:EXAMPLES],
            "largest_same": self.gap[0],
            "smallest_different": self.gap[1],
        }

    def _examples(self, seed: int) -> list[dict[str, Any]]:
        return [
            {
                "seed": seed,
                "a": self._said(i),
                "b": self._said(j),
                "difference": float(self._differences[i, j]),
                "largest_pixel_difference": decisions.largest_pixel_difference(
                    self._moments[i].at_home, self._moments[j].at_home
                ),
                "hand_apart_m": float(np.linalg.norm(self._moments[i].proprio[:3] - self._moments[j].proprio[:3])),
            }
            for i, j in self._pairs()
        ]

    def _said(self, index: int) -> dict[str, Any]:
        moment = self._moments[index]
        return {"variant": self._owners[index], "step": moment.step, "answer": moment.answer}

    def strip(self) -> np.ndarray | None:
        """Return the first pair side by side, (height, 4 × width, 3): cameras of a, of b; None without a pair."""
        if not self._pairs():
            return None
        i, j = self._pairs()[0]
        return np.concatenate([*self._moments[i].at_home, *self._moments[j].at_home], axis=1)


def _mean_of(tables: Sequence[dict[str, float]]) -> dict[str, float] | None:
    if not tables:
        return None
    return {key: sum(table[key] for table in tables) / len(tables) for key in tables[0]}


def _any_order(laboratory: Laboratory, settings: Settings) -> dict[str, Any]:
    """Look for ways to the goal that pictures alone can guide, and walk the best one in the simulator."""
    found = decisions.explore(laboratory, settings.budget, settings.horizon)
    graph = found.graph
    graph.pictures = classes(decisions.differences(found.pictures), settings.tolerance)
    goals = [variant.goal for variant in laboratory.variants]
    share, policy = best_map(graph, goals, settings.horizon)

    def act(seen: Sequence[decisions.Picture]) -> str | None:
        apart = [decisions.difference(seen, known) for known in found.pictures]
        nearest = int(np.argmin(apart))
        return policy.get(graph.pictures[nearest]) if apart[nearest] <= settings.tolerance else None

    confirmed = 0
    if share > 0:
        confirmed = sum(decisions.walk(laboratory, variant, act, settings.horizon) for variant in laboratory.variants)
    return {
        "seed": laboratory.seed,
        "deterministic": share,
        "confirmed": confirmed,
        "of": len(goals),
        "stochastic": best_probabilities(graph, goals, settings.horizon),
        "states": len(graph.pictures),
        "pictures": len(set(graph.pictures)),
        "moves": found.moves,
        "steps": found.steps,
        "complete": graph.complete,
        "policy": [
            {
                "when": sorted(
                    {
                        " ".join(sorted(map(format_formula, found.true[node])))
                        for node in _nodes_of(graph.pictures, picture)
                    }
                ),
                "do": answer,
            }
            for picture, answer in policy.items()
        ],
    }


def _nodes_of(pictures: Sequence[int], picture: int) -> list[int]:
    return [node for node, its in enumerate(pictures) if its == picture]
