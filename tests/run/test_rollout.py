"""The loop over steps that spares pictures: the same episodes as LeRobot's, action for action, with fewer pictures."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.envs import make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_eval
from numpy.typing import NDArray

from lerobot_memobench.envs import episode
from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import read_evaluation
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memory_reads import ReadLog, find_reads
from lerobot_memobench.run.rollout import Actor, roll
from lerobot_memobench.sim.object_layout import SIZE

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
    """The step of each observation whose pictures are drawn."""
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
    reads: ReadLog | None = None,
    **fields: Any,
) -> NDArray[np.float32]:
    """Return the actions (rows, steps, 7) of a fresh policy in fresh environments, by LeRobot's loop or ours."""
    torch.manual_seed(7)
    config = MemobenchEnvConfig(
        tasks=HIGHLIGHT,
        horizon=HORIZON,
        render="fast",
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
            with nullcontext() if reads is None else reads.noting(HIGHLIGHT, policy, seeds) as ended:
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
    "random": ("memobench_random", {}, [0, FIRST, LAST]),
    "memory": ("memobench_mem", MEMORY, list(range(LAST + 1))),
    "memory of every fourth": ("memobench_mem", {**MEMORY, "memory_stride": 4}, [0, 4, FIRST, 8, 10, 12, 14, LAST]),
    "no memory": ("memobench_mem", WITHOUT, [0, FIRST, 10, 14, LAST]),
}


def logged(folder: Path) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "wall_s"} for line in read_episodes(folder)]


@pytest.mark.parametrize("rows", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("case", [*CASES, "act"])
def test_a_rollout_is_lerobots(case: str, rows: int, drawn: list[int], tmp_path: Path) -> None:
    name, fields, looked = CASES.get(case, ("act", ACT, []))
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
    else:  # whether it sees the prompt is the environment's to say
        assert len(drawn) < everything


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The step of each observation whose objects are looked for."""
    steps: list[int] = []
    look = episode.Episode.objects

    def objects(self: episode.Episode) -> Any:
        steps.append(self.step_index)
        return look(self)

    monkeypatch.setattr(episode.Episode, "objects", objects)
    return steps


DIFFUSION = {"down_dims": (16, 32), "num_inference_steps": 2, "horizon": 8, "n_groups": 4, "n_action_steps": PLAN}
DIFFUSION |= {"diffusion_step_embed_dim": 16, "crop_shape": (84, 84), "pretrained_backbone_weights": None}


@pytest.mark.parametrize(
    ("name", "fields", "spares", "obs_type"),
    [
        ("act", ACT, True, BOTH),
        ("diffusion", DIFFUSION, False, OBJECTS),
        ("memobench_expert", {}, True, OBJECTS),
        ("memobench_random", {}, True, BOTH),
    ],
)
def test_a_rollout_on_objects_is_lerobots(
    name: str, fields: dict[str, Any], spares: bool, obs_type: str, drawn: list[int], found: list[int], tmp_path: Path
) -> None:
    theirs = rolled(True, 2, tmp_path / "theirs", name, obs_type=obs_type, **fields)
    everything = 2 * (theirs.shape[1] + 1)
    assert len(found) == everything
    assert len(drawn) == (0 if obs_type == OBJECTS else everything)
    found.clear()
    ours = rolled(False, 2, tmp_path / "ours", name, obs_type=obs_type, **fields)
    np.testing.assert_array_equal(ours, theirs)
    assert theirs.any()
    assert (len(found) < everything) == spares


def test_a_memory_of_pictures_refuses_to_be_shown_objects_alone(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"no picture, .* set env.obs_type=pixels_agent_pos, or"):
        rolled(False, 1, tmp_path, "memobench_mem", obs_type=OBJECTS, **MEMORY)


@pytest.mark.parametrize("use_async", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_nobody_watches_is_not_drawn(use_async: bool, tmp_path: Path) -> None:
    """By the word of a vector environment, in this process or in workers, until the next reset."""
    config = MemobenchEnvConfig(tasks=HIGHLIGHT, demonstration_prompt=False, render="fast", log_dir=str(tmp_path))
    ((env,),) = (suite.values() for suite in config.create_envs(2, use_async).values())
    move = np.full((2, 7), 0.7, np.float32)
    try:
        for _ in range(2):
            first = env.reset(seed=[7, 8], options={lerobot_eval.NEW_ROLLOUT_OPTION: True})[0]["pixels"]["wrist_image"]
            seen = env.step(move)[0]["pixels"]["wrist_image"].copy()
            assert (seen != first).any()
            env.call("need_observation", False)
            np.testing.assert_array_equal(env.step(move)[0]["pixels"]["wrist_image"], seen)
            env.call("need_observation", True)
            assert (env.step(move)[0]["pixels"]["wrist_image"] != seen).any()
            env.call("need_observation", False)
    finally:
        env.close()


def test_a_recorded_episode_is_drawn_whole(drawn: list[int], tmp_path: Path) -> None:
    """Two of three episodes are recorded, whoever needs frames."""
    from lerobot_memobench.envs.video import LAST_FRAMES
    from lerobot_memobench.evaluation.html.write import frame_count

    rolled(False, 3, tmp_path, "memobench_random", videos=2)
    recorded = sorted((tmp_path / "videos").iterdir())
    assert [video.name for video in recorded] == [f"{HIGHLIGHT}.0.mp4", f"{HIGHLIGHT}.1.mp4"]
    assert {frame_count(video) for video in recorded} == {LAST + 1 + LAST_FRAMES}
    assert len(drawn) == 2 * (LAST + 1) + 3


def test_the_command_draws_and_records_no_more_than_asked(drawn: list[int], tmp_path: Path) -> None:
    from lerobot_memobench.cli.lerobot import main

    words = [f"tasks={HIGHLIGHT}", "episodes=2", "batch_size=1", f"horizon={HORIZON}", "env.render=fast", "videos=1"]
    assert main(["eval", "env=memobench", *words, f"output_dir={tmp_path}"]) == 0
    assert [path.relative_to(tmp_path / "videos") for path in (tmp_path / "videos").rglob("*")] == [
        Path(f"{HIGHLIGHT}.0.mp4")
    ]
    assert len(drawn) == LAST + 1 + 3


def test_what_chunks_read_is_noted_as_each_episode_ends(tmp_path: Path) -> None:
    name, fields, _ = CASES["memory of every fourth"]
    plain = rolled(False, 2, tmp_path / "plain", name, **fields)
    noted = rolled(False, 2, tmp_path / "noted", name, reads=ReadLog(tmp_path / "noted", 7, "fixed"), **fields)
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


def test_the_default_batch_of_an_object_policy_changes_no_episode(tmp_path: Path) -> None:
    """Ten rows in one process by default, or as many as there are episodes; each row acts as it would alone."""
    from lerobot_memobench.cli.lerobot import main

    words = ["policy=memobench_small", f"tasks={STOVE},{HIGHLIGHT}", "episodes=2", "horizon=80", "device=cpu"]
    for name, more in (("default", []), ("alone", ["batch_size=1"])):
        assert main(["eval", "env=memobench", *words, *more, f"output_dir={tmp_path / name}"]) == 0
    sizes = [read_evaluation(tmp_path / name)["runs"][0]["batch_size"] for name in ("default", "alone")]
    assert sizes == [2, 1]
    own = {"wall_s", "run"}
    default, alone = (
        [{key: value for key, value in line.items() if key not in own} for line in read_episodes(tmp_path / name)]
        for name in ("default", "alone")
    )
    assert default == alone
    assert len(default) == 4
