"""Put a trained policy into the package: its weights in bfloat16, and a card with what made it and what it solves.

    python scripts/ship_policy.py outputs/joint/policies/memory-0 memobench_small --rollouts outputs/eval/small

The rollouts are those of the folder that this writes (policy=memobench_small), so that what is told is what is shipped:
write once without them, evaluate, and write again.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from lerobot_memobench.datasets.manifest import read_manifest
from lerobot_memobench.engine.policy_identity import ELSEWHERE, encoded, training_facts
from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.evaluation.documents.report import REPORT_JSON
from lerobot_memobench.files import file_hash, write_file
from lerobot_memobench.policies.checkpoint import SHIPPED, WEIGHTS_FILE, checkpoint_folder
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import DRAWN

LARGEST = 4_000_000
"""Bytes that one policy may take."""
OF_THE_DATA = ("input_features", "output_features", "action_feature_names", "object_classes")
"""Settings of a policy that its dataset decides."""
HEAD = """---
license: apache-2.0
library_name: lerobot
pipeline_tag: robotics
tags: [lerobot, memobench, memory]
---

"""


def ship(run: Path, name: str, rollouts: Path | None, merged: Sequence[Path] = ()) -> Path:
    """Write the last checkpoint of a training run as the package's policy ``name``; return its folder."""
    source, folder = checkpoint_folder(str(run)), SHIPPED / name
    if source is None:
        raise SystemExit(f"{run} holds no checkpoint; name the output_dir of a `lerobot train`")
    folder.mkdir(parents=True, exist_ok=True)
    weights = load_file(source / WEIGHTS_FILE)
    narrow = {key: value.to(torch.bfloat16) if value.is_floating_point() else value for key, value in weights.items()}
    save_file(narrow, folder / WEIGHTS_FILE, metadata={"format": "pt"})
    for path in source.glob("policy_*processor*"):
        shutil.copy(path, folder)
    config = json.loads((source / "config.json").read_text())
    write_file(
        folder / "config.json", json.dumps({**config, "device": "cpu", "pretrained_path": None}, indent=4) + "\n"
    )
    write_file(folder / "README.md", card(name, source, weights, rollouts, merged))
    size = sum(path.stat().st_size for path in folder.iterdir())
    if size > LARGEST:
        raise SystemExit(f"{folder} takes {size:,} bytes; expected at most {LARGEST:,}")
    return folder


def card(
    name: str, source: Path, weights: dict[str, torch.Tensor], rollouts: Path | None, merged: Sequence[Path] = ()
) -> str:
    """Return the Markdown that goes with a policy; ``merged`` are the datasets that LeRobot made one of for it."""
    told = json.loads((source / "train_config.json").read_text())
    policy = told["policy"]
    count = sum(value.numel() for value in weights.values()) / 1e6
    words = [*settings(policy), *(f"{key}={told[key]}" for key in ("batch_size", "steps", "seed"))]
    lines = [
        f"# {name}",
        "",
        f"`memobench_mem`, {count:.1f} million parameters, bfloat16; sees {policy['perception']}.",
        *demonstrations(training_facts(source) or {}, merged),
        "",
        "```bash",
        f"lerobot train policy=memobench_mem perception={policy['perception']} size={policy['size']} \\",
        f"    dataset=outputs/data {shlex.join(words)}",
        "```",
        *([] if rollouts is None else results(name, rollouts)),
    ]
    return HEAD + "\n".join(lines) + "\n"


def settings(policy: dict[str, Any]) -> list[str]:
    """Return what was said of a policy in training: where it is not as its size and perception decide."""
    usual = encoded(MemobenchMemConfig(device="cpu", size=policy["size"], perception=policy["perception"]))
    said = {key: policy[key] for key in sorted({*usual} & {*policy} - {*ELSEWHERE, *OF_THE_DATA})}
    return [
        f"policy.{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in said.items()
        if value != usual[key]
    ]


def demonstrations(trained_on: dict[str, Any], merged: Sequence[Path]) -> list[str]:
    """Return what a policy was trained on and the commands that made it, by the manifests in the datasets' folders."""
    try:
        manifests = [read_manifest(part) for part in merged or [Path(trained_on["root"])]]
        made = sum(episode["failure"] is None for manifest in manifests for episode in manifest["episodes"])
        requests, digest = [manifest["request"] for manifest in manifests], trained_on["sha256"]
        count = len({task for request in requests for task in request["tasks"]})
        names = [f"outputs/part{number}" for number in range(1, len(merged) + 1)]
        commands = [
            line
            for request, out in zip(requests, names or ["outputs/data"], strict=True)
            for line in (f"memobench generate {shlex.join(generation(request))} \\", f"    --out {out}")
        ]
    except (FileNotFoundError, KeyError, TypeError):  # it is gone, has no folder, or was not generated
        return ["Trained on a dataset that was not at hand when this card was written."]
    return [
        f"Trained on {made} demonstrations by the scripted expert, of {count} task{'s' if count > 1 else ''}; sha256",
        f"of the dataset's meta files and manifest: `{digest}`.",
        "",
        "```bash",
        *commands,
        *(merging(names) if merged else []),
        "```",
    ]


def merging(names: Sequence[str]) -> list[str]:
    """Return LeRobot's command that makes one dataset of several."""
    return [
        "lerobot-edit-dataset --operation.type=merge --new_repo_id=local/data --new_root=outputs/data \\",
        f"    --operation.repo_ids='[{', '.join(f'local/{Path(name).name}' for name in names)}]' \\",
        f"    --operation.roots='[{', '.join(names)}]'",
    ]


def generation(request: dict[str, Any]) -> list[str]:
    """Return the words of `memobench generate` that ask for what a manifest says was asked for."""
    suite = get_task(request["tasks"][0]).suite
    every = sorted(request["tasks"]) == sorted(task_names(suite=suite))
    options = {
        "--tasks": "all" if every else ",".join(request["tasks"]),
        "--suite": suite,
        "--episodes": request["episodes"],
        "--seed-base": request["seed_base"],
        "--referent": None if request["referent"] == DRAWN else request["referent"],
        "--image-size": request["image_size"] if request["images"] else None,
    }
    flags = {"--perturb": request["perturb"], "--no-images": not request["images"]}
    flags["--no-prompt-video"] = not request["prompt_video"]
    given = [str(word) for option in options.items() if option[1] is not None for word in option]
    return given + [flag for flag, meant in flags.items() if meant]


def results(name: str, rollouts: Path) -> list[str]:
    """Return what an evaluation says, as a table."""
    report = json.loads((rollouts / REPORT_JSON).read_text())
    rows = {**report["memory_types"], "average": report["average"], **report["tasks"]}
    body = [
        f"| {scope} | {row['n']} | " + " | ".join(_number(row[key]) for key in ("SR", "MSR", "MUR", "MCR")) + " |"
        for scope, row in rows.items()
    ]
    head = ["| | rollouts | SR | MSR | MUR | MCR |", "|---|---|---|---|---|---|"]
    said = f"`lerobot eval env=memobench policy={name} referent=random`, evaluation seeds from 7 on, sha256 of its log"
    return ["", f"{said} `{file_hash(rollouts / MERGED_FILE)}`:", "", *head, *body]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output_dir of a training run")
    parser.add_argument("name", help="by which policy= finds it")
    parser.add_argument("--rollouts", type=Path, help="output_dir of its evaluation")
    parser.add_argument("--merged", type=Path, nargs="+", default=[], help="datasets that the training's is made of")
    given = parser.parse_args()
    print(ship(given.run, given.name, given.rollouts, given.merged))
