"""Policies that know nothing of phases plan from the first execution frame on, also under LeRobot's own command."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.envs.episode_log import read_episodes, read_protocol_file
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.run.lerobot_commands import call_lerobot

MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
PROMPTS = [147, 165]
"""Steps of the prompt in the episodes of seeds 7 and 8."""
HORIZON = 20

ACT = [
    *("--policy.type=act", "--policy.pretrained_backbone_weights=null", "--policy.dim_model=32", "--policy.n_heads=2"),
    *("--policy.dim_feedforward=64", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1"),
    *("--policy.chunk_size=50", "--policy.n_action_steps=50", "--policy.latent_dim=8"),
]
DIFFUSION = [
    *("--policy.type=diffusion", "--policy.down_dims=[16,32]", "--policy.num_inference_steps=2", "--policy.horizon=16"),
    *("--policy.diffusion_step_embed_dim=16", "--policy.n_groups=4", "--policy.n_action_steps=8"),
    *("--policy.pretrained_backbone_weights=null", "--policy.crop_shape=[84,84]"),
    "--policy.spatial_softmax_num_keypoints=8",
]


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
def lerobot_eval(gl: str, tmp_path: Path) -> Any:
    """Two episodes with prompts of different lengths in one batch, by LeRobot's own command."""
    import lerobot_policy_memobench  # noqa: F401 - as LeRobot finds it

    def run(*policy: str) -> None:
        line = [
            *("--env.type=memobench", f"--env.tasks={MILK}", f"--env.horizon={HORIZON}", "--env.render=fast"),
            *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", "--seed=7"),
            *("--policy.device=cpu", f"--output_dir={tmp_path}"),
        ]
        assert call_lerobot("eval", [*line, *policy]) == 0

    return run


def act() -> tuple[type, list[str], int]:
    from lerobot.policies.act.modeling_act import ACTPolicy

    return ACTPolicy, ACT, 50


def diffusion() -> tuple[type, list[str], int]:
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    return DiffusionPolicy, DIFFUSION, 8


@pytest.mark.parametrize("kind", [act, diffusion])
def test_the_first_plan_is_made_from_the_first_execution_frame(
    kind: Any, lerobot_eval: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, flags, interval = kind()
    watched = Watched(monkeypatch, policy)
    lerobot_eval(*flags)
    records = read_episodes(tmp_path)
    assert [(record["prompt_steps"], record["steps"]) for record in records] == [(steps, HORIZON) for steps in PROMPTS]
    assert [record["prompt_shown"] for record in records] == [True, True]
    phases, steps, _ = watched.plans[0]
    assert phases == [EXECUTION, EXECUTION]
    assert steps == [0, 0], "the clock of the execution, whatever the prompts took"
    for row, seed in enumerate((7, 8)):
        planned = np.concatenate([actions[row, :interval] for _, _, actions in watched.plans])[:HORIZON]
        np.testing.assert_array_equal(np.stack(watched.applied[seed]), planned)  # none of them is stale
    assert read_protocol_file(tmp_path)["prompt_in"] == "reset"


def test_a_policy_that_knows_phases_sees_the_prompt(
    lerobot_eval: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_memobench.policies.baselines.modeling_baselines import MemobenchExpertPolicy

    seen: list[list[int]] = []
    select = MemobenchExpertPolicy.select_action

    def selected(this: Any, batch: Any, **options: Any) -> Any:
        seen.append(batch["observation.phase"].flatten().int().tolist())
        return select(this, batch, **options)

    monkeypatch.setattr(MemobenchExpertPolicy, "select_action", selected)
    lerobot_eval("--policy.type=memobench_expert", "--env.expert_action=true", "--env.horizon=2")
    assert [sum(row == PROMPT for row in rows) for rows in zip(*seen, strict=True)] == PROMPTS
    assert read_protocol_file(tmp_path)["prompt_in"] == "steps"


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (["--policy.type=act"], "reset"),
        (["--policy.type", "memobench_mem"], "steps"),
        (["--policy.type=remote"], "steps"),
        (["--policy.type=memobench_random"], "reset"),
        (["--policy.path=checkpoint"], "reset"),
        (["--config_path=train.yaml"], "reset"),
        (["--config_path=run"], "steps"),
        ([], "steps"),
    ],
)
def test_auto_is_by_the_policy_that_lerobot_runs(
    line: list[str], found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import lerobot_policy_memobench  # noqa: F401
    from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig

    monkeypatch.chdir(tmp_path)
    for folder in ("checkpoint", "run"):
        Path(folder).mkdir()
    Path("checkpoint/config.json").write_text('{"type": "act", "device": "cpu"}')
    Path("train.yaml").write_text("policy:\n  type: diffusion\n")
    Path("run/train_config.json").write_text('{"policy": {"type": "memobench_mem"}}')
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *line])
    assert MemobenchEnvConfig().resolved_prompt_in() == found
    assert MemobenchEnvConfig(prompt_in="steps").resolved_prompt_in() == "steps"
