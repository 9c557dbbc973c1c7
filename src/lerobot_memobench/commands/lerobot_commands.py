"""LeRobot's own commands: list them, run one, and prepare the benchmark's environment on its command line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot.configs import PreTrainedConfig

    from lerobot_memobench.envs.evaluation_file import Acting

PREFIX = "lerobot-"


def lerobot_commands() -> dict[str, metadata.EntryPoint]:
    """Return name -> entry point of every command of the installed LeRobot (``eval``: ``lerobot-eval``)."""
    return {
        entry.name.removeprefix(PREFIX): entry
        for entry in metadata.distribution("lerobot").entry_points
        if entry.group == "console_scripts" and entry.name.startswith(PREFIX)
    }


def load_command(name: str) -> Callable[[], Any]:
    """Return the main function of a LeRobot command, which reads ``sys.argv``. The import takes many seconds.

    Raises:
        MemobenchError: LeRobot was installed without the extra that the command needs.
    """
    try:
        entry: Callable[[], Any] = lerobot_commands()[name].load()
    except ImportError as error:
        raise MemobenchError(f"{PREFIX}{name} needs a package that is not installed: {error}") from error
    return entry


def call_lerobot(command: str, flags: Sequence[str]) -> int:
    """Run ``lerobot-<command>`` with these flags; return its exit status. Its main function reads ``sys.argv``."""
    entry = load_command(command)
    before = sys.argv
    sys.argv = [f"{PREFIX}{command}", *flags]
    try:
        status = entry()
    except SystemExit as stop:
        status = stop.code
    finally:
        sys.argv = before
    if status is None or isinstance(status, int):
        return status or 0
    print(status, file=sys.stderr)  # as Python does with such a status
    return 1


def prepare_lerobots_command(environment: Any) -> tuple[PreTrainedConfig | None, Acting]:
    """Return the policy on the command line of ``lerobot-eval`` or ``lerobot-train``, and its description for the log.

    The configuration is None elsewhere; the description is known in evaluations. Set the convention for the checkpoint
    of an evaluation; a training may begin with any.

    Raises:
        MemobenchError: as of `chosen_convention` and `check_obs_type`; or LeRobot's command would run the policy in
            LIBERO's pipelines.
    """
    from lerobot_memobench.commands.command_line import PATH, parse_words, read_words
    from lerobot_memobench.envs.evaluation_file import UNKNOWN_POLICY
    from lerobot_memobench.envs.observations import check_obs_type, policy_features, policy_names
    from lerobot_memobench.policies.checkpoint import acting
    from lerobot_memobench.policies.compatibility import check_actions, chosen_convention
    from lerobot_memobench.sim.convention import MIRRORED

    name = Path(sys.argv[0]).name.replace("_", "-")  # `lerobot-eval`, or `lerobot_eval.py` of `python -m`
    command = next((choice for choice in ("train", "eval") if name.startswith(f"{PREFIX}{choice}")), None)
    if command is None:
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
        names = {"features": policy_features(), "features_map": policy_names()}
        vars(environment).update(vars(replace(environment, **names, convention=convention)))
    return policy, acting(policy, path, environment.settings)
