"""Rewrite a memobench_mem checkpoint of an earlier version in this version's settings.

    python -m lerobot_memobench.policies.update_checkpoint CHECKPOINT ...

The values of weights are not changed; those of memory modulation get new names, and their training cannot be resumed. A
note is printed for each removed setting whose value differs from this version's behaviour.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.jobs.start import prepare_process
from lerobot_memobench.policies.checkpoint import (
    ADAPTER_FILE,
    CONFIG_FILE,
    PREPROCESSOR_FILE,
    REMOVED_FIELDS,
    WEIGHTS_FILE,
    Processor,
    checkpoint_folder,
    read_json,
    undamaged,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    ALIGN_WEIGHTS,
    SHUFFLE_SEED,
    SHUFFLED,
    SIZES,
    TOKENS_PER_FRAME,
)

TRAIN_CONFIG, TRAINING_FILE = "train_config.json", "training_weights.safetensors"
PHASE_WEIGHT = "model.memory.pool.phase.weight"
NESTED = re.compile(
    r"paligemma_with_expert\.gemma_expert\.model\.layers\.(\d+)\.post_attention_layernorm\.(norm|modulator)\."
)
"""Part of the names that modulated norms and their modulators once had."""
BEHAVIOUR: Mapping[str, Callable[[Mapping[str, Any]], tuple[Any, ...]]] = {
    "shuffle_seed": lambda saved: (SHUFFLE_SEED,) if saved.get("shuffle_subgoals") else (saved["shuffle_seed"],),
    "align_weight": lambda saved: (ALIGN_WEIGHTS[saved.get("align", "none")], None, 0.0),
    "min_lr_ratio": lambda saved: (SIZES[saved.get("size", "tiny")].final_learning_rate, None),
    "open_gate": lambda _: (False,),
    "full_chunk_when_stalled": lambda saved: (saved.get("perception") == "objects",),
}
"""Removed setting -> the values that equal this version's behaviour, which is the first."""


def update_checkpoint(folder: Path) -> list[str]:
    """Rewrite the settings in a checkpoint's files.

    Returns:
        A note for each setting whose value differs from this version's behaviour.

    Raises:
        MemobenchError: this version cannot act as the checkpoint was trained.
    """
    path, training, processor = (folder / name for name in (CONFIG_FILE, TRAIN_CONFIG, PREPROCESSOR_FILE))
    saved = read_json(path)
    policy, notes = updated(saved, folder), []
    for name, values in BEHAVIOUR.items():
        if name in saved and saved[name] not in values(saved):
            notes.append(f"{name} was {saved[name]}; this version continues with {values(saved)[0]}")
    if processor.is_file():
        content = read_json(processor, Processor)
        for step in content.get("steps", []):
            if step.get("registry_name") == "memobench_gather_memory":
                settings: Any = step.get("config", {})
                step["config"] = {name: one for name, one in settings.items() if name == "subgoals"}
        write_file(processor, json.dumps(content, indent=2))
    if training.is_file():
        config = read_json(training)
        config["policy"] = updated(config["policy"], folder)
        write_file(training, json.dumps(config, indent=4))
    if any(NESTED.search(name) for name in tensor_names(folder / WEIGHTS_FILE)):
        state = folder.parent / "training_state"
        if state.is_dir():
            shutil.move(state, state.with_name("training_state.earlier"))
            notes.append(
                f"the training cannot be resumed: its parameters had another order; begin with policy={folder}"
            )
        for file in (folder / TRAINING_FILE, folder / WEIGHTS_FILE):
            if file.is_file():
                rename_modulators(file)
    write_file(path, json.dumps(policy, indent=4))  # last, so that an interrupted update is repeated
    return notes


def updated(saved: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a policy's settings in the form of this version.

    Raises:
        MemobenchError: this version cannot act as the checkpoint was trained.
    """
    policy = {name: value for name, value in saved.items() if name not in REMOVED_FIELDS}
    if saved.get("shuffle_subgoals"):
        policy["align_targets"] = SHUFFLED
    memory = saved.get("memory") or ("none" if saved.get("memory_fusion") == "none" else "frames")
    settings = dict(saved.get("memory_settings") or {})
    tokens = TOKENS_PER_FRAME[saved.get("perception", "pixels")]
    unsupported = {
        "memory_settings.time_codes": memory != "none" and settings.pop("time_codes", True) is not True,
        "tokens_per_frame": memory != "none" and saved.get("tokens_per_frame") not in (None, tokens),
        "visual_encoder": saved.get("visual_encoder") == "random",
        "peft.method_type": any("modulator" in name for name in tensor_names(folder / ADAPTER_FILE)),
    }
    for name, present in unsupported.items():
        if present:
            raise MemobenchError(
                f"{folder} was trained with another value of {name} than this version's; use the version that "
                "trained it, or train it again"
            )
    if memory in ("frames", "subgoal"):
        settings = {"frames": saved.get("memory_frames", 32), "content": True} | settings
    if memory == "none":
        return policy | {"memory": memory, "memory_settings": {}, "memory_fusion": None}
    if "memory_phase" not in saved and PHASE_WEIGHT in tensor_names(folder / WEIGHTS_FILE):  # once always recorded
        policy["memory_phase"] = True
    return policy | {"memory": memory, "memory_settings": settings}


def rename_modulators(file: Path) -> None:
    """Rename the norms and modulators in a file of weights."""
    with undamaged(file), safe_open(file, framework="pt") as tensors:
        metadata, found = tensors.metadata(), {name: tensors.get_tensor(name) for name in tensors.keys()}  # noqa: SIM118
    labels = None if metadata is None else {name_now(key): value for key, value in metadata.items()}
    write_file(file, save({name_now(name): tensor for name, tensor in found.items()}, metadata=labels))


def name_now(name: str) -> str:
    """Return the present name of a tensor."""
    nested = NESTED.search(name)
    if nested is None:
        return name
    layer, part = nested.groups()
    if part == "norm":
        return name.replace("post_attention_layernorm.norm.", "post_attention_layernorm.")
    return f"{name[: nested.start()]}modulators.{layer}.{name[nested.end() :]}"


def tensor_names(file: Path) -> set[str]:
    """Return the names of the tensors in a file; none if it does not exist."""
    if not file.is_file():
        return set()
    with undamaged(file), safe_open(file, framework="numpy") as tensors:
        return set(tensors.keys())


def main(names: Sequence[str]) -> None:
    """Update checkpoints, or the last ones of training runs."""
    for name in names:
        folder = checkpoint_folder(name)
        if folder is None:
            raise MemobenchError(f"{name} is no checkpoint folder; give one that holds {CONFIG_FILE}")
        for note in update_checkpoint(folder):
            print(f"note: {note}")
        print(f"updated: {folder}")


if __name__ == "__main__":
    prepare_process()
    main(sys.argv[1:])
