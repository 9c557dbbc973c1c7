"""The command ``lerobot``: ``lerobot <name> key=value …`` runs LeRobot's own ``lerobot-<name>``.

``key=value`` becomes ``--key=value`` after a check against the command's settings; whatever starts with
``--`` is passed on untouched. ``lerobot eval env=memobench`` and ``lerobot train policy=…`` also get the
defaults that make them work as they stand (``evaluate``, ``train``).
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

from lerobot_memobench.cli.arguments import Words, flag_value, split_words, translate
from lerobot_memobench.cli.errors import one_sentence
from lerobot_memobench.cli.orders import take_orders
from lerobot_memobench.errors import MemobenchError, nearest

USAGE_ERROR = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status. Errors a user can mend are one sentence on stderr, status
    2.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return run(words)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        sentence = one_sentence(error)
        if sentence is None:
            raise
        print(f"lerobot: {sentence}", file=sys.stderr)
        return USAGE_ERROR


def run(words: list[str], say_where: bool = True) -> int:
    """Run the command line; ``say_where=False`` keeps quiet about the folder of an evaluation's report."""
    commands = lerobot_commands()
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview(commands))
        return 0
    name, rest = words[0], split_words(words[1:])
    if name not in commands:
        raise MemobenchError(f"there is no command {name!r}, {nearest(name, commands)}")
    if name == "train":
        from lerobot_memobench.cli.recipes import resolve_recipe

        rest = resolve_recipe(rest)
    check_tasks_early(rest)
    orders = take_orders(rest, ["lerobot", *words]) if name == "eval" else None
    try:
        entry = commands[name].load()
    except ImportError as error:
        raise MemobenchError(f"lerobot-{name} needs what is not installed here: {error}") from error
    register_plugins()
    config = config_class(entry)
    translation = translate(name, rest, config, read_config_file(rest))
    if rest.wants_help or config is None:
        return call(name, entry, translation.flags)
    if name == "eval":
        from lerobot_memobench.cli.evaluate import evaluate

        return evaluate(translation, lambda: call(name, entry, translation.flags), say_where, orders)
    if name == "train":
        from lerobot_memobench.cli.train import prepare_training

        prepare_training(translation)
    return call(name, entry, translation.flags)


def call(name: str, entry: Callable[[], Any], flags: Sequence[str]) -> int:
    """Call LeRobot's main function, which reads ``sys.argv``."""
    before = sys.argv
    sys.argv = [f"lerobot-{name}", *flags]
    try:
        status = entry()
    except SystemExit as stop:
        status = stop.code
    finally:
        sys.argv = before
    if status is None:
        return 0
    if isinstance(status, int):
        return status
    print(status, file=sys.stderr)
    return 1


def lerobot_commands() -> dict[str, metadata.EntryPoint]:
    """Return name -> entry point of every command of the installed LeRobot (``eval``: ``lerobot-eval``)."""
    prefix = "lerobot-"
    return {
        entry.name.removeprefix(prefix): entry
        for entry in metadata.distribution("lerobot").entry_points
        if entry.group == "console_scripts" and entry.name.startswith(prefix)
    }


def overview(commands: Sequence[str] | dict[str, Any]) -> str:
    """Return the help of ``lerobot`` itself."""
    return "\n".join(
        [
            "usage: lerobot <command> key=value … [--flag=value …]",
            "",
            "  lerobot eval env=memobench                                   the scripted expert on all tasks",
            "  lerobot eval env=memobench policy=<checkpoint> tasks=object  a trained policy",
            "  lerobot train policy=memobench_mem align=contrastive dataset=<folder>",
            "  lerobot train config=train_contrastive dataset=<folder>      the paper's recipe (memobench recipe)",
            "",
            "short forms: policy= env= dataset= align= size= replan= tasks= referent= episodes= batch_size=",
            "device=; any other setting by its full name (policy.optimizer_lr=1e-4), as listed by",
            "`lerobot <command> --help`. How the benchmark's evaluation is run: resume=true, shard=1/8, shards=8",
            "workers= executor= executor_option=.",
            "",
            "commands: " + ", ".join(sorted(commands)),
        ]
    )


def check_tasks_early(words: Words) -> None:
    """Refuse unknown task names before LeRobot's import, which takes many seconds."""
    from lerobot_memobench.tasks.catalogue import resolve_tasks

    settings = dict(words.settings)
    environment = settings.get("env", settings.get("env.type", flag_value(words.flags, "env.type")))
    own_folder = "env.task_dir" in settings or flag_value(words.flags, "env.task_dir")
    tasks = settings.get("tasks", settings.get("env.tasks", flag_value(words.flags, "env.tasks")))
    if environment == "memobench" and tasks is not None and not own_folder:
        resolve_tasks(tasks)


def register_plugins() -> None:
    """Let LeRobot find its plugins as its own commands do, without the log lines about it."""
    from lerobot.utils.import_utils import register_third_party_plugins

    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        register_third_party_plugins()
    finally:
        logging.disable(level)


def config_class(entry: Callable[[], Any]) -> type | None:
    """Return the configuration dataclass of a LeRobot command, None where it uses plain argparse.

    LeRobot wraps the function that takes the configuration, in the module of the command's main function.
    """
    import dataclasses
    import typing

    module = sys.modules[entry.__module__]
    for function in vars(module).values():
        inner = getattr(function, "__wrapped__", None)
        if inner is None or getattr(function, "__module__", None) != entry.__module__:
            continue
        try:
            hints = typing.get_type_hints(inner)
        except NameError:  # a type that is imported for checkers only
            hints = getattr(inner, "__annotations__", {})
        for hint in list(hints.values())[:1]:
            if dataclasses.is_dataclass(hint):
                return typing.cast(type, hint)
    return None


def read_config_file(words: Words) -> dict[str, Any]:
    """Return the content of the local file that ``config_path`` names, {} without one."""
    from pathlib import Path

    import yaml

    given = dict(words.settings).get("config_path", flag_value(words.flags, "config_path"))
    if given is None:
        return {}
    path = Path(given).expanduser()
    if path.is_dir():
        path = path / "train_config.json"
    if not path.is_file():
        return {}  # a repository: LeRobot fetches it
    try:
        content = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise MemobenchError(f"config_path={given} is neither YAML nor JSON: {problem}") from None
    if not isinstance(content, dict):
        raise MemobenchError(f"config_path={given} holds no settings; expected a mapping such as 'policy: …'")
    return content


if __name__ == "__main__":
    sys.exit(main())
