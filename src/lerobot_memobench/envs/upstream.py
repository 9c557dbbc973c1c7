"""The authors' evaluation, `protocol=upstream`: what their published script does otherwise than the paper says.

What it does was read in ``src/eval.py`` and ``bddl_base_domain.py`` of the repository Collab-Gen/MEMOBench. Here it is
written from that behaviour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import ArrayLike

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import UPSTREAM, UPSTREAM_HORIZON
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom
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


class SettlingSimulation(Simulation):
    """A simulation whose stabilisation steps are followed, each of them: their clock runs there already."""

    _following: Callable[[Callable[[Atom], bool]], None] | None = None
    _settling = False

    def follow(self, following: Callable[[Callable[[Atom], bool]], None]) -> None:
        """Hand `holds` to ``following`` after each stabilisation step of later resets."""
        self._following = following

    def reset(self, seed: int) -> None:
        """Draw the initial state of a seed and let it settle, followed; see `Simulation.reset`."""
        self._settling = True
        try:
            super().reset(seed)
        finally:
            self._settling = False

    def step(self, action: ArrayLike) -> None:
        """Advance by one control step; see `Simulation.step`."""
        super().step(action)
        if self._settling and self._following is not None:
            self._following(self.holds)
