"""A task of the benchmark, as data: scene, instruction, goal, checkpoints, and its variants.

`catalogue.load_task` reads tasks from folders.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import Atom, Formula, rename

MemoryType = Literal["temporal", "spatial", "object", "procedural"]
Operation = Literal["S", "U", "C"]
PromptKind = Literal["routine", "pick", "point", "highlight", "hide"]
Suite = Literal["published", "strict"]
World = Literal["memobench", "libero"]
Texts = tuple[str, str, str]

MEMORY_TYPES: tuple[MemoryType, ...] = get_args(MemoryType)
OPERATIONS: tuple[Operation, ...] = get_args(Operation)
SUITES: tuple[Suite, ...] = get_args(Suite)
PUBLISHED, STRICT = SUITES
WORLDS: tuple[World, ...] = get_args(World)
MEMOBENCH, LIBERO = WORLDS
REFERENTS = ("fixed", "random")
#: The referent of strict episodes, whatever is asked for (`Task.drawn`).
DRAWN = "drawn"
#: Control steps of a strict task's prompt for each thing that it shows, whichever variant that is. The slowest of some
#: 700 prompts left a sixth of them; the scene rests meanwhile.
STRICT_PROMPT_STEPS: dict[PromptKind, int] = {"highlight": 100, "point": 300, "pick": 300, "routine": 300, "hide": 600}
#: Classes of failure that only strict tasks have (`Task.spoilt_as`): the event was done too seldom or too often; the
#: thing was looked for where it is not.
STRICT_FAILURES = ("miscount", "wrong_place")
LEVELS = ("coarse", "intermediate", "fine")
#: The level whose operation labels are evaluated (paper: intermediate).
DEFAULT_LEVEL = 1

BDDL_FILE = "task_config.bddl"
METADATA_FILE = "task_config.meta.json"


def referent_text(asked: str, drawn: bool) -> str:
    """Return the referent of episodes for which one was asked: none can be chosen where each draws its own."""
    return DRAWN if drawn else asked


def check_world(prefix: str, world: str, suite: str) -> None:
    """Refuse an unknown world, and one in which a suite cannot take place; ``prefix`` stands before a setting's name.

    Raises:
        MemobenchError: it is refused.
    """
    check_choice(f"{prefix}world", world, WORLDS)
    if (suite, world) == (STRICT, LIBERO):
        raise MemobenchError(
            f"{prefix}world={LIBERO} was asked for with {prefix}suite={STRICT}, whose detents and sealed drawers are "
            f"those of world={MEMOBENCH} alone; leave one of the two out"
        )


@dataclass(frozen=True)
class Checkpoint:
    """A memory checkpoint.

    Attributes:
        goal: predicate that shows the event in the world.
        operations_by_level: label at the coarse, intermediate and fine level.
        language: what a memory should say after it, at the three levels.
    """

    goal: Formula
    operations_by_level: tuple[Operation, Operation, Operation]
    language: Texts

    @property
    def operation(self) -> Operation:
        """The label that is evaluated (intermediate level)."""
        return self.operations_by_level[DEFAULT_LEVEL]


@dataclass(frozen=True)
class Prompt:
    """A demonstration prompt: a routine, ``target`` being picked up, pointed at or highlighted, or a hiding.

    Attributes:
        places: of a hiding, thing -> drawer in the order shown. The execution begins from the scene as it left it.
    """

    kind: PromptKind
    target: str | None = None
    places: tuple[tuple[str, str], ...] = ()

    @property
    def restores(self) -> bool:
        """Whether the scene is put back as it was before the execution begins."""
        return self.kind != "hide"


@dataclass(frozen=True)
class Variant:
    """Another admissible referent, order or number of a task, in the same scene.

    Attributes:
        substitute: names replaced, all at once, in goal, checkpoint goals and prompt target.
        order: position k shows which checkpoint of the published task; its operation labels stay at their
            positions.
        languages: texts per position (coarse, intermediate, fine).
        goals: checkpoint goals per position in place of substituted and reordered ones.
        goal: goal in place of the substituted one.
        demo_summary: what the demonstration does.
        language: instruction in place of the task's.
        prompt: what the demonstration prompt shows in place of the substituted one.
        replaces_published: the published goal is looser than this variant's (it would accept another order),
            so variant 0 is not drawn.
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


@dataclass(frozen=True, eq=False)
class Task:
    """Everything the benchmark knows about a task. Do not change its dicts.

    Attributes:
        name: the folder's name.
        memory_type: temporal, spatial, object or procedural.
        family: tasks of the same kind.
        language: the instruction.
        objects: instance -> class, in the file's order.
        fixtures: instance -> class, in the file's order.
        regions: full name (``<target>_<region>``) -> region.
        init: starting state; objects in regions are sampled, others rest on what they name.
        prompt: what the demonstration prompt shows; None for the published temporal and spatial tasks.
        variants: the alternatives to the published task: ``variant(k)`` for k >= 1.
        variant_index: which variant this is.
        bddl_text: the task file as read.
        metadata: the metadata file as read.
        suite: what it belongs to; an episode of the strict suite ends when its goal can no longer be reached.
        derived_from: the published task in whose scene it takes place; None for a task of its own.
        drawn: every episode draws its variant by seed, whatever referent is asked for; a variant is not drawn again.
        spoilt_as: failure class of an episode whose goal could no longer be reached; None for that of its checkpoints.
        world: assets, placement, contacts and predicates of the scene: `memobench`, the package's own, or `libero`, the
            paper's. It is a property of an evaluation and never stated in a task's files.
    """

    name: str
    memory_type: MemoryType
    family: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    init: tuple[Atom, ...]
    objects_of_interest: tuple[str, ...]
    goal: Formula
    checkpoints: tuple[Checkpoint, ...]
    prompt: Prompt | None
    variants: tuple[Variant, ...]
    demo_summary: str
    folder: Path
    bddl_text: str = field(repr=False)
    metadata: dict[str, Any] = field(repr=False)
    variant_index: int = 0
    published: Task | None = field(default=None, repr=False)
    suite: Suite = "published"
    derived_from: str | None = None
    drawn: bool = False
    spoilt_as: str | None = None
    world: World = "memobench"

    # Two tasks are the same when their files, variant and world are: pickled copies in worker processes stay equal
    # and hashable.
    def _key(self) -> tuple[str, str, str, int, str]:
        return self.name, self.bddl_text, json.dumps(self.metadata, sort_keys=True), self.variant_index, self.world

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Task) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash((self.name, self.bddl_text, self.variant_index, self.world))

    def in_world(self, world: World) -> Task:
        """Return the task in another world; scene, instruction, goal and checkpoints stay the same.

        Raises:
            MemobenchError: it cannot take place there.
        """
        check_world("", world, self.suite)
        published = self.published and self.published.in_world(world)
        return dataclasses.replace(self, world=world, published=published)

    @property
    def scene_name(self) -> str:
        """The name by which seeds draw the scene: a strict task's is its published task's, seed for seed."""
        return self.derived_from or self.name

    @property
    def title(self) -> str:
        """What the task asks in all of its variants: its instruction, or its name where they differ in it."""
        return self.name.replace("_", " ") if any(one.language for one in self.variants) else self.language

    @property
    def idles(self) -> bool:
        """Whether the robot idles before the execution, which then shows no clock."""
        return self.suite == STRICT

    @property
    def prompt_steps(self) -> int | None:
        """Control steps of the prompt, the same for all variants; None: it takes as many as it needs."""
        if not self.idles:
            return None
        if self.prompt is None:
            return 0
        shown = {"routine": len(self.checkpoints), "hide": len(self.prompt.places)}.get(self.prompt.kind, 1)
        return shown * STRICT_PROMPT_STEPS[self.prompt.kind]

    @property
    def operations(self) -> str:
        """Operation labels of the checkpoints at the evaluated level, e.g. "SUC"."""
        return "".join(checkpoint.operation for checkpoint in self.checkpoints)

    @property
    def num_variants(self) -> int:
        """Number of variants, the published one (0) included."""
        return 1 + len(self.variants)

    @property
    def random_variants(self) -> tuple[int, ...]:
        """The k to draw from for a random referent: all, without 0 where a stricter copy replaces it."""
        first = 1 if any(variant.replaces_published for variant in self.variants) else 0
        return tuple(range(first, self.num_variants))

    def variant(self, k: int) -> Task:
        """Return the task with instruction, goal, checkpoints, texts and prompt of variant ``k``; 0 is as published."""
        base = self.published or self
        if k == 0:
            return base
        if not 0 < k < self.num_variants:
            raise MemobenchError(f"{self.name} has variants 0 to {self.num_variants - 1}, not {k}; pass one of those")
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
