"""Settings that a checkpoint or a recipe gives for its own memory, and that do not hold for another one.

LeRobot merges checkpoint, configuration file and command line before it builds a configuration, which then cannot tell
a stride that was asked for from one of another memory. The command line and the files can.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot.configs import parser

from lerobot_memobench.envs.command_line import in_file
from lerobot_memobench.policies.checkpoint import CONFIG_FILE, local_folder, read_json
from lerobot_memobench.policies.memobench_mem.memory import NONE

DEFAULT = "frames"
MEMORY_FRAMES = 32
OWN_DEFAULTS: Mapping[str, Any] = {
    "memory_stride": None,
    "memory_fusion": None,
    "memory_frames": MEMORY_FRAMES,
    "memory_phase": False,
    "memory_settings": {},
    "subgoals": None,
}
"""Field -> value by which a memory takes its own default."""


def of_another_memory(flags: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the default of each field that a command line takes from a checkpoint or recipe of another memory.

    Args:
        flags: of LeRobot, such as ``--policy.memory=bank``; None: those of this process.

    Returns:
        Field -> default, {} where the command line names no memory.
    """
    line = {name: parser.parse_arg(f"policy.{name}", flags) for name in ("memory", *OWN_DEFAULTS)}
    if line["memory"] is None:
        return {}
    file = in_file("policy", flags=flags)
    recipe = file if isinstance(file, dict) else {}
    path = parser.get_path_arg("policy", flags) or recipe.get("path")
    folder = None if path is None else local_folder(str(path))
    begun = {} if folder is None else read_json(folder / CONFIG_FILE)
    if (begun or recipe).get("type") != "memobench_mem":
        return {}
    line["memory"] = DEFAULT if line["memory"] == "null" else line["memory"]
    memory, given, others = DEFAULT, set[str](), set[str]()
    for level in (begun, recipe, line):
        said = {name for name in OWN_DEFAULTS if level.get(name) is not None}
        named = level.get("memory") or (NONE if level.get("memory_fusion") == NONE else memory)
        others = (others if named == memory else given) - said
        memory, given = str(named), given | said
    return {name: value for name, value in OWN_DEFAULTS.items() if name in others}
