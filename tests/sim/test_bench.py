"""The benchmarks' own arithmetic. What they measure is not a test: machines differ."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import bench


def line(name: str, ours: float, theirs: float) -> bench.Line:
    return bench.Line(name, ours, theirs, theirs / ours, "ms", "a machine", {"task": "t", "quality": "fast"})


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


def test_sides_take_turns_and_medians_count() -> None:
    order: list[str] = []
    times = iter([1.0, 2.0, 50.0, 1.0, 2.0, 3.0])

    def ours() -> float:
        order.append("o")
        return next(times)

    def theirs() -> float:
        order.append("t")
        return 7.0

    assert bench.alternate(ours, theirs, rounds=2, ours_per_round=3, theirs_per_round=1) == (2.0, 7.0)
    assert "".join(order) == "ooot" * 2


def test_table_names_machine_and_ratio() -> None:
    text = bench.table([line("step_with_images", 2.0, 20.0)])
    assert text.startswith("a machine")
    assert "| step with images | 2 ms | 20 ms | 10× | quality fast |" in text


def test_unknown_benchmark() -> None:
    with pytest.raises(MemobenchError, match="there is no benchmark 'rest'; did you mean 'reset'"):
        list(bench.run(["rest"]))


def test_our_side_steps_as_the_environment_does(gl: str) -> None:
    ours = bench.Ours(images=True)
    assert [image.shape for image in ours.look()] == [(256, 256, 3)] * 2
    ours.step(np.zeros(7))
    assert ours.progress.steps == 1
    ours.reset(3)
    assert ours.progress.steps == 0


@pytest.mark.slow
def test_step_beside_robosuite(gl: str) -> None:
    result = bench.step_with_images(rounds=1)
    assert result.ratio == pytest.approx(result.theirs / result.ours, rel=0.01)
