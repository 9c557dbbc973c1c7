"""``lerobot train``: read the command, refuse mistakes, and start the loop of memory policies or LeRobot's trainer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    INFO_FILE,
    check_whole,
    naming_damage,
    read_info,
)
from lerobot_memobench.envs.observations import check_obs_type
from lerobot_memobench.envs.settings import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.io import check_fetched
from lerobot_memobench.jobs.processes import adding_resume_hint, locked
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import CONFIG_FILE as POLICY_CONFIG
from lerobot_memobench.policies.checkpoint import (
    as_trained,
    check_weights,
    differing,
    local_folder,
    looks_local,
    read_json,
)
from lerobot_memobench.policies.lerobot_config import check_device, quiet
from lerobot_memobench.run.arguments import (
    CONFIG_FILE,
    TRAINING_OPTIONS,
    Arguments,
    LerobotArguments,
    checked_value,
    env_config,
    policy_config,
    read_arguments,
    read_config_file,
    resolve_recipe,
    whole_number,
)
from lerobot_memobench.training.resume import (
    check_same_training,
    make_room_for_link,
    note_on_resume,
    resume_hint,
    resumed,
)

MEMORY_POLICY = "memobench_mem"
OBJECT_BATCH = 72
"""Default frames per update of a policy whose samples are in main memory: a dozen episodes, six frames of each."""
SHORT_TRAINING = 2000
"""Updates below which losses are logged ten times; LeRobot's default of every 200 updates would log too few."""
TRAINED = ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
"""Settings that name the model to train."""
MEMORY_DEFAULTS: Mapping[str, object] = {
    "memory_stride": None,
    "memory_fusion": None,
    "memory_phase": False,
    "memory_repeats": True,
    "subgoals": None,
}
"""Settings that a memory does not take over from another memory's checkpoint or recipe -> their defaults."""
SMALLEST = {"steps": 1, "batch_size": 1, "num_workers": 0, "eval.batch_size": 0, "eval.n_episodes": 1}
"""Setting -> its smallest value."""


def train(given: Arguments, line: Sequence[str], notify: Callable[[str], None]) -> int:
    """Run ``lerobot train``; return the exit status.

    Args:
        line: the words of the command, for the message that explains how to resume.
        notify: called with notes.
    """
    begun = time.time()
    prompt_frames, obs_type, given = take_training_options(resolve_recipe(resumed(given)))
    arguments = read_arguments("train", given)
    if given.wants_help:
        return run_lerobot(arguments.for_parser)
    arguments = complete_training(arguments, notify)
    note, updates_left = note_on_resume(arguments)
    if note is not None:
        notify(note)
    if not updates_left:
        return 0
    make_room_for_link(arguments)
    root = arguments.get("dataset.root")
    with (
        adding_resume_hint("lerobot", lambda: resume_hint(arguments, line, begun)),
        locked_run(arguments),
        naming_damage(Path(root) if root else None),
    ):
        policy = arguments.chosen.get("policy")
        if policy is not None and policy.get_choice_name(policy) == MEMORY_POLICY:  # type: ignore[attr-defined]
            from lerobot_memobench.training.configuration import read_training
            from lerobot_memobench.training.loop import train as train_memory_policy

            train_memory_policy(read_training(arguments.for_parser))
            return 0
        from lerobot_memobench.training.view import viewed

        status = run_lerobot(viewed(arguments, prompt_frames, obs_type, notify).for_parser)
        if status and root and (Path(root) / INFO_FILE).is_file() and not arguments.has("dataset.episodes"):
            check_whole(Path(root))  # LeRobot's error does not name the damaged file
        return status


def run_lerobot(flags: Sequence[str]) -> int:
    """Run LeRobot's trainer, with samples in memory, in a process of its own; return its exit status."""
    command = [sys.executable, "-m", "lerobot_memobench.training.samples", *flags]
    return subprocess.run(command, check=False).returncode


@contextmanager
def locked_run(arguments: LerobotArguments) -> Iterator[None]:
    """Lock the folder of a training, in its first process.

    The lock is a file next to the folder, because LeRobot refuses a folder that exists before its first checkpoint.

    Raises:
        MemobenchError: another training holds the lock.
    """
    named = arguments.get("output_dir") or read_config_file(arguments.get(CONFIG_FILE)).get("output_dir")
    if not isinstance(named, str) or os.environ.get("RANK", "0") != "0":
        yield
        return
    run = Path(named).expanduser().absolute()
    run.parent.mkdir(parents=True, exist_ok=True)
    lock = run.with_name(f".{run.name}.lock")
    lock.touch()
    with locked(lock, run):
        try:
            yield
        finally:
            with suppress(OSError):  # Windows does not delete an open file
                lock.unlink()


def take_training_options(given: Arguments) -> tuple[bool | None, str | None, Arguments]:
    """Split off the options that LeRobot does not have.

    Returns:
        Whether frames of demonstration prompts are trained on, the kind of observation (each None if it is not given),
        and the other arguments.

    Raises:
        MemobenchError: an option has an unknown value.
    """
    found = dict(given.pairs)
    of_env = {"obs_type"} if "env" in found else set()  # it is a setting of the environment, too
    rest = [pair for pair in given.pairs if pair[0] in of_env or pair[0] not in TRAINING_OPTIONS]
    obs_type = found.get("obs_type")
    if obs_type is not None:
        check_choice("obs_type", obs_type, OBS_TYPES)
    prompts = checked_value("prompt_frames", bool | None, found.get("prompt_frames", "null"))
    return {"true": True, "false": False}.get(prompts), obs_type, replace(given, pairs=rest)


def complete_training(arguments: LerobotArguments, notify: Callable[[str], None] = print) -> LerobotArguments:
    """Check a training's arguments, and add the benchmark's defaults.

    Args:
        notify: called with notes.

    Raises:
        MemobenchError: no policy is named, a number is too small, the dataset or the checkpoint cannot be used, or a
            resumed training has other settings.
    """
    from_file = arguments.has(CONFIG_FILE)
    if not from_file:
        if not any(arguments.has(key) for key in TRAINED):
            raise MemobenchError("name a policy: policy=memobench_mem")
        arguments = arguments.default("dataset.repo_id", DEFAULT_REPO_ID)
        named = arguments.has("policy.type") or arguments.has("policy.path")
        if named and not arguments.has("policy.repo_id"):  # LeRobot would require one
            arguments = arguments.default("policy.push_to_hub", False)
    check_device(arguments.get("policy.device"))
    check_numbers(arguments)
    check_dataset(arguments)
    check_same_training(arguments)
    arguments, policy = parse_policy(with_memory_defaults(arguments))
    check_memory_settings(arguments, policy)
    path = arguments.get("policy.path")
    if path is not None and policy is not None:
        with quiet():
            trained = as_trained(path, policy)
            check_weights(path, trained)
        changed = list(differing(policy, trained, getattr(policy, "fixed_by_training", ())))
        if changed:
            was, now = (", ".join(f"{item[0]}={item[part]}" for item in changed) for part in (2, 1))
            notify(f"note: '{path}' was trained with {was}; this training continues from its weights with {now}")
    environment: Any = env_config(arguments)
    if environment is not None and environment.type == "memobench":
        check_obs_type(policy, environment.obs_type, environment.suite)
    steps = whole_number(arguments.get("steps"))
    if steps is not None and steps < SHORT_TRAINING and arguments.get("resume") != "true":
        arguments = arguments.default("log_freq", max(1, steps // 10))
    if not from_file and getattr(policy, "decodes_no_video", False):
        arguments = arguments.default("batch_size", OBJECT_BATCH)
    if cores() < 4 and not from_file:  # LeRobot's default is four loaders
        arguments = arguments.default("num_workers", cores())
    return arguments


def parse_policy(arguments: LerobotArguments) -> tuple[LerobotArguments, Any]:
    """Parse the policy's configuration; it is None if a configuration file is named.

    Settings of a checkpoint that have no effect under the settings of the command line are reset to their defaults.
    """
    from draccus.utils import ParsingError

    try:
        return arguments, policy_config(arguments)
    except ParsingError as error:
        unread = getattr(error.__cause__, "defaults", {})
        if not unread or arguments.get("policy.path") is None:
            raise
        for name, value in unread.items():
            arguments = arguments.default(f"policy.{name}", json.dumps(value))
        return arguments, policy_config(arguments)


def with_memory_defaults(arguments: LerobotArguments) -> LerobotArguments:
    """Return arguments in which a memory that differs from the checkpoint's or the recipe's has its own defaults."""
    memory, path = arguments.get("policy.memory"), arguments.get("policy.path")
    if memory is None:
        return arguments
    folder = None if path is None else local_folder(path)
    recipe = read_config_file(arguments.get(CONFIG_FILE)).get("policy")
    begun = read_json(folder / POLICY_CONFIG) if folder is not None else recipe if isinstance(recipe, dict) else {}
    held = begun.get("memory") or ("none" if begun.get("memory_fusion") == "none" else "frames")
    if begun.get("type") != MEMORY_POLICY or held == ("frames" if memory == "null" else memory):
        return arguments
    for name, value in MEMORY_DEFAULTS.items():
        arguments = arguments.default(f"policy.{name}", "null" if value is None else value)
    return arguments


def check_numbers(arguments: LerobotArguments) -> None:
    """Refuse numbers on the command line, or else in the configuration file, that are below `SMALLEST`."""
    file = read_config_file(arguments.get(CONFIG_FILE))
    for key, smallest in SMALLEST.items():
        section, _, name = key.rpartition(".")
        held = file.get(section) if section else file
        number = whole_number(arguments.get(key) or (str(held.get(name)) if isinstance(held, dict) else None))
        if number is not None and number < smallest:
            raise MemobenchError(f"found {key}={number}; expected at least {smallest}")


def check_dataset(arguments: LerobotArguments) -> None:
    """Refuse a folder that is not a dataset; a folder that does not exist may be one to download into."""
    root, repository = arguments.get("dataset.root"), arguments.get("dataset.repo_id")
    if root is None:
        if repository is not None and looks_local(repository):
            raise MemobenchError(
                f"dataset.repo_id={repository} is a folder's path; name the folder by dataset=<folder>"
            )
        return
    folder = Path(root).expanduser()
    if not folder.exists() and not (repository or "").startswith("local/"):
        return
    if not (folder / INFO_FILE).is_file():
        problem = f"is not a LeRobot dataset ({INFO_FILE} is missing)" if folder.is_dir() else "does not exist"
        raise MemobenchError(f"the dataset folder {root} {problem}; make one with `memobench generate --out <folder>`")
    read_info(folder)
    check_fetched(folder)


def check_memory_settings(arguments: LerobotArguments, policy: Any) -> None:
    """Refuse settings on the command line that belong to another memory; errors as of `read_settings`."""
    from lerobot_memobench.policies.memobench_mem.memory import NONE, read_settings

    given = yaml.safe_load(arguments.get("policy.memory_settings") or "{}")
    if given and getattr(policy, "memory", NONE) != NONE:
        read_settings(policy.memory, given)
