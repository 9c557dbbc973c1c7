"""The result card of an evaluation: what is needed to understand, repeat and check it, in ``card.json``.

::

    protocol      tasks, episodes, and the settings that must agree for two evaluations to compare
    policy        type, settings, seed, hash of its checkpoint: what must agree for an evaluation to be gone on with
    checkpoint    where it was, hash of each file;  trained_on: the dataset it was trained on
    task_files    hash of each task's files
    flags         LeRobot's flags, complete but for folders: `memobench rerun` repeats them;  shard: the part, or null
    runs          each start, on each machine: command line, versions, commit, machine, GL
    episodes      what was found: outcome, checkpoints' steps and scene hash of every episode

It is written when an evaluation starts, and again with what was found when it ends. ``card.md`` is the same for people.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.protocol import EXTENT, SETTINGS
from lerobot_memobench.evaluation.records.protocol import CARD_FILE

FORMAT = 1
CARD_MARKDOWN = "card.md"

PACKAGES = ("lerobot_policy_memobench", "lerobot", "mujoco", "robosuite", "torch", "transformers", "numpy", "gymnasium")

NOT_THE_CHECKPOINT = ("train_config.json", "README.md", "training_weights.safetensors", ".gitattributes")
"""Files of a checkpoint folder on which what the policy does at evaluation does not depend."""

ELSEWHERE = (
    *("device", "pretrained_path", "repo_id", "private", "tags", "license", "push_to_hub", "use_peft"),
    *("host", "port", "servers", "connect_timeout", "timeout", "retry"),
)
"""Settings of a policy that say where it runs or where it goes, not what it does."""

OUTCOME = ("success", "steps", "prompt_steps", "variant", "checkpoints", "failure", "scene_hash")
"""What two runs of the same episode must agree in."""


# --- what is put on it ---


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return what identifies a policy beside its weights: its configuration as LeRobot encodes it, the run's seed."""
    kept = {key: value for key, value in settings.items() if key not in ELSEWHERE and key != "type"}
    return {"type": settings.get("type"), "seed": seed, "settings": kept}


def checkpoint_files(folder: Path) -> dict[str, str]:
    """Return name -> sha256 of the files that a checkpoint consists of."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and path.name not in NOT_THE_CHECKPOINT)
    return {path.name: file_hash(path) for path in files}


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return what a checkpoint says about the dataset it was trained on, None where it says nothing.

    Where the dataset is on this machine, ``sha256`` is that of its meta files and its manifest, which in turn hold a
    digest of every episode that `memobench generate` made.
    """
    try:
        told = json.loads((folder / "train_config.json").read_text())
        dataset = told["dataset"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    found = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    found["steps"] = told.get("steps")
    root = Path(str(found["root"])) if found["root"] else None
    if root is not None and (root / "meta").is_dir():
        files = sorted(path for path in [*(root / "meta").rglob("*"), root / "manifest.json"] if path.is_file())
        found["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return found


def tree_hash(files: Mapping[str, str]) -> str:
    """Return one sha256 for many: of the lines ``<sha256>  <name>`` in the order of names, as sha256sum prints them."""
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


def file_hash(path: Path) -> str:
    """Return the sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def run_facts(command: Sequence[str], batch: int, gl: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is known of one start of an evaluation on this machine.

    Args:
        gl: what draws the pictures.
    """
    return {
        "command": list(command),
        "batch_size": batch,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": {"cpu": cpu_model(), "cores": os.cpu_count(), "gpu": gpu_model(), "system": platform.platform()},
        "gl": dict(gl),
    }


def versions() -> dict[str, str]:
    """Return the versions on which an evaluation's numbers may depend."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_commit() -> str | None:
    """Return the commit that this package runs from, with ``+changes`` where files differ; None outside a checkout."""
    package = Path(__file__).resolve().parents[1]
    if not (package.parents[1] / ".git").exists():
        return None
    commit = _git(package, "rev-parse", "HEAD")
    if not commit:
        return None
    return commit + ("+changes" if _git(package, "status", "--porcelain", "--", str(package)) else "")


def _git(folder: Path, *words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def cpu_model() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def gpu_model() -> str | None:
    """Return the GPU's name, None without one."""
    import torch

    return str(torch.cuda.get_device_name(0)) if torch.cuda.is_available() else None


# --- the card ---


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
    """Return a card for both of two runs of one evaluation: extent, runs and tasks' hashes of both.

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
        "flags": _flags(card, extent),
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
    }


def _flags(card: Mapping[str, Any], extent: Mapping[str, Any]) -> list[str]:
    """Return a card's flags, changed to a wider extent where it is wider."""
    flags = list(card["flags"])
    if extent["episodes"] != card["protocol"]["episodes"]:
        flags = [flag for flag in flags if not flag.startswith("--eval.n_episodes=")]
        flags.append(f"--eval.n_episodes={extent['episodes']}")
    if extent["tasks"] != sorted(card["protocol"]["tasks"]):
        flags = [flag for flag in flags if not flag.startswith(("--env.task=", "--env.tasks="))]
        flags.append(f"--env.tasks={','.join(extent['tasks'])}")
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
    """Return a card that holds what was found."""
    return {**card, "episodes": [outcome(record) for record in records]}


def outcome(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a card keeps of a line of the log: its identity and what does not depend on the clock."""
    return {
        key: record[key] for key in ("task", "memory_type", "episode", "seed", "referent", *OUTCOME) if key in record
    }


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write ``card.json`` and ``card.md``, each whole or not at all."""
    for name, text in ((CARD_FILE, _json(card)), (CARD_MARKDOWN, markdown(card))):
        draft = folder / f".{name}.part"
        with draft.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, folder / name)


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
    """Return the card for people."""
    protocol, policy = card["protocol"], card["policy"]
    tasks = protocol.get("tasks", [])
    lines = ["# Result card", "", "| protocol | |", "|---|---|"]
    lines += [f"| tasks | {len(tasks)}: {', '.join(tasks)} |", f"| episodes of each | {protocol.get('episodes')} |"]
    lines += [f"| {name.replace('_', ' ')} | {protocol[name]} |" for name in SETTINGS if name in protocol]
    others = {key: value for key, value in protocol.items() if key not in (*SETTINGS, *EXTENT)}
    lines += [f"| {name.replace('_', ' ')} | {value} |" for name, value in others.items()]
    lines += [f"| episodes in the log | {len(card['episodes'])} |", "", "| policy | |", "|---|---|"]
    lines += [f"| type | {policy.get('type', 'not known')} |", f"| seed | {policy.get('seed')} |"]
    if card["checkpoint"]:
        lines += [
            f"| checkpoint | {card['checkpoint']['path']} |",
            f"| its sha256 | {policy.get('sha256', 'not known')} |",
        ]
    for key, value in (card["trained_on"] or {}).items():
        lines.append(f"| trained on: {key} | {value} |")
    for number, run in enumerate(card["runs"], start=1):
        times = run.get("times", 1)
        lines += ["", f"## Run {number}" + (f" (started {times} times)" if times > 1 else ""), ""]
        lines += ["```", " ".join(run["command"]), "```", "", "| | |", "|---|---|"]
        lines += [f"| {name} | {version} |" for name, version in run["versions"].items()]
        lines += [f"| commit | {run['git_commit']} |", f"| batch size | {run['batch_size']} |"]
        lines += [f"| {name} | {value} |" for name, value in run["machine"].items()]
        lines += [f"| {name} | {value} |" for name, value in run["gl"].items()]
    lines += ["", f"`memobench rerun {CARD_FILE}` repeats the evaluation and compares every episode.", ""]
    return "\n".join(lines)


# --- agreement ---


def key_of(record: Mapping[str, Any]) -> tuple[str, int, str]:
    """Return what identifies an episode: task, number, referent."""
    return record["task"], record["episode"], record.get("referent", "fixed")


def disagreement(a: Mapping[str, Any], b: Mapping[str, Any], here: str = "here", there: str = "there") -> str | None:
    """Return in one phrase the first thing in which two records of the same episode differ, None when in nothing.

    The time it took is no difference, nor what one of them leaves out.
    """
    for name in ("seed", "replan_steps", "scene_hash", *OUTCOME):
        if name in a and name in b and a[name] != b[name]:
            where = f"{a['task']}, episode {a['episode']}"
            if name != "checkpoints" or len(a[name]) != len(b[name]):
                return f"{where}: {name} is {a[name]} {here} and {b[name]} {there}"
            for number, (mine, other) in enumerate(zip(a[name], b[name], strict=True), start=1):
                for key in ("operation", "first_step", "ordered_step"):
                    if mine.get(key) != other.get(key):
                        return (
                            f"{where}: {key} of checkpoint {number} is {mine.get(key)} {here} "
                            f"and {other.get(key)} {there}"
                        )
    return None
