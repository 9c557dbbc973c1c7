"""The result card of an evaluation: what is needed to understand, repeat and check it, in ``card.json``.

::

    protocol      tasks, episodes, and the settings that must agree for two evaluations to compare
    policy        type, settings, seed, hash of its checkpoint: what must agree for an evaluation to be gone on with
    checkpoint    where it was, hash of each file;  trained_on: the dataset it was trained on
    task_files    hash of each task's files
    flags         LeRobot's flags, complete but for folders: `memobench rerun` repeats them;  shard: the part, or null
    runs          each start, on each machine: command line, versions, commit, machine
    sealed        on the sealed seeds alone: how often this policy was run on them with this release, and when
    episodes      what was found: outcome, checkpoints' steps and scene hash of every episode

It is written when an evaluation starts, and again with what was found when it ends. ``card.md`` is the same for people.
"""

from __future__ import annotations

import datetime as dt
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_memobench.envs.acting import ELSEWHERE, checkpoint_files, encoded, tree_hash
from lerobot_memobench.envs.episode_log import EXTENT, INPUTS, SETTINGS, key_of
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.envs.upstream import DIFFERENCES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import outcome
from lerobot_memobench.evaluation.metrics import stand_ins_of
from lerobot_memobench.evaluation.records import CARD_FILE
from lerobot_memobench.evaluation.tables import markdown_text
from lerobot_memobench.io import Count, file_hash, read_json, write_file
from lerobot_memobench.policies.checkpoint import ADAPTER_FILE, WEIGHTS_FILE, local_folder, portable_path
from lerobot_memobench.protocol import UPSTREAM
from lerobot_memobench.run.arguments import without_flags
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.plan import EvaluationPlan

FORMAT = 1
CARD_MARKDOWN = "card.md"


# --- the card of a plan, before anything has been found ---


def card_of(plan: EvaluationPlan) -> dict[str, Any]:
    """Return the card of an evaluation that is about to begin. Hashes the checkpoint."""
    shard = plan.options.shard
    card = new_card(
        protocol=_protocol_of(plan),
        policy={} if plan.policy is None else policy_facts(encoded(plan.policy), plan.seed),
        checkpoint=None,
        trained_on=None,
        task_files=_task_files(plan),
        flags=_flags_of(plan),
        runs=[run_facts(plan.command, plan.batch)],
        shard=None if shard is None else str(shard),
    )
    return with_checkpoint(card, plan.policy_path)


def _flags_of(plan: EvaluationPlan) -> list[str]:
    """Return the plan's flags as another machine may use them: a policy of this package goes by its name."""
    key = "--policy.path="
    return [
        key + portable_path(flag.removeprefix(key)) if flag.startswith(key) else flag for flag in plan.portable_flags
    ]


def _protocol_of(plan: EvaluationPlan) -> dict[str, Any]:
    names = sorted(task.name for task in plan.grid.tasks)
    environment = plan.environment
    found = {"tasks": names, "episodes": plan.grid.runs, **environment.agreed_settings}
    if plan.policy is not None:
        found[INPUTS] = policy_inputs(plan.policy, environment.obs_type, environment.oracle_memory)
    return found


def _task_files(plan: EvaluationPlan) -> dict[str, str]:
    from lerobot_memobench.datasets.generation import task_hash
    from lerobot_memobench.tasks.catalogue import load_task

    return {task.name: task_hash(load_task(task.folder)) for task in plan.grid.tasks}


def with_checkpoint(card: dict[str, Any], path: str | None) -> dict[str, Any]:
    """Return a card with what is known of the checkpoint; a repository's is known once LeRobot has fetched it."""
    folder = None if path is None else local_folder(path)
    if folder is None or "sha256" in card["policy"]:
        return card
    files = checkpoint_files(folder)
    if not any(name in files for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        return card
    return {
        **card,
        "policy": {**card["policy"], "sha256": tree_hash(files)},
        "checkpoint": {
            "path": portable_path(str(path)),
            "revision": folder.name if folder.parent.name == "snapshots" else None,  # a copy in the hub's cache
            "files": files,
        },
        "trained_on": training_facts(folder),
    }


# --- what identifies a policy beyond its name: settings, seed, hash of its checkpoint, what it was trained on ---


class TrainedOn(TypedDict, total=False):
    """LeRobot's settings of the dataset of a training run."""

    repo_id: str | None
    revision: str | None
    root: str | None
    episodes: list[int] | None


class TrainConfig(TypedDict):
    """What is used of a checkpoint's ``train_config.json``."""

    dataset: TrainedOn
    steps: NotRequired[Count | None]


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return what identifies a policy beside its weights: its configuration as LeRobot encodes it, the run's seed.

    Of a detector, which is no part of its checkpoint, also the hash.

    Raises:
        MemobenchError: there is no such detector.
    """
    kept = {key: value for key, value in settings.items() if key not in ELSEWHERE and key != "type"}
    detector = detector_hash(kept)
    return {
        "type": settings.get("type"),
        "seed": seed,
        "settings": kept,
        **({} if detector is None else {"detector_sha256": detector}),
    }


def detector_hash(settings: Mapping[str, Any]) -> str | None:
    """Return the hash of the detector that a policy reads objects from, None where it has none.

    Raises:
        MemobenchError: there is no such detector.
    """
    if settings.get("detector") is None:
        return None
    from lerobot_memobench.perception.weights import detector_file

    return file_hash(detector_file(settings["detector"]))


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return what a checkpoint says about the dataset it was trained on, None where it says nothing.

    Where the dataset is on this machine, ``sha256`` is that of its meta files and its manifest, which in turn hold a
    digest of every episode that `memobench generate` made.
    """
    try:
        told = read_json(folder / "train_config.json", TrainConfig, "it is ignored")
    except (FileNotFoundError, MemobenchError):
        return None
    dataset = told["dataset"]
    found = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    found["steps"] = told.get("steps")
    root = Path(str(found["root"] or ""))
    if found["root"] and os.path.isdir(root / "meta"):  # pathlib's raises at names that are too long
        files = sorted(path for path in [*(root / "meta").rglob("*"), root / "manifest.json"] if path.is_file())
        found["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return found


# --- cards put together and written ---


def new_card(
    *,
    protocol: Mapping[str, Any],
    policy: Mapping[str, Any],
    checkpoint: Mapping[str, Any] | None,
    trained_on: Mapping[str, Any] | None,
    task_files: Mapping[str, str],
    flags: Sequence[str],
    runs: Sequence[Mapping[str, Any]],
    shard: str | None = None,
) -> dict[str, Any]:
    """Return the card of an evaluation that has found nothing yet."""
    return {
        "format": FORMAT,
        "written": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "protocol": dict(protocol),
        "policy": dict(policy),
        "checkpoint": checkpoint,
        "trained_on": trained_on,
        "task_files": dict(task_files),
        "flags": list(flags),
        "shard": shard,
        "runs": joined_runs(runs),
        "episodes": [],
    }


def extended(card: Mapping[str, Any], other: Mapping[str, Any], *, again: bool = True) -> dict[str, Any]:
    """Return a card for both of two runs of one evaluation: extent, episodes, runs and tasks' hashes of both.

    Args:
        again: whether an equal run is one more start, or the same start told twice.
    """
    a, b = card["protocol"], other["protocol"]
    extent = {"tasks": sorted({*a["tasks"], *b["tasks"]}), "episodes": max(a["episodes"], b["episodes"])}
    return {
        **card,
        "protocol": {**b, **a, **extent},
        "policy": card["policy"] or other["policy"],
        "checkpoint": card["checkpoint"] or other["checkpoint"],
        "trained_on": card["trained_on"] or other["trained_on"],
        "task_files": {**card["task_files"], **other["task_files"]},
        "flags": _widened_flags(card, extent),
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
        "episodes": _joined_episodes(card["episodes"], other["episodes"]),
    }


def _widened_flags(card: Mapping[str, Any], extent: Mapping[str, Any]) -> list[str]:
    """Return a card's flags, changed to a wider extent where it is wider."""
    flags = list(card["flags"])
    if extent["episodes"] != card["protocol"]["episodes"]:
        flags = [*without_flags(flags, "eval.n_episodes"), f"--eval.n_episodes={extent['episodes']}"]
    if extent["tasks"] != sorted(card["protocol"]["tasks"]):
        flags = [*without_flags(flags, "env.task", "env.tasks"), f"--env.tasks={','.join(extent['tasks'])}"]
    return flags


def joined_runs(runs: Iterable[Mapping[str, Any]], again: bool = True) -> list[dict[str, Any]]:
    """Return runs without repetitions; ``times`` says how often one was started."""
    found: list[dict[str, Any]] = []
    for run in runs:
        same = next((r for r in found if all(r.get(key) == run.get(key) for key in {*r, *run} - {"times"})), None)
        if same is None:
            found.append({**run, "times": run.get("times", 1)})
        else:
            times = run.get("times", 1)
            same["times"] = same["times"] + times if again else max(same["times"], times)
    return found


def with_episodes(card: Mapping[str, Any], records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a card that holds what was found; an episode that is on it stays as it is, whatever a log says later."""
    return {**card, "episodes": _joined_episodes(card["episodes"], map(outcome, records))}


def _joined_episodes(mine: Iterable[Mapping[str, Any]], others: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the episodes of both, sorted, each once, with the outcome that ``mine`` names."""
    found = {key_of(episode): dict(episode) for episode in others}
    for episode in mine:
        found[key_of(episode)] = {**found.get(key_of(episode), {}), **episode}
    return [found[key] for key in sorted(found)]


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write ``card.json`` and ``card.md``, each whole or not at all."""
    write_file(folder / CARD_FILE, _json(card), durable=True)
    write_file(folder / CARD_MARKDOWN, markdown(card), durable=True)


def remove_card(folder: Path) -> None:
    """Remove the card of a folder, if there is one."""
    for name in (CARD_FILE, CARD_MARKDOWN):
        (folder / name).unlink(missing_ok=True)


def _json(card: Mapping[str, Any]) -> str:
    """Return the card as JSON with one episode a line: there may be 1,500."""
    episodes = ",\n".join(f"  {json.dumps(episode)}" for episode in card["episodes"])
    text = json.dumps({**card, "episodes": []}, indent=1)
    return (
        text.replace('"episodes": []\n}', f'"episodes": [\n{episodes}\n ]\n}}' if episodes else '"episodes": []\n}')
        + "\n"
    )


def markdown(card: Mapping[str, Any]) -> str:
    """Return the card as Markdown."""
    lines = ["# Result card", "", *_protocol_lines(card), "", *_policy_lines(card)]
    for number, run in enumerate(card["runs"], start=1):
        lines += ["", *_run_lines(number, run)]
    lines += ["", f"`memobench rerun {CARD_FILE}` repeats the evaluation and compares every episode.", ""]
    return "\n".join(lines)


def _row(name: str, value: object) -> str:
    """Return a row of a table; what it holds may be a stranger's."""
    return f"| {markdown_text(name)} | {markdown_text(str(value))} |"


def _protocol_lines(card: Mapping[str, Any]) -> list[str]:
    protocol = card["protocol"]
    tasks = protocol.get("tasks", [])
    settings = {name: protocol[name] for name in SETTINGS if name in protocol}
    others = {key: value for key, value in protocol.items() if key not in (*SETTINGS, *EXTENT)}
    return [
        *("| protocol | |", "|---|---|"),
        _row("tasks", f"{len(tasks)}: {', '.join(tasks)}"),
        _row("episodes of each", protocol.get("episodes")),
        *(_row(name.replace("_", " "), value) for name, value in {**settings, **others}.items()),
        *_differences(card),
        *_sealed_lines(card.get("sealed")),
        _row("episodes in the log", len(card["episodes"])),
    ]


def _differences(card: Mapping[str, Any]) -> list[str]:
    """Return rows on what makes figures others than the paper's protocol and scenes would give."""
    found = {
        "differs from the paper's": DIFFERENCES if card["protocol"].get("protocol") == UPSTREAM else (),
        "stand-ins for missing scans": stand_ins_of(card["episodes"]),
    }
    return [_row(name, "; ".join(told)) for name, told in found.items() if told]


def _sealed_lines(sealed: Mapping[str, Any] | None) -> list[str]:
    if sealed is None:
        return []
    before = "; ".join(f"{start['started'][:10]} {start['suite']} {start['referent']}" for start in sealed["earlier"])
    number = f"run {sealed['run']} with release {sealed['release']}; before it: {before or 'none'}"
    told = {f"{name} of that run": sealed[name] for name in ("started", "policy", "scenes") if name in sealed}
    return [_row("sealed test", number), *(_row(name, value) for name, value in told.items())]


def _policy_lines(card: Mapping[str, Any]) -> list[str]:
    policy = card["policy"]
    lines = [
        "| policy | |",
        "|---|---|",
        _row("type", policy.get("type", "not known")),
        _row("seed", policy.get("seed")),
    ]
    if card["checkpoint"]:
        lines += [_row("checkpoint", card["checkpoint"]["path"]), _row("its sha256", policy.get("sha256", "not known"))]
    if "detector_sha256" in policy:
        lines += [_row("sha256 of its detector", policy["detector_sha256"])]
    return lines + [_row(f"trained on: {key}", value) for key, value in (card["trained_on"] or {}).items()]


def _run_lines(number: int, run: Mapping[str, Any]) -> list[str]:
    times = run.get("times", 1)
    command = " ".join(" ".join(run["command"]).split())
    lines = [f"## Run {number}" + (f" (started {times} times)" if times > 1 else ""), ""]
    lines += [f"    {command}", "", "| | |", "|---|---|"]  # indented: no text ends such a block
    facts = {"commit": run["git_commit"], "batch size": run["batch_size"], **run["machine"], **run.get("gl", {})}
    return lines + [_row(*fact) for fact in {**run["versions"], **facts}.items()]


# --- whether an episode was drawn as it is drawn here ---


def drawn_otherwise(records: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the first episode of a log or card whose variant is not the one that its seed draws here, None for none.

    Before variants were drawn in balance, each seed drew its own by itself. Tasks of one's own are not looked at.
    """
    from lerobot_memobench.envs.episode import referent_of
    from lerobot_memobench.tasks.catalogue import get_task, suite_of
    from lerobot_memobench.tasks.evidence import scene_and_variant

    for record in records:
        task, told, seed = record["task"], record.get("variant"), record.get("seed")
        drawn = record.get("referent", "fixed") != "fixed" and suite_of(task) is not None
        if not drawn or told is None or seed is None or seed < 0:
            continue
        if "choice" in record:  # each scene was run with each variant
            here = scene_and_variant(get_task(task), record["episode"])[1]
        else:
            here = referent_of(get_task(task), seed).variant_index
        if here != told:
            return f"{task}, episode {record['episode']}: variant {told} there, {here} by its seed here"
    return None
