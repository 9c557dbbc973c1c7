"""``memobench demo``: the scripted expert in videos, a contact sheet and a report; and what a memory is good for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console


def demo(
    out: Annotated[Path, typer.Option(help="Folder of videos and report; an earlier demo there is replaced.")] = Path(
        "outputs/demo"
    ),
) -> int:
    """Evaluate the scripted expert on a task of each memory type. On one of them, trained policies as well, with a
    memory and without.
    """
    from rich.markdown import Markdown

    from lerobot_memobench.cli.evaluate import evaluate_here, tell, tell_beginning
    from lerobot_memobench.evaluation.documents.report import REPORT_MARKDOWN
    from lerobot_memobench.run.demo import (
        CONTACT_SHEET,
        MEMORY_TABLE,
        MEMORY_VIDEO,
        compare_memories,
        demo_plan,
        has_policies,
        make_demo,
        memory_plan,
    )
    from lerobot_memobench.run.run import VIDEOS, run_evaluation

    def one_of_three(name: str, folder: Path) -> int:
        return run_evaluation(memory_plan(name, folder), tell, tell_beginning).status

    status = make_demo(
        out,
        lambda folder: evaluate_here(demo_plan(folder), say_where=False),
        (lambda work, made: compare_memories(work, made, one_of_three)) if has_policies() else None,
    )
    if status:
        return status
    screen = console()
    if (out / MEMORY_TABLE).is_file():
        screen.print(Markdown((out / MEMORY_TABLE).read_text()))
    screen.print(f"report:  {out / REPORT_MARKDOWN}", soft_wrap=True)
    screen.print(f"videos:  {out / VIDEOS}", soft_wrap=True)
    screen.print(f"picture: {out / CONTACT_SHEET}", soft_wrap=True)
    if (out / MEMORY_VIDEO).is_file():
        screen.print(f"memory:  {out / MEMORY_VIDEO}", soft_wrap=True)
    return 0
