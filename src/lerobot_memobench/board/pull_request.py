"""The text of a pull request with a submission."""

from __future__ import annotations

from lerobot_memobench.board.submission import CARD, CONTROLS, LOG, About, Evaluation
from lerobot_memobench.evaluation.report import evaluation_markdown

PROMISES = (
    "No setting of this policy was chosen on the seeds of this evaluation.",
    "No demonstration of these seeds was used in training.",
    "The maintainers may rerun it: weights or a policy server are available at the links, or on request.",
)
"""Statements of a submitter that no program can check; template and form ask for the same."""


def pull_request(name: str, about: About, evaluation: Evaluation) -> str:
    """Return the text in Markdown: files, statements of the submitter, promises to confirm, report of the evaluation.

    Args:
        name: of the row's folder.
    """
    stated = about.model_dump(exclude_none=True)
    stated |= stated.pop("links")
    lines = [
        f"This pull request adds `results/board/{name}` and changes nothing else: `{CARD}`, `{LOG}` and, for a "
        f"control, the same two files in {' and '.join(f'`{control}`' for control in CONTROLS)}.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {key.replace('_', ' ')} | {value} |" for key, value in stated.items()),
        "",
        *(f"- [ ] {promise}" for promise in PROMISES),
        "",
        evaluation_markdown(evaluation.run),
    ]
    return "\n".join(lines)
