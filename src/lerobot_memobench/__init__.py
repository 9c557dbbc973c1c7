"""MEMOBench: a process-level memory benchmark for robot manipulation, as a LeRobot plugin.

Importing this package imports nothing else, so commands that need no LeRobot start at once. What LeRobot must know
is in ``registration``, which ``lerobot_policy_memobench``, the name that LeRobot discovers, imports.
"""

__version__ = "0.3.0"
