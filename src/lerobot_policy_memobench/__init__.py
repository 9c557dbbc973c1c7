"""The name by which LeRobot discovers the plugin; everything is in ``lerobot_memobench``."""

import lerobot_memobench.registration  # noqa: F401
