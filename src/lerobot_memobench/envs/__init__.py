"""The environment: LeRobot configuration, gymnasium environment, episode, log.

Importing this package registers each task of both suites with gymnasium: ``gymnasium.make("memobench/<task>-v0")``
accepts the settings of `memobench_env.MemobenchEnv`, such as ``obs_type``. Ids omit the commas of a name, which
gymnasium does not allow.
"""

import gymnasium

from lerobot_memobench.tasks.catalogue import task_names

for _task in task_names(suite=None):
    gymnasium.register(
        f"memobench/{_task.replace(',', '')}-v0",
        entry_point="lerobot_memobench.envs.memobench_env:MemobenchEnv",
        kwargs={"task": _task},
    )
