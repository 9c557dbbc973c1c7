"""Frames that a policy remembers must show the step they are remembered for."""

from __future__ import annotations

from lerobot_memobench.errors import MemobenchError

PICTURE_STEP = "picture_step"
"""Observation: the step whose pictures are shown; told by an environment that does not draw every step."""
REFUSAL = "leave env.render_every at 1 for a policy that remembers the frames between its plans"


def require_fresh(step: int | None, picture_step: int | None) -> None:
    """Refuse a frame that is to be remembered and shows an earlier step; None where the environment tells no step.

    Raises:
        MemobenchError: it does.
    """
    if None not in (step, picture_step) and step != picture_step:
        raise MemobenchError(f"the frame of step {step} shows step {picture_step} again; {REFUSAL}")
