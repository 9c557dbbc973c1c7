"""Configuration of ``memobench_mem``: the dimensions of each size, the settings, their defaults and checks."""

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

from lerobot_memobench.datasets.lerobot_format.columns import PRIVILEGED
from lerobot_memobench.envs.observations import DETECTIONS, PIXEL_INPUT
from lerobot_memobench.envs.observations import PRIVILEGED as PRIVILEGED_INPUT
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.perception.weights import PACKAGE
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
"""Seed of ``align_targets=shuffled``."""
SUBGOALS, SHUFFLED, PROGRESS, ANSWERS = ALIGN_TARGETS = ("subgoals", "shuffled", "progress", "answers")
MODULATION, CONTEXT, OWN = "modulation", "context", "own"
MEMORY_FUSIONS = (MODULATION, CONTEXT, OWN)
PERCEPTIONS = ("pixels", "objects")
SUBGOAL_LEVELS = ("coarse", "intermediate", "fine")
PROMPTED = "prompted"
"""Key of ``task_weights`` for tasks that begin with a demonstration prompt."""
TOKENS_PER_FRAME = {"pixels": MEMORY_GRID**2, "objects": 2}
"""Memory tokens of a remembered frame."""
MEMORY_STRIDE, FRAMES_PER_EPISODE = 8, 6
"""Defaults if training decodes no video; 1 otherwise."""
ORACLE_TOKENS = 128
"""Tokens added to the prompt's length for oracle memory text: six checkpoints of about ten words."""


@dataclass(frozen=True)
class Gemma:
    """Dimensions of one of the two transformers, named as in LeRobot's ``GemmaConfig``."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class Vision:
    """Dimensions of the SigLIP image tower."""

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
"""The paper's values of the fields whose defaults depend on the size."""


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


MAY_DIFFER = frozenset(
    _names(
        """
        n_action_steps device dtype detector num_inference_steps rtc_config use_amp compile_model compile_mode
        gradient_checkpointing pretrained_path pretrained_revision use_peft output_features
        push_to_hub repo_id private tags license
        """
    )
)
"""Fields that may have another value than in training when a checkpoint acts or its training is resumed. All others
are refused then. LeRobot sets ``output_features`` from the environment; `policies.compatibility` checks them."""
PI05_ALONE = _names(
    "use_visual_memory use_proprioceptive_memory memory_frames memory_temporal_attention_every rtc_training_max_delay"
)
"""Fields that LeRobot's main branch adds to pi0.5: visual memory, and training for real-time chunking. They are not
saved, so that both versions of LeRobot load a checkpoint."""


def _remembers(config: MemobenchMemConfig, has: Callable[[Any], bool] = lambda _: True) -> bool:
    return config.memory != NONE and has(find_mechanism(config.memory))


READERS: Mapping[str, tuple[Callable[[MemobenchMemConfig], bool], str]] = {
    "perception=objects": (
        lambda it: it.uses_objects,
        "detector detection_noise object_classes",
    ),
    "perception=pixels": (lambda it: not it.uses_objects, "empty_cameras"),
    "pi0.5's image tower": (lambda it: not (it.uses_objects or it.uses_visual_encoder), "image_resolution"),
    "a policy whose state is a token": (lambda it: it.state_token, "max_state_dim"),
    "a policy that sees pictures": (lambda it: it.uses_pictures, "memory_camera"),
    "size=small perception=pixels": (lambda it: it.uses_visual_encoder, "visual_encoder"),
    "a memory": (_remembers, "memory_settings memory_fusion memory_stride"),
    "a memory of objects other than motion": (
        lambda it: it.uses_objects and _remembers(it, lambda one: not one.asks_motion),
        "memory_phase memory_repeats",
    ),
    "a memory that learns from texts": (lambda it: it.privileged_memory, "subgoals"),
    "an alignment": (lambda it: it.align != NONE, "align_targets text_encoder"),
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
"""Feature of a policy -> whether a configuration has it, and the fields that only this feature reads. Without the
feature, each of these fields must have its default."""
RANGES = {
    **dict.fromkeys(_names("memory_stride n_action_steps frames_per_episode num_inference_steps"), (1, math.inf)),
    "warmup_fraction": (0, 1),
    "detection_noise": (0, math.inf),
    "ema_decay": (0, math.nextafter(1, 0)),
}
"""Field -> its smallest and largest value."""


class UnreadError(MemobenchError):
    """A field without effect differs from its default.

    Attributes:
        defaults: field without effect -> its default.
    """

    def __init__(self, sentence: str, defaults: Mapping[str, Any]) -> None:
        super().__init__(sentence)
        self.defaults = defaults


FROM_SIZE: Any = None
"""Default of a field whose value depends on the size, the perception or the memory; construction sets it."""


@PreTrainedConfig.register_subclass("memobench_mem")
@dataclass
class MemobenchMemConfig(PI05Config):
    """The fields of LeRobot's pi0.5, and those of the memory. Construction replaces None by a default of the size."""

    reads_prompt: ClassVar[bool] = True
    execution_only: ClassVar[bool] = True

    size: str = "tiny"
    """``small`` (learns from objects in minutes on a CPU), ``tiny`` (trains on a CPU) or ``pi05`` (3.2 B weights)."""

    # -- observations
    perception: str = "pixels"
    """Source of observation tokens: ``pixels``, encoded by a frozen network, or ``objects``, the slots of
    ``observation.environment_state`` (`sim.object_slots`): privileged object state, or detections."""
    detector: str | None = None
    """With ``perception=objects``: detect objects in pictures by this detector, instead of reading privileged object
    state. ``package``, or a file of `python -m research.detector train`. A checkpoint holds only its name."""
    visual_encoder: str | None = None
    """With pixels at ``size=small``: the frozen encoder of pictures, of ``package`` (the default) or of a detector's
    file. A checkpoint holds its weights."""
    detection_noise: float = 0.0
    """Size of the errors added to privileged object state in training, so that the policy later acts by a
    ``detector``. 1: as large as the errors of the package's detector; 0: none."""
    object_classes: list[str] | None = None
    """Names of the object classes in order of their indices; None: the classes of this version."""

    base_weights: str | None = None
    """Folder or repository of pi0.5 weights to start from (e.g. ``lerobot/pi05_base``); None: from scratch."""

    # -- alignment
    align: str = "none"
    """How memory is aligned with checkpoint language: ``none``, ``semantic``, ``contrastive`` or ``framewise``."""
    subgoal_level: str = "intermediate"
    """Level of the checkpoint language: ``coarse``, ``intermediate`` or ``fine``."""
    align_targets: str = SUBGOALS
    """Texts that memory is aligned with: ``subgoals``, or a control. ``shuffled`` (the paper's) permutes them within
    each episode; an episode with fewer than three takes texts of other episodes; the permutation is the same in every
    epoch and on every machine. ``progress`` cuts the words that differ between the episodes of a task, and with them
    the hidden answer. ``answers`` is one text per episode, all its subgoals, which does not name its progress."""
    text_encoder: str | None = None
    """Encoder of subgoal texts: ``words`` (hashed words), ``labels`` (a random vector per text), or the folder or
    repository of a SigLIP model; None: the default of the size."""

    # -- memory
    memory: str = "frames"
    """The memory mechanism: ``frames``, another one of `memory` or of an installed package, or ``none``: plain pi0.5,
    the baseline without a memory."""
    memory_settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the mechanism (the ``Settings`` of its class); a setting that is not given has its default."""
    memory_fusion: str | None = FROM_SIZE
    """How actions read memory: ``modulation``, ``context`` (memory joins the prefix) or ``own`` (the mechanism's own
    way). None: ``own`` if the mechanism has one, else ``modulation``."""
    subgoals: dict[str, list[str]] | None = None
    """Instruction -> texts of its checkpoints, for a memory that learns from texts; None: those of the dataset."""
    oracle_memory: bool = False
    """Control of the paper: ground-truth memory text in the prompt, from the dataset's column ``memory`` in training
    and from the environment (``--env.oracle_memory=true``) in evaluation."""
    memory_camera: str | None = None
    """Camera whose pictures are remembered; None: the first of the policy's."""
    memory_stride: int = FROM_SIZE
    """Control steps between remembered frames; None: the mechanism's, or 8 if training decodes no video (objects, or
    pixels through a visual encoder), else 1."""
    memory_phase: bool = False
    """Whether a remembered frame of objects records its phase, prompt or execution. A memory with this information can
    count the steps since the execution began, which strict tasks hide."""
    memory_repeats: bool = True
    """Whether a frame equal to the last remembered one is remembered too. If false, the holds of strict tasks do not
    fill the memory, and do not use up the frames that a chunk reads."""

    # -- training
    objective: str = FROM_SIZE
    """How actions are learned: ``flow_matching``, as in pi0.5, or ``regression``, which computes a chunk in one pass
    instead of ten (`losses`). None: ``regression`` at ``small``, else ``flow_matching``."""
    ema_decay: float = FROM_SIZE
    """Decay of the moving average of the weights, which evaluation uses; 0: no average. None: the paper's 0.999, or
    0.995 at ``small``."""
    frames_per_episode: int = FROM_SIZE
    """Frames per episode in a batch; they share memory. ``batch_size`` counts frames. None: 6 if training decodes no
    video, else 1, as in LeRobot."""
    task_weights: dict[str, float] | None = field(default_factory=dict)
    """Draw tasks in proportion to these weights, independent of the length of their episodes. A key is a task's name, a
    memory type or ``prompted`` (tasks with a demonstration prompt); the first match counts, and other tasks weigh 1.
    None: all frames alike, which is the default if training decodes video; ``{}``, the default, else: all tasks."""
    warmup_fraction: float = 0.05
    """Share of the updates in which the learning rate rises. It then stays constant, or falls as a cosine to 0.02 of
    its maximum at ``size=small``."""

    # -- pi0.5's fields with other defaults
    freeze_vision_encoder: bool = True
    """Always true: memory tokens are cached features of the image tower."""
    chunk_size: int = FROM_SIZE
    """Actions of a chunk; None: 16 at ``small``, else 50."""
    n_action_steps: int = FROM_SIZE
    """Actions executed of a chunk before the next one is planned; None: 6 at ``small``, else 50. A policy of objects
    executes the chunk's following actions if its hand has stalled (`rollout.Row.begin_chunk`)."""
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
        for name, known in (
            ("size", SIZES),
            ("align", ALIGN_WEIGHTS),
            ("perception", PERCEPTIONS),
            ("subgoal_level", SUBGOAL_LEVELS),
            ("align_targets", ALIGN_TARGETS),
        ):
            self._choose(name, tuple(known))
        if self.visual_encoder is None and self.uses_visual_encoder:
            self.visual_encoder = PACKAGE
        self._complete_memory()
        defaults = self._defaults()
        for name, value in defaults.items():
            if getattr(self, name) in (None, {}):
                setattr(self, name, value)
        if not self.task_weights and not self.decodes_no_video:
            self.task_weights = None
        self._choose("objective", OBJECTIVES)
        # A checkpoint without oracle memory holds the shorter prompt length, which would cut the memory text off.
        if self.tokenizer_max_length == self.dimensions.tokenizer_max_length:
            self.tokenizer_max_length = defaults["tokenizer_max_length"]
        self._check_read(defaults)
        if self.objective == REGRESSION:
            self.num_inference_steps = 1
        self._check_numbers()  # before LeRobot's main, whose pi0.5 has a memory_stride too
        super().__post_init__()
        self._check_image_resolution()
        self._check_alignment()

    def _defaults(self) -> dict[str, Any]:
        """Return the defaults that depend on the size, the perception and the memory."""
        dims = self.dimensions
        side, mode = SIDE if self.uses_visual_encoder else dims.vision.image, NormalizationMode(dims.normalization)
        planned = self.chunk_size or dims.defaults["chunk_size"]
        room = ORACLE_TOKENS if self.oracle_memory and dims.tokenizer == "words" else 0
        return {
            **dims.defaults,
            "n_action_steps": min(dims.defaults["n_action_steps"], planned),
            "optimizer_lr": dims.learning_rate,
            "memory_stride": MEMORY_STRIDE if self.decodes_no_video else 1,
            "frames_per_episode": FRAMES_PER_EPISODE if self.decodes_no_video else 1,
            "tokenizer_name": dims.tokenizer,
            "tokenizer_max_length": dims.tokenizer_max_length + room,
            "text_encoder": dims.text_encoder,
            "normalization_mapping": {"VISUAL": NormalizationMode.IDENTITY, "STATE": mode, "ACTION": mode},
            "image_resolution": (side, side),
        }

    def _check_read(self, defaults: Mapping[str, Any]) -> None:
        """Refuse a field without effect, unless it has its default.

        Args:
            defaults: those of `_defaults`.
        """
        unset = {
            one.name: one.default if one.default_factory is MISSING else one.default_factory() for one in fields(self)
        }
        # Values that a recipe or a checkpoint with another memory, objective, alignment or perception may hold.
        usual = {
            "max_state_dim": () if self.robot_state_feature is None else self.robot_state_feature.shape,
            "memory_fusion": (MODULATION, OWN),
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
                f"--policy.{name}={getattr(self, name)} has no effect: only {reader} reads it; leave it out, or set "
                f"it to its default, {json.dumps(unset[name])}.",
                {one: unset[one] for one in found},
            )
        if self.memory == NONE:
            self.memory_fusion = None

    def _complete_memory(self) -> None:
        """Complete the settings of the memory, and check them."""
        if self.memory == NONE:
            if self.memory_settings in [asdict(read_settings(one, {})) for one in OURS if self.memory_settings]:
                self.memory_settings = {}  # the defaults of the memory of the checkpoint that training starts from
            return
        mechanism = find_mechanism(self.memory)
        fitting = (OWN,) if mechanism.fusion is not None else (MODULATION, CONTEXT)
        self.memory_fusion = self.memory_fusion or fitting[0]
        self._choose("memory_fusion", MEMORY_FUSIONS)
        if self.memory_fusion not in fitting:
            raise MemobenchError(
                f"--policy.memory={self.memory} cannot be read by memory_fusion={self.memory_fusion}; pass "
                f"--policy.memory_fusion={' or '.join(fitting)}."
            )
        other = settings_of_another(self.memory, self.memory_settings)
        if other is not None:  # a checkpoint with another memory, from which training starts
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

    def _check_image_resolution(self) -> None:
        multiple = MEMORY_GRID * self.dimensions.vision.patch
        if not self.uses_visual_encoder and any(side % multiple for side in self.image_size):
            raise MemobenchError(
                f"--policy.image_resolution={self.image_resolution} must be a multiple of {multiple} pixels at "
                f"size {self.size}, so that its patches pool to a {MEMORY_GRID}x{MEMORY_GRID} grid."
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
                f"--policy.align={self.align} aligns memory with the subgoal's text, and a chunk of "
                f"memory={self.memory} reads only that text; use --policy.align=none."
            )
        if self.align == "framewise" and not find_mechanism(self.memory).per_frame:
            raise MemobenchError(
                "--policy.align=framewise aligns each remembered frame with its own text, and "
                f"memory={self.memory} has no tokens of single frames; use semantic or contrastive, or "
                "--policy.memory=frames."
            )

    # -- derived properties ----------------------------------------------------------------------------------------

    @property
    def fixed_by_training(self) -> tuple[str, ...]:
        """Fields that must keep their values when a checkpoint acts or its training is resumed, ours first."""
        ours = [*MemobenchMemConfig.__annotations__]
        names = [one.name for one in fields(self) if one.name not in MAY_DIFFER]
        return tuple(sorted(names, key=lambda name: ours.index(name) if name in ours else len(ours)))

    kept_since_begun = fixed_by_training

    @property
    def dimensions(self) -> Dimensions:
        """Dimensions of the size."""
        return SIZES[self.size]

    @property
    def uses_objects(self) -> bool:
        """Whether observations are object slots."""
        return self.perception == "objects"

    @property
    def uses_detector(self) -> bool:
        """Whether objects are detected in pictures."""
        return self.detector is not None

    @property
    def uses_visual_encoder(self) -> bool:
        """Whether pictures are encoded by the visual encoder of `lerobot_memobench.perception`."""
        return self.size == "small" and not self.uses_objects

    @property
    def uses_pictures(self) -> bool:
        """Whether pictures are read."""
        return self.uses_detector or not self.uses_objects

    @property
    def encodes_ahead(self) -> bool:
        """Whether pictures are encoded, or objects detected in them, once before training."""
        return self.uses_detector or self.uses_visual_encoder

    @property
    def decodes_no_video(self) -> bool:
        """Whether training samples consist of numbers and features in main memory."""
        return self.uses_objects or self.encodes_ahead

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names in `envs.observations` of the inputs other than the robot's state."""
        if not self.uses_objects:
            return (PIXEL_INPUT,)
        return (DETECTIONS,) if self.uses_detector else (PRIVILEGED_INPUT,)

    @property
    def state_token(self) -> bool:
        """Whether the state is a token of the prefix; otherwise it is spelled out in the prompt, as in pi0.5."""
        return self.dimensions.tokenizer == "words" and (self.uses_objects or self.size != "tiny")

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the policy's images, pixels."""
        assert self.image_resolution is not None
        return tuple(self.image_resolution)  # type: ignore[return-value]  # a checkpoint gives a list

    @property
    def tokens_per_frame(self) -> int:
        """Number of memory tokens of a remembered frame."""
        return TOKENS_PER_FRAME[self.perception]

    @property
    def privileged_memory(self) -> bool:
        """Whether the memory learns from texts of checkpoints."""
        return self.memory != NONE and find_mechanism(self.memory).privileged

    @property
    def remembers_thumbnails(self) -> bool:
        """Whether small grey copies of pictures are remembered instead of their tokens."""
        return self.memory != NONE and find_mechanism(self.memory).asks_motion and not self.uses_objects

    @property
    def subgoal_texts(self) -> tuple[str, ...]:
        """All texts of checkpoints; a privileged memory refers to them by their indices here."""
        return texts_of(self.subgoals or {})

    @property
    def needs_every_frame(self) -> bool:
        """Whether the policy reads pictures between two action chunks."""
        return self.memory != NONE and self.uses_pictures

    def check_memory_reads(self) -> None:
        """Check that the memory's fusion can report how much a chunk reads of each remembered entry.

        Raises:
            MemobenchError: there is no memory, or its own fusion has no attention weights.
        """
        fusion = None if self.memory == NONE else find_mechanism(self.memory).fusion
        if self.memory == NONE or (fusion is not None and not fusion.reports_reads):
            raise MemobenchError(
                f"memory_reads=true is not available for memory={self.memory}, which has no attention weights; leave "
                "it out"
            )

    # -- called by LeRobot -----------------------------------------------------------------------------------------

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """Return the default optimizer of a training."""
        return FusedAdamWConfig(**vars(super().get_optimizer_preset()))

    def get_scheduler_preset(self) -> WarmupFractionSchedulerConfig:
        """Return the default learning-rate schedule of a training."""
        final = self.dimensions.final_learning_rate
        return WarmupFractionSchedulerConfig(warmup_fraction=self.warmup_fraction, final=final)

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Add the objects of a dataset with pictures to the inputs; LeRobot does not recognise their column.

        LeRobot calls this with a dataset's ``features`` before it makes the policy.
        """
        if not self.uses_pictures and PRIVILEGED in features:
            shape = tuple(features[PRIVILEGED]["shape"])
            self.input_features.setdefault(OBS_ENV_STATE, PolicyFeature(FeatureType.ENV, shape))

    def validate_features(self) -> None:
        """Remove features that this perception does not read; with a detector, add its cameras.

        Raises:
            MemobenchError: object slots or the remembered camera are missing, or there are more numbers than the
                initial weights have room for.
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
                f"perception=objects reads '{OBS_ENV_STATE}', which the inputs lack; train on a dataset of this "
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
                f"--policy.memory_camera={self.memory_camera} is not among the policy's cameras "
                f"({', '.join(cameras)}); name one of them, or leave it out for the first."
            )

    def _fit_numbers(self) -> None:
        """Raise ``max_state_dim`` and ``max_action_dim`` to the features' lengths, unless weights are loaded."""
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
    """Fused AdamW. Torch's default copies all trained parameters on a GPU, and takes three times as long on a CPU.

    At full size the copy takes 10.5 GiB; with it, `config=train_paper` does not fit on four GPUs of 80 GB.
    """

    def build(self, params: Iterable[nn.Parameter]) -> Optimizer:
        """Return the optimizer of these parameters."""
        learning = list(params)
        fused = all(parameter.device.type in ("cpu", "cuda") for parameter in learning) or None  # None: torch's choice
        return AdamW(learning, self.lr, self.betas, self.eps, self.weight_decay, fused=fused)


@LRSchedulerConfig.register_subclass("memobench_constant_with_warmup")
@dataclass
class WarmupFractionSchedulerConfig(LRSchedulerConfig):
    """Linear warm-up over a fraction of the updates (paper: 5 %), then constant, or a cosine down to ``final``.

    LeRobot's constant schedule takes a number of warm-up steps, which would have to change with ``--steps``.
    """

    num_warmup_steps: int | None = None
    warmup_fraction: float = 0.05
    final: float = 1.0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return the schedule of a training of ``num_training_steps`` updates."""
        steps = self.num_warmup_steps
        warmup = max(1, round(self.warmup_fraction * num_training_steps) if steps is None else steps)

        def rate(step: int) -> float:
            fallen = (1 - math.cos(math.pi * min(1.0, step / num_training_steps))) / 2
            return min(1.0, (step + 1) / warmup) * (1 - (1 - self.final) * fallen)

        return LambdaLR(optimizer, rate)
