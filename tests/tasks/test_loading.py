"""Loading task folders, ours and published ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.tasks.formula import And, Atom
from lerobot_memobench.tasks.task import MEMORY_TYPES, Prompt

Write = Callable[..., Path]


def test_loads_a_folder_in_the_published_format(write_task: Write) -> None:
    task = load_task(write_task(parent="temporal"))
    assert (task.name, task.memory_type, task.family) == ("my_task", "temporal", "unspecified")
    assert task.operations == "SC"
    assert task.checkpoints[1].operations_by_level == ("U", "C", "U")
    assert task.checkpoints[1].language == ("d", "e", "f")
    assert task.checkpoints[0].goal == And((Atom("wasopen", ("box_1_top_region",)),))
    assert task.prompt is None
    assert (task.num_variants, task.random_variants, task.demo_summary) == (1, (0,), "")
    assert task.variant(0) is task


@pytest.mark.parametrize(
    ("language", "goal", "expected"),
    [
        ("put the cup away", "(In cup_1 box_1_top_region)", "spatial"),
        ("open the drawer", "(WasOpen box_1_top_region)", "temporal"),
        ("put the cup from the prompt video away", "(In cup_1 box_1_top_region)", "object"),
        ("take the cup pointed out in the video", "(In cup_1 box_1_top_region)", "object"),
        ("follow the prompt video", "(In cup_1 box_1_top_region)", "procedural"),
        ("do the 3-step sequence shown in the prompt", "(In cup_1 box_1_top_region)", "procedural"),
    ],
)
def test_memory_type_is_inferred(write_task: Write, bddl: str, language: str, goal: str, expected: str) -> None:
    bddl = bddl.replace("put the cup, the red one, into the drawer", language)
    bddl = bddl.replace("(And (In cup_1 box_1_top_region) (Not (Open box_1_top_region)))", goal)
    assert load_task(write_task(bddl)).memory_type == expected
    assert load_task(write_task(bddl, parent="spatial")).memory_type == "spatial"


@pytest.mark.parametrize(
    ("language", "kind"),
    [
        ("stow the cup picked up in the prompt video", "pick"),
        ("stow the cup pointed out in the prompt video", "point"),
        ("stow the cup from the place highlighted in the prompt video", "highlight"),
        ("stow the cup from the prompt video", "routine"),
    ],
)
def test_prompt_is_inferred(write_task: Write, bddl: str, language: str, kind: str) -> None:
    bddl = bddl.replace("put the cup, the red one, into the drawer", language)
    assert load_task(write_task(bddl, parent="object")).prompt == Prompt(kind, "cup_1")  # type: ignore[arg-type]
    assert load_task(write_task(bddl, parent="temporal")).prompt is None
    if kind == "routine":
        assert load_task(write_task(bddl, parent="procedural")).prompt == Prompt("routine", None)


def test_referent_is_the_object_that_has_siblings(write_task: Write, bddl: str, metadata: dict[str, Any]) -> None:
    metadata["subtask_goals"][0] = ["on", "lid,v1.2", "cup_2"]
    prompt = load_task(write_task(bddl, metadata, parent="object")).prompt
    assert prompt == Prompt("routine", "cup_2")


# --- missing or malformed files ---


def test_missing_metadata_names_file_and_content(write_task: Write, bddl: str) -> None:
    folder = write_task(bddl, None)
    with pytest.raises(MemobenchError) as error:
        load_task(folder)
    for words in (
        str(folder / "task_config.meta.json"),
        "missing",
        "memory",
        "operating_type",
        "subtask_goals",
    ):
        assert words in str(error.value)
    task = load_task(folder, require_metadata=False)
    assert (task.checkpoints, task.operations, task.metadata) == ((), "", {})
    assert load_task(write_task(), require_metadata=False).operations == "SC"


def test_missing_folder_and_bddl(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="not a folder"):
        load_task(tmp_path / "nowhere")
    with pytest.raises(MemobenchError, match=r"task_config\.bddl is missing"):
        load_task(tmp_path)
    (tmp_path / "task_config.bddl").mkdir()
    with pytest.raises(MemobenchError, match="cannot be read"):
        load_task(tmp_path)


def test_bytes_that_are_no_text(write_task: Write) -> None:
    folder = write_task()
    (folder / "task_config.bddl").write_bytes(b"(define \xff")
    with pytest.raises(MemobenchError, match="offset 8"):
        load_task(folder)


# --- the published folders ---


def test_every_published_folder_loads(published: Path) -> None:
    folders = sorted(path for path in published.glob("*/*") if path.is_dir())
    assert len(folders) == 30
    lacking = []
    for folder in folders:
        if not (folder / "task_config.meta.json").exists():
            lacking.append(folder.name)
            with pytest.raises(MemobenchError, match=r"task_config\.meta\.json is missing"):
                load_task(folder)
        task = load_task(folder, require_metadata=False)
        assert task.memory_type == folder.parent.name
        assert (task.prompt is None) == (task.memory_type in ("temporal", "spatial"))
        assert task.num_variants == 1
    assert lacking == ["turn_on_the_stove_and_turn_it_off_near_the_shelf"]


def test_published_folders_elsewhere_get_the_same_memory_type(published: Path, tmp_path: Path) -> None:
    for folder in published.glob("*/*"):
        if (folder / "task_config.meta.json").is_file():
            copy = tmp_path / "x" / folder.name
            copy.mkdir(parents=True)
            for file in folder.iterdir():
                (copy / file.name).write_bytes(file.read_bytes())
            assert load_task(copy).memory_type == folder.parent.name
            assert folder.parent.name in MEMORY_TYPES


def test_inferred_prompts_equal_the_catalogues(published: Path) -> None:
    from lerobot_memobench.tasks.catalogue import get_task

    for folder in published.glob("*/*"):
        if folder.parent.name in ("object", "procedural"):
            assert load_task(folder).prompt == get_task(folder.name).prompt


def test_metadata_is_kept_as_read(write_task: Write) -> None:
    folder = write_task()
    assert load_task(folder).metadata == json.loads((folder / "task_config.meta.json").read_text())
