"""Files of a submission: names, sizes, schema, reading and writing.

A row of the board is a folder with the card and the log of an evaluation. The card has a ``submission`` block in
addition. Subfolders hold the evaluations of controls. All of it is untrusted data: no link is followed, no other file
is read, and no part is executed.
"""

from __future__ import annotations

import datetime as dt
import gzip
import hashlib
import io
import json
import re
import shutil
import stat
import unicodedata
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le
from pydantic import AfterValidator, BaseModel, ConfigDict

from lerobot_memobench.envs.episode_log import MERGED_FILE, POLICY, EpisodeRecord, key_of, read_log, with_omitted
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, read_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run, requested_lines
from lerobot_memobench.io import PACKED, Malformed, checked, in_words, parsed, refuse_links, write_file
from lerobot_memobench.run.card import write_card

CARD, LOG = EVALUATION_FILE, MERGED_FILE + PACKED
CONTROLS = (PAUSES,) = ("pauses",)
"""Subfolders for evaluations of the same policy under a control."""
LARGEST = {CARD: 2 << 20, LOG: 1 << 20}
"""File -> its largest size, bytes."""
LARGEST_UNPACKED = 8 << 20
"""Largest unpacked size of a log, bytes: some ten thousand episodes."""
BOARD = Path("results/board")
"""The board's folder in a checkout."""
RERUNS = "reruns.json"
"""File of the board, kept by its maintainers: row -> `Submission.digest` of what they ran or repeated."""
ABOUT = "submission"
"""Key of the block that a card has in addition."""

# --- the block ---

ROW_NAME = re.compile(r"(?!(con|prn|aux|nul|com\d|lpt\d)$)[a-z0-9][a-z0-9_-]{1,63}")
"""Without the names of devices in Windows."""
TEXT = re.compile(r"[\w(][\w .,:;+()/%~–-]{0,199}")
FIRST_DAY = "2026-01-01"
LOOK_ALIKE = {"LATIN", "CYRILLIC", "GREEK"}
"""Alphabets with letters of one shape; a word that mixes them imitates another name."""
ACCOUNT = re.compile(r"@[A-Za-z0-9-]{1,39}")
LINK = re.compile(
    r"https://(?!(.*\.)?xn--|.*/(\.|%2e){1,2}(/|$))[A-Za-z0-9.-]+(/[\w.~/%+@=-]*)?", re.ASCII | re.IGNORECASE
)
"""Without look-alike hosts (IDNA) and paths that lead elsewhere."""


def row_name(name: str) -> str:
    """Return the name of a row if it is a safe name of a folder, else raise `ValueError`."""
    if not ROW_NAME.fullmatch(name):
        raise ValueError("expected 2 to 64 lower-case letters, digits, _ and -")
    return name


def _alphabets(word: str) -> set[str]:
    return {unicodedata.name(letter, "").split(" ")[0] for letter in word if letter.isalpha()}


def _text(value: str) -> str:
    mixed = any(len(_alphabets(word) & LOOK_ALIKE) > 1 for word in re.findall(r"\w+", value.replace("π", "")))
    if not TEXT.fullmatch(value) or mixed or unicodedata.normalize("NFKC", value) != value:
        raise ValueError("expected 1 to 200 letters, words of one alphabet, digits, spaces and . , : ; + ( ) / % ~ - _")
    return value


def _submitter(value: str) -> str:
    return value if ACCOUNT.fullmatch(value) else _text(value)


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
Submitter = Annotated[str, AfterValidator(_submitter)]
Link = Annotated[str, AfterValidator(_link)]
Day = Annotated[str, AfterValidator(_day)]
LINKS = ("code", "weights", "paper")


class About(BaseModel):
    """The ``submission`` block of a card. Inputs, suite and seeds are read from the card itself.

    Attributes:
        model: name of the policy, as the board shows it.
        submitter: person or team; ``@name`` for a GitHub account.
        date: of the submission.
        training_data: origin and size of the demonstrations.
        parameters: number of parameters; None if unknown, 0 for a scripted policy.
        links: addresses of code, weights and paper.
        without_memory: row of the board with a policy of the same kind that has no memory.
    """

    model_config = ConfigDict(extra="forbid")

    model: Text
    submitter: Submitter
    date: Day
    training_data: Text
    parameters: Annotated[int, Ge(0), Le(10**13)] | None = None
    links: dict[Literal["code", "weights", "paper"], Link] = {}
    without_memory: RowName | None = None


# --- reading ---


@dataclass(frozen=True)
class Evaluation:
    """An evaluation of a submission.

    Attributes:
        place: folder, as messages name it.
        card: content of its ``evaluation.json``.
        records: lines of its log.
        digest: SHA-256 of the unpacked log.
    """

    place: Path
    card: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    digest: str

    @property
    def protocol(self) -> dict[str, Any]:
        """The protocol of the card, with the values that earlier cards omit."""
        return with_omitted(self.card["protocol"])

    @property
    def run(self) -> Run:
        """The evaluation as reports read it."""
        return Run(self.place.name, "", self.place, self.records, {**self.protocol, POLICY: self.card[POLICY]})


@dataclass(frozen=True)
class Submission:
    """A row of the board as submitted: its evaluation, and those of controls by the names of `CONTROLS`."""

    name: str
    about: About
    evaluation: Evaluation
    controls: Mapping[str, Evaluation] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """SHA-256 over the cards, with the statements of the submitter, and the logs of all evaluations."""
        parts = {name: [run.card, run.digest] for name, run in {"": self.evaluation, **self.controls}.items()}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_submission(folder: Path) -> Submission:
    """Return the content of a submission's folder.

    Raises:
        MemobenchError: a name, a size or the schema of a file is not allowed.
    """
    try:
        name = row_name(folder.name)
    except ValueError as error:
        raise MemobenchError(f"found the folder {folder.name[:80]!r}; {error}") from None
    evaluation = _read_evaluation(folder, CONTROLS)
    if ABOUT not in evaluation.card:
        raise MemobenchError(f"{folder / CARD} has no block {ABOUT!r}; `memobench submit` writes it")
    try:
        about = checked(evaluation.card[ABOUT], About)
    except Malformed as error:
        raise MemobenchError(f"{folder / CARD}: {ABOUT}: {error}") from None
    controls = [name for name in CONTROLS if (folder / name).exists()]
    return Submission(name, about, evaluation, {each: _read_evaluation(folder / each) for each in controls})


def _read_evaluation(folder: Path, folders: Sequence[str] = ()) -> Evaluation:
    _check_entries(folder, folders)
    card = read_evaluation(folder / CARD, whole=True)
    content = _unpacked(folder / LOG)
    json.loads((folder / CARD).read_bytes(), object_pairs_hook=_once)
    return Evaluation(folder, card, list(_records(folder / LOG, content)), hashlib.sha256(content).hexdigest())


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise for a key given twice, because readers differ in the value that counts."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise MemobenchError(f"card or log has a key twice in {str(found)[:80]}; submit them unchanged")
    return found


def _check_entries(folder: Path, folders: Sequence[str]) -> None:
    """Refuse unknown names, links, missing and large files."""
    if not stat.S_ISDIR(folder.lstat().st_mode):
        raise MemobenchError(f"{folder} is not a folder; expected one with {CARD} and {LOG}")
    entries = sorted(folder.iterdir())
    for entry in entries:
        found = entry.lstat()
        if entry.name not in (*LARGEST, *folders):
            raise MemobenchError(
                f"{folder} holds {entry.name[:80]!r}; expected {CARD} and {LOG} only, and folders "
                f"{' and '.join(CONTROLS)} of a row"
            )
        if entry.name in folders:
            if not stat.S_ISDIR(found.st_mode):
                raise MemobenchError(f"{entry} is a link or a file; expected a folder")
        elif not stat.S_ISREG(found.st_mode):
            raise MemobenchError(f"{entry} is a link or no plain file; expected a file")
        elif found.st_size > LARGEST[entry.name]:
            raise MemobenchError(
                f"{entry} has {in_words(found.st_size)}; expected at most {in_words(LARGEST[entry.name])}"
            )
    if missing := [name for name in LARGEST if name not in {entry.name for entry in entries}]:
        raise MemobenchError(f"{folder} lacks {' and '.join(missing)}; `memobench submit` writes both")


def _unpacked(file: Path) -> bytes:
    try:
        with gzip.open(file) as packed:
            content = packed.read(LARGEST_UNPACKED + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise MemobenchError(f"{file} is no whole gzip file ({error}); `memobench submit` writes it") from None
    if len(content) > LARGEST_UNPACKED:
        raise MemobenchError(
            f"{file} becomes larger than {in_words(LARGEST_UNPACKED)}; expected a log of 50 episodes a task"
        )
    return content


def _records(file: Path, content: bytes) -> Iterator[Mapping[str, Any]]:
    known = set()
    for number, line in enumerate(content.splitlines(), start=1):
        try:
            record = checked(parsed(line), EpisodeRecord)
            json.loads(line, object_pairs_hook=_once)
        except Malformed as error:
            raise MemobenchError(f"{file}, line {number}: {error}; `memobench submit` writes it") from None
        if key_of(record) in known:
            raise MemobenchError(
                f"{file}, line {number}: a second line of {record['task']}, episode {record['episode']}"
            )
        known.add(key_of(record))
        yield record


# --- writing ---


def write_submission(folder: Path, about: About, evaluations: Mapping[str, Path]) -> Path:
    """Write the folder of a submission, and return it. An earlier submission there is replaced.

    Args:
        folder: its last part is the name of the row.
        evaluations: "" for the evaluation itself, or a name of `CONTROLS` -> folder of a finished evaluation.

    Raises:
        MemobenchError: an evaluation lacks its card or its log, or the folder holds something else.
    """
    if folder.exists() and ABOUT not in read_evaluation(folder):
        raise MemobenchError(f"{folder} exists and holds no submission; choose another --out or --name")
    refuse_links(*(folder / control for control in CONTROLS))
    for control in {*CONTROLS} - {*evaluations}:
        shutil.rmtree(folder / control, ignore_errors=True)
    for control, source in evaluations.items():
        place = folder / control
        place.mkdir(parents=True, exist_ok=True)
        card = read_evaluation(source, whole=True)
        block = {} if control else {ABOUT: about.model_dump(exclude_none=True)}
        write_card(place, {**card, **block})
        lines = [json.dumps(record) + "\n" for record in requested_lines(source, read_log(source))]
        packed = io.BytesIO()
        with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as file:
            file.write("".join(lines).encode())
        write_file(place / LOG, packed.getvalue())
    return folder
