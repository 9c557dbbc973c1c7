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

from lerobot_memobench.datasets.lerobot_format.layout import DEFAULT_REPO_ID, INFO_FILE, check_whole, naming_damage
from lerobot_memobench.envs.command_line import quiet
from lerobot_memobench.envs.observations import check_obs_type
from lerobot_memobench.envs.settings import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.processes import locked, saying_how_to_go_on
from lerobot_memobench.jobs.threads import LEARNING, cores, use_threads
from lerobot_memobench.policies.checkpoint import CONFIG_FILE as POLICY_CONFIG
from lerobot_memobench.policies.checkpoint import (
    as_trained,
    check_weights,
    differing,
    local_folder,
    read_json,
)
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
    how_to_go_on,
    make_room_for_link,
    note_on_resume,
    resumed,
)

MEMORY_POLICY = "memobench_mem"
OBJECT_BATCH = 72
"""Default frames per update of a policy whose samples lie in main memory: a dozen episodes, six frames of each."""
TRAINED = ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
"""Settings that name what is trained."""
OF_MEMORY: Mapping[str, object] = {
    "memory_stride": None,
    "memory_fusion": None,
    "memory_frames": 32,
    "memory_phase": False,
    "subgoals": None,
}
"""Settings that another memory does not take over from a checkpoint or a recipe -> their defaults."""


def train(given: Arguments, line: Sequence[str], tell: Callable[[str], None]) -> int:
    """Run ``lerobot train``; return the exit status.

    Args:
        line: the words of the command, for the message that says how to resume.
        tell: called with notes.
    """
    begun = time.time()
    use_threads(LEARNING)
    prompt_frames, obs_type, given = take_training_options(resolve_recipe(resumed(given)))
    arguments = read_arguments("train", given)
    if given.wants_help:
        return run_lerobot(arguments.for_parser)
    arguments = complete_training(arguments)
    note, left = note_on_resume(arguments)
    for noted in (note, note_on_start(arguments)):
        if noted is not None:
            tell(noted)
    if not left:
        return 0
    make_room_for_link(arguments)
    root = arguments.get("dataset.root")
    with (
        saying_how_to_go_on("lerobot", lambda: how_to_go_on(arguments, line, begun)),
        held_run(arguments),
        naming_damage(Path(root) if root else None),
    ):
        if policy_type(arguments) == MEMORY_POLICY:
            from lerobot_memobench.training.configuration import read_training
            from lerobot_memobench.training.loop import train as train_memory_policy

            train_memory_policy(read_training(arguments.for_parser))
            return 0
        from lerobot_memobench.training.view import viewed

        status = run_lerobot(viewed(arguments, prompt_frames, obs_type, tell).for_parser)
        if status and root and (Path(root) / INFO_FILE).is_file() and not arguments.has("dataset.episodes"):
            check_whole(Path(root))  # its error, in the other process, does not name the file
        return status


def run_lerobot(flags: Sequence[str]) -> int:
    """Run LeRobot's trainer in a process of its own; return its exit status."""
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_train", *flags]
    return subprocess.run(command, check=False).returncode


def policy_type(arguments: LerobotArguments) -> str | None:
    """Return the type of the policy that is trained, None for a reward model."""
    kind = arguments.chosen.get("policy")
    return None if kind is None else str(kind.get_choice_name(kind))  # type: ignore[attr-defined]


@contextmanager
def held_run(arguments: LerobotArguments) -> Iterator[None]:
    """Hold the folder of a training by a lock file beside it, in the training's first process.

    LeRobot refuses a folder that exists before its first checkpoint, so the lock cannot lie in it.

    Raises:
        MemobenchError: another training holds it.
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
            with suppress(OSError):  # Windows keeps a file that is open
                lock.unlink()


# -- the words ---------------------------------------------------------------------------------------------------------


def take_training_options(given: Arguments) -> tuple[bool | None, str | None, Arguments]:
    """Return the options of a command line that LeRobot does not have, and the arguments without them.

    Returns:
        Whether frames of demonstration prompts are trained on, the kind of observation (each None if it is not given),
        and the rest.

    Raises:
        MemobenchError: the first is neither true nor false, or the second no kind of observation.
    """
    found = dict(given.pairs)
    of_env = {"obs_type"} if "env" in found else set()  # it is a setting of it, too
    rest = [pair for pair in given.pairs if pair[0] in of_env or pair[0] not in TRAINING_OPTIONS]
    obs_type = found.get("obs_type")
    if obs_type is not None and obs_type not in OBS_TYPES:
        raise MemobenchError(f"found obs_type={obs_type}, {nearest(obs_type, OBS_TYPES)}")
    wanted = checked_value("prompt_frames", bool | None, found.get("prompt_frames", "null"))
    return {"true": True, "false": False}.get(wanted), obs_type, replace(given, pairs=rest)


def complete_training(arguments: LerobotArguments) -> LerobotArguments:
    """Return a training's arguments with the benchmark's defaults.

    Raises:
        MemobenchError: no policy is named, a number is too small, or the dataset or the model checkpoint is none.
    """
    from lerobot_memobench.training.checks import check_dataset, check_memory_settings, check_numbers

    from_file = arguments.has(CONFIG_FILE)
    if not from_file:
        if not any(arguments.has(key) for key in TRAINED):
            raise MemobenchError("name a policy: policy=memobench_mem")
        arguments = arguments.default("dataset.repo_id", DEFAULT_REPO_ID)
        named = arguments.has("policy.type") or arguments.has("policy.path")
        if named and not arguments.has("policy.repo_id"):  # LeRobot would ask for one
            arguments = arguments.default("policy.push_to_hub", False)
    check_numbers(arguments)
    check_dataset(arguments)
    check_same_training(arguments)
    arguments = without_unread(with_own_memory(arguments))
    policy = policy_config(arguments)
    check_memory_settings(arguments, policy)
    path = arguments.get("policy.path")
    if path is not None and policy is not None:
        with quiet():
            check_weights(path, as_trained(path, policy))
    environment: Any = env_config(arguments)
    if environment is not None and environment.type == "memobench":
        check_obs_type(policy, environment.obs_type)
    steps = whole_number(arguments.get("steps"))
    if steps is not None and steps < 2000 and arguments.get("resume") != "true":
        # LeRobot's default of every 200 steps shows no loss of a short run.
        arguments = arguments.default("log_freq", max(1, steps // 10))
    if not from_file and getattr(policy, "decodes_no_video", False):
        arguments = arguments.default("batch_size", OBJECT_BATCH)
    if cores() < 4 and not from_file:  # LeRobot's default of 4 loaders would only wait for one another
        arguments = arguments.default("num_workers", cores())
    return arguments


def with_own_memory(arguments: LerobotArguments) -> LerobotArguments:
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
    for name, value in OF_MEMORY.items():
        arguments = arguments.default(f"policy.{name}", "null" if value is None else value)
    return arguments


def without_unread(arguments: LerobotArguments) -> LerobotArguments:
    """Return arguments that reset settings of a checkpoint that have no effect under the settings of the line.

    Those of the line itself are refused later.
    """
    if arguments.get("policy.path") is None:
        return arguments
    from draccus.utils import ParsingError

    try:
        policy_config(arguments)
    except ParsingError as error:
        for name, value in getattr(error.__cause__, "defaults", {}).items():
            arguments = arguments.default(f"policy.{name}", json.dumps(value))
    return arguments


def note_on_start(arguments: LerobotArguments) -> str | None:
    """Return a note if a training begins from a checkpoint under other settings than its weights were trained for."""
    path = arguments.get("policy.path")
    policy = None if path is None else policy_config(arguments)
    if path is None or policy is None:
        return None
    fixed = getattr(policy, "fixed_by_training", ())
    with quiet():
        changed = list(differing(policy, as_trained(path, policy), fixed)) if fixed else []
    if not changed:
        return None
    was, now = (", ".join(f"{item[0]}={item[part]}" for item in changed) for part in (2, 1))
    return f"note: '{path}' was trained with {was}, and its weights are now trained on with {now}"
