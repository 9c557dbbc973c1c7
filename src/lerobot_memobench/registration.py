"""Make the environment ``memobench`` and the policies ``memobench_*`` known to LeRobot.

The configuration modules register themselves when imported; they import neither simulator nor model code.
"""

import lerobot_memobench.envs.configuration_memobench
import lerobot_memobench.policies.baselines.configuration_baselines
import lerobot_memobench.policies.memobench_mem.configuration_memobench_mem
import lerobot_memobench.policies.remote.configuration_remote  # noqa: F401
