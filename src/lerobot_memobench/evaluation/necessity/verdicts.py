"""Is a memory needed? What the figures of a task come to."""

from __future__ import annotations

from lerobot_memobench.evaluation.necessity.study import Result

VERDICTS = {
    "no": "pictures decide every step of the demonstrated routine: no memory is needed",
    "order": "with the arm at home, pictures tell not the demonstrated order but another that the goal accepts",
    "yes": "no order that was found reaches the goal from pictures alone",
    "order?": "with the arm at home, pictures do not tell the demonstrated order; other ways were not looked for",
    "unknown": "the expert solved none of the scenes, so nothing can be said",
}


def verdict(result: Result) -> str:
    """Return which of `VERDICTS` holds."""
    in_order, any_order = result["in_order"], result["any_order"]
    if in_order is None:
        return "unknown"
    if in_order["deterministic"] >= 1.0:
        return "no"
    if any_order is None:
        return "order?"
    return "order" if any_order["confirmed"] == any_order["of"] else "yes"
