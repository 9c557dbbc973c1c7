"""The example of the paper's tables: its data agree with each other and with the text, and its tables hold them."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.datasets.card import FAMILIES, LENGTH_BUCKETS
from lerobot_memobench.evaluation.metrics import METRICS
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.evaluation.tables import WRITERS
from lerobot_memobench.tasks.task import MEMORY_TYPES
from tests.support import logs

EXAMPLE = Path(__file__).parents[1] / "examples" / "paper"
PUBLISHED = runpy.run_path(str(EXAMPLE / "published.py"))
published_rows, RAW = PUBLISHED["published_rows"], PUBLISHED["RAW"]
ROWS = published_rows()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.table}-{row.model}-{row.replan_steps}")
def test_published_averages_are_the_mean_of_applicable_memory_types(row: Any) -> None:
    assert tuple(row.memory_types) == MEMORY_TYPES
    for metric in METRICS:
        values = [value for figures in row.memory_types.values() if (value := figures[metric]) is not None]
        # The paper rounds the memory types as well as their mean.
        assert row.average[metric] == pytest.approx(sum(values) / len(values), abs=0.1 + 1e-9), metric


def test_an_operation_is_published_where_the_catalogue_has_it() -> None:
    from lerobot_memobench.tasks.catalogue import get_task, task_names

    for memory_type in MEMORY_TYPES:
        operations = {label for name in task_names(memory_type) for label in get_task(name).operations}
        for row in ROWS:
            published = {m for m, value in row.memory_types[memory_type].items() if value is not None}
            assert published == {"SR"} | {f"M{operation}R" for operation in operations}


def test_the_text_quotes_the_tables() -> None:
    """Sentences of the paper's section on results, each against the rows."""

    def figure(model: str, replan: int, read: Callable[[Any], float | None], table: str = "main") -> object:
        (row,) = [r for r in published_rows(table) if r.model == model and r.replan_steps == replan]
        return read(row)

    module = "pi05 + RoboMME Memory Module"
    assert figure(module, 5, lambda r: r.average["SR"]) == 31.9
    assert figure("pi05", 50, lambda r: r.average["SR"]) == 20.8
    assert figure("pi0", 5, lambda r: r.memory_types["temporal"]["MSR"]) == 94.0
    assert figure("MemoryVLA", 20, lambda r: r.average["MUR"]) == 49.9
    assert figure("Contrastive Memory Alignment", 5, lambda r: r.average["SR"], "alignment") == 34.7


def test_failures_add_up() -> None:
    counts = dict(RAW["failure_taxonomy"])
    assert counts.pop("rollouts") == sum(counts.values()) == 150


def test_demonstration_statistics_add_up() -> None:
    families = [FAMILIES[name] for name in MEMORY_TYPES]
    total = FAMILIES["total"]
    assert sum(f["steps"] for f in families) == total["steps"] == 927_444
    assert sum(f["episodes"] for f in families) == sum(LENGTH_BUCKETS.values()) == total["episodes"]
    assert sum(f["gib"] for f in families) == pytest.approx(total["gib"], abs=0.01)
    for family in families:
        assert family["mean"] == pytest.approx(family["steps"] / family["episodes"], abs=0.1)
    assert next(iter(LENGTH_BUCKETS)) == (0, 200)
    assert list(LENGTH_BUCKETS)[-1] == (1500, None)


def test_cards_of_datasets_have_the_papers_statistics() -> None:
    assert RAW["demo_statistics"] == FAMILIES
    assert {name.replace("+", "-"): count for name, count in RAW["length_buckets"].items()} == {
        f"{low}-{high - 1 if high else ''}": count for (low, high), count in LENGTH_BUCKETS.items()
    }


def test_tables_with_evaluations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paper: "oracle memory closes 45.5% of the MUR gap and 54.9% of the MCR gap, but only 20.2% of the MSR gap"."""
    monkeypatch.syspath_prepend(EXAMPLE)
    example = runpy.run_path(str(EXAMPLE / "tables.py"))
    (run,) = read_runs([logs.evaluation(tmp_path / "a")])
    changed = replace(run, protocol={**run.protocol, "horizon": 600, "suite": "strict"})
    assert example["departures"](changed)[len(example["departures"](run)) :] == [
        *("suite strict, not published", "horizon 600, not 1200")
    ]
    report = example["paper_report"]([run])
    text = WRITERS["markdown"](report)
    assert "| paper: π0.5 + memory module | pixels | 5 | 9.8 | 92.0 | 32.2 | 10.0 |" in text
    assert text.count("| paper: ") == 43
    assert "| stale memory first update | 63 | 42.0" in text
    (average,) = [line for line in text.splitlines() if line.startswith("| **average**")]
    assert [cell.strip("* ") for cell in average.split("|")][-4:-1] == ["20.2", "45.5", "54.9"]
    assert "| shuffled | 90.0 | 24.0 | 2.0 |" in text
    assert r"$\pi_{0.5}$ + memory module" in WRITERS["latex"](report)
