"""The command ``lerobot``: ``lerobot <name> key=value …`` runs LeRobot's own ``lerobot-<name>``.

``key=value`` becomes ``--key=value`` after a check against the command's settings; whatever starts with
``--`` is passed on untouched. ``lerobot eval env=memobench`` and ``lerobot train policy=…`` also get the
defaults that make them work as they stand (``engine.planning``, ``settings.training``).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from lerobot_memobench.cli.errors import one_sentence
from lerobot_memobench.engine.lerobot_command import call_lerobot
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.settings.lerobot_commands import lerobot_commands
from lerobot_memobench.settings.reading import check_task_names, read_settings
from lerobot_memobench.settings.recipes import resolve_recipe
from lerobot_memobench.settings.short_forms import MEANINGS, help_text
from lerobot_memobench.settings.words import Words, split_words

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


def run(words: Sequence[str]) -> int:
    """Run the command line."""
    commands = lerobot_commands()
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview(commands))
        return 0
    name, rest = words[0], split_words(words[1:])
    if name not in commands:
        raise MemobenchError(f"there is no command {name!r}, {nearest(name, commands)}")
    if rest.wants_help and name in MEANINGS:
        print(help_text(name), flush=True)
    if name == "train":
        return train(rest)
    check_task_names(rest)
    if name == "eval":
        from lerobot_memobench.cli.evaluate import evaluate

        return evaluate(rest, ("lerobot", *words))
    return call_lerobot(name, read_settings(name, rest).flags)


def train(words: Words) -> int:
    """Run ``lerobot train`` with the benchmark's defaults, checked."""
    from lerobot_memobench.settings.training import complete_training, take_training_words

    prompt_frames, obs_type, words = take_training_words(resolve_recipe(words))
    check_task_names(words)
    settings = read_settings("train", words)
    if words.wants_help:
        return call_lerobot("train", settings.flags)
    from lerobot_memobench.engine.lerobot_training import trained_on

    settings = complete_training(settings)
    with trained_on(prompt_frames, obs_type):
        return call_lerobot("train", settings.flags)


def overview(commands: Iterable[str]) -> str:
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
            "`lerobot eval --help` and `lerobot train --help` explain these short forms; any other setting goes by its",
            "full name (policy.optimizer_lr=1e-4), as listed there.",
            "",
            "commands: " + ", ".join(sorted(commands)),
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
