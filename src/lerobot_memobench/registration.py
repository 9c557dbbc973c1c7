"""Register the environment ``memobench`` and the policies ``memobench_*`` with LeRobot.

Importing the module of a configuration registers it, without loading the simulator or a model.
"""

import lerobot_memobench.policies.baselines
import lerobot_memobench.policies.memobench_mem.configuration_memobench_mem
import lerobot_memobench.policies.remote  # noqa: F401
from lerobot_memobench.commands.lerobot_commands import prepare_lerobots_command
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig

MemobenchEnvConfig.check_policy = prepare_lerobots_command
