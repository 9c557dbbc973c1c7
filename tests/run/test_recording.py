"""``lerobot eval … eval.recording=true``: rollouts as a dataset that a policy can be trained on, batch after batch."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_eval

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.modeling_baselines import MemobenchRandomPolicy

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
STEPS = 4
COMMAND = ["eval", "env=memobench", f"tasks={TASK}", "policy=memobench_random", f"horizon={STEPS}", "videos=0"]
COMMAND += ["demonstration_prompt=false", "eval.use_async_envs=false", "eval.recording=true"]


def test_batches_of_several_rows_go_on_with_their_datasets(tmp_path: Path) -> None:
    """Four episodes in two batches of two rows, with pictures; then the fifth and sixth by resume=true."""
    out = tmp_path / "out"
    words = [*COMMAND, "batch_size=2", "env.render=fast", f"output_dir={out}"]
    assert main([*words, "episodes=4"]) == 0
    (folder,) = (out / "recordings").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == ["env_0", "env_1"]
    for row in range(2):
        dataset = LeRobotDataset("local/recorded", root=folder / f"env_{row}")
        assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 2 * STEPS, 20)
        assert {"observation.images.image", "observation.images.wrist_image", "observation.state"} <= set(
            dataset.features
        )
        items = [dataset[number] for number in range(len(dataset))]
        assert [item["next.done"].item() for item in items] == [False] * (STEPS - 1) + [True] + [False] * (
            STEPS - 1
        ) + [True]
        assert {item["task"] for item in items} == {"put the butter into the bowl from the prompt video"}
        assert all(item["observation.images.image"].shape == (3, 256, 256) for item in items)
        assert items[0]["observation.images.image"].mean() > 0.1  # something is to be seen
        assert {item["observation.phase"].item() for item in items} == {1}
    assert main([*words, "episodes=6", "resume=true"]) == 0
    assert LeRobotDataset("local/recorded", root=folder / "env_1").num_episodes == 3


def test_what_is_recorded_is_what_the_policy_did(tmp_path: Path) -> None:
    """One row, three batches, objects instead of pictures; nothing else of the evaluation changes."""
    words = [*COMMAND, "batch_size=1", "episodes=3", "obs_type=environment_state_agent_pos"]
    assert main([*words, f"output_dir={tmp_path / 'recorded'}"]) == 0
    assert main([*words, "eval.recording=false", f"output_dir={tmp_path / 'plain'}"]) == 0
    (folder,) = (tmp_path / "recorded" / "recordings").iterdir()
    dataset = LeRobotDataset("local/recorded", root=folder)
    assert (dataset.num_episodes, dataset.num_frames) == (3, 3 * STEPS)
    assert dataset.features["observation.environment_state"]["dtype"] == "float32"
    actions = np.array([dataset[number]["action"].numpy() for number in range(len(dataset))])
    assert len(np.unique(actions, axis=0)) == 3 * STEPS
    states = np.array([dataset[number]["observation.state"].numpy() for number in range(len(dataset))])
    assert np.abs(np.diff(states[:STEPS], axis=0)).max() > 1e-4  # the arm moves
    hashes = [(path / "report.json").read_text() for path in (tmp_path / "recorded", tmp_path / "plain")]
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize(("bad", "step"), [(np.nan, 2), (None, 1)])
def test_nothing_is_kept_of_an_episode_that_was_broken_off(
    bad: float | None, step: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first batch's second action holds NaN, or its first is of another shape; the second batch goes on."""
    draw, calls = MemobenchRandomPolicy.select_action, []

    def select_action(self: MemobenchRandomPolicy, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        calls.append(draw(self, batch))
        if len(calls) != step:
            return calls[-1]
        return calls[-1][:, :6] if bad is None else calls[-1] * bad

    monkeypatch.setattr(MemobenchRandomPolicy, "select_action", select_action)
    words = [*COMMAND, "batch_size=1", "episodes=2", "obs_type=environment_state_agent_pos"]
    assert main([*words, f"output_dir={tmp_path}"]) == 0
    (folder,) = (tmp_path / "recordings").iterdir()
    dataset = LeRobotDataset("local/recorded", root=folder)
    assert (dataset.num_episodes, dataset.num_frames) == (1, STEPS)
    first, second = read_episodes(tmp_path)
    assert (first["failure"], first["steps"], second["steps"]) == ("invalid_action", step - 1, STEPS)


@pytest.mark.parametrize(("obs_type", "episodes"), [("both", 1), ("environment_state_agent_pos", 3)])
def test_plain_lerobot_eval_is_told_what_its_recorder_cannot(
    obs_type: str, episodes: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", ["/bin/lerobot-eval", "--eval.recording=true", f"--eval.n_episodes={episodes}"])
    config = MemobenchEnvConfig(tasks=TASK, obs_type=obs_type, log_dir=str(tmp_path))
    theirs = lerobot_eval.rollout
    foreign = functools.wraps(theirs)(lambda *words, **more: theirs(*words, **more))
    for rollout in (theirs, foreign):  # somebody's decorator is no loop of ours
        monkeypatch.setattr(lerobot_eval, "rollout", rollout)
        with pytest.raises(MemobenchError, match=r"lerobot eval env=memobench eval\.recording=true"):
            config.create_envs(1)
    monkeypatch.setattr(lerobot_eval, "rollout", theirs)
    monkeypatch.setattr(sys, "argv", ["/bin/lerobot-eval", "--eval.recording=false"])
    assert config.create_envs(1)
    assert not hasattr(lerobot_eval.rollout, "__wrapped__")
