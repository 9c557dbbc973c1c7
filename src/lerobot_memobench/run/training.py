"""``lerobot train policy=…``: defaults and checks before LeRobot's training, and what is added to it while it lasts.

Whether frames of demonstration prompts are trained on is decided where the policy is known for sure: when LeRobot, its
configuration complete, has opened the datasets. So are a policy's inputs: our datasets hold pictures, beside them the
privileged object state of what shows in them, and phase and step, and LeRobot would take all of them for inputs. What
this relies on is listed in tests/run/test_lerobot_training.py; how it gets there, and out again: `lerobot_hooks`.
"""

from __future__ import annotations

import copy
import functools
import itertools
import json
import logging
import os
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from lerobot_memobench.datasets.lerobot_format.layout import (
    DEFAULT_REPO_ID,
    EPISODE_INFO,
    PRIVILEGED,
    check_clock,
    naming_damage,
    read_info,
    without_pattern,
)
from lerobot_memobench.datasets.lerobot_format.layout import OBJECTS as INPUT
from lerobot_memobench.datasets.lerobot_format.reading import check_idling
from lerobot_memobench.datasets.statistics import complete, lacking, needed_by
from lerobot_memobench.envs.command_line import overrides, quiet
from lerobot_memobench.envs.observations import chooses_inputs, reads_prompt
from lerobot_memobench.envs.settings import BOTH, OBJECTS, OBS_TYPES, PIXELS
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import check_fetched, count_of
from lerobot_memobench.jobs.processes import locked, saying_how_to_go_on
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.lerobot_hooks import OPEN_DATASETS, check_version, install
from lerobot_memobench.policies.checkpoint import (
    LAST,
    as_trained,
    check_as_begun,
    check_processors,
    check_weights,
    checkpoint_folder,
    checkpoint_type,
    checkpoints_of,
    differing,
    read_json,
    text_of_link,
)
from lerobot_memobench.protocol import CLOCK
from lerobot_memobench.run.arguments import (
    CONFIG_FILE,
    RECIPE,
    TRAINING_OPTIONS,
    Arguments,
    LerobotArguments,
    check_task_names,
    checked_value,
    is_true,
    read_arguments,
    read_config_file,
    resolve_recipe,
    whole_number,
)
from lerobot_memobench.run.lerobot_commands import call_lerobot, without_configuration
from lerobot_memobench.run.plan import check_observations, env_config, policy_config

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

INFO_FILE = Path("meta") / "info.json"
OBJECT_BATCH = 72
"""Frames per update of a policy that reads objects or tokens of a visual encoder: a dozen episodes, six frames of each.
They lie in main memory, where no loader would be quicker."""
TRAIN_CONFIG = "train_config.json"
"""LeRobot's file of a training's whole configuration, in each of its checkpoints."""
TRAINING_STEP = Path("training_state") / "training_step.json"
OPTIMIZER_GROUPS = "optimizer_param_groups.json"
"""Written behind an optimizer's state, which is behind nearly all of a checkpoint."""
LEAST = {"steps": 1, "batch_size": 1, "num_workers": 0, "eval.batch_size": 0, "eval.n_episodes": 1}
"""Setting -> the smallest number with which LeRobot trains and evaluates."""
TRAINED = ("policy.type", "policy.path", "reward_model.type", "reward_model.path")
"""What may say what is trained."""


def train(given: Arguments, line: Sequence[str], tell: Callable[[str], None]) -> int:
    """Run ``lerobot train`` with the benchmark's defaults, checked; return the exit status.

    Args:
        line: the arguments as they were typed, for who is to go on with it.
        tell: told what may matter and stops nothing.
    """
    begun = time.time()
    prompt_frames, obs_type, given = take_training_options(resolve_recipe(resumed(given)))
    check_task_names(given)
    arguments = read_arguments("train", given)
    if given.wants_help:
        return call_lerobot("train", arguments.for_parser)
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
        trained_on(prompt_frames, obs_type),
        naming_damage(Path(root) if root else None),
        without_configuration(),
    ):
        return call_lerobot("train", arguments.for_parser)


@contextmanager
def held_run(arguments: LerobotArguments) -> Iterator[None]:
    """Hold the folder of a training that is named, in its first process, by a lock file beside it.

    LeRobot refuses a folder that is there before its first checkpoint, so there is none to hold until then.

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


def take_training_options(given: Arguments) -> tuple[bool | None, str | None, Arguments]:
    """Return the options of a command line that LeRobot does not have, and the arguments without them.

    Returns:
        Whether frames of demonstration prompts are trained on, the kind of observation (each None where it is not
        said), and the rest.

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
    """Return a training run's arguments with the benchmark's defaults; what is wrong with them is told here.

    Raises:
        MemobenchError: no policy is named, a number is too small, or the dataset or the model checkpoint is none.
    """
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
    check_observations(policy, env_config(arguments))
    steps = whole_number(arguments.get("steps"))
    if steps is not None and steps < 2000 and arguments.get("resume") != "true":
        # To see the loss of a short run: LeRobot's default is every 200 steps.
        arguments = arguments.default("log_freq", max(1, steps // 10))
    if not from_file and getattr(policy, "decodes_no_video", False):
        arguments = arguments.default("batch_size", OBJECT_BATCH).default("num_workers", 0)
    if cores() < 4 and not from_file:  # LeRobot's default of 4 loaders would only wait for one another
        arguments = arguments.default("num_workers", cores())
    return arguments


def check_numbers(arguments: LerobotArguments) -> None:
    """Refuse numbers, of the line or else of the configuration file, that are smaller than `LEAST`."""
    file = read_config_file(arguments.get(CONFIG_FILE))
    for key, least in LEAST.items():
        section, _, name = key.rpartition(".")
        held = file.get(section) if section else file
        text = arguments.get(key) or (str(held.get(name)) if isinstance(held, dict) else None)
        number = whole_number(text)
        if number is not None and number < least:
            raise MemobenchError(f"found {key}={number}; expected at least {least}")


def with_own_memory(arguments: LerobotArguments) -> LerobotArguments:
    """Return arguments in which a memory that is another one than that of the checkpoint or recipe it begins with has
    its own defaults.
    """
    from lerobot_memobench.policies.memobench_mem.inherited import of_another_memory

    for name, value in of_another_memory(arguments.flags).items():
        if name != "memory_settings":  # LeRobot would merge these; the configuration leaves out those of another
            arguments = arguments.default(f"policy.{name}", "null" if value is None else value)
    return arguments


def without_unread(arguments: LerobotArguments) -> LerobotArguments:
    """Return arguments that reset the settings of a checkpoint which nothing reads under the settings asked for.

    What the line itself sets is left to be refused.
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


def check_memory_settings(arguments: LerobotArguments, policy: Any) -> None:
    """Refuse settings on the line that are another memory's; errors as of `read_settings`."""
    given = yaml.safe_load(arguments.get("policy.memory_settings") or "{}")
    if given and getattr(policy, "memory", "none") != "none":
        from lerobot_memobench.policies.memobench_mem.memory import read_settings

        read_settings(policy.memory, given)


def check_dataset(arguments: LerobotArguments) -> None:
    """Refuse a dataset folder that is none."""
    root = arguments.get("dataset.root")
    if root is None:
        return
    folder = Path(root).expanduser()
    local_only = (arguments.get("dataset.repo_id") or "").startswith("local/")
    if not folder.exists() and not local_only:
        return  # LeRobot downloads the repository into it
    if not folder.is_dir():
        raise MemobenchError(
            f"the dataset folder {root} does not exist; make one with `memobench generate --out {root}`"
        )
    if not (folder / INFO_FILE).is_file():
        raise MemobenchError(
            f"the folder {root} is not a LeRobot dataset ({INFO_FILE} is missing); make one with "
            "`memobench generate --out <folder>`"
        )
    read_info(folder)
    check_fetched(folder)


def note_on_start(arguments: LerobotArguments) -> str | None:
    """Return a note on a training that begins from a model checkpoint under other settings than its weights were
    trained for, which fine-tuning may mean; None: there is nothing to note.
    """
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


# --- going on with a training: resume=true ---


def resumed(given: Arguments) -> Arguments:
    """Return what LeRobot goes on with a training by, where ``output_dir=<run> resume=true`` asks for that.

    LeRobot wants the configuration in the run's last model checkpoint named. That holds all that was set when the run
    began; what is given again, or changed, on the line counts before it.

    Raises:
        MemobenchError: there is nothing to go on with, a recipe is named, or another policy than that of the run.
    """
    wanted = "true" if "--resume" in given.flags and given.value("resume") is None else given.value("resume")
    if not is_true("resume", wanted):
        return given
    recipe, stated = given.value(RECIPE), given.value(CONFIG_FILE)
    if recipe is None and stated is not None and not (Path(stated).is_file() and Path(stated).name != TRAIN_CONFIG):
        return given  # LeRobot's own form, by a checkpoint or a repository
    named = f"{RECIPE}={recipe}" if recipe is not None else f"{CONFIG_FILE}={stated}"
    if recipe is not None or stated is not None:
        raise MemobenchError(
            f"{named} is given beside resume=true, and a training goes on by the configuration in its last checkpoint; "
            "leave the recipe out, and say what is to change as key=value"
        )
    folder = given.value("output_dir")
    if folder is None:
        raise MemobenchError("resume=true needs the folder of the training to go on with: output_dir=<folder>")
    checkpoint = last_checkpoint(Path(folder).expanduser())
    _check_same_policy(given, checkpoint, folder)
    rest = given.without("policy", "policy.path", "policy.type", "resume")
    return replace(rest, pairs=[(CONFIG_FILE, str(checkpoint / TRAIN_CONFIG)), ("resume", "true"), *rest.pairs])


def last_checkpoint(run: Path) -> Path:
    """Return the folder ``pretrained_model`` of the last whole checkpoint of a training run.

    Raises:
        MemobenchError: there is none.
    """
    found = next(whole_checkpoints(run), None)
    if found is not None:
        return found / "pretrained_model"
    what = "holds no whole checkpoint" if run.is_dir() else "does not exist"
    raise MemobenchError(
        f"output_dir={run} {what}, so there is nothing to go on with; a first one is saved after save_freq steps: "
        "leave resume=true out and name a new folder"
    )


def whole_checkpoints(run: Path) -> Iterator[Path]:
    """Yield the checkpoints of a training run that can be gone on with, the last one first."""
    for folder in checkpoints_of(run):
        told = (folder / "pretrained_model" / TRAIN_CONFIG).is_file() and (folder / TRAINING_STEP).is_file()
        # The link is set once a checkpoint is whole.
        if told and (folder.name == LAST or any(folder.glob("training_state/**/" + OPTIMIZER_GROUPS))):
            yield folder


def make_room_for_link(arguments: LerobotArguments) -> None:
    """Remove a file that stands for the link ``last`` of a training that goes on: LeRobot makes the link itself.

    Raises:
        MemobenchError: it is a folder, or another file.
    """
    checkpoint = _gone_on_with(arguments)
    last = None if checkpoint is None else checkpoint.parents[1] / LAST
    if last is None or last.is_symlink() or not last.exists():
        return
    named = text_of_link(last)
    if not (named and named.isdecimal()):
        raise MemobenchError(
            f"{last} is no link, and LeRobot makes a link of that name when it saves a checkpoint; give it another "
            "name, such as the number of its step"
        )
    last.unlink(missing_ok=True)  # another process of this training may have


def _check_same_policy(given: Arguments, checkpoint: Path, folder: str) -> None:
    """Refuse to go on with another type of policy than the run's."""
    begun = (read_json(checkpoint / TRAIN_CONFIG).get("policy") or {}).get("type")
    named = given.value("policy") or given.value("policy.type")
    where = None if named is None else checkpoint_folder(named)
    kind = named if where is None else checkpoint_type(str(where))
    if kind is not None and begun is not None and "/" not in kind and kind != begun:
        raise MemobenchError(f"the training in {folder} is of policy={begun}, and policy={named} was asked for")


def check_same_training(arguments: LerobotArguments) -> None:
    """Refuse to go on with a training under settings, or on a dataset, that it was not begun with.

    Raises:
        MemobenchError: one of them is another.
    """
    checkpoint = _gone_on_with(arguments)
    if checkpoint is None:
        return
    check_processors(checkpoint)
    _check_same_dataset(arguments, checkpoint)
    given = overrides("policy", arguments.for_parser)
    if not given:
        return
    from lerobot.configs.policies import PreTrainedConfig

    with quiet():
        begun = PreTrainedConfig.from_pretrained(checkpoint)
        asked = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=given)
    check_as_begun(checkpoint, asked, begun)


def _check_same_dataset(arguments: LerobotArguments, checkpoint: Path) -> None:
    """Refuse to go on with a training on another dataset, or on other episodes of it."""
    begun = read_json(checkpoint / TRAIN_CONFIG).get("dataset") or {}
    root, repository = arguments.get("dataset.root"), arguments.get("dataset.repo_id")
    held = str(begun.get("root") or begun.get("repo_id"))
    advice = f"leave that out, or train a new run from the checkpoint: policy={checkpoint} output_dir=<new folder>"
    same = (
        root is not None
        and begun.get("root") is not None
        and (Path(root).expanduser().resolve() == Path(begun["root"]).expanduser().resolve())
    )
    if not same and (root is not None or repository not in (None, begun.get("repo_id"))):
        moved = begun.get("root") is not None and not Path(held).expanduser().exists()
        raise MemobenchError(
            f"this training was begun on the dataset {held}, and {root or repository} was asked for; "
            + (f"if that is the same, put it or a link to it at {held}; else " if moved else "")
            + advice
        )
    for name in ("episodes", "revision"):
        asked = arguments.get(f"dataset.{name}")
        if asked is not None and yaml.safe_load(asked) != begun.get(name):
            raise MemobenchError(
                f"this training was begun with dataset.{name}={begun.get(name)}, and {asked} was asked for; {advice}"
            )


def _gone_on_with(arguments: LerobotArguments) -> Path | None:
    """Return the checkpoint that a training goes on with; None where it begins, or is not on this machine."""
    path, resume = arguments.get(CONFIG_FILE), arguments.get("resume")
    wanted = arguments.has("resume") if resume is None else resume.lower() == "true"  # LeRobot takes a bare --resume
    if not wanted or path is None or not Path(path).exists():
        return None
    return Path(path) if Path(path).is_dir() else Path(path).parent


def note_on_resume(arguments: LerobotArguments) -> tuple[str | None, bool]:
    """Return a note on a training that goes on (None: there is none), and whether anything is left to be done."""
    checkpoint = _gone_on_with(arguments)
    if checkpoint is None:
        return None, True
    steps = whole_number(arguments.get("steps"))
    total = steps or whole_number(str(read_json(checkpoint / TRAIN_CONFIG).get("steps")))
    done = step_reached(checkpoint)
    if total is not None and done >= total:
        return (
            f"the training in {checkpoint.parents[2]} has made all of its {done} steps; ask for more by steps=",
            False,
        )
    return note_on_schedule(checkpoint, steps), True


def note_on_schedule(checkpoint: Path, steps: int | None) -> str | None:
    """Return a note on what another number of steps does to the learning rate of a training that goes on.

    LeRobot makes the schedule anew for the new number and goes on in it at the step that was reached. None: it does
    nothing to it.

    Args:
        checkpoint: the folder ``pretrained_model`` that is gone on with.
        steps: those asked for; None: as many as before.
    """
    from lerobot.configs.train import TrainPipelineConfig
    from torch import nn, optim

    with quiet():
        begun = TrainPipelineConfig.from_pretrained(checkpoint)
        if steps is None or steps == begun.steps or begun.scheduler is None or begun.optimizer is None:
            return None
        peak = float(getattr(begun.optimizer, "lr", 1.0))
        rates = []
        for total in (begun.steps, steps):
            weights = optim.SGD(nn.Linear(1, 1).parameters(), lr=peak)
            made = begun.scheduler.build(weights, total)
            rates.append(getattr(made, "lr_lambdas", [None])[0])
    before, after = rates
    done = step_reached(checkpoint)
    if before is None or after is None:
        return f"note: {begun.scheduler.type} is made anew for {steps} steps instead of {begun.steps}"
    old, new, last = (peak * rate(step) for rate, step in ((before, done), (after, done), (after, steps - 1)))
    if f"{old:.2e}" == f"{new:.2e}":
        what = f"it stays at {new:.2e} at step {done}"
    else:
        what = f"at step {done} it jumps from {old:.2e} to {new:.2e}"
    return (
        f"note: {steps} steps instead of {begun.steps} make the schedule of the learning rate "
        f"({begun.scheduler.type}) anew: {what} and is {last:.2e} at the end"
    )


def step_reached(checkpoint: Path) -> int:
    """Return after how many steps a checkpoint was saved."""
    return int(read_json(checkpoint.parent / TRAINING_STEP)["step"])


def how_to_go_on(arguments: LerobotArguments, line: Sequence[str], begun: float) -> str:
    """Return what is said when a training is ended from outside: the command that goes on with its last checkpoint.

    Args:
        line: its command line after ``lerobot train``.
        begun: when it began, seconds since the epoch: LeRobot itself names a folder that was not named.
    """
    given = arguments.get("output_dir")
    runs = [Path(given)] if given is not None else list(Path("outputs/train").glob("*/*"))
    saved = [checkpoint for run in runs for checkpoint in itertools.islice(whole_checkpoints(run), 1)]
    saved = [one for one in saved if given is not None or one.lstat().st_mtime >= begun]
    if not saved:
        again = shlex.join(["lerobot", "train", *line])
        return f"no checkpoint was saved; begin anew with: {again}"
    run = max(saved, key=lambda one: one.lstat().st_mtime).parents[1]
    # LeRobot's configuration has no place for these.
    kept = [word for word in line if word.partition("=")[0] in TRAINING_OPTIONS]
    again = shlex.join(["lerobot", "train", f"output_dir={run}", "resume=true", *kept])
    return f"go on with: {again}"


# --- what is added to LeRobot's training: which frames are trained on, and what a policy's inputs are ---


@contextmanager
def trained_on(prompt_frames: bool | None, obs_type: str | None = None) -> Iterator[None]:
    """While this lasts, steer LeRobot's training.

    Args:
        prompt_frames: whether frames of demonstration prompts are trained on; None: where the policy reads prompts.
        obs_type: kind of observation (`envs.observations.OBS_TYPES`) of a policy without a ``perception`` of its own;
            None: pictures where the dataset has them, else objects.

    Raises:
        MemobenchError: the installed LeRobot is another than the one whose training is known here.
    """
    undo = steer(prompt_frames, obs_type)
    try:
        yield
    finally:
        undo()


def steer(prompt_frames: bool | None, obs_type: str | None = None) -> Callable[[], None]:
    """As `trained_on`, until the function returned is called."""
    check_version()
    return install(OPEN_DATASETS, lambda make: _steered(make, prompt_frames, obs_type))


def _steered(make: Callable[..., Any], prompt_frames: bool | None, obs_type: str | None) -> Callable[..., Any]:
    """Wrap what opens LeRobot's datasets: those that it returns hold no prompts where none are wanted."""

    @functools.wraps(make)
    def run(config: Any) -> Any:
        from lerobot_memobench.datasets.execution_frames import ExecutionFrames, leave_out_prompts
        from lerobot_memobench.datasets.samples import keep_in_memory
        from lerobot_memobench.policies.memobench_mem.sampler import check_transforms

        _check_streaming(config, prompt_frames)
        _check_adapters(config)
        check_transforms(config.policy, config.dataset.image_transforms.enable)
        _check_distribution(config)
        opened = copy.copy(config)
        if config.dataset.root is not None:
            opened.dataset = replace(config.dataset, root=str(without_pattern(Path(config.dataset.root))))
        meta = _metadata(opened.dataset)
        _check_episodes(opened.dataset, meta.total_episodes)
        if config.policy is not None and not config.dataset.streaming:
            _complete_statistics(opened, meta)
        train, held_out = make(opened)
        _check_streamed(train, config.policy)
        check_clock(train.meta.features, train.root)
        if EPISODE_INFO in train.meta.features and not config.dataset.streaming:
            check_idling(Path(train.root))
        if _reads_objects(config.policy, obs_type):
            for dataset in (train, held_out):
                _take_for_input(dataset)
        _choose_inputs(config.policy, train.meta.features, obs_type)
        _check_environment(config, train)
        wanted = config.policy is None or reads_prompt(config.policy) if prompt_frames is None else prompt_frames
        if not wanted:
            count = leave_out_prompts(train)
            frames = "the frames" if count is None else f"{count} frames"
            logger.info("%s of prompts are left out of the %d to train on", frames, train.num_frames)
        # A policy that draws execution frames alone sees to what it trains on, and not to what it is tested on.
        tested = wanted and not getattr(config.policy, "execution_only", False)
        if held_out is not None:
            held_out.reader.trained_with = train.meta
        if held_out is not None and not tested and leave_out_prompts(held_out):
            held_out = ExecutionFrames(held_out)
        if _reads_no_pictures(config):
            logger.info("samples lie in main memory, where loader processes would be slower: num_workers=0")
            config.num_workers = 0
            for dataset in filter(None, (train, held_out)):
                keep_in_memory(getattr(dataset, "dataset", dataset))
        return train, held_out

    return run


def _reads_no_pictures(config: Any) -> bool:
    """Return whether a policy of somebody's is known to read no pictures, of a dataset that lies on the disk."""
    from lerobot.configs import FeatureType

    inputs = getattr(config.policy, "input_features", None) or {}
    pictures = any(feature.type is FeatureType.VISUAL for feature in inputs.values())
    chosen = bool(inputs) and not chooses_inputs(config.policy)  # memobench_mem has samples of its own
    return chosen and not pictures and not config.dataset.streaming


def _check_streaming(config: Any, prompt_frames: bool | None) -> None:
    """Refuse to stream to a policy that draws its own execution frames: it would get prompts, which do not count."""
    if not config.dataset.streaming:
        return
    if config.num_workers == 0:
        raise MemobenchError(
            "dataset.streaming=true and num_workers=0 were asked for, and LeRobot's stream gives its frames to loaders "
            "alone; use num_workers=1 or more"
        )
    root = None if config.dataset.root is None else Path(config.dataset.root)
    if root is not None and without_pattern(root) != root:
        raise MemobenchError(
            f"dataset.streaming=true cannot read {root}: LeRobot takes the folder's name for a pattern; rename the "
            "folder, or use dataset.streaming=false"
        )
    if prompt_frames is not False and getattr(config.policy, "execution_only", False):
        raise MemobenchError(
            f"policy={config.policy.type} draws execution frames alone, and dataset.streaming=true leaves no choice of "
            "frames; use dataset.streaming=false, or prompt_frames=false to take execution frames as they come"
        )


def _check_streamed(dataset: Any, policy: Any) -> None:
    """Refuse to stream several frames of a single number, such as the clock's: LeRobot cannot stack them."""
    if hasattr(dataset.hf_dataset, "data"):
        return
    single = [key for key in dataset.delta_indices or {} if tuple(dataset.meta.features[key]["shape"]) == (1,)]
    if single:
        raise MemobenchError(
            f"policy={policy.type} asks for several frames of {single[0]}, a single number, which LeRobot's stream "
            "cannot give; use dataset.streaming=false"
        )


def _check_adapters(config: Any) -> None:
    """Refuse adapters (LeRobot's ``peft``) that LeRobot would refuse once it has built the policy."""
    policy = config.policy
    if config.peft is None or policy is None:
        return
    from lerobot.policies.factory import get_policy_class
    from lerobot.policies.pretrained import PreTrainedPolicy

    kind = get_policy_class(policy.type)
    # MolmoAct2 names its weights by `checkpoint_path`.
    if not policy.pretrained_path and not getattr(policy, "checkpoint_path", None):
        raise MemobenchError(
            f"--peft trains adapters beside trained weights, and policy={policy.type} begins without any; name a "
            "checkpoint by policy=, or weights by policy.pretrained_path="
        )
    has_targets = kind._get_default_peft_targets is not PreTrainedPolicy._get_default_peft_targets
    if not has_targets and not config.peft.target_modules:
        raise MemobenchError(
            f"--peft trains adapters of some modules, and policy={policy.type} does not say of which; name them by "
            "--peft.target_modules"
        )


def _check_distribution(config: Any) -> None:
    """Refuse what LeRobot's main can do to a policy's weights and memobench_mem does in another way, or not at all."""
    if getattr(config.policy, "type", None) != "memobench_mem":
        return
    from lerobot_memobench.policies.memobench_mem.sharding import shard_plugin

    if getattr(getattr(config, "parallelism", None), "is_sharded", False):
        raise MemobenchError(
            "parallelism.dp_shard would train memobench_mem in shards by FSDP 2, which its average of weights is not "
            "made for; leave it out: each process then holds the whole policy"
        )
    if config.env is not None and config.env_eval_freq > 0 and shard_plugin() is not None:
        raise MemobenchError(
            f"env_eval_freq={config.env_eval_freq} would evaluate a policy of which each process holds a part, as it "
            "trains in shards (FSDP); use env_eval_freq=0, and `lerobot eval` with a checkpoint"
        )
    if getattr(getattr(config, "ema", None), "enable", False):
        raise MemobenchError(
            "ema.enable=true would average weights that memobench_mem averages by itself; leave it out, or set the "
            "decay by policy.ema_decay"
        )


def _metadata(dataset: Any) -> LeRobotDatasetMetadata:
    """Return the metadata of a dataset, of LeRobot's configuration of it; fetched, where it is on the hub."""
    from lerobot.datasets import LeRobotDatasetMetadata

    return LeRobotDatasetMetadata(
        dataset.repo_id, root=dataset.root, revision=dataset.revision, repo_type=dataset.repo_type
    )


def _complete_statistics(config: Any, meta: LeRobotDatasetMetadata) -> None:
    """Add the statistics that a policy normalises by and its dataset lacks, before anything is encoded or trained."""
    from lerobot.datasets import LeRobotDataset

    given, root = config.dataset, Path(meta.root)
    missing = lacking(root, needed_by(config.policy, meta.features, given.use_imagenet_stats))
    if not missing:
        return
    if not (root / "data").is_dir():
        root = Path(LeRobotDataset(given.repo_id, root=given.root, revision=given.revision).root)
    complete(root, missing, logger.warning)


def _check_episodes(dataset: Any, total: int) -> None:
    """Refuse to train on episodes that a dataset does not have: LeRobot leaves them out, and fails where none is left.

    Args:
        dataset: LeRobot's configuration of it. total: the episodes that it has.
    """
    if dataset.episodes is None:
        return
    absent = [episode for episode in dataset.episodes if episode >= total]
    if absent or not dataset.episodes:
        raise MemobenchError(
            f"found episodes={absent or dataset.episodes}, and the dataset {dataset.root or dataset.repo_id} has "
            f"{count_of(total, 'episode')}; name some of 0 to {total - 1}, or leave episodes out for all"
        )


def _reads_objects(policy: Any, obs_type: str | None) -> bool:
    """Return whether a policy without a ``perception`` is to see objects: as asked now, or when its training began."""
    if policy is None or chooses_inputs(policy):
        return False
    begun = policy.input_features or {}
    return INPUT in begun if begun else obs_type in (OBJECTS, BOTH)


def _take_for_input(dataset: Any) -> None:
    """Give the objects of an opened dataset with pictures the name that LeRobot takes for an input's."""
    from lerobot.utils.constants import OBS_STATE

    if dataset is None or PRIVILEGED not in dataset.meta.features:
        return

    def named(table: dict[str, Any]) -> dict[str, Any]:
        return {INPUT if key == PRIVILEGED else key: value for key, value in table.items()}

    dataset.meta.info.features, dataset.meta.stats = named(dataset.meta.features), named(dataset.meta.stats)
    reader = getattr(dataset, "reader", dataset)  # a stream reads by itself
    reader.hf_dataset = reader.hf_dataset.rename_column(PRIVILEGED, INPUT)
    for holder, name in ((dataset, "delta_timestamps"), (reader, "delta_indices")):  # as of any other observation
        deltas = getattr(holder, name, None)
        if deltas and OBS_STATE in deltas:
            setattr(holder, name, {**deltas, INPUT: deltas[OBS_STATE]})


def _choose_inputs(policy: Any, features: dict[str, Any], obs_type: str | None) -> None:
    """Tell a policy's configuration its inputs, as LeRobot would from all that a dataset holds."""
    from lerobot.configs import FeatureType
    from lerobot.utils.feature_utils import dataset_to_policy_features

    if policy is None or policy.input_features or chooses_inputs(policy):
        return
    offered = dataset_to_policy_features(features)
    # A policy with a memory finds the clock in its batches all the same, and as it is: inputs are normalised.
    inputs = {key: f for key, f in offered.items() if f.type is not FeatureType.ACTION and key not in CLOCK}
    pictures = any(feature.type is FeatureType.VISUAL for feature in inputs.values())
    seen = obs_type or (PIXELS if pictures else OBJECTS)
    unseen = {PIXELS: FeatureType.ENV, OBJECTS: FeatureType.VISUAL}.get(seen)
    chosen = {key: feature for key, feature in inputs.items() if feature.type is not unseen}
    if obs_type is not None and not {FeatureType.VISUAL, FeatureType.ENV} & {
        feature.type for feature in chosen.values()
    }:
        raise MemobenchError(
            f"obs_type={obs_type} was asked for, but the dataset has {', '.join(inputs)}; choose another obs_type, or "
            "generate a dataset that has it"
        )
    policy.input_features = chosen


def _check_environment(config: Any, dataset: Any) -> None:
    """Refuse to evaluate between updates on the benchmark what is trained on other cameras, numbers or sizes."""
    from lerobot.configs import FeatureType
    from lerobot.envs.utils import env_to_policy_features
    from lerobot.utils.feature_utils import dataset_to_policy_features

    from lerobot_memobench.policies.compatibility import check_features

    environment = getattr(config, "env", None)
    if config.policy is None or getattr(environment, "type", None) != "memobench":
        return
    unseen = None if getattr(config.policy, "uses_pictures", True) else FeatureType.VISUAL
    features = dataset_to_policy_features(dataset.meta.features)
    policy = copy.copy(config.policy)
    policy.output_features = {key: one for key, one in features.items() if one.type is FeatureType.ACTION}
    policy.input_features = policy.input_features or {
        key: one for key, one in features.items() if one.type not in (FeatureType.ACTION, unseen)
    }
    check_features(f"that learns from {dataset.root}", policy, env_to_policy_features(environment), config.rename_map)
