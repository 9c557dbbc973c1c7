"""Make one evaluation of the parts that several runs or machines have written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.engine.card import disagreement, extended, key_of, remove_card, with_episodes, write_card
from lerobot_memobench.envs.episode_log import has_log, read_episodes, write_episodes
from lerobot_memobench.envs.protocol import EXTENT, read_protocol_file, write_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import (
    CARD_FILE,
    POLICY,
    differences,
    read_card,
    read_protocol,
)

SHARDS = "shard-*-of-*"
"""Folders of the parts of an evaluation, in its own."""

VIDEOS = "videos"


def merge(out: Path, folders: Sequence[Path]) -> list[tuple[str, int]]:
    """Join the logs, cards and films of evaluations of one protocol into the folder ``out``.

    What ``out`` holds already is joined as well. Films are hard links where the disk allows it, else copies; LeRobot's
    own files stay where they are. Every check comes before anything is written.

    Returns:
        (task, episode) of those that were asked for, as far as the cards tell, and are in none of the parts.

    Raises:
        MemobenchError: nothing to merge, protocols or policies that differ, or an episode that ended differently in two
            parts.
    """
    sources = list(dict.fromkeys([*([out] if has_log(out) else []), *folders]))
    if not folders:
        raise MemobenchError(f"{out} holds no parts ({SHARDS}); name the folders to merge")
    records = {source: read_episodes(source) for source in sources}
    protocols = {source: read_protocol(source) for source in sources}
    _check_protocols(protocols)
    joined = join(records)
    card = _joined_card(sources)
    protocol: dict[str, Any] = {}
    for found in protocols.values():
        protocol = {**found, **protocol}
    asked = card["protocol"] if card is not None else {}
    first = (card["policy"].get("seed") or 0) - asked["seed_base"] if card is not None and card["policy"] else 0
    episodes = range(first, first + asked.get("episodes", 0))
    wanted = [(task, episode) for task in asked.get("tasks", []) for episode in episodes]
    present = {(record["task"], record["episode"]) for record in joined}

    out.mkdir(parents=True, exist_ok=True)
    settings = {key: protocol[key] for key in protocol if key not in (*EXTENT, POLICY)}
    if all(read_protocol_file(source) for source in sources):
        write_protocol(out, settings)
    for source in folders:
        if source != out:
            _share_films(source / VIDEOS, out / VIDEOS)
    write_episodes(out, joined)
    if card is not None:
        write_card(out, with_episodes(card, joined))
    else:
        remove_card(out)
    return [cell for cell in wanted if cell not in present]


def _check_protocols(protocols: Mapping[Path, Mapping[str, Any]]) -> None:
    """Raise with what differs between the first folder and another."""
    (first, reference), *others = protocols.items()
    for folder, protocol in others:
        found = differences(reference, protocol, policy=True)
        if found:
            raise MemobenchError(
                f"{first} and {folder} were run under other protocols ({'; '.join(found)}); they are not one evaluation"
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
    card: dict[str, Any] | None = None
    for folder in folders:
        if not (folder / CARD_FILE).is_file():
            return None
        mine = read_card(folder / CARD_FILE)
        card = mine if card is None else extended(card, mine, again=False)
    if card is not None:
        for folder in folders:
            _check_task_files(card, folder)
    return card


def _check_task_files(card: Mapping[str, Any], folder: Path) -> None:
    for name, value in read_card(folder / CARD_FILE)["task_files"].items():
        if card["task_files"][name] != value:
            raise MemobenchError(f"the episodes of {name} in {folder} were run with other task files than the others")


def _share_films(source: Path, target: Path) -> None:
    """Give films of episodes a second name, or copy them; ones that are there stay."""
    for film in sorted(source.glob("*.mp4")):
        place = target / film.name
        if place.exists():
            continue
        target.mkdir(parents=True, exist_ok=True)
        draft = target / f".{film.name}.part"
        draft.unlink(missing_ok=True)
        try:
            os.link(film, draft)
        except OSError:  # another disk, or one without links
            shutil.copyfile(film, draft)
        os.replace(draft, place)


def part_folders(out: Path) -> list[Path]:
    """Return the folders of an evaluation's parts in its own, those that hold episodes."""
    return sorted(folder for folder in out.glob(SHARDS) if folder.is_dir() and has_log(folder))
