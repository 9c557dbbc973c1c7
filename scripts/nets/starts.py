"""Net ``starts``: compiled models, initial states and first observations of all 190 tasks, by their gymnasium ids.

Two seeds of each task of ``published`` and ``strict``, one initial state of each task of LIBERO. About 8 CPU minutes.
"""

import re
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scripts.nets.access import simulation
from scripts.nets.store import Facts, Parts, digest, flatten

SEEDS = (7, 8)
GROUPS = ("body", "jnt", "dof", "geom", "site", "mesh", "tex", "mat", "light", "cam", "actuator", "name", "eq")
"""Beginnings of the names of a model's fields that are hashed together; the others form one more group."""
LEFT_OUT = re.compile("^_|path|^nbuffer$|^signature$")
"""Fields that depend on paths of files, and private ones."""


def parts() -> Parts:
    """Return one part per registered environment."""
    import gymnasium

    import lerobot_memobench.envs  # noqa: F401 - registers the tasks

    return {name: partial(start, name) for name in gymnasium.registry if name.startswith("memobench/")}


def start(name: str, folder: Path) -> Facts:
    """Return the facts of an environment's starts."""
    import gymnasium

    try:
        env, seeds = gymnasium.make(name, obs_type="both", disable_env_checker=True), SEEDS
    except Exception:  # suites of LIBERO have images only
        env, seeds = gymnasium.make(name, disable_env_checker=True), SEEDS[:1]
    found: Facts = {}
    for seed in seeds:
        observation, _info = env.reset(seed=seed)
        model, data = simulation(env)
        if seed == seeds[0]:
            found[name] = {"instruction": env.unwrapped.task_description, **model_hashes(model)}
        state = digest(data.qpos, data.qvel, data.ctrl, data.mocap_pos, np.float64(data.time))
        seen = {field: digest(value) for field, value in flatten(observation).items()}
        found[f"{name} {seed}"] = {"state": state, **seen}
    env.close()
    return found


def model_hashes(model: Any) -> dict[str, str]:
    """Return the hash of each group of a model's numeric fields, sizes, options and names."""
    groups: dict[str, list[Any]] = defaultdict(list)
    for struct in (model, model.opt, model.stat):
        for field in (each for each in sorted(dir(struct)) if not LEFT_OUT.search(each)):
            value = getattr(struct, field)
            if isinstance(value, np.ndarray | int | float | bytes):
                group = next((each for each in GROUPS if field.startswith(each)), "other")
                groups[group] += [field, value]
    return {f"model {group}": digest(*values) for group, values in groups.items()}
