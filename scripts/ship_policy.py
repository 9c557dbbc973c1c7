"""Put a trained policy into the package: its weights in bfloat16, and a card with its training and its results.

    python scripts/ship_policy.py outputs/joint/policies/memory-0 memobench_strict --rollouts outputs/eval/small

The card's rollouts are of the shipped weights: run once without rollouts, evaluate the written folder
(policy=memobench_strict), and run again. Put later rollouts of the same weights into the card by

    python scripts/ship_policy.py memobench_strict memobench_strict --rollouts outputs/eval/later
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from lerobot_memobench.datasets.episodes import read_manifest
from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, read_evaluation
from lerobot_memobench.evaluation.records import read_run
from lerobot_memobench.evaluation.report import REPORT_JSON
from lerobot_memobench.io import file_hash, write_file
from lerobot_memobench.policies.checkpoint import (
    ELSEWHERE,
    SHIPPED,
    WEIGHTS_FILE,
    checkpoint_files,
    checkpoint_folder,
    encoded_config,
    shipped_policies,
    tree_hash,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SUPERVISED, MemobenchMemConfig
from lerobot_memobench.rollouts.card import git, training_facts
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import DRAWN

TRAINED = "train_config.json"
LARGEST = 4_000_000
"""Bytes that one policy may take."""
FOLLOWING = ("input_features", "output_features", "object_classes", "supervised_with_answer")
"""Settings of a policy that its dataset or other settings decide."""
OF_THE_MACHINE = (
    "env",
    "policy",
    "output_dir",
    "resume",
    "videos",
    "batch_size",
    "device",
    "shard",
    "shards",
    "workers",
)
"""Words of an evaluation's command that a card does not repeat."""
HEAD = """---
license: apache-2.0
library_name: lerobot
pipeline_tag: robotics
tags: [lerobot, memobench, memory]
---

"""


def ship(run: Path, name: str, rollouts: Path | None, merged: Mapping[Path, Sequence[Path]]) -> Path:
    """Write the last checkpoint of a training run as the package's policy ``name``; return its folder."""
    source, folder = checkpoint_folder(str(run)), SHIPPED / name
    if source is None:
        raise SystemExit(f"{run} holds no checkpoint; name the output_dir of a `lerobot train`")
    if rollouts is not None:
        check_rollouts(rollouts, folder)
    folder.mkdir(parents=True, exist_ok=True)
    weights = load_file(source / WEIGHTS_FILE)
    narrow = {key: value.to(torch.bfloat16) if value.is_floating_point() else value for key, value in weights.items()}
    save_file(narrow, folder / WEIGHTS_FILE, metadata={"format": "pt"})
    for path in folder.glob("policy_*processor*"):  # of an earlier policy, perhaps with other names
        path.unlink()
    for path in source.glob("policy_*processor*"):
        shutil.copy(path, folder)
    config = json.loads((source / "config.json").read_text()) | {"device": "cpu", "pretrained_path": None}
    write_file(folder / "config.json", json.dumps(config, indent=4) + "\n")
    write_file(folder / "README.md", card(name, source, weights, rollouts, merged))
    size = sum(path.stat().st_size for path in folder.iterdir())
    if size > LARGEST:
        raise SystemExit(f"{folder} takes {size:,} bytes; expected at most {LARGEST:,}")
    return folder


def card(
    name: str,
    source: Path,
    weights: dict[str, torch.Tensor],
    rollouts: Path | None,
    merged: Mapping[Path, Sequence[Path]],
) -> str:
    """Return the Markdown that goes with a policy; ``merged``: datasets, and those that LeRobot made each of."""
    runs = trainings(source)
    begun = runs.pop(0) if "shipped" in runs[0] else None
    policy = runs[-1]["policy"]
    count = sum(value.numel() for value in weights.values()) / 1e6
    marked = MemobenchMemConfig.from_pretrained(source, cli_overrides=["--device=cpu"]).supervised_with_answer
    lines = [
        f"# {name}",
        "",
        f"`memobench_mem`, {count:.1f} million parameters, bfloat16; reads {policy['perception']}.",
        *([f"**{SUPERVISED}.**"] if marked else []),
        *([] if begun is None else [began_with(begun["folder"])]),
        *demonstrations(runs, training_facts(source) or {}, merged),
        "",
        "```bash",
        *(
            line
            for run, before in zip(runs, [begun, *runs], strict=False)
            for line in training(run, before, begun is not None or len(runs) > 1)
        ),
        "```",
        *([] if rollouts is None else results(name, rollouts)),
    ]
    return HEAD + "\n".join(lines) + "\n"


def began_with(shipped: Path) -> str:
    """Return a sentence on the shipped policy, with its commit, from whose weights the first training began."""
    of = git(shipped, "log", "-1", "--format=%h", "--", ".")
    return f"It went on from `{shipped.name}` as of commit `{of}`, whose card says how that was made."


def trainings(source: Path) -> list[dict[str, Any]]:
    """Return the settings of the trainings that led to a checkpoint; a policy of the package gives its name."""
    if not (source / TRAINED).is_file():
        policy = json.loads((source / "config.json").read_text())
        return [{"shipped": source.name, "folder": source, "policy": policy}]
    run: dict[str, Any] = json.loads((source / TRAINED).read_text())
    begun = run["policy"].get("pretrained_path")
    if begun is not None and source.resolve().parents[1] == Path(begun).resolve().parents[1]:
        # A resumed training names its own checkpoint. Its first one names the policy it began from, unless it was
        # itself saved after an interruption.
        saved = [path for path in source.resolve().parents[1].iterdir() if path.name.isdecimal()]
        first = min(saved, key=lambda path: int(path.name))
        begun = json.loads((first / source.name / TRAINED).read_text())["policy"].get("pretrained_path")
        if begun is not None and Path(begun).resolve().parents[1] == first.parent:
            raise SystemExit(f"{first} does not name the policy that the training began from; write its card by hand")
    return [*(trainings(Path(begun)) if begun is not None else []), run]


def training(run: dict[str, Any], before: dict[str, Any] | None, named: bool) -> list[str]:
    """Return the command of a training from the weights of ``before``; ``named``: there are several."""
    policy = run["policy"]
    if before is None:
        kind = f"policy=memobench_mem perception={policy['perception']} size={policy['size']}"
    else:
        kind = f"policy={before.get('shipped') or place(before['output_dir'])}"
    words = [f"dataset={place(run['dataset']['root'])}", *settings(policy, before and before["policy"])]
    words += [f"{key}={run[key]}" for key in ("batch_size", "steps", "seed")]
    words += [f"output_dir={place(run['output_dir'])}"] if named else []
    chosen = run["dataset"].get("episodes")
    some = [] if chosen is None else [f"    {episodes(chosen)} \\"]
    return [f"lerobot train {kind} \\", *some, f"    {shlex.join(words)}"]


def episodes(chosen: Sequence[int]) -> str:
    """Return the word that chooses episodes of a dataset, short where many follow one another."""
    gaps = [0, *(index for index in range(1, len(chosen)) if chosen[index] != chosen[index - 1] + 1), len(chosen)]
    runs = [(chosen[first], chosen[past - 1]) for first, past in pairwise(gaps)]
    return f'episodes="[{",".join(f"$(seq -s, {first} {last})" for first, last in runs)}]"'


def place(folder: str | Path) -> str:
    """Return the path of a local folder in the commands of a card."""
    return f"outputs/{Path(folder).name}"


def settings(policy: dict[str, Any], before: dict[str, Any] | None = None) -> list[str]:
    """Return the settings that differ from the defaults of the policy's size and perception, or from ``before``."""
    usual = encoded_config(MemobenchMemConfig(device="cpu", size=policy["size"], perception=policy["perception"]))
    known = usual | (before or {})
    given = {key: policy[key] for key in sorted({*usual} & {*policy} - {*ELSEWHERE, *FOLLOWING})}
    return [
        f"policy.{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in given.items()
        if value != known[key]
    ]


def demonstrations(
    runs: Sequence[dict[str, Any]], trained_on: dict[str, Any], merged: Mapping[Path, Sequence[Path]]
) -> list[str]:
    """Return the demonstrations of a training and their commands, by the manifests in the datasets' folders."""
    roots = [Path(run["dataset"]["root"]) for run in runs]
    try:
        parts = dict.fromkeys(part for root in roots for part in generated(root, merged))
        manifests = {part: read_manifest(part) for part in parts}
        made = sum(episode["failure"] is None for manifest in manifests.values() for episode in manifest["episodes"])
        count, digest = len({e["task_name"] for m in manifests.values() for e in m["episodes"]}), trained_on["sha256"]
        commands = [
            line
            for part in parts
            for line in (
                f"memobench generate {shlex.join(generation(manifests[part]['request']))} \\",
                f"    --out {place(part)}",
            )
        ]
    except (FileNotFoundError, KeyError, TypeError):  # it is gone, has no folder, or was not generated
        return ["Trained on a dataset that was not at hand when this card was written."]
    return [
        f"Trained on {made} demonstrations by the scripted expert, of {count} task{'s' if count > 1 else ''}; sha256",
        f"of the dataset's meta files and manifest: `{digest}`.",
        "",
        "```bash",
        *commands,
        *(line for root, own in merged.items() for line in merging(root, own)),
        "```",
    ]


def generated(root: Path, merged: Mapping[Path, Sequence[Path]]) -> list[Path]:
    """Return the generated datasets that were merged into ``root``; itself if it was generated."""
    return [part for own in merged[root] for part in generated(own, merged)] if root in merged else [root]


def merging(root: Path, parts: Sequence[Path]) -> list[str]:
    """Return LeRobot's command that makes one dataset of several."""
    names = [place(part) for part in parts]
    return [
        f"lerobot-edit-dataset --operation.type=merge --new_repo_id=local/{root.name} --new_root={place(root)} \\",
        f"    --operation.repo_ids='[{', '.join(f'local/{part.name}' for part in parts)}]' \\",
        f"    --operation.roots='[{', '.join(names)}]'",
    ]


def generation(request: dict[str, Any]) -> list[str]:
    """Return the words of `memobench generate` of a manifest's request."""
    suite = get_task(request["tasks"][0]).suite
    every = sorted(request["tasks"]) == sorted(task_names(suite=suite))
    options = {
        "--tasks": "all" if every else ",".join(request["tasks"]),
        "--suite": suite,
        "--episodes": request["episodes"],
        "--prompted-episodes": request.get("prompted_episodes"),
        "--seed-base": request["seed_base"],
        "--referent": None if request["referent"] == DRAWN else request["referent"],
        "--image-size": request["image_size"] if request["images"] else None,
        "--policy": driver(request),
    }
    flags = {"--perturb": request["perturb"], "--no-images": not request["images"]}
    flags["--no-demonstration-prompt"] = not request["demonstration_prompt"]
    given = [str(word) for option in options.items() if option[1] is not None for word in option]
    return given + [flag for flag, meant in flags.items() if meant]


def driver(request: dict[str, Any]) -> str | None:
    """Return the policy that moved the arm, as a command names it; None if none did."""
    name, _, _ = (request.get("policy") or "").rpartition(" ")  # followed by a hash of its weights
    return (name if name in shipped_policies() else place(name)) if name else None


def results(name: str, rollouts: Path) -> list[str]:
    """Return the results of an evaluation, as a table."""
    report = json.loads((rollouts / REPORT_JSON).read_text())
    rows = {**report["memory_types"], "average": report["average"], **report["tasks"]}
    body = [
        f"| {scope} | {row['n']} | " + " | ".join(_number(row[key]) for key in ("SR", "MSR", "MUR", "MCR")) + " |"
        for scope, row in rows.items()
    ]
    head = ["| | rollouts | SR | MSR | MUR | MCR |", "|---|---|---|---|---|---|"]
    given = json.loads((rollouts / EVALUATION_FILE).read_text())["runs"][0]["command"][2:]
    words = [f"policy={name}", *(word for word in given if word.partition("=")[0] not in OF_THE_MACHINE)]
    command = shlex.join(["lerobot", "eval", "env=memobench", *words])
    return ["", f"`{command}`, sha256 of its log `{file_hash(rollouts / MERGED_FILE)}`:", "", *head, *body]


def check_rollouts(rollouts: Path, folder: Path) -> None:
    """Refuse rollouts that are not whole, or of other weights than those in the policy's folder."""
    whole = read_evaluation(rollouts, whole=True)
    if not (rollouts / REPORT_JSON).is_file() or read_run(rollouts).missing is not None:
        raise SystemExit(f"{rollouts} lacks episodes or its report; resume the evaluation, then `memobench report` it")
    if whole["runs"][0]["command"][:2] != ["lerobot", "eval"]:
        raise SystemExit(f"{rollouts} is not of `lerobot eval`, so its command is not known; evaluate the policy by it")
    here = tree_hash(checkpoint_files(folder)) if folder.is_dir() else None
    if (there := whole["policy"].get("sha256")) != here:
        raise SystemExit(f"{rollouts} has rollouts of other weights ({there}) than {folder} ({here}); evaluate those")


def replace_results(name: str, rollouts: Path) -> Path:
    """Replace the results on the card of the package's policy ``name``; return its folder."""
    check_rollouts(rollouts, SHIPPED / name)
    file = SHIPPED / name / "README.md"
    before, _, _ = file.read_text().partition("\n`lerobot eval env=memobench ")
    write_file(file, "\n".join([before, *results(name, rollouts)[1:]]) + "\n")
    return SHIPPED / name


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output_dir of a training run, or the policy's own name")
    parser.add_argument("name", help="by which policy= finds it")
    parser.add_argument("--rollouts", type=Path, help="output_dir of its evaluation")
    parser.add_argument(
        "--merged",
        type=Path,
        nargs="+",
        action="append",
        default=[],
        metavar=("DATASET", "PART"),
        help="a training dataset, and those that lerobot-edit-dataset merged into it; repeatable, in order",
    )
    given = parser.parse_args()
    parts = {whole: parts for whole, *parts in given.merged}
    if str(given.run) == given.name and given.rollouts is not None:
        print(replace_results(given.name, given.rollouts))
    else:
        print(ship(given.run, given.name, given.rollouts, parts))
