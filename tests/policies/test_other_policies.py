"""LeRobot's policies: an update on our datasets and a rollout in our environment, without a rename map.

Policies are small. If LeRobot fixes sizes or downloads a tokenizer, the test replaces those; the policy's code is
LeRobot's.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.commands.command_line import call_lerobot
from lerobot_memobench.conformance.streams import write_streams
from lerobot_memobench.constants import EXECUTION
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.lerobot_policies import shrink_paligemma, tiny_smolvlm, words_of
from tests.support.logs import protocol_of

TASK = "turn_on_the_stove_and_turn_it_off"
STATE, OBJECTS = "observation.state", "observation.environment_state"
IMAGES = {"observation.images.image", "observation.images.wrist_image"}
INPUTS = {*IMAGES, STATE}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short demonstrations with images and objects."""
    return write_streams(tmp_path_factory.mktemp("others") / "demonstrations", frames=9, task=TASK)


def train_and_roll_out(dataset: Path, out: Path, *policy: str, inputs: set[str] = INPUTS) -> dict[str, Any]:
    """Train one step and run one short episode by the two commands; return the protocol of the evaluation."""
    run = out / "train"
    words = ("steps=1", "batch_size=2", "num_workers=0", "save_freq=1", f"output_dir={run}", "policy.device=cpu")
    assert main(["train", *policy, f"dataset={dataset}", *words]) == 0
    checkpoint = run / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((checkpoint / "config.json").read_text())
    # Phase, checkpoints, subgoals and language are inputs of memory policies alone.
    assert set(config["input_features"]) == inputs
    assert set(config["output_features"]) == {"action"}
    steps = json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]
    (step,) = [step for step in steps if step.get("registry_name") == "normalizer_processor"]
    assert set(step["config"]["features"]) == {*inputs, "action"}
    words = (f"tasks={TASK}", "episodes=1", "horizon=3", f"output_dir={out / 'eval'}")
    assert main(["eval", "env=memobench", f"policy={run}", *words]) == 0
    (record,) = read_episodes(out / "eval")
    assert record["steps"] == 3
    return protocol_of(out / "eval")


DIFFUSION = (
    *("policy=diffusion", "policy.down_dims=[16,32]", "policy.num_inference_steps=2", "policy.horizon=8"),
    *("policy.diffusion_step_embed_dim=16", "policy.n_groups=4", "policy.n_action_steps=2"),
    *("policy.pretrained_backbone_weights=null", "policy.crop_shape=[84,84]", "policy.spatial_softmax_num_keypoints=8"),
)


SHOWN = {
    "pixels": (True, None, "pixels_agent_pos"),
    "both": (True, "both", "both"),
    "objects alone": (False, None, "environment_state_agent_pos"),
    "objects": (True, "environment_state_agent_pos", "environment_state_agent_pos"),
}
DEFAULT = (("diffusion", "pixels"), ("act", "both"))


@pytest.mark.parametrize(
    ("policy", "images", "obs_type", "seen"),
    [
        pytest.param(
            words, *SHOWN[case], marks=() if (name, case) in DEFAULT else pytest.mark.slow, id=f"{name} {case}"
        )
        for name, words in (("act", words_of("act")), ("diffusion", DIFFUSION))
        for case in SHOWN
    ],
)
def test_evaluation_has_the_inputs_of_training(
    policy: tuple[str, ...], images: bool, obs_type: str | None, seen: str, tmp_path: Path
) -> None:
    of = {"pixels_agent_pos": IMAGES, "environment_state_agent_pos": {OBJECTS}, "both": IMAGES | {OBJECTS}}
    dataset = write_streams(tmp_path / "demonstrations", images, frames=9, task=TASK)
    words = policy if obs_type is None else (*policy, f"obs_type={obs_type}")
    protocol = train_and_roll_out(dataset, tmp_path, *words, inputs={STATE} | of[seen])
    assert protocol["obs_type"] == seen


# --- policies with a language model ---


@pytest.fixture
def _tiny_paligemma(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_paligemma(monkeypatch, get_task(TASK).language)


@pytest.mark.slow
@pytest.mark.usefixtures("_tiny_paligemma")
@pytest.mark.parametrize("name", ["pi0", "pi05"])
def test_pi(dataset: Path, tmp_path: Path, name: str) -> None:
    train_and_roll_out(
        dataset,
        tmp_path,
        *(f"policy={name}", "policy.chunk_size=4", "policy.n_action_steps=4", "policy.num_inference_steps=2"),
        *("policy.dtype=float32", "policy.tokenizer_max_length=64"),
    )


@pytest.mark.slow
def test_smolvla(dataset: Path, tmp_path: Path) -> None:
    train_and_roll_out(
        dataset,
        tmp_path,
        *(
            "policy=smolvla",
            f"policy.vlm_model_name={tiny_smolvlm(tmp_path, get_task(TASK).language)}",
            "policy.num_vlm_layers=2",
            "policy.num_steps=2",
        ),
        *("policy.chunk_size=4", "policy.n_action_steps=4"),
    )


# --- demonstration prompts ---

MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
PROMPTS = [136, 144]
"""Steps of the prompt in the episodes of seeds 7 and 8."""
HORIZON, INTERVAL = 20, 8


def test_first_plan_reads_the_first_execution_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The environments receive the planned actions and no earlier ones, whatever the lengths of the prompts."""
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    import lerobot_policy_memobench  # noqa: F401 - as LeRobot finds it

    plans: list[np.ndarray] = []
    applied: dict[int, list[np.ndarray]] = defaultdict(list)
    plan, step = DiffusionPolicy.predict_action_chunk, MemobenchEnv.step

    def planned(this: Any, batch: Any, **options: Any) -> Any:
        plans.append(plan(this, batch, **options))
        return plans[-1]

    def stepped(this: MemobenchEnv, action: Any) -> Any:
        if this.episode.phase == EXECUTION:
            applied[this.episode.seed].append(np.array(action))
        return step(this, action)

    monkeypatch.setattr(DiffusionPolicy, "predict_action_chunk", planned)
    monkeypatch.setattr(MemobenchEnv, "step", stepped)
    words = dict(word.split("=", 1) for word in DIFFUSION) | {"policy.horizon": "16", "policy.n_action_steps": "8"}
    flags = [f"--{'policy.type' if name == 'policy' else name}={value}" for name, value in words.items()]
    line = [
        *("--env.type=memobench", f"--env.tasks={MILK}", f"--env.horizon={HORIZON}"),
        *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", "--seed=7"),
        *("--policy.device=cpu", f"--output_dir={tmp_path}", f"--env.log_dir={tmp_path}"),
    ]
    assert call_lerobot("eval", [*line, *flags]) == 0
    records = read_episodes(tmp_path)
    assert [(record["prompt_steps"], record["steps"]) for record in records] == [(steps, HORIZON) for steps in PROMPTS]
    assert [record["prompt_shown"] for record in records] == [True, True]
    for row, seed in enumerate((7, 8)):
        expected = np.concatenate([actions[row, :INTERVAL].numpy() for actions in plans])[:HORIZON]
        np.testing.assert_array_equal(np.stack(applied[seed]), expected)
    assert protocol_of(tmp_path)["prompt_in"] == "reset"
