"""MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin.

Importing this package makes the environment ``memobench`` and the policies ``memobench_mem`` and
``memobench_expert`` known to LeRobot and does nothing else: no simulator, no model code, no GL. It does not
import LeRobot either (see ``registration``), so commands and workers that do not need LeRobot start in a
second.
"""

from lerobot_memobench.registration import register

__version__ = "0.1.0"

register()
