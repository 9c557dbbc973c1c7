"""The alignment study: one command, resumable, its split held out, its table and figure from its runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.cli.study import study
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.studies.alignment.settings import ALIGNMENTS, StudySettings
from lerobot_memobench.studies.alignment.study import Study
from lerobot_memobench.studies.alignment.summary import markdown_table

SETTINGS = StudySettings(steps=2, batch_size=4, seeds=1, held_out=1, frames_per_episode=6, action_batches=1)


@pytest.fixture(scope="module")
def work(twice_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Study:
    return Study(twice_root, tmp_path_factory.mktemp("out") / "study", SETTINGS, lambda _: None)


def test_held_out_episodes_are_never_trained_or_fitted_on(work: Study) -> None:
    held = set(work.split.episode[work.split.test].tolist())
    assert held == {1, 3, 5}  # the last of each task's two
    assert not held & set(work.split.episode[work.split.train].tolist())
    assert not held & set(work.split.episode[work.split.fit].tolist())
    assert (work.cache.phase[work.split.test] == 1).all()


def test_arrays_are_the_dataset(work: Study, twice_root: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("memobench/synthetic", root=twice_root, delta_timestamps={"action": [0.0, 0.05, 0.1]})
    indices = np.array([3, 38, 39, 81])  # 39 is the last frame of its episode: its chunk is padded
    batch = work.frames.batch(indices, 3)
    items = [dataset[int(index)] for index in indices]
    for key in ("action", "action_is_pad", "observation.state", "observation.images.image"):
        torch.testing.assert_close(batch[key], torch.stack([item[key] for item in items]), atol=2e-3, rtol=0)
    assert batch["task"] == [item["task"] for item in items]


def test_runs_are_measured_and_read_back(work: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    found = work.run("framewise", 0)
    assert {"memory", "last_frame", "head", "action_loss", "curve"} <= set(found)
    assert all(0 <= found[name]["all"] <= found[name]["own_task"] <= 1 for name in ("memory", "last_frame", "head"))
    assert found["action_loss"] > 0
    assert (work.out / "checkpoints" / "framewise" / "pretrained_model" / "model.safetensors").is_file()
    monkeypatch.setattr(
        "lerobot_memobench.studies.alignment.study.train", lambda *_: pytest.fail("a finished run was trained again")
    )
    assert work.run("framewise", 0) == found
    plain = work.baselines()
    assert plain["chance"]["all"] == pytest.approx(1 / len(work.questions.candidates))


def test_own_task_scores_ask_among_the_tasks_subgoals(work: Study) -> None:
    for row, index in enumerate(work.questions.test.indices.tolist()):
        texts = {work.questions.texts[k] for k in work.questions.test.allowed[row].nonzero().flatten().tolist()}
        task = work.frames.task_texts[int(work.frames.tasks[index])]
        assert (task == "put the bowl away") == ("put the bowl in the drawer" in texts)
        assert work.questions.texts[int(work.questions.test.labels[row])] in texts


def test_another_study_in_the_same_folder_is_refused(work: Study, twice_root: Path) -> None:
    with pytest.raises(MemobenchError, match="another steps"):
        Study(twice_root, work.out, StudySettings(steps=3), lambda _: None)
    with pytest.raises(MemobenchError, match="has 2 episodes and 2 are to be held out"):
        Study(twice_root, work.out.parent / "other", StudySettings(), lambda _: None)


@pytest.mark.slow
def test_one_command_makes_table_and_figure(
    twice_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert study(twice_root, tmp_path, steps=1, batch_size=4, seeds=1, held_out=1) == 0
    summary = json.loads((tmp_path / "study.json").read_text())
    assert list(summary["alignments"]) == list(ALIGNMENTS)
    assert "own head" not in summary["alignments"]["none"]
    assert "own head" in summary["alignments"]["semantic"]
    table = (tmp_path / "study.md").read_text().strip()
    assert table == markdown_table(summary)
    assert table in capsys.readouterr().out
    assert (tmp_path / "alignment_study.png").stat().st_size > 10_000
    assert not list(tmp_path.rglob("*.part*"))
