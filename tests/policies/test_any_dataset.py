"""``memobench_mem`` on datasets of other robots: any cameras, joints and rates; no phases, subgoals or clock."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.common.control_utils import predict_action
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import Frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemorySpec
from lerobot_memobench.run.arguments import call_lerobot
from lerobot_memobench.training import loop
from lerobot_memobench.training.configuration import read_training

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"


@dataclass(frozen=True)
class Foreign:
    """Content of a dataset; ``cameras``: name -> height and width."""

    cameras: dict[str, tuple[int, int]] = field(default_factory=lambda: {IMAGES + "top": (96, 96)})
    dtype: str = "video"
    state: int = 6
    action: int = 6
    fps: int = 30
    episodes: int = 1
    tasks: tuple[str, ...] = ("fold the towel",)
    extra: dict[str, Any] = field(default_factory=dict)

    def write(self, root: Path, length: int = 10) -> Path:
        picture = {"dtype": self.dtype, "names": ["height", "width", "channels"]}
        dataset = LeRobotDataset.create(
            "somebody/robot",
            fps=self.fps,
            root=root,
            use_videos=self.dtype == "video",
            features={
                STATE: {"dtype": "float32", "shape": (self.state,), "names": None},
                **{name: {**picture, "shape": (*size, 3)} for name, size in self.cameras.items()},
                ACTION: {"dtype": "float32", "shape": (self.action,), "names": None},
                **{name: {"dtype": "string", "shape": (1,), "names": None} for name in self.extra},
            },
        )
        rng = np.random.default_rng(0)
        for episode in range(self.episodes):
            for _ in range(length):
                numbers = {STATE: self.state, ACTION: self.action}
                dataset.add_frame(
                    {name: rng.normal(size=count).astype(np.float32) for name, count in numbers.items()}
                    | self.pictures(rng)
                    | self.extra
                    | {"task": self.tasks[episode % len(self.tasks)]}
                )
            dataset.save_episode()
        dataset.finalize()
        return root

    def pictures(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {name: rng.integers(0, 255, (*size, 3), np.uint8) for name, size in self.cameras.items()}

    def observed(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {STATE: rng.normal(size=self.state).astype(np.float32), **self.pictures(rng)}


def train(root: Path, out: Path, *flags: str, size: str | None = "tiny") -> Path:
    """Train two updates; return the checkpoint."""
    own = [] if size is None else ["--policy.type=memobench_mem", f"--policy.size={size}"]
    own += ["--policy.num_inference_steps=2"] if size == "tiny" else []
    own += [] if "--policy.memory=none" in flags else ["--policy.memory_settings={frames: 4}"]
    usual = [
        *("--dataset.repo_id=somebody/robot", f"--dataset.root={root}", f"--output_dir={out}"),
        *("--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", "--policy.device=cpu"),
        "--policy.push_to_hub=false",
    ]
    loop.train(read_training([*own, *usual, *flags]))
    return out / "checkpoints" / "last" / "pretrained_model"


def loaded(checkpoint: Path, **renamed: str) -> tuple[Any, Any, Any]:
    """Load policy and processors as LeRobot's control loop does."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    overrides = {"rename_observations_processor": {"rename_map": renamed}}
    pipelines = make_pre_post_processors(config, pretrained_path=str(checkpoint), preprocessor_overrides=overrides)
    return policy, *pipelines


def act(robot: Foreign, policy: Any, before: Any, after: Any, steps: int = 5) -> torch.Tensor:
    """Let a robot act for some control steps; return its actions (steps, A)."""
    rng, cpu = np.random.default_rng(1), torch.device("cpu")
    policy.reset()
    actions = [
        predict_action(robot.observed(rng), policy, cpu, before, after, False, robot.tasks[0], "arm")
        for _ in range(steps)
    ]
    return torch.cat(actions)


def trained_and_acting(robot: Foreign, size: str, tmp_path: Path) -> Any:
    """Train on a robot's dataset, and let the policy act; return it."""
    checkpoint = train(robot.write(tmp_path / "data"), tmp_path / "run", size=size)
    policy, *pipelines = loaded(checkpoint)
    actions = act(robot, policy, *pipelines)
    assert actions.shape == (5, robot.action)
    assert actions.isfinite().all()
    assert policy.config.memory_camera == next(iter(robot.cameras))
    assert [frame.step for frame in policy.rollout.rows[0].memory[0]] == [
        step for step in range(5) if step % policy.config.memory_stride == 0
    ]
    return policy


CAMERAS = {"left": (480, 640), "top": (240, 320), "gripper": (96, 96)}
THREE = {IMAGES + name: size for name, size in CAMERAS.items()}
TASKS = ("fold the towel", "fold the shirt twice", "put it away")


@pytest.mark.parametrize(
    ("robot", "size"),
    [
        (Foreign({"observation.image": (96, 96)}, state=2, action=2, fps=10), "tiny"),
        pytest.param(
            Foreign(THREE, "image", state=40, action=40, fps=50, episodes=3, tasks=TASKS),
            "tiny",
            marks=pytest.mark.slow,
        ),
        (Foreign({IMAGES + "front": (240, 320), IMAGES + "phone": (120, 90)}, state=14, action=7), "small"),
    ],
    ids=["pusht", "humanoid", "two_cameras"],
)
def test_datasets_of_other_robots(robot: Foreign, size: str, tmp_path: Path) -> None:
    trained_and_acting(robot, size, tmp_path)


# --- names ---


@pytest.mark.slow
@pytest.mark.parametrize("size", ["tiny", "small"])
def test_camera_names_are_mapped_in_training_and_acting(size: str, tmp_path: Path) -> None:
    """A checkpoint is trained on data with other names of cameras, and acts for a robot with these names."""
    first = Foreign({IMAGES + "front": (96, 96), IMAGES + "wrist": (96, 96)})
    checkpoint = train(
        first.write(tmp_path / "first"), tmp_path / "run", "--policy.memory_camera=" + IMAGES + "wrist", size=size
    )
    other = Foreign({"observation.image.b": (120, 160), "observation.image.a": (120, 160)})
    renamed = {"observation.image.a": IMAGES + "front", "observation.image.b": IMAGES + "wrist"}
    root = other.write(tmp_path / "other")
    flags = (f"--policy.path={checkpoint}", f"--rename_map={json.dumps(renamed)}")
    on = train(root, tmp_path / "on", *flags, size=None)
    policy, *pipelines = loaded(on, **renamed)
    assert policy.config.memory_camera == IMAGES + "wrist"
    assert act(other, policy, *pipelines).isfinite().all()
    with pytest.raises(MemobenchError, match=f"{IMAGES}wrist.*--rename_map"):
        act(other, *loaded(on))


def test_memory_camera_is_an_input() -> None:
    features = {name: PolicyFeature(FeatureType.VISUAL, (3, *size)) for name, size in THREE.items()}
    config = MemobenchMemConfig(device="cpu", input_features=features)
    config.validate_features()
    assert config.memory_camera == IMAGES + "left"
    config = MemobenchMemConfig(device="cpu", input_features=features, memory_camera=IMAGES + "image")
    with pytest.raises(MemobenchError, match=r"memory_camera.*left, .*top, .*grip"):
        config.validate_features()


# --- missing parts ---


@pytest.mark.parametrize("size", [pytest.param("tiny", marks=pytest.mark.slow), "small"])
def test_no_memory_makes_no_cache_of_it(size: str, tmp_path: Path) -> None:
    robot = Foreign()
    root = robot.write(tmp_path / "data")
    policy, *pipelines = loaded(train(root, tmp_path / "run", "--policy.memory=none", size=size))
    assert act(robot, policy, *pipelines).isfinite().all()
    # The visual encoder's tokens of present pictures are cached, with or without a memory.
    assert [file.name.split("-")[1] for file in root.glob("feature_cache/*/")] == (
        ["present"] if size == "small" else []
    )


@pytest.mark.parametrize(
    ("extra", "flag", "named"),
    [
        ({}, "align=contrastive", "policy.align"),
        ({"simple_subgoal": ""}, "align=framewise", "simple_subgoal"),
        ({"coarse_subgoal": "fold"}, "align=semantic", "policy.subgoal_level"),
        ({}, "oracle_memory=true", "policy.oracle_memory"),
    ],
)
def test_missing_texts_are_refused_before_the_model_is_built(
    extra: dict[str, str], flag: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Foreign(dtype="image", extra=extra).write(tmp_path / "data", length=3)
    monkeypatch.setattr(modeling_memobench_mem, "MemoryPI05", None)
    with pytest.raises(MemobenchError, match=named):
        train(root, tmp_path / "run", f"--policy.{flag}")
    assert not (root / "feature_cache").exists()


def test_states_longer_than_the_base_weights_are_refused() -> None:
    features = {STATE: PolicyFeature(FeatureType.STATE, (33,))}
    config = MemobenchMemConfig(device="cpu", input_features=dict(features))
    config.validate_features()
    assert config.max_state_dim == 33
    config = MemobenchMemConfig(device="cpu", input_features=dict(features), base_weights="lerobot/pi05_base")
    with pytest.raises(MemobenchError, match=r"33 .*32"):
        config.validate_features()


# --- robots without episodes ---


def test_history_without_reset_is_bounded(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Frames.capacity == 8192
    monkeypatch.setattr(Frames, "capacity", 16)
    spec = MemorySpec(dim=2, tokens=1, width=2, expert=2, grid=0, stride=1)
    mechanism = Frames(spec, torch.nn.Identity(), Frames.Settings(frames=4))
    state = mechanism.init(1)
    with caplog.at_level(logging.WARNING):
        for step in range(50):
            state = mechanism.observe(state, torch.full((1, 1, 2), float(step)), torch.tensor([step]))
            read = mechanism.read(state)
            assert read.steps is not None
            assert read.steps[read.mask].tolist() == list(mechanism.slots(step, mechanism.settings)), "as in training"
    assert [frame.step for frame in state[0]] == list(range(34, 50))
    assert read.steps.tolist() == [[34, 39, 44, 49]]
    assert len(caplog.messages) == 1
    assert "policy.reset()" in caplog.text


# --- the benchmark between updates ---


def test_evaluation_between_updates_needs_the_datasets_inputs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Foreign({IMAGES + "image": (128, 128)}, "image", state=8, action=7).write(tmp_path / "data", length=3)
    words = ("policy=act", "policy.pretrained_backbone_weights=null", "env=memobench", "steps=1", "device=cpu")
    assert main(["train", *words, f"dataset={root}", f"output_dir={tmp_path / 'run'}"]) == 2
    assert re.search(f"{root}.*128 x 128", capsys.readouterr().err)


# --- another environment ---


@pytest.mark.slow
def test_pusht(tmp_path: Path) -> None:
    """A rollout in LeRobot's own environment, by its own command: no clock, no phases, one instruction for all."""
    pytest.importorskip("gym_pusht")
    robot = Foreign({"observation.image": (384, 384)}, state=2, action=2, fps=10)
    checkpoint = train(robot.write(tmp_path / "data"), tmp_path / "run")
    flags = (f"--policy.path={checkpoint}", "--env.type=pusht", "--env.episode_length=12", "--policy.device=cpu")
    flags += (
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'out'}",
    )
    assert call_lerobot("eval", flags) == 0
    assert json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
