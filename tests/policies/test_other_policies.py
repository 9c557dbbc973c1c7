"""LeRobot's own policies here: a step of training on our columns, a rollout in our environment, without a rename map.

Weights are random and small. Where LeRobot fixes sizes or fetches a tokenizer inside the policy, the test hands it
smaller numbers or a tokenizer built here; the policy's own code runs unchanged.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.lerobot_format.assembling import write_dataset
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.run.arguments import call_lerobot
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.tiny_paligemma import shrink_paligemma, word_tokenizer

TASK = "turn_on_the_stove_and_turn_it_off"
LENGTH, PROMPT_LENGTH, SIDE = 12, 4, 256
STATE, OBJECTS, PRIVILEGED = "observation.state", "observation.environment_state", "privileged.environment_state"
PICTURES = {"observation.images.image", "observation.images.wrist_image"}
INPUTS = {*PICTURES, STATE}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short demonstrations with pictures of the real size."""
    return written(tmp_path_factory.mktemp("others"), pictures=True)


def written(folder: Path, *, pictures: bool) -> Path:
    """Two short demonstrations with every column that `memobench generate` writes."""
    task = get_task(TASK)
    rng = np.random.default_rng(3)
    satisfied = np.zeros((LENGTH, len(task.checkpoints)), np.bool_)
    satisfied[7:] = True
    shade = np.linspace(0, 200, SIDE, dtype=np.uint8)
    frames = np.stack([np.broadcast_to(np.roll(shade, 9 * t)[None, :, None], (SIDE, SIDE, 3)) for t in range(LENGTH)])

    def demonstration(seed: int) -> Demonstration:
        return Demonstration(
            task=task,
            seed=seed,
            referent="fixed",
            variant=0,
            states=rng.normal(size=(LENGTH, 5)),
            actions=rng.uniform(-1, 1, size=(LENGTH, 7)).astype(np.float32),
            proprio=rng.normal(size=(LENGTH, 8)).astype(np.float32),
            images=dict.fromkeys(("image", "wrist_image"), frames) if pictures else None,
            objects=rng.normal(size=(LENGTH, SIZE)).astype(np.float32),
            exec_start=PROMPT_LENGTH,
            satisfied=satisfied,
            success=True,
            fixture_poses={},
            scene_hash="abc",
        )

    return write_dataset((demonstration(seed) for seed in (10_000, 10_001)), folder / "demonstrations")


def train_and_roll_out(dataset: Path, out: Path, *policy: str, inputs: set[str] = INPUTS) -> dict[str, Any]:
    """One optimiser step and one short episode by the two commands, as a user types them; check what came of both.

    Returns the protocol of the evaluation.
    """
    run = out / "train"
    words = ("steps=1", "batch_size=2", "num_workers=0", "save_freq=1", f"output_dir={run}", "policy.device=cpu")
    assert main(["train", *policy, f"dataset={dataset}", *words]) == 0
    checkpoint = run / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((checkpoint / "config.json").read_text())
    # Phase, checkpoints, subgoals and language rows are for memory policies: to others they are no input.
    assert set(config["input_features"]) == inputs
    assert set(config["output_features"]) == {"action"}
    assert normalised(checkpoint, inputs) <= {*inputs, "action"} | KEPT
    words = (f"tasks={TASK}", "episodes=1", "horizon=3", "env.render=fast", f"output_dir={out / 'eval'}")
    assert main(["eval", "env=memobench", f"policy={run}", *words]) == 0
    (record,) = read_episodes(out / "eval")
    assert record["steps"] == 3
    return protocol_of(out / "eval")


#: LeRobot keeps the statistics of every column in the file; which of them are used its step's features say.
KEPT = {
    *PICTURES,
    OBJECTS,
    PRIVILEGED,
    "executed_action",
    "checkpoint.index",
    "checkpoint.operation",
    "checkpoint.completed",
    "checkpoint.event",
    *("timestamp", "frame_index", "episode_index", "index", "task_index"),
}


def normalised(checkpoint: Path, inputs: set[str]) -> set[str]:
    """Return the columns whose statistics a checkpoint's preprocessor holds; check which of them it applies."""
    steps = json.loads((checkpoint / "policy_preprocessor.json").read_text())["steps"]
    (step,) = [step for step in steps if step.get("registry_name") == "normalizer_processor"]
    assert set(step["config"]["features"]) == {*inputs, "action"}
    with safe_open(checkpoint / step["state_file"], framework="numpy") as file:
        return {name.rpartition(".")[0] for name in file.keys()}  # noqa: SIM118


ACT = (
    *("policy=act", "policy.pretrained_backbone_weights=null", "policy.dim_model=32", "policy.n_heads=2"),
    *("policy.dim_feedforward=64", "policy.n_encoder_layers=1", "policy.n_vae_encoder_layers=1"),
    *("policy.chunk_size=4", "policy.n_action_steps=4", "policy.latent_dim=8"),
)
DIFFUSION = (
    *("policy=diffusion", "policy.down_dims=[16,32]", "policy.num_inference_steps=2", "policy.horizon=8"),
    *("policy.diffusion_step_embed_dim=16", "policy.n_groups=4", "policy.n_action_steps=2"),
    *("policy.pretrained_backbone_weights=null", "policy.crop_shape=[84,84]", "policy.spatial_softmax_num_keypoints=8"),
)


@pytest.mark.parametrize("policy", [pytest.param(ACT, marks=pytest.mark.slow), DIFFUSION], ids=["act", "diffusion"])
def test_on_pictures(policy: tuple[str, ...], dataset: Path, tmp_path: Path) -> None:
    assert train_and_roll_out(dataset, tmp_path, *policy)["obs_type"] == "pixels_agent_pos"


@pytest.mark.parametrize("policy", [ACT, pytest.param(DIFFUSION, marks=pytest.mark.slow)], ids=["act", "diffusion"])
@pytest.mark.parametrize(
    ("pictures", "said", "seen"),
    [
        (False, None, "environment_state_agent_pos"),
        (True, None, "pixels_agent_pos"),
        (True, "environment_state_agent_pos", "environment_state_agent_pos"),
        (True, "both", "both"),
    ],
)
def test_on_objects(policy: tuple[str, ...], pictures: bool, said: str | None, seen: str, tmp_path: Path) -> None:
    """The evaluation shows what the policy was trained on, without a word."""
    of = {"pixels_agent_pos": PICTURES, "environment_state_agent_pos": {OBJECTS}, "both": PICTURES | {OBJECTS}}
    dataset = written(tmp_path, pictures=pictures)
    words = policy if said is None else (*policy, f"obs_type={said}")
    protocol = train_and_roll_out(dataset, tmp_path, *words, inputs={STATE} | of[seen])
    assert protocol["obs_type"] == seen


# --- those with a language model ---


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


@pytest.fixture
def tiny_smolvlm(tmp_path: Path) -> Path:
    """A folder with a small SmolVLM's configuration and processor, as the hub has the large one's."""
    from transformers import SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    folder = tmp_path / "smolvlm"
    tokenizer = word_tokenizer(
        get_task(TASK).language,
        fake_image_token="<fake_token_around_image>",
        image_token="<image>",
        end_of_utterance_token="<end_of_utterance>",
        global_image_token="<global-img>",
        video_token="<video>",
    )
    text = {
        "hidden_size": 48,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 12,
        "vocab_size": len(tokenizer),
        "pad_token_id": tokenizer.pad_token_id,
        "max_position_embeddings": 512,
    }
    vision = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 512,
        "patch_size": 16,
    }
    image = tokenizer.convert_tokens_to_ids("<image>")
    SmolVLMConfig(text_config=text, vision_config=vision, scale_factor=4, image_token_id=image).save_pretrained(folder)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
    return folder


@pytest.mark.slow
def test_smolvla(dataset: Path, tmp_path: Path, tiny_smolvlm: Path) -> None:
    train_and_roll_out(
        dataset,
        tmp_path,
        *("policy=smolvla", f"policy.vlm_model_name={tiny_smolvlm}", "policy.num_vlm_layers=2", "policy.num_steps=2"),
        *("policy.chunk_size=4", "policy.n_action_steps=4"),
    )


# --- demonstration prompts ---

MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
PROMPTS = [147, 165]
"""Steps of the prompt in the episodes of seeds 7 and 8."""
HORIZON = 20


def flags(words: tuple[str, ...], **other: int) -> list[str]:
    """Return our words as LeRobot's flags, with other values."""
    pairs = dict(word.split("=", 1) for word in words) | {f"policy.{name}": str(value) for name, value in other.items()}
    return [f"--{'policy.type' if name == 'policy' else name}={value}" for name, value in pairs.items()]


class Watched:
    """What a policy plans in a rollout, and what its environments are given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, policy: type) -> None:
        self.plans: list[tuple[list[int], list[int], np.ndarray]] = []
        """Of each plan: phase and step of every row's observation, actions (rows, chunk, 7)."""
        self.applied: dict[int, list[np.ndarray]] = defaultdict(list)
        """Seed -> actions that were given in the execution."""
        self._seen: Any = None
        plan, select, step = policy.predict_action_chunk, policy.select_action, MemobenchEnv.step  # type: ignore[attr-defined]

        def selected(this: Any, batch: Any, **options: Any) -> Any:
            self._seen = batch
            return select(this, batch, **options)

        def planned(this: Any, batch: Any, **options: Any) -> Any:
            actions = plan(this, batch, **options)
            rows = [self._seen[f"observation.{name}"].flatten().int().tolist() for name in ("phase", "step")]
            self.plans.append((rows[0], rows[1], actions.numpy().copy()))
            return actions

        def stepped(this: MemobenchEnv, action: Any) -> Any:
            if this.episode.phase == EXECUTION:
                self.applied[this.episode.seed].append(np.array(action))
            return step(this, action)

        monkeypatch.setattr(policy, "select_action", selected)
        monkeypatch.setattr(policy, "predict_action_chunk", planned)
        monkeypatch.setattr(MemobenchEnv, "step", stepped)


@pytest.fixture
def lerobot_eval(tmp_path: Path) -> Any:
    """Two episodes with prompts of different lengths in one batch, by LeRobot's own command."""
    import lerobot_policy_memobench  # noqa: F401 - as LeRobot finds it

    def run(*policy: str) -> None:
        line = [
            *("--env.type=memobench", f"--env.tasks={MILK}", f"--env.horizon={HORIZON}", "--env.render=fast"),
            *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", "--seed=7"),
            *("--policy.device=cpu", f"--output_dir={tmp_path}", f"--env.log_dir={tmp_path}"),
        ]
        assert call_lerobot("eval", [*line, *policy]) == 0

    return run


def act() -> tuple[type, list[str], int]:
    from lerobot.policies.act.modeling_act import ACTPolicy

    return ACTPolicy, flags(ACT, chunk_size=50, n_action_steps=50), 50


def diffusion() -> tuple[type, list[str], int]:
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    return DiffusionPolicy, flags(DIFFUSION, horizon=16, n_action_steps=8), 8


@pytest.mark.parametrize("kind", [act, diffusion])
def test_the_first_plan_is_made_from_the_first_execution_frame(
    kind: Any, lerobot_eval: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, words, interval = kind()
    watched = Watched(monkeypatch, policy)
    lerobot_eval(*words, "--env.prompt_in=reset")
    records = read_episodes(tmp_path)
    assert [(record["prompt_steps"], record["steps"]) for record in records] == [(steps, HORIZON) for steps in PROMPTS]
    assert [record["prompt_shown"] for record in records] == [True, True]
    phases, steps, _ = watched.plans[0]
    assert phases == [EXECUTION, EXECUTION]
    assert steps == [0, 0], "the clock of the execution, whatever the prompts took"
    for row, seed in enumerate((7, 8)):
        planned = np.concatenate([actions[row, :interval] for _, _, actions in watched.plans])[:HORIZON]
        np.testing.assert_array_equal(np.stack(watched.applied[seed]), planned)  # none of them is stale
    assert protocol_of(tmp_path)["prompt_in"] == "reset"


def test_a_policy_that_reads_prompts_is_shown_them(
    lerobot_eval: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_memobench.policies.baselines.modeling_baselines import MemobenchExpertPolicy

    seen: list[list[int]] = []
    select = MemobenchExpertPolicy.select_action

    def selected(this: Any, batch: Any, **options: Any) -> Any:
        seen.append(batch["observation.phase"].flatten().int().tolist())
        return select(this, batch, **options)

    monkeypatch.setattr(MemobenchExpertPolicy, "select_action", selected)
    nothing_drawn = "--env.obs_type=environment_state_agent_pos"
    lerobot_eval("--policy.type=memobench_expert", "--env.expert_action=true", "--env.horizon=2", nothing_drawn)
    assert [sum(row == PROMPT for row in rows) for rows in zip(*seen, strict=True)] == PROMPTS
    assert protocol_of(tmp_path)["prompt_in"] == "steps"
