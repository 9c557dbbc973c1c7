"""The environment: LeRobot configuration, gymnasium environment, episode, log.

Importing this package registers each task of all suites with gymnasium: ``gymnasium.make("memobench/<task>-v0")``
accepts the settings of `env.MemobenchEnv`, such as ``obs_type``. Ids omit the commas of a name, which
gymnasium does not allow.
"""

import gymnasium

from lerobot_memobench.tasks.catalogue import ALL_SUITES, task_names

for _task in (name for suite in ALL_SUITES for name in task_names(suite=suite)):
    gymnasium.register(
        f"memobench/{_task.replace(',', '')}-v0",
        entry_point="lerobot_memobench.envs.env:MemobenchEnv",
        kwargs={"task": _task},
    )
