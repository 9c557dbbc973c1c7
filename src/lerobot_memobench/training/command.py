"""``lerobot train``: read the command, refuse mistakes, and start the loop of memory policies or LeRobot's trainer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_memobench.datasets.episodes import check_whole, naming_damage, read_info
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID, INFO_FILE
from lerobot_memobench.envs.observations import check_obs_type
from lerobot_memobench.envs.settings import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.io import check_fetched
from lerobot_memobench.jobs.processes import adding_resume_hint, locked
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import CONFIG_FILE as POLICY_CONFIG
from lerobot_memobench.policies.checkpoint import (
    as_trained,
    check_checkpoint,
    check_weights,
    differing,
    local_folder,
    looks_local,
    read_json,
)
from lerobot_memobench.policies.lerobot_config import check_device, check_sizes, quiet
from lerobot_memobench.run.command_line import (
    HELP,
    PATH,
    TRAINING_OPTIONS,
    CommandSettings,
    read_words,
    resolve_recipe,
    spelled,
    value_of,
    without,
)
from lerobot_memobench.run.lerobot_commands import call_lerobot
from lerobot_memobench.training.resume import (
    check_same_training,
    make_room_for_link,
    note_on_resume,
    resume_hint,
    resumed,
)

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

MEMORY_POLICY = "memobench_mem"
OBJECT_BATCH = 72
"""Default frames per update of a policy whose samples are in main memory: a dozen episodes, six frames of each."""
SHORT_TRAINING = 2000
"""Updates below which losses are logged ten times; LeRobot's default of every 200 updates would log too few."""
TRAINED = ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
"""Settings that name the model to train."""
SMALLEST = {"steps": 1, "batch_size": 1, "num_workers": 0, "eval.batch_size": 0, "eval.n_episodes": 1}
"""Setting -> its smallest value."""


def train(words: Mapping[str, str], notify: Callable[[str], None]) -> int:
    """Run ``lerobot train``; return the exit status.

    Args:
        words: of the command line (`run.command_line.parse_words`).
        notify: called with notes.
    """
    begun = time.time()
    prompt_frames, obs_type, rest = take_training_options(resolve_recipe(resumed(words)))
    asked = read_words("train", rest)
    if HELP in words:
        return call_lerobot("train", ["--help", *(f"--{word}" for word in spelled(asked.words))])
    asked, config = complete_training(asked, notify)
    note, updates_left = note_on_resume(asked, config)
    if note is not None:
        notify(note)
    if not updates_left:
        return 0
    make_room_for_link(asked)
    root = config.dataset.root
    with (
        adding_resume_hint("lerobot", lambda: resume_hint(asked, words, begun)),
        locked_run(config),
        naming_damage(Path(root) if root else None),
    ):
        if config.policy is not None and config.policy.type == MEMORY_POLICY:
            from lerobot_memobench.training.configuration import complete
            from lerobot_memobench.training.loop import train as train_memory_policy

            train_memory_policy(complete(config, asked))
            return 0
        from lerobot_memobench.training.view import viewed

        status = run_lerobot(viewed(config, prompt_frames, obs_type, notify), asked.config_path)
        if status and root and (Path(root) / INFO_FILE).is_file() and config.dataset.episodes is None:
            check_whole(Path(root))  # LeRobot's error does not name the damaged file
        return status


def run_lerobot(config: TrainPipelineConfig, config_path: str | None) -> int:
    """Run LeRobot's trainer, with samples in memory, in a process of its own; return its exit status.

    Args:
        config_path: the file or repository of a resumed training.
    """
    import draccus

    line = [f"--config_path={config_path}"] if config.resume and config_path is not None else []
    command = [sys.executable, "-m", "lerobot_memobench.training.samples", *line]
    return subprocess.run(command, input=json.dumps(draccus.encode(config)).encode(), check=False).returncode


@contextmanager
def locked_run(config: TrainPipelineConfig) -> Iterator[None]:
    """Lock the folder of a training, in its first process.

    The lock is a file next to the folder, because LeRobot refuses a folder that exists before its first checkpoint.

    Raises:
        MemobenchError: another training holds the lock.
    """
    if config.output_dir is None or os.environ.get("RANK", "0") != "0":
        yield
        return
    run = Path(config.output_dir).expanduser().absolute()
    run.parent.mkdir(parents=True, exist_ok=True)
    lock = run.with_name(f".{run.name}.lock")
    lock.touch()
    with locked(lock, run):
        try:
            yield
        finally:
            with suppress(OSError):  # Windows does not delete an open file
                lock.unlink()


def take_training_options(words: Mapping[str, str]) -> tuple[bool | None, str | None, dict[str, str]]:
    """Split off the options that LeRobot does not have.

    Returns:
        Whether frames of demonstration prompts are trained on, the kind of observation (each None if it is not given),
        and the other words.

    Raises:
        MemobenchError: an option has an unknown value.
    """
    obs_type = words.get("obs_type")
    if obs_type is not None:
        check_choice("obs_type", obs_type, OBS_TYPES)
    prompts: bool | None = value_of("prompt_frames", bool | None, words.get("prompt_frames", "null"))
    rest = without(words, *TRAINING_OPTIONS)
    if obs_type is not None and "env" in words:  # it is a setting of the environment, too
        rest["obs_type"] = obs_type
    return prompts, obs_type, rest


def complete_training(
    asked: CommandSettings, notify: Callable[[str], None] = print
) -> tuple[CommandSettings, TrainPipelineConfig]:
    """Check a training's settings and add the benchmark's defaults; return them and the configuration.

    Args:
        notify: called with notes.

    Raises:
        MemobenchError: no policy is named, a number is too small, the dataset or the checkpoint cannot be used, or a
            resumed training has other settings.
    """
    if not any(asked.get(key) for key in TRAINED):
        raise MemobenchError("name a policy: policy=memobench_mem")
    asked = asked.default("dataset.repo_id", DEFAULT_REPO_ID)
    if asked.get("policy") and asked.get("policy.repo_id") is None:  # LeRobot would require one
        asked = asked.default("policy.push_to_hub", False)
    path = asked.get(f"policy.{PATH}")
    check_device(asked.get("policy.device"))
    check_dataset(asked)
    if path is not None:
        check_checkpoint(path)
    asked, config = build_training(with_memory_defaults(asked))
    check_numbers(config)
    check_same_training(asked, config)
    policy: Any = config.policy
    if policy is not None:
        check_sizes(policy)
        check_memory_settings(asked, policy)
    if path is not None:
        with quiet():
            trained = as_trained(path, policy)
            check_weights(path, trained)
        changed = list(differing(policy, trained, getattr(policy, "fixed_by_training", ())))
        if changed:
            was, now = (", ".join(f"{item[0]}={item[part]}" for item in changed) for part in (2, 1))
            notify(f"note: '{path}' was trained with {was}; this training continues from its weights with {now}")
    if getattr(config.env, "type", None) == "memobench":
        check_obs_type(policy, config.env.obs_type, config.env.suite)
    if config.steps < SHORT_TRAINING and asked.get("log_freq") is None:
        config.log_freq = max(1, config.steps // 10)
    if asked.get("batch_size") is None and getattr(policy, "decodes_no_video", False):
        config.batch_size = OBJECT_BATCH
    if asked.get("num_workers") is None and cores() < 4:  # LeRobot's default is four loaders
        config.num_workers = cores()
    return asked, config


def build_training(asked: CommandSettings) -> tuple[CommandSettings, TrainPipelineConfig]:
    """Return the settings and the configuration.

    Settings of a checkpoint that have no effect under the settings of the command line are reset to their defaults.
    """
    try:
        return asked, asked.build()
    except MemobenchError as error:
        unread = getattr(error, "defaults", {})
        if not unread or asked.get(f"policy.{PATH}") is None:
            raise
        asked = replace(asked, words={**{f"policy.{name}": value for name, value in unread.items()}, **asked.words})
        return asked, asked.build()


def with_memory_defaults(asked: CommandSettings) -> CommandSettings:
    """Return settings in which a memory that differs from the checkpoint's or the recipe's has its own defaults."""
    memory, path = asked.words.get("policy.memory"), asked.get(f"policy.{PATH}")
    if memory is None:
        return asked
    folder = None if path is None else local_folder(path)
    begun = read_json(folder / POLICY_CONFIG) if folder is not None else asked.file.get("policy") or {}
    if begun.get("type") != MEMORY_POLICY:
        return asked
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig, memory_defaults

    if begun.get("memory", MemobenchMemConfig.memory) == memory:
        return asked
    defaults = {f"policy.{name}": value for name, value in memory_defaults().items()}
    return replace(asked, words={**defaults, **asked.words})


def check_numbers(config: TrainPipelineConfig) -> None:
    """Refuse numbers below `SMALLEST`."""
    for key, smallest in SMALLEST.items():
        found: Any = config
        for part in key.split("."):
            found = getattr(found, part)
        if found < smallest:
            raise MemobenchError(f"found {key}={found}; expected at least {smallest}")


def check_dataset(asked: CommandSettings) -> None:
    """Refuse a folder that is not a dataset; a folder that does not exist may be one to download into."""
    root, repository = asked.get("dataset.root"), asked.get("dataset.repo_id")
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


def check_memory_settings(asked: CommandSettings, policy: Any) -> None:
    """Refuse settings on the command line that belong to another memory; errors as of `read_settings`."""
    from lerobot_memobench.policies.memobench_mem.memory import NONE, read_settings

    given = asked.words.get("policy.memory_settings")
    if given and getattr(policy, "memory", NONE) != NONE:
        read_settings(policy.memory, value_of("policy.memory_settings", dict[str, Any], given))
