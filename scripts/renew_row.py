"""Run a row of the board again with this version: ``python scripts/renew_row.py results/board/NAME OUT``.

The evaluation and its controls run with the settings of the row's cards into OUT/NAME; the same command resumes them.
Then they replace the row. ``python -m tools.board results/board`` checks the board;
``results/board/reruns.json`` needs the new digest. An evaluation in OUT/NAME that another command has made, such as
one with ``shards=``, is completed and taken.
"""

from __future__ import annotations

import datetime as dt
import sys
from dataclasses import replace
from pathlib import Path

import lerobot_policy_memobench  # noqa: F401 - registers policies
from lerobot_memobench.board.submission import ABOUT, CARD, CONTROLS, About, write_submission
from lerobot_memobench.cli.lerobot import evaluate_here
from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.rollouts.rerun import plan_of_evaluation, read_repeatable


def renew(row: Path, out: Path) -> int:
    """Run the evaluations of a row into ``out`` and replace it; return the status of the first that fails."""
    about = About(**read_evaluation(row)[ABOUT] | {"date": str(dt.date.today())})
    sources = {}
    for control in ("", *(name for name in CONTROLS if (row / name / CARD).exists())):
        sources[control] = out / row.name / (control or "evaluation")
        plan = plan_of_evaluation(*read_repeatable(row / control), sources[control])
        if status := evaluate_here(replace(plan, options=replace(plan.options, resume=True))):
            return status
    print(write_submission(row, about, sources))
    return 0


if __name__ == "__main__":
    sys.exit(renew(Path(sys.argv[1]), Path(sys.argv[2])))
