"""Register the environment ``memobench`` and the policies ``memobench_*`` with LeRobot.

Importing a configuration module registers it, without loading simulator or models.
"""

import lerobot_memobench.policies.baselines.configuration_baselines
import lerobot_memobench.policies.memobench_mem.configuration_memobench_mem
import lerobot_memobench.policies.remote.configuration_remote  # noqa: F401
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.run.lerobot_commands import prepare_lerobots_command

MemobenchEnvConfig.check_policy = prepare_lerobots_command
