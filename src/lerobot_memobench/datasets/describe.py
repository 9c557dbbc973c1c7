"""Summarise a dataset: the card's tables and the hash of every episode, small enough to commit."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.lerobot_format.card import CARD_FILE, EDITED, MADE_BY, card_from_frames, own_card
from lerobot_memobench.datasets.lerobot_format.layout import (
    MANIFEST_FILE,
    check_whole,
    naming_damage,
    read_info,
    read_manifest,
    undamaged,
)
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import telling_of_the_disk, write_file

TABLES_FILE = "tables.md"

UNCHECKED = (
    "not checked: values of tables, pictures of videos, statistics, states, hashes, HDF5 files and feature caches; "
    "`memobench validate {folder}` checks them"
)
Say = Callable[[str], None]


def describe(folder: Path, out: Path, say: Say = lambda _: None) -> list[Path]:
    """Write tables and hashes of the dataset in ``folder`` to ``out``; return the files.

    Episodes that another program made are left out. ``say`` gets a sentence about them, and about the parts that other
    tools have taken from the dataset.

    Raises:
        MemobenchError: the folder is no dataset, one of its files is cut off (see `check_whole`), or none of its
            episodes is one of this benchmark.
    """
    rows, hashes = _known(folder, say), folder / MANIFEST_FILE
    check_whole(folder)
    with undamaged(folder), naming_damage(folder):
        card = own_card(folder, read_info(folder)["total_episodes"])
        tables = card_tables(card or card_from_frames(folder, rows))
        manifest = read_manifest(folder) if hashes.is_file() else _manifest_of(rows)
    say(UNCHECKED.format(folder=folder))
    if card is None:
        say(EDITED)
        _put_card(folder, rows, say)
    with telling_of_the_disk(out):
        out.mkdir(parents=True, exist_ok=True)
        return [
            write_file(out / TABLES_FILE, tables),
            write_file(out / MANIFEST_FILE, short_manifest(manifest)),
        ]


def _known(folder: Path, say: Say) -> list[dict[str, Any]]:
    """Return the records of the dataset's episodes, without those that another program made."""
    with undamaged(folder):
        places = list_episodes(folder)
    rows = [
        place.record.model_dump() | {"episode_index": place.index, "length": place.length, "start": place.start}
        for place in places
        if place.record is not None
    ]
    strangers = [str(place.index) for place in places if place.record is None]
    if not rows:
        raise MemobenchError(f"{folder} has no episode of this benchmark: of each, {STRANGER}")
    if strangers:
        listed = ", ".join(strangers[:5]) + (", …" if len(strangers) > 5 else "")
        say(f"{len(strangers)} of {len(places)} episodes ({listed}) are left out: of each, {STRANGER}")
    return rows


def _put_card(folder: Path, rows: Sequence[Mapping[str, Any]], say: Say) -> None:
    """Give a dataset without a card one, where there may be written."""
    if (folder / CARD_FILE).exists():
        return
    try:
        write_file(folder / CARD_FILE, card_from_frames(folder, rows))
    except OSError as error:
        say(f"its card could not be written to {folder} ({error.strerror})")


def _manifest_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a manifest of the episodes that are there."""
    versions = sorted({json.dumps(row["versions"], sort_keys=True) for row in rows if row["versions"]})
    return {
        "versions": [json.loads(each) for each in versions],
        "episodes": [{**row, "failure": None} for row in rows],
    }


def card_tables(card: str) -> str:
    """Return the part of a dataset card that says how it was made, what failed, and its statistics."""
    begin, end = card.find(MADE_BY), card.find("## Columns")
    if begin < 0:
        raise MemobenchError("the dataset's README.md has no section 'How it was made': this package did not write it")
    return card[begin : end if end > begin else None].rstrip() + "\n"


def short_manifest(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as JSON of one line per task: seed to the hash of its episode, or to why there is none."""
    tasks: dict[str, dict[str, str]] = {}
    for row in manifest["episodes"]:
        tasks.setdefault(row["task_name"], {})[str(row["seed"])] = (
            row["failure"] or row.get("digest") or "no hash was kept"
        )
    head = {key: value for key, value in manifest.items() if key != "episodes"}
    lines = [f"{json.dumps(name)}: {json.dumps(seeds)}" for name, seeds in sorted(tasks.items())]
    return json.dumps(head | {"tasks": None})[: -len("null}")] + "{\n" + ",\n".join(lines) + "\n}}\n"
