"""A dataset after LeRobot's dataset tools: it is described, validated and filtered, and lost parts are reported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_edit_dataset as tool

from lerobot_memobench.datasets.card import describe
from lerobot_memobench.datasets.demonstration import Demonstration, digest
from lerobot_memobench.datasets.episodes import STRANGER, episodes_where, list_episodes, read_episode
from lerobot_memobench.datasets.layout import EPISODE_INFO, MANIFEST_FILE
from lerobot_memobench.datasets.validate import CheckResult
from lerobot_memobench.datasets.validate import validate as validation
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.errors import MemobenchError
from tests.datasets.conftest import BUTTER, STOVE
from tests.support.short_demonstrations import drawn_steps

REPO = "local/ours"


@pytest.fixture(scope="module")
def demos() -> list[Demonstration]:
    """Stove, butter (with a demonstration prompt), stove; a few steps of each, without images."""
    kinds = [(STOVE, 10_000, 12, 0), (BUTTER, 10_000, 16, 6), (STOVE, 10_001, 10, 0)]
    return [drawn_steps(*kind) for kind in kinds]


@pytest.fixture(scope="module")
def ours(demos, tmp_path_factory) -> Path:
    return write_dataset(demos, tmp_path_factory.mktemp("ours") / "ds", repo_id=REPO)


def validate(folder: Path) -> list[CheckResult]:
    """Return the verdicts on episodes; all files agree, and a note lists omitted checks."""
    found = validation(folder)
    assert [verdict for verdict in found if verdict.of_file and verdict.disagreement] == []
    assert [verdict for verdict in found if verdict.note]
    return [verdict for verdict in found if not verdict.of_file]


def edit(root: Path | None, out: Path, operation: Any) -> Path:
    where = {"new_root": str(out), "new_repo_id": "local/edited"}
    source = {} if root is None else {"repo_id": REPO, "root": str(root)}
    tool.edit_dataset(tool.EditDatasetConfig(operation=operation, **source, **where))
    return out


def delete(root: Path, out: Path, *episodes: int) -> Path:
    return edit(root, out, tool.DeleteEpisodesConfig(episode_indices=list(episodes)))


def merge(out: Path, *roots: Path) -> Path:
    return edit(None, out, tool.MergeConfig(repo_ids=[REPO] * len(roots), roots=[str(root) for root in roots]))


def check(folder: Path, kept: list[Demonstration], out: Path) -> list[str]:
    """Describe, validate and filter a dataset; return the messages of the description."""
    news: list[str] = []
    names = {file.name for file in describe(folder, out, news.append)}
    assert news.pop(0).startswith("not checked: ")
    assert {"tables.md", MANIFEST_FILE} == names
    hashes: dict[str, dict[str, str]] = {}
    for demo in kept:
        hashes.setdefault(demo.task.name, {})[str(demo.seed)] = digest(demo)
    assert json.loads((out / MANIFEST_FILE).read_text())["tasks"] == hashes
    assert f"| {kept[0].task.name} | {kept[0].task.operations} |" in (out / "tables.md").read_text()
    assert [verdict.disagreement for verdict in validate(folder)] == [None] * len(kept)
    for kind in {demo.task.memory_type for demo in kept}:
        chosen = episodes_where(folder, memory_type=kind)
        assert chosen == [n for n, demo in enumerate(kept) if demo.task.memory_type == kind]
        frames = LeRobotDataset(REPO, root=folder, episodes=chosen)
        assert len(frames) == sum(len(kept[n]) for n in chosen)
    return news


def test_deleted_episodes(ours, demos, tmp_path):
    edited = delete(ours, tmp_path / "edited", 0)
    (news,) = check(edited, demos[1:], tmp_path / "out")
    assert "failed seeds and the simulator's states were lost" in news
    card = (edited / "README.md").read_text()
    assert "2 demonstrations of 2 robot manipulation tasks" in card
    assert card.count(news) == 1
    assert episodes_where(delete(edited, tmp_path / "again", 0), seed=10_001) == [0]


@pytest.mark.slow
def test_merged(ours, demos, tmp_path):
    """Of an edited dataset and a whole one: meta/episodes then has records of some episodes only."""
    edited = delete(ours, tmp_path / "edited", 0, 1)
    merged = merge(tmp_path / "merged", edited, ours)
    assert {None} < {row["seed"] for row in pq.read_table(merged / "meta" / "episodes").to_pylist()}
    check(merged, [demos[2], *demos], tmp_path / "out")


@pytest.mark.slow
def test_removed_columns(ours, demos, tmp_path):
    operation = tool.RemoveFeatureConfig(feature_names=["subgoal.coarse", "observation.state"])
    check(edit(ours, tmp_path / "edited", operation), demos, tmp_path / "out")


def test_removed_states_are_compared_by_hash(ours, demos, tmp_path):
    edited = delete(ours, tmp_path / "edited", 1, 2)
    assert "states" not in read_episode(edited, 0).columns
    _rewrite(edited, digest(demos[0]), "0" * 64)
    (verdict,) = validate(edited)
    assert str(verdict.disagreement).startswith("digest: recorded '000000")
    _rewrite(edited, '"world":"libero"', '"world":"another"')
    with pytest.raises(MemobenchError, match=r"episode 0: .*episode_info .*world"):
        list_episodes(edited)


def test_episodes_of_other_programs(ours, make_demo, tmp_path):
    stranger = write_dataset([make_demo(["0011"])], tmp_path / "stranger", repo_id=REPO)
    for path in [*(stranger / "meta" / "episodes").rglob("*.parquet"), *(stranger / "data").rglob("*.parquet")]:
        table = pq.read_table(path)
        table = table.drop_columns([name for name in ("seed", "task_name", "digest") if name in table.column_names])
        if EPISODE_INFO in table.column_names:
            place = table.column_names.index(EPISODE_INFO)
            table = table.set_column(place, table.schema.field(EPISODE_INFO), [[""] * len(table)])
        pq.write_table(table, path)
    with pytest.raises(MemobenchError, match="no episode of this benchmark"):
        describe(stranger, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    merged = merge(tmp_path / "merged", stranger, delete(ours, tmp_path / "edited", 1, 2))
    news: list[str] = []
    describe(merged, tmp_path / "out", news.append)
    assert news[0].startswith("1 of 2 episodes (0) are left out: it has neither task nor seed")
    assert [verdict.disagreement for verdict in validate(merged)] == [STRANGER, None]
    assert episodes_where(merged, task_name=STOVE) == [1]
    with pytest.raises(MemobenchError, match="'colour'"):
        episodes_where(ours, colour="red")


def _rewrite(folder: Path, old: str, new: str) -> None:
    for path in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(path)
        texts = [text.replace(old, new) for text in table.column(EPISODE_INFO).to_pylist()]
        assert texts != table.column(EPISODE_INFO).to_pylist()
        place = table.column_names.index(EPISODE_INFO)
        pq.write_table(table.set_column(place, table.schema.field(EPISODE_INFO), [texts]), path)
