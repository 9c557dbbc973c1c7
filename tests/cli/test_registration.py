"""LeRobot knows the plugin's configurations, whichever is imported first, and importing them stays light."""

from __future__ import annotations

import subprocess
import sys

import pytest

KNOWN = """
import sys
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
assert "memobench" in EnvConfig.get_known_choices()
policies = {"memobench_mem", "memobench_expert", "memobench_random", "memobench_remote"}
assert policies <= set(PreTrainedConfig.get_known_choices())
heavy = {"mujoco", "robosuite"} & set(sys.modules)
assert not heavy, heavy
models = [name for name in sys.modules if "memobench" in name and "modeling" in name]
assert not models, models
"""


FIRST = ["import lerobot.scripts.lerobot_eval as s; s.register_third_party_plugins()"]
#: LeRobot's import takes many seconds, so the rest is left to `-m slow`.
MORE = [
    "import lerobot_policy_memobench",
    "import lerobot_policy_memobench, lerobot.policies, lerobot.envs",
    "import lerobot.envs, lerobot.policies, lerobot_policy_memobench",
    "import lerobot_memobench.registration",
]


@pytest.mark.parametrize("first", [*FIRST, *(pytest.param(more, marks=pytest.mark.slow) for more in MORE)])
def test_configurations_are_registered(first: str) -> None:
    done = subprocess.run([sys.executable, "-c", first + "\n" + KNOWN], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = (
        "import sys, lerobot_memobench; heavy = {'lerobot', 'torch', 'mujoco'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
