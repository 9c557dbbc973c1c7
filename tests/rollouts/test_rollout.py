"""The rollout loop: LeRobot's episodes, action for action, with fewer images; and the seeds of batches."""

from __future__ import annotations

import random
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.envs import make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from lerobot.scripts import lerobot_eval
from numpy.typing import NDArray

from lerobot_memobench.cli.lerobot import main
from lerobot_memobench.envs import episode
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import UNKNOWN_POLICY, read_evaluation
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memory_reads import find_reads, noting_reads
from lerobot_memobench.rollouts import evaluate as evaluation
from lerobot_memobench.rollouts.rollout import Actor, BatchSeeds, batch_seed, roll
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.tasks.catalogue import task_folder

STOVE = "turn_on_the_stove_and_turn_it_off"
HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
PROMPT, HORIZON, PLAN = 6, 9, 4
STATISTICS = {
    key: {"mean": torch.full((size,), 0.1), "std": torch.full((size,), 0.7), "min": -torch.ones(size)}
    | {"max": torch.ones(size), "q01": -torch.ones(size), "q99": torch.ones(size)}
    for key, size in (("observation.state", 8), ("observation.environment_state", SIZE), ("action", 7))
}


@pytest.fixture(autouse=True)
def short_prompts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut prompt videos off after some steps."""
    monkeypatch.setattr(episode, "PROMPT_HORIZON", PROMPT)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The step of each observation whose images are drawn."""
    steps: list[int] = []
    draw = episode.Episode.images

    def images(self: episode.Episode) -> Any:
        steps.append(self.step_index)
        return draw(self)

    monkeypatch.setattr(episode.Episode, "images", images)
    return steps


def configured(name: str, config: MemobenchEnvConfig, **fields: Any) -> tuple[Any, Any]:
    """A policy with random weights and its configuration, made for the environment's features."""
    from lerobot.envs import env_to_policy_features
    from lerobot.policies.factory import get_policy_class, make_policy_config

    import lerobot_memobench.registration  # noqa: F401

    features = env_to_policy_features(config)
    settings = make_policy_config(name, device="cpu", push_to_hub=False, **fields)
    settings.output_features = {key: part for key, part in features.items() if part.type is FeatureType.ACTION}
    settings.input_features = {key: part for key, part in features.items() if key not in settings.output_features}
    torch.manual_seed(0)
    return get_policy_class(name)(settings), settings


def rolled(
    lerobots: bool,
    rows: int,
    log: Path,
    name: str,
    videos: int = 0,
    obs_type: str = PIXELS,
    reads: bool = False,
    **fields: Any,
) -> NDArray[np.float32]:
    """Return the actions (rows, steps, 7) of a fresh policy in fresh environments, by LeRobot's loop or ours."""
    torch.manual_seed(7)
    config = MemobenchEnvConfig(
        tasks=HIGHLIGHT,
        horizon=HORIZON,
        expert_action=name == "memobench_expert",
        log_dir=str(log),
        videos=videos,
        obs_type=obs_type,
    )
    ((env,),) = (suite.values() for suite in config.create_envs(rows).values())
    policy, settings = configured(name, config, **fields)
    before, after = make_pre_post_processors(settings, dataset_stats=STATISTICS)
    env_before, env_after = make_env_pre_post_processors(env_cfg=config, policy_cfg=settings)
    actions, step, seeds = [], env.step, list(range(7, 7 + rows))
    env.step = lambda action: actions.append(action.copy()) or step(action)
    try:
        if lerobots:
            processors = {"env_preprocessor": env_before, "env_postprocessor": env_after}
            processors |= {"preprocessor": before, "postprocessor": after}
            lerobot_eval.rollout(env=env, policy=policy.eval(), seeds=seeds, render_callback=None, **processors)
        else:
            actor = Actor(policy.eval(), (env_before, before), (after, env_after))
            with noting_reads(log, config.settings, HIGHLIGHT, policy, seeds) if reads else nullcontext() as ended:
                roll(env, actor, seeds, ended)
    finally:
        env.close()
    return np.stack(actions, axis=1)


ACT = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
ACT |= {"chunk_size": PLAN, "n_action_steps": PLAN, "latent_dim": 8, "pretrained_backbone_weights": None}
MEMORY = {"chunk_size": PLAN, "n_action_steps": PLAN, "num_inference_steps": 1, "memory_settings": {"frames": 4}}
FIRST, LAST = PROMPT, PROMPT + HORIZON
"""Of the execution, which are always drawn."""

WITHOUT = {key: value for key, value in MEMORY.items() if not key.startswith("memory_")} | {"memory": "none"}
CASES: dict[str, tuple[str, dict[str, Any], list[int]]] = {
    "expert": ("memobench_expert", {}, [0, FIRST, LAST]),
    "memory of every fourth": ("memobench_mem", {**MEMORY, "memory_stride": 4}, [0, 4, FIRST, 8, 10, 12, 14, LAST]),
    "no memory": ("memobench_mem", WITHOUT, [0, FIRST, 10, 14, LAST]),
}


def logged(folder: Path) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "wall_s"} for line in read_episodes(folder)]


class Watched:
    """A policy that needs no observation, and notes which it got and when its memory was corrupted."""

    def __init__(self) -> None:
        self.acted, self.processed, self.corruptions = 0, [], []

    def reset(self) -> None:
        pass

    def needs_observation(self) -> bool:
        return False

    def has_planned_action(self) -> bool:
        return True

    def process(self, inputs: dict[str, Any]) -> dict[str, Any]:
        self.processed.append(self.acted)
        return inputs

    def select_action(self, inputs: dict[str, Any]) -> torch.Tensor:
        self.acted += 1
        return torch.zeros(2, 7)

    def corrupt_memory(self, how: str, rows: list[int]) -> None:
        self.corruptions.append((how, rows, self.acted))


@pytest.mark.parametrize(
    ("settings", "at"), [({}, PROMPT), ({"reshow": True}, PROMPT), ({"corrupt_step": 3}, PROMPT + 3)]
)
def test_memory_is_corrupted_before_the_frame_is_observed(settings: dict[str, Any], at: int, tmp_path: Path) -> None:
    asked = {"corrupt": "swap", "tasks": HIGHLIGHT, "horizon": HORIZON, "obs_type": OBJECTS}
    config = MemobenchEnvConfig(**asked, **settings)
    env = config.opener(None, UNKNOWN_POLICY, tmp_path)(task_folder(HIGHLIGHT), 2, False)
    policy = Watched()
    roll(env, Actor(policy, [policy.process], (lambda action: action, dict)), [7, 8], corrupt="swap")
    env.close()
    assert policy.corruptions == [("swap", [0, 1], at)]
    assert at in policy.processed
    assert [line["corrupted"] for line in read_episodes(tmp_path)] == [True, True]


@pytest.mark.parametrize("case", [*CASES, "act"])
def test_a_rollout_equals_lerobots(case: str, drawn: list[int], tmp_path: Path) -> None:
    name, fields, looked = CASES.get(case, ("act", ACT, []))
    rows = 2
    theirs = rolled(True, rows, tmp_path / "theirs", name, **fields)
    everything = len(drawn)
    drawn.clear()
    ours = rolled(False, rows, tmp_path / "ours", name, **fields)
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(ours, theirs)
    assert theirs.any()
    assert everything == rows * (theirs.shape[1] + 1)
    assert logged(tmp_path / "ours") == logged(tmp_path / "theirs")
    if case in CASES:
        assert sorted(drawn) == sorted(rows * looked)
    else:  # the environment decides whether it observes the prompt
        assert len(drawn) < everything


DIFFUSION = {"down_dims": (16, 32), "num_inference_steps": 2, "horizon": 8, "n_groups": 4, "n_action_steps": PLAN}
DIFFUSION |= {"diffusion_step_embed_dim": 16, "crop_shape": (84, 84), "pretrained_backbone_weights": None}


@pytest.mark.parametrize(
    ("name", "fields", "obs_type"),
    [("diffusion", DIFFUSION, OBJECTS), ("memobench_expert", {}, OBJECTS), ("memobench_random", {}, BOTH)],
)
def test_a_rollout_on_objects_equals_lerobots(name: str, fields: dict[str, Any], obs_type: str, tmp_path: Path) -> None:
    theirs = rolled(True, 2, tmp_path / "theirs", name, obs_type=obs_type, **fields)
    ours = rolled(False, 2, tmp_path / "ours", name, obs_type=obs_type, **fields)
    np.testing.assert_array_equal(ours, theirs)
    assert theirs.any()


def test_a_memory_of_images_refuses_objects_alone(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"env\.obs_type=pixels_agent_pos"):
        rolled(False, 1, tmp_path, "memobench_mem", obs_type=OBJECTS, **MEMORY)


def test_recorded_episodes_are_drawn_whole(drawn: list[int], tmp_path: Path) -> None:
    """One of two episodes is recorded; of the other the needed images are drawn."""
    from lerobot_memobench.envs.video import LAST_FRAMES
    from lerobot_memobench.evaluation.html import frame_count

    words = [f"tasks={HIGHLIGHT}", "episodes=2", "batch_size=1", f"horizon={HORIZON}", "videos=1"]
    assert main(["eval", "env=memobench", *words, f"output_dir={tmp_path}"]) == 0
    (recorded,) = (tmp_path / "videos").rglob("*")
    assert recorded.name == f"{HIGHLIGHT}.0.mp4"
    assert frame_count(recorded) == LAST + 1 + LAST_FRAMES
    assert len(drawn) == LAST + 1 + 3


def test_memory_reads_are_written_as_episodes_end(tmp_path: Path) -> None:
    name, fields, _ = CASES["memory of every fourth"]
    plain = rolled(False, 2, tmp_path / "plain", name, **fields)
    noted = rolled(False, 2, tmp_path / "noted", name, reads=True, **fields)
    np.testing.assert_array_equal(noted, plain)
    records = read_episodes(tmp_path / "noted")
    found, notes = find_reads(tmp_path / "noted", records, {})
    assert notes == []
    for chunks in (found[0], found[1]):
        assert [(chunk["step"], chunk["entries"]) for chunk in chunks] == [
            (PROMPT, [0, 4]),
            (PROMPT + PLAN, [0, 4, 8]),
            (PROMPT + 2 * PLAN, [0, 4, 8, 12]),
        ]
        assert [sum(chunk["weights"]) for chunk in chunks] == pytest.approx([1, 1, 1], abs=1e-3)
    assert not (tmp_path / "plain" / "memory_reads").exists()


def test_the_batch_size_of_an_object_policy_changes_no_episode(tmp_path: Path) -> None:
    """One process with a row per episode, by default; each row acts as it would alone."""
    words = ["policy=memobench_strict", f"tasks={STOVE}", "episodes=2", "horizon=60", "device=cpu"]
    found = []
    for name, more, size in (("default", [], 2), ("alone", ["batch_size=1"], 1)):
        assert main(["eval", "env=memobench", *words, *more, f"output_dir={tmp_path / name}"]) == 0
        assert read_evaluation(tmp_path / name)["runs"][0]["batch_size"] == size
        lines = read_episodes(tmp_path / name)
        found.append([{key: value for key, value in line.items() if key not in ("wall_s", "run")} for line in lines])
    assert len(found[0]) == 2
    assert found[0] == found[1]


# --- seeds ---


def draws(first: int, history: int = 0, seed: int = 7, own: int = 0) -> list[float]:
    """Random numbers of a policy in the batch that starts at ``first``, after a history of other draws."""
    policy = SimpleNamespace(name="diffusion", _generator=torch.Generator().manual_seed(own))
    seeds = BatchSeeds(policy, seed)
    torch.manual_seed(7)
    torch.rand(history)
    for k in range(3 if history else 0):
        seeds.begin("a_task", 100 + k)
        torch.rand(1, generator=policy._generator)
    seeds.begin("a_task", first)
    return [
        torch.rand(1).item(),
        random.random(),
        np.random.rand(),  # noqa: NPY002 - LeRobot seeds it
        torch.rand(1, generator=policy._generator).item(),
    ]


def test_draws_depend_on_the_batch_alone() -> None:
    assert draws(27) == draws(27, history=5)
    assert all(a != b for a, b in zip(draws(27), draws(28), strict=True))
    assert all(a != b for a, b in zip(draws(27), draws(27, seed=8), strict=True))
    assert draws(27, own=1)[3] == draws(27, own=1, history=5)[3] != draws(27, own=2)[3]
    torch.manual_seed(7)
    BatchSeeds(SimpleNamespace(name="memobench_mem"), 7).begin("a_task", 9)  # it seeds its noise itself
    assert torch.initial_seed() == 7
    seeds = {batch_seed(7, task, first) for task in ("a", "b") for first in range(500)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_an_xvla_gets_the_environments_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's function would give it the processors of LIBERO: a turned image, no clock, six numbers of seven."""
    loaded = SimpleNamespace(config=SimpleNamespace(device="cpu"))
    monkeypatch.setattr(evaluation, "make_policy", lambda **_: SimpleNamespace(eval=lambda: loaded))
    monkeypatch.setattr(evaluation, "make_pre_post_processors", lambda **_: (None, None))
    environment = MemobenchEnvConfig()
    plan: Any = SimpleNamespace(
        policy=make_policy_config("xvla", device="cpu", action_mode="auto"),
        environment=environment,
        policy_path=None,
        settings=SimpleNamespace(rename_map={}),
    )
    actor = evaluation.load_actor(plan)
    for found, own in zip((actor.before[0], actor.after[1]), environment.get_env_processors(), strict=True):
        assert [type(step) for step in found.steps] == [type(step) for step in own.steps]  # type: ignore[attr-defined]
