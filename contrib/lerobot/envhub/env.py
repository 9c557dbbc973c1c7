"""MEMOBench from the hub: `lerobot.envs.make_env("<user>/memobench", n_envs=2, trust_remote_code=True)`.

The environment itself is the package `lerobot_policy_memobench`, which this file asks for.
"""

from dataclasses import fields

import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: object | None = None
) -> dict[str, dict[int, gym.vector.VectorEnv]]:
    """Return `{memory type: {task id: vector environment}}`; nothing is simulated before a first reset.

    Args:
        n_envs: environments of a task that run at once.
        use_async_envs: whether each has a process of its own.
        cfg: a `MemobenchEnvConfig`, or a configuration whose `task` chooses the tasks: memory types or names,
            separated by commas. None: all thirty.
    """
    try:
        from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "MEMOBench's simulator is a package: pip install lerobot_policy_memobench", name=error.name
        ) from error
    if isinstance(cfg, MemobenchEnvConfig):
        return cfg.create_envs(n_envs, use_async_envs)
    known = {field.name for field in fields(MemobenchEnvConfig)} - {"fps", "features", "features_map"}
    asked = {name: getattr(cfg, name) for name in known if hasattr(cfg, name)}
    return MemobenchEnvConfig(**asked).create_envs(n_envs, use_async_envs)
