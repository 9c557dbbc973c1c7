"""Run an evaluation in this process, batch after batch: all of it, a part, or the episodes that an earlier run left."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.device_utils import get_safe_torch_device
from lerobot.utils.random_utils import set_seed

from lerobot_memobench.envs.episode_log import Key, has_log, key_of, read_lines
from lerobot_memobench.envs.evaluation_file import (
    EVALUATION_FILE,
    INPUTS,
    POLICY,
    Acting,
    differences_of_parts,
    read_evaluation,
    require_whole,
    write_evaluation,
)
from lerobot_memobench.envs.settings import SWAP
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.io import refuse_links, remove_drafts
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.jobs.threads import limit_torch
from lerobot_memobench.policies.checkpoint import check_weights, portable_path, quiet
from lerobot_memobench.policies.memory_reads import MEMORY_READS, noting_reads
from lerobot_memobench.rollouts.card import card_of, extended, with_checkpoint
from lerobot_memobench.rollouts.plan import Cell, EvaluationPlan, Shard
from lerobot_memobench.rollouts.rollout import Actor, BatchSeeds, roll

VIDEOS = "videos"

Note = Callable[[str], None]
"""Called with a message for the user; the run continues."""

BatchCallback = Callable[[int, int, str], None]
"""Called after each batch with the finished episodes, all episodes of the run, and the task's name."""


def run_evaluation(plan: EvaluationPlan, note: Note, begin: Note, advance: BatchCallback) -> Run | None:
    """Run the missing episodes, write report and card; return None for a part that holds no episode.

    Args:
        note: called with notes, and with the command that resumes a run that breaks off.
        begin: called with a line on the evaluation before it starts.
    """
    if plan.policy_path is not None:
        check_weights(plan.policy_path, plan.policy)
    with locked_evaluation(plan):
        card = card_of(plan)
        if plan.options.resume:
            card = resumed_card(plan.log, card, note)
        else:
            check_new(plan.output)
            check_new(plan.log)
        for part in sorted(plan.output.parent.glob(Shard.FOLDERS)) if plan.options.shard is not None else ():
            resumed_card(part, card, lambda text: None)  # else the parts could not be merged
        # A batch with a missing episode is run whole; its logged rows rest.
        if cells := plan.grid.missing(logged(plan.log), plan.options.shard):
            policy = portable_path(plan.policy_path) if plan.policy_path else plan.policy.type
            tasks = count_of(len(plan.grid.tasks), "task") + (" with variants" if plan.environment.evidence else "")
            episodes = count_of(plan.grid.runs, "episode")
            begin(f"evaluating {policy} on {tasks}, {episodes} each, into {plan.output}")
            try:
                evaluate(plan, cells, card, advance)
            except BaseException:  # Ctrl-C too
                if has_log(plan.log):
                    note(
                        f"the episodes that ended are in {plan.log}; report them: `memobench report {plan.log}`; "
                        f"resume: `{plan.resuming_command}`"
                    )
                raise
        elif has_log(plan.log):  # this start runs nothing, so it is none of the card's runs
            earlier = read_evaluation(plan.log).get("runs", card["runs"])
            write_evaluation(plan.log, {**card, "runs": earlier})
        else:
            return None
        return write_report(plan.log)


# --- the loop ---


def evaluate(plan: EvaluationPlan, cells: Sequence[Cell], card: dict[str, Any], advance: BatchCallback) -> None:
    """Run batches of episodes, those of one task in succession; the environments write the log."""
    policy: Any = plan.policy
    device = get_safe_torch_device(policy.device)
    # As LeRobot's own command sets them, before it makes the policy.
    torch.backends.cudnn.benchmark = True
    torch.backends.cuda.matmul.allow_tf32 = True
    set_seed(plan.seed)
    actor = load_actor(plan)
    limit_torch(sum(parameter.numel() for parameter in actor.policy.parameters()))
    card = with_checkpoint(card, plan)  # which the hub has delivered by now
    write_evaluation(plan.log, card)
    # Logged rows of a resumed batch rest, and have no memory to swap.
    rests = plan.environment.corrupt != SWAP
    environment = replace(plan.environment, resume=rests and has_log(plan.log))
    by = Acting(card[POLICY], card["protocol"][INPUTS], range(plan.seed, plan.seed + plan.grid.runs))
    # The loaded policy's configuration: some policies of LeRobot replace their plan by that of the checkpoint.
    open_environments = environment.opener(actor.policy.config, by, plan.log)
    seeds = BatchSeeds(actor.policy, plan.seed)
    scenes, reads = environment.settings, plan.options.memory_reads
    amp = torch.autocast(device_type=device.type) if policy.use_amp else nullcontext()
    done, total = 0, sum(len(plan.grid.runs_of(number)) for _, number in cells)
    groups = itertools.groupby(cells, lambda cell: (cell[0], len(plan.grid.runs_of(cell[1]))))
    for (task, rows), group in groups:
        # Without settings of the user, each environment has a process of its own.
        opened = open_environments(task, rows, plan.settings.use_async_envs is not False)
        with amp, closing(opened) as env:
            for _, number in group:
                runs = plan.grid.runs_of(number)
                batch = range(plan.seed + runs.start, plan.seed + runs.stop)
                seeds.begin(task.name, batch.start)
                watched = noting_reads(plan.log, scenes, task.name, actor.policy, batch) if reads else nullcontext()
                with watched as ended:
                    roll(env, actor, batch, ended, scenes.corrupt)
                done += len(batch)
                advance(done, total, task.name)


def load_actor(plan: EvaluationPlan) -> Actor:
    """Return the plan's policy and its processors, as LeRobot makes them."""
    policy, environment = copy(plan.policy), plan.environment
    policy.pretrained_path = None if plan.policy_path is None else Path(plan.policy_path)
    renamed = dict(plan.settings.rename_map)
    with quiet() if plan.policy_path is None else nullcontext():  # LeRobot warns that there are no weights
        loaded = make_policy(cfg=policy, env_cfg=environment, rename_map=renamed).eval()
    before, after = make_pre_post_processors(
        policy_cfg=policy,
        pretrained_path=policy.pretrained_path,
        preprocessor_overrides={
            "device_processor": {"device": str(loaded.config.device)},
            "rename_observations_processor": {"rename_map": renamed},
        },
    )
    env_before, env_after = environment.get_env_processors()  # LeRobot's function would give any XVLA those of LIBERO
    return Actor(loaded, (env_before, before), (after, env_after))


# --- resuming: whether it is the same evaluation, and which episodes are left ---


def resumed_card(folder: Path, card: dict[str, Any], note: Note) -> dict[str, Any]:
    """Return the card for an evaluation that resumes the one in ``folder``, if there is one.

    Tasks and episodes may differ: finished ones are kept. Another protocol, another policy and other task files are
    refused.
    """
    check_folder(folder)
    if not has_log(folder):
        return card
    earlier = read_evaluation(folder)
    if unlike := differences_of_parts(earlier, card):
        raise MemobenchError(
            f"{folder} holds an evaluation with another protocol ({'; '.join(unlike)}, there and now); repeat its "
            "settings to resume it, or choose another output_dir="
        )
    if "runs" not in earlier:  # LeRobot's own command wrote it
        if not earlier[POLICY]:
            note(f"note: {folder} names no policy: whether its episodes are of this policy cannot be checked")
        return card
    require_whole(folder, earlier)
    both = extended(earlier, card, folder)
    old, new = ({"batch_size": run["batch_size"], **run["versions"]} for run in (earlier["runs"][-1], card["runs"][-1]))
    changed = [f"{key} {old[key]}, now {new[key]}" for key in new if old.get(key, new[key]) != new[key]]
    for change in changed[: 1 + (old["batch_size"] != new["batch_size"])]:  # and the first version that differs
        note(f"note: numbers may depend on a change since the episodes in {folder}: {change}")
    return both


def logged(folder: Path) -> set[Key]:
    """Return the episodes in a folder's log, without those that could not be run: a resumed evaluation retries them."""
    return {key_of(line) for line in read_lines(folder) if "not_run" not in line} if has_log(folder) else set()


# --- the folder of an evaluation ---


def check_new(folder: Path) -> None:
    """Refuse to mix an evaluation with an earlier one in the same folder."""
    if has_log(folder):
        raise MemobenchError(f"{folder} already holds an evaluation; choose another output_dir=, or add resume=true")
    check_folder(folder)


def check_folder(folder: Path) -> None:
    """Refuse a file in the place of a folder."""
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


@contextmanager
def locked_evaluation(plan: EvaluationPlan) -> Iterator[None]:
    """Make and lock the folders of an evaluation and of its log, see `locked_folder`.

    Drafts of a killed run are removed. A run that ends before its first episode leaves no evaluation file.
    """
    with ExitStack() as stack:
        for folder in {folder.absolute(): folder for folder in (plan.output, plan.log)}.values():
            stack.enter_context(locked_folder(folder))
        refuse_links(plan.log / VIDEOS, plan.log / MEMORY_READS)
        for folder in (plan.log, plan.log / VIDEOS, plan.log / MEMORY_READS):
            remove_drafts(folder)
        file = plan.log / EVALUATION_FILE
        existed = file.exists()
        try:
            yield
        finally:
            if not existed and not has_log(plan.log):
                file.unlink(missing_ok=True)


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Make a folder and lock it, see `locked`; afterwards new folders that are empty are removed."""
    check_folder(folder)
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, folder):
        try:
            yield
        finally:
            for path in new:
                for child in [*sorted(path.rglob("*"), reverse=True), path]:  # children first
                    if child.is_dir() and not any(child.iterdir()):
                        child.rmdir()
