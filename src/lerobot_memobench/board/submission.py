"""Files of a submission, and the text of its pull request.

A row of the board is a folder with the card and the log of an evaluation. The card has a ``submission`` block in
addition. Subfolders hold the evaluations of controls.
"""

from __future__ import annotations

import datetime as dt
import gzip
import re
import shutil
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le
from pydantic import AfterValidator, BaseModel, ConfigDict

from lerobot_memobench.envs.episode_log import MERGED_FILE, log_text
from lerobot_memobench.envs.evaluation_file import (
    EVALUATION_FILE,
    has_evaluation,
    read_evaluation,
    require_whole,
    write_evaluation,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run, read_run
from lerobot_memobench.evaluation.report import evaluation_markdown
from lerobot_memobench.io import refuse_links, write_file
from lerobot_memobench.untrusted import PACKED

CARD, LOG = EVALUATION_FILE, MERGED_FILE + PACKED
CONTROLS = (PAUSES,) = ("pauses",)
"""Subfolders for evaluations of the same policy under a control."""
BOARD = Path("results/board")
"""The board's folder in a checkout."""
ABOUT = "submission"
"""Key of the block that a card has in addition."""

# --- the block ---

# Windows cannot have files with names of devices.
ROW_NAME = re.compile(r"(?!(con|prn|aux|nul|com\d|lpt\d)$)[a-z0-9][a-z0-9_-]{1,63}")
TEXT = re.compile(r"[\w(][\w .,:;+()/%~–-]{0,199}")
FIRST_DAY = "2026-01-01"
# Alphabets with letters of one shape: a word that mixes them imitates another name.
LOOK_ALIKE = {"LATIN", "CYRILLIC", "GREEK"}
ACCOUNT = re.compile(r"@[A-Za-z0-9-]{1,39}")
# Without look-alike hosts (IDNA) and paths that lead elsewhere.
LINK = re.compile(
    r"https://(?!(.*\.)?xn--|.*/(\.|%2e){1,2}(/|$))[A-Za-z0-9.-]+(/[\w.~/%+@=-]*)?", re.ASCII | re.IGNORECASE
)


def row_name(name: str) -> str:
    """Return the name of a row if it is a safe name of a folder, else raise `ValueError`."""
    if not ROW_NAME.fullmatch(name):
        raise ValueError("expected 2 to 64 lower-case letters, digits, _ and -")
    return name


def _text(value: str) -> str:
    # π0 and π0.5 are names of policies.
    words = re.findall(r"\w+", value.replace("π", ""))
    alphabets = [{unicodedata.name(letter, "").split(" ")[0] for letter in word if letter.isalpha()} for word in words]
    mixed = any(len(each & LOOK_ALIKE) > 1 for each in alphabets)
    if not TEXT.fullmatch(value) or mixed or unicodedata.normalize("NFKC", value) != value:
        raise ValueError("expected 1 to 200 letters, words of one alphabet, digits, spaces and . , : ; + ( ) / % ~ - _")
    return value


def _link(value: str) -> str:
    if len(value) > 300 or not LINK.fullmatch(value):
        raise ValueError("expected an address that begins with https:// and has no query")
    return value


def _day(value: str) -> str:
    latest = dt.date.today() + dt.timedelta(days=1)  # somewhere it is tomorrow
    if str(dt.date.fromisoformat(value)) != value or not FIRST_DAY <= value <= str(latest):
        raise ValueError(f"expected a date as YYYY-MM-DD, from {FIRST_DAY} to {latest}")
    return value


RowName = Annotated[str, AfterValidator(row_name)]
Text = Annotated[str, AfterValidator(_text)]
Submitter = Annotated[str, AfterValidator(lambda value: value if ACCOUNT.fullmatch(value) else _text(value))]
LINKS = ("code", "weights", "paper")


class About(BaseModel):
    """The ``submission`` block of a card. Inputs, suite and seeds are read from the card itself.

    Attributes:
        model: name of the policy, as the board shows it.
        submitter: person or team; ``@name`` for a GitHub account.
        training_data: origin and size of the demonstrations.
        parameters: number of parameters; None if unknown, 0 for a scripted policy.
        without_memory: row of the board with a policy of the same kind that has no memory.
        supervised_with_answer: whether texts that name the hidden answer supervised the policy in training, see
            `rules.supervised_with_answer`.
    """

    model_config = ConfigDict(extra="forbid")

    model: Text
    submitter: Submitter
    date: Annotated[str, AfterValidator(_day)]
    training_data: Text
    parameters: Annotated[int, Ge(0), Le(10**13)] | None = None
    links: dict[Literal["code", "weights", "paper"], Annotated[str, AfterValidator(_link)]] = {}
    without_memory: RowName | None = None
    supervised_with_answer: bool | None = None


# --- files ---


def own_evaluation(folder: Path) -> Run:
    """Return a finished evaluation of the user; raise where its card lacks something that a repetition needs."""
    run = read_run(folder)
    require_whole(folder, run.card)
    return run


def write_submission(folder: Path, about: About, evaluations: Mapping[str, Path]) -> Path:
    """Write the folder of a submission, named after its row, and return it. An earlier submission is replaced.

    ``evaluations`` maps "" for the evaluation itself, or a name of `CONTROLS`, to the folder of a finished one.
    """
    if folder.exists() and not (has_evaluation(folder) and ABOUT in read_evaluation(folder)):
        raise MemobenchError(f"{folder} exists and holds no submission; choose another --out or --name")
    refuse_links(*(folder / control for control in CONTROLS))
    for control in {*CONTROLS} - {*evaluations}:
        shutil.rmtree(folder / control, ignore_errors=True)
    for control, source in evaluations.items():
        target = folder / control
        evaluation = own_evaluation(source)
        block = {} if control else {ABOUT: about.model_dump(exclude_none=True)}
        write_evaluation(target, {**evaluation.card, **block})
        # Without its time, so that equal logs are equal files.
        write_file(target / LOG, gzip.compress(log_text(evaluation.records).encode(), mtime=0))
    return folder


# --- the text of a pull request ---

PROMISES = (
    "No setting of this policy was chosen on the seeds of this evaluation.",
    "No demonstration of these seeds was used in training.",
    "The maintainers may rerun it: weights or a policy server are available at the links, or on request.",
)
"""Statements of a submitter that no program can check; template and form ask for the same."""


def pull_request(name: str, about: About, evaluation: Run) -> str:
    """Return the text in Markdown, with promises to confirm and the evaluation's report."""
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
        evaluation_markdown(evaluation),
    ]
    return "\n".join(lines)
