"""The configurations of the policy and the environment that a command line chooses, as LeRobot will build them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from lerobot_memobench.envs.observations import OBJECTS, check_obs_type, obs_type_of
from lerobot_memobench.envs.prompting import quiet, read_rename_map
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import check_as_trained, check_checkpoint
from lerobot_memobench.policies.freshness import REFUSAL
from lerobot_memobench.policies.shown import check_features
from lerobot_memobench.run.translation import LerobotSettings

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig


def policy_config(settings: LerobotSettings) -> PreTrainedConfig | None:
    """Return the policy's configuration; None where none is chosen, or a configuration file has a say.

    Its own checks run here: an unknown ``policy.align`` is told before anything starts.

    Raises:
        MemobenchError: the checkpoint is not whole. Others come from the configuration's own checks.
    """
    path = settings.get("policy.path")
    if path is None:
        return cast("PreTrainedConfig | None", _parsed(settings, "policy"))
    check_checkpoint(path)
    if not _is_known(settings, "policy"):
        return None
    from lerobot.configs.policies import PreTrainedConfig

    with quiet():
        return PreTrainedConfig.from_pretrained(path, cli_overrides=_overrides(settings, "policy"))


def env_config(settings: LerobotSettings) -> EnvConfig | None:
    """Return the environment's configuration; None where none is chosen, or a configuration file has a say."""
    return cast("EnvConfig | None", _parsed(settings, "env"))


def check_sight(policy: PreTrainedConfig | None, environment: EnvConfig | None) -> None:
    """Refuse an environment that does not show what the policy sees, or not at each step at which it remembers it.

    Raises:
        MemobenchError: pictures or objects would be missing, or one step's picture remembered as another's.
    """
    if environment is not None and environment.type == "memobench":
        check_obs_type(policy, environment.obs_type)
    remembers_pictures = getattr(policy, "watches", False) and obs_type_of(policy) != OBJECTS
    if remembers_pictures and getattr(environment, "render_every", 1) > 1:
        raise MemobenchError(f"env.render_every is {getattr(environment, 'render_every', 1)}; {REFUSAL}")


def check_shown(settings: LerobotSettings, policy: PreTrainedConfig | None, environment: EnvConfig | None) -> None:
    """Refuse a checkpoint that is to act under other settings than it was trained for, or that sees something else.

    Raises:
        MemobenchError: it is refused.
    """
    path = settings.get("policy.path")
    if path is None or policy is None:
        return
    with quiet():
        check_as_trained(path, policy)
    if environment is None:
        return
    from lerobot.envs.utils import env_to_policy_features

    renamed = read_rename_map(settings.get("rename_map"))
    check_features(path, policy, env_to_policy_features(environment), renamed)


def _is_known(settings: LerobotSettings, key: str) -> bool:
    return key in settings.chosen and not settings.has("config_path")


def _parsed(settings: LerobotSettings, key: str) -> Any:
    import draccus
    import yaml

    if not _is_known(settings, key):
        return None
    try:
        with quiet():
            return draccus.parse(settings.chosen[key], args=_overrides(settings, key))
    except yaml.YAMLError as error:  # LeRobot reads every value as YAML
        problem = " ".join(str(error).split())
        raise MemobenchError(f"a value of {key}. cannot be read ({problem}); put it in quotes within quotes") from None


def _overrides(settings: LerobotSettings, key: str) -> list[str]:
    from lerobot.configs import parser

    return parser.get_cli_overrides(key, list(settings.flags)) or []
