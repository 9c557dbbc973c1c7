"""Put a trained policy into the package: its weights in bfloat16, and a card with what made it and what it solves.

    python scripts/ship_policy.py outputs/joint/policies/memory-0 memobench_small --rollouts outputs/eval/small

The rollouts are those of the folder that this writes (policy=memobench_small), so that what is told is what is shipped:
write once without them, evaluate, and write again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from lerobot_memobench.engine.policy_identity import training_facts
from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.evaluation.documents.report import REPORT_JSON
from lerobot_memobench.files import file_hash, write_file
from lerobot_memobench.policies.checkpoint import SHIPPED, WEIGHTS_FILE, checkpoint_folder

LARGEST = 4_000_000
"""Bytes that one policy may take."""
HEAD = """---
license: apache-2.0
library_name: lerobot
pipeline_tag: robotics
tags: [lerobot, memobench, memory]
---

"""


def ship(run: Path, name: str, rollouts: Path | None) -> Path:
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
    write_file(folder / "README.md", card(name, source, weights, rollouts))
    size = sum(path.stat().st_size for path in folder.iterdir())
    if size > LARGEST:
        raise SystemExit(f"{folder} takes {size:,} bytes; expected at most {LARGEST:,}")
    return folder


def card(name: str, source: Path, weights: dict[str, torch.Tensor], rollouts: Path | None) -> str:
    """Return the Markdown that goes with a policy."""
    told = json.loads((source / "train_config.json").read_text())
    facts: dict[str, Any] = {**(training_facts(source) or {})}
    policy = told["policy"]
    words = [f"policy.{key}={policy[key]}" for key in ("integration", "objective", "memory_stride", "align")]
    count = sum(value.numel() for value in weights.values()) / 1e6
    lines = [
        f"# {name}",
        "",
        f"`memobench_mem`, {count:.1f} million parameters, bfloat16; sees objects, not pixels. Trained on the scripted",
        "expert's demonstrations of all thirty published tasks with random referents, seeds from 10,000 on:",
        "",
        "```bash",
        "memobench generate --tasks all --referent random --episodes 20 --perturb --no-images --out outputs/data",
        "lerobot train policy=memobench_mem perception=objects size=small dataset=outputs/data \\",
        f"    {' '.join(words)} batch_size={told['batch_size']} steps={told['steps']} seed={told['seed']}",
        "```",
        "",
        f"sha256 of the dataset's meta files and manifest: `{facts.get('sha256')}`.",
        *([] if rollouts is None else results(name, rollouts)),
    ]
    return HEAD + "\n".join(lines) + "\n"


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
    given = parser.parse_args()
    print(ship(given.run, given.name, given.rollouts))
