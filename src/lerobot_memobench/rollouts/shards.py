"""Run the parts of an evaluation as jobs (``lerobot eval … shards=8``), and merge parts into one evaluation.

A part is the same command with ``shard=i/n resume=true`` in a process of its own. So a killed part is resumed, and a
finished part is skipped.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import Key, has_log, joined, key_of, read_lines, write_episodes
from lerobot_memobench.envs.evaluation_file import (
    EXTENT,
    POLICY,
    differences_of_parts,
    read_evaluation,
    require_whole,
    write_evaluation,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run, disagreement
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.io import draft_of, refuse_links
from lerobot_memobench.jobs.processes import ProgressCallback, run_jobs
from lerobot_memobench.jobs.threads import sharing
from lerobot_memobench.policies.memory_reads import MEMORY_READS
from lerobot_memobench.rollouts.card import card_of, extended
from lerobot_memobench.rollouts.evaluate import (
    VIDEOS,
    Note,
    check_new,
    locked_folder,
    logged,
    resumed_card,
)
from lerobot_memobench.rollouts.plan import EvaluationPlan, Shard, with_changes

LOGS = "logs"


# --- parts as jobs ---


@dataclass(frozen=True)
class ShardJob:
    """One part of an evaluation, as a job."""

    program: tuple[str, ...]  # arguments of Python for a process of ``lerobot`` that ends when its standard input does
    arguments: tuple[str, ...]  # the command line of the part, after ``lerobot``
    shard: Shard
    out: Path  # folder of the evaluation
    episodes: frozenset[Key]
    directory: Path  # where relative paths are looked up
    at_once: int  # parts that run at the same time

    @property
    def folder(self) -> Path:
        """Folder of the part's log."""
        return self.out / self.shard.folder

    @property
    def task_name(self) -> str:
        """Name of the job in messages on progress."""
        return f"part {self.shard}"

    @property
    def seed(self) -> int:
        """The part's number, which identifies the job."""
        return self.shard.number

    @property
    def messages(self) -> Path:
        """File for the output of the part's process."""
        return self.out / LOGS / f"{self.shard.folder}.log"

    def finished(self) -> bool:
        """Whether all episodes of the part are in its log."""
        return self.episodes <= logged(self.folder)

    def failure(self) -> str | None:
        """Return None: a part that cannot be run raises."""
        return None

    def run(self) -> None:
        """Run the part in a process of its own, which ends when this process does; raise with its error message."""
        self.messages.parent.mkdir(parents=True, exist_ok=True)
        with self.messages.open("ab") as file:
            begin = file.tell()  # after the messages of earlier starts
            process = subprocess.Popen(
                [sys.executable, *self.program, *self.arguments],
                cwd=self.directory,
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=file,
                env=sharing(self.at_once),
            )
            try:
                status = process.wait()
            except BaseException:  # Ctrl-C too
                process.kill()
                process.wait()
                raise
        if status:
            lines = self.messages.read_bytes()[begin:].decode(errors="replace").splitlines()
            errors = [line.removeprefix("lerobot: ") for line in lines if line.startswith("lerobot: ")]
            raise MemobenchError(
                f"{self.task_name} ended with {errors[-1] if errors else f'status {status}'} (see {self.messages}); "
                "resume by the same command with resume=true"
            )


def plan_shards(plan: EvaluationPlan, program: Sequence[str], note: Note) -> list[ShardJob]:
    """Return a job for each part of an evaluation, which starts ``program``.

    More parts than batches, and folders that hold another evaluation are refused.
    """
    options, grid, out = plan.options, plan.grid, plan.output.absolute()
    if options.shards > (batches := len(grid.cells())):
        raise MemobenchError(f"found shards={options.shards} and only {batches} batches of episodes; ask for fewer")
    own: dict[str, object] = dict.fromkeys(("shards", "workers", "output_dir", "resume"))
    together = plan.settings.use_async_envs is False  # of the whole, which the parts' own batch size would not imply
    own |= {"eval.use_async_envs": "false"} if together else {}
    words = with_changes(plan.command[2:], **own, batch_size=plan.batch, salt=plan.environment.salt)
    jobs = [
        ShardJob(
            program=tuple(program),
            arguments=("eval", *words, f"output_dir={out}", f"shard={shard}", "resume=true"),
            shard=shard,
            out=out,
            episodes=frozenset(episode for cell in grid.cells(shard) for episode in grid.episodes(cell)),
            directory=Path.cwd(),
            at_once=min(options.workers or options.shards, options.shards),
        )
        for shard in (Shard(k + 1, options.shards) for k in range(options.shards))
    ]
    if options.resume:
        card = card_of(plan)
        for folder in (out, *(job.folder for job in jobs)):
            resumed_card(folder, card, note)
    else:
        for folder in (out, *out.glob(Shard.FOLDERS)):
            check_new(folder)
    return jobs


def run_shards(plan: EvaluationPlan, jobs: Sequence[ShardJob], progress: ProgressCallback) -> Run:
    """Run all parts, at once or some at a time, and merge them."""
    out = plan.output.absolute()
    with locked_folder(out):
        run_jobs(jobs, workers=plan.options.workers or len(jobs), progress=progress)
        return _merge_and_report(out, [job.folder for job in jobs if has_log(job.folder)])


# --- merging ---


def part_folders(out: Path) -> list[Path]:
    """Return the folders of an evaluation's parts that hold episodes."""
    return sorted(folder for folder in out.glob(Shard.FOLDERS) if folder.is_dir() and has_log(folder))


def merge_and_report(out: Path, folders: Sequence[Path]) -> Run:
    """Lock the folder ``out``, merge parts into it and report the whole; see `merge`."""
    with locked_folder(out):
        return _merge_and_report(out, folders)


def _merge_and_report(out: Path, folders: Sequence[Path]) -> Run:
    merge(out, folders)
    run = write_report(out)
    notes = [] if run.protocol[POLICY] else [f"{out} does not name the policy of its episodes: no part did"]
    return replace(run, notes=[*run.notes, *notes])


def merge(out: Path, folders: Sequence[Path]) -> None:
    """Merge the logs, cards and videos of evaluations of one protocol into the folder ``out``.

    Episodes of ``out`` are kept. Videos and memory reads are hard links where the disk allows it, else copies;
    LeRobot's own files are not merged. Before the first file is written, all differences between the parts are refused.
    """
    if not folders:
        raise MemobenchError(f"{out} holds no parts ({Shard.FOLDERS}); name the folders to merge")
    sources = list(dict.fromkeys([*([out] if has_log(out) else []), *folders]))
    lines = {source: read_lines(source) for source in sources}
    cards = {source: read_evaluation(source) for source in sources}
    card = _joined_card(cards)
    records = join({source: joined(source, cards[source], lines[source]) for source in sources})
    refuse_links(out / VIDEOS, out / MEMORY_READS)
    for source in folders:
        if source != out:
            _share(source / VIDEOS, out / VIDEOS, "*.mp4")
            _share(source / MEMORY_READS, out / MEMORY_READS, "*.json.gz")
    write_evaluation(out, card)  # first: a log without its card could not be merged again
    write_episodes(out, records)


def join(parts: Mapping[Path, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the episodes of all parts, sorted, each once; raise where two parts disagree about one.

    An episode that could not be run in one part, and was run in another, is the one that was run.
    """
    episodes: dict[Key, tuple[Path, Mapping[str, Any]]] = {}
    lines = [(folder, record) for folder, records in parts.items() for record in records]
    for folder, record in sorted(lines, key=lambda line: "not_run" in line[1]):
        known = episodes.setdefault(key_of(record), (folder, record))
        problem = disagreement(known[1], record, f"in {known[0]}", f"in {folder}")
        if problem is not None and "not_run" not in record:
            raise MemobenchError(f"{problem}; leave the wrong folder out")
    return [dict(episodes[key][1]) for key in sorted(episodes)]


def _joined_card(cards: Mapping[Path, dict[str, Any]]) -> dict[str, Any]:
    """Return one card for all folders; where LeRobot's own commands ran one of them, protocol and policy alone."""
    (first, card), *rest = cards.items()
    for folder, other in rest:
        if unlike := differences_of_parts(card, other):
            raise MemobenchError(
                f"{first} and {folder} were run under different protocols ({'; '.join(unlike)}); merge parts of one "
                "evaluation"
            )
        if bool(card[POLICY]) != bool(other[POLICY]):  # else all episodes would get its name
            raise MemobenchError(
                f"{folder if card[POLICY] else first} does not name the policy of its episodes, and another part does; "
                "evaluate the policy again there, or leave that folder out"
            )
    if not all("runs" in part_card for part_card in cards.values()):
        protocol = {name: value for name, value in card["protocol"].items() if name not in EXTENT}
        return {"format": card["format"], "protocol": protocol, POLICY: card[POLICY]}
    for folder, part_card in cards.items():
        require_whole(folder, part_card)
    for folder, other in rest:
        card = extended(card, other, folder, again=False)
    return card


def _share(source: Path, target: Path, pattern: str) -> None:
    """Link files of episodes into another folder, or copy them; existing ones are kept."""
    for file in sorted(source.glob(pattern)):
        destination = target / file.name
        if destination.exists():
            continue
        target.mkdir(parents=True, exist_ok=True)
        with draft_of(destination) as draft:
            try:
                os.link(file, draft)
            except OSError:  # another disk, or one without links
                shutil.copyfile(file, draft)
