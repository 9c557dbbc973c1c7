"""Figures of a report: the numbers that are drawn, and the files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.evaluation.plots import OUTCOMES, bars, draw_figures, draw_replan, line_style
from lerobot_memobench.evaluation.records import Run, read_runs
from lerobot_memobench.tasks.failures import FAILURES, FAULTS, REFINED_FAILURES
from lerobot_memobench.tasks.task import STRICT_FAILURES
from tests.support import logs


@pytest.fixture
def runs(tmp_path: Path) -> list[Run]:
    """A policy at two intervals: 1 and 3 of 4 episodes of each task succeed."""
    for k, successes in ((5, 1), (20, 3)):
        logs.evaluation(tmp_path / f"k{k}", successes, replan_steps=k)
    return read_runs([f"mine_$={tmp_path}/k{k}" for k in (5, 20)])


def test_bars_count_rollouts_of_all_and_of_each_memory_type(runs: list[Run]) -> None:
    found = bars(runs, paper=True)
    assert [bar.heading for bar in found] == [
        *["all rollouts"] * 2,
        *["temporal"] * 2,
        *["spatial"] * 2,
        found[-1].heading,
    ]
    assert (found[0].parts["success"], found[0].parts["stale_memory"], found[0].parts["compression_collapse"]) == (
        2,
        3,
        3,
    )
    assert sum(found[0].parts.values()) == 8
    assert sum(found[-1].parts.values()) == 150, "the paper's"


def test_every_outcome_has_a_colour_and_a_hatch_of_its_own() -> None:
    assert set(OUTCOMES) == {"success", *FAILURES, *REFINED_FAILURES, *STRICT_FAILURES, *FAULTS}
    assert len(set(OUTCOMES.values())) == len(OUTCOMES)


def test_eleven_methods_differ_in_colour_marker_and_dashes() -> None:
    styles = [line_style(k, published=False) for k in range(11)]
    for key in ("color", "marker", "ls"):
        assert len({str(style[key]) for style in styles}) == 11
    assert len({str(line_style(k, published=False)) for k in range(100)}) == 100


def test_curves_are_averages_with_intervals(runs: list[Run]) -> None:
    figure = draw_replan(runs, paper=True)
    line = figure.axes[0].lines[0]
    assert [*line.get_xdata()] == [5, 20]
    assert [*line.get_ydata()] == pytest.approx([25, 75])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0].startswith("mine_\\$\n(2 of 30 tasks, 8 rollouts)")
    assert sum(label.startswith("paper: ") for label in labels) == len(labels) - 1 > 5


def test_files_are_pdf_and_png_and_the_same_again(runs: list[Run], tmp_path: Path) -> None:
    files = draw_figures(runs, tmp_path / "figures")
    assert [path.name for path in files] == ["outcomes.pdf", "outcomes.png", "replan.pdf", "replan.png"]
    before = [path.read_bytes() for path in files]
    assert [path.read_bytes() for path in draw_figures(runs, tmp_path / "figures")] == before
    assert before[0].startswith(b"%PDF")
    assert np.asarray(Image.open(files[1]).convert("L")).std() > 10, "something is drawn"
    assert [path.stem for path in draw_figures(runs[:1], tmp_path / "one")] == ["outcomes", "outcomes"]
