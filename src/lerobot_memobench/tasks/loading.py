"""Load a task from its folder: ``task_config.bddl`` and ``task_config.meta.json``.

The project's own catalogue and folders in the published format are read alike; what the published metadata does not
say is told from the folder and the instruction.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.bddl.problem import Problem
from lerobot_memobench.tasks.bddl.reading import parse_bddl
from lerobot_memobench.tasks.formula import LATCHES, atoms
from lerobot_memobench.tasks.metadata import Metadata
from lerobot_memobench.tasks.metadata_file import read_text
from lerobot_memobench.tasks.task import (
    BDDL_FILE,
    MEMORY_TYPES,
    METADATA_FILE,
    Checkpoint,
    MemoryType,
    Prompt,
    PromptKind,
    Task,
)

_PROMPT_WORDS: tuple[tuple[str, PromptKind], ...] = (
    ("picked up", "pick"),
    ("pointed", "point"),
    ("highlighted", "highlight"),
)
_ROUTINE_WORDS = ("procedure", "sequence", "routine", "follow", "step", "order")


def load_task(folder: str | Path, require_metadata: bool = True) -> Task:
    """Load a task folder, of the catalogue or in the published format.

    ``require_metadata=False`` lets a folder without a metadata file load as a task without checkpoints; a
    metadata file that is there is always read in full. Where the metadata does not say it, the memory type is
    the parent folder's name if that is one of the four; else ``procedural`` or ``object`` for an instruction
    that speaks of a prompt or video (procedural when it also speaks of a procedure, sequence or steps),
    ``temporal`` when the goal holds a latch, and ``spatial`` otherwise.

    Raises ``MemobenchError`` that names file, place, what was found and what was expected.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise MemobenchError(f"{folder} is not a folder, expected a task folder with {BDDL_FILE} and {METADATA_FILE}")
    text = read_text(folder / BDDL_FILE, "the scene, instruction and goal in BDDL")
    problem = parse_bddl(text, folder / BDDL_FILE)
    path = folder / METADATA_FILE
    read = require_metadata or path.exists()
    metadata = Metadata.read(path, problem) if read else Metadata(path, problem, {})
    checkpoints = metadata.checkpoints()
    memory_type = metadata.memory_type() or _infer_memory_type(folder, problem)
    stated = "prompt" in metadata.data
    return Task(
        name=folder.name,
        memory_type=memory_type,
        family=metadata.text("family") or "unspecified",
        language=problem.language,
        objects=problem.objects,
        fixtures=problem.fixtures,
        regions=problem.regions,
        init=problem.init,
        objects_of_interest=problem.objects_of_interest,
        goal=problem.goal,
        checkpoints=checkpoints,
        prompt=metadata.prompt() if stated else _infer_prompt(memory_type, problem, checkpoints),
        variants=metadata.variants(),
        demo_summary=metadata.text("demo_summary"),
        folder=folder,
        bddl_text=text,
        metadata=metadata.data,
        suite=metadata.suite(),
        twin_of=metadata.text("twin_of") or None,
        drawn=metadata.flag("drawn"),
        spoilt_as=metadata.failure_class("spoilt_as"),
    )


def _infer_memory_type(folder: Path, problem: Problem) -> MemoryType:
    for memory_type in MEMORY_TYPES:
        if folder.parent.name == memory_type:
            return memory_type
    language = problem.language.lower()
    if "prompt" in language or "video" in language:
        words = language.replace("-", " ").split()
        return "procedural" if any(word.startswith(_ROUTINE_WORDS) for word in words) else "object"
    return "temporal" if any(atom.predicate in LATCHES for atom in atoms(problem.goal)) else "spatial"


def _infer_prompt(memory_type: MemoryType, problem: Problem, checkpoints: tuple[Checkpoint, ...]) -> Prompt | None:
    if memory_type not in ("object", "procedural"):
        return None
    referent = _infer_referent(problem, checkpoints)
    language = problem.language.lower()
    kind: PromptKind = next((kind for words, kind in _PROMPT_WORDS if words in language), "routine")
    if kind == "routine" or referent is None:
        return Prompt("routine", referent if memory_type == "object" else None)
    return Prompt(kind, referent)


def _infer_referent(problem: Problem, checkpoints: tuple[Checkpoint, ...]) -> str | None:
    """The object that the prompt is about, from the first checkpoint that names objects (else from the goal).

    Of its objects it is the first that could be mistaken for another of its class, else the first.
    """
    siblings = Counter(problem.objects.values())
    for formula in (*(checkpoint.goal for checkpoint in checkpoints), problem.goal):
        named = [arg for atom in atoms(formula) for arg in atom.args if arg in problem.objects]
        if named:
            return next((arg for arg in named if siblings[problem.objects[arg]] > 1), named[0])
    return None
