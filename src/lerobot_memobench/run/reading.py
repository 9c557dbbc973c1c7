"""A command line, read whole: what LeRobot's command is to be called with, and what it would choose by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.run.lerobot_commands import config_class, load_command, register_plugins
from lerobot_memobench.run.translation import LerobotSettings, translate
from lerobot_memobench.run.words import Words
from lerobot_memobench.tasks.catalogue import check_suite, resolve_tasks
from lerobot_memobench.tasks.task import PUBLISHED


def read_settings(command: str, words: Words) -> LerobotSettings:
    """Return what the words of a LeRobot command mean to it; imports that command.

    Raises:
        MemobenchError: an unknown key or value, named with the nearest known one.
    """
    config = config_class(load_command(command))
    register_plugins()
    return translate(command, words, config, read_config_file(words))


def check_task_names(words: Words) -> None:
    """Refuse unknown task names before LeRobot's import, which takes many seconds.

    Raises:
        MemobenchError: a task that the catalogue does not have.
    """
    settings = dict(words.settings)
    environment = settings.get("env", words.value("env.type"))
    tasks = settings.get("tasks", words.value("env.tasks"))
    own_folder = "env.task_dir" in settings or words.value("env.task_dir")
    suite = settings.get("suite", words.value("env.suite"))
    in_a_file = suite is None and words.value("config_path") is not None
    if environment == "memobench" and not own_folder and not in_a_file:
        resolve_tasks("all" if tasks is None else tasks, check_suite(suite or PUBLISHED))


def read_config_file(words: Words) -> dict[str, Any]:
    """Return the content of the local file that ``config_path`` names, {} without one.

    Raises:
        MemobenchError: it cannot be read as settings.
    """
    given = words.value("config_path")
    if given is None:
        return {}
    path = Path(given).expanduser()
    if path.is_dir():
        path = path / "train_config.json"
    if not path.is_file():
        return {}  # a repository: LeRobot fetches it
    try:
        content = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise MemobenchError(f"config_path={given} cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError, AttributeError) as error:
        # Beside its own errors, PyYAML lets through those of dates, numbers and keys that are none.
        problem = " ".join(str(error).split())
        raise MemobenchError(f"config_path={given} is neither YAML nor JSON: {problem}") from None
    if not isinstance(content, dict):
        raise MemobenchError(f"config_path={given} holds no settings; expected a mapping such as 'policy: …'")
    return content
