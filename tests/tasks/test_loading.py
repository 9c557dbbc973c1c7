"""Task folders: BDDL and metadata files, inferred values, malformed files, the published folders."""

from __future__ import annotations

import json
import pickle
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.bddl import Region, parse_bddl
from lerobot_memobench.tasks.catalogue import find_tasks, get_task, load_task, task_names
from lerobot_memobench.tasks.formula import And, Atom, Not, format_formula
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Prompt
from tests.support import mutations
from tests.support.scripts import load_script

format_bddl = load_script("strict_suite/bddl_text").format_bddl
Write = Callable[..., Path]
DRAWER = "box_1_top_region"
LANGUAGE, GOAL = "put the cup, the red one, into the drawer", f"(And (In cup_1 {DRAWER}) (Not (Open {DRAWER})))"

# --- BDDL ---


def test_bddl_is_parsed_in_any_case_and_written_again(bddl: str) -> None:
    problem = parse_bddl(bddl)
    assert (problem.name, problem.domain, problem.language) == ("KITCHEN", "robosuite", LANGUAGE)
    assert problem.objects == {"cup_1": "cup", "cup_2": "cup", "lid,v1.2": "lid"}
    assert list(problem.fixtures) == ["table_1", "box_1"]
    place = Region("cup_place", "table_1", ((0.0, 0.0, 0.1, 0.1), (0.2, 0.2, 0.3, 0.3)), (0.0, 1.5))
    assert problem.regions["table_1_cup_place"] == place
    assert problem.regions[DRAWER] == Region("top_region", "box_1")
    assert problem.objects_of_interest == ("cup_1", "box_1")
    assert problem.init[3:] == (Atom("on", ("lid,v1.2", "cup_2")), Atom("close", (DRAWER,)))
    assert problem.goal == And((Atom("in", ("cup_1", DRAWER)), Not(Atom("open", (DRAWER,)))))
    words = "define|problem|:domain|:regions|:target|:ranges|:goal|And|In|Not|On"
    shouted = re.sub(rf"\(({words})\b", lambda found: found[0].upper(), bddl).replace("(IN cup_1", "(IN CUP_1")
    assert parse_bddl(shouted) == problem
    assert parse_bddl(format_bddl(problem, "a comment (with parentheses)")) == problem
    for name in task_names(suite=None):
        text = get_task(name).bddl_text
        assert parse_bddl(format_bddl(parse_bddl(text))) == parse_bddl(text)


def test_unused_region_on_an_undeclared_target_is_accepted(bddl: str) -> None:
    """LIBERO's ten goal tasks declare such a region of a drainer."""
    libero = bddl.replace("(top_region", "(right_region (:target Drainer_1))\n    (top_region")
    problem = parse_bddl(libero)
    assert problem.regions == parse_bddl(bddl).regions
    used = libero.replace(f"(Not (Open {DRAWER}))", "(On cup_1 drainer_1_right_region)")
    with pytest.raises(MemobenchError, match=r"^a\.bddl, line 7: .*'Drainer_1'"):
        parse_bddl(used, "a.bddl")
    with pytest.raises(MemobenchError, match="right_region"):
        problem.resolve(Atom("on", ("cup_1", "drainer_1_right_region")), "a.json")


MALFORMED_BDDL = [
    # (text, replacement, line of the error, word in the message)
    ("(problem KITCHEN)", "(problem)", 1, "problem"),
    ("(:domain robosuite)", "(:domian robosuite)", 2, ":domian"),
    ("(:domain robosuite)", "(:domain robosuite) (:domain robosuite)", 2, "second :domain"),
    (LANGUAGE, "", 3, ":language"),
    ("(cup_place (:target table_1)", "(cup_place (:target tabel_1)", 5, "'table_1'"),
    ("(cup_place (:target table_1)", "(cup_place (:target table_1) (:target table_1)", 5, "second :target"),
    ("lid,v1.2 - lid", "lid,v1.2 (- lid)", 15, "list"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 -0.2 0.0))", 6, "x1 <= x2"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 nan 0.0))", 6, "finite"),
    (" (:ranges ((-0.1 -0.1 0.0 0.0)))", "", 19, ":ranges"),
    ("(box_place", "(cup_place", 6, "again"),
    ("table_1 - kitchen_table", "table_1 - kitchen_table Table_1 - shelf", 10, "'Table_1'"),
    ("(:obj_of_interest cup_1", "(:obj_of_interest cup_3", 17, "'cup_3'"),
    ("    (On cup_1 table_1_cup_place)\n", "", 18, "'cup_1'"),
    ("(On cup_1 table_1_cup_place)", "(On cup_1 table_1_cup_place) (On cup_1 cup_2)", 20, "'cup_1'"),
    ("(On cup_2 table_1_cup_place)", "(On cup_2 lid,v1.2)", 18, "itself"),
    ("(On cup_2 table_1_cup_place)", "(Not (On cup_2 table_1_cup_place))", 21, ":init"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 top_region)", 25, "'top_region'"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 box_1_top_region", 1, "never closed"),
    ("(Not (Open box_1_top_region))", "(Not " * 5_000 + "(Open box_1)" + ")" * 5_000, 25, "nested"),
    ("(define", "(" * 50_000 + "define", 1, "never closed"),
]


@pytest.mark.parametrize(
    ("old", "new", "line", "word"), MALFORMED_BDDL, ids=[str(k) for k in range(len(MALFORMED_BDDL))]
)
def test_malformed_bddl_names_file_line_and_item(bddl: str, old: str, new: str, line: int, word: str) -> None:
    assert old in bddl
    with pytest.raises(MemobenchError) as error:
        parse_bddl(bddl.replace(old, new, 1), "some/file.bddl")
    message = str(error.value)
    assert message.startswith(f"some/file.bddl, line {line}: found ")
    assert word in message
    assert "\n" not in message


# --- metadata ---


def test_folder_in_the_published_format(write_task: Write) -> None:
    folder = write_task(parent="temporal")
    task = load_task(folder)
    assert (task.name, task.memory_type, task.family) == ("my_task", "temporal", "unspecified")
    assert task.operations == "SC"
    assert task.checkpoints[1].operations_by_level == ("U", "C", "U")
    assert task.checkpoints[1].language == ("d", "e", "f")
    assert task.checkpoints[0].goal == And((Atom("wasopen", (DRAWER,)),))
    assert (task.prompt, task.num_variants, task.random_variants, task.demo_summary) == (None, 1, (0,), "")
    assert task.variant(0) is task
    assert task.metadata == json.loads((folder / "task_config.meta.json").read_text())
    again = load_task(str(folder))
    assert task == again == pickle.loads(pickle.dumps(task))  # noqa: S301
    assert hash(task) == hash(again)


def test_variants_replace_goals_texts_and_prompt(write_task: Write, metadata: dict[str, Any]) -> None:
    metadata["prompt"] = {"kind": "pick", "target": "cup_1"}
    texts = [["g", "h", "i"], ["j", "k", "l"]]
    swap = {"cup_1": "cup_2", "cup_2": "cup_1"}
    metadata["variants"] = [
        {"substitute": swap, "memory": texts, "demo_summary": "The other cup."},
        {"order": [1, 0], "goal": {"then": [["open", DRAWER], ["close", DRAWER]]}, "memory": texts},
        {"subtask_goals": [["open", DRAWER], ["on", "cup_2", "cup_1"]], "memory": texts, "language": "other"},
    ]
    task = load_task(write_task(metadata=metadata))
    first, second, third = (task.variant(k) for k in (1, 2, 3))
    assert (task.num_variants, task.random_variants) == (4, (0, 1, 2, 3))
    assert format_formula(first.goal) == f"(And (In cup_2 {DRAWER}) (Not (Open {DRAWER})))"
    assert first.checkpoints[1].goal == And((Atom("in", ("cup_2", DRAWER)),))
    assert first.checkpoints[1].language == ("j", "k", "l")
    assert (first.prompt, first.demo_summary) == (Prompt("pick", "cup_2"), "The other cup.")
    assert (first.name, first.language, first.init, first.variant_index) == (task.name, task.language, task.init, 1)
    assert first != task
    assert first.variant(0) is task
    assert first.variant(2) == second
    assert [each.goal for each in second.checkpoints] == [each.goal for each in reversed(task.checkpoints)]
    assert second.operations == task.operations, "labels belong to positions"
    assert format_formula(second.goal) == f"(Then (Open {DRAWER}) (Close {DRAWER}))"
    assert third.checkpoints[1].goal == Atom("on", ("cup_2", "cup_1"))
    assert (third.goal, third.prompt, third.language) == (task.goal, task.prompt, "other")
    for k in (-1, 4):
        with pytest.raises(MemobenchError, match="0 to 3"):
            task.variant(k)
    metadata["variants"][1]["replaces_published"] = True
    assert load_task(write_task(metadata=metadata)).random_variants == (1, 2, 3)


MALFORMED_METADATA: list[tuple[dict[str, Any], str]] = [
    *(({key: None}, key) for key in ("memory", "operating_type", "subtask_goals")),
    ({"subtask_goals": {"and": []}}, "subtask_goals"),
    ({"subtask_goals": [["open", "box_1"]]}, "1 entries"),
    ({"subtask_goals": [["open", "box_1"], ["open", "box_2"]]}, "subtask_goals[1]"),
    ({"operating_type": [[0, 0, 0], [0, 0, 3]]}, "operating_type[1][2]"),
    ({"memory": [["a", "b", "c"], ["a", "b"]]}, "memory[1]"),
    ({"memory_type": "episodic"}, "memory_type"),
    ({"prompt": {"kind": "pick", "target": "cup_9"}}, "prompt.target"),
    ({"prompt": {"kind": "pick", "target": "cup_1", "x": 1}}, "prompt"),
    ({"prompt": {"kind": "hide", "places": [["cup_1", "box_1"]]}}, "prompt.places"),
    ({"variants": [{"memory": "M", "substitute": {"cup_1": "cup_7"}}]}, "variants[0].substitute['cup_1']"),
    ({"variants": [{"memory": "M", "order": [0, 0]}]}, "variants[0].order"),
    ({"variants": [{"memory": "M", "goal": ["open", "nowhere"]}]}, "variants[0].goal"),
    ({"variants": [{"memory": "M", "replaces_published": 1}]}, "variants[0].replaces_published"),
]


@pytest.mark.parametrize(("change", "key"), MALFORMED_METADATA, ids=map(str, range(len(MALFORMED_METADATA))))
def test_malformed_metadata_names_file_and_key(
    write_task: Write, metadata: dict[str, Any], change: dict[str, Any], key: str
) -> None:
    for variant in change["variants"] if isinstance(change.get("variants"), list) else []:
        if variant.get("memory") == "M":
            variant["memory"] = metadata["memory"]
    found = {name: value for name, value in (metadata | change).items() if value is not None}
    folder = write_task(metadata=found)
    with pytest.raises(MemobenchError) as error:
        load_task(folder)
    message = str(error.value)
    assert message.startswith(str(folder / "task_config.meta.json"))
    assert key in message
    assert "\n" not in message


@pytest.mark.parametrize("text", ["", '{"memory": [\n}', "[]", "null", "[" * 100_000, '{"a": ' + "9" * 5000 + "}"])
def test_metadata_that_is_no_json_object_names_its_file(write_task: Write, text: str) -> None:
    with pytest.raises(MemobenchError, match=r"task_config\.meta\.json"):
        load_task(write_task(metadata=text))


def test_missing_and_unreadable_files_are_named(write_task: Write, bddl: str, tmp_path: Path) -> None:
    folder = write_task(bddl, None)
    with pytest.raises(MemobenchError, match=r"task_config\.meta\.json is missing.*subtask_goals"):
        load_task(folder)
    with pytest.raises(MemobenchError, match="not a folder"):
        load_task(tmp_path / "nowhere")
    with pytest.raises(MemobenchError, match=r"task_config\.bddl"):
        load_task(tmp_path)
    (tmp_path / "task_config.bddl").mkdir()
    with pytest.raises(MemobenchError, match=r"task_config\.bddl"):
        load_task(tmp_path)
    (folder / "task_config.bddl").write_bytes(b"(define \xff")
    with pytest.raises(MemobenchError, match="position 8"):
        load_task(folder)


# --- values that the published format lacks ---


@pytest.mark.parametrize(
    ("language", "goal", "memory_type", "prompt"),
    [
        ("put the cup away", f"(In cup_1 {DRAWER})", "spatial", None),
        ("open the drawer", f"(WasOpen {DRAWER})", "temporal", None),
        ("stow the cup from the prompt video", f"(In cup_1 {DRAWER})", "object", Prompt("routine", "cup_1")),
        ("stow the cup picked up in the video", f"(In cup_1 {DRAWER})", "object", Prompt("pick", "cup_1")),
        ("stow the cup pointed out in the video", f"(In cup_1 {DRAWER})", "object", Prompt("point", "cup_1")),
        ("stow the cup highlighted in the video", f"(In cup_1 {DRAWER})", "object", Prompt("highlight", "cup_1")),
        ("follow the prompt video", f"(In cup_1 {DRAWER})", "procedural", Prompt("routine")),
        ("do the 3-step sequence shown in the prompt", f"(In cup_1 {DRAWER})", "procedural", Prompt("routine")),
    ],
)
def test_memory_type_and_prompt_are_inferred(
    write_task: Write, bddl: str, language: str, goal: str, memory_type: str, prompt: Prompt | None
) -> None:
    task = load_task(write_task(bddl.replace(LANGUAGE, language).replace(GOAL, goal)))
    assert (task.memory_type, task.prompt) == (memory_type, prompt)
    assert load_task(write_task(bddl.replace(LANGUAGE, language), parent="spatial")).memory_type == "spatial"


def test_trees_of_tasks(write_task: Write, tmp_path: Path) -> None:
    elsewhere = write_task(parent="elsewhere/temporal")
    for name in ("task_config.bddl", "task_config.meta.json"):
        (elsewhere / name).rename(elsewhere / name.upper())
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "linked").symlink_to(elsewhere.parent)
    (found,) = find_tasks(tmp_path / "tree")
    assert load_task(found).name == "my_task"
    write_task(parent="tree/spatial")
    with pytest.raises(MemobenchError, match=r"linked/my_task and .*spatial/my_task hold tasks of one name"):
        find_tasks(tmp_path / "tree")


# --- damaged files ---


def test_damaged_files_load_or_raise_one_sentence(write_task: Write) -> None:
    rng, refused = random.Random(0), 0
    for _ in range(200):
        task = get_task(rng.choice(task_names()))
        folder = write_task(task.bddl_text, (task.folder / "task_config.meta.json").read_text())
        file = folder / rng.choice(["task_config.bddl", "task_config.meta.json"])
        file.write_bytes(mutations.mutated_bytes(file.read_bytes(), rng))
        message = refusal(folder)
        refused += bool(message)
        assert not message or (str(folder) in message and "\n" not in message)
    assert refused > 50


def refusal(folder: Path) -> str:
    """Load a folder and evaluate its variants; return the error message, "" without an error."""
    try:
        task = load_task(folder)
        for k in range(task.num_variants):
            Progress(task.variant(k)).step(lambda atom: True)
    except MemobenchError as error:
        return str(error)
    return ""
