"""Scripts of `benchmarks/`, `trace.py`, `ship_policy.py` and the nets: they run, and notice what they look for."""

from __future__ import annotations

import importlib
import json
import re
import statistics
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.policies.checkpoint import TRAIN_CONFIG, encoded_config, shipped_policies
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SUPERVISED, MemobenchMemConfig
from research.kept import restore
from scripts import ship_policy
from scripts.nets.mutants import place_of, table
from scripts.nets.store import ROOT, differences
from tests.support.scripts import SCRIPTS

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SMALLEST = {
    "dataset_writing": "--episodes 1 --repeats 1 --ways write",
    "gpu": "--size tiny --device cpu --steps 1 --out {folder}/gpu.jsonl",
    "memory_cost": "--memory none bank subgoal --steps 30 --repeats 1",
    "mujoco_renderers": "--frames 1 --backends egl",
    "object_update": "src --rounds 1 --memory frames",
    "speed": "--turns 1 --tasks put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
    "step_with_objects": "--steps 5 --repeats 1 --tasks 1",
}
"""Script -> arguments."""


@pytest.mark.parametrize("name", SMALLEST)
def test_benchmark_imports(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    for module in ("turns", "policies", "random_weights", "object_update", name):
        monkeypatch.delitem(sys.modules, module, raising=False)
    importlib.import_module(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_benchmark_runs(name: str, tmp_path: Path) -> None:
    arguments = SMALLEST[name].format(folder=tmp_path).split()
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), *arguments]
    done = subprocess.run(command, cwd=BENCHMARKS.parent, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "error" not in done.stdout
    assert done.stdout


# --- benchmarks/speed.py ---


def test_speed_prints_a_row_for_each_operation_on_a_scene() -> None:
    arguments = ["--tables", "scenes", "--turns", "1", "--tasks", "put_the_butter_into_the_bowl_from_the_prompt_video"]
    command = [sys.executable, str(BENCHMARKS / "speed.py"), *arguments]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = re.findall(r"^\| ([a-z ]+) \| [\d.,]+ / [\d.,]+ \|$", output, flags=re.MULTILINE)
    firsts = [f"first scene {of}" for of in ("of a process", "of a task", "on a machine")]
    assert sorted(rows) == [*firsts, "reset", "step with two images", "step without images"]


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Return a function that imports a benchmark."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tasks", "stack_the_bowl"], "found no task named 'stack_the_bowl'"),
        (["--former", "/"], "/ holds no src/lerobot_memobench; expected a checkout"),
        (["--stock", "no/python"], "no/python is no program; expected the Python of stock LIBERO"),
        (["--turns", "0"], "expected at least 1"),
    ],
)
def test_speed_refuses_what_it_cannot_measure(
    arguments: list[str], message: str, benchmark: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["speed.py", *arguments])
    with pytest.raises(SystemExit, match=message):
        benchmark("speed").main()


def test_ratios_are_to_the_first_side(
    benchmark: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    here, stock = [[1.0, 3.0], [3.0, 3.0]], [[8.0, 9.0]]
    rows = {"step": {"here": here, "stock": stock}, None: {"stock": stock}, "reset": {"here": [[1000.0, 0.5]]}}
    benchmark("turns").print_table("ms", rows, statistics.mean, 10.0)
    assert capsys.readouterr().out.splitlines() == [
        "| ms | here | stock | ratio |",
        "|---|---:|---:|---:|",
        "| step | 20.0 / 30.0 | 80.0 / 90.0 | 4.00 / 3.00 |",
        "| reset | 10,000 / 5.00 | – | – |",
        "",
    ]


# --- scripts/trace.py ---


@pytest.mark.slow
def test_trace_prints_table_and_files() -> None:
    command = [sys.executable, str(SCRIPTS / "trace.py"), "words to plan", "--list"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    row = re.search(r"^\| words to plan \| (\d+) \| (\d+) \|$", output, flags=re.MULTILINE)
    files = re.findall(r"^    (\S+\.py): ", output, flags=re.MULTILINE)
    assert 5 < len(files) == int(row[1]) <= int(row[2])


# --- scripts/ship_policy.py ---


def test_card_of_a_shipped_policy_has_its_mark(tmp_path: Path) -> None:
    config = MemobenchMemConfig(device="cpu", size="small", perception="objects", align="contrastive")
    config.save_pretrained(tmp_path)
    run = {"policy": encoded_config(config), "dataset": {"root": "gone"}, "output_dir": "outputs/run"}
    run |= {"batch_size": 72, "steps": 2000, "seed": 1000}
    (tmp_path / TRAIN_CONFIG).write_text(json.dumps(run))
    text = ship_policy.card("mine", tmp_path, {}, None, {})
    assert f"**{SUPERVISED}.**" in text
    assert "policy.align=contrastive batch_size" in text
    for folder in shipped_policies().values():
        marked = MemobenchMemConfig.from_pretrained(folder, cli_overrides=["--device=cpu"]).supervised_with_answer
        assert (f"**{SUPERVISED}.**" in (folder / "README.md").read_text()) == marked


def test_a_resumed_training_names_the_policy_it_began_from(tmp_path: Path) -> None:
    checkpoints = tmp_path / "outputs" / "run" / "checkpoints"
    begun = {"002": "outputs/first/checkpoints/002/pretrained_model", "004": str(checkpoints / "last/pretrained_model")}
    begun |= {"006": "outputs/run/checkpoints/last/pretrained_model"}  # relative, as a resumed training may save it
    for step, path in begun.items():
        folder = checkpoints / step / "pretrained_model"
        folder.mkdir(parents=True)
        (folder / TRAIN_CONFIG).write_text(
            json.dumps({"policy": {"pretrained_path": path}, "output_dir": "outputs/run"})
        )
    (checkpoints / "last").symlink_to("006")
    first = tmp_path / "outputs" / "first" / "checkpoints" / "002" / "pretrained_model"
    first.mkdir(parents=True)
    (first / TRAIN_CONFIG).write_text(json.dumps({"policy": {"pretrained_path": None}, "output_dir": "outputs/first"}))
    with chdir(tmp_path):
        for step in begun:
            found = ship_policy.trainings(checkpoints / step / "pretrained_model")
            assert [run["output_dir"] for run in found] == ["outputs/first", "outputs/run"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda card: card["policy"].update(sha256="0" * 64), "other weights"),
        (lambda card: card["runs"][0].update(command=["memobench", "rerun"]), "not of `lerobot eval`"),
        (lambda card: card["protocol"].update(episodes=9), "lacks episodes"),
    ],
)
def test_other_rollouts_are_not_put_on_a_card(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], named: str
) -> None:
    restore(ROOT / "results" / "evaluations", tmp_path, ["strict_validation_memory"])
    folder = tmp_path / "strict_validation_memory"
    write_report(folder)
    ship_policy.check_rollouts(folder, ship_policy.SHIPPED / "memobench_strict")
    assert "shard" not in "".join(ship_policy.results("memobench_strict", folder)[:2])
    card = json.loads((folder / "evaluation.json").read_text())
    change(card)
    (folder / "evaluation.json").write_text(json.dumps(card))
    with pytest.raises(SystemExit, match=named):
        ship_policy.check_rollouts(folder, ship_policy.SHIPPED / "memobench_strict")


# --- scripts/nets ---


def test_a_comparison_names_fields_that_went_came_and_changed() -> None:
    old = {"a": {"x": 1.0, "hash bits": "aa", "went": None}, "b": {"x": 1.0}}
    new = {"a": {"x": 1.0 + 1e-9, "hash bits": "ab", "came": True}, "b": {"x": 2.0}}
    assert differences(old, old, True) == []
    heads = [line for line in differences(old, new, False) if not line.startswith(" ")]
    assert heads == ["came: came, 1 times", "went: went, 1 times", "x: changed, 1 times"]
    heads = [line for line in differences(old, new, True) if not line.startswith(" ")]
    assert heads == ["came: came, 1 times", "hash bits: changed, 1 times", "went: went, 1 times", "x: changed, 2 times"]


@pytest.mark.parametrize("name", table())
def test_a_mutant_has_its_text_in_the_source(name: str) -> None:
    _, _, old, new = table()[name]
    assert place_of(old, ROOT).read_text().replace(old, new).count(old) == 0
