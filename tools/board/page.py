"""Rows of the board, recounted from the logs, and their table for the site.

`scripts/docs_reference.py` puts the table into ``docs/benchmark/board.md``. ``docs/javascripts/board.js`` makes it
sortable.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from lerobot_memobench.board.rules import SEEDS, supervised_with_answer
from lerobot_memobench.board.submission import PAUSES, About
from lerobot_memobench.envs.evaluation_file import INPUTS, POLICY
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.evidence import Evidence
from lerobot_memobench.evaluation.metrics import PAPER_METRICS, Rate, Row, stand_ins_of
from lerobot_memobench.evaluation.statistics import Contrast
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, percent_text, with_interval
from lerobot_memobench.untrusted import checked, parsed
from tools.board.check import RERUNS, ranked, read_board, remembers
from tools.board.submission import Submission


@dataclass(frozen=True)
class BoardRow:
    """A row of the board.

    Attributes:
        name: of its folder.
        rerun: whether the maintainers ran or repeated the evaluation and its controls.
        suite: with the referent where it is not the suite's default.
        assets: origin of the scenes' models.
        seeds: split.
        rates, evidence: averages.
        pauses: change of SR by the pauses.
        without_memory: SR of the partner without a memory.
        replan: executed actions of each plan.
        memory_stride: control steps between updates of the memory, where the policy's settings name them.
        supervised: whether the policy was supervised with the answer; None for a script.
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
    replan: int | None
    memory_stride: int | None
    supervised: bool | None


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
    protocol = evaluation.protocol
    changes: Sequence[Contrast] = ()
    if PAUSES in controls:
        changes = compare_evaluations(evaluation, controls[PAUSES], permutations=100).contrasts
    partner = next((each for each in others if each.name == submission.about.without_memory), None)
    return BoardRow(
        name=submission.name,
        about=submission.about,
        ranked=ranked(evaluation),
        rerun=(reruns or {}).get(submission.name) == submission.digest,
        suite=" ".join([protocol["suite"], *(["random referents"] if protocol["referent"] == "random" else [])]),
        assets=f"LIBERO{', own objects for missing scans' if stand_ins_of(evaluation.records) else ''}",
        inputs=protocol[INPUTS],
        seeds=SEEDS[protocol["seed_base"]],
        episodes=protocol["episodes"],
        rates=evaluation.summary.average,
        evidence=evaluation.evidence.average if evaluation.evidence else None,
        pauses=next((each for each in changes if each.kind == "average" and each.metric == "SR"), None),
        without_memory=None if partner is None else partner.evaluation.summary.average["SR"],
        replan=evaluation.replan_steps,
        memory_stride=memory_stride(evaluation.card[POLICY].get("settings", {})),
        supervised=supervised_with_answer(evaluation, submission.about),
    )


def memory_stride(settings: Mapping[str, Any]) -> int | None:
    """Return the control steps between updates of a policy's memory; None without a memory, or if they are unknown."""
    stride = settings.get("memory_stride") if remembers(settings) else None
    return stride if isinstance(stride, int) else None  # a card may hold any value


# --- the table ---

BOARD = Path(__file__).resolve().parents[2] / "results" / "board"
PLACE = "<!-- board -->"
"""Line of the page that the table replaces."""
TABLE = "board-table"
"""Id of the table; the page's heading has the id ``board``."""
HEAD = (
    *(
        "policy",
        "rank",
        *PAPER_METRICS,
        "follows evidence",
        "change by pauses",
        "without memory, SR",
        "supervised with the answer",
        "suite",
        "assets",
    ),
    *("inputs", "plan interval", "parameters", "training data", "episodes of each task", "run by us"),
)
UNRANKED = 1000
"""Value by which rows without a rank are sorted."""

Cell = tuple[str, float | str]
"""HTML of a cell, and the value by which it is sorted."""
SUPERVISED: Mapping[bool | None, Cell] = {True: ("yes", 1), False: ("no", 0), None: (NOT_APPLICABLE, -1)}


def table() -> str:
    """Return the board as an HTML table."""
    ranks = itertools.count(1)
    lines = [_line(next(ranks) if row.ranked else None, row) for row in board_rows(BOARD)]
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in HEAD)
    body = "\n".join(lines)
    whole = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    return f'<div class="board">\n<table id="{TABLE}">\n{whole}\n</table>\n</div>'


def _line(rank: int | None, row: BoardRow) -> str:
    about = row.about
    links = " ".join(f'<a href="{escape(link)}" rel="nofollow noopener">{key}</a>' for key, link in about.links.items())
    policy = f"{escape(about.model)}<br><small>{escape(about.submitter)}, {about.date}{links and f', {links}'}</small>"
    count = about.parameters
    cells: list[Cell] = [
        (policy, about.model.lower()),
        (NOT_APPLICABLE, UNRANKED) if rank is None else (str(rank), rank),
        *(_rate(row.rates[metric]) for metric in PAPER_METRICS),
        _evidence(row.evidence),
        _pauses(row.pauses),
        _rate(row.without_memory),
        SUPERVISED[row.supervised],
        *((escape(text), text) for text in (row.suite, row.assets, row.inputs)),
        _interval(row.replan, row.memory_stride),
        (NOT_APPLICABLE if count is None else f"{count:,}", -1 if count is None else count),
        (escape(about.training_data), about.training_data),
        (f"{row.episodes}<br><small>{escape(row.seeds)}</small>", row.episodes),
        ("yes" if row.rerun else "no", int(row.rerun)),
    ]
    made = "".join(f'<td data-sort="{escape(str(value))}">{text}</td>' for text, value in cells)
    return f"<tr>{made}</tr>" if row.rerun else f'<tr class="unverified">{made}</tr>'


def _rate(rate: Rate | None) -> Cell:
    """Return a rate in per cent with its interval: ``97.8 [95.2–99.0]``."""
    if rate is None or rate.value is None or rate.interval is None:
        return NOT_APPLICABLE, -1 if rate is None or rate.value is None else rate.value
    return with_interval(rate.value, *rate.interval), rate.value


def _evidence(evidence: Evidence | None) -> Cell:
    """Return the rate of following the evidence, and the chance: ``71.0 [63.0–78.0], chance 33.3``."""
    if evidence is None:
        return NOT_APPLICABLE, -1
    follows, chance = evidence.rates["follows"], percent_text(evidence.chance)
    return f"{with_interval(follows.value, follows.low, follows.high)}, chance {chance}", follows.value or 0


def _interval(replan: int | None, memory: int | None) -> Cell:
    """Return the control steps between plans, and between updates of the memory: ``6, memory 8``."""
    text = NOT_APPLICABLE if replan is None else str(replan)
    return text if memory is None else f"{text}<br><small>memory {memory}</small>", -1 if replan is None else replan


def _pauses(change: Contrast | None) -> Cell:
    """Return the change of SR by pauses, in points: ``-3.0 [-6.1 to 0.2]``."""
    if change is None:
        return NOT_APPLICABLE, -2
    low, high = map(percent_text, change.interval)
    return f"{percent_text(change.value, sign=True)} [{low} to {high}]", change.value
