"""``memobench recipe``: the shipped training recipes."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from lerobot_memobench.cli.console import console
from lerobot_memobench.run.arguments import recipe_file, recipes


def recipe(
    name: Annotated[str | None, typer.Argument(help="A recipe; all are listed without it.")] = None,
) -> int:
    """Print the file of a training recipe. As in `lerobot-train --config_path=$(memobench recipe train_paper)`."""
    if name is not None:
        print(recipe_file(name))
        return 0
    table = Table(header_style="bold", pad_edge=False)
    table.add_column("recipe", no_wrap=True)
    table.add_column("what it trains")
    for key, path in recipes().items():
        table.add_row(key, path.read_text().splitlines()[0].removeprefix("# "))
    console().print(table)
    return 0
