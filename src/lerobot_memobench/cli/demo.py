"""``memobench demo``: the scripted expert in videos, a contact sheet and a report."""

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
    """Evaluate the scripted expert on four tasks, one of each memory type, and show it in videos."""
    from lerobot_memobench.cli.evaluate import evaluate_here
    from lerobot_memobench.engine.demo import CONTACT_SHEET, demo_plan, make_demo
    from lerobot_memobench.engine.folder import VIDEOS
    from lerobot_memobench.evaluation.documents.report import REPORT_MARKDOWN

    status = make_demo(out, lambda folder: evaluate_here(demo_plan(folder), say_where=False))
    if status:
        return status
    screen = console()
    screen.print(f"report:  {out / REPORT_MARKDOWN}", soft_wrap=True)
    screen.print(f"videos:  {out / VIDEOS}", soft_wrap=True)
    screen.print(f"picture: {out / CONTACT_SHEET}", soft_wrap=True)
    return 0
