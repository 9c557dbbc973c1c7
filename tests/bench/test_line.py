"""A claim as JSON and as a row."""

from __future__ import annotations

import json

from lerobot_memobench.bench.line import Line, table


def line(name: str, ours: float, theirs: float) -> Line:
    return Line(name, ours, theirs, theirs / ours, "ms", "a machine", {"task": "t", "quality": "fast"})


def test_line_is_one_flat_json_object() -> None:
    record = json.loads(line("step", 2.0, 20.0).json())
    assert record == {
        "name": "step",
        "ours": 2.0,
        "theirs": 20.0,
        "ratio": 10.0,
        "unit": "ms",
        "machine": "a machine",
        "task": "t",
        "quality": "fast",
    }


def test_table_names_machine_and_ratio() -> None:
    text = table([line("step_with_images", 2.0, 20.0)])
    assert text.startswith("a machine")
    assert "| step with images | 2 ms | 20 ms | 10× | quality fast |" in text
