"""Imported, it makes LeRobot's training leave the frames of prompts out, whatever the policy.

For plain ``lerobot-train``, by LeRobot's own flag for plugins
``--dataset.discover_packages_path=lerobot_memobench.engine.without_prompts``; a package and no module, since LeRobot
looks for more in it. ``lerobot train`` does it by ``prompt_frames=``.
"""

from lerobot_memobench.engine.lerobot_training import steer

steer(prompt_frames=False)
