"""Evaluations kept in the repository, many in two Parquet tables: their rollouts, and the facts of each.

``rollouts.parquet`` has a row per rollout: the evaluation's name, and the fields of its line in the log.
``evaluations.parquet`` has a row per evaluation, or training: its name, its ``evaluation.json``, the command and its
cost. A name is the path of its folder below the folder that it was kept from.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_memobench.envs.episode_log import MERGED_FILE, log_text, read_lines
from lerobot_memobench.envs.evaluation_file import read_evaluation, write_evaluation
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import draft_of, write_file

ROLLOUTS, EVALUATIONS = "rollouts.parquet", "evaluations.parquet"
NAME, FIELDS, CARD, COMMAND = "evaluation", "fields", "card", "command"
SOMETIMES = ("fault", "not_run", "settled")
"""Fields that only some lines of a log have."""

Rows = list[dict[str, Any]]


def keep(root: Path, names: Iterable[str], kept: Path) -> None:
    """Add evaluations and commands to the tables in ``kept``; earlier ones of the same names are replaced.

    ``root/name`` is an evaluation's folder, ``root/name.json`` describes its command; one of them may be missing. A
    dataset's folder is not kept.
    """
    rollouts: Rows = []
    evaluations: Rows = []
    for name in names:
        folder, command = root / name, root / f"{name}.json"
        row = dict.fromkeys((FIELDS, CARD, COMMAND)) | {NAME: name}
        if command.exists():
            row[COMMAND] = json.dumps(json.loads(command.read_text()))
        if folder.is_dir() and not (folder / "meta").is_dir():  # a dataset is kept as its command
            lines = read_lines(folder)
            row[FIELDS] = list(dict.fromkeys(key for line in lines for key in line))
            row[CARD] = json.dumps(read_evaluation(folder))
            rollouts += [{NAME: name, **line} for line in lines]
        evaluations.append(row)
    new = {row[NAME] for row in evaluations}
    kept.mkdir(parents=True, exist_ok=True)
    for file, rows in ((kept / ROLLOUTS, rollouts), (kept / EVALUATIONS, evaluations)):
        rows += [row for row in _read(file) if row[NAME] not in new] if file.exists() else []
        rows.sort(key=lambda row: str(row[NAME]))
        columns = dict.fromkeys([NAME, *(key for row in rows for key in row)])
        table = pa.table({key: [row.get(key) for row in rows] for key in columns})
        with draft_of(file) as draft:
            pq.write_table(table, draft, compression="zstd", compression_level=19)


def restore(kept: Path, root: Path, names: Sequence[str] | None = None) -> list[str]:
    """Write kept evaluations of these names, or all, as folders below ``root``; return their names."""
    if not (kept / EVALUATIONS).exists():
        raise MemobenchError(f"{kept} holds no {EVALUATIONS}; give a folder that --keep has written")
    evaluations = {row[NAME]: row for row in _read(kept / EVALUATIONS)}
    wanted = list(evaluations) if names is None else list(names)
    for name in wanted:
        if name not in evaluations:
            raise MemobenchError(f"{kept} holds no evaluation {name!r}; {nearest(name, evaluations)}")
    lines: dict[str, Rows] = {}
    for row in _read(kept / ROLLOUTS, wanted):
        lines.setdefault(row[NAME], []).append(_line(row, evaluations[row[NAME]][FIELDS]))
    for name in wanted:
        row, folder = evaluations[name], root / name
        folder.parent.mkdir(parents=True, exist_ok=True)
        if row[COMMAND] is not None:
            write_file(root / f"{name}.json", row[COMMAND])
        if name in lines:
            write_evaluation(folder, json.loads(row[CARD]))
            write_file(folder / MERGED_FILE, log_text(lines[name]))
    return wanted


def _read(file: Path, names: Sequence[str] | None = None) -> Rows:
    chosen = None if names is None else [(NAME, "in", list(names))]
    rows: Rows = pq.read_table(file, filters=chosen).to_pylist()
    return rows


def _line(row: dict[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """Return the line of the log that a row was: a table has all columns in all rows."""
    absent = fields if row.get("not_run") is not None else SOMETIMES
    return {key: row[key] for key in fields if row[key] is not None or key not in absent}
