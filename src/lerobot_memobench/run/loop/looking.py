"""Which policies look at the next observation: for those that do not, nothing is drawn and no objects are found.

A policy of ours says so itself, by its method ``looks_next``. LeRobot's policies that plan chunks look when their queue
of planned actions is empty; each is known by the very function that was read (tests/engine/test_lerobot_loop.py), so a
subclass that acts in another way, a wrapped policy, and any other always look. (`diffusion` queues pictures at every
step.)
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from lerobot.utils.constants import ACTION


def _act(policy: Any) -> bool:
    return policy.config.temporal_ensemble_coeff is not None or not policy._action_queue


def _pi(policy: Any) -> bool:
    return not policy._action_queue


def _smolvla(policy: Any) -> bool:
    return not policy._queues[ACTION]


KNOWN: dict[tuple[str, str], Callable[[Any], bool]] = {
    ("lerobot.policies.act.modeling_act", "ACTPolicy"): _act,
    ("lerobot.policies.pi0.modeling_pi0", "PI0Policy"): _pi,
    ("lerobot.policies.pi05.modeling_pi05", "PI05Policy"): _pi,
    ("lerobot.policies.smolvla.modeling_smolvla", "SmolVLAPolicy"): _smolvla,
}
"""Module and class of LeRobot's policies -> whether one of them looks next."""


def looking(policy: Any) -> Callable[[], bool]:
    """Return what tells, before a step, whether a policy looks at pictures or objects of the observation after it."""
    own = getattr(policy, "looks_next", None)
    if own is not None:
        return own
    acts = getattr(type(policy), "select_action", None)
    for (module, name), looks in KNOWN.items():
        # A policy of a module that nobody has imported is not here.
        if acts is not None and acts is getattr(getattr(sys.modules.get(module), name, None), "select_action", None):
            return lambda: looks(policy)
    return lambda: True
