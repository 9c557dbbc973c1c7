"""Repeat the evaluation that a card describes and compare every episode.

A card is data that anybody may have written. Its settings decide which packages are imported and which files are read,
so only known settings of the environment, the policy and the evaluation are accepted: none that name code, a place to
write to or another machine, and as places to read from only folders of this machine. Anything else is refused by name,
and so is more than `MOST` of something, and a card that does not name the outcome of every episode.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import re
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from draccus.utils import is_enum, is_literal, is_union
from lerobot.configs.eval import EvalPipelineConfig

from lerobot_memobench.envs.episode_log import MOST_EPISODES, OMITTED, differences, read_log
from lerobot_memobench.envs.evaluation_file import protocol_of, read_evaluation
from lerobot_memobench.envs.pacing import longest
from lerobot_memobench.envs.settings import EnvSettings, revision
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import disagreements
from lerobot_memobench.io import Malformed, checked, count_of
from lerobot_memobench.policies.checkpoint import local_folder
from lerobot_memobench.protocol import HORIZON, SEALED
from lerobot_memobench.run.arguments import (
    PLAIN,
    checked_value,
    chosen_class,
    register_plugins,
    setting_type,
    without_none,
)
from lerobot_memobench.run.arguments import settings as settings_of
from lerobot_memobench.run.card import checkpoint_files, detector_hash, first_variant_mismatch, tree_hash
from lerobot_memobench.run.machine import PACKAGES, drawn_with, versions
from lerobot_memobench.run.plan import EvaluationPlan, RunOptions, Shard, make_plan
from lerobot_memobench.run.settings import ENVIRONMENT, OWN, EvaluationSettings, settings_of_flags
from lerobot_memobench.tasks.task import PUBLISHED

REACHING_OUT = ("push_to_hub", "private", "use_peft", "trust_remote_code", "discover_packages_path")
"""Settings of a policy by which more than numbers changes. All other numbers and truth values are accepted."""
WORDS = (
    *("size", "perception", "align", "subgoal_level", "memory_fusion", "memory_camera", "detector"),
    *("dtype", "dialect", "gripper"),
)
"""Texts of a policy that name one of several known things."""
NOTES = ("label", "keys")
"""Text that is printed on a card, or sent to the policy's server."""
SERVERS = ("host", "servers")

MOST = {"horizon": 10 * HORIZON, "episodes": MOST_EPISODES, "videos": MOST_EPISODES, "batch_size": 512}
MOST_STEPS = 100 * HORIZON
"""Limits for a card: setting -> its largest number, and control steps of an episode with its pauses."""
NAMED = {"success", "steps", "checkpoints"}
"""Fields that a card must name of an episode, since a repetition could contradict nothing else."""
OF_EARLIER_VERSIONS = re.compile(r"--(eval\.recording.*|job_name=.*|env\.render_every=1|env\.max_parallel_tasks=1)")
"""Flags on cards of earlier versions on which no outcome depends."""

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
        say: called with differences of this machine, and with the result.

    Raises:
        MemobenchError: the card cannot be repeated here.
    """
    card = repeatable_card(path, server)
    check_policy(card)
    if (otherwise := first_variant_mismatch(card["episodes"])) is not None:
        raise MemobenchError(
            f"the card's episodes drew their variants otherwise ({otherwise}): an earlier version ran them, which did "
            f"not draw in balance; repeat it with that version ({_version_of(card)})"
        )
    told = card["protocol"]
    for name, here in revision(told.get("suite", PUBLISHED)).items():
        if (there := told.get(name, OMITTED[name])) != here:
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
    problems = differences(told, protocol_of(plan.log))
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
    """Return the card of an evaluation that has ended, with ``asked``, its settings, checked by `allowed_settings`.

    Args:
        path: the card's file or its folder.
        server: where the policy's server is here (``host:port``, or several with commas); as on the card when None.

    Raises:
        MemobenchError: there is none, it holds nothing to compare with, or a setting that no card may hold.
    """
    card = read_evaluation(path, whole=True)
    if not card["episodes"]:
        raise MemobenchError(f"{path} holds no episodes to compare with; expected that of an evaluation that has ended")
    return {**card, "asked": allowed_settings(asked_of(card), server)}


def plan_of_card(card: Mapping[str, Any], out: Path | None = None) -> EvaluationPlan:
    """Return the plan of a card's evaluation, to be run in ``out``, or in a folder of the present time."""
    out = out or Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_rerun"
    shard = None if card["shard"] is None else Shard.parse(card["shard"])
    options = RunOptions(split=SEALED if "sealed" in card else None, shard=shard)
    return make_plan(replace(card["asked"], output_dir=str(out)), options, ("memobench", "rerun"))


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
            f"the card's settings run {grid.runs} episodes of {len(tasks)} tasks, and its protocol names "
            f"{asked['episodes']} of {len(asked['tasks'])}; expected a card that we wrote"
        )
    most = longest(environment.settings)
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
        MemobenchError: the checkpoint is another one, or the card does not identify it.
    """
    given = card["asked"].policy_path
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


# --- settings that a card may hold ---


def asked_of(card: Mapping[str, Any]) -> EvaluationSettings:
    """Return the settings of a card, also of one from when cards held LeRobot's flags.

    Raises:
        MemobenchError: they have another form.
    """
    if "settings" in card:
        try:
            return EvaluationSettings(**checked(card["settings"], dict[str, Any]))
        except (Malformed, TypeError):
            raise MemobenchError("the card's settings have unknown fields; expected a card that we wrote") from None
    flags = card.get("flags")
    if not isinstance(flags, list) or not all(isinstance(flag, str) and FLAG.fullmatch(flag) for flag in flags):
        raise MemobenchError("the card's flags are no list of --key=value; expected a card that we wrote")
    if {flag for flag in flags if flag.startswith("--env.type=")} != {"--env.type=memobench"}:
        raise MemobenchError("the card does not say --env.type=memobench; expected an evaluation of the benchmark")
    for key, value in (flag.removeprefix("--").split("=", 1) for flag in flags):
        if key.rpartition(".")[2] in REACHING_OUT:
            raise _refused(key, value, "which no card sets that is repeated")
    kept = [flag for flag in flags if not OF_EARLIER_VERSIONS.fullmatch(flag)]
    return settings_of_flags(flag.replace("--env.task=", "--env.tasks=", 1) for flag in kept)


def allowed_settings(asked: EvaluationSettings, server: str | None = None) -> EvaluationSettings:
    """Return a card's settings, checked, with the policy's checkpoint by its folder.

    Args:
        server: where the policy is asked, in place of the card's address; None for the card's.

    Raises:
        MemobenchError: one of them is none that a card may hold.
    """
    _check_environment(asked.env)
    for name, kind in (("seed", int), ("episodes", int), ("batch_size", int), ("use_async_envs", bool)):
        value = getattr(asked, name)
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool) != (kind is bool)):
            raise _refused(name, value, f"expected {PLAIN[kind]}")
        _check_most(name, value)
    if asked.output_dir is not None:
        raise _refused("output_dir", asked.output_dir, "which no card sets")
    if not _renames_observations(asked.rename_map):
        raise _refused("rename_map", asked.rename_map, "expected names of observations")
    return replace(asked, policy=_allowed_policy(asked.policy, server))


def _check_environment(env: Any) -> None:
    """Refuse other settings of the environment than `EnvSettings`, tasks and a folder of tasks that is here."""
    known = {name for name in ENVIRONMENT if name not in ("log_dir", "resume")}
    for name, value in _items("env", env):
        if name not in known:
            raise _refused(f"env.{name}", value, "which is no setting of this evaluation")
        if name == "tasks" and not (isinstance(value, str) and WORD.fullmatch(value)):
            raise _refused("env.tasks", value, "expected names of tasks")
        if name == "task_dir" and value is not None and not (isinstance(value, str) and Path(value).is_dir()):
            raise _refused("env.task_dir", value, "expected a folder that is here")
        _check_most(name, value, "env.")
    EnvSettings(**{name: value for name, value in env.items() if name not in OWN})


def _check_most(name: str, value: Any, section: str = "") -> None:
    if name in MOST and isinstance(value, int) and value > MOST[name]:
        raise _refused(section + name, value, f"expected at most {MOST[name]:,}")


def _items(section: str, found: Any) -> Iterable[tuple[str, Any]]:
    if not isinstance(found, Mapping):
        raise _refused(section, found, "expected settings by name")
    return found.items()


def _allowed_policy(policy: Any, server: str | None) -> dict[str, str]:
    """Return the settings of a card's policy, checked; its checkpoint is a folder of this machine.

    Of a repository, it is the copy in the hub's cache: nothing is fetched.
    """
    told = dict(_items("policy", policy))
    for name, value in told.items():
        if not isinstance(value, str):
            raise _refused(f"policy.{name}", value, "expected text")
    if (path := told.get("path")) is not None:
        try:
            folder = local_folder(path)
        except (ValueError, RuntimeError, OSError):  # neither a path nor a repository
            folder = None
        if folder is None:
            raise MemobenchError(
                f"the checkpoint {path[:80]!r} (policy.path) is not here; put it there to repeat the evaluation"
            )
        told["path"] = str(folder.absolute())
    if server is not None:
        if told.get("type") != "memobench_remote":
            raise MemobenchError(f"--server {server} is for a policy that runs in a server, and the card's does not")
        told = {name: value for name, value in told.items() if name not in (*SERVERS, "port")}
    register_plugins()
    choosing = [f"--policy.{name}={told[name]}" for name in ("path", "type") if name in told]
    chosen = chosen_class(EvalPipelineConfig, "policy", choosing, {})
    known = {} if chosen is None else dict(settings_of(chosen, {}))
    kept = {name: value if name in ("path", "type") else _checked(known, name, value) for name, value in told.items()}
    return kept if server is None else {**kept, "servers": server}


def _checked(known: Mapping[str, Any], name: str, value: str) -> str:
    """Return a value of a policy's setting as LeRobot reads it, if it names nothing but what is on this machine."""
    key = f"policy.{name}"
    for names, (holds, expected) in EXPECTED.items():
        if name in names:
            if not holds(value):
                raise _refused(key, value, f"expected {expected}")
            return value
    try:
        kind = setting_type(known, name)
    except KeyError:
        raise _refused(key, value, "which is no setting of this evaluation") from None
    if name.rpartition(".")[2] in REACHING_OUT:
        raise _refused(key, value, "which no card sets that is repeated")
    if value in NOTHING:
        return value
    parts = typing.get_args(kind) if is_union(kind) else (kind,)
    kind = without_none(kind)
    if dataclasses.is_dataclass(kind) or typing.get_origin(kind) is dict:
        raise _refused(key, value, "which no card sets that is repeated")
    if any(part in (str, Path, Any, object) for part in parts):
        raise _refused(key, value, "which may name a file or a repository")
    if not (kind in PLAIN or is_enum(kind) or is_literal(kind) or _holds_numbers(value)):
        raise _refused(key, value, "expected numbers")
    return checked_value(key, kind, value)


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


def _renames_observations(found: Any) -> bool:
    return isinstance(found, Mapping) and all(
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
    ("device",): (_is_device_here, "cpu, mps, cuda or cuda:<number of a GPU that is here>"),
}


def _refused(key: str, value: Any, why: str) -> MemobenchError:
    return MemobenchError(
        f"the card sets {key}={str(value)[:80]!r}, {why}; a card is data and is not repeated with it: run its command "
        "yourself if you trust it"
    )
