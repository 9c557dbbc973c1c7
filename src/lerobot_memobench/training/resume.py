"""Resume a training: ``lerobot train output_dir=<run> resume=true``."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import yaml

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import (
    LAST,
    check_as_begun,
    check_processors,
    checkpoint_folder,
    checkpoint_type,
    checkpoints_of,
    read_json,
    text_of_link,
)
from lerobot_memobench.policies.lerobot_config import overrides, quiet
from lerobot_memobench.run.arguments import (
    CONFIG_FILE,
    RECIPE,
    TRAINING_OPTIONS,
    Arguments,
    LerobotArguments,
    is_true,
    whole_number,
)

TRAIN_CONFIG = "train_config.json"
"""LeRobot's file of a training's whole configuration, in each of its checkpoints."""
TRAINING_STEP = Path("training_state") / "training_step.json"
OPTIMIZER_GROUPS = "optimizer_param_groups.json"
"""Written behind an optimizer's state, which is behind nearly all of a checkpoint."""


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
    checkpoint_type(str(checkpoint))
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
    """Return a note if another number of steps changes the learning rate of a training that is resumed.

    LeRobot builds the schedule for the new number and continues in it at the step that was reached.

    Args:
        checkpoint: its folder ``pretrained_model``. steps: those asked for; None: as many as before.
    """
    from lerobot.configs.train import TrainPipelineConfig
    from torch import nn, optim

    with quiet():
        begun = TrainPipelineConfig.from_pretrained(checkpoint)
    if steps is None or steps == begun.steps or begun.scheduler is None or begun.optimizer is None:
        return None
    done, rates = step_reached(checkpoint), []
    for total in (begun.steps, steps):
        made = begun.scheduler.build(optim.SGD(nn.Linear(1, 1).parameters(), lr=1.0), total)
        rates.append(getattr(made, "lr_lambdas", [lambda _: 1.0])[0](done) * getattr(begun.optimizer, "lr", 1.0))
    before, after = (f"{rate:.2e}" for rate in rates)
    if before == after:
        return None
    return (
        f"note: with {steps} steps instead of {begun.steps} the learning rate at step {done} jumps from {before} to "
        f"{after} ({begun.scheduler.type})"
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
