"""Memory of a GPU, main memory and disk that a training of ``memobench_mem`` needs, counted before anything is loaded.

The policy is built on torch's meta device, so every weight is counted and none is made. Weights, gradients, AdamW's
state, average, buckets and shards are exact. Activations are an estimate from layers and tokens, and from what a sample
leaves behind in the memory (`memory_use`). What was measured on one GPU with ``memory=frames``
(docs/research/full_size_on_one_gpu.md) is at most 4 % below the count; tests hold that.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import tempfile
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_memobench.datasets.feature_cache.frames import read_frame_table
from lerobot_memobench.datasets.lerobot_format.layout import read_info
from lerobot_memobench.envs.command_line import overrides, quiet
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.run.arguments import CONFIG_FILE, LerobotArguments, read_config_file, whole_number
from lerobot_memobench.run.plan import policy_config
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import LEVELS

if TYPE_CHECKING:
    from lerobot_memobench.run.memory_use import MemoryUse

logger = logging.getLogger(__name__)

GIB = 2**30
OVERHEAD = 2 * GIB
"""CUDA's context, NCCL, and what the allocator keeps unused; 1 to 5 GiB measured."""
SLACK = 0.97
"""Share of the count that was measured at least."""
OF_A_LAYER = 0.6
"""Share of a layer's activations that stand when it is computed once more, with gradient checkpointing; measured."""
FRAMES = 750_000
"""Of 1,500 demonstrations, about; taken where no dataset lies here."""
RANK_OF_ADAPTERS = 16
"""LeRobot's, of LoRA."""
WHOLE, DDP, FSDP = "one GPU", "DDP", "FSDP"
LORA, EXPERT = "LoRA", "expert, memory"
MEMORY = "memory"
HOW = {
    FSDP: "shards over several GPUs (accelerate launch --use_fsdp)",
    LORA: "adapters (--peft.method_type=LORA)",
    EXPERT: "memory and action expert only (policy.train_expert_only=true)",
}
"""What may be chosen instead, and by which setting."""


@dataclass(frozen=True)
class Weights:
    """Numbers of a policy's weights.

    Attributes:
        trained: that learn; of these ``ungraded`` never get a gradient, the last of the language model's layers behind
            its keys and values, ``embedded`` are of the table of words, and ``in_units`` in units that FSDP gathers one
            by one, of which the largest has ``unit``.
        frozen: bytes of what does not learn.
    """

    trained: int
    ungraded: int
    embedded: int
    in_units: int
    unit: int
    frozen: int


@dataclass(frozen=True)
class Need:
    """Bytes of one GPU in a way of training.

    Attributes:
        copies: of weights in the precision that is computed in; under FSDP whole weights and their gradients.
        activations: at the end of the forward pass. left: of these, when the last gradients come.
        start: bytes before the first update where that is more than an update takes.
    """

    way: str
    weights: int
    frozen: int
    optimizer: int
    average: int
    gradients: int
    buckets: int
    copies: int
    activations: int
    left: int
    start: int = 0

    @property
    def peak(self) -> int:
        """Bytes at the most."""
        stays = self.weights + self.frozen + self.optimizer + self.average + self.buckets
        # Autocast's copies go as the gradients come; FSDP's whole gradients stand beside their shards.
        backward = self.gradients + (self.copies if self.way == FSDP else 0) + self.left
        return max(self.start, stays + max(self.copies + self.activations, backward))

    def fits(self, card: int) -> bool | None:
        """Return whether it fits a GPU of so many bytes; None: only a trial can tell."""
        if self.peak + OVERHEAD <= card:
            return True
        return False if self.peak * SLACK > card else None


@dataclass(frozen=True)
class Training:
    """A training as far as memory and disk ask: ``batch`` is of each process; ``way`` None: whole weights learn."""

    config: MemobenchMemConfig
    batch: int
    gpus: int = 1
    steps: int = 0
    save_freq: int = 0
    frames: int = FRAMES
    way: str | None = None
    counted: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """What was counted already, of each way and of the memory; shared by trainings that differ in numbers alone."""

    def weights(self, way: str) -> Weights:
        """Return the numbers of weights in a way to train, counted once."""
        kind = way if way in (LORA, EXPERT) else WHOLE
        if kind not in self.counted:
            self.counted[kind] = count_weights(replace_config(self.config, way), adapters=way == LORA)
        found: Weights = self.counted[kind]
        return found

    @property
    def memory(self) -> MemoryUse:
        """What the memory takes of each sample, found once."""
        from lerobot_memobench.run.memory_use import memory_use

        if MEMORY not in self.counted:
            self.counted[MEMORY] = memory_use(self.config)
        found: MemoryUse = self.counted[MEMORY]
        return found

    def need(self) -> Need:
        """Return what it needs of each GPU."""
        return need(self, self.way or (WHOLE if self.gpus == 1 else DDP))

    def ways(self) -> list[Need]:
        """Return what each way to train needs of each GPU, the largest first where GPUs are many."""
        whole = [WHOLE] if self.gpus == 1 else [DDP, FSDP]
        return [need(self, way) for way in (*whole, EXPERT, LORA)]


def training_of(arguments: LerobotArguments, gpus: int = 1) -> Training | None:
    """Return the training that a command line of ``lerobot train`` asks for; None where its policy is another.

    Raises:
        MemobenchError: a setting of the policy cannot be.
    """
    file = read_config_file(arguments.get(CONFIG_FILE))
    config = policy_config(arguments) or _policy_of_file(arguments, file)
    if not isinstance(config, MemobenchMemConfig):
        return None

    def number(name: str, default: int) -> int:
        found = whole_number(arguments.get(name))
        return int(file.get(name, default)) if found is None else found

    root = arguments.get("dataset.root") or (file.get("dataset") or {}).get("root")
    folder = None if root is None else Path(root).expanduser()
    here = folder is not None and folder.is_dir()
    if config.privileged_memory and not config.subgoals:
        config = replace_config(config, WHOLE, subgoals=_texts(folder if here else None, config.subgoal_level))
    adapters = any(flag.startswith("--peft.") for flag in arguments.flags) or bool(file.get("peft"))
    return Training(
        config,
        number("batch_size", 8),
        gpus,
        number("steps", 100_000),
        number("save_freq", 20_000),
        int(read_info(folder).get("total_frames", FRAMES)) if folder is not None and here else FRAMES,
        LORA if adapters else None,
    )


def _texts(folder: Path | None, level: str) -> dict[str, list[str]]:
    """Return texts of checkpoints that a memory may learn from: a dataset's, else those of the published tasks."""
    found = set() if folder is None else {*read_frame_table(folder).subgoals.get(level, [])} - {""}
    if not found:
        tasks = [get_task(name) for name in task_names()]
        found = {one.language[LEVELS.index(level)] for task in tasks for one in task.checkpoints}
    return {"": sorted(found)}


def _policy_of_file(arguments: LerobotArguments, file: dict[str, Any]) -> Any:
    """Return the configuration of a memobench_mem that a recipe names, with what the line changes of it."""
    import draccus

    section = file.get("policy")
    if not isinstance(section, dict) or section.get("type") != "memobench_mem":
        return None
    with tempfile.TemporaryDirectory() as folder, quiet():
        path = Path(folder) / "policy.json"
        path.write_text(json.dumps({key: value for key, value in section.items() if key != "type"}))
        given = [flag for flag in overrides("policy", arguments.for_parser) if not flag.startswith("--type=")]
        return draccus.parse(MemobenchMemConfig, path, args=given)


def refuse_too_large(arguments: LerobotArguments) -> None:
    """Refuse a training at full size that cannot fit the GPU it would run on, before anything is loaded.

    One whose memory cannot be counted may try.

    Raises:
        MemobenchError: it cannot.
    """
    import torch

    if not torch.cuda.is_available() or arguments.get("job.target") not in (None, "local"):
        return
    gpus = int(os.environ.get("WORLD_SIZE", "1"))
    from lerobot_memobench.run.memory_use import UncountedError

    training = training_of(arguments, gpus)
    if training is None or training.config.size != "pi05" or training.config.device == "cpu":
        return
    if gpus > 1 and training.way is None and os.environ.get("ACCELERATE_USE_FSDP", "").lower() == "true":
        training = replace(training, way=FSDP)
    card = torch.cuda.get_device_properties(int(os.environ.get("LOCAL_RANK", "0"))).total_memory
    try:
        check_fits(training, card)
    except UncountedError as error:
        logger.warning("whether it fits this GPU is not known: %s", error)


def check_fits(training: Training, card: int) -> None:
    """Refuse a training that cannot fit a GPU of so many bytes, and name what would.

    Raises:
        MemobenchError: it cannot fit.
    """
    asked = training.need()
    if asked.fits(card) is not False:
        return
    smaller = replace(training, batch=1)
    fitting = [HOW[one.way] for one in training.ways() if one.way in HOW and one.way != asked.way and one.fits(card)]
    if smaller.need().fits(card) and training.batch > 1:
        fitting.insert(0, "a smaller batch_size")
    if training.gpus == 1:
        room = round(SLACK * card)  # FSDP was counted, and never measured
        several = next((n for n in (2, 4, 8, 16) if need(replace(training, gpus=n), FSDP).fits(room)), None)
        fitting += [f"{several} such GPUs by accelerate launch --use_fsdp"] if several else []
    advice = ", or ".join(fitting) or "a larger GPU"
    raise MemobenchError(
        f"this training needs about {(asked.peak + OVERHEAD) / GIB:.0f} GiB of each GPU ({asked.way}, batch_size="
        f"{training.batch}), and there are {card / GIB:.0f}; what would fit: {advice}; `memobench fit` counts it"
    )


def need(training: Training, way: str) -> Need:
    """Return what a way to train needs of each GPU."""
    config = replace_config(training.config, way)
    weights = training.weights(way)
    active = activations(config, training.batch, training.memory)
    left = active if config.gradient_checkpointing else 0  # what is computed once more stands beside what was kept
    narrow = 2 if config.dtype == "bfloat16" else 4
    graded = weights.trained - weights.ungraded
    averages = bool(config.ema_decay) and way != LORA
    if way == FSDP:
        root, share = weights.trained - weights.in_units, training.gpus
        return Need(
            way,
            _part(4 * weights.trained, share),
            weights.frozen,
            _part(8 * graded, share),
            _part(4 * weights.trained * averages, share),
            _part(4 * graded, share),
            0,
            # Computed with, their gradients, and these in float32 while they are summed up; two units at once.
            (root + 2 * weights.unit) * (2 * narrow + 4),
            active,
            left,
            # A policy stands whole before it is sharded, and beside it the flat copy; an average that is gone on with.
            weights.frozen + 4 * weights.trained * (2 + averages),
        )
    return Need(
        way,
        4 * weights.trained,
        weights.frozen,
        8 * graded,
        4 * weights.trained * averages,
        4 * graded,
        4 * weights.trained * (training.gpus > 1),
        (weights.trained - weights.embedded) * narrow * (narrow == 2),
        active,
        left,
    )


def replace_config(config: MemobenchMemConfig, way: str, **more: Any) -> MemobenchMemConfig:
    """Return a configuration as a way to train takes it, with other settings where some are given."""
    changed = more | ({"train_expert_only": True} if way == EXPERT else {})
    if not changed:
        return config
    known = {one.name: getattr(config, one.name) for one in fields(config) if one.init}
    with quiet():
        return type(config)(**{**known, **changed})


def _part(whole: int, share: int) -> int:
    return math.ceil(whole / share)


def activations(config: MemobenchMemConfig, batch: int, memory: MemoryUse) -> int:
    """Estimate the bytes of a batch's activations at their most: two cameras, prompts of full length, and the memory's.

    A layer keeps, of each token, about 20 vectors of its width and 3 of its MLP's, and 12 bytes of each pair of tokens
    and head. With gradient checkpointing each keeps its input in float32, and one is computed at a time.
    """
    dims = config.dimensions
    prefix = 2 * (dims.vision.image // dims.vision.patch) ** 2 + (config.tokenizer_max_length or 0) + memory.prefix
    tokens = ((dims.vlm, prefix), (dims.expert, config.chunk_size + memory.suffix))
    pairs = dims.vlm.num_heads * sum(count for _, count in tokens) ** 2
    width = 2 if config.dtype == "bfloat16" else 4
    layer = width * sum(count * (20 * one.width + 3 * one.mlp_dim) for one, count in tokens) + 12 * pairs
    kept = 4 * sum(count * one.width for one, count in tokens)
    depth = dims.vlm.depth
    layers = round(depth * kept + OF_A_LAYER * layer if config.gradient_checkpointing else depth * layer)
    return batch * (layers + memory.kept)


def count_weights(config: MemobenchMemConfig, *, adapters: bool = False) -> Weights:
    """Count a policy's weights, none of which is made.

    Args:
        adapters: whether LeRobot's LoRA and the memory learn, and nothing else.
    """
    import torch
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy
    from torch import nn

    from lerobot_memobench.policies.memobench_mem.alignment import make_alignment
    from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import OWN_MODULES
    from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
    from lerobot_memobench.policies.memobench_mem.sharding import UNIT

    dims, policy = config.dimensions, nn.ModuleDict()
    with torch.device("meta"), quiet():
        policy["model"] = MemoryPI05(config)
        heads = make_alignment(
            config.align, dims.vlm.width, dims.text_dim, config.memory_frames, config.tokens_per_frame
        )
        if heads is not None:
            policy["alignment"] = heads
    if adapters:
        default: Any = PI05Policy._get_default_peft_targets
        pattern = re.compile(default(None)["target_modules"])
        whole = [m for name, m in policy.named_modules() if any(f".{name}".endswith(f".{end}") for end in OWN_MODULES)]
        learning = {one for module in whole for one in module.parameters()}
        low_rank = sum(
            RANK_OF_ADAPTERS * (module.in_features + module.out_features)
            for name, module in policy.named_modules()
            if isinstance(module, nn.Linear) and pattern.fullmatch(name)
        )
        trained = low_rank + sum(one.numel() for one in learning)
        return Weights(trained, 0, 0, 0, 0, sum(one.nbytes for one in policy.parameters()))
    last = (
        rf"\.language_model\.(norm\.|layers\.{dims.vlm.depth - 1}\.(mlp|self_attn\.o_proj|post_attention_layernorm)\.)"
    )
    named = {name: one for name, one in policy.named_parameters() if one.requires_grad}
    units = [
        sum(one.numel() for one in module.parameters() if one.requires_grad)
        for module in policy.modules()
        if type(module).__name__ == UNIT
    ]
    return Weights(
        sum(one.numel() for one in named.values()),
        sum(one.numel() for name, one in named.items() if re.search(last, name)),
        sum(one.numel() for name, one in named.items() if ".embed_tokens." in name),
        sum(units),
        max(units, default=0),
        sum(one.nbytes for one in policy.parameters() if not one.requires_grad),
    )


@dataclass(frozen=True)
class Disk:
    """Bytes on disk: of a checkpoint, whose optimizer state is ``optimizer``, how many there are, and of the cache."""

    checkpoint: int
    optimizer: int
    checkpoints: int
    cache: int

    @property
    def total(self) -> int:
        """Bytes of all checkpoints and the cache."""
        return self.checkpoint * self.checkpoints + self.cache


def disk(training: Training) -> Disk:
    """Count what a training writes: the averaged and the trained weights, AdamW's state, and the feature cache."""
    config = training.config
    weights = training.weights(training.way or WHOLE)
    optimizer = 8 * (weights.trained - weights.ungraded)
    model = 4 * weights.trained + (0 if training.way == LORA else weights.frozen)
    average = 4 * weights.trained * (bool(config.ema_decay) and training.way != LORA)
    count = math.ceil(training.steps / training.save_freq) if training.save_freq > 0 else 1
    cache = training.memory.stored * math.ceil(training.frames / config.memory_stride)
    return Disk(model + average + optimizer, optimizer, count, cache)
