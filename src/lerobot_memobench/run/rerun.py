"""Put a card to the test: run the evaluation that it describes once more and compare every episode.

A card is data, and anybody may have written it. Its flags go to LeRobot, which would import packages, run code from the
hub and read and write files by them. So only those are taken that a card of ours can hold and that name no code, no
place to write to, no machine but this one, and of places to read from only folders that are here. Anything else is
refused by name. So is more than `MOST` of something, and a card that does not name the outcome of every episode.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import re
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from draccus.utils import is_enum, is_literal, is_union

from lerobot_memobench.envs.episode_log import (
    MOST_EPISODES,
    UNTOLD,
    differences,
    read_log,
    read_protocol_file,
    revision,
)
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import disagreements
from lerobot_memobench.evaluation.records import CARD_FILE, read_card
from lerobot_memobench.io import count_of
from lerobot_memobench.policies.checkpoint import local_folder
from lerobot_memobench.protocol import HORIZON, SEALED
from lerobot_memobench.run.arguments import PLAIN, checked_value, chosen_class, flag_value, setting_type, without_none
from lerobot_memobench.run.arguments import settings as settings_of
from lerobot_memobench.run.card import checkpoint_files, detector_hash, drawn_otherwise, tree_hash
from lerobot_memobench.run.lerobot_commands import config_class, load_command, register_plugins
from lerobot_memobench.run.machine import PACKAGES, drawn_with, versions
from lerobot_memobench.run.plan import ENVIRONMENT, EvaluationPlan, plan_line
from lerobot_memobench.tasks.task import PUBLISHED

ENV, POLICY_TYPE, POLICY_PATH, TASK_DIR = "env.type", "policy.type", "policy.path", "env.task_dir"

REACHING_OUT = (
    "push_to_hub",
    "private",
    "recording_private",
    "use_peft",
    "trust_remote_code",
    "discover_packages_path",
)
"""Settings by which more than numbers changes. All other numbers and truth values are taken."""
WORDS = (
    *("job_name", "env.task", "env.tasks", "env.suite", "env.world", "env.protocol"),
    *("env.obs_type", "env.referent", "env.prompt_in", "env.render"),
    *("policy.size", "policy.perception", "policy.align", "policy.subgoal_level", "policy.memory_fusion"),
    *("policy.memory_camera", "policy.detector"),
    *("policy.dtype", "policy.dialect", "policy.gripper"),
)
"""Texts that name one of several known things."""
NOTES = ("policy.label", "policy.keys")
"""Text that stands on a card, or in a message to the policy's server."""
SERVERS = ("policy.host", "policy.servers")

RECORDING = "eval.recording"
"""Writes a dataset of the rollouts: no outcome depends on it, and a repetition leaves it out."""
MOST = {"env.horizon": 10 * HORIZON, "eval.n_episodes": MOST_EPISODES, "env.videos": MOST_EPISODES}
MOST |= {"eval.batch_size": 512}
MOST_STEPS = 100 * HORIZON
"""What a card may ask for: setting -> its largest number, and control steps of an episode with its pauses."""
NAMED = {"success", "steps", "checkpoints"}
"""What a card must name of an episode, since a repetition could contradict nothing else."""

FLAG = re.compile(r"--([\w.]+)=(.*)", re.DOTALL)
WORD = re.compile(r"[\w.,+' ()-]*")
DEVICE = re.compile(r"cpu|mps|(cuda|xpu)(:\d{1,3})?")
SERVER = re.compile(r"(?:\w+://)?(?:127\.0\.0\.1|localhost)(?::\d+)?")
OBSERVATION = re.compile(r"[\w./-]+")
NOTHING = ("null", "none", "None", "~")


def repeat(
    path: Path,
    out: Path | None,
    server: str | None,
    evaluate: Callable[[EvaluationPlan], int],
    say: Callable[[str], None],
) -> int:
    """Repeat the evaluation of a card and compare every episode; return 1 where one ended differently.

    Args:
        path: the card, or its folder.
        out: folder of the repetition, a dated one when None.
        server: see `repeatable_card`.
        evaluate: runs the plan and returns its exit status.
        say: told what differs here, and what was found.

    Raises:
        MemobenchError: the card cannot be repeated here.
    """
    card = repeatable_card(path, server)
    check_policy(card)
    if (otherwise := drawn_otherwise(card["episodes"])) is not None:
        raise MemobenchError(
            f"the card's episodes drew their variants otherwise ({otherwise}): an earlier version ran them, which did "
            f"not draw in balance; repeat it with that version ({_version_of(card)})"
        )
    told = card["protocol"]
    for name, here in revision(told.get("suite", PUBLISHED)).items():
        if (there := told.get(name, UNTOLD[name])) != here:
            raise MemobenchError(
                f"the card's protocol of strict tasks has {name}={there}, and this version {name}={here}: an earlier "
                f"version ran it; repeat it with that version ({_version_of(card)})"
            )
    for note in differences_here(card):
        say(f"note: {note}")
    plan = plan_of_card(card, out)
    check_extent(card, plan)
    if status := evaluate(plan):
        return status
    problems = differences(told, read_protocol_file(plan.log) or told)
    problems += disagreements(card["episodes"], read_log(plan.log), "here")
    if not problems:
        say(f"repeated: {count_of(len(card['episodes']), 'episode')}, as on the card")
        return 0
    say(f"not repeated: {problems[0]}")
    return 1


def _version_of(card: Mapping[str, Any]) -> str:
    """Return the package's version and commit by which a card was last run."""
    run = card["runs"][-1]
    return f"{run['versions'].get(PACKAGES[0], 'not known')}, commit {run['git_commit'] or 'not known'}"


def repeatable_card(path: Path, server: str | None = None) -> dict[str, Any]:
    """Return the card of an evaluation that has ended, from its file or its folder, with flags that may be repeated.

    Args:
        server: where the policy's server is here (``host:port``, or several with commas); as on the card when None.

    Raises:
        MemobenchError: there is none, it holds nothing to compare with, or what no card may ask for (`allowed_flags`).
    """
    path = path / CARD_FILE if path.is_dir() else path
    card = read_card(path, whole=True)
    if not card["episodes"]:
        raise MemobenchError(f"{path} holds no episodes to compare with; expected that of an evaluation that has ended")
    return {**card, "flags": allowed_flags(card.get("flags"), server)}


def plan_of_card(card: Mapping[str, Any], out: Path | None = None) -> EvaluationPlan:
    """Return the plan of a card's evaluation, to be run in ``out``, or in a folder of the present time."""
    out = out or Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_rerun"
    shard = [] if card["shard"] is None else [f"shard={card['shard']}"]
    split = [f"split={SEALED}"] if "sealed" in card else []
    return plan_line([*card["flags"], f"output_dir={out}", *shard, *split])


def check_extent(card: Mapping[str, Any], plan: EvaluationPlan) -> None:
    """Refuse a card whose flags run something else than its episodes, or whose episodes may take too long.

    Raises:
        MemobenchError: success, steps or checkpoints of an episode of its protocol are not on the card, an episode of
            another protocol is, or an episode may take more than `MOST_STEPS`.
    """
    asked, grid, environment = card["protocol"], plan.grid, plan.environment
    tasks = sorted(task.name for task in grid.tasks)
    if (tasks, grid.runs) != (sorted(asked["tasks"]), asked["episodes"]):
        raise MemobenchError(
            f"the card's flags run other tasks or episodes ({grid.runs} of {len(tasks)} tasks) than its protocol names "
            f"({asked['episodes']} of {len(asked['tasks'])}); expected a card.json that we wrote"
        )
    most = longest(environment.horizon, environment.pause_steps, environment.speed, environment.replan_steps)
    if most > MOST_STEPS:
        raise MemobenchError(
            f"an episode of the card may take {most:,} control steps; expected at most {MOST_STEPS:,}, so run its "
            "command yourself if you trust it"
        )
    wanted = {episode for cell in grid.cells(plan.options.shard) for episode in grid.episodes(cell)}
    named = {(e["task"], e["episode"]) for e in card["episodes"] if "not_run" in e or {*e} >= NAMED}
    for task, episode in sorted(wanted ^ named)[:1]:
        lacks = "does not name success, steps and checkpoints of" if (task, episode) in wanted else "does not ask for"
        raise MemobenchError(
            f"the card {lacks} {task}, episode {episode}, so it cannot be repeated; expected the outcome of each of "
            f"the {count_of(len(wanted), 'episode')} of its protocol, as on the card of a finished evaluation"
        )


def check_policy(card: Mapping[str, Any]) -> None:
    """Refuse to repeat an evaluation with another policy.

    Raises:
        MemobenchError: the checkpoint is another one, or nobody knows which it was.
    """
    given = flag_value(card["flags"], "policy.path")
    if given is None:
        return
    folder = local_folder(given)
    assert folder is not None  # `repeatable_card` has found it
    found, told = tree_hash(checkpoint_files(folder)), card["policy"].get("sha256")
    if found != told:
        raise MemobenchError(
            f"the checkpoint {given} is not the one that was evaluated (sha256 {found[:12]}, on the card "
            f"{str(told)[:12]}); its results would be another policy's"
        )
    settings, detector = card["policy"].get("settings", {}), card["policy"].get("detector_sha256")
    here = detector_hash(settings)
    if here != detector:
        raise MemobenchError(
            f"the detector {settings.get('detector')} is not the one that was used (sha256 {str(here)[:12]}, on the "
            f"card {str(detector)[:12]}); the results would be another policy's"
        )


def differences_here(card: Mapping[str, Any]) -> list[str]:
    """Return in what this machine differs from those that a card's runs were made on."""
    here = drawn_with({"versions": versions()})
    notes = []
    for run in card["runs"]:
        changed = [
            f"{name} {version} (here {here[name]})"
            for name, version in drawn_with(run).items()
            if here.get(name, version) != version
        ]
        if changed:
            notes.append(f"the card's run used {', '.join(changed)}; results may depend on it")
    return list(dict.fromkeys(notes))


# --- what a card that is repeated may ask for ---


def allowed_flags(flags: Any, server: str | None = None) -> list[str]:
    """Return a card's flags as LeRobot may be given them: values checked, each key once, checkpoints by their folders.

    Args:
        flags: as they were read.
        server: where the policy is asked, in place of the card's address; None for the card's.

    Raises:
        MemobenchError: one of them is none that a card which is repeated may hold.
    """
    if not isinstance(flags, list) or not all(isinstance(flag, str) for flag in flags):
        raise MemobenchError("the card's flags are no list of --key=value; expected a card.json that we wrote")
    settings = {key: _folder(key, value) for key, value in map(_taken_apart, flags) if key != RECORDING}
    if ENV not in settings:
        raise MemobenchError(f"the card does not say {ENV}={ENVIRONMENT}; only evaluations of ours are repeated")
    named = []
    if server is not None:
        if settings.get(POLICY_TYPE) != "memobench_remote":
            raise MemobenchError(f"--server {server} is for a policy that runs in a server, and the card's does not")
        settings = {key: value for key, value in settings.items() if key not in (*SERVERS, "policy.port")}
        named = [f"--policy.servers={server}"]
    known = _known([f"--{key}={settings[key]}" for key in (ENV, POLICY_TYPE, POLICY_PATH) if key in settings])
    return [f"--{key}={_checked(known, key, value)}" for key, value in settings.items()] + named


def _taken_apart(flag: str) -> tuple[str, str]:
    """Return key and value; LeRobot would understand other spellings, a card of ours has none."""
    found = FLAG.fullmatch(flag)
    if found is None:
        raise MemobenchError(f"the card's flag {flag[:80]!r} is not --key=value; expected a card.json that we wrote")
    key, value = found.groups()
    if key == ENV and value != ENVIRONMENT:
        raise _refused(key, value, f"expected {ENVIRONMENT}")
    return key, value


def _folder(key: str, value: str) -> str:
    """Return the folder that a setting names, other settings' values as they are.

    Of a repository, it is the copy in the hub's cache: LeRobot must not fetch what nobody has seen.
    """
    if key == POLICY_PATH:
        try:
            folder = local_folder(value)
        except (ValueError, RuntimeError, OSError):  # neither a path nor a repository
            folder = None
        if folder is None:
            raise MemobenchError(
                f"the checkpoint {value[:80]!r} (policy.path) is not here; put it there to repeat the evaluation"
            )
        return str(folder.absolute())
    if key == TASK_DIR and not Path(value).is_dir():
        raise _refused(key, value, "expected a folder that is here")
    return value


def _known(choosing: list[str]) -> dict[str, Any]:
    """Return the settings of an evaluation with these flags that choose environment and policy."""
    config = config_class(load_command("eval"))
    assert config is not None
    register_plugins()
    found = {key: chosen_class(config, key, choosing, {}) for key in ("env", "policy")}
    return dict(settings_of(config, {key: choice for key, choice in found.items() if choice is not None}))


def _checked(known: Mapping[str, Any], key: str, value: str) -> str:
    """Return a value as LeRobot reads it, if it is one that names nothing but what is here."""
    if key in (ENV, POLICY_TYPE, POLICY_PATH, TASK_DIR):
        return value  # known by now
    for keys, (holds, expected) in EXPECTED.items():
        if key in keys:
            if not holds(value):
                raise _refused(key, value, f"expected {expected}")
            return value
    try:
        kind = setting_type(known, key)
    except KeyError:
        raise _refused(key, value, "which is no setting of this evaluation") from None
    if key.rpartition(".")[2] in REACHING_OUT:
        raise _refused(key, value, "which no card sets that is repeated")
    parts = typing.get_args(kind) if is_union(kind) else (kind,)
    may_be_text = any(part in (str, Path, Any, object) for part in parts)
    if value in NOTHING and (key.startswith("policy.") or not may_be_text):
        return value
    kind = without_none(kind)
    if dataclasses.is_dataclass(kind) or typing.get_origin(kind) is dict:
        raise _refused(key, value, "which no card sets that is repeated")
    if may_be_text:
        raise _refused(key, value, "which may name a file or a repository")
    if not (kind in PLAIN or is_enum(kind) or is_literal(kind) or _holds_numbers(value)):
        raise _refused(key, value, "expected numbers")
    found = checked_value(key, kind, value)
    if key in MOST and float(found) > MOST[key]:
        raise _refused(key, value, f"expected at most {MOST[key]:,}")
    return found


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _holds_numbers(text: str) -> bool:
    """Whether a text is a JSON number or list of them, or of lists of them."""
    found = _parsed(text)
    lists = found if isinstance(found, list) else [found]
    parts = [part for item in lists for part in (item if isinstance(item, list) else [item])]
    return all(isinstance(part, int | float) for part in parts)


def _renames_observations(text: str) -> bool:
    found = _parsed(text)
    return isinstance(found, dict) and all(
        isinstance(name, str) and OBSERVATION.fullmatch(name) for pair in found.items() for name in pair
    )


def _all_here(text: str) -> bool:
    return all(SERVER.fullmatch(part.strip()) for part in text.split(","))


def _is_device_here(text: str) -> bool:
    import torch

    found = DEVICE.fullmatch(text)
    return found is not None and int((found[2] or ":0")[1:]) < max(1, torch.cuda.device_count())


EXPECTED: dict[tuple[str, ...], tuple[Callable[[str], Any], str]] = {
    WORDS: (WORD.fullmatch, "words"),
    NOTES: (str.isprintable, "a line of text"),
    SERVERS: (_all_here, "this machine (127.0.0.1); name the server that you trust by --server host:port"),
    ("policy.device",): (_is_device_here, "cpu, mps, cuda or cuda:<number of a GPU that is here>"),
    ("rename_map",): (_renames_observations, "names of observations"),
}


def _refused(key: str, value: str, why: str) -> MemobenchError:
    return MemobenchError(
        f"the card sets {key}={value[:80]!r}, {why}; a card is data and is not repeated with it: run its command "
        "yourself if you trust it"
    )
