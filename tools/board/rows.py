"""Rows of the board: figures recounted from the logs, as data and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.board.rules import SEEDS
from lerobot_memobench.board.submission import PAUSES, About
from lerobot_memobench.envs.evaluation_file import INPUTS
from lerobot_memobench.evaluation.comparison import Contrast, compare
from lerobot_memobench.evaluation.evidence import Evidence
from lerobot_memobench.evaluation.metrics import Rate, Row, stand_ins_of
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, figure, with_interval
from lerobot_memobench.io import checked, parsed
from tools.board.check import RERUNS, ranked, read_board
from tools.board.submission import Submission


@dataclass(frozen=True)
class BoardRow:
    """A row of the board.

    Attributes:
        name: of its folder.
        about: statements of the submitter.
        ranked: whether it enters the ranking.
        rerun: whether the maintainers ran or repeated the evaluation and its controls.
        suite: with the referent where it is not the suite's default.
        assets: origin of the scenes' models.
        inputs: of the policy.
        seeds: split.
        episodes: of each task.
        rates: average of SR, MSR, MUR and MCR.
        evidence: average over scenes that were run with each variant.
        pauses: change of SR by the pauses.
        without_memory: SR of the partner without a memory.
    """

    name: str
    about: About
    ranked: bool
    rerun: bool
    suite: str
    assets: str
    inputs: str
    seeds: str
    episodes: int
    rates: Row
    evidence: Evidence | None
    pauses: Contrast | None
    without_memory: Rate | None


def board_rows(board: Path) -> list[BoardRow]:
    """Return the rows of a board, after all checks: ranked rows by SR, then the others by suite and SR."""
    submissions = read_board(board)
    reruns = board / RERUNS
    known = checked(parsed(reruns.read_bytes()), dict[str, str]) if reruns.exists() else {}
    rows = [board_row(each, submissions, known) for each in submissions]
    return sorted(rows, key=lambda row: (not row.ranked, row.suite, row.assets, -(row.rates["SR"].value or 0)))


def board_row(
    submission: Submission, others: Sequence[Submission] = (), reruns: Mapping[str, str] | None = None
) -> BoardRow:
    """Return the row of a checked submission; ``others`` may hold its partner without a memory."""
    evaluation, controls = submission.evaluation, submission.controls
    protocol, run = evaluation.protocol, evaluation.run
    changes: tuple[Contrast, ...] = ()
    if PAUSES in controls:
        changes = compare(run, controls[PAUSES].run, permutations=100).contrasts
    partner = next((each for each in others if each.name == submission.about.without_memory), None)
    return BoardRow(
        name=submission.name,
        about=submission.about,
        ranked=ranked(evaluation),
        rerun=(reruns or {}).get(submission.name) == submission.digest,
        suite=" ".join([protocol["suite"], *(["random referents"] if protocol["referent"] == "random" else [])]),
        assets=f"LIBERO{', own objects for missing scans' if stand_ins_of(run.records) else ''}",
        inputs=protocol[INPUTS],
        seeds=SEEDS[protocol["seed_base"]],
        episodes=protocol["episodes"],
        rates=run.summary.average,
        evidence=run.evidence.average if run.evidence else None,
        pauses=next((each for each in changes if each.kind == "average" and each.metric == "SR"), None),
        without_memory=None if partner is None else partner.evaluation.run.summary.average["SR"],
    )


# --- text ---


def rate_text(rate: Rate | None) -> str:
    """Return a rate in per cent with its interval: ``97.8 [95.2–99.0]``."""
    if rate is None or rate.value is None or rate.interval is None:
        return NOT_APPLICABLE
    return with_interval(rate.value, *rate.interval)


def evidence_text(found: Evidence | None) -> str:
    """Return the rate of following the evidence, and the chance: ``71.0 [63.0–78.0], chance 33.3``."""
    if found is None:
        return NOT_APPLICABLE
    follows = found.rates["follows"]
    return f"{with_interval(follows.value, follows.low, follows.high)}, chance {figure(found.chance)}"


def pauses_text(found: Contrast | None) -> str:
    """Return the change of SR by pauses, in points: ``-3.0 [-6.1–0.2]``."""
    if found is None:
        return NOT_APPLICABLE
    low, high = found.interval
    return f"{figure(found.value, sign=True)} [{figure(low)} to {figure(high)}]"
