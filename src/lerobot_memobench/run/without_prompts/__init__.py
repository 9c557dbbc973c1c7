"""Imported, it makes LeRobot's training leave the frames of prompts out, whatever the policy.

For plain ``lerobot-train``, by LeRobot's own flag for plugins
``--dataset.discover_packages_path=lerobot_memobench.run.without_prompts``; a package and no module, since LeRobot
looks for more in it. ``lerobot train`` does it by ``prompt_frames=``. As the flag is the process's, so is what it does:
it ends with the process, or where `undo` is called.
"""

from lerobot_memobench.run.training import steer

undo = steer(prompt_frames=False)
