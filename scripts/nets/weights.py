"""Net ``weights``: losses and weights after twelve updates of each memory, from objects and from images.

`lerobot train policy=memobench_mem size=small` on two demonstrations that the expert records here. Names of tensors are
a fact of their own, so that a renamed module changes no other one. About 2 CPU minutes.
"""

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_memobench.policies.memobench_mem.memory import NONE, OURS
from scripts.nets.access import succeed
from scripts.nets.store import BITS, Facts, Parts, digest

TASKS = "4,24"
SETTINGS = ("size=small", "seed=3", "device=cpu", "steps=12", "batch_size=6", "log_freq=1")


def parts() -> Parts:
    """Return one part per input and memory."""
    return {
        f"{inputs} {memory}": partial(train, inputs, memory)
        for inputs in ("objects", "pixels")
        for memory in (NONE, *OURS)
    }


def train(inputs: str, memory: str, folder: Path) -> Facts:
    """Train a policy for a few updates; return the facts of its losses and weights."""
    from safetensors.numpy import load_file

    dataset, out = folder / f"{inputs}_dataset", folder / f"{inputs}_{memory}"
    if not (dataset / "meta" / "info.json").exists():
        images = "--images" if inputs == "pixels" else "--no-images"
        succeed("memobench", "generate", "--tasks", TASKS, "--episodes", 1, images, "--out", dataset)
    chosen = ("policy=memobench_mem", f"policy.memory={memory}", f"perception={inputs}", f"dataset={dataset}")
    shutil.rmtree(out, ignore_errors=True)  # of an interrupted run
    align = "none" if memory in ("none", "keyframes") else "contrastive"  # these have nothing to align
    succeed("lerobot", "train", *chosen, *SETTINGS, f"align={align}", "num_workers=0", f"output_dir={out}")
    found: Facts = {}
    for row in pd.read_csv(out / "losses.csv").itertuples():
        if "loss" in str(row.name) or row.name == "grad_norm":
            found.setdefault(f"{inputs} {memory} update {row.step}", {})[str(row.name)] = float(row.value)
    weights = load_file(out / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    every = np.concatenate([np.sort(np.float64(tensor).ravel()) for tensor in weights.values()])
    found[f"{inputs} {memory}"] = {
        **{
            f"weights {BITS}": digest(*sorted(map(digest, weights.values()))),
            "weights size": float(np.abs(every).mean()),
        },
        **{"tensors": len(weights), "parameters": len(every), "names of tensors": digest(*sorted(weights))},
    }
    return found
