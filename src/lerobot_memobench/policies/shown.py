"""What to do about an observation that a policy misses."""

from __future__ import annotations

from collections.abc import Collection

from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES

from lerobot_memobench.envs.obs_types import BOTH, OBJECTS, PIXELS


def cure(missing: str, observed: Collection[str]) -> str:
    """Return how to be shown an observation, to end a sentence with.

    Args:
        missing: its name at the policy.
        observed: the names that there are.
    """
    cameras = ", ".join(key for key in observed if key.startswith(f"{OBS_IMAGES}."))
    if missing == OBS_ENV_STATE:
        return f"set env.obs_type={OBJECTS}, or {BOTH}."
    if not cameras and OBS_ENV_STATE in observed:
        return f"set env.obs_type={PIXELS}, or {BOTH}."
    return f"it has {cameras or 'none'}. Map its names with --rename_map."
