"""Register the environment ``memobench`` and the policies ``memobench_*`` with LeRobot, and check its own commands.

Importing the module of a configuration registers it, without loading the simulator or a model.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import lerobot_memobench.policies.baselines
import lerobot_memobench.policies.memobench_mem.configuration_memobench_mem
import lerobot_memobench.policies.remote  # noqa: F401
from lerobot_memobench.envs.evaluation_file import UNKNOWN_POLICY, Acting
from lerobot_memobench.envs.lerobot import MemobenchEnvConfig, lerobots_command
from lerobot_memobench.envs.observations import check_obs_type, policy_features, policy_names
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.convention import MIRRORED

if TYPE_CHECKING:
    from lerobot.configs import PreTrainedConfig


def prepare_lerobots_command(environment: MemobenchEnvConfig) -> tuple[PreTrainedConfig | None, Acting]:
    """Return the policy on the command line of ``lerobot-eval`` or ``lerobot-train``, and its description for the log.

    The configuration is None elsewhere; the description is known in evaluations. Set the convention for the checkpoint
    of an evaluation; a training may begin with any.
    """
    from lerobot_memobench.commands.command_line import PATH, parse_words, read_words
    from lerobot_memobench.policies.checkpoint import acting
    from lerobot_memobench.policies.compatibility import check_actions, chosen_convention

    if (command := lerobots_command()) is None:
        return None, UNKNOWN_POLICY
    requested = read_words(command, parse_words(sys.argv[1:]))
    policy: PreTrainedConfig | None = requested.build_field("policy")
    path = requested.get(f"policy.{PATH}")
    if command == "train" or policy is None:
        return policy, UNKNOWN_POLICY
    check_obs_type(policy, environment.obs_type, environment.suite)
    if path is None:
        return policy, acting(policy, None, environment.settings)
    check_actions(path, policy)
    if policy.type == "xvla":
        raise MemobenchError(
            "lerobot-eval runs every XVLA with the processors of LIBERO, which mirror an image and convert actions; "
            f"run `lerobot eval env=memobench policy={path}`"
        )
    stated = requested.get("env.convention") or (MIRRORED if environment.camera_name_mapping else None)
    renamed = requested.build_field("rename_map") or {}
    convention = chosen_convention(path, policy, stated, renamed)
    if convention not in (None, environment.convention):  # with the names of its images
        changes: dict[str, Any] = {"features": policy_features(), "features_map": policy_names()}
        changes["convention"] = convention
        environment.__dict__.update(vars(replace(environment, **changes)))
    return policy, acting(policy, path, environment.settings)


MemobenchEnvConfig.check_policy = prepare_lerobots_command
