"""What is seen beside the arm's state: pictures, the objects on them, or both? Names, and what a policy needs.

Cheap to import: no LeRobot.
"""

from __future__ import annotations

from typing import Any

from lerobot_memobench.errors import MemobenchError

PIXELS, OBJECTS, BOTH = "pixels_agent_pos", "environment_state_agent_pos", "both"
OBS_TYPES = (PIXELS, OBJECTS, BOTH)
"""Values of ``env.obs_type``; the first two by LeRobot's names."""

READ_OBJECTS = ("act", "diffusion", "tdmpc", "gaussian_actor")
"""Policies of LeRobot's that read `observation.environment_state` where they were trained on it; others ignore it."""


def obs_type_of(policy: Any) -> str | None:
    """Return what a policy must be shown by its configuration; None where that is not known, or nothing is needed.

    A policy that says by ``perception`` what it sees (`pixels`, `objects` or `any`) is taken at its word; one that
    ``finds_objects`` does so in pictures, and is told some all the same by ``told_objects``.
    """
    if getattr(policy, "finds_objects", False):
        return PIXELS if policy.told_objects == "nothing" else BOTH
    perception = getattr(policy, "perception", None)
    if policy is None or perception is not None:
        return {"objects": OBJECTS, "pixels": PIXELS}.get(str(perception))
    objects = policy.type in READ_OBJECTS and policy.env_state_feature is not None
    if policy.image_features:
        return BOTH if objects else PIXELS
    return OBJECTS if objects else None


SEEN_PIXELS, DETECTIONS, PRIVILEGED, SIMULATOR, MEMORY_TEXT = (
    *("pixels", "detections", "privileged object state", "privileged simulator state", "oracle memory text"),
)
"""What a policy may have seen, as reports say it. Detections: objects that a detector finds in pixels."""
NOTHING = "nothing"


def what_is_seen(policy: Any, shown: str, oracle_memory: bool = False) -> str:
    """Return in words what a policy sees beside the arm's state; where that is not known, all that it is shown.

    Args:
        policy: its configuration, or the class of it. One that says by ``sees`` what it sees is taken at its word.
        shown: what the environment observes.
        oracle_memory: whether the instruction tells what was done so far.
    """
    own = getattr(policy, "sees", None)
    if isinstance(own, tuple):
        found = own
    else:
        inputs = getattr(policy, "input_features", None) or {}
        types = {getattr(feature.type, "value", feature.type) for feature in inputs.values()}
        all_shown = not types & {"VISUAL", "ENV"}
        ignores = type(policy).__module__.startswith("lerobot.") and policy.type not in READ_OBJECTS
        pixels = shown != OBJECTS and (all_shown or "VISUAL" in types)
        objects = shown != PIXELS and not ignores and (all_shown or "ENV" in types)
        found = (SEEN_PIXELS,) * pixels + (PRIVILEGED,) * objects
    found += (MEMORY_TEXT,) * oracle_memory
    return ", ".join(found) or NOTHING


def check_obs_type(policy: Any, shown: str) -> None:
    """Refuse to show a policy something else than it sees.

    Args:
        policy: its configuration.
        shown: what the environment observes.

    Raises:
        MemobenchError: pictures or objects that it needs would be missing.
    """
    needed = obs_type_of(policy)
    if needed is not None and shown not in (needed, BOTH):
        wanted = BOTH if needed == BOTH else f"{needed} or {BOTH}"
        told = "" if needed == PIXELS else f" ({PRIVILEGED} among it)"
        raise MemobenchError(
            f"env.obs_type is {shown}, which does not show what the policy sees{told}; set it to {wanted}"
        )
