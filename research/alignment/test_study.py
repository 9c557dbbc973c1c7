"""The alignment study: one command, resumable, its split held out, its tables and figure from its policies."""

from __future__ import annotations

import ast
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies import make_policy, make_pre_post_processors
from PIL import Image, ImageColor
from safetensors.torch import load_file

from lerobot_memobench.datasets.lerobot_format.reading import EpisodePlace, EpisodeRecord
from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from research.alignment import study as study_module
from research.alignment.__main__ import alignment as study
from research.alignment.measures import Measures, split_episodes
from research.alignment.study import ALIGNMENTS, Study, StudySettings, run_study
from research.learning import stages as stages_module
from research.learning.experiments import MEMORY, MEMORYLESS
from research.learning.results import COLOURS
from research.learning.stages import Cost
from tests.support.object_dataset import NAMES, TASKS

SETTINGS = StudySettings(steps=2, seeds=1, held_out=1, rollouts=10, frames_per_episode=6)
BOWL, MILK = NAMES[:2]
STRICT_TASK = "open_and_close_the_microwave_a_given_number_of_times"


@pytest.fixture(scope="module")
def work(twice_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Study:
    return Study(twice_root, tmp_path_factory.mktemp("out") / "study", SETTINGS)


def said(words: Sequence[str], key: str) -> str | None:
    return next((word.partition("=")[2] for word in words if word.startswith(f"{key}=")), None)


def fake_training(work: Study, words: Sequence[str]) -> None:
    """Leave a checkpoint as `lerobot train` does, of a policy that has learned nothing."""
    own = {
        "align": said(words, "align") or "none",
        "memory_fusion": said(words, "policy.memory_fusion") or "modulation",
    }
    own["oracle_memory"] = said(words, "policy.oracle_memory") == "true"
    config = MemobenchMemConfig(size="small", perception="objects", device="cpu", push_to_hub=False, **own)
    torch.manual_seed(int(said(words, "seed") or -1))
    policy = make_policy(config, ds_meta=work.measures.meta)
    for part in (policy, *make_pre_post_processors(config, dataset_stats=work.measures.meta.stats)):
        part.save_pretrained(Path(str(said(words, "output_dir"))) / "checkpoints" / "last" / "pretrained_model")


def weights_of(work: Study, arm: str) -> dict[str, torch.Tensor]:
    return load_file(work.stages.checkpoint(arm, 0) / "model.safetensors")


def fake_evaluation(words: Sequence[str]) -> None:
    """Log that a memory is always right, and that without one the referent is wrong in six of ten."""
    from tests.support.logs import rollout

    solved = 4 if "no_memory" in str(said(words, "policy")) else 10
    write_episodes(
        Path(str(said(words, "output_dir"))),
        [
            rollout(task, "object", "S", [k < solved], k < solved, k, failure=None if k < solved else "reference_drift")
            for task in str(said(words, "tasks")).split(",")
            for k in range(int(said(words, "episodes") or 0))
        ],
    )


@pytest.fixture
def ran(work: Study, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands that a study gives, whose work is made up."""
    found: list[list[str]] = []

    def fake(words: list[str], log: Path, **options: Any) -> Cost:
        found.append(words)
        if words[1] == "train":
            fake_training(work, words)
        else:
            fake_evaluation(words)
        return Cost(60.0, 90.0)

    monkeypatch.setattr(stages_module, "run_once", fake)
    return found


def test_held_out_episodes_are_never_trained_or_fitted_on(work: Study, ran: list[list[str]]) -> None:
    held = set(work.questions.test.episodes.tolist())
    assert held == {3, 5}  # the last of each task's
    assert set(work.questions.fit.episodes.tolist()) == {0, 1, 2, 4}
    work.stages.train("semantic", 0)
    assert ast.literal_eval(str(said(ran[0], "dataset.episodes"))) == [0, 1, 2, 4]
    asked = np.concatenate([work.questions.fit.indices, work.questions.test.indices])
    assert (work.frames.phase[asked] == 1).all()
    starts = work.frames.episodes
    assert (np.searchsorted(starts, asked, "right") - 1).tolist() == [
        *work.questions.fit.episodes.tolist(),
        *work.questions.test.episodes.tolist(),
    ]


@pytest.mark.slow
def test_a_study_is_told_and_read_back(
    work: Study, ran: list[list[str]], twice_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables, figure = run_study(twice_root, work.out, SETTINGS, lambda _: None)
    assert [words[1] for words in ran] == ["train"] * 6 + ["eval"] * 6
    assert all(f"tasks={BOWL},{MILK}" in words and "referent=random" in words for words in ran[6:])
    begun = [weights_of(work, arm) for arm in list(ALIGNMENTS)[:4]]
    assert all(torch.equal(own[name], begun[0][name]) for own in begun for name in begun[0]), "heads apart"
    assert (work.out / "study.md").read_text() == tables + "\n"
    told = json.loads((work.out / "study.json").read_text())
    assert told["outcomes"][MEMORYLESS]["all"]["success"] == pytest.approx(0.4)
    assert told["differences"][MEMORYLESS]["value"] == pytest.approx(-0.6)
    assert f"| all, {MEMORYLESS} | 20 | 40.0 |" in tables
    assert f"| {MEMORYLESS} less {MEMORY} | 20 | -60.0 | " in tables
    assert "| training | 6 | 1.0 | 9.0 |" in tables
    measures = told["measures"]
    assert list(measures) == list(ALIGNMENTS)
    heads = [arm for arm, found in measures.items() if "own head" in found]
    assert heads == ["semantic", "contrastive", "framewise"]
    assert [arm for arm, found in measures.items() if "memory" in found] == [MEMORY, *heads]
    for found in measures.values():
        assert found["action loss"]["mean"] > 0
        for name in ("memory", "last frame", "own head"):
            if name in found:
                assert 0 <= found[name]["mean"] <= found[f"{name}, own task"]["mean"] <= 1
    plain = told["baselines"]
    assert plain["chance"]["all"] == pytest.approx(1 / len(work.questions.candidates))
    assert {"untrained_memory", "untrained_last_frame", "commonest"} <= set(plain)
    with Image.open(figure) as picture:
        pixels = np.asarray(picture.convert("RGB"))[: picture.height // 2, : picture.width // 3].reshape(-1, 3)
    with_memory, without = ((pixels == ImageColor.getrgb(COLOURS[k])).all(axis=1).sum() for k in (0, 5))
    assert with_memory / without == pytest.approx(100 / 40, rel=0.15), "bars are as high as their rates"
    monkeypatch.setattr(Measures, "of_checkpoint", lambda *_: pytest.fail("a finished policy was asked again"))
    assert run_study(twice_root, work.out, SETTINGS, lambda _: None)[0] == tables
    assert not list(work.out.rglob("*.part*"))


def test_own_task_scores_ask_among_the_tasks_subgoals(work: Study) -> None:
    asked = work.questions.test
    for row, index in enumerate(asked.indices.tolist()):
        texts = {work.questions.texts[k] for k in asked.allowed[row].nonzero().flatten().tolist()}
        assert work.questions.texts[int(asked.labels[row])] in texts
        own = {k for part in (work.questions.fit, asked) for k in part.labels[part.tasks == asked.tasks[row]].tolist()}
        assert texts == {work.questions.texts[k] for k in own}
        instruction = TASKS[NAMES.index(work.split.tasks[asked.tasks[row]])]
        number = int(work.frames.columns["task_index"][index])
        assert work.measures.meta.tasks.iloc[number].name == instruction


def test_another_study_in_the_same_folder_is_refused(work: Study, twice_root: Path) -> None:
    with pytest.raises(MemobenchError, match="another steps"):
        Study(twice_root, work.out, StudySettings(**{**vars(SETTINGS), "steps": 3}))
    with pytest.raises(MemobenchError, match=f"'{MILK}' has 2 episodes and 2 are to be held out"):
        Study(twice_root, work.out.parent / "other", StudySettings(held_out=2))


def test_a_dataset_of_nobody_knows_what_is_refused(twice_root: Path, tmp_path: Path) -> None:
    from tests.support.object_dataset import make_object_dataset

    with pytest.raises(MemobenchError, match=r"of the episode 0 of .*, it has neither task nor seed"):
        Study(make_object_dataset(tmp_path / "strange"), tmp_path / "out", SETTINGS)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "referent"), [(BOWL, "fixed"), (STRICT_TASK, "random")])
def test_demonstrations_of_two_kinds_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, referent: str
) -> None:
    kinds = [(BOWL, "random"), (name, referent)] * 3
    records = [
        EpisodeRecord(task_name=n, memory_type="", seed=k, referent=r, variant=0, exec_start_index=0, key_frames=[])
        for k, (n, r) in enumerate(kinds)
    ]
    places = [EpisodePlace(k, 10 * k, 10, record) for k, record in enumerate(records)]
    monkeypatch.setattr("research.alignment.measures.list_episodes", lambda _: places)
    with pytest.raises(MemobenchError, match="demonstrations of 2 kinds"):
        split_episodes(tmp_path, 1)
    del places[1::2]
    assert split_episodes(tmp_path, 1).trained == [0, 1]


@pytest.mark.slow
def test_one_command_trains_rolls_out_and_tells(
    twice_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With LeRobot's commands and the simulator; killed, the same command goes on. Three arms are enough of these."""
    arms = {name: ALIGNMENTS[name] for name in (MEMORY, "contrastive", "oracle text")}
    monkeypatch.setattr(study_module, "ALIGNMENTS", arms)
    asked = {"steps": 2, "seeds": 1, "held_out": 1, "rollouts": 1}
    rolled_out = stages_module.Stages.evaluate
    monkeypatch.setattr(stages_module.Stages, "evaluate", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        study(twice_root, tmp_path, **asked)
    monkeypatch.setattr(stages_module.Stages, "evaluate", rolled_out)
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("model.safetensors")}
    assert len(made) == len(arms)
    study(twice_root, tmp_path, **asked)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("model.safetensors")} == made
    summary = json.loads((tmp_path / "study.json").read_text())
    assert all(found["all"]["rollouts"] == 2 for found in summary["outcomes"].values())
    assert (tmp_path / "study.md").read_text().strip() in capsys.readouterr().out
    assert (tmp_path / "alignment_study.png").stat().st_size > 10_000
