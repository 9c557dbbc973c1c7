"""Make one evaluation of the parts that several runs or machines have written."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import (
    EXTENT,
    POLICY,
    differences,
    has_log,
    key_of,
    read_log,
    write_episodes,
)
from lerobot_memobench.envs.evaluation_file import protocol_of, read_evaluation, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import disagreement
from lerobot_memobench.evaluation.records import read_protocol
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.io import draft_of
from lerobot_memobench.policies.memory_reads import MEMORY_READS
from lerobot_memobench.run.card import (
    extended,
    first_variant_mismatch,
    remove_card,
    with_episodes,
    write_card,
)
from lerobot_memobench.run.run import VIDEOS, EvaluationReport, made

SHARDS = "shard-*-of-*"
"""Folders of the parts of an evaluation, in its own."""


def merge_and_report(out: Path, folders: Sequence[Path]) -> EvaluationReport:
    """Merge parts into the folder ``out`` and report the whole; see `merge`.

    Raises:
        MemobenchError: see `merge`; or another run is writing to ``out``.
    """
    with made(out):
        return merge_held(out, folders)


def merge_held(out: Path, folders: Sequence[Path]) -> EvaluationReport:
    """Do as `merge_and_report` where the caller holds ``out``."""
    absent = merge(out, folders)
    report = EvaluationReport(write_report(out), absent)
    if _tells_whose(read_protocol(out), read_log(out)):
        return report
    note = f"{out} does not say whose episodes it holds: no part of it did"
    return replace(report, run=replace(report.run, notes=[*report.run.notes, note]))


def merge(out: Path, folders: Sequence[Path]) -> list[tuple[str, int]]:
    """Join the logs, cards and videos of evaluations of one protocol into the folder ``out``.

    What ``out`` holds already is joined as well. Videos and memory reads are hard links where the disk allows it, else
    copies; LeRobot's own files stay where they are. Every check comes before anything is written.

    Returns:
        (task, episode) of those that were asked for, as far as the cards tell, and are in none of the parts.

    Raises:
        MemobenchError: nothing to merge, protocols or policies that differ, a part that does not say whose episodes it
            holds where another does, variants drawn by two rules, or an episode that ended differently in two parts.
    """
    sources = list(dict.fromkeys([*([out] if has_log(out) else []), *folders]))
    if not folders:
        raise MemobenchError(f"{out} holds no parts ({SHARDS}); name the folders to merge")
    records = {source: read_log(source) for source in sources}
    protocols = {source: read_protocol(source) for source in sources}
    _check_protocols(protocols)
    _check_owners(protocols, records)
    _check_draws(records)
    joined = join(records)
    card = _joined_card(sources)
    wanted = [] if card is None else _wanted(card)
    told = [*map(protocol_of, sources)]

    out.mkdir(parents=True, exist_ok=True)
    for source in folders:
        if source != out:
            _share(source / VIDEOS, out / VIDEOS, "*.mp4")
            _share(source / MEMORY_READS, out / MEMORY_READS, "*.json.gz")
    write_episodes(out, joined)
    remove_card(out)
    if card is not None:
        asked = set(wanted)
        write_card(out, with_episodes(card, [each for each in joined if (each["task"], each["episode"]) in asked]))
    elif all(told):
        write_protocol(out, _joined_settings([*told, *protocols.values()]))
    present = {(record["task"], record["episode"]) for record in joined}
    return [cell for cell in wanted if cell not in present]


def _joined_settings(protocols: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the settings of all protocols; the first one that names a setting counts."""
    joined: dict[str, Any] = {}
    for protocol in protocols:
        joined = {**protocol, **joined}
    return {key: value for key, value in joined.items() if key not in EXTENT}


def _wanted(card: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Return (task, episode) of all that a card's evaluation was asked for."""
    asked, policy = card["protocol"], card["policy"]
    base = asked.get("seed_base")
    first = (policy.get("seed") or 0) - base if policy and isinstance(base, int) else 0
    episodes = range(first, first + asked["episodes"])
    return [(task, episode) for task in asked["tasks"] for episode in episodes]


def _check_protocols(protocols: Mapping[Path, Mapping[str, Any]]) -> None:
    """Raise with what differs between the first folder and another."""
    (first, reference), *others = protocols.items()
    for folder, protocol in others:
        found = differences(reference, protocol, policy=True)
        if found:
            raise MemobenchError(
                f"{first} and {folder} were run under other protocols ({'; '.join(found)}); they are not one evaluation"
            )


def _tells_whose(protocol: Mapping[str, Any], records: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a folder says whose episodes it holds: its protocol or card does, or every line."""
    return bool(protocol[POLICY]) or all(record.get(POLICY) for record in records)


def _check_owners(
    protocols: Mapping[Path, Mapping[str, Any]], records: Mapping[Path, Sequence[Mapping[str, Any]]]
) -> None:
    """Raise where only some parts say whose they are: the result would call all of it the policy of these."""
    named = {record[POLICY]: folder for folder, lines in records.items() for record in lines if record.get(POLICY)}
    if len(named) > 1:
        (a, mine), (b, other), *_ = named.items()
        raise MemobenchError(f"{mine} holds episodes of {a} and {other} ones of {b}; they are not one evaluation")
    nobodys = [folder for folder in protocols if not _tells_whose(protocols[folder], records[folder])]
    known = [folder for folder in protocols if folder not in nobodys]
    if nobodys and (known or named):
        does = f"{known[0]} does" if known else "some of its lines do"
        raise MemobenchError(
            f"{nobodys[0]} does not say whose episodes it holds, and {does}; they may be of two policies, so evaluate "
            "the policy again there, or leave that folder out"
        )


def _check_draws(records: Mapping[Path, Sequence[Mapping[str, Any]]]) -> None:
    """Raise where some parts drew their variants as it is done here, and others by an earlier version's rule."""
    otherwise = {folder: first_variant_mismatch(lines) for folder, lines in records.items()}
    strange = {folder: problem for folder, problem in otherwise.items() if problem is not None}
    if 0 < len(strange) < len(records):
        folder, problem = next(iter(strange.items()))
        raise MemobenchError(
            f"the episodes in {folder} drew their variants otherwise than the other parts' ({problem}): another "
            "version ran them, so leave that folder out"
        )


def join(parts: Mapping[Path, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the episodes of all parts, sorted, each once.

    Raises:
        MemobenchError: two parts disagree about an episode.
    """
    found: dict[tuple[str, int, str], tuple[Path, Mapping[str, Any]]] = {}
    for folder, records in parts.items():
        for record in records:
            known = found.setdefault(key_of(record), (folder, record))
            problem = disagreement(known[1], record, f"in {known[0]}", f"in {folder}")
            if problem is not None:
                raise MemobenchError(f"{problem}; remove the folder that is not meant")
    return [dict(found[key][1]) for key in sorted(found)]


def _joined_card(folders: Sequence[Path]) -> dict[str, Any] | None:
    """Return one card for all, None where one of them has none: it would say more than is known."""
    if not all(POLICY in read_evaluation(folder) for folder in folders):
        return None
    cards = {folder: read_evaluation(folder, whole=True) for folder in folders}
    joined = functools.reduce(lambda card, mine: extended(card, mine, again=False), cards.values())
    for folder, card in cards.items():
        for name, value in card["task_files"].items():
            if joined["task_files"][name] != value:
                raise MemobenchError(
                    f"the episodes of {name} in {folder} were run with other task files than the others"
                )
    return joined


def _share(source: Path, target: Path, pattern: str) -> None:
    """Give files of episodes a second name, or copy them; ones that are there stay."""
    for mine in sorted(source.glob(pattern)):
        place = target / mine.name
        if place.exists():
            continue
        target.mkdir(parents=True, exist_ok=True)
        with draft_of(place) as draft:
            try:
                os.link(mine, draft)
            except OSError:  # another disk, or one without links
                shutil.copyfile(mine, draft)


def part_folders(out: Path) -> list[Path]:
    """Return the folders of an evaluation's parts in its own, those that hold episodes."""
    return sorted(folder for folder in out.glob(SHARDS) if folder.is_dir() and has_log(folder))
