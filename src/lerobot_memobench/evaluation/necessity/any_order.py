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
    """Return the best policies without memory that were found, and whether the simulator confirms the best maps.

    A policy reads the instruction: goals with the same one share a policy, others have one of their own.
    """
    found = explore(laboratory, settings.budget, settings.horizon)
    graph = found.graph
    graph.pictures = classes(differences(found.pictures), settings.tolerance)
    groups = [_best(laboratory, found, group, settings) for group in _by_instruction(laboratory)]
    goals = len(laboratory.variants)
    return {
        "seed": laboratory.seed,
        "deterministic": sum(len(group["goals"]) * group["deterministic"] for group in groups) / goals,
        "confirmed": sum(group["confirmed"] for group in groups),
        "of": goals,
        "stochastic": sum(len(group["goals"]) * group["stochastic"] for group in groups) / goals,
        "states": len(graph.pictures),
        "pictures": len(set(graph.pictures)),
        "moves": found.moves,
        "steps": found.steps,
        "complete": graph.complete,
        "exhausted": found.exhausted,
        "policy": [rule for group in groups for rule in group["policy"]],
    }


def _by_instruction(laboratory: Laboratory) -> list[list[int]]:
    """Return the goals, as places in the row of variants, that one instruction asks for."""
    groups: dict[str, list[int]] = {}
    for place, variant in enumerate(laboratory.variants):
        groups.setdefault(variant.language, []).append(place)
    return list(groups.values())


def _best(laboratory: Laboratory, found: Exploration, group: Sequence[int], settings: Settings) -> dict[str, Any]:
    """Return how far the best policies come at the goals of one instruction."""
    goals = [laboratory.variants[place].goal for place in group]
    starts = [found.starts[place] for place in group]
    share, policy = best_map(found.graph, goals, settings.horizon, starts)
    return {
        "goals": group,
        "deterministic": share,
        "confirmed": _confirmed(laboratory, found, group, policy, settings) if share > 0 else 0,
        "stochastic": best_probabilities(found.graph, goals, settings.horizon, starts),
        "policy": [{"when": _when(found, picture), "do": answer} for picture, answer in policy.items()],
    }


def _confirmed(
    laboratory: Laboratory, found: Exploration, group: Sequence[int], policy: Policy, settings: Settings
) -> int:
    """Return how many goals come true in the simulator when the map acts; it knows the nearest picture it explored."""

    def act(seen: Sequence[Picture]) -> str | None:
        apart = [difference(seen, known) for known in found.pictures]
        nearest = int(np.argmin(apart))
        return policy.get(found.graph.pictures[nearest]) if apart[nearest] <= settings.tolerance else None

    confirmed = 0
    for start in dict.fromkeys(found.starts[place] for place in group):
        together = [place for place in group if found.starts[place] == start]
        laboratory.sim.restore(laboratory.starts[together[0]])
        tasks = [laboratory.variants[place] for place in together]
        confirmed += walk(laboratory, tasks, act, settings.horizon)
    return confirmed


def _when(found: Exploration, picture: int) -> list[str]:
    """Return which atoms of the goals hold where a picture is seen, a text for each combination, sorted."""
    nodes = [node for node, its_picture in enumerate(found.graph.pictures) if its_picture == picture]
    return sorted({" ".join(sorted(map(format_formula, found.true[node]))) for node in nodes})
