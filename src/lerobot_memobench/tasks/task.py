"""Define the data of a task: scene, instruction, goal, checkpoints and variants.

`catalogue.load_task` reads tasks from folders.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from lerobot_memobench.constants import HORIZON
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import Atom, Formula, rename

MemoryType = Literal["temporal", "spatial", "object", "procedural"]
Operation = Literal["S", "U", "C"]
PromptKind = Literal["routine", "pick", "point", "highlight", "hide"]
Suite = Literal["published", "strict"]
LiberoSuite = Literal["libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90"]
Difficulty = Literal["easy", "standard", "hard", "extreme"]
Texts = tuple[str, str, str]

MEMORY_TYPES: tuple[MemoryType, ...] = get_args(MemoryType)
OPERATIONS: tuple[Operation, ...] = get_args(Operation)
SUITES: tuple[Suite, ...] = get_args(Suite)
PUBLISHED, STRICT = SUITES
#: LIBERO's own suites (`tasks.catalogue`), whose tasks have no checkpoints.
LIBERO_SUITES: tuple[LiberoSuite, ...] = get_args(LiberoSuite)
#: Difficulty of strict tasks -> largest number of repetitions that a counting task asks for. Each one draws from the
#: variants of the easier ones and its own (`Variant.difficulty`).
REPETITIONS: dict[Difficulty, int] = {"easy": 2, "standard": 3, "hard": 5, "extreme": 8}
DIFFICULTIES = tuple(REPETITIONS)
EASY, STANDARD = DIFFICULTIES[:2]
REFERENTS = ("fixed", "random")
DRAWN = "drawn"  # referent of strict episodes, which ignore the referent setting (`Task.drawn`)
#: Control steps of a strict task's prompt per object shown, equal for all variants. The slowest of some 700 prompts
#: used five sixths of them; the scene rests for the remainder.
STRICT_PROMPT_STEPS: dict[PromptKind, int] = {"highlight": 100, "point": 300, "pick": 300, "routine": 300, "hide": 600}
#: Failure classes of strict tasks only (`Task.spoilt_as`): an event was repeated too rarely or too often; the object
#: was searched in a wrong place; the events or the place were right, and the hand failed.
MISCOUNT, WRONG_PLACE, HAND = STRICT_FAILURES = ("miscount", "wrong_place", "hand")
LEVELS = ("coarse", "intermediate", "fine")
DEFAULT_LEVEL = 1  # level of the evaluated operation labels (paper: intermediate)

BDDL_FILE = "task_config.bddl"
METADATA_FILE = "task_config.meta.json"


def referent_text(requested: str, drawn: bool) -> str:
    """Return the effective referent: the requested one, or `DRAWN` for tasks that draw it per episode."""
    return DRAWN if drawn else requested


def horizon_of(difficulty: str) -> int:
    """Return the execution steps per episode of a difficulty; raise `MemobenchError` if it is unknown."""
    # As many per repetition as in the standard suite, and not less in all.
    check_choice("difficulty", difficulty, DIFFICULTIES)
    return max(HORIZON, HORIZON * REPETITIONS[cast("Difficulty", difficulty)] // REPETITIONS[STANDARD])


@dataclass(frozen=True)
class Checkpoint:
    """A memory checkpoint: the goal detects the event; labels and texts at the coarse, intermediate and fine level."""

    goal: Formula
    operations_by_level: tuple[Operation, Operation, Operation]
    language: Texts

    @property
    def operation(self) -> Operation:
        """Evaluated label (intermediate level)."""
        return self.operations_by_level[DEFAULT_LEVEL]


@dataclass(frozen=True)
class Prompt:
    """A demonstration prompt: a routine; picking up, pointing at or highlighting ``target``; or a hiding.

    Attributes:
        places: for a hiding, pairs of object and drawer in the order shown; hidden objects stay in place for the
            execution.
    """

    kind: PromptKind
    target: str | None = None
    places: tuple[tuple[str, str], ...] = ()

    @property
    def restores(self) -> bool:
        """Whether the scene is restored before the execution begins."""
        return self.kind != "hide"


@dataclass(frozen=True)
class Variant:
    """An alternative referent, order or count of a task in the same scene.

    Attributes:
        substitute: simultaneous replacement of names in goal, checkpoint goals and prompt target.
        order: index of the published checkpoint at each position; operation labels keep their positions.
        languages: texts per position (coarse, intermediate, fine).
        goals, goal: checkpoint goals per position, and goal; override substituted and reordered ones.
        language, prompt: override the task's instruction and the substituted prompt.
        replaces_published: whether the published goal is looser (accepts another order); then variant 0 is not drawn.
        difficulty: lowest difficulty at which it is drawn.
    """

    languages: tuple[Texts, ...]
    substitute: dict[str, str] = field(default_factory=dict)
    order: tuple[int, ...] | None = None
    goals: tuple[Formula, ...] | None = None
    goal: Formula | None = None
    demo_summary: str = ""
    language: str = ""
    prompt: Prompt | None = None
    replaces_published: bool = False
    difficulty: Difficulty = EASY


@dataclass(frozen=True, eq=False)
class Task:
    """All data of a task. Do not modify its dicts.

    Attributes:
        memory_type: temporal, spatial, object or procedural; the suite for a task of LIBERO's suites, which LeRobot
            reports by suite.
        objects, fixtures: instance -> class, in the file's order.
        regions: full name (``<target>_<region>``) -> region.
        init: initial state; objects in regions are sampled, others rest on their support.
        prompt: None for the published temporal and spatial tasks.
        variants: alternatives to the published task: ``variant(k)`` for k >= 1.
        bddl_text, metadata: content of the task's files.
        suite: published, strict or one of LIBERO's; a strict episode ends when its goal can no longer be reached.
        derived_from: published task with the same scene; None for a task with its own scene.
        drawn: whether each episode draws its variant by seed and ignores the referent setting; False for a variant.
        spoilt_as: failure class of an episode with an unreachable goal; None classifies by checkpoints.
        difficulty: variants that are drawn; a setting of the evaluation, never of a task's files.
    """

    name: str
    memory_type: MemoryType | LiberoSuite
    family: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    init: tuple[Atom, ...]
    objects_of_interest: tuple[str, ...]
    goal: Formula
    folder: Path
    bddl_text: str = field(repr=False)
    metadata: dict[str, Any] = field(default_factory=dict, repr=False)
    checkpoints: tuple[Checkpoint, ...] = ()
    prompt: Prompt | None = None
    variants: tuple[Variant, ...] = ()
    demo_summary: str = ""
    variant_index: int = 0
    published: Task | None = field(default=None, repr=False)
    suite: Suite | LiberoSuite = "published"
    derived_from: str | None = None
    drawn: bool = False
    spoilt_as: str | None = None
    difficulty: Difficulty = STANDARD

    # Compare files, variant and settings, so that pickled copies in worker processes are equal and hashable.
    def _key(self) -> tuple[str | int, ...]:
        metadata = json.dumps(self.metadata, sort_keys=True)
        return self.name, self.bddl_text, metadata, self.variant_index, self.difficulty

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Task) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash((self.name, self.bddl_text, self.variant_index))

    def at(self, difficulty: str) -> Task:
        """Return the task with the variants of another difficulty (strict tasks only)."""
        return dataclasses.replace(self, difficulty=cast("Difficulty", difficulty))

    @property
    def title(self) -> str:
        """Instruction shared by all variants, or the task's name if their instructions differ."""
        return self.name.replace("_", " ") if any(variant.language for variant in self.variants) else self.language

    @property
    def prompt_steps(self) -> int | None:
        """Fixed number of control steps of the prompt; None for a variable length."""
        if self.suite != STRICT:
            return None
        if self.prompt is None:
            return 0
        shown = {"routine": len(self.checkpoints), "hide": len(self.prompt.places)}.get(self.prompt.kind, 1)
        return shown * STRICT_PROMPT_STEPS[self.prompt.kind]

    @property
    def operations(self) -> str:
        """Operation labels of the checkpoints at the evaluated level, such as "SUC"."""
        return "".join(checkpoint.operation for checkpoint in self.checkpoints)

    @property
    def num_variants(self) -> int:
        """Number of variants, including the published one (0)."""
        return 1 + len(self.variants)

    @property
    def random_variants(self) -> tuple[int, ...]:
        """Indices drawn for a random referent: those of the difficulty, without 0 if a stricter variant replaces it."""
        first = () if any(variant.replaces_published for variant in self.variants) else (0,)
        drawn = DIFFICULTIES[: DIFFICULTIES.index(self.difficulty) + 1]
        return *first, *(k for k, variant in enumerate(self.variants, 1) if variant.difficulty in drawn)

    def variant(self, k: int) -> Task:
        """Return the task with instruction, goal, checkpoints, texts and prompt of variant ``k``; 0 is published."""
        base = self.published or self
        if k == 0:
            return base
        if not 0 < k < self.num_variants:
            raise MemobenchError(f"{self.name} has variants 0 to {self.num_variants - 1}, not {k}; choose one of these")
        chosen = self.variants[k - 1]
        order = chosen.order or tuple(range(len(base.checkpoints)))
        goals = chosen.goals or tuple(rename(base.checkpoints[i].goal, chosen.substitute) for i in order)
        checkpoints = tuple(
            dataclasses.replace(checkpoint, goal=goal, language=language)
            for checkpoint, goal, language in zip(base.checkpoints, goals, chosen.languages, strict=True)
        )
        prompt = chosen.prompt or base.prompt
        if prompt is not None and prompt.target is not None:
            prompt = dataclasses.replace(prompt, target=chosen.substitute.get(prompt.target, prompt.target))
        return dataclasses.replace(
            base,
            language=chosen.language or base.language,
            goal=chosen.goal or rename(base.goal, chosen.substitute),
            checkpoints=checkpoints,
            prompt=prompt,
            demo_summary=chosen.demo_summary or base.demo_summary,
            variant_index=k,
            published=base,
            drawn=False,
        )
