"""Going on with an evaluation: whether it is the same one, which episodes are left, what is then run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, POLICY, differences, read_card, read_protocol
from lerobot_memobench.run.card import extended
from lerobot_memobench.run.folder import check_folder, logged
from lerobot_memobench.run.grid import Range, task_names
from lerobot_memobench.run.plan import EvaluationPlan

Tell = Callable[[str], None]
"""Told what a user should know and what stops nothing."""

Ranges = Mapping[tuple[str, int], list[Range]]
"""LeRobot's name of a task -> the runs of it that are made."""


def earlier_batch_size(log: Path) -> int | None:
    """Return the batch size of the evaluation in a folder, None where there is none or nobody knows."""
    path = log / CARD_FILE
    if not path.is_file():
        return None
    starts = read_card(path).get("runs") or [{}]
    size = starts[-1].get("batch_size")
    return None if size is None else int(size)


def resumed_card(folder: Path, card: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Return the card for an evaluation that goes on with the one in ``folder``.

    Tasks and episodes may be others: those that are there stay. A folder without an evaluation is begun.

    Raises:
        MemobenchError: it is another evaluation: of another protocol, policy, or of other task files.
    """
    check_folder(folder)
    path = folder / CARD_FILE
    if not has_log(folder):
        return card
    found = differences(read_protocol(folder), {**card["protocol"], POLICY: card[POLICY]}, policy=True)
    if found:
        raise MemobenchError(
            f"{folder} holds an evaluation with another protocol ({'; '.join(found)}, there and now); repeat its "
            "settings to go on with it, or choose another output_dir="
        )
    if not path.is_file():
        tell(f"note: {folder} has no {CARD_FILE}: whether its episodes are this policy's cannot be checked")
        return card
    earlier = read_card(path, whole=True)
    edited = [name for name, value in card["task_files"].items() if earlier["task_files"].get(name, value) != value]
    if edited:
        raise MemobenchError(f"the files of {edited[0]} are not those that the episodes in {folder} were run with")
    for changed in _run_differences(earlier["runs"][-1], card["runs"][-1]):
        tell(f"note: the episodes in {folder} were run otherwise ({changed}, there and now); numbers may depend on it")
    return extended(earlier, card)


def _run_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return in what the start of a run differs from that of an earlier one, on which numbers may depend."""
    found = []
    if earlier["batch_size"] != now["batch_size"]:
        found.append(f"batch_size: {earlier['batch_size']} and {now['batch_size']}")
    for part in ("versions", "gl"):
        there, here = earlier[part], now[part]
        changed = [f"{key}: {there[key]} and {here[key]}" for key in here if there.get(key, here[key]) != here[key]]
        found += changed[:1]
    return found


def missing(plan: EvaluationPlan) -> Ranges | None:
    """Return the runs that are to be made, in whole batches; None for all of them."""
    orders = plan.orders
    if plan.grid is None or plan.environment is None or not (orders.resume or orders.shard is not None):
        return None
    done = logged(plan.log, plan.environment.referent)
    return plan.grid.ranges(plan.grid.missing(done, orders.shard))


def remainder(plan: EvaluationPlan, ranges: Ranges | None) -> EvaluationPlan:
    """Return the plan of what is left: tasks that are done are not opened, episodes that are there are left out."""
    if ranges is None or plan.grid is None:
        return plan
    settings, output = plan.settings, plan.output
    names = task_names(plan.grid.places, ranges)
    if len(names) < len(plan.grid.places) and not settings.has("env.task_dir"):
        settings = settings.changed("env.task" if settings.has("env.task") else "env.tasks", ",".join(names))
    if has_log(plan.log):
        settings = settings.changed("env.resume", True)
        output = unused_subfolder(plan.output)
    return replace(plan, settings=settings, output=output)


def unused_subfolder(output: Path) -> Path:
    """Return the first folder ``continued-k`` that is not there: LeRobot would write over the first run's own files."""
    k = 1
    while (output / f"continued-{k}").exists():
        k += 1
    return output / f"continued-{k}"
