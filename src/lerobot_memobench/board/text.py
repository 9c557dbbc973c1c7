"""The text of a pull request with a submission."""

from __future__ import annotations

from lerobot_memobench.board.rows import BoardRow, evidence_text, pauses_text, rate_text
from lerobot_memobench.board.submission import CARD, CONTROLS, LOG
from lerobot_memobench.evaluation.metrics import METRICS

PROMISES = (
    "No setting of this policy was chosen on the seeds of this evaluation.",
    "No demonstration of these seeds was used in training.",
    "The maintainers may rerun it: weights or a policy server are available at the links, or on request.",
)
"""Statements of a submitter that no program can check; template and form ask for the same."""


def pull_request(row: BoardRow) -> str:
    """Return the text in Markdown: files, figures recounted from the log, and the statements to confirm."""
    about = row.about
    cells = {
        "model": about.model,
        "submitter": about.submitter,
        "suite": f"{row.suite}, {'ranked' if row.ranked else 'not ranked'}",
        "assets": row.assets,
        "inputs": row.inputs,
        "seeds": f"{row.seeds}, {row.episodes} episodes of each task",
        "parameters": "unknown" if about.parameters is None else f"{about.parameters:,}",
        "training data": about.training_data,
        **about.links,
        **{metric: rate_text(row.rates[metric]) for metric in METRICS},
        "follows the evidence": evidence_text(row.evidence),
        "change by pauses": pauses_text(row.pauses),
        "without a memory": about.without_memory or "–",
    }
    lines = [
        f"# Result of {about.model}",
        "",
        f"This pull request adds `results/board/{row.name}` and changes nothing else: `{CARD}`, `{LOG}` and, for a "
        f"control, the same two files in {' and '.join(f'`{name}`' for name in CONTROLS)}.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {key} | {value} |" for key, value in cells.items()),
        "",
        *(f"- [ ] {promise}" for promise in PROMISES),
    ]
    return "\n".join(lines) + "\n"
