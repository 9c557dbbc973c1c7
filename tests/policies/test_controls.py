"""The paper's controls: oracle memory in the prompt, shuffled subgoals, subgoal level, and pi0.5 without a memory."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors

from lerobot_memobench.datasets.frames import FrameLookup, read_frame_table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import SEVERAL, WordTextEncoder, shuffled_subgoals, text_rows
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.memory_text import with_memory
from lerobot_memobench.tasks.task import LEVELS
from lerobot_memobench.training.features import FOLDER
from tests.support.small_policy import batch_of, made_for_training, small_config

EPISODE_1 = 40  # first frame of the second episode, whose subgoals are:
SUBGOALS = ("open the top drawer", "put the bowl in the drawer", "close the top drawer")


def _observation(dataset: LeRobotDataset, frame: int, task: str) -> dict[str, Any]:
    item = dataset[EPISODE_1 + frame]
    keys = ("observation.images.image", "observation.images.wrist_image", "observation.state")
    found = {key: item[key][None] for key in keys}
    found |= {"observation.step": torch.tensor([[float(frame)]]), "observation.phase": torch.ones(1, 1)}
    return found | {"task": [task]}


def _prompt(before: Any, batch: dict[str, Any], row: int) -> str:
    """What the policy reads, as words: tokens decoded by the pipeline's own tokenizer."""
    step = next(step for step in before.steps if hasattr(step, "vocabulary"))
    ids = batch["observation.language.tokens"][row][batch["observation.language.attention_mask"][row].bool()]
    return " ".join(step.tokenizer.convert_ids_to_tokens(ids.tolist()))


# -- oracle memory -------------------------------------------------------------------------------------------------


def test_oracle_memory_stands_whole_in_the_training_prompt(dataset_root: Path, tmp_path: Path) -> None:
    policy, before, after, dataset = made_for_training(dataset_root, oracle_memory=True)
    batch = before(batch_of(dataset, [EPISODE_1, EPISODE_1 + 22]))
    assert "put the bowl away memory : nothing yet , state :" in _prompt(before, batch, 0)
    done = " ; ".join(SUBGOALS[:2])
    assert f"put the bowl away memory : {done} , state :" in _prompt(before, batch, 1)
    assert _prompt(before, batch, 1).endswith("action :")  # nothing was cut off
    loss, _ = policy.forward(batch)
    loss.backward()
    # The saved pipeline asks for the memory too, and a rollout with it reads the same words.
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    evaluated = MemobenchMemPolicy.from_pretrained(tmp_path)
    again, _ = make_pre_post_processors(evaluated.config, pretrained_path=str(tmp_path))
    task = with_memory("put the bowl away", "; ".join(SUBGOALS[:2]))
    seen = again(_observation(dataset, 22, task))
    assert torch.equal(seen["observation.language.tokens"][0], batch["observation.language.tokens"][1])
    assert torch.isfinite(evaluated.select_action(seen)).all()
    with pytest.raises(MemobenchError, match=r"env\.oracle_memory=true"):
        again(_observation(dataset, 22, "put the bowl away"))


def test_plain_policies_read_no_memory_text(dataset_root: Path) -> None:
    _, before, _, dataset = made_for_training(dataset_root)
    assert "put the bowl away , state :" in _prompt(before, before(batch_of(dataset, [EPISODE_1 + 22])), 0)


def test_six_checkpoints_fit_into_the_prompt() -> None:
    """The longest memory of the catalogue is not cut off by the word tokenizer's length."""
    from lerobot_memobench.policies.memobench_mem.alignment import words
    from lerobot_memobench.tasks.catalogue import get_task, task_names
    from lerobot_memobench.tasks.memory_text import memory_text

    texts = [
        with_memory(task.language, memory_text(task, len(task.checkpoints))) for task in map(get_task, task_names())
    ]
    frame = words("Task: , State: " + "255 " * 8 + ";\nAction: ")
    assert (
        max(len(words(text)) for text in texts) + len(frame) + 1
        <= small_config(oracle_memory=True).tokenizer_max_length
    )


# -- subgoals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "text"),
    [
        ("coarse", "put it"),
        ("intermediate", "put the bowl in the drawer"),
        ("fine", "put the bowl in the drawer at (0.1, 0.2)"),
    ],
)
@pytest.mark.parametrize("align", ["semantic", "framewise"])
def test_subgoal_level_chooses_the_text(dataset_root: Path, align: str, level: str, text: str) -> None:
    policy, before, _, dataset = made_for_training(dataset_root, align=align, subgoal_level=level)
    batch = before(batch_of(dataset, [EPISODE_1 + 12, 3]))
    found = batch["memory.text"][0]
    if align == "framewise":
        found = found[batch["memory.text_mask"][0]][-1]  # the frame itself is the last of its history
    torch.testing.assert_close(found, WordTextEncoder(64)([text])[0])
    policy.forward(batch)[0].backward()


def test_shuffled_subgoals_stay_in_their_episode_and_all_move() -> None:
    rows = np.array([0, 0, 1, 2, -1, 5, 5, 7], np.int32)
    episodes = np.array([0, 5, 7, 8])
    shuffled, elsewhere = shuffled_subgoals(rows, episodes)
    assert set(shuffled[:4]) == {0, 1, 2}
    assert (shuffled[:4] != rows[:4]).all()
    assert shuffled[4] == -1
    assert elsewhere == 2, "one subgoal has none to change places with"
    assert shuffled[5] == shuffled[6] in {0, 1, 2, 7}
    assert shuffled[7] in {0, 1, 2, 5}
    assert shuffled[0] == shuffled[1]
    assert np.array_equal(shuffled, shuffled_subgoals(rows, episodes)[0])
    others = [shuffled_subgoals(rows, episodes, seed)[0][:4].tolist() for seed in range(8)]
    assert len({tuple(other) for other in others}) == 2  # three subgoals can all move in two ways


def kept_relation(rows: np.ndarray, shuffled: np.ndarray) -> dict[int, float]:
    """How often each subgoal gets the text that it gets most often: 1 where it is renamed alike everywhere."""
    found = {}
    for row in np.unique(rows):
        _, counts = np.unique(shuffled[rows == row], return_counts=True)
        found[int(row)] = counts.max() / counts.sum()
    return found


@pytest.mark.parametrize("level", LEVELS)
def test_shuffled_subgoals_tell_nothing_of_what_is_seen_in_any_task(level: str) -> None:
    """Episodes of all tasks together, and of each task alone; a subgoal is one frame of each episode."""
    repeats = 60
    tasks = [get_task(name) for name in task_names(suite=None)]
    said = [[checkpoint.language[LEVELS.index(level)] for checkpoint in task.checkpoints] for task in tasks]
    number = {text: row for row, text in enumerate(dict.fromkeys(text for texts in said for text in texts))}
    own = [[number[text] for text in dict.fromkeys(texts)] for texts in said]
    few = [rows for rows in own if len(rows) < SEVERAL]
    assert few, "there are tasks whose subgoals would only be renamed"

    def shuffle(tasks: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
        rows = np.array([row for subgoals in tasks for row in subgoals * repeats])
        lengths = [len(subgoals) for subgoals in tasks for _ in range(repeats)]
        return rows, shuffled_subgoals(rows, np.r_[0, np.cumsum(lengths)])[0]

    rows, shuffled = shuffle(own)
    ends = np.cumsum([repeats * len(subgoals) for subgoals in own])
    for task, end, subgoals in zip(tasks, ends, own, strict=True):
        here = slice(end - repeats * len(subgoals), end)
        assert max(kept_relation(rows[here], shuffled[here]).values()) < 0.7, task.name
    for task, subgoals in zip(tasks, own, strict=True):
        if len(subgoals) > 1:
            assert max(kept_relation(*shuffle([subgoals])).values()) < 0.75, f"{task.name} alone"


def test_one_subgoal_alone_cannot_be_shuffled() -> None:
    cache: Any = SimpleNamespace(
        texts=["put it down"], text_rows=lambda _: np.zeros(5, int), episodes=np.array([0, 5]), root="here"
    )
    with pytest.raises(MemobenchError, match=r"one coarse subgoal.*several tasks"):
        text_rows(cache, "coarse", "semantic", True)


@pytest.mark.parametrize("align", ["contrastive", "framewise"])
def test_shuffled_subgoals_reach_the_loss(dataset_root: Path, align: str) -> None:
    """Every frame of an episode with several subgoals is taught another one of the same episode."""
    indices = [EPISODE_1 + frame for frame in (1, 9, 20)]
    found = {}
    for shuffle in (False, True):
        policy, before, _, dataset = made_for_training(dataset_root, align=align, shuffle_subgoals=shuffle)
        batch = before(batch_of(dataset, indices))
        found[shuffle] = batch["memory.text"]
        policy.forward(batch)[0].backward()
        again = before(batch_of(dataset, indices))  # another epoch
        assert torch.equal(batch["memory.text"], again["memory.text"])
    known = WordTextEncoder(64)(list(SUBGOALS))
    plain, shuffled = (
        (found[key].reshape(-1, 64) @ known.T).argmax(dim=1)[batch["memory.text_mask"].reshape(-1)]
        for key in (False, True)
    )
    assert (plain != shuffled).all()
    assert set(shuffled.tolist()) == {0, 1, 2}


def test_a_dataset_without_the_columns_is_refused(dataset_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(dataset_root, root, ignore=shutil.ignore_patterns(FOLDER))
    for path in (root / "data").rglob("*.parquet"):
        pq.write_table(pq.read_table(path).drop_columns(["coarse_subgoal", "memory"]), path)
    lookup = FrameLookup(root, read_frame_table(root))
    with pytest.raises(MemobenchError, match=r"coarse_subgoal.*intermediate, fine"):
        lookup.text_rows("coarse")
    with pytest.raises(MemobenchError, match="no column 'memory'"):
        lookup.memory_texts([3])


# -- pi0.5 without a memory ----------------------------------------------------------------------------------------


def test_without_memory_fusion_it_is_plain_pi05(dataset_root: Path, tmp_path: Path) -> None:
    from lerobot_memobench.policies.memobench_mem.network import MemoryPI05

    policy, before, after, dataset = made_for_training(dataset_root, memory_fusion="none")
    assert set(dict(policy.model.named_parameters())) == set(
        dict(MemoryPI05(small_config(memory_fusion="none")).named_parameters())
    )
    batch = before(batch_of(dataset, [EPISODE_1 + 1, EPISODE_1 + 22]))
    assert batch["phase"].tolist() == [0, 1]
    assert not any(key.startswith("memory.") for key in batch)
    policy.train()
    loss, logged = policy.forward(batch)
    loss.backward()
    assert logged["loss"] == logged["action_loss"]
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    evaluated = MemobenchMemPolicy.from_pretrained(tmp_path)
    for frame in range(3):
        action = evaluated.select_action(before(_observation(dataset, frame, "put the bowl away")))
        assert torch.isfinite(action).all()
    assert all(row.memory is None for row in evaluated.rollout.rows)


def test_nothing_is_aligned_without_a_memory() -> None:
    with pytest.raises(MemobenchError, match="no memory to align"):
        small_config(memory_fusion="none", align="semantic")
