"""Configuration, suites and features of MEMOBench, without simulation.

Skipped without the package (``pip install -e ".[memobench]"``).
"""

from __future__ import annotations

import sys

import pytest

from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins

pytest.importorskip("lerobot_policy_memobench")

TASK = "turn_on_the_stove_and_turn_it_off"


@pytest.fixture(autouse=True)
def _register_plugins() -> None:
    register_third_party_plugins()


class TestMemobenchConfig:
    def test_registered_by_name(self):
        assert "memobench" in EnvConfig.get_known_choices()
        assert make_env_config("memobench").type == "memobench"

    def test_defaults(self):
        cfg = make_env_config("memobench")
        assert (cfg.fps, cfg.tasks, cfg.suite, cfg.horizon) == (20, "all", "published", 1200)

    def test_policy_features(self):
        features = env_to_policy_features(make_env_config("memobench"))
        assert {key: tuple(feature.shape) for key, feature in features.items()} == {
            ACTION: (7,),
            OBS_STATE: (8,),
            f"{OBS_IMAGES}.image": (3, 256, 256),
            f"{OBS_IMAGES}.wrist_image": (3, 256, 256),
        }

    def test_object_observations(self):
        features = env_to_policy_features(
            make_env_config("memobench", obs_type="environment_state_agent_pos")
        )
        assert {feature.type for feature in features.values()} == {
            FeatureType.ACTION,
            FeatureType.STATE,
            FeatureType.ENV,
        }

    def test_unknown_task_is_an_error(self):
        with pytest.raises(ValueError, match="stov"):
            make_env_config("memobench", task="stov").create_envs(1)


class TestMemobenchEnvs:
    @pytest.fixture
    def envs(self, tmp_path):
        made = make_env(make_env_config("memobench", task=TASK, log_dir=str(tmp_path)), n_envs=2)
        yield made
        for tasks in made.values():
            for env in tasks.values():
                env.close()

    def test_suites_are_memory_types(self, envs):
        (suite,) = envs
        assert suite == "temporal"
        (env,) = envs[suite].values()
        assert env.num_envs == 2
        assert env.single_action_space.shape == (7,)
        assert set(env.single_observation_space["pixels"].spaces) == {"image", "wrist_image"}

    def test_attributes_of_rollouts_before_reset(self, envs):
        (env,) = envs["temporal"].values()
        assert set(env.call("task")) == {TASK}
        assert set(env.call("_max_episode_steps")) == {1200}
        assert all("stove" in text for text in env.call("task_description"))

    def test_all_tasks_without_simulation(self, tmp_path):
        before = "mujoco" in sys.modules
        made = make_env(make_env_config("memobench", log_dir=str(tmp_path)), n_envs=1)
        assert {suite: len(tasks) for suite, tasks in made.items()} == {
            "temporal": 10,
            "spatial": 10,
            "object": 5,
            "procedural": 5,
        }
        assert before or "mujoco" not in sys.modules
