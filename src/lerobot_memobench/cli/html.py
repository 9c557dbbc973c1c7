"""``memobench html``: evaluations as a folder to open in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.io import count_of


def html(
    folders: Annotated[list[Path], typer.Argument(help="Folders that evaluations have written.")],
    out: Annotated[Path, typer.Option(help="Folder of the report; an earlier report there is replaced.")] = Path(
        "outputs/html"
    ),
    link: Annotated[
        bool,
        typer.Option("--link", help="Link to the videos where they are: saves space, but the folder cannot be moved."),
    ] = False,
    task_dir: Annotated[
        Path | None,
        typer.Option(help="Tasks in the published format that the evaluations ran, beside the catalogue's."),
    ] = None,
) -> None:
    """Make a report for the browser. Rates, failures, and each episode's video over its timeline."""
    from lerobot_memobench.evaluation.documents.html import write_html

    written = write_html(folders, out, link=link, task_dir=task_dir)
    screen = console()
    for note in written.notes:
        screen.print(f"note: {note}", soft_wrap=True)
    screen.print(f"{count_of(written.rollouts, 'episode')}, {written.videos} with a video")
    screen.print(f"open {written.page}", soft_wrap=True)
