"""Memory necessity of one task, from simulated episodes to a JSON object; resumable per task and referent setting."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.evaluation import decisions
from lerobot_memobench.evaluation.decisions import Demonstration, Laboratory, Moment
from lerobot_memobench.evaluation.necessity import (
    Decision,
    History,
    aliased,
    chance,
    classes,
    deterministic_ceiling,
    stochastic_ceiling,
)
from lerobot_memobench.evaluation.necessity_search import best_map, best_probabilities
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.task import Task

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
        budget: moves simulated in search of other ways to the goal; 0 leaves the search out.
        horizon: execution steps.
    """

    episodes: int = 3
    seed_base: int = 7
    tolerance: float = 0.005
    budget: int = 60
    horizon: int = decisions.HORIZON


def variants_of(task: Task, referent: str) -> list[Task]:
    """Return the goals that may lie behind the same start: the published one, or all that a random referent draws."""
    if referent == "fixed" or task.num_variants == 1:
        return [task]
    return [task.variant(k) for k in task.random_variants]


# --- results on disk ---


def result_path(out: Path, task: Task, referent: str) -> Path:
    """Return where the result of a task under a referent setting lies."""
    return out / "results" / f"{task.name}.{referent}.json"


def pictures_path(out: Path, task: Task, referent: str) -> Path:
    """Return where the first aliased pair's pictures lie: a strip of both moments, two cameras each."""
    return out / "pictures" / f"{task.name}.{referent}.png"


def fingerprint(task: Task, referent: str, settings: Settings) -> str:
    """Return what a result must carry to be taken for an answer to the same question."""
    said = json.dumps([VERSION, referent, asdict(settings), task.bddl_text, task.metadata], sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def read_result(out: Path, task: Task, referent: str, settings: Settings) -> dict[str, Any] | None:
    """Return a result that is there and answers this question; None otherwise."""
    try:
        found = json.loads(result_path(out, task, referent).read_text())
    except (OSError, ValueError):
        return None
    same = isinstance(found, dict) and found.get("fingerprint") == fingerprint(task, referent, settings)
    return found if same else None


def study(task: Task, referent: str, settings: Settings, out: Path) -> dict[str, Any]:
    """Return the result of a task under a referent setting, from disk or by simulating it."""
    known = read_result(out, task, referent, settings)
    if known is not None:
        return known
    result, strip = _study(task, referent, settings)
    path, picture = result_path(out, task, referent), pictures_path(out, task, referent)
    path.parent.mkdir(parents=True, exist_ok=True)
    if strip is not None:
        from PIL import Image

        picture.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(strip).save(picture, optimize=True)
    else:
        picture.unlink(missing_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    draft.write_text(json.dumps(result, indent=1) + "\n")
    os.replace(draft, path)
    return result


# --- one task ---


def _study(task: Task, referent: str, settings: Settings) -> tuple[dict[str, Any], np.ndarray | None]:
    from lerobot_memobench.sim.simulation import Simulation

    sim, variants = Simulation(task), variants_of(task, referent)
    scenes, examples, strip, successes = [], [], None, 0
    for seed in range(settings.seed_base, settings.seed_base + settings.episodes):
        shown = [decisions.follow(variant, sim, seed, settings.horizon) for variant in variants]
        successes += sum(demonstration.success for demonstration in shown)
        scene = _Scene(variants, shown, settings.tolerance)
        scenes.append(scene)
        found = scene.examples(seed)
        if strip is None and found:
            strip = scene.strip()
        examples += found
    in_order = _mean_of([scene.ceilings for scene in scenes if scene.histories])
    result: dict[str, Any] = {
        "task": task.name,
        "memory_type": task.memory_type,
        "referent": referent,
        "settings": asdict(settings),
        "fingerprint": fingerprint(task, referent, settings),
        "variants": len(variants),
        "has_variants": task.num_variants > 1,
        "expert": {"n": len(variants) * settings.episodes, "success": successes},
        "decisions": sum(len(h) for s in scenes for h in s.histories) / max(1, sum(len(s.histories) for s in scenes)),
        "aliased": _mean_of([scene.counts for scene in scenes if scene.histories]),
        "in_order": in_order,
        "examples": examples[:EXAMPLES],
        "largest_same": max((scene.gap[0] for scene in scenes), default=0.0),
        "smallest_different": min((scene.gap[1] for scene in scenes), default=1.0),
        "any_order": None,
    }
    if in_order is not None and in_order["deterministic"] < 1.0 and settings.budget:
        result["any_order"] = _any_order(Laboratory(variants, sim, settings.seed_base), settings)
    return result, strip


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

    def examples(self, seed: int) -> list[dict[str, Any]]:
        """Return the pairs as they are reported."""
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

    def strip(self) -> np.ndarray:
        """Return the pictures of the first pair side by side, (height, 4 × width, 3): cameras of a, cameras of b."""
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
