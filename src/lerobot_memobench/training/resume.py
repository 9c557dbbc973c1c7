"""Resume a training: ``lerobot train output_dir=<run> resume=true``."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import (
    LAST,
    TRAIN_CONFIG,
    check_as_begun,
    check_processors,
    checkpoint_folder,
    checkpoint_type,
    checkpoints_of,
    read_json,
    text_of_link,
)
from lerobot_memobench.run.command_line import (
    CONFIG_FILE,
    PATH,
    RECIPE,
    TRAINING_OPTIONS,
    TYPE,
    CommandSettings,
    field_types,
    spelled,
    value_of,
    without,
)

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

TRAINING_STEP = Path("training_state") / "training_step.json"
OF_OPTIMIZER = ("optimizer.", "policy.optimizer_")
"""Beginnings of settings that a saved optimizer overrides."""
NOT_COMPARED = {
    *("dataset.root", "dataset.repo_id", "log_freq", "num_workers", "output_dir", "resume", "save_freq", "steps")
}
"""Settings of a resumed training that other checks compare, or that change nothing that is learned."""
OPTIMIZER_GROUPS = "optimizer_param_groups.json"
"""Written after an optimizer's state, which is nearly the last part of a checkpoint."""


def resumed(words: Mapping[str, str]) -> dict[str, str]:
    """Return the words of LeRobot to resume a training, if ``output_dir=<run> resume=true`` is given.

    LeRobot needs the path of the configuration in the run's last checkpoint. That holds all settings of the run;
    settings on the command line override it.

    Raises:
        MemobenchError: there is no checkpoint, a recipe is named, or another policy than that of the run.
    """
    if not value_of("resume", bool, words.get("resume", "false")):
        return dict(words)
    recipe, stated = words.get(RECIPE), words.get(CONFIG_FILE)
    if recipe is None and stated is not None and not (Path(stated).is_file() and Path(stated).name != TRAIN_CONFIG):
        return dict(words)  # LeRobot's own form: a checkpoint or a repository
    named = f"{RECIPE}={recipe}" if recipe is not None else f"{CONFIG_FILE}={stated}"
    if recipe is not None or stated is not None:
        raise MemobenchError(
            f"{named} cannot be combined with resume=true, which uses the configuration in the last checkpoint; leave "
            "the recipe out, and change settings by key=value"
        )
    folder = words.get("output_dir")
    if folder is None:
        raise MemobenchError("resume=true needs the folder of the training: output_dir=<folder>")
    checkpoint = last_checkpoint(Path(folder).expanduser())
    checkpoint_type(str(checkpoint))
    _check_same_policy(words, checkpoint, folder)
    rest = without(words, "policy", f"policy.{PATH}", f"policy.{TYPE}")
    return {CONFIG_FILE: str(checkpoint / TRAIN_CONFIG), **rest}


def last_checkpoint(run: Path) -> Path:
    """Return the folder ``pretrained_model`` of the last complete checkpoint of a run.

    Raises:
        MemobenchError: there is none.
    """
    found = next(whole_checkpoints(run), None)
    if found is not None:
        return found / "pretrained_model"
    problem = "holds no complete checkpoint" if run.is_dir() else "does not exist"
    raise MemobenchError(
        f"output_dir={run} {problem}; the first checkpoint is saved after save_freq steps: leave resume=true out and "
        "name a new folder"
    )


def whole_checkpoints(run: Path) -> Iterator[Path]:
    """Yield the complete checkpoints of a run, the last one first."""
    for folder in checkpoints_of(run):
        described = (folder / "pretrained_model" / TRAIN_CONFIG).is_file() and (folder / TRAINING_STEP).is_file()
        # LeRobot sets the link when a checkpoint is complete.
        if described and (folder.name == LAST or any(folder.glob("training_state/**/" + OPTIMIZER_GROUPS))):
            yield folder


def make_room_for_link(asked: CommandSettings) -> None:
    """Remove a file that a copy made of the link ``last`` of a resumed training, because LeRobot makes the link.

    Raises:
        MemobenchError: ``last`` is a folder, or another file.
    """
    checkpoint = _resumed_checkpoint(asked)
    last = None if checkpoint is None else checkpoint.parents[1] / LAST
    if last is None or last.is_symlink() or not last.exists():
        return
    named = text_of_link(last)
    if not (named and named.isdecimal()):
        raise MemobenchError(
            f"{last} is not a link, and LeRobot makes a link of that name with each checkpoint; rename it, for example "
            "to the number of its step"
        )
    last.unlink(missing_ok=True)  # another process of this training may remove it


def _check_same_policy(words: Mapping[str, str], checkpoint: Path, folder: str) -> None:
    """Refuse to resume with another type of policy than the run's."""
    begun = (read_json(checkpoint / TRAIN_CONFIG).get("policy") or {}).get("type")
    named = words.get("policy") or words.get(f"policy.{TYPE}")
    where = None if named is None else checkpoint_folder(named)
    kind = named if where is None else checkpoint_type(str(where))
    if kind is not None and begun is not None and "/" not in kind and kind != begun:
        raise MemobenchError(f"the training in {folder} has policy={begun}; found policy={named}; leave policy out")


def check_same_training(asked: CommandSettings, config: TrainPipelineConfig) -> None:
    """Refuse to resume a training with another dataset, or with settings that it cannot change.

    Args:
        config: the configuration of `asked`.

    Raises:
        MemobenchError: a setting differs.
    """
    checkpoint = _resumed_checkpoint(asked)
    if checkpoint is None:
        return
    check_processors(checkpoint)
    begun = asked.begun
    _check_same_dataset(asked, begun, checkpoint)
    for name, value, held in changed_settings(asked, config, begun):
        if name.startswith(OF_OPTIMIZER):
            raise MemobenchError(
                f"this training was begun with {name}={held}, which its saved optimizer keeps; found {value}; leave "
                f"{name.removeprefix('policy.')} out, or train a new run from the checkpoint: policy={checkpoint} "
                "output_dir=<new folder>"
            )
    if config.policy is not None and begun.policy is not None:
        check_as_begun(checkpoint, config.policy, begun.policy)


def _check_same_dataset(asked: CommandSettings, begun: TrainPipelineConfig, checkpoint: Path) -> None:
    """Refuse to resume a training on another dataset, or on other episodes of it."""
    root, repository = asked.words.get("dataset.root"), asked.words.get("dataset.repo_id")
    held = str(begun.dataset.root or begun.dataset.repo_id)
    advice = f"leave it out, or train a new run from the checkpoint: policy={checkpoint} output_dir=<new folder>"
    same = (
        root is not None
        and begun.dataset.root is not None
        and (Path(root).expanduser().resolve() == Path(begun.dataset.root).expanduser().resolve())
    )
    if not same and (root is not None or repository not in (None, begun.dataset.repo_id)):
        moved = begun.dataset.root is not None and not Path(held).expanduser().exists()
        raise MemobenchError(
            f"this training was begun on the dataset {held}; found {root or repository}; "
            + (f"if it is the same dataset, move it or link it to {held}; else " if moved else "")
            + advice
        )
    for name in ("episodes", "revision"):
        text, value = asked.words.get(f"dataset.{name}"), getattr(begun.dataset, name)
        if text is not None and value_of(name, field_types(type(begun.dataset))[name], text) != value:
            raise MemobenchError(f"this training was begun with dataset.{name}={value}; found {text}; {advice}")


def _resumed_checkpoint(asked: CommandSettings) -> Path | None:
    """Return the checkpoint that a training resumes from; None if it is new, or if the checkpoint is on the hub."""
    path = asked.config_path
    if not value_of("resume", bool, asked.get("resume") or "false") or path is None or not Path(path).exists():
        return None
    return Path(path) if Path(path).is_dir() else Path(path).parent


def note_on_resume(asked: CommandSettings, config: TrainPipelineConfig) -> tuple[str | None, bool]:
    """Return a note on a resumed training, or None, and whether updates are left."""
    checkpoint = _resumed_checkpoint(asked)
    if checkpoint is None:
        return None, True
    begun, done = asked.begun, step_reached(checkpoint)
    if done >= config.steps:
        return (
            f"the training in {checkpoint.parents[2]} has finished its {done} steps; for more, set steps=",
            False,
        )
    changed = [
        f"{name}={value} instead of {held}"
        for name, value, held in changed_settings(asked, config, begun)
        if not name.startswith("policy.")  # see `check_as_begun`
    ]
    note = f"note: this training continues with {', '.join(changed)}" if changed else None
    return "\n".join(filter(None, (note, note_on_schedule(begun, config.steps, done)))) or None, True


def changed_settings(
    asked: CommandSettings, config: TrainPipelineConfig, begun: TrainPipelineConfig
) -> Iterator[tuple[str, object, object]]:
    """Yield name, value and earlier value of settings on the command line that differ from the run's.

    Folders and the number of steps are left out.
    """
    for name in asked.words:
        try:
            now, before = (attrgetter(name)(one) for one in (config, begun))
        except AttributeError:  # a setting of another type of optimizer
            continue
        if name not in NOT_COMPARED and now != before:
            yield name, now, before


def note_on_schedule(begun: TrainPipelineConfig, steps: int, done: int) -> str | None:
    """Return a note if another number of steps makes the learning rate of a resumed training jump.

    LeRobot builds the schedule for the new number and continues in it at the step that was reached.

    Args:
        steps: the new number. done: the step that was reached.
    """
    from torch import nn, optim

    if steps == begun.steps or begun.scheduler is None or begun.optimizer is None:
        return None
    rates = []
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
    """Return the step at which a checkpoint was saved."""
    return int(read_json(checkpoint.parent / TRAINING_STEP)["step"])


def resume_hint(asked: CommandSettings, words: Mapping[str, str], begun: float) -> str:
    """Return the advice for a training that was terminated: the command that resumes from its last checkpoint.

    Args:
        words: of its command line.
        begun: its start, seconds since the epoch, to find the folder if LeRobot chose its name.
    """
    given = asked.get("output_dir")
    runs = [Path(given)] if given is not None else list(Path("outputs/train").glob("*/*"))
    saved = [checkpoint for run in runs for checkpoint in itertools.islice(whole_checkpoints(run), 1)]
    saved = [one for one in saved if given is not None or one.lstat().st_mtime >= begun]
    if not saved:
        return f"no checkpoint was saved; start again with: {shlex.join(['lerobot', 'train', *spelled(words)])}"
    run = max(saved, key=lambda one: one.lstat().st_mtime).parents[1]
    kept = {key: value for key, value in words.items() if key in TRAINING_OPTIONS}  # LeRobot does not keep these
    again = spelled({"output_dir": str(run), "resume": "true", **kept})
    return f"go on with: {shlex.join(['lerobot', 'train', *again])}"
