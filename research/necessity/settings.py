"""Settings of the study: referent, scenes, and tolerance of pictures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.task import DRAWN, REFERENTS, Task

VERSION = 4
"""Raised when results change, so that old ones are made again."""


@dataclass(frozen=True)
class Settings:
    """Settings of a result, besides the task.

    Attributes:
        episodes: scenes (seeds) per task; with `referent=random` each is demonstrated once per variant.
        seed_base: the first of their seeds.
        tolerance: share of pixels without a like pixel within two, up to which pictures look the same.
        budget: control steps, per different start, after which the search for other ways to the goal begins no new
            state; 0 leaves it out.
        horizon: execution steps.
    """

    episodes: int = 3
    seed_base: int = 7
    tolerance: float = 0.005
    budget: int = 10_000
    horizon: int = HORIZON

    @property
    def seeds(self) -> range:
        """The seeds of the scenes."""
        return range(self.seed_base, self.seed_base + self.episodes)


def settings_of(task: Task, referents: Sequence[str]) -> tuple[str, ...]:
    """Return the settings of the referent to study: one where the task has one goal or draws it."""
    if task.drawn:
        return (DRAWN,)
    return tuple(referents) if task.num_variants > 1 else REFERENTS[:1]


def variants_of(task: Task, referent: str) -> list[Task]:
    """Return the goals that may lie behind the same start: the published one, or all that are drawn."""
    if referent == "fixed" or task.num_variants == 1:
        return [task]
    return [task.variant(k) for k in task.random_variants]


def fingerprint(task: Task, referent: str, settings: Settings, searched: int | None = None) -> str:
    """Return the hash that a kept result must have to be of the same settings.

    Args:
        searched: for the search, the seed of the start; None for the result of a scene, which has its seed in its name.
    """
    other = ("episodes", "seed_base") if searched is not None else ("episodes", "seed_base", "budget")
    asked = {key: value for key, value in asdict(settings).items() if key not in other}
    if searched is not None:
        asked["seed"] = searched
    text = json.dumps([VERSION, referent, asked, task.bddl_text, task.metadata], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
