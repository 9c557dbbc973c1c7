"""A handful of closed-loop motions: pick, place, pull, push, turn.

Each is a generator of actions that looks at the simulator before every action and returns whether it worked, so a plan
composes them with ``yield from`` and tries again where one missed.
"""

from __future__ import annotations

from lerobot_memobench.experts.doors import close_door, open_door
from lerobot_memobench.experts.grasping import pick
from lerobot_memobench.experts.handles import close_drawer, open_drawer, turn_knob
from lerobot_memobench.experts.leaning import pointing
from lerobot_memobench.experts.placing import put_at, put_in_drawer, put_on, put_on_region
from lerobot_memobench.experts.surroundings import outward_of
from lerobot_memobench.experts.sweeping import pull_open, push_shut
from lerobot_memobench.experts.travel import Held, come_home, go_home

__all__ = [
    "Held",
    "close_door",
    "close_drawer",
    "come_home",
    "go_home",
    "open_door",
    "open_drawer",
    "outward_of",
    "pick",
    "pointing",
    "pull_open",
    "push_shut",
    "put_at",
    "put_in_drawer",
    "put_on",
    "put_on_region",
    "turn_knob",
]
