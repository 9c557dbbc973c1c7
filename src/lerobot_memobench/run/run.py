"""Run an evaluation in this process: all of it, a part, or what an earlier run has left."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.envs.episode_log import has_log, read_episodes, read_protocol_file
from lerobot_memobench.evaluation.records.protocol import POLICY, read_protocol
from lerobot_memobench.io import count_of
from lerobot_memobench.policies.checkpoint import check_weights, portable_path
from lerobot_memobench.policies.untrained import UntrainedConfig
from lerobot_memobench.run.card import with_episodes, write_card
from lerobot_memobench.run.folder import check_new, held, made
from lerobot_memobench.run.lerobot_command import call_lerobot
from lerobot_memobench.run.lerobot_commands import without_chatter
from lerobot_memobench.run.loop.steering import calm_output, steered
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.run.plan_card import card_of, with_checkpoint
from lerobot_memobench.run.reporting import EvaluationReport, report_on
from lerobot_memobench.run.resume import Ranges, Tell, missing, remainder, resumed_card


@dataclass(frozen=True)
class Ended:
    """How an evaluation ended.

    Attributes:
        status: exit status of LeRobot's command.
        report: None when it failed, or when a part holds no episode.
    """

    status: int
    report: EvaluationReport | None = None


def run_evaluation(plan: EvaluationPlan, tell: Tell, begin: Tell = lambda text: None) -> Ended:
    """Run what is missing, write report and card.

    Args:
        tell: told what matters and stops nothing, and how to go on when a run breaks off.
        begin: told what is about to be run: the first episode takes a while.

    Raises:
        MemobenchError: the folder holds another evaluation, or weights are missing. Whatever LeRobot raises.
    """
    if plan.policy is not None and plan.policy_path is not None:
        check_weights(plan.policy_path, plan.policy)
    if not plan.orders.resume:
        check_new(plan.output)
        check_new(plan.log)
    card = card_of(plan)
    if plan.orders.resume:
        card = resumed_card(plan.log, card, tell)
    ranges = missing(plan)
    if ranges != {}:
        begin(_what_is_run(plan))
        return _run_lerobot(plan, card, ranges, tell)
    return Ended(0, _finish(plan, card) if has_log(plan.log) else None)


def _what_is_run(plan: EvaluationPlan) -> str:
    who = portable_path(plan.policy_path) if plan.policy_path else getattr(plan.policy, "type", "the policy")
    grid = plan.grid
    what = "" if grid is None else f" on {count_of(len(grid.places), 'task')}, {count_of(grid.runs, 'episode')} each"
    return f"evaluating {who}{what}, into {plan.output}"


def _run_lerobot(plan: EvaluationPlan, card: dict[str, Any], ranges: Ranges | None, tell: Tell) -> Ended:
    """Run LeRobot's evaluation on what is left, in the folder that is held meanwhile."""
    status, trained = 1, not isinstance(plan.policy, UntrainedConfig)
    try:
        with (
            nullcontext() if plan.orders.verbose else without_chatter(trained),
            held(plan),
            calm_output(),
            steered(plan.seed, ranges),
        ):
            if card["protocol"]:
                write_card(plan.log, card)
            left = remainder(plan, ranges)
            with made(left.output):  # LeRobot makes it for films of its own only
                status = call_lerobot("eval", left.lerobot_flags)
            return Ended(status, None if status else _finish(plan, card))
    finally:
        if status and has_log(plan.log):
            tell(
                f"the episodes that ended are in {plan.log}; `memobench report {plan.log}` reports them, "
                f"`{plan.going_on}` goes on"
            )


def _finish(plan: EvaluationPlan, card: dict[str, Any]) -> EvaluationReport:
    """Write the report of the log, and what was found onto the card."""
    protocol = {**(card["protocol"] or read_protocol(plan.log)), **read_protocol_file(plan.log)}
    protocol.pop(POLICY, None)  # a card says more of it; the file has what `auto` came to in LeRobot's process
    # LeRobot runs whole batches: episodes beyond those asked for are no part of the report.
    limit = None if plan.grid is None else plan.grid.first + max(plan.grid.runs, protocol["episodes"])
    report = report_on(plan.log, limit)
    records = [record for record in read_episodes(plan.log) if limit is None or record["episode"] < limit]
    card = with_checkpoint({**card, "protocol": protocol}, plan.policy_path)
    write_card(plan.log, with_episodes(card, records))
    return report
