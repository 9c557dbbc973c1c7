"""Steps from cue to use: the shipped numbers cover the catalogue, and an evaluation is grouped by them."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.evaluation.plots import draw_figures, success_by_gap
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.tasks.catalogue import cue_to_use, get_task, longest_cue_to_use, task_names
from tests.support.logs import rollout, write_log

COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
HIDING = "find_the_tomato_hidden_in_one_of_the_drawers"


@pytest.mark.parametrize("suite", ["published", "strict"])
def test_every_checkpoint_of_the_catalogue_was_measured(suite: str) -> None:
    for task in map(get_task, task_names(suite=suite)):
        measured = cue_to_use(task)
        assert len(measured) == len(task.checkpoints)
        assert all(one is None or 0 < one.least <= one.median <= one.most for one in measured)
        # An instruction needs no memory, a prompt does.
        assert (measured[0] is None) == (task.prompt is None)
        if suite == "strict":
            longest = longest_cue_to_use(task)
            assert longest is not None
            assert longest.median > 30
            assert longest.held == (task.prompt is not None)


def test_checkpoints_are_grouped_by_gap() -> None:
    """The third checkpoint counts for those episodes only that came to it."""
    done = [[True, True, True, True], [True, True, False, False], [True, False, False, False]]
    records = [rollout(COUNTING, "temporal", "SUUC", marks, all(marks), k) for k, marks in enumerate(done)]
    found = success_by_gap(records)
    assert sum(count for _, count in found.values()) == 4 + 3 + 2
    assert sum(reached for reached, _ in found.values()) == 4 + 2 + 1
    for record in records:  # logs of other tools omit it, as in prefix completion
        record["checkpoints"][0].pop("ordered_step", None)
    assert sum(reached for reached, _ in success_by_gap(records).values()) == 0
    assert success_by_gap([rollout("my_own_task", "temporal", "S", [True], True, 0)]) == {}


def test_figure_is_drawn_for_tasks_of_the_catalogue(tmp_path: Path) -> None:
    records = [rollout(HIDING, "spatial", "SUC", [True, k > 1, k > 2], k > 2, k) for k in range(4)]
    write_log(tmp_path / "log", records)
    files = draw_figures(read_runs([tmp_path / "log"]), tmp_path)
    assert {"gap.pdf", "gap.png"} <= {file.name for file in files}
