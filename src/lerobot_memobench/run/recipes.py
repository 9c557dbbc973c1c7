"""The shipped training recipes: ``lerobot train config=train_paper`` and ``memobench recipe``."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib import resources
from pathlib import Path

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.run.flags import has_flag
from lerobot_memobench.run.words import Words

KEY = "config"
logger = logging.getLogger(__name__)


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
    path = Path(value).expanduser()
    if value in known:
        if path.is_file():
            logger.warning("%s=%s is the shipped recipe; the file of that name is %s=./%s", KEY, value, KEY, value)
        return known[value]
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
