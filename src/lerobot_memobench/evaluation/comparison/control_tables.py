"""What the tables of the controls share: titles, and rows of prefix completion as wide as the widest task asks for."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.evaluation.documents.tables import Cell

PAPER = "paper"
PAPER_TASK = "paper, stove task of three checkpoints"


def replan_title(replan: int | None) -> str:
    """Return the title of a table of rollouts of one replan interval."""
    return f"replan interval {'unknown' if replan is None else replan}"


def prefix_header(second: str, width: int) -> tuple[str, ...]:
    """Return the header; ``second`` names the column after the task, ``width`` is the number of checkpoints."""
    return ("task", second, *(f"c{k + 1}" for k in range(width)), "success")


def prefix_row(task: str, second: str, cells: Sequence[Cell], width: int) -> tuple[Cell, ...]:
    """Return a row; a task with fewer checkpoints than the widest has empty cells, and success comes last."""
    *checkpoints, success = cells
    return (task, second, *checkpoints, *([None] * (width - len(checkpoints))), success)
