"""Write a strict task as a task folder: the scene of a published task with another instruction, goal and metadata."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bddl_text import format_bddl

from lerobot_memobench.io import write_file
from lerobot_memobench.tasks.bddl import Region, parse_bddl
from lerobot_memobench.tasks.catalogue import CATALOGUE_DIR, get_task
from lerobot_memobench.tasks.formula import Formula, to_lists
from lerobot_memobench.tasks.task import BDDL_FILE, EASY, METADATA_FILE, STRICT, Difficulty, Prompt, Task

LONGEST_ROW = 110
"""Maximum columns of a JSON value on one line."""


@dataclass(frozen=True)
class Setting:
    """A variant that a seed can draw from ``difficulty`` on: instruction, goal and memory texts (K checkpoints)."""

    language: str
    goal: Formula
    checkpoints: tuple[Formula, ...]
    memory: tuple[tuple[str, str, str], ...]
    demo_summary: str
    prompt: Prompt | None = None
    difficulty: Difficulty = EASY


@dataclass(frozen=True)
class StrictTask:
    """A strict task with the settings that a seed draws from; the BDDL file contains the first.

    Attributes:
        operations: S, U or C per checkpoint, equal at all levels of language.
        regions: regions that the published file does not define.
        moved: start regions that replace published ones of the same name.
    """

    name: str
    published: str
    family: str
    operations: str
    settings: tuple[Setting, ...]
    spoilt_as: str | None = None
    regions: tuple[Region, ...] = ()
    moved: tuple[Region, ...] = ()

    @property
    def scene(self) -> Task:
        """The published task."""
        return get_task(self.published)

    @property
    def folder(self) -> Path:
        """The folder in the catalogue."""
        return CATALOGUE_DIR / STRICT / self.scene.memory_type / self.name


def files(task: StrictTask) -> dict[str, str]:
    """Return file name -> text of a task's folder."""
    problem = parse_bddl(task.scene.bddl_text, task.published)
    first = task.settings[0]
    regions = problem.regions | {region.full_name: region for region in (*task.regions, *task.moved)}
    problem = replace(problem, language=first.language, goal=first.goal, regions=regions)
    comment = f"Strict task, family {task.family}, in the scene of\n{task.published}."
    return {BDDL_FILE: format_bddl(problem, comment), METADATA_FILE: _json(_metadata(task)) + "\n"}


def write(task: StrictTask) -> None:
    """Write a task's folder, replacing existing files."""
    task.folder.mkdir(parents=True, exist_ok=True)
    for name, text in files(task).items():
        write_file(task.folder / name, text)


def _metadata(task: StrictTask) -> dict[str, Any]:
    first, *others = task.settings
    count = len(task.operations)
    assert all(len(one.checkpoints) == len(one.memory) == count for one in task.settings), task.name
    return {
        "suite": STRICT,
        "derived_from": task.published,
        "drawn": True,
        **({"spoilt_as": task.spoilt_as} if task.spoilt_as else {}),
        "memory_type": task.scene.memory_type,
        "family": task.family,
        "demo_summary": first.demo_summary,
        "prompt": _prompt(first.prompt),
        "key_frame": [-1] * count,
        "operating_type": [["SUC".index(operation)] * 3 for operation in task.operations],
        "subtask_goals": [to_lists(goal) for goal in first.checkpoints],
        "memory": [list(texts) for texts in first.memory],
        "variants": [_variant(one, first) for one in others],
    }


def _variant(one: Setting, first: Setting) -> dict[str, Any]:
    return {
        **({"language": one.language} if one.language != first.language else {}),
        "goal": to_lists(one.goal),
        **({"prompt": _prompt(one.prompt)} if one.prompt != first.prompt else {}),
        "subtask_goals": [to_lists(goal) for goal in one.checkpoints],
        "memory": [list(texts) for texts in one.memory],
        "demo_summary": one.demo_summary,
        **({"difficulty": one.difficulty} if one.difficulty != EASY else {}),
    }


def _prompt(prompt: Prompt | None) -> dict[str, Any] | None:
    if prompt is None:
        return None
    if prompt.places:
        return {"kind": prompt.kind, "places": [list(pair) for pair in prompt.places]}
    return {"kind": prompt.kind, "target": prompt.target}


def _json(value: Any, indent: str = "") -> str:
    """Return JSON with a value on one line if it fits."""
    flat = json.dumps(value, ensure_ascii=False)
    if len(indent) + len(flat) <= LONGEST_ROW or not isinstance(value, dict | list):
        return flat
    deeper = indent + "  "
    if isinstance(value, dict):
        rows = [f"{deeper}{json.dumps(key)}: {_json(item, deeper)}" for key, item in value.items()]
        return "{\n" + ",\n".join(rows) + f"\n{indent}}}"
    return "[\n" + ",\n".join(f"{deeper}{_json(item, deeper)}" for item in value) + f"\n{indent}]"
