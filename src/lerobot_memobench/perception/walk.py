"""Moments of an episode: the scripted expert on its way, its arm moved off it at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.perturbation import Perturbation
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.sim.rendering import Highlight

EVERY = 3
"""Steps from one moment to the next from which some are chosen."""
NEAR = 0.15
"""Distance of the hand from a thing at which a reach counts as nearly there, m."""
NEARER = 3.0
"""How much likelier such a moment is chosen than another."""
STREAM = 5
"""Of the episode's random numbers: what moves the arm, and which moments are taken."""


@dataclass(frozen=True)
class Moment:
    """What the simulation is put back to. ``state``: as `Simulation.state` gives it."""

    state: NDArray[np.float64]
    highlights: tuple[Highlight, ...]
    near: bool


def walk(episode: Episode, seed: int, count: int) -> list[Moment]:
    """Play the episode of a seed, prompt and all, and return ``count`` of its moments (fewer of a short one)."""
    rng = generator(episode.published, seed, STREAM)
    episode.reset(seed)
    disturb, moments = Perturbation(rng), []
    while not (episode.done or episode.expert_done):
        if episode.step_index % EVERY == 0:
            moments.append(_moment(episode))
        episode.step(disturb.moved(episode.expert_action()))
    weights = np.array([NEARER if moment.near else 1.0 for moment in moments])
    chosen = rng.choice(len(moments), min(count, len(moments)), replace=False, p=weights / weights.sum())
    return [moments[index] for index in sorted(chosen)]


def _moment(episode: Episode) -> Moment:
    sim = episode.sim
    hand = sim.eef_pose()[0]
    places = [sim.body_pose(name)[0] for name, asset in sim.assets.items() if asset.kind == "object"]
    places += [sim.site_pose(part.handle_site)[0] for a in sim.assets.values() for part in a.articulations.values()]
    near = min(float(np.linalg.norm(place - hand)) for place in places) < NEAR
    return Moment(sim.state(), sim.highlights, near)
