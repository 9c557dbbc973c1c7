"""``lerobot train``: read the command, refuse mistakes, and start the loop of memory policies or LeRobot's trainer."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_memobench.commands.command_line import (
    CONFIG_FILE,
    HELP,
    PATH,
    RECIPE,
    TRAINING_OPTIONS,
    TYPE,
    CommandSettings,
    as_command_line,
    call_lerobot,
    read_words,
    resolve_recipe,
    value_of,
    without,
)
from lerobot_memobench.constants import MEMORY_POLICY
from lerobot_memobench.datasets.episodes import naming_damage, read_info
from lerobot_memobench.datasets.layout import DEFAULT_REPO_ID, INFO_FILE
from lerobot_memobench.envs.observations import check_obs_type
from lerobot_memobench.envs.settings import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, check_choice
from lerobot_memobench.jobs.processes import adding_resume_hint, locked
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.policies.checkpoint import CONFIG_FILE as POLICY_CONFIG
from lerobot_memobench.policies.checkpoint import (
    LAST,
    TRAIN_CONFIG,
    as_trained,
    check_as_begun,
    check_checkpoint,
    check_device,
    check_processors,
    check_sizes,
    check_weights,
    checkpoint_folder,
    checkpoint_type,
    checkpoints_of,
    differing,
    local_folder,
    looks_local,
    quiet,
    read_checkpoint_json,
    text_of_link,
)
from lerobot_memobench.untrusted import check_fetched

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

OBJECT_BATCH = 72
"""Default frames per update of a policy whose samples are in main memory: a dozen episodes, six frames of each."""
SHORT_TRAINING = 2000
"""Updates below which losses are logged ten times; LeRobot's default of every 200 updates would log too few."""
SMALLEST = {"steps": 1, "batch_size": 1, "num_workers": 0, "eval.batch_size": 0, "eval.n_episodes": 1}
"""Setting -> its smallest value; LeRobot checks none of them."""
READ = frozenset(
    {
        *("batch_size", "checkpoint_path", "cudnn_deterministic", "dataloader_multiprocessing_context", "dataset"),
        *("env", "env_eval_freq", "eval", "eval_steps", "job_name", "log_freq", "max_eval_samples", "num_workers"),
        *("optimizer", "output_dir", "peft", "persistent_workers", "policy", "prefetch_factor", "rename_map", "resume"),
        *("save_checkpoint", "save_checkpoint_to_hub", "save_freq", "scheduler", "seed", "steps", "tolerance_s"),
        *("use_policy_training_preset", "wandb"),
    }
)
"""Fields of LeRobot's configuration that the loop of memory policies reads, itself or through LeRobot's functions."""
TRAINING_STEP = Path("training_state") / "training_step.json"
FIXED = ("dataset.episodes", "dataset.revision", "optimizer.", "policy.optimizer_")
"""Beginnings of settings that a resumed training keeps; a saved optimizer overrides its own."""
NOT_COMPARED = {
    *("dataset.root", "dataset.repo_id", "log_freq", "num_workers", "output_dir", "resume", "save_freq", "steps")
}
"""Settings of a resumed training that other checks compare, or that change nothing that is learned."""


def run_training(words: Mapping[str, str], notify: Callable[[str], None]) -> int:
    """Run ``lerobot train`` by the words of `commands.command_line.parse_words`; return the exit status."""
    prompt_frames, obs_type, rest = take_training_options(resolve_recipe(with_last_checkpoint(words)))
    requested = read_words("train", rest)
    if HELP in words:
        return call_lerobot("train", ["--help", *(f"--{word}" for word in as_command_line(requested.words))])
    config = complete_training(requested, notify)
    if config.checkpoint_path is not None:
        done = step_reached(config.checkpoint_path)
        if done >= config.steps and not lacks_rollouts(config, done):
            run = config.checkpoint_path.parents[1]
            notify(f"the training in {run} has finished its {done} steps; for more, set steps=")
            return 0
        make_room_for_link(config.checkpoint_path.with_name(LAST))
    root = config.dataset.root
    with (
        adding_resume_hint("lerobot", lambda: resume_hint(config, words)),
        locked_run(requested.get("output_dir")),
        naming_damage(Path(root) if root else None),
    ):
        if config.policy is not None and config.policy.type == MEMORY_POLICY:
            from lerobot_memobench.training.loop import train

            train(config)
        else:
            from lerobot_memobench.training.trainer import prepare, run_lerobot

            run_lerobot(prepare(config, prompt_frames, obs_type, notify))
    return 0


def lacks_rollouts(config: TrainPipelineConfig, step: int) -> bool:
    """Return whether a memory policy's training was interrupted in its last rollouts."""
    if config.policy is None or config.policy.type != MEMORY_POLICY:
        return False  # LeRobot's trainer does not log them in a file
    from lerobot_memobench.training.loop import rollouts_missing

    return rollouts_missing(config, step)


@contextmanager
def locked_run(folder: str | None) -> Iterator[None]:
    """Lock the folder of a training if it is named, in its first process; refuse it if another training holds the lock.

    The lock is a file next to the folder, because LeRobot refuses a folder that exists before its first checkpoint.
    """
    if folder is None or os.environ.get("RANK", "0") != "0":
        yield
        return
    run = Path(folder).expanduser().absolute()
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
    """Return the options that LeRobot does not have, each None if it is not given, and the other words.

    The options are whether frames of demonstration prompts are trained on, and the kind of observation.
    """
    prompts: bool | None = value_of("prompt_frames", bool | None, words.get("prompt_frames", "null"))
    obs_type, rest = words.get("obs_type"), without(words, *TRAINING_OPTIONS)
    if obs_type is not None:
        check_choice("obs_type", obs_type, OBS_TYPES)
        if "env" in words:  # it is a setting of the environment, too
            rest["obs_type"] = obs_type
    return prompts, obs_type, rest


# -- configuration -----------------------------------------------------------------------------------------------------


def complete_training(requested: CommandSettings, notify: Callable[[str], None] = print) -> TrainPipelineConfig:
    """Return the configuration of a training with the benchmark's defaults, checked and completed by LeRobot."""
    if not (requested.get("policy") or requested.get("reward_model")):
        raise MemobenchError("name a policy: policy=memobench_mem")
    requested = requested.default("dataset.repo_id", DEFAULT_REPO_ID)
    if requested.get("policy") and requested.get("policy.repo_id") is None:  # LeRobot would require one
        requested = requested.default("policy.push_to_hub", False)
    path = requested.get(f"policy.{PATH}")
    check_device(requested.get("policy.device"))
    check_dataset(requested)
    if path is not None:
        check_checkpoint(path)
    requested, config = build_training(with_memory_defaults(requested))
    for key, smallest in SMALLEST.items():
        if (value := attrgetter(key)(config)) < smallest:
            raise MemobenchError(f"found {key}={value}; expected at least {smallest}")
    policy: Any = config.policy
    if getattr(policy, "type", None) == MEMORY_POLICY:
        check_settings(config)
        if "policy.supervised_with_answer" in requested.words:
            raise MemobenchError(
                "policy.supervised_with_answer follows from policy.align, policy.memory and the checkpoint that the "
                "training starts from, and cannot be set; leave it out"
            )
    check_with_lerobot(config, requested)
    if config.checkpoint_path is not None:
        check_same_training(requested, config, config.checkpoint_path, notify)
    if policy is not None:
        check_sizes(policy)
    given = requested.words.get("policy.memory_settings")  # a checkpoint may hold those of another memory
    if given and (memory := getattr(policy, "memory", "none")) != "none":
        from lerobot_memobench.policies.memobench_mem.memory import mechanism_settings

        mechanism_settings(memory, value_of("policy.memory_settings", dict[str, Any], given))
    if path is not None:
        with quiet():
            trained: Any = as_trained(path, policy)
            check_weights(path, trained)
        if getattr(trained, "supervised_with_answer", False):  # also where the checkpoint's file lacks it
            policy.supervised_with_answer = True
        changed = list(differing(policy, trained, getattr(policy, "fixed_by_training", ())))
        if changed:
            was, now = (", ".join(f"{item[0]}={item[part]}" for item in changed) for part in (2, 1))
            notify(f"note: '{path}' was trained with {was}; this training continues from its weights with {now}")
    if getattr(config.env, "type", None) == "memobench":
        check_obs_type(policy, config.env.obs_type, config.env.suite)
    if config.steps < SHORT_TRAINING and requested.get("log_freq") is None:
        config.log_freq = max(1, config.steps // 10)
    if requested.get("batch_size") is None and getattr(policy, "decodes_no_video", False):
        config.batch_size = OBJECT_BATCH
    if requested.get("num_workers") is None and cores() < 4:  # LeRobot's default is four loaders
        config.num_workers = cores()
    return config


def build_training(requested: CommandSettings) -> tuple[CommandSettings, TrainPipelineConfig]:
    """Return settings and configuration; settings of a checkpoint that have no effect under them get their defaults."""
    try:
        return requested, requested.build()
    except MemobenchError as error:
        unread = getattr(error, "defaults", {})
        if not unread or requested.get(f"policy.{PATH}") is None:
            raise
        defaults = {f"policy.{name}": value for name, value in unread.items()}
        requested = replace(requested, words={**defaults, **requested.words})
        return requested, requested.build()


def with_memory_defaults(requested: CommandSettings) -> CommandSettings:
    """Return settings in which a memory that differs from the checkpoint's or the recipe's has its own defaults."""
    memory, path = requested.words.get("policy.memory"), requested.get(f"policy.{PATH}")
    if memory is None:
        return requested
    folder = None if path is None else local_folder(path)
    begun = read_checkpoint_json(folder / POLICY_CONFIG) if folder is not None else requested.file.get("policy") or {}
    if begun.get("type") != MEMORY_POLICY:
        return requested
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig, memory_defaults

    if begun.get("memory", MemobenchMemConfig.memory) == memory:
        return requested
    defaults = {f"policy.{name}": value for name, value in memory_defaults().items()}
    return replace(requested, words={**defaults, **requested.words})


def check_with_lerobot(config: TrainPipelineConfig, requested: CommandSettings) -> None:
    """Let LeRobot check a configuration and complete its folder, job, optimizer and resumed checkpoint."""
    if not config.resume and config.output_dir is not None and config.output_dir.is_dir():
        with locked_run(requested.get("output_dir")):  # a training that is running there is the better reason
            raise MemobenchError(
                f"the folder output_dir={config.output_dir} exists already; name another one, or resume its training "
                "with resume=true"
            )
    settings = {CONFIG_FILE: requested.config_path, "output_dir": requested.words.get("output_dir")}
    flags = [f"--{key}={value}" for key, value in settings.items() if config.resume and value is not None]
    line, sys.argv = sys.argv, [sys.argv[0], *flags]
    try:
        config.validate()  # it reads the checkpoint and the folder of a resumed training from `sys.argv`
    except (ValueError, FileNotFoundError) as error:
        raise MemobenchError(" ".join(str(error).split())) from None
    finally:
        sys.argv = line


def check_settings(config: TrainPipelineConfig) -> None:
    """Refuse settings that have no effect on the training of a memory policy."""
    policy: Any = config.policy
    unused = type(config)(config.dataset)
    for name, value in vars(config).items():
        for setting, changed in () if name in READ else changes(name, value, getattr(unused, name, None)):
            raise MemobenchError(f"{setting}={changed} has no effect on policy={policy.type}; leave it out")
    encodes_ahead = policy.uses_detector or policy.uses_visual_encoder
    encoded = config.dataset.image_transforms.enable and encodes_ahead
    for is_set, setting, why in (
        (config.dataset.streaming, "dataset.streaming", "memory needs all frames of an episode"),
        (policy.use_amp, "policy.use_amp", "policy.dtype sets the precision"),
        (config.eval.recording, "eval.recording", "rollouts of a training are not recorded"),
        (encoded, "dataset.image_transforms.enable", "images are encoded once, before training"),
    ):
        if is_set:
            raise MemobenchError(f"{setting}=true has no effect on policy={policy.type} ({why}); leave it out")


def changes(name: str, value: object, default: object) -> Iterator[tuple[str, object]]:
    """Yield name and value of the settings of a field that differ from its default."""
    if is_dataclass(value) and is_dataclass(default):
        for item in fields(value):
            yield from changes(f"{name}.{item.name}", getattr(value, item.name), getattr(default, item.name, None))
    elif value != default:
        yield name, value


def check_dataset(requested: CommandSettings) -> None:
    """Refuse a folder that is not a dataset; a folder that does not exist may be one to download into."""
    root, repository = requested.get("dataset.root"), requested.get("dataset.repo_id")
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


# -- resumed trainings -------------------------------------------------------------------------------------------------


def with_last_checkpoint(words: Mapping[str, str]) -> dict[str, str]:
    """Return the words of LeRobot to resume a training, if ``output_dir=<run> resume=true`` is given.

    LeRobot needs the path of the configuration in the run's last checkpoint. It holds all settings of the run; those
    on the command line override it. A recipe, or another policy than that of the run, is refused.
    """
    if not value_of("resume", bool, words.get("resume", "false")):
        return dict(words)
    stated = words.get(CONFIG_FILE)
    if RECIPE in words or (stated and Path(stated).is_file() and Path(stated).name != TRAIN_CONFIG):
        key = RECIPE if RECIPE in words else CONFIG_FILE
        raise MemobenchError(
            f"{key}={words[key]} cannot be combined with resume=true, which uses the configuration in the last "
            "checkpoint; leave the recipe out, and change settings by key=value"
        )
    if stated is not None:
        return dict(words)  # LeRobot's own form: a checkpoint or a repository
    folder = words.get("output_dir")
    if folder is None:
        raise MemobenchError("resume=true needs the folder of the training: output_dir=<folder>")
    checkpoint = last_checkpoint(Path(folder).expanduser())
    checkpoint_type(str(checkpoint))
    begun = (read_checkpoint_json(checkpoint / TRAIN_CONFIG).get("policy") or {}).get("type")
    kind = policy = words.get("policy") or words.get(f"policy.{TYPE}")
    if policy is not None and (source := checkpoint_folder(policy)) is not None:
        kind = checkpoint_type(str(source))
    if kind is not None and begun is not None and "/" not in kind and kind != begun:
        raise MemobenchError(f"the training in {folder} has policy={begun}; found policy={policy}; leave policy out")
    return {CONFIG_FILE: str(checkpoint / TRAIN_CONFIG)} | without(words, "policy", f"policy.{PATH}", f"policy.{TYPE}")


def last_checkpoint(run: Path) -> Path:
    """Return the folder ``pretrained_model`` of the last complete checkpoint of a run; raise if there is none."""
    for folder in complete_checkpoints(run):
        return folder / "pretrained_model"
    problem = "holds no complete checkpoint" if run.is_dir() else "does not exist"
    raise MemobenchError(
        f"output_dir={run} {problem}; the first checkpoint is saved after save_freq steps: leave resume=true out and "
        "name a new folder"
    )


def complete_checkpoints(run: Path) -> Iterator[Path]:
    """Yield the complete checkpoints of a run, the last one first."""
    for folder in checkpoints_of(run):
        described = (folder / "pretrained_model" / TRAIN_CONFIG).is_file() and (folder / TRAINING_STEP).is_file()
        # LeRobot sets the link when a checkpoint is complete; it writes the optimizer's groups nearly last.
        if described and (folder.name == LAST or any(folder.glob("training_state/**/optimizer_param_groups.json"))):
            yield folder


def step_reached(checkpoint: Path) -> int:
    """Return the step at which a checkpoint was saved."""
    return int(read_checkpoint_json(checkpoint / TRAINING_STEP)["step"])


def make_room_for_link(last: Path) -> None:
    """Remove a file that a copy made of the link ``last`` of a training, because LeRobot makes the link."""
    if last.is_symlink() or not last.exists():
        return
    target = text_of_link(last)
    if not (target and target.isdecimal()):
        raise MemobenchError(
            f"{last} is not a link, and LeRobot makes a link of that name with each checkpoint; rename it, for example "
            "to the number of its step"
        )
    last.unlink(missing_ok=True)  # another process of this training may remove it


def check_same_training(
    requested: CommandSettings, config: TrainPipelineConfig, checkpoint: Path, notify: Callable[[str], None]
) -> None:
    """Refuse to resume a training with another dataset, or with settings that it cannot change; note the others."""
    begun, model, dataset = requested.begun, checkpoint / "pretrained_model", config.dataset
    another = f"train a new run from the checkpoint: policy={model} output_dir=<new folder>"
    check_processors(model)
    old, new = (Path(root).expanduser().resolve() if root else None for root in (begun.dataset.root, dataset.root))
    if old != new or (old is None and dataset.repo_id != begun.dataset.repo_id):
        before = begun.dataset.root or begun.dataset.repo_id
        moved = old is not None and not old.exists()
        raise MemobenchError(
            f"this training was begun on the dataset {before}; found {dataset.root or dataset.repo_id}; "
            + (f"if it is the same dataset, move it or link it to {before}; else " if moved else "")
            + f"leave it out, or {another}"
        )
    changed = []
    for name in ("dataset.episodes", "dataset.revision", *requested.words):
        try:
            value, before = (attrgetter(name)(source) for source in (config, begun))
        except AttributeError:  # a setting of another type of optimizer
            continue
        if name in NOT_COMPARED or value == before:
            continue
        if name.startswith(FIXED):
            raise MemobenchError(
                f"this training was begun with {name}={before}, which it keeps; found {value}; leave "
                f"{name.removeprefix('policy.')} out, or {another}"
            )
        if not name.startswith("policy."):  # see `check_as_begun`
            changed.append(f"{name}={value} instead of {before}")
    if config.policy is not None and begun.policy is not None:
        check_as_begun(model, config.policy, begun.policy)
    if (done := step_reached(checkpoint)) < config.steps:
        if changed:
            notify(f"note: this training continues with {', '.join(changed)}")
        if note := note_on_schedule(begun, config.steps, done):
            notify(note)


def note_on_schedule(begun: TrainPipelineConfig, steps: int, done: int) -> str | None:
    """Return a note if another number of steps makes the learning rate of a resumed training jump.

    LeRobot builds the schedule for the new number and continues in it at the step reached.
    """
    from torch import nn, optim

    if steps == begun.steps or begun.scheduler is None or begun.optimizer is None:
        return None
    rates = []
    for total in (begun.steps, steps):
        schedule = begun.scheduler.build(optim.SGD(nn.Linear(1, 1).parameters(), lr=1.0), total)
        rates.append(getattr(schedule, "lr_lambdas", [lambda _: 1.0])[0](done) * getattr(begun.optimizer, "lr", 1.0))
    before, after = (f"{rate:.2e}" for rate in rates)
    if before == after:
        return None
    return (
        f"note: with {steps} steps instead of {begun.steps} the learning rate at step {done} jumps from {before} to "
        f"{after} ({begun.scheduler.type})"
    )


def resume_hint(config: TrainPipelineConfig, words: Mapping[str, str]) -> str:
    """Return the advice for a training that was terminated: the command that resumes from its last checkpoint."""
    assert config.output_dir is not None
    advice = "no checkpoint was saved; start again with"
    if any(complete_checkpoints(config.output_dir)):
        options = {key: value for key, value in words.items() if key in TRAINING_OPTIONS}  # LeRobot does not keep these
        advice, words = "go on with", {"output_dir": str(config.output_dir), "resume": "true", **options}
    return f"{advice}: {shlex.join(['lerobot', 'train', *as_command_line(words)])}"
