"""Is there a way to the goal that pictures alone can guide? Looked for in any order, and walked in the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_memobench.evaluation.necessity.aliasing import classes
from lerobot_memobench.evaluation.necessity.best_map import Policy, best_map
from lerobot_memobench.evaluation.necessity.best_probabilities import best_probabilities
from lerobot_memobench.evaluation.necessity.exploration import Exploration, explore, walk
from lerobot_memobench.evaluation.necessity.laboratory import Laboratory
from lerobot_memobench.evaluation.necessity.pictures import Picture, difference, differences
from lerobot_memobench.evaluation.necessity.question import Settings
from lerobot_memobench.tasks.formula import format_formula


def search(laboratory: Laboratory, settings: Settings) -> dict[str, Any]:
    """Return the best policies without memory that were found, and whether the simulator confirms the best map."""
    found = explore(laboratory, settings.budget, settings.horizon)
    graph = found.graph
    graph.pictures = classes(differences(found.pictures), settings.tolerance)
    goals = [variant.goal for variant in laboratory.variants]
    share, policy = best_map(graph, goals, settings.horizon)
    return {
        "seed": laboratory.seed,
        "deterministic": share,
        "confirmed": _confirmed(laboratory, found, policy, settings) if share > 0 else 0,
        "of": len(goals),
        "stochastic": best_probabilities(graph, goals, settings.horizon),
        "states": len(graph.pictures),
        "pictures": len(set(graph.pictures)),
        "moves": found.moves,
        "steps": found.steps,
        "complete": graph.complete,
        "policy": [{"when": _when(found, picture), "do": answer} for picture, answer in policy.items()],
    }


def _confirmed(laboratory: Laboratory, found: Exploration, policy: Policy, settings: Settings) -> int:
    """Return how many goals come true in the simulator when the map acts; it knows the nearest picture it explored."""

    def act(seen: Sequence[Picture]) -> str | None:
        apart = [difference(seen, known) for known in found.pictures]
        nearest = int(np.argmin(apart))
        return policy.get(found.graph.pictures[nearest]) if apart[nearest] <= settings.tolerance else None

    return walk(laboratory, laboratory.variants, act, settings.horizon)


def _when(found: Exploration, picture: int) -> list[str]:
    """Return which atoms of the goals hold where a picture is seen, a text for each combination, sorted."""
    nodes = [node for node, its_picture in enumerate(found.graph.pictures) if its_picture == picture]
    return sorted({" ".join(sorted(map(format_formula, found.true[node]))) for node in nodes})
