"""Rolling friction: what is put down stays there.

In the published scenes an artichoke in a drawer, or a biscuit on its edge, rolls on until something stops it; what
rolls to the back of a drawer while that is shut cannot be taken out again by a hand from above. In the strict suite,
where things are hidden and found, they come to rest within a second.
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco

ROLLING = 0.002
"""Rolling friction, m: how far from under the middle a surface holds a thing that rolls."""


def stop_rolling(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    """Give what the bodies of objects touch something to hold them by as they roll."""
    for name in names:
        for geom in spec.body(name).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype or geom.conaffinity:
                geom.condim = 6
                geom.friction = [*geom.friction[:2], ROLLING]
