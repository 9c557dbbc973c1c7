"""``lerobot eval env=memobench``: the benchmark's defaults before LeRobot's run, its report after it."""

from __future__ import annotations

import datetime as dt
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path

from lerobot_memobench.cli import preflight
from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.report import REPORT_MARKDOWN

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
FIRST_SEED = 7
"""Episode i of the protocol uses seed 7 + i."""


def evaluate(translation: Translation, run: Callable[[], int], say_where: bool = True) -> int:
    """Complete the flags of an evaluation, run it, write and print its report; return the exit status.

    An environment of LeRobot's own gets nothing but the checks.
    """
    if not translation.has("env.type") and not translation.has("config_path"):
        raise MemobenchError("name an environment: env=memobench")
    if translation.get("env.type") != ENVIRONMENT:
        preflight.check_policy(translation)
        return run()
    add_policy(translation)
    preflight.check_policy(translation)
    policy = preflight.parse_choice(translation, "policy")
    add_protocol(translation, getattr(policy, "n_action_steps", None))
    environment = preflight.parse_choice(translation, "env")
    if environment is not None:
        environment.selected()  # unknown tasks are told here
    preflight.check_rendering()
    output, log = Path(translation.get("output_dir") or ""), Path(translation.get("env.log_dir") or "")
    preflight.check_output(output)
    preflight.check_output(log)
    existed = output.exists()
    calm_output()
    status = 1
    try:
        status = run()
    finally:
        if status and not existed:
            preflight.remove_empty(output)
        if status and has_log(log):
            print(
                f"the episodes that ended are in {log}; `memobench report {log}` reports them",
                file=sys.stderr,
            )
    if status == 0:
        print_report(log, int(translation.get("eval.n_episodes") or 0) or None)
        if say_where:
            print(f"report: {log / REPORT_MARKDOWN}")
    return status


def calm_output() -> None:
    """Keep progress bars out of log files, and a library's farewell out of the end of a run."""
    from lerobot.scripts import lerobot_eval

    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    if not sys.stderr.isatty():
        # The bar is redrawn at every step. LeRobot leaves it out where it takes itself to be in a batch job.
        lerobot_eval.inside_slurm = lambda: True


def add_policy(translation: Translation) -> None:
    """Use the scripted expert where no policy is named, and let the environment offer it its action."""
    if not translation.has("policy.path"):
        translation.add("policy.type", EXPERT)
    if translation.get("policy.type") == EXPERT:
        translation.add("env.expert_action", True)
    if "policy" not in translation.chosen:
        from lerobot.configs.policies import PreTrainedConfig

        name = translation.get("policy.type")
        if name is not None:
            translation.chosen["policy"] = PreTrainedConfig.get_choice_class(name)


def add_protocol(translation: Translation, n_action_steps: int | None) -> None:
    """Set seed, episodes, batch size, device and folders where the user has not."""
    import torch

    translation.add("seed", FIRST_SEED)
    translation.add("eval.n_episodes", 50)
    add_batch_size(translation)
    if not torch.cuda.is_available() and not torch.backends.mps.is_available():
        translation.add("policy.device", "cpu")
    if n_action_steps is not None:
        translation.add("env.replan_steps", n_action_steps)
    translation.add("output_dir", default_output(translation))
    translation.add("env.log_dir", translation.get("output_dir"))


def add_batch_size(translation: Translation) -> None:
    """Choose the largest batch that LeRobot would choose and that divides the episodes.

    LeRobot runs whole batches and throws the surplus of the last one away, after simulating it.
    """
    if (translation.get("eval.batch_size") or "0") != "0":
        return
    episodes = int(translation.get("eval.n_episodes") or 50)
    limit = max(1, min(int((os.cpu_count() or 4) * 0.7), episodes, 64))
    best = max(size for size in range(1, limit + 1) if episodes % size == 0)
    translation.flags = [flag for flag in translation.flags if flag != "--eval.batch_size=0"]
    translation.add("eval.batch_size", best)


def default_output(translation: Translation) -> Path:
    """Return a folder that no evaluation has used: ``outputs/eval/<date>/<time>_memobench_<policy>``."""
    chosen = translation.chosen.get("policy")
    name = translation.get("policy.type") or (chosen.get_choice_name(chosen) if chosen else "policy")  # type: ignore[attr-defined]
    now = dt.datetime.now()
    base = Path("outputs/eval") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{ENVIRONMENT}_{name}"
    folder, k = base, 1
    while folder.exists():
        k += 1
        folder = base.with_name(f"{base.name}_{k}")
    return folder


def print_report(folder: Path, episodes: int | None) -> None:
    """Write the report of the log in ``folder`` beside it and print its table."""
    from lerobot_memobench.cli.console import console
    from lerobot_memobench.evaluation.report import failure_line, table, write_report

    summary, notes = write_report(folder, episodes)
    out = console()
    out.print()
    out.print(table(summary))
    out.print(failure_line(summary))
    for note in notes:
        out.print(f"note: {note}")
