"""Reading of a submission as untrusted data: no link is followed, no other file is read, and no part is executed."""

from __future__ import annotations

import gzip
import hashlib
import json
import stat
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_memobench.board.submission import ABOUT, CARD, CONTROLS, LOG, About, row_name
from lerobot_memobench.envs.episode_log import EpisodeRecord, joined, key_of
from lerobot_memobench.envs.evaluation_file import POLICY, read_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.io import in_words
from lerobot_memobench.untrusted import Malformed, checked, parsed

LARGEST = {CARD: 2 << 20, LOG: 1 << 20}
"""File -> its largest size, bytes."""
LARGEST_UNPACKED = 8 << 20
"""Largest unpacked size of a log, bytes: some ten thousand episodes."""


@dataclass(frozen=True, kw_only=True)
class Submitted(Run):
    """An evaluation of a submission.

    Attributes:
        digest: SHA-256 of the unpacked log.
    """

    digest: str


@dataclass(frozen=True)
class Submission:
    """A row of the board as submitted: its evaluation, and those of controls by the names of `CONTROLS`."""

    name: str
    about: About
    evaluation: Submitted
    controls: Mapping[str, Submitted] = field(default_factory=dict)

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


def _read_evaluation(folder: Path, folders: Sequence[str] = ()) -> Submitted:
    _check_entries(folder, folders)
    card = read_evaluation(folder / CARD, whole=True)
    content = _unpacked(folder / LOG)
    json.loads((folder / CARD).read_bytes(), object_pairs_hook=_once)
    records = joined(folder, card, _lines(folder / LOG, content))
    return Submitted(
        name=folder.name,
        method="",
        folder=folder,
        card=card,
        records=records,
        protocol={**card["protocol"], POLICY: card[POLICY]},
        digest=hashlib.sha256(content).hexdigest(),
    )


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise for a key given twice, because readers differ in the value that counts."""
    content = dict(pairs)
    if len(content) < len(pairs):
        raise MemobenchError(f"card or log has a key twice in {str(content)[:80]}; submit them unchanged")
    return content


def _check_entries(folder: Path, folders: Sequence[str]) -> None:
    if not stat.S_ISDIR(folder.lstat().st_mode):
        raise MemobenchError(f"{folder} is not a folder; expected one with {CARD} and {LOG}")
    entries = sorted(folder.iterdir())
    for entry in entries:
        status = entry.lstat()
        if entry.name not in (*LARGEST, *folders):
            raise MemobenchError(
                f"{folder} holds {entry.name[:80]!r}; expected {CARD} and {LOG} only, and folders "
                f"{' and '.join(CONTROLS)} of a row"
            )
        if entry.name in folders:
            if not stat.S_ISDIR(status.st_mode):
                raise MemobenchError(f"{entry} is a link or a file; expected a folder")
        elif not stat.S_ISREG(status.st_mode):
            raise MemobenchError(f"{entry} is a link or no plain file; expected a file")
        elif status.st_size > LARGEST[entry.name]:
            raise MemobenchError(
                f"{entry} has {in_words(status.st_size)}; expected at most {in_words(LARGEST[entry.name])}"
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


def _lines(file: Path, content: bytes) -> Iterator[Mapping[str, Any]]:
    known = set()
    for number, line in enumerate(content.removesuffix(b"\n").split(b"\n"), start=1):
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
