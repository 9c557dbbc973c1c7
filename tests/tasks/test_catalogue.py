"""The catalogue: the facts of the published tasks, our own texts, selection of tasks by name and number."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.bddl import parse_bddl
from lerobot_memobench.tasks.catalogue import (
    get_task,
    load_task,
    resolve_tasks,
    suite_of,
    task_index,
    task_names,
    task_number,
    task_record,
)
from lerobot_memobench.tasks.formula import Then, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import MEMORY_TYPES, METADATA_FILE, STRICT, SUITES, Task

COMMAS = "follow_the_prompt_to_determine_the_items,_discard_the_waste_first,_then_plate_the_remaining_item"
STOVE = "turn_on_the_stove_and_turn_it_off"


def tasks() -> list[Task]:
    return [get_task(name) for name in task_names()]


def texts_of(task: Task) -> list[str]:
    return [task.demo_summary, *(text for checkpoint in task.checkpoints for text in checkpoint.language)]


def test_published_tasks_are_complete_and_ordered() -> None:
    assert Counter(task.memory_type for task in tasks()) == dict(zip(MEMORY_TYPES, (10, 10, 5, 5), strict=True))
    assert Counter("".join(task.operations for task in tasks())) == {"S": 35, "U": 32, "C": 17}
    keys = [(MEMORY_TYPES.index(task.memory_type), task.name) for task in tasks()]
    assert keys == sorted(keys)
    assert [task_index(name) for name in task_names()] == list(range(30))
    assert len({c for t in tasks() for c in t.objects.values()}) == 29
    assert len({c for t in tasks() for c in t.fixtures.values()}) == 5
    for task in tasks():
        assert task.folder.parent.name == task.memory_type
        assert task.family != "unspecified"
        assert (task.prompt is None) == (task.memory_type in ("temporal", "spatial"))
        assert all(text == " ".join(text.split()) and text for text in texts_of(task))
        for coarse, intermediate, fine in (checkpoint.language for checkpoint in task.checkpoints):
            assert len(coarse) <= len(intermediate) + 12
            assert len(intermediate) < len(fine)
        assert get_task(task.name) is task


def test_variants_differ_and_start_incomplete() -> None:
    expected = {
        "put_the_butter_into_the_bowl_from_the_prompt_video": 3,
        "put_the_butter_picked_up_in_the_prompt_video_on_the_plate": 9,
        "put_the_milk_picked_up_in_the_prompt_video_on_the_plate": 9,
        "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video": 6,
        "execute_the_assembly_procedure_demonstrated_in_the_prompt_video": 2,
    }
    for task in tasks():
        drawn = [task.variant(k) for k in task.random_variants]
        prompted = task.memory_type in ("object", "procedural")
        assert len(drawn) == expected.get(task.name, 2 if prompted else 1)
        for fact in (lambda v: v.goal, lambda v: tuple(c.goal for c in v.checkpoints), lambda v: tuple(texts_of(v))):
            assert len({fact(variant) for variant in drawn}) == len(drawn)
        problem = parse_bddl(task.bddl_text)
        for variant in drawn:
            assert (variant.operations, variant.init) == (task.operations, task.init)
            for goal in (variant.goal, *(checkpoint.goal for checkpoint in variant.checkpoints)):
                assert problem.resolve(goal, task.name) == goal
            progress = Progress(variant)
            progress.step(set(task.init).__contains__)
            assert not progress.success
            assert not any(progress.satisfied)
            if task.memory_type == "procedural":
                if variant.goal != task.goal or task.num_variants == len(drawn):
                    parts = (variant.goal, *getattr(variant.goal, "children", ()))
                    assert any(isinstance(part, Then) for part in parts)
                wanted = [atom for checkpoint in variant.checkpoints for atom in atoms(checkpoint.goal)]
                assert list(atoms(variant.goal)) == wanted
            if variant.prompt is not None and variant.prompt.target is not None:
                named = {arg for atom in atoms(variant.checkpoints[0].goal) for arg in atom.args}
                assert variant.prompt.target in named


def test_left_and_right_are_those_of_the_camera() -> None:
    """The third-person camera looks along -x, so +y is on the right."""
    for name in (
        "put_the_butter_into_the_bowl_from_the_prompt_video",
        "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
        "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video",
    ):
        task = get_task(name)
        place = {atom.args[0]: task.regions[atom.args[1]].ranges[0] for atom in task.init}
        for variant in map(task.variant, range(task.num_variants)):
            moved = variant.prompt.target if variant.prompt else None
            moved = moved or next(atoms(variant.checkpoints[0].goal)).args[0]
            y = sum(place[moved][1::2]) / 2
            text = variant.checkpoints[0].language[1].split(" into ")[0 if "stack" in name else -1]
            side = "right" if y > 0.1 else "left" if y < -0.1 else None
            assert [word for word in ("left", "right") if word in text] == ([side] if side else [])


def test_tasks_are_selected_by_type_name_number_and_range() -> None:
    assert resolve_tasks("all") == task_names()
    assert resolve_tasks("spatial") == task_names("spatial")
    assert resolve_tasks(f" {STOVE} , object,{STOVE}") == [STOVE, *task_names("object")]
    assert resolve_tasks(f"{STOVE},{COMMAS},temporal")[:2] == [STOVE, COMMAS]
    for suite in SUITES:
        names = task_names(suite=suite)
        assert [task_number(name) for name in names] == list(range(1, 31))
        assert resolve_tasks("all", suite) == names
        assert resolve_tasks("30, 1-3,object,2", suite) == [names[29], *names[:3], *task_names("object", suite)]
    assert task_names(suite=None) == task_names() + task_names(suite=STRICT)
    assert (suite_of(STOVE), suite_of("another")) == ("published", None)


@pytest.mark.parametrize(
    ("spec", "suite", "named"),
    [
        (" ", "published", "tasks"),
        ("12,,3", "published", "'12,,3'"),
        ("4-3", "published", "reversed"),
        ("0", "published", "1 to 30"),
        ("object, all", "published", "'all'"),
        ("spatial,temporl", "published", "'temporal'"),
        (task_names(suite=STRICT)[3], "published", "suite=strict"),
        (f"object,{STOVE}", STRICT, "suite=published"),
    ],
)
def test_invalid_selection_names_the_entry(spec: str | list[str], suite: str, named: str) -> None:
    with pytest.raises(MemobenchError) as error:
        resolve_tasks(spec, suite)
    assert named in str(error.value)


# --- the reference facts next to the checkout ---


def test_facts_equal_the_published_ones(published: Path) -> None:
    facts = published.parent
    known = {task["name"]: task for task in json.loads((facts / "spec" / "catalogue.json").read_text())}
    records = [task_record(task, known[task.name]["state_dim"]) for task in tasks()]
    check = subprocess.run(
        [sys.executable, str(facts / "tools" / "check_catalogue.py")],
        input=json.dumps(records),
        capture_output=True,
        text=True,
        check=False,
    )
    assert check.returncode == 0, check.stdout + check.stderr
    for task in tasks():
        fact = known[task.name]
        assert task.family == fact["family"]
        operations = [checkpoint["operation_by_level"] for checkpoint in fact["checkpoints"]]
        assert ["".join(c.operations_by_level) for c in task.checkpoints] == operations


def test_scenes_equal_the_published_ones_and_texts_do_not(published: Path) -> None:
    def plain(text: str) -> str:
        return " ".join("".join(c for c in text.lower() if c.isalnum() or c == " ").split())

    folders = {task: published / task.memory_type / task.name for task in tasks()}
    others = {task: load_task(folder) for task, folder in folders.items() if (folder / METADATA_FILE).is_file()}
    theirs = {plain(text) for other in others.values() for text in texts_of(other)}
    for task, other in others.items():
        for key in ("language", "objects", "fixtures", "regions", "init", "objects_of_interest", "goal"):
            assert getattr(task, key) == getattr(other, key), (task.name, key)
        assert [c.goal for c in task.checkpoints] == [c.goal for c in other.checkpoints]
        for text in (text for k in range(task.num_variants) for text in texts_of(task.variant(k))):
            assert plain(text) not in theirs, (task.name, text)
