"""The folder of an evaluation: whether it may be written to, held while a run lasts, left clean behind it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_memobench.envs.episode_log import PROTOCOL_FILE, has_log, read_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import remove_drafts
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.run.card import remove_card
from lerobot_memobench.run.plan import EvaluationPlan

VIDEOS = "videos"
EARLIER_DRAFTS = (".*.part", "*.part", f".{PROTOCOL_FILE}.*", f"{VIDEOS}/.*.part")
"""What earlier versions of this package called files that were being written."""


def check_new(folder: Path) -> None:
    """Refuse to mix an evaluation with an earlier one in the same folder."""
    if has_log(folder):
        raise MemobenchError(
            f"{folder} already holds an evaluation; choose another output_dir=, or go on with it by resume=true"
        )
    check_folder(folder)


def check_folder(folder: Path) -> None:
    """Refuse to write into what is no folder."""
    if folder.exists() and not folder.is_dir():
        raise MemobenchError(f"output_dir={folder} is a file; name a folder")


def logged(folder: Path, referent: str) -> set[tuple[str, int]]:
    """Return (task, episode) of the episodes in a folder's log, those included that could not be run."""
    if not has_log(folder):
        return set()
    records = read_log(folder)
    return {(record["task"], record["episode"]) for record in records if record.get("referent", "fixed") == referent}


@contextmanager
def held(plan: EvaluationPlan) -> Iterator[None]:
    """Hold the folder of an evaluation's log; a run that ends before its first episode leaves nothing in it.

    Raises:
        MemobenchError: another run holds it.
    """
    new = [folder for folder in (plan.output, plan.log) if not folder.exists()]
    plan.log.mkdir(parents=True, exist_ok=True)
    try:
        with locked(plan.log, plan.log):
            _clean(plan.log)
            yield
    finally:
        if not has_log(plan.log):
            remove_card(plan.log)
            for folder in new:
                _remove_empty(folder)


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make a folder for as long as it is written to; of a new one nothing that is empty stays behind."""
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if new:
            _remove_empty(folder)


def _clean(folder: Path) -> None:
    """Remove what a killed run was writing: whole files have names of their own."""
    for place in (folder, folder / VIDEOS):
        remove_drafts(place)
    for pattern in EARLIER_DRAFTS:
        for draft in folder.glob(pattern):
            draft.unlink(missing_ok=True)


def _remove_empty(folder: Path) -> None:
    """Remove a folder and those below it, as far as they hold nothing."""
    if not folder.is_dir():
        return
    for child in sorted(folder.rglob("*"), reverse=True):
        if child.is_dir() and not any(child.iterdir()):
            child.rmdir()
    if not any(folder.iterdir()):
        folder.rmdir()
