"""The shipped training recipes: ``lerobot train config=train_contrastive`` and ``memobench recipe``."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.arguments import Words, has_flag
from lerobot_memobench.cli.console import console
from lerobot_memobench.errors import MemobenchError, nearest

KEY = "config"


def recipes() -> dict[str, Path]:
    """Return name -> file of every shipped recipe."""
    folder = Path(str(resources.files("lerobot_memobench") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def recipe_file(value: str) -> Path:
    """Return the file of a recipe: one shipped, by its name, or a YAML or JSON file.

    Raises:
        MemobenchError: there is none.
    """
    known = recipes()
    if value in known:
        return known[value]
    path = Path(value).expanduser()
    if path.is_file():
        return path
    if "/" in value or path.suffix:
        raise MemobenchError(f"{KEY}={value}: there is no such file; name a shipped recipe or a YAML file")
    raise MemobenchError(f"there is no recipe {value!r}, {nearest(value, known)}")


def resolve_recipe(words: Words) -> Words:
    """Replace ``config=<recipe>`` by LeRobot's ``config_path=<file>``."""
    named = [value for key, value in words.settings if key == KEY]
    if not named:
        return words
    others = [(key, value) for key, value in words.settings if key != KEY]
    if len(named) > 1 or any(key == "config_path" for key, _ in others) or has_flag(words.flags, "config_path"):
        raise MemobenchError(f"{KEY}={named[-1]}: give one recipe, either by {KEY}= or by config_path=")
    return replace(words, settings=[("config_path", str(recipe_file(named[0]))), *others])


def recipe(
    name: Annotated[str | None, typer.Argument(help="A recipe; all are listed without it.")] = None,
) -> int:
    """Print the file of a training recipe, for `lerobot-train --config_path=$(memobench recipe train_paper)`."""
    if name is not None:
        print(recipe_file(name))
        return 0
    from rich.table import Table

    table = Table(header_style="bold", pad_edge=False)
    table.add_column("recipe", no_wrap=True)
    table.add_column("what it trains")
    for key, path in recipes().items():
        table.add_row(key, path.read_text().splitlines()[0].removeprefix("# "))
    console().print(table)
    return 0
