"""A claim as JSON and as a row."""

from __future__ import annotations

import json

from research.speed.sides import Line, Times, line_of, table


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
    assert "| step with images | 2 ms | 20 ms | 10× |  |  |  | quality fast |" in text


def test_a_line_states_both_clocks_as_medians_of_pairs() -> None:
    """The wall's ratio is the claim; a round in which another program computed moves neither clock's median."""
    quiet = Times(0.010, 0.012), Times(0.100, 0.156)
    disturbed = Times(0.050, 0.012), Times(0.100, 0.156)
    measured = line_of("reset", [quiet, disturbed, quiet], {"task": "t"})
    assert (measured.ours, measured.theirs, measured.ratio) == (10.0, 100.0, 10.0)
    assert measured.detail == {"task": "t", "cpu_ours": 12.0, "cpu_theirs": 156.0, "cpu_ratio": 13.0}
    assert "| reset | 10 ms | 100 ms | 10× | 12 ms | 156 ms | 13× |  |" in table([measured])
