"""Objects in place of pictures, or beside them: the same in every batch, drawn by nobody, refused where mixed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.envs import env_to_policy_features, preprocess_observation

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.evaluation_file import protocol_of
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.observations import check_obs_type, obs_type_of
from lerobot_memobench.envs.settings import BOTH, OBJECTS, OBS_TYPES, PIXELS
from lerobot_memobench.envs.video import LAST_FRAMES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html.write import frame_count
from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig
from lerobot_memobench.protocol import EXECUTION, PROMPT
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots

HIGHLIGHT = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
SEEDS = [20_007, 20_008, 20_009]
PICTURES = {"observation.images.image", "observation.images.wrist_image"}
STATE = "observation.environment_state"


@pytest.fixture
def blind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asks for a renderer fails."""

    def refuse(*_: object) -> None:
        raise AssertionError("something is drawn")

    for name in ("get_renderer", "get_rasterizer"):
        monkeypatch.setattr(f"lerobot_memobench.sim.simulation.{name}", refuse)


def make(name: str, obs_type: str = OBJECTS, **settings: Any) -> MemobenchEnv:
    return MemobenchEnv(name, obs_type=obs_type, **settings)


def vector(name: str, batch: int, log: Path, use_async: bool = False, **settings: Any) -> gym.vector.VectorEnv:
    config = MemobenchEnvConfig(tasks=name, log_dir=str(log), **settings)
    ((env,),) = (suite.values() for suite in config.create_envs(batch, use_async).values())
    return env


def moves(seed: int, steps: int) -> np.ndarray:
    """Actions (steps, 7) of a seed's episode, the same in every batch."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 7)).astype(np.float32)


@pytest.mark.parametrize("obs_type", OBS_TYPES)
def test_features_are_lerobots(obs_type: str) -> None:
    features = env_to_policy_features(MemobenchEnvConfig(obs_type=obs_type))
    visual = {name for name, feature in features.items() if feature.type is FeatureType.VISUAL}
    assert visual == (set() if obs_type == OBJECTS else PICTURES)
    objects = {name: feature.shape for name, feature in features.items() if feature.type is FeatureType.ENV}
    assert objects == ({} if obs_type == PIXELS else {STATE: (SIZE,)})
    assert features.keys() - visual - objects.keys() == {"action", "observation.state"}


@pytest.mark.usefixtures("blind")
def test_objects_are_those_of_the_moment_and_nothing_is_drawn() -> None:
    env = make(HIGHLIGHT, expert_action=True, horizon=4)
    observation, _ = env.reset(seed=20_007)
    look, lit = ObjectSlots(env.episode.sim), 0
    while True:
        assert env.observation_space.contains(observation)
        assert "pixels" not in observation
        np.testing.assert_array_equal(observation["environment_state"], look.observe())
        slots = observation["environment_state"].reshape(SLOTS, WIDTH)
        assert slots[:, STARTS["present"]].any()
        glows = bool(slots[:, STARTS["highlighted"]].any())
        assert not (glows and observation["phase"] == [EXECUTION])
        lit += glows
        observation, _, _, ended, _ = env.step(np.full(7, 0.3, np.float32))
        if ended:
            break
    assert lit
    env.close()


@pytest.mark.usefixtures("blind")
def test_a_prompt_within_reset_ends_with_the_objects_of_the_execution() -> None:
    shown = []
    for where in ("steps", "reset"):
        env = make(HIGHLIGHT, prompt_in=where)
        observation, _ = env.reset(seed=20_007)
        while observation["phase"] == [PROMPT]:
            observation, *_ = env.step(np.zeros(7, np.float32))
        shown.append(observation["environment_state"])
        env.close()
    np.testing.assert_array_equal(*shown)


@pytest.mark.slow  # of pictures alone it is no slow test: test_memobench_env.py
@pytest.mark.parametrize("obs_type", [OBJECTS, BOTH])
def test_batches_of_one_and_three_sync_and_async(obs_type: str, tmp_path: Path) -> None:
    def roll(env: gym.vector.VectorEnv, seeds: list[int]) -> dict[str, Any]:
        env.reset(seed=seeds)
        for plan in np.stack([moves(seed, 8) for seed in seeds], axis=1):
            observation, *_ = env.step(plan)
        seen = preprocess_observation(observation)
        assert set(seen) >= {STATE, "observation.state"} | (PICTURES if obs_type == BOTH else set())
        assert seen[STATE].shape == (len(seeds), SIZE)
        return {key: value.numpy().copy() for key, value in seen.items()}

    alone = vector(DRAWER, 1, tmp_path / "alone", obs_type=obs_type)
    rows = [roll(alone, [seed]) for seed in SEEDS]
    alone.close()
    assert (rows[0][STATE] != rows[1][STATE]).any()
    for use_async in (False, True):
        env = vector(DRAWER, len(SEEDS), tmp_path / f"{use_async}", use_async, obs_type=obs_type)
        try:
            together = roll(env, SEEDS)
        finally:
            env.close()
        assert ("observation.images.image" in together) == (obs_type == BOTH)
        for key, values in together.items():
            np.testing.assert_array_equal(values, np.concatenate([row[key] for row in rows]), err_msg=key)


@pytest.mark.usefixtures("blind")
def test_objects_that_nobody_looks_at_are_those_seen_last() -> None:
    env = make(DRAWER, horizon=5)
    env.reset(seed=20_007)
    seen = env.step(moves(1, 1)[0])[0]["environment_state"]
    env.need_observation(False)
    articulation, _ = env.episode.sim.world.articulation("wooden_cabinet_1_top_region")
    env.episode.sim.data.joint(articulation.joint).qpos[0] = articulation.open_q
    for _ in range(3):
        stale = env.step(np.ones(7, np.float32))[0]
        np.testing.assert_array_equal(stale["environment_state"], seen)
    last = env.step(np.ones(7, np.float32))[0]["environment_state"]  # the horizon: always of the present
    np.testing.assert_array_equal(last, ObjectSlots(env.episode.sim).observe())
    assert (last != seen).any()
    env.close()


def test_a_film_shows_every_step_and_other_episodes_are_not_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    images = Episode.images
    monkeypatch.setattr(Episode, "images", lambda self: drawn.append(self.step_index) or images(self))  # type: ignore[func-returns-value]
    env = make(DRAWER, log_dir=str(tmp_path), horizon=4, videos=1, seed_base=20_007, render="fast")
    for seed in (20_007, 20_008):
        env.reset(seed=seed)
        for action in moves(seed, 4):
            env.step(action)
    assert drawn == [0, 1, 2, 3, 4]
    (film,) = tmp_path.rglob("*.mp4")
    assert frame_count(film) == len(drawn) + LAST_FRAMES
    frame = env.render()  # as LeRobot's own films do it
    assert frame.shape[2] == 3
    assert frame.std() > 0
    env.render()
    assert drawn == [0, 1, 2, 3, 4, 4]
    env.close()


@pytest.mark.usefixtures("blind")
def test_phase_and_step_have_the_shape_of_a_training_batch(tmp_path: Path) -> None:
    """LeRobot loads a dataset's column of one number as (B,); through its processors a rollout's is alike."""
    env = vector(DRAWER, 2, tmp_path, obs_type=OBJECTS, horizon=1)
    observation, _ = env.reset(seed=SEEDS[:2])
    env.close()
    assert observation["step"].shape == (2, 1)
    before, _ = MemobenchEnvConfig().get_env_processors()
    batch = before(preprocess_observation(observation))
    for name, value in (("phase", EXECUTION), ("step", 0)):
        found = batch[f"observation.{name}"]
        assert (found.shape, found.dtype) == ((2,), torch.float32)
        assert found.tolist() == [value, value]


def test_one_folder_holds_one_kind_of_observations(tmp_path: Path) -> None:
    env = make(DRAWER, log_dir=str(tmp_path), horizon=1)
    env.reset(seed=20_007)
    env.step(np.zeros(7, np.float32))
    env.close()
    assert protocol_of(tmp_path)["obs_type"] == OBJECTS
    with pytest.raises(MemobenchError, match=r"another protocol \(obs_type: environment_state_agent_pos and both"):
        vector(DRAWER, 1, tmp_path, obs_type=BOTH, horizon=1, resume=True)


def policy(kind: str, *seen: FeatureType, **more: Any) -> Any:
    """What is asked of a policy's configuration."""
    images = {"observation.images.image": None} if FeatureType.VISUAL in seen else {}
    objects = True if FeatureType.ENV in seen else None
    ours = kind.startswith(("memobench", "mine"))
    made = type("Config", (SimpleNamespace,), {"__module__": "plugin" if ours else "lerobot.policies"})
    return made(type=kind, image_features=images, env_state_feature=objects, **more)


@pytest.mark.parametrize(
    ("config", "needed"),
    [
        (None, None),
        (policy("pi05"), None),  # before it has seen a dataset
        (policy("memobench_random", FeatureType.VISUAL, perception=UntrainedConfig.perception), None),
        (policy("act", FeatureType.VISUAL), PIXELS),
        (policy("act", FeatureType.ENV), OBJECTS),
        (policy("diffusion", FeatureType.ENV, FeatureType.VISUAL), BOTH),
        (policy("pi05", FeatureType.ENV, FeatureType.VISUAL), PIXELS),  # trained beside the column, which it ignores
        (policy("mine", FeatureType.ENV), OBJECTS),  # of somebody's plugin
        (policy("memobench_mem", FeatureType.ENV, FeatureType.VISUAL, perception="objects"), OBJECTS),
        (policy("memobench_mem", perception="pixels"), PIXELS),
    ],
)
def test_a_policy_is_shown_what_it_sees(config: Any, needed: str | None) -> None:
    assert obs_type_of(config) == needed
    for shown in OBS_TYPES:
        if needed is None or shown in (needed, BOTH):
            check_obs_type(config, shown)
        else:
            with pytest.raises(MemobenchError, match=rf"env.obs_type is {shown}, .* set it to .*{BOTH}"):
                check_obs_type(config, shown)
