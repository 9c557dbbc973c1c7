"""Net ``actions``: actions of the shipped policies and the observations that follow, in LeRobot's loop.

`make_env`, LeRobot's processors and `select_action`, on a published and a salted strict task. About 1 CPU
minute.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scripts.nets.access import shipped_policy
from scripts.nets.store import BITS, Facts, Parts, digest

POLICIES = ("memobench_strict", "memobench_strict_memoryless")
TASKS: dict[str, dict[str, Any]] = {
    "check_the_top_drawer_of_the_cabinet": {},
    "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate": {
        **{"suite": "strict", "replan_steps": 6, "salt": "0123456789abcdef0123456789abcdef"},
    },
}
SEED, STEPS = 20_000, 240
BLOCK = 60
"""Steps of one subject, so that a comparison names the first difference."""


def parts() -> Parts:
    """Return one part per policy and task."""
    return {f"{policy} {task}": partial(act, policy, task) for policy in POLICIES for task in TASKS}


def act(name: str, task: str, folder: Path) -> Facts:
    """Run a policy from the start of an episode; return the facts of its actions."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import make_env, make_env_pre_post_processors, preprocess_observation
    from lerobot.envs.configs import EnvConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.constants import ACTION
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    source = shipped_policy(name)
    config = PreTrainedConfig.from_pretrained(source, cli_overrides=["--device=cpu"])
    policy = get_policy_class(config.type).from_pretrained(source, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(source))
    chosen = {"tasks": task, "obs_type": "environment_state_agent_pos", "log_dir": str(folder / "log"), **TASKS[task]}
    settings = EnvConfig.get_choice_class("memobench")(**chosen)
    (env,) = (env for by_task in make_env(settings, n_envs=1).values() for env in by_task.values())
    env_before, env_after = make_env_pre_post_processors(settings, config)
    torch.manual_seed(SEED)
    policy.reset()
    observation, _ = env.reset(seed=[SEED])
    actions, seen = [], []
    for _ in range(STEPS):
        named = {"task": list(env.call("task_description"))}
        with torch.inference_mode():
            batch = before(env_before(preprocess_observation(observation) | named))
            actions.append(env_after({ACTION: after(policy.select_action(batch))})[ACTION].numpy())
        observation, *_ = env.step(actions[-1])
        seen.append(np.concatenate([observation[key].ravel() for key in ("agent_pos", "environment_state", "phase")]))
    env.close()
    found: Facts = {}
    for first in range(0, STEPS, BLOCK):
        acted, followed = np.stack(actions[first : first + BLOCK]), np.stack(seen[first : first + BLOCK])
        hashes = {f"actions {BITS}": digest(acted), f"observations {BITS}": digest(followed)}
        sizes = {"mean action": float(acted.mean()), "mean size": float(np.abs(acted).mean())}
        found[f"{name} {task} from step {first}"] = hashes | sizes
    return found
