"""Loading task folders, ours and published ones, and their variants."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import And, Atom, format_formula
from lerobot_memobench.tasks.formula_parsing import parse_formula
from lerobot_memobench.tasks.loading import load_task
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


def test_equal_hashable_and_picklable(write_task: Write) -> None:
    folder = write_task()
    task, again = load_task(folder), load_task(str(folder))
    assert task == again
    assert hash(task) == hash(again)
    assert pickle.loads(pickle.dumps(task)) == task  # noqa: S301 - our own bytes, as worker processes do


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


def test_own_keys(write_task: Write, metadata: dict[str, Any]) -> None:
    metadata |= {
        "memory_type": "object",
        "family": "mine",
        "prompt": {"kind": "pick", "target": "cup_1"},
        "timestep_exec_start_idx": [-1],
        "demo_summary": "Stow the cup.",
        "note": {"kept": True},
    }
    task = load_task(write_task(metadata=metadata, parent="spatial"))
    assert (task.memory_type, task.family, task.demo_summary) == ("object", "mine", "Stow the cup.")
    assert task.prompt == Prompt("pick", "cup_1")
    assert task.metadata["note"] == {"kept": True}
    metadata["prompt"] = None
    assert load_task(write_task(metadata=metadata)).prompt is None


def test_variants(write_task: Write, metadata: dict[str, Any]) -> None:
    metadata["prompt"] = {"kind": "pick", "target": "cup_1"}
    texts = [["g", "h", "i"], ["j", "k", "l"]]
    metadata["variants"] = [
        {
            "substitute": {"cup_1": "cup_2", "cup_2": "cup_1"},
            "memory": texts,
            "demo_summary": "The other cup.",
        },
        {
            "order": [1, 0],
            "goal": {"then": [["open", "box_1_top_region"], ["close", "box_1_top_region"]]},
            "memory": texts,
        },
        {"subtask_goals": [["open", "box_1_top_region"], ["on", "cup_2", "cup_1"]], "memory": texts},
    ]
    task = load_task(write_task(metadata=metadata))
    assert (task.num_variants, task.random_variants) == (4, (0, 1, 2, 3))
    other = task.variant(1)
    assert format_formula(other.goal) == "(And (In cup_2 box_1_top_region) (Not (Open box_1_top_region)))"
    assert other.checkpoints[1].goal == parse_formula({"and": ["in", "cup_2", "box_1_top_region"]})
    assert other.checkpoints[1].language == ("j", "k", "l")
    assert other.prompt == Prompt("pick", "cup_2")
    assert (other.demo_summary, other.operations, other.variant_index) == ("The other cup.", "SC", 1)
    assert other != task
    assert (other.name, other.language, other.init) == (task.name, task.language, task.init)
    assert other.variant(0) is task
    assert other.variant(2) == task.variant(2)
    turned = task.variant(2)
    assert [c.goal for c in turned.checkpoints] == [c.goal for c in reversed(task.checkpoints)]
    assert turned.operations == task.operations  # labels belong to the position in the routine
    assert format_formula(turned.goal) == "(Then (Open box_1_top_region) (Close box_1_top_region))"
    assert turned.prompt == task.prompt
    assert task.variant(3).checkpoints[1].goal == Atom("on", ("cup_2", "cup_1"))
    assert task.variant(3).goal == task.goal
    for k in (-1, 4):
        with pytest.raises(MemobenchError, match="variants 0 to 3"):
            task.variant(k)
    metadata["variants"][1]["replaces_published"] = True
    assert load_task(write_task(metadata=metadata)).random_variants == (1, 2, 3)


# --- what is missing or malformed ---


def test_missing_metadata_tells_file_and_content(write_task: Write, bddl: str) -> None:
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


@pytest.mark.parametrize("key", ["memory", "operating_type", "subtask_goals"])
def test_missing_key(write_task: Write, metadata: dict[str, Any], key: str) -> None:
    del metadata[key]
    with pytest.raises(MemobenchError, match=rf"meta\.json lacks '{key}', expected an object that holds"):
        load_task(write_task(metadata=metadata))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"subtask_goals": []}, "at least one formula"),
        ({"subtask_goals": {"and": []}}, "at least one formula"),
        ({"subtask_goals": [["open", "box_1"]]}, "a list of 1 entries"),
        (
            {"subtask_goals": [["open", "box_1"], ["open", "box_2"]]},
            "subtask_goals[1]: found the name 'box_2'",
        ),
        ({"subtask_goals": [["open", "box_1"], 5]}, "subtask_goals[1]: found 5"),
        ({"operating_type": [[0, 0, 0]]}, "a list of 2 entries"),
        ({"operating_type": [[0, 0, 0], [0, 0]]}, "operating_type[1] = [0, 0], expected three labels"),
        ({"operating_type": [[0, 0, 0], [0, 0, 3]]}, "each 0, 1 or 2"),
        ({"operating_type": [[0, 0, 0], [0, 0, True]]}, "each 0, 1 or 2"),
        ({"operating_type": [[0, 0, 0], 1]}, "each 0, 1 or 2"),
        ({"memory": [["a", "b", "c"]]}, "memory = [['a', 'b', 'c']], expected a list of 2 entries"),
        ({"memory": [["a", "b", "c"], ["a", "b"]]}, "memory[1]"),
        ({"memory": [["a", "b", "c"], ["a", "b", " "]]}, "three texts"),
        ({"memory": [["a", "b", "c"], ["a", "b", 3]]}, "three texts"),
        ({"memory": "abc"}, "a list of 2 entries"),
        ({"key_frame": [-1]}, "a list of 2 integers"),
        ({"key_frame": [-1, 0.5]}, "a list of 2 integers"),
        ({"timestep_exec_start_idx": "0"}, "an integer or a list of integers"),
        ({"demo_summary": ["a"]}, "demo_summary = ['a'], expected text"),
        ({"memory_type": "episodic"}, "expected one of temporal, spatial, object, procedural"),
        ({"memory_type": ["temporal"]}, "expected one of"),
        ({"family": 1}, "expected text"),
        ({"prompt": "pick"}, 'expected null or {"kind"'),
        ({"prompt": {"kind": "pick", "target": "cup_1", "x": 1}}, 'expected null or {"kind"'),
        ({"prompt": {"kind": "grab", "target": "cup_1"}}, "one of routine, pick, point, highlight"),
        ({"prompt": {"kind": "pick"}}, "the object that a prompt of kind 'pick' shows"),
        ({"prompt": {"kind": "pick", "target": "cup_9"}}, "a name that the BDDL file declares"),
        ({"prompt": {"kind": "pick", "target": ["cup_1"]}}, "a name that the BDDL file declares"),
        ({"variants": {}}, "a list of objects"),
        ({"variants": [{}]}, "an object with 'memory'"),
        ({"variants": [{"memory": []}]}, "variants[0].memory"),
        ({"variants": [{"memory": "M", "swap": 1}]}, "an object with 'memory'"),
        ({"variants": [{"memory": "M", "substitute": []}]}, "an object of names to names"),
        ({"variants": [{"memory": "M", "substitute": {"cup_1": "cup_7"}}]}, "substitute['cup_1'] = 'cup_7'"),
        (
            {"variants": [{"memory": "M", "substitute": {"cup_1": "box_1_top_region"}}]},
            "expected object or fixture",
        ),
        ({"variants": [{"memory": "M", "order": [0, 0]}]}, "each of 0 to 1 once"),
        ({"variants": [{"memory": "M", "order": "01"}]}, "each of 0 to 1 once"),
        (
            {"variants": [{"memory": "M", "goal": ["open", "nothing"]}]},
            "variants[0].goal: found the name 'nothing'",
        ),
        ({"variants": [{"memory": "M", "subtask_goals": []}]}, "a list of 2 formulas"),
        ({"variants": [{"memory": "M", "replaces_published": 1}]}, "true or false"),
        ({"variants": [{"memory": "M", "demo_summary": 1}]}, "expected text"),
    ],
)
def test_malformed_metadata_is_one_clear_error(
    write_task: Write, metadata: dict[str, Any], change: dict[str, Any], words: str
) -> None:
    for variant in change.get("variants", []):
        if variant.get("memory") == "M":
            variant["memory"] = metadata["memory"]
    folder = write_task(metadata=metadata | change)
    with pytest.raises(MemobenchError) as error:
        load_task(folder)
    message = str(error.value)
    assert message.startswith(str(folder / "task_config.meta.json"))
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1: found no valid JSON"),
        ('{"memory": [\n}', "line 2: found no valid JSON"),
        ("[]", "expected a JSON object"),
        ("null", "expected a JSON object"),
        ('{"memory": 1, "memory": 2}', "the key 'memory' twice"),
        ("[" * 100_000, "JSON"),
        ('{"a": ' + "9" * 5000 + "}", "JSON that cannot be read"),
    ],
)
def test_metadata_that_is_no_json_object(write_task: Write, text: str, words: str) -> None:
    with pytest.raises(MemobenchError) as error:
        load_task(write_task(metadata=text))
    assert words in str(error.value)


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
