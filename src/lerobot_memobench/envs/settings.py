"""Settings of an environment: name, type, default, meaning and accepted values.

LeRobot configuration, gymnasium environment, episode, evaluation file and vla-evaluation-harness all use `EnvSettings`.
To add a setting, add a field here and the code that applies it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from lerobot_memobench.constants import (
    BY_PAPER,
    EVALUATION_SEED,
    HOLD_MEAN,
    IMAGE_SIZE,
    PROMPT_HORIZON,
    RULES,
    SCENE_HASH_VERSION,
    UPSTREAM,
    UPSTREAM_HORIZON,
)
from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.sim.convention import CONVENTIONS, LIBERO_CAMERAS, MIRRORED, UPRIGHT, image_names
from lerobot_memobench.tasks.catalogue import STEP_LIMITS
from lerobot_memobench.tasks.task import (
    DIFFICULTIES,
    DRAWN,
    LIBERO_SUITES,
    PUBLISHED,
    REFERENTS,
    STANDARD,
    STRICT,
    SUITES,
    horizon_of,
)

PIXELS, OBJECTS, BOTH = "pixels_agent_pos", "environment_state_agent_pos", "both"
OBS_TYPES = (PIXELS, OBJECTS, BOTH)  # values of `obs_type`; the first two are LeRobot's names

AUTO, STEPS, RESET = "auto", "steps", "reset"
PROMPT_IN = (AUTO, STEPS, RESET)
"""Values of ``prompt_in``. A policy that reads prompts declares ``reads_prompt: ClassVar[bool] = True`` in the class of
its configuration. It waits while `observation.phase` is 0 and discards planned actions when it becomes 1. For other
policies the prompt plays in `reset`. ``auto`` chooses by the policy; without a known policy it means ``steps``."""

RELATIVE = "relative"
QUALITIES = ("default", "high")
EVERY = -1  # value of `videos`: record every episode
SLOWEST = 10  # maximum number of control steps per action, see `speed`

SMALLEST, LARGEST = 16, 2048  # least and greatest height and width of images, pixels

EXAMPLE = '{"agentview_image": "camera1", "robot0_eye_in_hand_image": "camera2"}'  # a value of `camera_name_mapping`
IMAGE_NAME = re.compile("[A-Za-z0-9_]+")

SALT = re.compile("[0-9a-f]{32}")
INTACT, DELETE, SWAP, NOISE = "none", "delete", "swap", "noise"
CORRUPTIONS = (INTACT, DELETE, SWAP, NOISE)  # values of `corrupt`: what happens to the memory of the policy

IMAGE_SETTINGS = {"convention": UPRIGHT, "observation_height": IMAGE_SIZE, "observation_width": IMAGE_SIZE}
"""Settings of images, which observations of objects alone do not have, and their defaults."""
MEMORY_CONTROLS = ("corrupt", "corrupt_step", "reshow", "interference")  # settings of corruption and interference

HOLD, GOALS, STRICT_GOALS = "hold", "goals", 4
"""Protocol keys of strict tasks: mean control steps of a hold, and revision of the goals. Goals of revision 1 could be
reached without memory by marks in the scene and a clock, goals of revision 2 by a camera inside a drawer and by a plan
that passes home, goals of revision 3 by a clock, because returns without an event were held."""
SCENE_HASHES = "scene_hash_version"  # protocol key: version of the hash of scenes (`Simulation.scene_hash`)
UPSTREAM_ONLY = ("suite", "referent", "oracle_memory", "pause_steps", "speed", "evidence", *MEMORY_CONTROLS)
"""Settings that keep their default in the authors' evaluation."""
LIBERO_ONLY = (
    *("difficulty", "rules", "referent", "oracle_memory", "evidence", "salt", "expert_action", "blind_action"),
    *("obs_type", "demonstration_prompt", *MEMORY_CONTROLS),
)
"""Settings that keep their default in LIBERO's suites. Their tasks have no checkpoints, prompts, variants and expert,
and object slots lack their classes."""


def setting(default: Any, meaning: str, values: Sequence[str] = (), least: int | None = None, usual: str = "") -> Any:
    """Return a field of `EnvSettings`, with its entry in help and reference.

    Args:
        values: accepted values; empty for any value of the type.
        least: smallest accepted integer.
        usual: the default in words, where it depends on other settings or on the policy.
    """
    metadata = {"meaning": meaning, "values": tuple(values), "least": least, "usual": usual}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class EnvSettings:
    """Settings of one environment; raise for values that are not accepted, and for incompatible settings."""

    suite: str = setting(
        PUBLISHED,
        "thirty tasks as published; strict: variants that need a memory; libero_…: LIBERO's own tasks, "
        "episode i from the i-th initial state",
        (*SUITES, *LIBERO_SUITES),
    )
    difficulty: str = setting(
        STANDARD, "counts of strict tasks up to 2, 3, 5 or 8, and the number of steps", DIFFICULTIES
    )
    rules: str = setting(
        BY_PAPER,
        "the paper's evaluation; upstream, the authors' script: no demonstration prompt, fixed referents, at most 990 "
        "steps, an end when all checkpoints have held",
        RULES,
    )
    seed_base: int = setting(EVALUATION_SEED, "seed of episode 0", least=0, usual="that of seed= or split=")
    obs_type: str = setting(
        PIXELS,
        "observations: the arm's state with images, with object slots, or with both",
        OBS_TYPES,
        usual="what the policy was trained on, else images",
    )
    convention: str = setting(
        None,
        "images upright (image, wrist_image), or libero: mirrored left to right (image, image2), as checkpoints of "
        "LIBERO need them",
        [*CONVENTIONS],
        usual="the checkpoint's; else upright, in suites of LIBERO libero",
    )
    camera_name_mapping: dict[str, str] | None = setting(  # noqa: RUF009 - its default is None
        None,
        f"LeRobot's mapping of LIBERO's names of the cameras, such as {EXAMPLE}; means convention=libero",
        usual="image, image2",
    )
    observation_height: int = setting(IMAGE_SIZE, "height of images, pixels, an even number", least=SMALLEST)
    observation_width: int = setting(IMAGE_SIZE, "width of images, pixels, an even number", least=SMALLEST)
    control_mode: str = setting(RELATIVE, "actions are displacements; LIBERO's absolute ones are refused")
    referent: str = setting(
        "fixed",
        "the published goals; random: the seed decides the goal that the prompt shows; strict tasks are always drawn",
        (*REFERENTS, DRAWN),
    )
    demonstration_prompt: bool = setting(True, "object and procedural tasks begin with their demonstration prompt")
    prompt_in: str = setting(
        AUTO,
        "steps: the policy observes the prompt; reset: it plays before the first observation",
        PROMPT_IN,
        usual="by the policy",
    )
    horizon: int = setting(
        None,
        "execution steps per episode",
        least=1,
        usual="1200; with difficulty=hard 2000, with extreme 3200; in suites of LIBERO 280, 280, 300, 520 and 400",
    )
    replan_steps: int | None = setting(
        None,
        "actions executed per prediction; pauses start, and holds end, between chunks",
        least=1,
        usual="the policy's",
    )
    window_steps: int = setting(
        1, "control steps of observations in an input of a policy without a memory", least=1, usual="the policy's"
    )
    delay_steps: int = setting(0, "control steps from an observation to the first action planned from it", least=0)
    render: str = setting("default", "high is for figures: four samples per pixel, slower", QUALITIES)
    oracle_memory: bool = setting(False, "the instruction ends with the completed checkpoints (oracle memory control)")
    pause_steps: int = setting(
        0, "control steps of each pause, at moments drawn by the seed (pause control, see memobench compare)", least=0
    )
    speed: float = setting(
        1.0, "1, 0.5, 0.33 and so on: an action takes 1, 2, 3 control steps (speed control, see memobench compare)"
    )
    evidence: bool = setting(
        False, "each scene with each variant of its task, 36 episodes unless others are asked for (evidence control)"
    )
    salt: str | None = setting(
        None,
        "sealed test only: 32 hexadecimal digits that repeat the draws of variants and holds of an earlier run",
        usual="drawn at the start",
    )
    corrupt: str = setting(
        INTACT, "delete, swap (between rows) or noise the policy's memory once, for policies that offer it", CORRUPTIONS
    )
    corrupt_step: int = setting(0, "execution step at which corrupt acts; 0: at the end of the prompt", least=0)
    reshow: bool = setting(False, "the prompt plays a second time, after corrupt has acted")
    interference: int = setting(0, "episodes of other tasks shown between prompt and execution", least=0)
    robot_state: bool = setting(False, "add the nested robot_state of LeRobot's libero: hand, fingers and joints")
    expert_action: bool = setting(False, "add the scripted expert's action as observation.expert_action")
    blind_action: bool = setting(False, "add the blind published routine's action as observation.blind_action")
    videos: int = setting(
        0,
        "number of first episodes of each task recorded as videos; -1 for all",
        least=EVERY,
        usual="10, without images in the observations 0",
    )

    def __post_init__(self) -> None:
        # By `vars`, because the class is frozen.
        vars(self).update({name: value for name, value in self.usual.items() if getattr(self, name) is None})
        for setting in fields(self):
            self._check(setting.name, str(setting.type), setting.metadata)
        if self.referent == DRAWN and self.suite != STRICT:
            check_choice("referent", self.referent, REFERENTS)
        if not 1 / SLOWEST <= self.speed <= 1 or abs(steps_per_action(self.speed) * self.speed - 1) > 0.02:
            raise MemobenchError(
                f"speed is {self.speed!r}; expected 1, 0.5, 0.33, 0.25 and so on down to {1 / SLOWEST}, so that an "
                "action takes a whole number of control steps"
            )
        if self.salt is not None and not SALT.fullmatch(str(self.salt)):
            raise MemobenchError(f"salt is {self.salt!r}; expected 32 hexadecimal digits in lower case")
        if self.control_mode != RELATIVE:
            raise MemobenchError(
                f"control_mode is {self.control_mode!r}, and actions of this environment are displacements; leave "
                f"control_mode out, and evaluate a policy of control_mode={RELATIVE}"
            )
        if self.suite in LIBERO_SUITES:
            self._require(LIBERO_ONLY, f"suite={self.suite}, without checkpoints, prompts, expert and object slots,")
        self._check_images()
        if self.suite == STRICT:
            vars(self).update(referent=DRAWN)
        elif self.difficulty != STANDARD:
            raise MemobenchError(
                f"difficulty={self.difficulty} is for strict tasks; set suite={STRICT}, or leave it out"
            )
        if self.rules == UPSTREAM:
            self._require(UPSTREAM_ONLY, f"rules={UPSTREAM}, the authors' evaluation,")
            vars(self).update(demonstration_prompt=False, horizon=min(self.horizon, UPSTREAM_HORIZON))
        if self.evidence and self.referent == REFERENTS[0]:
            raise MemobenchError(
                f"evidence=true runs each scene with each variant, but referent={self.referent} allows the published "
                f"variant only; set referent={REFERENTS[1]}"
            )
        self._check_memory_controls()

    def _check_images(self) -> None:
        height, width = self.observation_height, self.observation_width
        if height % 2 or width % 2 or max(height, width) > LARGEST:
            raise MemobenchError(
                f"observation_height and observation_width are {height} and {width}; expected even numbers up to "
                f"{LARGEST}"
            )
        for name, default in IMAGE_SETTINGS.items():
            if self.obs_type == OBJECTS and (value := getattr(self, name)) != default:
                raise MemobenchError(f"{name}={value} is of images, and obs_type={OBJECTS} has none; leave it out")
        if (mapping := self.camera_name_mapping) is None:
            return
        if self.convention != MIRRORED:
            raise MemobenchError(
                f"camera_name_mapping= names LIBERO's images, and convention is {self.convention}; set "
                f"convention={MIRRORED}, or leave camera_name_mapping out"
            )
        if not _names_images(mapping):
            raise MemobenchError(
                f"camera_name_mapping is {mapping!r}; expected different names of letters, digits and _ for "
                f"{' and '.join(LIBERO_CAMERAS.values())}, as in {EXAMPLE}"
            )

    @property
    def images(self) -> dict[str, str]:
        """Camera -> name of its image."""
        return image_names(self.convention, self.camera_name_mapping)

    def _check_memory_controls(self) -> None:
        if self.corrupt_step and (self.corrupt == INTACT or self.reshow):
            raise MemobenchError(
                f"found corrupt_step={self.corrupt_step} with corrupt={self.corrupt} and reshow="
                f"{str(self.reshow).lower()}; a step needs corrupt=delete, swap or noise, and reshow=true needs step "
                "0, because prompts play before the execution"
            )
        if self.interference and (self.corrupt != INTACT or self.reshow):
            raise MemobenchError(
                f"found interference={self.interference} with corrupt={self.corrupt} and reshow="
                f"{str(self.reshow).lower()}; expected one control, run an evaluation for each"
            )
        if self.needs_prompt and (self.prompt_in == RESET or not self.demonstration_prompt):
            raise MemobenchError(
                "corrupt= (at step 0), reshow= and interference= act while the policy observes the prompt; leave out "
                "prompt_in=reset and demonstration_prompt=false, and evaluate a policy that reads prompts"
            )

    @property
    def needs_prompt(self) -> bool:
        """Whether a control acts between prompt and execution, so that only tasks with a prompt are run."""
        return self.reshow or self.interference > 0 or (self.corrupt != INTACT and self.corrupt_step == 0)

    def _check(self, name: str, kind: str, accepted: Mapping[str, Any]) -> None:
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
        elif accepted["values"]:
            check_choice(name, value, accepted["values"])

    def _require(self, names: Sequence[str], reason: str) -> None:
        for name in names:  # a field's default is an attribute of the class
            if (value := getattr(self, name)) != (default := getattr(type(self), name)):
                raise MemobenchError(
                    f"{name} is {str(value).lower()}, but {reason} requires {name}={str(default).lower()}; leave "
                    f"{name} out"
                )

    @property
    def usual(self) -> dict[str, Any]:
        """Defaults that follow from other settings."""
        limits = {str(suite): steps for suite, steps in STEP_LIMITS.items()}
        mirrored = self.suite in limits or self.camera_name_mapping is not None
        return {
            "horizon": limits.get(self.suite, horizon_of(self.difficulty)),
            "convention": MIRRORED if mirrored else UPRIGHT,  # as in LeRobot's environment `libero`
        }

    @property
    def longest_interference(self) -> int:
        """Maximum number of control steps of the other episodes between prompt and execution."""
        return self.interference * (PROMPT_HORIZON + self.horizon + 2)

    def changed(self, **changes: Any) -> EnvSettings:
        """Return a copy with changed values; raise for an unknown setting or value."""
        known = [setting.name for setting in fields(self)]
        for name in changes:
            if name not in known:
                raise MemobenchError(f"unknown environment setting {name!r}; {nearest(name, known)}")
        following = {name: None for name, value in self.usual.items() if getattr(self, name) == value}
        return replace(self, **following | changes)

    @property
    def protocol_block(self) -> dict[str, Any]:
        """Settings that must agree to join or compare two evaluations."""
        agreed = {name: value for name, value in asdict(self).items() if name not in NOT_COMPARED}
        strict = {HOLD: HOLD_MEAN, GOALS: STRICT_GOALS} if self.suite == STRICT else {}
        return {**agreed, SCENE_HASHES: SCENE_HASH_VERSION, **strict}


NOT_COMPARED = ("control_mode", "expert_action", "blind_action", "videos")  # settings without effect on rollouts
SETTINGS = tuple(setting.name for setting in fields(EnvSettings) if setting.name not in NOT_COMPARED)
"""Settings with an effect on rollouts."""


def steps_per_action(speed: float) -> int:
    """Return the number of control steps per action."""
    return round(1 / speed)


def _names_images(mapping: Any) -> bool:
    if not isinstance(mapping, Mapping) or not {*mapping} <= {*LIBERO_CAMERAS.values()}:
        return False
    names = [*image_names(MIRRORED, mapping).values()]
    return all(isinstance(name, str) and IMAGE_NAME.fullmatch(name) for name in names) and len({*names}) == len(names)


DEFAULTS = EnvSettings()
