"""What a policy server answers, as actions of this environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.dialects import RLDS

ACTION_SIZE = 7


def read_actions(answer: Mapping[str, Any], config: RemoteConfig, address: str) -> NDArray[np.float32]:
    """Return the actions (H, 7) in an answer, their gripper in the environment's terms.

    One that is not finite is passed on: the environment ends the episode with it, and the others go on.

    Raises:
        MemobenchError: there are none, too few for a plan, or something else.
    """
    actions = _numbers(answer, address)
    if len(actions) < config.n_action_steps:
        raise MemobenchError(
            f"the policy server at {address} answers {len(actions)} actions at a time, fewer than the "
            f"{config.n_action_steps} to be executed; choose replan={len(actions)} or less"
        )
    if (config.gripper or config.spoken.gripper) == RLDS:
        gripper = actions[:, -1]
        actions[:, -1] = np.where(np.isfinite(gripper), -np.sign(2 * gripper - 1), gripper)
    return actions


def _numbers(answer: Mapping[str, Any], address: str) -> NDArray[np.float32]:
    if "actions" not in answer:
        raise _wrong(address, f"an answer without 'actions' (it holds {', '.join(map(str, answer)) or 'nothing'})")
    try:
        actions = np.array(answer["actions"], dtype=np.float32, ndmin=2)
    except (TypeError, ValueError) as error:
        raise _wrong(address, "actions that are no numbers") from error
    if actions.ndim != 2 or actions.shape[1] != ACTION_SIZE:
        raise _wrong(address, f"actions of shape {actions.shape}")
    return actions


def _wrong(address: str, what: str) -> MemobenchError:
    return MemobenchError(
        f"the policy server at {address} gave {what}; expected finite numbers of shape "
        f"(steps, {ACTION_SIZE}): six of the end effector's displacement and one of the gripper"
    )
