"""A task's scene with more things in it, all classes alike: a task has few, and most classes are in one or two tasks.

The things wait where no camera looks until `Scatter` puts some of them somewhere. No physics is stepped here: moments
come from the task's own simulation.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.perception.poses import away
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.scene import TABLE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

MORE = "more_"
"""What names of added things begin with."""

Array = NDArray[np.float64]


@cache
def object_classes() -> tuple[str, ...]:
    """Return the classes, variants told apart, of all objects of the catalogue."""
    return tuple(sorted({one for name in task_names(suite=None) for one in get_task(name).objects.values()}))


def crowded(sim: Simulation, rng: np.random.Generator) -> Simulation:
    """Return a scene like that of ``sim``, filled up with things of different classes to as many as can be labelled."""
    room = SLOTS - len(ObjectSlots(sim).things)
    chosen = rng.choice(object_classes(), min(room, len(object_classes())), replace=False)
    return Simulation(_with_more(sim.task, [str(one) for one in chosen]), sim.render_settings)


def _with_more(task: Task, classes: list[str]) -> Task:
    more = {f"{MORE}{index}": name for index, name in enumerate(classes)}
    somewhere = next(name for name, region in task.regions.items() if region.target == TABLE)
    return replace(
        task,
        objects={**task.objects, **more},
        init=(*task.init, *(Atom("on", (name, somewhere)) for name in more)),
        bddl_text=f"{task.bddl_text}\n; and {', '.join(classes)}",  # compiled scenes are known by their text
    )


def widened(state: Array, sim: Simulation, crowd: Simulation) -> Array:
    """Return a state of ``sim`` as one of the scene that `crowded` made of it: what was added is away, at rest."""
    nq, before = sim.model.nq, sum(asset.kind == "object" for asset in sim.assets.values())
    added = [away(before + index) for index in range((crowd.model.nq - nq) // 7)]
    rest = np.zeros(crowd.model.nv - sim.model.nv)
    return np.concatenate([state[: 1 + nq], *added, state[1 + nq :], rest])
