"""Settings of an environment: name, type, default, meaning and values, each in one place.

The LeRobot configuration, the gymnasium environment, the episode, the evaluation's file and vla-evaluation-harness take
an `EnvSettings` whole. To add a setting, add a field here and the code that acts on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.protocol import (
    BY_PAPER,
    EVALUATION_SEED,
    HORIZON,
    IDLE_STEPS,
    PROTOCOLS,
    UPSTREAM,
    UPSTREAM_HORIZON,
)
from lerobot_memobench.tasks.evidence import check_referent
from lerobot_memobench.tasks.task import DRAWN, MEMOBENCH, PUBLISHED, REFERENTS, STRICT, SUITES, WORLDS, check_world

PIXELS, OBJECTS, BOTH = "pixels_agent_pos", "environment_state_agent_pos", "both"
OBS_TYPES = (PIXELS, OBJECTS, BOTH)
"""Values of ``obs_type``, by LeRobot's names."""

AUTO, STEPS, RESET = "auto", "steps", "reset"
PROMPT_IN = (AUTO, STEPS, RESET)
"""Values of ``prompt_in``. A policy that reads prompts declares ``reads_prompt: ClassVar[bool] = True`` on the class of
its configuration: it waits while `observation.phase` is 0 and discards planned actions when it becomes 1. For any other
policy the prompt plays within `reset`. ``auto`` chooses by the policy; where no policy is known, it means ``steps``."""

REFERENT_VALUES = (*REFERENTS, DRAWN)
"""Values of ``referent``; the last one is that of strict tasks alone."""
QUALITIES = ("fast", "default", "high")
EVERY = -1
"""Value of ``videos``: record every episode."""
SLOWEST = 10
"""Most control steps per action, see ``speed``."""

IDLE, GOALS, STRICT_GOALS = "idle", "goals", 2
"""Keys of strict tasks in a protocol: control steps that the robot idles at most before the execution, and the revision
of the goals. Revision 1 could be reached without a memory, by notes in the scene and a clock."""
UPSTREAM_ONLY = {
    **{"suite": PUBLISHED, "referent": REFERENTS[0], "oracle_memory": False},
    **{"pause_steps": 0, "speed": 1.0, "evidence": False},
}
"""The one value that a setting has in the authors' evaluation."""


def setting(default: Any, meaning: str, values: Sequence[str] = (), least: int | None = None) -> Any:
    """Return a field of `EnvSettings`.

    Args:
        meaning: one line for the reference.
        values: accepted values; any of the type when empty.
        least: smallest whole number accepted.
    """
    return field(default=default, metadata={"meaning": meaning, "values": tuple(values), "least": least})


@dataclass(frozen=True)
class EnvSettings:
    """Settings of one environment; see each field's ``metadata["meaning"]``, which the reference prints.

    Raises:
        MemobenchError: a value is not accepted, or two settings exclude each other.
    """

    suite: str = setting(PUBLISHED, "the published tasks, or strict: 30 variants that need a memory", SUITES)
    world: str = setting(MEMOBENCH, "this package's scenes, or the paper's, of LIBERO's assets", WORLDS)
    protocol: str = setting(BY_PAPER, "the paper's evaluation, or the authors' script", PROTOCOLS)
    seed_base: int = setting(EVALUATION_SEED, "seed of episode 0", least=0)
    obs_type: str = setting(PIXELS, "observations besides the arm's state: pictures, object slots, or both", OBS_TYPES)
    referent: str = setting(
        "fixed", "the published goals, or drawn by seed; strict tasks are always drawn", REFERENT_VALUES
    )
    demonstration_prompt: bool = setting(True, "object and procedural tasks begin with their demonstration prompt")
    prompt_in: str = setting(AUTO, "the prompt plays in steps that the policy observes, or within reset", PROMPT_IN)
    horizon: int = setting(HORIZON, "execution steps per episode", least=1)
    replan_steps: int | None = setting(None, "actions executed per prediction; pauses keep such chunks whole", least=1)
    render: str = setting("default", "fast has no shadows; high is for films, at ten times the cost", QUALITIES)
    oracle_memory: bool = setting(False, "the instruction ends with the completed checkpoints (oracle memory control)")
    pause_steps: int = setting(0, "control steps of each pause, at moments drawn by the seed (pause control)", least=0)
    speed: float = setting(1.0, "1, 0.5, 0.33 and so on: an action takes 1, 2, 3 control steps (speed control)")
    evidence: bool = setting(False, "each scene is run with each variant of its task (evidence control)")
    expert_action: bool = setting(False, "offer the scripted expert's action as observation.expert_action")
    blind_action: bool = setting(False, "offer the blind published routine's as observation.blind_action")
    videos: int = setting(0, "episodes of each task that are recorded as videos, from the first; -1 all", least=EVERY)

    def __post_init__(self) -> None:
        for each in fields(self):
            self._check(each.name, str(each.type), each.metadata)
        if self.referent == DRAWN and self.suite != STRICT:
            check_choice("referent", self.referent, REFERENTS)
        if abs(steps_per_action(self.speed) * self.speed - 1) > 0.02 or not 1 / SLOWEST <= self.speed <= 1:
            raise MemobenchError(
                f"speed is {self.speed!r}; expected 1, 0.5, 0.33, 0.25 and so on down to {1 / SLOWEST}: an action "
                "takes a whole number of control steps"
            )
        if self.suite == STRICT:
            check_world("", self.world, self.suite)
            self._set(referent=DRAWN)
        if self.protocol == UPSTREAM:
            self._follow_upstream()
        if self.evidence:
            check_referent("", self.referent)

    def _check(self, name: str, kind: str, accepted: Mapping[str, Any]) -> None:
        """Check the type of a value, and against the values that are accepted."""
        value = getattr(self, name)
        optional = value is None and kind.endswith("| None")
        if kind.startswith("int") and not optional:
            least = accepted["least"]
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise MemobenchError(f"{name} is {value!r}; expected a whole number from {least} on")
        elif kind == "float":
            if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
                raise MemobenchError(f"{name} is {value!r}; expected a number above 0")
        elif kind == "bool" and not isinstance(value, bool | np.bool_):
            raise MemobenchError(f"{name} is {value!r}; expected true or false")
        elif accepted["values"] and value not in accepted["values"]:
            check_choice(name, value, accepted["values"])

    def _follow_upstream(self) -> None:
        """Set the values of the authors' evaluation; refuse others."""
        for name, value in UPSTREAM_ONLY.items():
            asked = getattr(self, name)
            if asked != value:
                raise MemobenchError(
                    f"{name} is {str(asked).lower()}; protocol={UPSTREAM}, the authors' evaluation, has "
                    f"{name}={str(value).lower()} only, so leave one of the two out"
                )
        self._set(demonstration_prompt=False, horizon=min(self.horizon, UPSTREAM_HORIZON))

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def changed(self, **changes: Any) -> EnvSettings:
        """Return settings with other values.

        Raises:
            MemobenchError: an unknown setting, or a value that is not accepted.
        """
        known = [each.name for each in fields(self)]
        for name in changes:
            if name not in known:
                raise MemobenchError(f"there is no setting {name!r} of an environment; {nearest(name, known)}")
        return replace(self, **changes)

    @property
    def protocol_block(self) -> dict[str, Any]:
        """The settings that must agree for two evaluations to be one, or to be compared."""
        agreed = {name: value for name, value in asdict(self).items() if name not in NOT_COMPARED}
        return {**agreed, **revision(self.suite)}


NOT_COMPARED = ("expert_action", "blind_action", "videos")
"""Settings on which no rollout depends."""
SETTINGS = tuple(each.name for each in fields(EnvSettings) if each.name not in NOT_COMPARED)
"""Settings on which rollouts depend."""


def revision(suite: str) -> dict[str, int]:
    """Return the part of a suite's protocol that changed with versions: idling and goals of strict tasks."""
    return {IDLE: IDLE_STEPS, GOALS: STRICT_GOALS} if suite == STRICT else {}


def steps_per_action(speed: float) -> int:
    """Return how many control steps an action takes at a speed."""
    return round(1 / speed)


DEFAULTS = EnvSettings()
