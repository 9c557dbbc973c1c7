"""Repeat the evaluation that a card describes and compare every episode.

A card is data that anybody may have written, and its settings decide which packages are imported and which files are
read. So only known settings are accepted. None of them may name code, a folder to write to or another machine; files to
read are those of this machine. Numbers have limits, and the log must hold the outcome of every episode.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from draccus.utils import is_enum, is_literal, is_union
from lerobot.configs import PreTrainedConfig

from lerobot_memobench.commands.command_line import (
    NULLS,
    PLAIN,
    chosen_class,
    field_types,
    load_plugins,
    value_of,
    without_none,
)
from lerobot_memobench.constants import HORIZON, SEALED
from lerobot_memobench.envs.episode_log import key_of, read_log
from lerobot_memobench.envs.evaluation_file import MOST_EPISODES, differences, read_evaluation
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.records import SCENES, disagreements, other_hashes
from lerobot_memobench.policies.checkpoint import checkpoint_files, has_device, local_folder, tree_hash
from lerobot_memobench.rollouts.card import PACKAGES, detector_hash, versions
from lerobot_memobench.rollouts.plan import (
    ENVIRONMENT,
    OWN,
    EvaluationPlan,
    EvaluationSettings,
    RunOptions,
    Shard,
    card_settings,
    make_plan,
)
from lerobot_memobench.untrusted import Malformed, checked, parsed

MOST_STEPS = 400 * HORIZON
"""Most control steps of an episode with its pauses and holds; those of a strict one may take 180,000."""
MOST = {"horizon": 10 * HORIZON, "videos": MOST_EPISODES}
"""Setting of the environment -> its largest number."""
REACHING_OUT = ("push_to_hub", "private", "use_peft", "trust_remote_code", "discover_packages_path")
"""Settings of a policy that change more than numbers. All other numbers and truth values are accepted."""
SERVERS = ("host", "servers")
WORD = re.compile(r"[\w.,+' ()-]*")  # no slash, which paths and names of repositories have
DEVICE = re.compile(r"cpu|mps|(cuda|xpu)(:\d{1,3})?")
_SERVER = r"\s*(?:\w+://)?(?:127\.0\.0\.1|localhost)(?::\d+)?\s*"
HERE = re.compile(f"{_SERVER}(?:,{_SERVER})*")
OBSERVATION = re.compile(r"[\w./-]+")


def repeat(
    path: Path,
    out: Path | None,
    server: str | None,
    evaluate: Callable[[EvaluationPlan], int],
    say: Callable[[str], None],
) -> int:
    """Repeat the evaluation of a card and compare every episode; return 1 where one ended differently.

    Args:
        path, server: see `read_repeatable`. out: folder of the repetition, a dated one when None.
        evaluate: runs the plan and returns its exit status.
        say: called with differences of this machine, and with the result.
    """
    card, settings = read_repeatable(path, server)
    check_policy(card, settings.policy.get("path"))
    for note in differences_here(card):
        say(f"note: {note}")
    plan = plan_of_evaluation(card, settings, out)
    here = plan.environment.settings.protocol_block
    if changes := differences(card["protocol"], here):
        start = card["runs"][-1]
        raise MemobenchError(
            f"another version ran the card ({'; '.join(changes)}, there and here); repeat it with that version "
            f"({start['versions'].get(PACKAGES[0], 'not known')}, commit {start['git_commit'] or 'not known'})"
        )
    episodes = read_log(path if path.is_dir() else path.parent)
    check_extent(card, episodes, plan)
    for note in (hashed := other_hashes(card["protocol"], here)):
        say(f"note: {note}")
    if status := evaluate(plan):
        return status
    problems = disagreements(episodes, read_log(plan.log), "there", "here", [SCENES] if hashed else [])
    if not problems:
        say(f"repeated: {count_of(len(episodes), 'episode')}, as in the log")
        return 0
    say(f"not repeated: {problems[0]}")
    return 1


def read_repeatable(path: Path, server: str | None = None) -> tuple[dict[str, Any], EvaluationSettings]:
    """Return the card in a file or a folder, and its settings, checked by `allowed_settings`.

    ``server``: address of the policy's server (``host:port``, or several with commas); the card's when None.
    """
    card = read_evaluation(path, whole=True)
    return card, allowed_settings(card_settings(card), server)


def plan_of_evaluation(
    card: Mapping[str, Any], settings: EvaluationSettings, out: Path | None = None
) -> EvaluationPlan:
    """Return the plan of a card's evaluation, to be run in ``out``, or in a folder of the present time."""
    out = out or Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_rerun"
    shard = None if card["shard"] is None else Shard.parse(card["shard"])
    options = RunOptions(split=SEALED if settings.env.get("salt") else None, shard=shard)
    return make_plan(replace(settings, output_dir=str(out)), options, ("memobench", "rerun"))


# --- whether this machine and version can repeat it ---


def check_extent(card: Mapping[str, Any], episodes: Sequence[Mapping[str, Any]], plan: EvaluationPlan) -> None:
    """Refuse a card whose settings run other episodes than it names and logs, or whose episodes may take too long."""
    protocol, grid = card["protocol"], plan.grid
    tasks = sorted(task.name for task in grid.tasks)
    if (tasks, grid.runs) != (sorted(protocol["tasks"]), protocol["episodes"]):
        raise MemobenchError(
            f"the card's settings run {grid.runs} episodes of {len(tasks)} tasks, and its protocol names "
            f"{protocol['episodes']} of {len(protocol['tasks'])}; expected a card of `lerobot eval`"
        )
    most = longest(plan.environment.settings) + plan.environment.settings.longest_interference
    if most > MOST_STEPS:
        raise MemobenchError(
            f"an episode of the card may take {most:,} control steps; expected at most {MOST_STEPS:,}, so run its "
            "command yourself if you trust it"
        )
    wanted = {episode for cell in grid.cells(plan.options.shard) for episode in grid.episodes(cell)}
    logged = {key_of(record) for record in episodes if "not_run" in record or "steps" in record}
    for task, episode in sorted(wanted ^ logged)[:1]:
        problem = "log lacks" if (task, episode) in wanted else "card does not ask for"
        raise MemobenchError(
            f"the {problem} {task}, episode {episode}; expected the outcome of each of the "
            f"{count_of(len(wanted), 'episode')} of the card's protocol, as of a finished evaluation"
        )


def check_policy(card: Mapping[str, Any], path: str | None) -> None:
    """Refuse to repeat an evaluation with another checkpoint or detector, or without their hashes on the card."""
    if path is None:
        return
    policy = card["policy"]
    settings = policy.get("settings", {})
    hashes = {
        f"checkpoint {path}": (tree_hash(checkpoint_files(Path(path))), policy.get("sha256")),
        f"detector {settings.get('detector')}": (detector_hash(settings), policy.get("detector_sha256")),
    }
    for name, (here, stored) in hashes.items():
        if here != stored:
            raise MemobenchError(
                f"the {name} is not the one on the card (sha256 {str(here)[:12]} here, {str(stored)[:12]} on the "
                "card); the results would be those of another policy"
            )


def differences_here(card: Mapping[str, Any]) -> list[str]:
    """Return the differences between this machine and those of a card's runs."""
    here, notes = versions(), dict[str, None]()  # without repetitions
    for run in card["runs"]:
        used = run["versions"].items()
        changed = [f"{name} {there} (here {here[name]})" for name, there in used if here.get(name, there) != there]
        if changed:
            notes[f"the card's run used {', '.join(changed)}; results may depend on it"] = None
    return [*notes]


# --- settings that a card may hold ---


def allowed_settings(settings: EvaluationSettings, server: str | None = None) -> EvaluationSettings:
    """Return a card's settings, checked, with the policy's checkpoint by its folder, and its server if one is given."""
    if not all(OBSERVATION.fullmatch(name) for pair in settings.rename_map.items() for name in pair):
        raise _refused("rename_map", settings.rename_map, "expected names of observations")
    for name, value in settings.env.items():
        if name not in ENVIRONMENT or name in ("task", "task_ids", "log_dir", "resume"):
            raise _refused(f"env.{name}", value, "no card sets it")
        if name == "tasks" and not (isinstance(value, str) and WORD.fullmatch(value)):
            raise _refused("env.tasks", value, "expected names of tasks")
        if name == "task_dir" and value is not None and not (isinstance(value, str) and Path(value).is_dir()):
            raise _refused("env.task_dir", value, "expected a folder on this machine")
        if name in MOST and isinstance(value, int) and value > MOST[name]:
            raise _refused(f"env.{name}", value, f"expected at most {MOST[name]:,}")
    EnvSettings(**{name: value for name, value in settings.env.items() if name not in OWN})
    return replace(settings, policy=_allowed_policy(dict(settings.policy), server))


def _allowed_policy(policy: dict[str, Any], server: str | None) -> dict[str, Any]:
    """Return the settings of a card's policy, checked; its checkpoint is a folder here, without a download."""
    for name in ("path", "type"):
        if not isinstance(value := policy.get(name), str | None):
            raise _refused(f"policy.{name}", value, "expected a name")
    if (path := policy.get("path")) is not None:
        try:
            folder = local_folder(path)
        except (ValueError, RuntimeError, OSError):  # neither a path nor a repository
            folder = None
        if folder is None:
            raise MemobenchError(f"the checkpoint {path[:80]!r} (policy.path) is not on this machine; copy it there")
        policy["path"] = str(folder.absolute())
    if server is not None:
        if policy.get("type") != "memobench_remote":
            raise MemobenchError(f"--server {server} needs a card of policy.type=memobench_remote")
        policy = {name: value for name, value in policy.items() if name not in (*SERVERS, "port")}
    load_plugins()
    chosen = chosen_class(PreTrainedConfig, "policy", policy)
    known = {} if chosen is None else field_types(chosen)
    for name, value in policy.items():
        if name not in ("path", "type"):
            policy[name] = _checked(known, name, value)
    if not has_device(policy.get("device", "cpu")):
        del policy["device"]  # a result does not depend on it
    return policy if server is None else {**policy, "servers": server}


def _checked(known: Mapping[str, Any], name: str, value: Any) -> Any:
    """Return a value of a policy's setting as LeRobot reads it, if it stays on this machine."""
    key = f"policy.{name}"
    if name not in known:
        raise _refused(key, value, "the policy has no such setting")
    if name in TEXTS:
        accepts, expected = TEXTS[name]
        if not accepts(str(value)):
            raise _refused(key, value, f"expected {expected}")
        return value
    if name in REACHING_OUT:
        raise _refused(key, value, "no card sets it")
    if value is None or value in (*NULLS, "none", "None"):
        return None
    parts = typing.get_args(known[name]) if is_union(known[name]) else (known[name],)
    kind = without_none(known[name])
    if dataclasses.is_dataclass(kind) or typing.get_origin(kind) is dict:
        raise _refused(key, value, "no card sets it")
    if any(part in (str, Path, Any, object) for part in parts):
        raise _refused(key, value, "it may name a file or a repository")
    if not (kind in PLAIN or is_enum(kind) or is_literal(kind)):
        try:
            numbers = parsed(value) if isinstance(value, str) else value
            checked(numbers, bool | float | list[bool | float | list[bool | float]])
        except Malformed:
            raise _refused(key, value, "expected numbers") from None
    return value_of(key, known[name], value)


def _is_device_here(text: str) -> bool:
    import torch

    match = DEVICE.fullmatch(text)
    return match is not None and int((match[2] or ":0")[1:]) < max(1, torch.cuda.device_count())


WORDS = ("size", "perception", "align", "subgoal_level", "memory_fusion", "memory_camera", "detector", "dtype")
TEXTS: dict[str, tuple[Callable[[str], Any], str]] = {
    **dict.fromkeys((*WORDS, "dialect", "gripper"), (WORD.fullmatch, "words")),
    **dict.fromkeys(("label", "keys"), (str.isprintable, "a line of text")),
    **dict.fromkeys(SERVERS, (HERE.fullmatch, "this machine (127.0.0.1); name a server that you trust by --server")),
    "device": (_is_device_here, "cpu, mps, cuda or cuda:<number of a GPU that is here>"),
}
"""Text setting of a policy -> the check of its value, and the expected values."""


def _refused(key: str, value: Any, why: str) -> MemobenchError:
    return MemobenchError(f"the card sets {key}={str(value)[:80]!r}: {why}; run its command yourself if you trust it")
