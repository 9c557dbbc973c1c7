"""Files of what chunks have read: written and found again on the report's timeline; damaged ones are told of."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.evaluation.html.write import write_html
from lerobot_memobench.evaluation.memory_reads import EpisodeReads, find_reads, reads_file, write_reads
from tests.support.logs import record

CHUNKS: list[Any] = [
    {"step": 5, "entries": [-1, 0, 4], "weights": [0.25, 0.123456, 0.5]},
    {"step": 9, "entries": [0, 8], "weights": [0.0, 1.0]},
]
READS: EpisodeReads = {"seed": 7, "referent": "random", "chunks": CHUNKS}
ROLLOUT = record(referent="random", prompt_steps=3, steps=10, suite="published")


def found_of(folder: Path, protocol: dict[str, Any] | None = None, **changes: Any) -> tuple[Any, list[str]]:
    chunks, notes = find_reads(folder, [record(episode=1), ROLLOUT | changes], protocol or {})
    return chunks.get(1), notes


def test_what_was_read_is_found_on_the_timeline(tmp_path: Path) -> None:
    write_reads(reads_file(tmp_path, "a_task", 0), READS)
    found, notes = found_of(tmp_path)
    rounded = {"step": 5, "entries": [-1, 0, 4], "weights": [0.25, 0.1235, 0.5]}
    assert (found, notes) == ([rounded, CHUNKS[1]], [])
    # The policy began to count behind the prompt that it did not see; a strict task's clock counts it all the same.
    found, _ = found_of(tmp_path, {"prompt_in": "reset"})
    assert [chunk["step"] for chunk in found] == [8, 12]
    assert found[0]["entries"] == [-1, 3, 7]
    assert found_of(tmp_path, {"prompt_in": "reset"}, suite="strict")[0][0]["step"] == 5
    assert found_of(tmp_path, paused_steps=20) == (None, [])  # its timeline leaves the pauses out


def test_episodes_of_one_scene_have_files_of_their_own(tmp_path: Path) -> None:
    rollouts = [ROLLOUT | {"episode": k, "seed": 7 + k // 3, "variant": k % 3, "variants": 3} for k in range(6)]
    for k in range(6):
        reads: EpisodeReads = {"seed": 7 + k, "referent": "random", "chunks": CHUNKS[: k % 2 + 1]}
        write_reads(reads_file(tmp_path, "a_task", k), reads)
    found, notes = find_reads(tmp_path, rollouts, {})
    assert [len(found[k]) for k in range(6)] == [1, 2, 1, 2, 1, 2]
    assert notes == []
    another: EpisodeReads = {**READS, "seed": 8}
    write_reads(reads_file(tmp_path, "a_task", 4), another)  # the scene's, but of episode 1
    found, (note,) = find_reads(tmp_path, rollouts, {})
    assert 4 not in found
    assert "not of the rollout" in note


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seed": 8}, "not of the rollout"),
        ({"referent": "fixed"}, "not of the rollout"),
        ({"chunks": [{"step": 13, "entries": [0], "weights": [1.0]}]}, "not of the rollout"),
        ({"chunks": [{"step": 5, "entries": [6], "weights": [1.0]}]}, "not of the rollout"),
        ({"chunks": [{"step": 5, "entries": [0, 1], "weights": [1.0]}]}, "not of the rollout"),
        ({"chunks": [{"step": "5", "entries": [], "weights": []}]}, "expected an integer"),
    ],
)
def test_another_rollouts_file_is_left_out_and_told(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    write_reads(reads_file(tmp_path, "a_task", 0), READS | changes)
    found, (note,) = found_of(tmp_path)
    assert found is None
    assert note.startswith("1 file of memory_reads left out, the first because ")
    assert told in note


@pytest.mark.parametrize(
    "content",
    [b"", b"no gzip", gzip.compress(b"{}")[:-4], gzip.compress(b"[1]")],
    ids=["empty", "plain", "cut off", "a list"],
)
def test_a_damaged_file_is_left_out_and_told(tmp_path: Path, content: bytes) -> None:
    path = reads_file(tmp_path, "a_task", 0)
    path.parent.mkdir()
    path.write_bytes(content)
    write_episodes(tmp_path, [ROLLOUT])
    written = write_html([tmp_path], tmp_path / "html")
    assert len(written.notes) == 1
    assert str(path) in written.notes[0]


def test_a_long_episode_takes_a_few_kilobytes(tmp_path: Path) -> None:
    chunks: list[Any] = [
        {"step": 6 * k, "entries": [8 * n for n in range(32)], "weights": [((7 * k + n) % 32) / 496 for n in range(32)]}
        for k in range(45, 200)
    ]
    write_reads(path := reads_file(tmp_path, "a_task", 0), {"seed": 7, "referent": "fixed", "chunks": chunks})
    assert path.stat().st_size < 8_000
