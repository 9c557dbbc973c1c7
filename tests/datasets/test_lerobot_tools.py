"""What LeRobot's own dataset tools leave of a dataset: it describes, validates, caches, filters and trains, or says in
one sentence what is lost.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_edit_dataset as tool
from safetensors.torch import load_file

from lerobot_memobench.datasets.demonstration import Demonstration, digest
from lerobot_memobench.datasets.describe import describe
from lerobot_memobench.datasets.lerobot_format.assembling import assemble, write_dataset
from lerobot_memobench.datasets.lerobot_format.layout import EPISODE_INFO, MANIFEST_FILE
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, episodes_where, list_episodes, read_episode
from lerobot_memobench.datasets.staging import stage_demonstration
from lerobot_memobench.datasets.validate import Verdict
from lerobot_memobench.datasets.validate import validate as validation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from tests.support.short_demonstrations import drawn_steps, with_pictures
from tests.support.small_policy import train_with

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
SIZE = 48
REPO = "local/ours"


@pytest.fixture(scope="module")
def demos() -> list[Demonstration]:
    """Stove, butter (with a demonstration prompt), stove; a few steps of each, without images."""
    kinds = [(STOVE, 10_000, 12, 0), (BUTTER, 10_000, 16, 6), (STOVE, 10_001, 10, 0)]
    return [drawn_steps(*kind) for kind in kinds]


@pytest.fixture(scope="module")
def ours(demos, tmp_path_factory) -> Path:
    return write_dataset(demos, tmp_path_factory.mktemp("ours") / "ds", repo_id=REPO)


@pytest.fixture(scope="module")
def filmed(demos, tmp_path_factory) -> Path:
    """The first two, with small pictures."""
    shown = [with_pictures(demo, SIZE) for demo in demos[:2]]
    return write_dataset(shown, tmp_path_factory.mktemp("filmed") / "ds", repo_id=REPO)


def validate(folder: Path) -> list[Verdict]:
    """Return the verdicts on episodes; of the files none disagrees, and a note says what was not checked."""
    found = validation(folder)
    assert [verdict for verdict in found if verdict.of_file and verdict.disagreement] == []
    assert [verdict for verdict in found if verdict.note]
    return [verdict for verdict in found if not verdict.of_file]


def edit(root: Path | None, out: Path, operation: Any) -> Path:
    """Run ``lerobot-edit-dataset``; those operations that work in place get a copy at ``out``."""
    where: dict[str, Any] = {"new_root": str(out), "new_repo_id": "local/edited"}
    if isinstance(operation, tool.ModifyTasksConfig):
        root, where = shutil.copytree(root, out), {}
    source = {} if root is None else {"repo_id": REPO, "root": str(root)}
    tool.edit_dataset(tool.EditDatasetConfig(operation=operation, **source, **where))
    return out


def delete(root: Path, out: Path, *episodes: int) -> Path:
    return edit(root, out, tool.DeleteEpisodesConfig(episode_indices=list(episodes)))


def merge(out: Path, *roots: Path) -> Path:
    return edit(None, out, tool.MergeConfig(repo_ids=[REPO] * len(roots), roots=[str(root) for root in roots]))


def check(folder: Path, kept: list[Demonstration], out: Path) -> list[str]:
    """The dataset describes, validates and filters; return what describing said."""
    said: list[str] = []
    names = {file.name for file in describe(folder, out, said.append)}
    assert said.pop(0).startswith("not checked: ")
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
    return said


def test_deleted_episodes(ours, demos, tmp_path):
    edited = delete(ours, tmp_path / "edited", 0)
    said = check(edited, demos[1:], tmp_path / "out")
    assert len(said) == 1
    assert "Lost are the failed seeds, and the simulator's states" in said[0]
    card = (edited / "README.md").read_text()
    assert "2 demonstrations of 2 robot manipulation tasks" in card
    assert card.count(said[0]) == 1
    assert describe(edited, tmp_path / "again_out", said.append)
    assert len(said) == 2, "it has its card now, and is not checked now either"
    assert episodes_where(delete(edited, tmp_path / "again", 0), seed=10_001) == [0]


def test_split(ours, demos, tmp_path):
    edit(ours, tmp_path / "parts", tool.SplitConfig(splits={"a": [0, 2], "b": [1]}))
    check(tmp_path / "parts" / "a", [demos[0], demos[2]], tmp_path / "out a")
    check(tmp_path / "parts" / "b", [demos[1]], tmp_path / "out b")


def test_merged(ours, demos, tmp_path):
    """Of an edited dataset and a whole one: meta/episodes then knows some episodes and not others."""
    edited = delete(ours, tmp_path / "edited", 0, 1)
    merged = merge(tmp_path / "merged", edited, ours)
    assert {None} < {row["seed"] for row in pq.read_table(merged / "meta" / "episodes").to_pylist()}
    check(merged, [demos[2], *demos], tmp_path / "out")


@pytest.mark.parametrize(
    "operation",
    [
        tool.RecomputeStatsConfig(),
        tool.RemoveFeatureConfig(feature_names=["coarse_subgoal", "observation.state"]),
    ],
    ids=lambda operation: type(operation).__name__,
)
def test_the_other_operations(ours, demos, tmp_path, operation):
    check(edit(ours, tmp_path / "edited", operation), demos, tmp_path / "out")


def test_another_instruction_is_named(ours, tmp_path):
    """LeRobot's tool may give all episodes one; the card is of the same episodes and stays."""
    edited = edit(ours, tmp_path / "edited", tool.ModifyTasksConfig(new_task="do what must be done"))
    assert describe(edited, tmp_path / "out")
    found = [str(verdict.disagreement) for verdict in validation(edited) if not verdict.of_file]
    assert len(found) == 3
    assert all(each.startswith("task at frame 0: recorded 'do what must be done', replayed") for each in found)


@pytest.mark.slow
def test_with_images_it_caches_and_trains(filmed, demos, tmp_path):
    """An episode deleted, the rest merged with the whole, its videos written anew; training makes the cache."""
    edited = delete(filmed, tmp_path / "edited", 0)
    merged = merge(tmp_path / "merged", edited, filmed)
    folder = edit(merged, tmp_path / "reencoded", tool.ReencodeVideosConfig())
    check(folder, [demos[1], *demos[:2]], tmp_path / "out")
    policy = MemobenchMemConfig(device="cpu", push_to_hub=False, align="semantic", chunk_size=8, n_action_steps=8)
    chosen = episodes_where(folder, memory_type="object")
    train_with(
        TrainPipelineConfig(
            dataset=DatasetConfig(repo_id=REPO, root=str(folder), episodes=chosen),
            policy=policy,
            output_dir=tmp_path / "run",
            steps=1,
            batch_size=2,
            num_workers=0,
            save_freq=1,
        )
    )
    assert (tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model" / "model.safetensors").is_file()
    lengths = []
    for path in sorted((folder / "feature_cache").rglob("*.safetensors")):
        lengths.append(len(load_file(path)["tokens"]))
    assert lengths == [len(demo) for demo in (demos[1], *demos[:2])]


def test_states_that_are_gone_are_still_compared(ours, demos, tmp_path):
    """The hash of an episode is of its states too: one digit of it is as good as a state."""
    edited = delete(ours, tmp_path / "edited", 1, 2)
    assert not (edited / "states").exists()
    assert "states" not in read_episode(edited, 0).columns
    _rewrite(edited, digest(demos[0]), "0" * 64)
    (verdict,) = validate(edited)
    assert verdict.disagreement is not None
    assert verdict.disagreement.startswith("digest: recorded '000000")


def test_what_is_lost_is_said(ours, make_demo, tmp_path):
    """Episodes of another program, a dataset from before the frames told their origin, removed actions."""
    stranger = write_dataset([make_demo(["0011"])], tmp_path / "stranger", repo_id=REPO)
    for path in [*(stranger / "meta" / "episodes").rglob("*.parquet"), *(stranger / "data").rglob("*.parquet")]:
        table = pq.read_table(path)
        table = table.drop_columns([name for name in ("seed", "task_name", "digest") if name in table.column_names])
        if EPISODE_INFO in table.column_names:
            place = table.column_names.index(EPISODE_INFO)
            table = table.set_column(place, table.schema.field(EPISODE_INFO), [[""] * len(table)])
        pq.write_table(table, path)
    with pytest.raises(MemobenchError, match="has no episode of this benchmark: of each, it has neither task nor"):
        describe(stranger, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert [verdict.disagreement for verdict in validate(stranger)] == [STRANGER]

    merged = merge(tmp_path / "merged", stranger, delete(ours, tmp_path / "edited", 1, 2))
    said: list[str] = []
    describe(merged, tmp_path / "out", said.append)
    assert said[0].startswith("1 of 2 episodes (0) are left out: of each, it has neither task nor seed")
    assert [verdict.disagreement for verdict in validate(merged)] == [STRANGER, None]
    assert episodes_where(merged, task_name=STOVE) == [1]

    still = edit(ours, tmp_path / "still", tool.RemoveFeatureConfig(feature_names=["action"]))
    assert "no column 'action' (a tool removed it)" in str(validate(still)[0].disagreement)


def test_datasets_without_the_column_are_read_as_before(ours, tmp_path):
    """Those written before it: everything while they are whole, one sentence once they are edited."""
    old = edit(ours, tmp_path / "old", tool.RemoveFeatureConfig(feature_names=[EPISODE_INFO]))
    shutil.copytree(ours / "states", old / "states")
    assert [verdict.disagreement for verdict in validate(old)] == [None] * 3
    assert episodes_where(old, memory_type="object", seed=10_000) == [1]
    for place, new in zip(list_episodes(old), list_episodes(ours), strict=True):
        assert place == new
    edited = delete(old, tmp_path / "edited", 0)
    with pytest.raises(MemobenchError, match="edited a dataset that was written before its frames had the column"):
        describe(edited, tmp_path / "out")
    assert {verdict.disagreement for verdict in validate(edited)} == {STRANGER}
    mixed = merge(tmp_path / "mixed", edited, old)  # numbers beside gaps are floats in its tables
    assert [place.record for place in list_episodes(mixed)] == [None, None, *(p.record for p in list_episodes(ours))]


def test_a_damaged_record_is_told(ours, tmp_path):
    edited = delete(ours, tmp_path / "edited", 0, 1)
    _rewrite(edited, '"variant":0', '"variant":"none"')
    with pytest.raises(MemobenchError, match=r"episode 0: .*episode_info .*variant = 'none', expected"):
        list_episodes(edited)
    with pytest.raises(MemobenchError, match="found 'colour', expected one of task_name, memory_type"):
        episodes_where(ours, colour="red")
    with pytest.raises(MemobenchError, match="has no episode with seed=7"):
        episodes_where(ours, seed=7)


def test_versions_stay(make_demo, tmp_path):
    staged = [stage_demonstration(make_demo(["0011"]), tmp_path / "ds" / ".staging" / "episodes" / "000000")]
    folder = assemble(staged, tmp_path / "ds", manifest={"request": {"versions": {"mujoco": "3.0"}}}, repo_id=REPO)
    twice = merge(tmp_path / "merged", folder, folder)
    edited = delete(twice, tmp_path / "edited", 0)
    describe(edited, tmp_path / "out")
    assert json.loads((tmp_path / "out" / MANIFEST_FILE).read_text())["versions"] == [{"mujoco": "3.0"}]


def _rewrite(folder: Path, old: str, new: str) -> None:
    """Replace a text in the records that frames hold."""
    for path in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(path)
        texts = [text.replace(old, new) for text in table.column(EPISODE_INFO).to_pylist()]
        assert texts != table.column(EPISODE_INFO).to_pylist()
        place = table.column_names.index(EPISODE_INFO)
        pq.write_table(table.set_column(place, table.schema.field(EPISODE_INFO), [texts]), path)
