"""The authors' evaluation, `protocol=upstream`: what their published script does otherwise than the paper says.

What it does was read in ``src/eval.py`` and ``bddl_base_domain.py`` of the repository Collab-Gen/MEMOBench. Here it is
written from that behaviour.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import UPSTREAM, UPSTREAM_HORIZON
from lerobot_memobench.tasks.task import PUBLISHED, REFERENTS

DIFFERENCES = (
    "no demonstration prompt",
    "the published referents alone",
    "an episode also ends when all memory checkpoints have held, in whatever order, before a goal of Then is reached",
    f"at most {UPSTREAM_HORIZON} execution steps",
    "two evaluations of the goal per control step: each part of Then holds for 5 of them, not 10",
    "the goal is evaluated in the 10 stabilisation steps too",
)
"""In what it differs from the paper's protocol, for cards."""
_ONLY = {
    "suite": PUBLISHED,
    "referent": REFERENTS[0],
    "oracle_memory": False,
    "pause_steps": 0,
    "speed": 1.0,
    "evidence": False,
}
"""Settings that have one value there."""


def upstream_settings(prefix: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that the authors' evaluation decides by itself.

    Args:
        prefix: stands before a setting's name in the message.
        asked: settings of an evaluation, by name.

    Raises:
        MemobenchError: something was asked for that it does not have.
    """
    for name, value in _ONLY.items():
        if asked[name] != value:
            raise MemobenchError(
                f"{prefix}protocol={UPSTREAM} is the authors' evaluation, which has {name}={str(value).lower()} alone, "
                f"and {prefix}{name}={str(asked[name]).lower()} was asked for; leave one of the two out"
            )
    return {"demonstration_prompt": False, "horizon": min(asked["horizon"], UPSTREAM_HORIZON)}
