"""MEMOBench from the hub: `lerobot.envs.make_env("<user>/memobench", n_envs=2, trust_remote_code=True)`.

The environment is in the package `lerobot_policy_memobench`, which must be installed.
"""

from dataclasses import fields

import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: object | None = None
) -> dict[str, dict[int, gym.vector.VectorEnv]]:
    """Return `{memory type: {task id: vector environment}}`; simulations start at the first reset.

    Args:
        n_envs: parallel environments per task.
        use_async_envs: whether to run each environment in its own process.
        cfg: a `MemobenchEnvConfig`, or any configuration with a field `task`: memory types or task names, separated
            by commas. None: all thirty tasks.
    """
    try:
        from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "MEMOBench needs its simulator: pip install lerobot_policy_memobench", name=error.name
        ) from error
    if isinstance(cfg, MemobenchEnvConfig):
        return cfg.create_envs(n_envs, use_async_envs)
    known = {field.name for field in fields(MemobenchEnvConfig)} - {"fps", "features", "features_map"}
    settings = {name: getattr(cfg, name) for name in known if hasattr(cfg, name)}
    return MemobenchEnvConfig(**settings).create_envs(n_envs, use_async_envs)
