"""Memory reads: which policies give them, files as episodes end, parts, the report's timeline, damaged files."""

from __future__ import annotations

import gzip
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.settings import OBJECTS, RESET
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html import page_data, write_html
from lerobot_memobench.evaluation.records import read_runs
from lerobot_memobench.policies.memory_reads import (
    Chunk,
    EpisodeReads,
    find_reads,
    noting_reads,
    reads_file,
    write_reads,
)
from lerobot_memobench.rollouts.plan import plan_line
from lerobot_memobench.rollouts.shards import merge
from tests.support.logs import record, write_log

TASK = "turn_on_the_stove_and_turn_it_off"
MILK = "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"


class Policy:
    """A policy with given memory reads."""

    def __init__(self, *rows: list[Chunk]) -> None:
        self.rows, self.watched = [*rows], False

    def watch_memory(self, watched: bool = True) -> None:
        self.watched = watched

    def memory_reads(self) -> list[list[Chunk]]:
        assert self.watched
        return self.rows


@pytest.mark.usefixtures("short_holds")
def test_reads_of_evidence_belong_to_their_episode(tmp_path: Path) -> None:
    """Four episodes of two scenes, in two parts; the second part is resumed after its first episode."""
    for part, number in (("a", 0), ("a", 1), ("b", 2), ("b", 3)):
        env = gym.vector.SyncVectorEnv([partial(evidence, tmp_path / part)])
        policy: Any = Policy([{"step": 0, "entries": [0], "weights": [number / 10]}])
        settings = env.envs[0].settings
        with noting_reads(tmp_path / part, settings, MILK, policy, [20_000 + number]) as ended:
            env.reset(seed=[20_000 + number])
            truncated = np.zeros(1, np.bool_)
            while not truncated.any():  # the execution begins with a hold
                truncated = env.step(np.zeros((1, 7), np.float32))[3]
            ended(truncated)
        env.close()
    merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"])
    (run,) = read_runs([tmp_path / "all"])
    found, notes = find_reads(run.folder, run.records, run.protocol)
    assert notes == []
    episodes = page_data([run], [{}], {}, [found])["runs"][0]["episodes"]
    assert [(each["episode"], each["seed"], each["variant"]) for each in episodes] == [
        (0, 20_000, 0),
        (1, 20_000, 1),
        (2, 20_001, 0),
        (3, 20_001, 1),
    ]
    assert [each["reads"][0][2] for each in episodes] == [[0.0], [0.1], [0.2], [0.3]]


def evidence(folder: Path) -> MemobenchEnv:
    return MemobenchEnv(
        MILK,
        obs_type=OBJECTS,
        prompt_in=RESET,
        horizon=1,
        demonstration_prompt=False,
        evidence=True,
        seed_base=20_000,
        log_dir=str(folder),
    )


def test_memory_reads_need_a_policy_with_a_memory() -> None:
    line = ["env=memobench", f"tasks={TASK}", "episodes=2", "batch_size=1", "memory_reads=true"]
    assert plan_line([*line, "policy=memobench_strict"]).options.memory_reads
    with pytest.raises(MemobenchError, match="memory=none"):
        plan_line([*line, "policy=memobench_strict_memoryless"])


# --- files on the report's timeline ---

CHUNKS: list[Any] = [
    {"step": 5, "entries": [-1, 0, 4], "weights": [0.25, 0.123456, 0.5]},
    {"step": 9, "entries": [0, 8], "weights": [0.0, 1.0]},
]
READS: EpisodeReads = {"seed": 7, "referent": "random", "chunks": CHUNKS}
ROLLOUT = record(referent="random", prompt_steps=3, steps=10, suite="published")


def found_of(folder: Path, protocol: dict[str, Any] | None = None, **changes: Any) -> tuple[Any, list[str]]:
    chunks, notes = find_reads(folder, [record(episode=1), ROLLOUT | changes], protocol or {})
    return chunks.get(1), notes


def test_reads_are_placed_on_the_timeline(tmp_path: Path) -> None:
    write_reads(reads_file(tmp_path, "a_task", 0), READS)
    found, notes = found_of(tmp_path)
    rounded = {"step": 5, "entries": [-1, 0, 4], "weights": [0.25, 0.1235, 0.5]}
    assert (found, notes) == ([rounded, CHUNKS[1]], [])
    # The policy began to count after the prompt; the clock of a strict task counts the prompt.
    found, _ = found_of(tmp_path, {"prompt_in": "reset"})
    assert [chunk["step"] for chunk in found] == [8, 12]
    assert found[0]["entries"] == [-1, 3, 7]
    assert found_of(tmp_path, {"prompt_in": "reset"}, suite="strict")[0][0]["step"] == 5
    assert found_of(tmp_path, paused_steps=20) == (None, [])  # its timeline leaves the pauses out


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seed": 8}, "not of the rollout"),
        ({"chunks": [{"step": 13, "entries": [0], "weights": [1.0]}]}, "not of the rollout"),
        ({"chunks": [{"step": 5, "entries": [0, 1], "weights": [1.0]}]}, "not of the rollout"),
        ({"chunks": [{"step": "5", "entries": [], "weights": []}]}, "expected an integer"),
    ],
)
def test_the_file_of_another_rollout_is_left_out(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    write_reads(reads_file(tmp_path, "a_task", 0), READS | changes)
    found, (note,) = found_of(tmp_path)
    assert found is None
    assert named in note


@pytest.mark.parametrize("content", [b"", gzip.compress(b"{}")[:-4]], ids=["empty", "cut off"])
def test_a_damaged_file_is_left_out_with_a_note(tmp_path: Path, content: bytes) -> None:
    path = reads_file(tmp_path, "a_task", 0)
    path.parent.mkdir()
    path.write_bytes(content)
    write_log(tmp_path, [ROLLOUT])
    written = write_html([tmp_path], tmp_path / "html")
    assert len(written.notes) == 1
    assert str(path) in written.notes[0]
