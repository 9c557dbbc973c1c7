"""Configuration of ``memobench_mem``: dimensions of its sizes, its settings, their defaults and checks."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES
from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED
from lerobot_memobench.envs.observations import DETECTIONS, PIXEL_INPUT
from lerobot_memobench.envs.observations import PRIVILEGED as PRIVILEGED_INPUT
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.perception.weights import PACKAGE, RANDOM
from lerobot_memobench.policies.memobench_mem.memory import (
    NONE,
    OURS,
    find_mechanism,
    mechanism_names,
    read_settings,
    settings_of,
    settings_of_another,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MEMORY_GRID
from lerobot_memobench.policies.memobench_mem.subgoals import texts_of
from lerobot_memobench.protocol import CAMERAS, CLOCK, IMAGE_SIZE

logger = logging.getLogger(__name__)

FLOW_MATCHING, REGRESSION = "flow_matching", "regression"
OBJECTIVES = (FLOW_MATCHING, REGRESSION)
ALIGN_WEIGHTS: Mapping[str, float] = {"none": 0.0, "semantic": 0.1, "contrastive": 0.1, "framewise": 0.05}
SHUFFLE_SEED = 7
"""Seed of ``shuffle_subgoals``."""
MODULATION, CONTEXT, OWN = "modulation", "context", "own"
MEMORY_FUSIONS = (MODULATION, CONTEXT, OWN, NONE)
PERCEPTIONS = ("pixels", "objects")
SUBGOAL_LEVELS = ("coarse", "intermediate", "fine")
PROMPTED = "prompted"
"""Key of ``task_weights`` for tasks that begin with a demonstration prompt."""
TOKENS_PER_FRAME = {"pixels": MEMORY_GRID**2, "objects": 2}
MEMORY_FRAMES = 32
MEMORY_STRIDE, FRAMES_PER_EPISODE = 8, 6
"""Where training decodes no video; 1 elsewhere."""
ORACLE_TOKENS = 128
"""Room that oracle memory text needs in a prompt of the word tokenizer: six memory checkpoints of some ten words."""


@dataclass(frozen=True)
class Gemma:
    """One transformer of the pair (names as LeRobot's ``GemmaConfig``)."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class Vision:
    """The SigLIP image tower."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    patch: int
    image: int  # pixels per side of the policy's input


PAPERS: Mapping[str, Any] = {
    "chunk_size": 50,
    "n_action_steps": 50,
    "optimizer_weight_decay": 0.0,
    "ema_decay": 0.999,
    "objective": FLOW_MATCHING,
}
"""Defaults of the fields that a size decides: the paper's."""


@dataclass(frozen=True)
class Dimensions:
    """All dimensions and size-dependent defaults of one size."""

    vlm: Gemma
    expert: Gemma
    vision: Vision
    vocabulary: int
    tokenizer: str  # "words" (built here) or a Hugging Face tokenizer
    tokenizer_max_length: int
    text_encoder: str  # "words" or "labels" (built here) or a folder or repository of a SigLIP model
    text_dim: int
    learning_rate: float
    normalization: str = "QUANTILES"  # LeRobot's mode for states and actions
    final_learning_rate: float = 1.0  # at the end, as a fraction of the highest; 1: it stays constant
    defaults: Mapping[str, Any] = field(default_factory=lambda: PAPERS)


# The VLM's width is also the width d_m of the memory tokens (2048 at full size).
# LeRobot's attention code fixes 8 heads; widths and head dimensions are free.
_TINY = Dimensions(
    vlm=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
    expert=Gemma(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
    vision=Vision(width=96, depth=2, mlp_dim=192, num_heads=4, patch=12, image=96),
    vocabulary=1024,
    tokenizer="words",
    tokenizer_max_length=64,
    text_encoder="words",
    text_dim=64,
    learning_rate=1e-3,
)
SIZES = {
    "tiny": _TINY,
    "small": replace(
        _TINY,
        vlm=replace(_TINY.vlm, depth=3),
        expert=replace(_TINY.expert, depth=3),
        vocabulary=512,
        tokenizer_max_length=48,
        normalization="MEAN_STD",
        final_learning_rate=0.02,
        defaults={
            "chunk_size": 16,
            "n_action_steps": 6,
            "optimizer_weight_decay": 1e-4,
            "ema_decay": 0.995,
            "objective": REGRESSION,
        },
    ),
    "pi05": Dimensions(
        vlm=Gemma(width=2048, depth=18, mlp_dim=16_384, num_heads=8, num_kv_heads=1, head_dim=256),
        expert=Gemma(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
        vision=Vision(width=1152, depth=27, mlp_dim=4304, num_heads=16, patch=14, image=224),
        vocabulary=257_152,
        tokenizer="google/paligemma-3b-pt-224",
        tokenizer_max_length=200,
        text_encoder="google/siglip-so400m-patch14-224",
        text_dim=1152,
        learning_rate=5e-5,
    ),
}


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


FIXED = _names(
    """
    size perception object_classes memory memory_settings memory_fusion subgoals oracle_memory memory_camera
    memory_frames memory_phase tokens_per_frame memory_stride objective chunk_size normalization_mapping
    image_resolution tokenizer_name tokenizer_max_length input_features n_obs_steps paligemma_variant
    action_expert_variant max_state_dim max_action_dim min_period max_period use_relative_actions
    relative_exclude_joints action_feature_names empty_cameras
    """
)
"""Fields by which a checkpoint was trained, and which are refused where it acts under another value: its weights would
mean something else, mostly without a word. Those that decide others stand before them."""
OF_ACTING = _names(
    """
    n_action_steps full_chunk_when_stalled detector visual_encoder num_inference_steps rtc_config device dtype use_amp
    compile_model compile_mode freeze_vision_encoder pretrained_path pretrained_revision use_peft output_features
    """
)
"""Fields that are free where a checkpoint acts. A ``detector`` is no part of it, and its own ``visual_encoder`` has a
rule of its own (`checkpoints.read_config`); LeRobot makes ``output_features`` of the environment's, which
`policies.compatibility` compares with the checkpoint's, and ``freeze_vision_encoder`` has one value here."""
SINCE_BEGUN = _names(
    """
    align subgoal_level shuffle_subgoals text_encoder base_weights train_expert_only
    ema_decay warmup_fraction optimizer_lr optimizer_betas optimizer_eps optimizer_weight_decay
    optimizer_grad_clip_norm scheduler_warmup_steps scheduler_decay_steps scheduler_decay_lr
    """
)
"""Fields that a training keeps where it is gone on with: they decide the model's parts and what these
learn, or stand in the optimizer's saved state, which LeRobot makes from them once."""
PI05_ALONE = _names(
    "use_visual_memory use_proprioceptive_memory memory_temporal_attention_every rtc_training_max_delay"
)
"""Fields of pi0.5's own in LeRobot's main: its visual memory, and training for real-time chunking. They are not saved,
so that a checkpoint goes from one LeRobot to the other."""


def _remembers(config: MemobenchMemConfig, how: Callable[[Any], bool] = lambda _: True) -> bool:
    return config.memory != NONE and how(find_mechanism(config.memory))


READERS: Mapping[str, tuple[Callable[[MemobenchMemConfig], bool], str]] = {
    "perception=objects": (
        lambda it: it.uses_objects,
        "detector detection_noise object_classes full_chunk_when_stalled",
    ),
    "perception=pixels": (lambda it: not it.uses_objects, "image_resolution empty_cameras"),
    "a policy whose state is a token": (lambda it: it.state_token, "max_state_dim"),
    "a policy that sees pictures": (lambda it: it.uses_pictures, "memory_camera"),
    "size=small perception=pixels": (lambda it: it.size == "small" and not it.uses_objects, "visual_encoder"),
    "a memory": (_remembers, "memory_settings memory_fusion memory_stride tokens_per_frame"),
    "memory=frames or subgoal": (
        lambda it: _remembers(it, lambda one: issubclass(one, find_mechanism("frames"))),
        "memory_frames",
    ),
    "a memory of objects other than motion": (
        lambda it: it.uses_objects and _remembers(it, lambda one: not one.asks_motion),
        "memory_phase",
    ),
    "a memory with memory_fusion=modulation": (
        lambda it: it.memory != NONE and it.memory_fusion == MODULATION,
        "open_gate",
    ),
    "a memory that learns from texts": (lambda it: it.privileged_memory, "subgoals"),
    "an alignment": (lambda it: it.align != NONE, "shuffle_subgoals text_encoder"),
    "an alignment or a memory that learns from texts": (
        lambda it: it.align != NONE or it.privileged_memory,
        "subgoal_level",
    ),
    "objective=flow_matching": (
        lambda it: it.objective == FLOW_MATCHING,
        "num_inference_steps rtc_config time_sampling_beta_alpha time_sampling_beta_beta time_sampling_scale "
        "time_sampling_offset",
    ),
    "use_relative_actions=true": (lambda it: it.use_relative_actions, "relative_exclude_joints"),
    "compile_model=true": (lambda it: it.compile_model, "compile_mode"),
    "policy=pi05": (
        lambda _: False,
        "paligemma_variant action_expert_variant n_obs_steps freeze_vision_encoder "
        "scheduler_warmup_steps scheduler_decay_steps scheduler_decay_lr " + " ".join(PI05_ALONE),
    ),
}
"""What alone reads some fields, for messages -> whether a configuration has it, and the fields: each must have its
default where nothing reads it."""
RANGES = {
    **dict.fromkeys(_names("memory_frames memory_stride n_action_steps tokens_per_frame"), (1, math.inf)),
    **dict.fromkeys(_names("frames_per_episode num_inference_steps"), (1, math.inf)),
    "warmup_fraction": (0, 1),
    "detection_noise": (0, math.inf),
    "ema_decay": (0, math.nextafter(1, 0)),
}
"""Smallest and largest value of fields."""


class UnreadError(MemobenchError):
    """Fields that nothing reads have other values than their defaults.

    Attributes:
        defaults: those fields -> their defaults.
    """

    def __init__(self, sentence: str, defaults: Mapping[str, Any]) -> None:
        super().__init__(sentence)
        self.defaults = defaults


FROM_SIZE: Any = None
"""Default of a field that the size or the perception decides; after construction it is set."""


@PreTrainedConfig.register_subclass("memobench_mem")
@dataclass
class MemobenchMemConfig(PI05Config):
    """pi0.5's fields plus the memory's. Fields that are ``None`` here take the size's value in construction."""

    reads_prompt: ClassVar[bool] = True
    execution_only: ClassVar[bool] = True
    fixed_by_training: ClassVar[tuple[str, ...]] = FIXED
    kept_since_begun: ClassVar[tuple[str, ...]] = (*FIXED, *SINCE_BEGUN)

    size: str = "tiny"
    """``small`` (from scratch, learns from objects in minutes on a CPU), ``tiny`` (from scratch, trains on a CPU) or
    ``pi05`` (3.2 B)."""

    # -- observations
    perception: str = "pixels"
    """Source of observation tokens: ``pixels``, through a frozen image tower, or ``objects``, the slots of
    ``observation.environment_state`` (`sim.object_slots`): privileged object state, or detections."""
    detector: str | None = None
    """With ``perception=objects``, the detector whose detections in pictures stand for privileged object state: a file
    of `python -m research.detector train`, or ``package``; none: the environment gives the state. No part of a
    checkpoint, which only names it."""
    visual_encoder: str | None = None
    """With pixels at ``size=small``, the frozen encoder of pictures: that of a detector's file or of ``package`` (the
    default), or ``random``: pi0.5's image tower with random weights. A checkpoint holds its weights."""
    detection_noise: float = 0.0
    """Size of the errors that are added to privileged object state in training, so that the policy acts by a
    ``detector`` afterwards; 1: as large as those of the package's detector, 0: none."""
    object_classes: list[str] | None = None
    """Names of the classes that slots were trained with, in order of their indices; none: those of this version."""

    base_weights: str | None = None
    """Folder or repository of pi0.5 weights to start from (e.g. ``lerobot/pi05_base``); none: from scratch."""

    # -- alignment
    align: str = "none"
    """How memory is aligned with checkpoint language: ``none``, ``semantic``, ``contrastive`` or ``framewise``."""
    subgoal_level: str = "intermediate"
    """Level of the language that memory is aligned with: ``coarse``, ``intermediate`` or ``fine``."""
    shuffle_subgoals: bool = False
    """Control of the paper: the subgoal texts of an episode change places among themselves, or with those of other
    episodes where it has fewer than three; the same in every epoch and on every machine."""
    text_encoder: str | None = None
    """Encoder of subgoals: ``words`` (a hash of words), ``labels`` (a vector for each text, whatever its words), or
    folder or repository of a SigLIP model; none: the size's."""

    # -- memory
    memory: str = FROM_SIZE
    """What is remembered: ``frames`` (the default), another mechanism of `memory` or of a package that brings one, or
    ``none``: plain pi0.5, the baseline without a memory."""
    memory_settings: dict[str, Any] = field(default_factory=dict)
    """Settings of that mechanism (``Settings`` of its class); those that are not named have their defaults."""
    memory_fusion: str = FROM_SIZE
    """How actions read memory: ``modulation``, ``context`` (memory joins the prefix), ``own``, where the mechanism has
    a way of its own, or ``none`` without one. None: ``own``, or else ``modulation``."""
    open_gate: bool = False
    """With ``memory_fusion=modulation``, whether training begins with a random modulation, by which memory gets
    gradients from the first update on; else it begins with none, as plain pi0.5."""
    subgoals: dict[str, list[str]] | None = None
    """Instruction -> texts of its checkpoints, where the memory learns from them; none: those of the dataset."""
    oracle_memory: bool = False
    """Control of the paper: ground-truth memory text stands in the text prompt, from the dataset's column ``memory`` in
    training and from the environment (``--env.oracle_memory=true``) at evaluation."""
    memory_camera: str | None = None
    """Camera whose pictures are remembered; none: the first of the policy's."""
    memory_frames: int = MEMORY_FRAMES
    """Frames of the history that a chunk reads at most, with ``memory=frames`` or ``subgoal``."""
    tokens_per_frame: int = FROM_SIZE
    """Memory tokens of a remembered frame: 16 of a picture; 2, or another number, of objects."""
    memory_stride: int = FROM_SIZE
    """Control steps from one frame of the history (and the cache) to the next; none: the mechanism's, or 8 where
    training decodes no video (objects, and pixels through a visual encoder), else 1."""
    memory_phase: bool = False
    """Whether a remembered frame of objects tells whether it was of the prompt. A memory that knows when the execution
    began has the clock of it, which strict tasks hide."""

    # -- training
    objective: str = FROM_SIZE
    """How actions are learned: ``flow_matching``, as in pi0.5, or ``regression``, whose chunk is one pass of the model
    instead of ten (`training`). None: the size's, ``regression`` at ``small``."""
    ema_decay: float = FROM_SIZE
    """Decay of the weights' moving average, which evaluation uses; 0 turns it off. None: the size's, the paper's
    0.999 or 0.995 at ``small``."""
    frames_per_episode: int = FROM_SIZE
    """Frames of an episode that stand side by side in a batch, and share memory; none: 6 where training decodes no
    video, else 1, LeRobot's order. ``batch_size`` counts frames all the same."""
    task_weights: dict[str, float] | None = None
    """Tasks are drawn in proportion to these weights, however long their episodes are. Keys are task names, memory
    types or ``prompted`` (tasks that begin with a demonstration prompt), of which the first that a task has counts;
    other tasks weigh 1, and ``{}`` draws all alike. None: ``{}`` where training decodes no video, else frames alike."""
    warmup_fraction: float = 0.05
    """Share of the updates in which the learning rate rises to its highest; it then stays, or falls as a cosine to
    0.02 of it at ``size=small``."""

    # -- pi0.5's fields with this recipe's values, or the size's where they are None or empty
    freeze_vision_encoder: bool = True
    """Always: memory tokens are cached from the image tower."""
    chunk_size: int = FROM_SIZE
    """Actions of a chunk; none: the size's, 16 at ``small``, else 50."""
    n_action_steps: int = FROM_SIZE
    """Actions executed of a chunk before the next one; none: the size's, 6 at ``small``, else 50."""
    full_chunk_when_stalled: bool = False
    """Whether a whole chunk is executed, and not its first ``n_action_steps``, where the hand stands as it stood at the
    chunk before: on a rim it might stand for ever, and plan each time to let go a little later."""
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)
    image_resolution: tuple[int, int] | None = None
    tokenizer_name: str | None = None
    tokenizer_max_length: int | None = None
    optimizer_lr: float | None = None
    optimizer_weight_decay: float = FROM_SIZE

    def __post_init__(self) -> None:
        try:
            self._complete()
        except MemobenchError as error:
            # LeRobot's parser reports only that the class "couldn't be instantiated".
            logger.warning("%s", error)
            raise

    def _save_pretrained(self, save_directory: Path) -> None:
        super()._save_pretrained(save_directory)
        file = save_directory / CONFIG_NAME
        saved = json.loads(file.read_text(encoding="utf-8"))
        if set(PI05_ALONE) & set(saved):  # an earlier LeRobot would refuse the checkpoint for them
            kept = {name: value for name, value in saved.items() if name not in PI05_ALONE}
            file.write_text(json.dumps(kept, indent=4), encoding="utf-8")

    def _complete(self) -> None:
        """Set the fields that the size and the perception decide, and check every field."""
        self._choose("size", tuple(SIZES))
        self._choose("align", tuple(ALIGN_WEIGHTS))
        self._choose("perception", PERCEPTIONS)
        self._choose("subgoal_level", SUBGOAL_LEVELS)
        if self.visual_encoder is None and self.size == "small" and not self.uses_objects:
            self.visual_encoder = PACKAGE
        self._complete_memory()
        defaults = self._defaults()
        for name, value in defaults.items():
            if getattr(self, name) in (None, {}):
                setattr(self, name, value)
        self._choose("objective", OBJECTIVES)
        # A checkpoint without oracle memory holds the length of prompts without it, which would cut the text off.
        if self.tokenizer_max_length == self.dimensions.tokenizer_max_length:
            self.tokenizer_max_length = defaults["tokenizer_max_length"]
        self._check_read(defaults)
        if self.objective == REGRESSION:
            self.num_inference_steps = 1
        self._check_numbers()  # before LeRobot's main, whose pi0.5 has a memory_stride too
        super().__post_init__()
        self._check_perception()
        self._check_alignment()

    def _defaults(self) -> dict[str, Any]:
        """Return the defaults that the size, the perception and the memory decide."""
        dims = self.dimensions
        side, mode = SIDE if self.uses_visual_encoder else dims.vision.image, NormalizationMode(dims.normalization)
        planned = self.chunk_size or dims.defaults["chunk_size"]
        room = ORACLE_TOKENS if self.oracle_memory and dims.tokenizer == "words" else 0
        return {
            **dims.defaults,
            "n_action_steps": min(dims.defaults["n_action_steps"], planned),
            "optimizer_lr": dims.learning_rate,
            "tokens_per_frame": TOKENS_PER_FRAME[self.perception],
            "memory_stride": MEMORY_STRIDE if self.decodes_no_video else 1,
            "frames_per_episode": FRAMES_PER_EPISODE if self.decodes_no_video else 1,
            "task_weights": {} if self.decodes_no_video else None,
            "tokenizer_name": dims.tokenizer,
            "tokenizer_max_length": dims.tokenizer_max_length + room,
            "text_encoder": dims.text_encoder,
            "normalization_mapping": {"VISUAL": NormalizationMode.IDENTITY, "STATE": mode, "ACTION": mode},
            "image_resolution": (side, side),
        }

    def _check_read(self, defaults: Mapping[str, Any]) -> None:
        """Refuse a field that nothing reads, unless it has its default.

        Args:
            defaults: those of `_defaults`.
        """
        unset = {
            one.name: one.default if one.default_factory is MISSING else one.default_factory() for one in fields(self)
        }
        # As a recipe or a checkpoint of another memory, objective, alignment or perception may hold them.
        usual = {
            "max_state_dim": () if self.robot_state_feature is None else self.robot_state_feature.shape,
            "memory_fusion": (NONE, MODULATION),
            "memory_camera": (f"{OBS_IMAGES}.{next(iter(CAMERAS))}",),
            "num_inference_steps": (1,),
        }
        found: dict[str, str] = {}
        for reader, (present, names) in READERS.items():
            for name in () if present(self) else [one for one in names.split() if one in unset]:
                known = [unset[name], defaults.get(name), *usual.get(name, ())]
                value = getattr(self, name)
                if value not in known and (not isinstance(value, list) or tuple(value) not in known):
                    found[name] = reader
        for name, reader in found.items():
            raise UnreadError(
                f"--policy.{name}={getattr(self, name)} would do nothing: only {reader} reads it; leave it out, or set "
                f"it to its default, {json.dumps(unset[name])}.",
                {one: unset[one] for one in found},
            )
        if self.memory == NONE:
            self.memory_fusion = NONE

    def _complete_memory(self) -> None:
        """Set and check what makes the memory."""
        if self.memory in (None, "frames"):  # the default, as a recipe or checkpoint may name it
            self.memory = NONE if self.memory_fusion == NONE else "frames"
        if self.memory == NONE:
            if self.memory_settings in [asdict(read_settings(one, {})) for one in OURS if self.memory_settings]:
                self.memory_settings = {}  # the defaults of the memory of a checkpoint, whose training goes on without
            return
        mechanism = find_mechanism(self.memory)
        fusion = OWN if mechanism.fusion is not None else MODULATION
        if self.memory_fusion is None:
            self.memory_fusion = fusion
        self._choose("memory_fusion", MEMORY_FUSIONS)
        if self.memory_fusion == NONE or (OWN in (fusion, self.memory_fusion) and self.memory_fusion != fusion):
            fitting = OWN if fusion == OWN else f"{MODULATION} or {CONTEXT}"
            raise MemobenchError(
                f"--policy.memory={self.memory} cannot be read by memory_fusion={self.memory_fusion}; pass "
                f"--policy.memory_fusion={fitting}; policy.memory=none is the baseline without a memory."
            )
        other = settings_of_another(self.memory, self.memory_settings)
        if other is not None:  # a checkpoint's, whose training this memory goes on from
            logger.warning("memory_settings are those of memory=%s; memory=%s keeps its own", other, self.memory)
            own = settings_of(self.memory)
            self.memory_settings = {name: value for name, value in self.memory_settings.items() if name in own}
        self.memory_settings = asdict(read_settings(self.memory, self.memory_settings))
        if self.memory_stride is None:
            stride = mechanism.stride
            self.memory_stride = stride.get(self.perception) if isinstance(stride, Mapping) else stride

    # -- checks ----------------------------------------------------------------------------------------------------

    def _choose(self, field: str, known: tuple[str, ...]) -> None:
        given = getattr(self, field)
        if given not in known:
            raise MemobenchError(
                f"memobench_mem has no {field} '{given}': {nearest(str(given), known)} "
                f"Pass --policy.{field}=<one of {', '.join(known)}>."
            )

    def _check_numbers(self) -> None:
        for name, (least, most) in RANGES.items():
            if not least <= getattr(self, name) <= most:  # nor NaN
                raise MemobenchError(
                    f"--policy.{name}={getattr(self, name)} is out of range; expected at least {least}"
                    + ("." if most == math.inf else f" and {'at most' if isinstance(most, int) else 'below'} 1.")
                )
        if any(weight < 0 for weight in (self.task_weights or {}).values()):
            raise MemobenchError(f"--policy.task_weights={self.task_weights} must not hold negative weights.")

    def _check_perception(self) -> None:
        if self.detector == RANDOM:
            raise MemobenchError(
                f"--policy.detector={self.detector} is no detector; name {PACKAGE} or a file of "
                "`python -m research.detector train`; or leave it out: then the environment gives the objects."
            )
        if not self.uses_objects and self.tokens_per_frame != MEMORY_GRID**2:
            raise MemobenchError(
                f"--policy.tokens_per_frame={self.tokens_per_frame} is for objects: pictures are pooled to a 4x4 grid, "
                f"{MEMORY_GRID**2} tokens; leave it out."
            )
        if self.uses_visual_encoder:
            if self.image_size != (SIDE, SIDE):
                raise MemobenchError(
                    f"--policy.image_resolution={self.image_resolution} cannot be used: the visual encoder takes "
                    f"{SIDE} x {SIDE} pixels; leave it out, or use --policy.visual_encoder={RANDOM}."
                )
            return
        multiple = MEMORY_GRID * self.dimensions.vision.patch
        if any(side % multiple for side in self.image_size):
            raise MemobenchError(
                f"--policy.image_resolution={self.image_resolution} must be a multiple of {multiple} pixels at "
                f"size {self.size}, so that its patches pool to a 4x4 grid."
            )

    def _check_alignment(self) -> None:
        if self.align == NONE:
            return
        if self.memory == NONE:
            raise MemobenchError(
                f"--policy.align={self.align} has no memory to align with --policy.memory=none; name a memory "
                f"({', '.join(mechanism_names())}), or use --policy.align=none."
            )
        if find_mechanism(self.memory).reads_text:
            raise MemobenchError(
                f"--policy.align={self.align} ties what is remembered to the subgoal's text, and memory={self.memory} "
                "learns from that text already, which is all that a chunk reads of it; use --policy.align=none."
            )
        if self.align == "framewise" and not find_mechanism(self.memory).per_frame:
            raise MemobenchError(
                "--policy.align=framewise aligns each remembered frame with its own text, and "
                f"memory={self.memory} has no tokens of single frames; use semantic or contrastive, or "
                "--policy.memory=frames."
            )

    # -- properties that follow ------------------------------------------------------------------------------------

    @property
    def of_training_alone(self) -> tuple[str, ...]:
        """All other fields: they say how a policy is trained and where it goes. A checkpoint that acts reads none of
        them, and another value is refused there, or its card would tell of a training that never was."""
        return tuple(one.name for one in fields(self) if one.name not in (*FIXED, *OF_ACTING))

    @property
    def dimensions(self) -> Dimensions:
        """Dimensions of this size."""
        return SIZES[self.size]

    @property
    def uses_objects(self) -> bool:
        """Whether observations are object slots."""
        return self.perception == "objects"

    @property
    def uses_detector(self) -> bool:
        """Whether these are detections in pictures."""
        return self.detector is not None

    @property
    def uses_visual_encoder(self) -> bool:
        """Whether pictures are read as tokens of `lerobot_memobench.perception`'s encoder."""
        return self.visual_encoder not in (None, RANDOM)

    @property
    def uses_pictures(self) -> bool:
        """Whether pictures are read."""
        return self.uses_detector or not self.uses_objects

    @property
    def encodes_ahead(self) -> bool:
        """Whether pictures are encoded, or detected in, once before training."""
        return self.uses_detector or self.uses_visual_encoder

    @property
    def decodes_no_video(self) -> bool:
        """Whether training samples are made of numbers and features in main memory."""
        return self.uses_objects or self.encodes_ahead

    @property
    def inputs(self) -> tuple[str, ...]:
        """Policy inputs beside the robot's state, in the words of `envs.observations`."""
        if not self.uses_objects:
            return (PIXEL_INPUT,)
        return (DETECTIONS,) if self.uses_detector else (PRIVILEGED_INPUT,)

    @property
    def state_token(self) -> bool:
        """Whether the state enters as numbers, by a token of the prefix; otherwise as words of the prompt.

        Words at full size, as in pi0.5, and in tiny policies of pixels, which were so from the beginning.
        """
        return self.dimensions.tokenizer == "words" and (self.uses_objects or self.size != "tiny")

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the policy's images, pixels: ``image_resolution``, known to be set."""
        assert self.image_resolution is not None
        return tuple(self.image_resolution)  # type: ignore[return-value]  # a checkpoint gives a list

    @property
    def privileged_memory(self) -> bool:
        """Whether the memory learns from the checkpoints' texts."""
        return self.memory != NONE and find_mechanism(self.memory).privileged

    @property
    def remembers_thumbnails(self) -> bool:
        """Whether small grey copies of pictures are remembered, and not their tokens."""
        return self.memory != NONE and find_mechanism(self.memory).asks_motion and not self.uses_objects

    @property
    def subgoal_texts(self) -> tuple[str, ...]:
        """All texts of checkpoints, by whose numbers a privileged memory learns and chooses."""
        return texts_of(self.subgoals or {})

    @property
    def needs_every_frame(self) -> bool:
        """Whether pictures between two action chunks count."""
        return self.memory != NONE and self.uses_pictures

    def check_memory_reads(self) -> None:
        """Refuse to tell how much a chunk reads of what is remembered where nothing tells it.

        Raises:
            MemobenchError: there is no memory, or a fusion of its own that has no weights.
        """
        fusion = None if self.memory == NONE else find_mechanism(self.memory).fusion
        if self.memory == NONE or (fusion is not None and not fusion.tells_reads):
            raise MemobenchError(
                f"memory_reads=true asks how much each remembered frame is read, which memory={self.memory} does not "
                "tell; leave it out"
            )

    # -- LeRobot's questions ---------------------------------------------------------------------------------------

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """Return the optimizer that lerobot-train takes."""
        return FusedAdamWConfig(**vars(super().get_optimizer_preset()))

    def get_scheduler_preset(self) -> WarmupFractionSchedulerConfig:
        """Return the schedule that lerobot-train takes."""
        final = self.dimensions.final_learning_rate
        return WarmupFractionSchedulerConfig(warmup_fraction=self.warmup_fraction, final=final)

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Take the objects of a dataset with pictures for the input that LeRobot does not take them for.

        LeRobot calls this with a dataset's ``features`` before it makes a policy for it.
        """
        if not self.uses_pictures and PRIVILEGED in features:
            shape = tuple(features[PRIVILEGED]["shape"])
            self.input_features.setdefault(OBS_ENV_STATE, PolicyFeature(FeatureType.ENV, shape))

    def validate_features(self) -> None:
        """Keep the features that this perception reads, besides the state.

        A checkpoint that was trained on privileged object state has no pictures among them; a detector reads all
        cameras.

        Raises:
            MemobenchError: they lack the slots of objects or the camera that is remembered, or have more numbers than
                the weights to start from.
        """
        unseen = FeatureType.ENV if self.uses_pictures else FeatureType.VISUAL
        for key in [key for key, one in self.input_features.items() if one.type is unseen or key in CLOCK]:
            del self.input_features[key]
        if self.uses_detector and not self.image_features:
            shape = (3, IMAGE_SIZE, IMAGE_SIZE)
            self.input_features |= {
                f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, shape) for name in CAMERAS
            }
        if not self.uses_pictures and OBS_ENV_STATE not in self.input_features:
            raise MemobenchError(
                f"perception=objects reads '{OBS_ENV_STATE}', which is not there; train on a dataset of this "
                "version's `memobench generate`, and evaluate with --env.obs_type=environment_state_agent_pos."
            )
        self._choose_memory_camera()
        self._fit_numbers()
        super().validate_features()

    def _choose_memory_camera(self) -> None:
        cameras = [*self.image_features]
        if self.memory_camera is None and cameras:
            self.memory_camera = cameras[0]
        if self.uses_pictures and not self.uses_objects and cameras and self.memory_camera not in cameras:
            raise MemobenchError(
                f"--policy.memory_camera={self.memory_camera} is none of this policy's cameras "
                f"({', '.join(cameras)}); name one of them, or leave it out for the first."
            )

    def _fit_numbers(self) -> None:
        """Make room for as many numbers as a state and an action have, where no weights of another size are loaded."""
        state, action = self.robot_state_feature, self.action_feature
        for name, feature in (("max_state_dim", state), ("max_action_dim", action)):
            needed = 0 if feature is None else feature.shape[0]
            if needed <= getattr(self, name):
                continue
            if self.pretrained_path is not None or self.base_weights is not None:
                raise MemobenchError(
                    f"The {'state' if feature is state else 'action'} has {needed} numbers, and the weights to start "
                    f"from have room for {getattr(self, name)} (policy.{name}); train from scratch, or on a dataset "
                    "with fewer."
                )
            setattr(self, name, needed)


@OptimizerConfig.register_subclass("memobench_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """AdamW in one kernel: torch's default makes a copy of all that learns on a GPU, and takes three times as long on a
    CPU.

    At full size that copy is 10.5 GiB, and is what made four cards of 80 GB too small for `config=train_paper`.
    """

    def build(self, params: Iterable[nn.Parameter]) -> Optimizer:
        """Return the optimizer of some parameters."""
        learning = list(params)
        fused = all(parameter.device.type in ("cpu", "cuda") for parameter in learning) or None  # None: torch's choice
        return AdamW(learning, self.lr, self.betas, self.eps, self.weight_decay, fused=fused)


@LRSchedulerConfig.register_subclass("memobench_constant_with_warmup")
@dataclass
class WarmupFractionSchedulerConfig(LRSchedulerConfig):
    """Linear warm-up over a fraction of the run, then constant (paper: 5 %), or a cosine down to ``final`` at its end.

    LeRobot's own constant schedule counts warm-up steps, which would have to change with ``--steps``.
    """

    num_warmup_steps: int | None = None
    warmup_fraction: float = 0.05
    final: float = 1.0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return the schedule of a run of so many updates."""
        steps = self.num_warmup_steps
        warmup = max(1, round(self.warmup_fraction * num_training_steps) if steps is None else steps)

        def rate(step: int) -> float:
            fallen = (1 - math.cos(math.pi * min(1.0, step / num_training_steps))) / 2
            return min(1.0, (step + 1) / warmup) * (1 - (1 - self.final) * fallen)

        return LambdaLR(optimizer, rate)
