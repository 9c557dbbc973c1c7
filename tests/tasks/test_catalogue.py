"""The catalogue: 30 tasks, facts as published, texts of our own."""

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
    task_index,
    task_names,
    task_number,
    task_record,
)
from lerobot_memobench.tasks.formula import Then, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import MEMORY_TYPES, SUITES, Task

COMMAS = "follow_the_prompt_to_determine_the_items,_discard_the_waste_first,_then_plate_the_remaining_item"


def tasks() -> list[Task]:
    return [get_task(name) for name in task_names()]


def everything_said(task: Task) -> list[str]:
    return [task.demo_summary, *(text for checkpoint in task.checkpoints for text in checkpoint.language)]


def test_size_and_order() -> None:
    assert len(task_names()) == 30
    assert Counter(task.memory_type for task in tasks()) == dict(zip(MEMORY_TYPES, (10, 10, 5, 5), strict=True))
    operations = Counter("".join(task.operations for task in tasks()))
    assert operations == {"S": 35, "U": 32, "C": 17}
    keys = [(MEMORY_TYPES.index(task.memory_type), task.name) for task in tasks()]
    assert keys == sorted(keys)
    assert [task_index(name) for name in task_names()] == list(range(30))
    assert len({c for t in tasks() for c in t.objects.values()}) == 29
    assert len({c for t in tasks() for c in t.fixtures.values()}) == 5


def test_every_task_is_complete() -> None:
    for task in tasks():
        assert task.folder.parent.name == task.memory_type
        assert task.family != "unspecified"
        assert (task.prompt is None) == (task.memory_type in ("temporal", "spatial"))
        assert all(text == " ".join(text.split()) and text for text in everything_said(task))
        for coarse, intermediate, fine in (checkpoint.language for checkpoint in task.checkpoints):
            assert len(coarse) <= len(intermediate) + 12
            assert len(intermediate) < len(fine)
        assert get_task(task.name) is task


def test_variants_of_the_catalogue() -> None:
    expected = {
        "put_the_butter_into_the_bowl_from_the_prompt_video": 3,
        "put_the_butter_picked_up_in_the_prompt_video_on_the_plate": 9,
        "put_the_milk_picked_up_in_the_prompt_video_on_the_plate": 9,
        "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video": 6,
        "execute_the_assembly_procedure_demonstrated_in_the_prompt_video": 2,
    }
    for task in tasks():
        prompted = task.memory_type in ("object", "procedural")
        assert len(task.random_variants) == expected.get(task.name, 2 if prompted else 1)
        drawn = [task.variant(k) for k in task.random_variants]
        # What the video shows decides: no two draws share goal, checkpoints or texts.
        assert len({variant.goal for variant in drawn}) == len(drawn)
        assert len({tuple(c.goal for c in variant.checkpoints) for variant in drawn}) == len(drawn)
        assert len({tuple(everything_said(variant)) for variant in drawn}) == len(drawn)
        for variant in drawn:
            assert variant.operations == task.operations
            assert variant.init == task.init
            problem = parse_bddl(task.bddl_text)
            for checkpoint in variant.checkpoints:
                problem.resolve(checkpoint.goal, task.name)
            problem.resolve(variant.goal, task.name)
            progress = Progress(variant)
            progress.step(set(task.init).__contains__)
            assert not progress.success
            assert not any(progress.satisfied)  # nothing is complete from the start
            if task.memory_type == "procedural":
                if variant.goal != task.goal or task.num_variants == len(drawn):
                    assert any(
                        isinstance(node, Then) for node in (variant.goal, *getattr(variant.goal, "children", ()))
                    )
                # The goal asks for the checkpoints' atoms in the checkpoints' order.
                wanted = [atom for checkpoint in variant.checkpoints for atom in atoms(checkpoint.goal)]
                assert list(atoms(variant.goal)) == wanted
            if variant.prompt is not None and variant.prompt.target is not None:
                named = {arg for atom in atoms(variant.checkpoints[0].goal) for arg in atom.args}
                assert variant.prompt.target in named


def test_sides_are_the_cameras() -> None:
    """The third-person camera looks along -x, so +y is right in its image and in our texts."""
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
            said = variant.checkpoints[0].language[1].split(" into ")[0 if "stack" in name else -1]
            side = "right" if y > 0.1 else "left" if y < -0.1 else None
            assert [word for word in ("left", "right") if word in said] == ([side] if side else [])


def test_names_and_resolution() -> None:
    stove = "turn_on_the_stove_and_turn_it_off"
    assert resolve_tasks("all") == task_names()
    assert resolve_tasks("spatial") == task_names("spatial") == task_names(["spatial"])
    assert task_names(["object", "temporal"]) == task_names("temporal") + task_names("object")
    assert resolve_tasks(f" {stove} , object,{stove}") == [stove, *task_names("object")]
    assert resolve_tasks(f"{stove},{COMMAS},temporal")[:2] == [stove, COMMAS]
    assert resolve_tasks([COMMAS, "object"]) == [COMMAS, *task_names("object")]
    for suite in SUITES:
        names = task_names(suite=suite)
        assert [task_number(name) for name in names] == list(range(1, 31))
        assert resolve_tasks("30, 1-3,object,2", suite) == [names[29], *names[:3], *task_names("object", suite)]


@pytest.mark.parametrize(
    ("spec", "fragment"),
    [
        (" ", "nothing"),
        ("12,,3", "'12,,3'"),
        ("object,", "'object,'"),
        ("4-3", "4-3 among the tasks; the range is reversed"),
        ("object,3-", "3- among the tasks; this is not a complete range"),
        ("1-3-5", "not a complete range"),
        ("3 - 7", "not a complete range"),
        ("0", "numbered 1 to 30"),
        ("28-31", "numbered 1 to 30"),
        ("object, all", "either 'all' or the others"),
        (["12", "all"], "either 'all' or the others"),
        ("spatial,temporl", "did you mean 'temporal'"),
    ],
)
def test_an_invalid_list_of_tasks_names_the_entry(spec: str | list[str], fragment: str) -> None:
    with pytest.raises(MemobenchError) as error:
        resolve_tasks(spec)
    assert fragment in str(error.value)


def test_unknown_names_suggest_the_nearest() -> None:
    with pytest.raises(MemobenchError, match="did you mean 'turn_on_the_stove_and_turn_it_off'"):
        get_task("turn_on_the_stove_and_turn_of")
    with pytest.raises(MemobenchError, match="'episodic'"):
        task_names("episodic")
    with pytest.raises(MemobenchError, match="'nothing'"):
        task_index("nothing")


def test_record_is_json() -> None:
    record = task_record(get_task(COMMAS), 71)
    assert json.loads(json.dumps(record)) == record
    assert record["goal"] == ["then", ["on", "milk_1", "bowl_1"], ["on", "butter_1", "plate_1"]]
    assert record["objects"]["akita_black_bowl"] == ["bowl_1"]
    assert [checkpoint["operation"] for checkpoint in record["checkpoints"]] == ["S", "U"]
    assert record["state_dim"] == 71


# --- against the reference facts beside the checkout ---


def test_facts_are_the_published_ones(facts: Path) -> None:
    published = {task["name"]: task for task in json.loads((facts / "spec" / "catalogue.json").read_text())}
    records = [task_record(task, published[task.name]["state_dim"]) for task in tasks()]
    check = subprocess.run(
        [sys.executable, str(facts / "tools" / "check_catalogue.py")],
        input=json.dumps(records),
        capture_output=True,
        text=True,
        check=False,
    )
    assert check.returncode == 0, check.stdout + check.stderr
    for task in tasks():
        fact = published[task.name]
        assert task.family == fact["family"]
        assert ["".join(c.operations_by_level) for c in task.checkpoints] == [
            c["operation_by_level"] for c in fact["checkpoints"]
        ]


def test_scenes_are_the_published_ones(published: Path) -> None:
    for task in tasks():
        other = load_task(published / task.memory_type / task.name, require_metadata=False)
        for key in ("language", "objects", "fixtures", "regions", "init", "objects_of_interest", "goal"):
            assert getattr(task, key) == getattr(other, key), (task.name, key)
        if other.checkpoints:
            assert [c.goal for c in task.checkpoints] == [c.goal for c in other.checkpoints]


def test_texts_are_our_own(published: Path) -> None:
    def plain(text: str) -> str:
        return " ".join("".join(c for c in text.lower() if c.isalnum() or c == " ").split())

    theirs = {
        plain(text)
        for folder in published.glob("*/*")
        for text in everything_said(load_task(folder, require_metadata=False))
    }
    for task in tasks():
        for k in range(task.num_variants):
            for text in everything_said(task.variant(k)):
                assert plain(text) not in theirs, (task.name, text)
