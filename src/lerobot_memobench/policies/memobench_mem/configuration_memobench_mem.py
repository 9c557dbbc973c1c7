"""Configuration of ``memobench_mem``: settings with their defaults and checks, optimizer and schedule."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import Any, ClassVar, NamedTuple

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lerobot_memobench.constants import CAMERAS, CLOCK, IMAGE_SIZE
from lerobot_memobench.datasets.layout import PRIVILEGED
from lerobot_memobench.envs.observations import DETECTIONS, PIXEL_INPUT
from lerobot_memobench.envs.observations import PRIVILEGED as PRIVILEGED_INPUT
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.perception.detector import PACKAGE
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.policies.memobench_mem.memory import (
    NONE,
    OURS,
    find_mechanism,
    mechanism_names,
    mechanism_settings,
    setting_names,
    settings_of_another,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism
from lerobot_memobench.policies.memobench_mem.sizes import FLOW_MATCHING, REGRESSION, SIZES, Dimensions

logger = logging.getLogger(__name__)

OBJECTIVES = (FLOW_MATCHING, REGRESSION)
ALIGN_WEIGHTS: Mapping[str, float] = {"none": 0.0, "semantic": 0.1, "contrastive": 0.1, "framewise": 0.05}
SUBGOALS, SHUFFLED, PROGRESS, ANSWERS = ALIGN_TARGETS = ("subgoals", "shuffled", "progress", "answers")
SUPERVISED = "Supervised with the answer: the texts of its training name the hidden answer"
MODULATION, CONTEXT, OWN = "modulation", "context", "own"
MEMORY_FUSIONS = (MODULATION, CONTEXT, OWN)
PERCEPTIONS = ("pixels", "objects")
SUBGOAL_LEVELS = ("coarse", "intermediate", "fine")
PROMPTED = "prompted"
"""Key of ``task_weights`` for tasks that begin with a demonstration prompt."""
MEMORY_STRIDE, FRAMES_PER_EPISODE = 8, 6
"""Defaults if training decodes no video; 1 otherwise."""
ORACLE_TOKENS = 128
"""Tokens added to the prompt's length for oracle memory text: six checkpoints of about ten words."""
MAY_DIFFER = frozenset(
    (
        *("n_action_steps", "device", "dtype", "detector", "num_inference_steps", "use_amp", "use_peft"),
        *("gradient_checkpointing", "pretrained_path", "pretrained_revision", "output_features"),
        *("push_to_hub", "repo_id", "private", "tags", "license"),
    )
)
"""Fields that may have another value than in training when a checkpoint acts or its training is resumed. All others
are refused then. LeRobot sets ``output_features`` from the environment; `policies.compatibility` checks them."""


# -- metadata of fields ------------------------------------------------------------------------------------------------


class Condition(NamedTuple):
    """A condition under which some fields are used, named by the feature that reads them, for error messages."""

    name: str
    holds: Callable[[MemobenchMemConfig], bool]


OBJECTS = Condition("perception=objects", lambda config: config.uses_objects)
IMAGES = Condition("a policy that sees images", lambda config: config.uses_images)
VISUAL_ENCODER = Condition("size=small perception=pixels", lambda config: config.uses_visual_encoder)
STATE_TOKEN = Condition("a policy whose state is a token", lambda config: config.state_token)
MEMORY = Condition("a memory", lambda config: config.memory != NONE)
OBJECT_MEMORY = Condition(
    "a memory of objects other than motion", lambda config: config.uses_objects and config.skips_repeated_frames
)
TEXT_MEMORY = Condition("a memory that learns from texts", lambda config: config.privileged_memory)
ALIGNMENT = Condition("an alignment", lambda config: config.align != NONE)
TEXTS = Condition(
    "an alignment or a memory that learns from texts", lambda config: config.align != NONE or config.privileged_memory
)
FLOW = Condition("objective=flow_matching", lambda config: config.objective == FLOW_MATCHING)


def policy_setting(
    default: Any,
    *,
    used_if: Condition | None = None,
    values: Iterable[str] = (),
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """Return a field of `MemobenchMemConfig`, which has no effect without its condition ``used_if``."""
    metadata = {"used_if": used_if, "values": tuple(values), "least": least, "most": most}
    kind: dict[str, Any] = {"default_factory": dict} if default is dict else {"default": default}  # dict: an empty one
    return field(**kind, metadata=metadata)


FROM_SIZE: Any = None
"""Default of a field whose value depends on the size, the perception or the memory; construction sets it."""


# -- optimizer and schedule -------------------------------------------------------------------------------------------


@OptimizerConfig.register_subclass("memobench_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """Fused AdamW. Torch's default takes three times as long on a CPU, and copies the parameters on a GPU.

    At full size the copy takes 10.5 GiB; with it, `config=train_paper` does not fit on four GPUs of 80 GB.
    """

    def build(self, params: Iterable[nn.Parameter]) -> Optimizer:
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
        steps = self.num_warmup_steps
        warmup = max(1, round(self.warmup_fraction * num_training_steps) if steps is None else steps)

        def rate(step: int) -> float:
            fallen = (1 - math.cos(math.pi * min(1.0, step / num_training_steps))) / 2
            return min(1.0, (step + 1) / warmup) * (1 - (1 - self.final) * fallen)

        return LambdaLR(optimizer, rate)


@PreTrainedConfig.register_subclass("memobench_mem")
@dataclass
class MemobenchMemConfig(PreTrainedConfig):
    """pi0.5 with a memory. Construction replaces None by a default of the size."""

    reads_prompt: ClassVar[bool] = True
    execution_only: ClassVar[bool] = True

    size: str = policy_setting("tiny", values=SIZES)
    """``small`` (learns from objects in minutes on a CPU), ``tiny`` (trains on a CPU) or ``pi05`` (3.2 B weights)."""

    # -- observations
    perception: str = policy_setting("pixels", values=PERCEPTIONS)
    """Source of observation tokens: ``pixels``, encoded by a frozen network, or ``objects``, the slots of
    ``observation.environment_state`` (`sim.object_slots`): privileged object state, or detections."""
    detector: str | None = policy_setting(None, used_if=OBJECTS)
    """With ``perception=objects``: detect objects in images by this detector, instead of reading privileged object
    state. ``package``, or a file of `python -m research.detector train`. A checkpoint holds only its name."""
    visual_encoder: str | None = policy_setting(None, used_if=VISUAL_ENCODER)
    """With pixels at ``size=small``: the frozen encoder of images, of ``package`` (the default) or of a detector's
    file. A checkpoint holds its weights."""
    detection_noise: float = policy_setting(0.0, used_if=OBJECTS, least=0)
    """Size of the errors added to privileged object state in training, so that the policy later acts by a
    ``detector``. 1: as large as the errors of the package's detector; 0: none."""
    object_classes: list[str] | None = policy_setting(None, used_if=OBJECTS)
    """Names of the object classes in order of their indices; None: the classes of this version."""

    n_obs_steps: int = policy_setting(1, least=1, most=1)
    """Always 1: earlier frames are read through the memory."""
    max_state_dim: int = policy_setting(32, used_if=STATE_TOKEN)
    """Numbers of a state, padded; raised to the dataset's, unless weights are loaded."""

    # -- network
    base_weights: str | None = None
    """Folder or repository of pi0.5 weights to start from (e.g. ``lerobot/pi05_base``); None: from scratch."""
    dtype: str = policy_setting("float32", values=("float32", "bfloat16"))
    """Precision of LeRobot's transformers: ``float32`` or ``bfloat16``."""
    tokenizer_name: str | None = None
    """``words``, or a Hugging Face tokenizer; None: that of the size."""
    tokenizer_max_length: int | None = None
    """Tokens of a prompt; None: those of the size."""
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)

    # -- actions
    chunk_size: int = FROM_SIZE
    """Actions of a chunk; None: 16 at ``small``, else 50."""
    n_action_steps: int = policy_setting(FROM_SIZE, least=1)
    """Actions executed of a chunk before the next one is planned; None: 6 at ``small``, else 50. A policy of objects
    executes the chunk's following actions if its hand has stalled (`rollout.EnvMemory.begin_chunk`)."""
    max_action_dim: int = 32
    """Numbers of an action, padded; raised to the dataset's, unless weights are loaded."""
    num_inference_steps: int = policy_setting(10, used_if=FLOW, least=1)
    """Steps from noise to actions, with flow matching."""

    # -- alignment
    align: str = policy_setting("none", values=ALIGN_WEIGHTS)
    """How memory is aligned with checkpoint language: ``none``, ``semantic``, ``contrastive`` or ``framewise``."""
    subgoal_level: str = policy_setting("intermediate", used_if=TEXTS, values=SUBGOAL_LEVELS)
    """Level of the checkpoint language: ``coarse``, ``intermediate`` or ``fine``."""
    align_targets: str = policy_setting(SUBGOALS, used_if=ALIGNMENT, values=ALIGN_TARGETS)
    """Texts that memory is aligned with: ``subgoals``, or a control. ``shuffled`` (the paper's) permutes them within
    each episode; an episode with fewer than three takes texts of other episodes; the permutation is the same in every
    epoch and on every machine. ``progress`` cuts the words that differ between the episodes of a task, and with them
    the hidden answer. ``answers`` is one text per episode, all its subgoals, which does not name its progress."""
    text_encoder: str | None = policy_setting(None, used_if=ALIGNMENT)
    """Encoder of subgoal texts: ``words`` (hashed words), ``labels`` (a random vector per text), or the folder or
    repository of a SigLIP model; None: the default of the size."""
    supervised_with_answer: bool = False
    """Mark of a policy that learned from texts which name the hidden answer: by an alignment, except with
    ``align_targets=progress``, or by a memory that learns from texts. It follows from these settings and cannot be set
    in a command; a training that starts from such a checkpoint keeps it."""

    # -- memory
    memory: str = "frames"
    """The memory mechanism: ``frames``, another one of `memory` or of an installed package, or ``none``: plain pi0.5,
    the baseline without a memory."""
    memory_settings: dict[str, Any] = policy_setting(dict, used_if=MEMORY)
    """Settings of the mechanism (the ``Settings`` of its class); a setting that is not given has its default."""
    memory_fusion: str | None = policy_setting(FROM_SIZE, used_if=MEMORY, values=MEMORY_FUSIONS)
    """How actions read memory: ``modulation``, ``context`` (memory joins the prefix) or ``own`` (the mechanism's own
    way). None: ``own`` if the mechanism has one, else ``modulation``."""
    subgoals: dict[str, list[str]] | None = policy_setting(None, used_if=TEXT_MEMORY)
    """Instruction -> texts of its checkpoints, for a memory that learns from texts; None: those of the dataset."""
    oracle_memory: bool = False
    """Control of the paper: ground-truth memory text in the prompt, from the dataset's column ``memory`` in training
    and from the environment (``--env.oracle_memory=true``) in evaluation."""
    memory_camera: str | None = policy_setting(None, used_if=IMAGES)
    """Camera whose images are remembered; None: the first of the policy's."""
    memory_stride: int = policy_setting(FROM_SIZE, used_if=MEMORY, least=1)
    """Control steps between remembered frames; None: the mechanism's, or 8 if training decodes no video (objects, or
    pixels through a visual encoder), else 1."""
    memory_phase: bool = policy_setting(False, used_if=OBJECT_MEMORY)
    """Whether a remembered frame of objects records its phase, prompt or execution. A memory with this information can
    count the steps since the execution began, which strict tasks hide."""

    # -- training
    objective: str = policy_setting(FROM_SIZE, values=OBJECTIVES)
    """How actions are learned: ``flow_matching``, as in pi0.5, or ``regression``, which computes a chunk in one pass
    instead of ten (`losses`). None: ``regression`` at ``small``, else ``flow_matching``."""
    ema_decay: float = policy_setting(FROM_SIZE, least=0, most=math.nextafter(1, 0))
    """Decay of the moving average of the weights, which evaluation uses; 0: no average. None: the paper's 0.999, or
    0.995 at ``small``."""
    frames_per_episode: int = policy_setting(FROM_SIZE, least=1)
    """Frames per episode in a batch; they share memory. ``batch_size`` counts frames. None: 6 if training decodes no
    video, else 1, as in LeRobot."""
    task_weights: dict[str, float] | None = field(default_factory=dict)
    """Draw tasks in proportion to these weights, independent of the length of their episodes. A key is a task's name, a
    memory type or ``prompted`` (tasks with a demonstration prompt); the first match counts, and other tasks weigh 1.
    None: all frames alike, which is the default if training decodes video; ``{}``, the default, else: all tasks."""
    warmup_fraction: float = policy_setting(0.05, least=0, most=1)
    """Share of the updates in which the learning rate rises. It then stays constant, or falls as a cosine to 0.02 of
    its maximum at ``size=small``."""

    train_expert_only: bool = False
    """Train the memory and the action expert, and freeze the language model."""
    gradient_checkpointing: bool = False
    """Recompute activations in the backward pass, to save memory."""
    optimizer_lr: float | None = None
    """Highest learning rate; None: that of the size."""
    optimizer_weight_decay: float = FROM_SIZE
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_grad_clip_norm: float = 1.0

    def __post_init__(self) -> None:
        try:
            self._complete()
        except MemobenchError as error:
            # LeRobot's parser reports only that the class "couldn't be instantiated".
            logger.warning("%s", error)
            raise

    def _complete(self) -> None:
        """Set the fields that the size and the perception decide, and check every field."""
        self._check_values()
        if self.visual_encoder is None and self.uses_visual_encoder:
            self.visual_encoder = PACKAGE
        self._complete_memory()
        defaults = self._defaults()
        for name, value in defaults.items():
            if getattr(self, name) in (None, {}):
                setattr(self, name, value)
        if not self.task_weights and not self.decodes_no_video:
            self.task_weights = None
        # A checkpoint without oracle memory holds the shorter prompt length, which would cut the memory text off.
        if self.tokenizer_max_length == self.dimensions.tokenizer_max_length:
            self.tokenizer_max_length = defaults["tokenizer_max_length"]
        self._check_read(defaults)
        if self.objective == REGRESSION:
            self.num_inference_steps = 1
        self._check_numbers()
        super().__post_init__()
        self._check_alignment()
        self.supervised_with_answer |= self.privileged_memory or (self.align != NONE and self.align_targets != PROGRESS)

    def _defaults(self) -> dict[str, Any]:
        """Return the defaults that depend on the size, the perception and the memory."""
        dims = self.dimensions
        mode = NormalizationMode(dims.normalization)
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
        }

    def _check_read(self, defaults: Mapping[str, Any]) -> None:
        unset = {
            setting.name: setting.default if setting.default_factory is MISSING else setting.default_factory()
            for setting in fields(self)
        }
        # Values that a recipe or a checkpoint with another memory, objective, alignment or perception may hold.
        usual = {
            "max_state_dim": () if self.robot_state_feature is None else self.robot_state_feature.shape,
            "memory_fusion": (MODULATION, OWN),
            "memory_camera": (f"{OBS_IMAGES}.{next(iter(CAMERAS))}",),
            "num_inference_steps": (1,),
        }
        for name, condition in conditions(self).items():
            known = [unset[name], defaults.get(name), *usual.get(name, ())]
            if getattr(self, name) not in known and not condition.holds(self):
                raise MemobenchError(
                    f"--policy.{name}={getattr(self, name)} has no effect: only {condition.name} reads it; leave it "
                    f"out, or set it to its default, {json.dumps(unset[name])}."
                )
        if self.memory == NONE:
            self.memory_fusion = None

    def _complete_memory(self) -> None:
        mechanism = self.mechanism
        if mechanism is None:
            if self.memory_settings in [asdict(mechanism_settings(name, {})) for name in OURS if self.memory_settings]:
                self.memory_settings = {}  # the defaults of the memory of the checkpoint that training starts from
            return
        fitting = (OWN,) if mechanism.fusion is not None else (MODULATION, CONTEXT)
        self.memory_fusion = self.memory_fusion or fitting[0]
        if self.memory_fusion not in fitting:
            raise MemobenchError(
                f"--policy.memory={self.memory} cannot be read by memory_fusion={self.memory_fusion}; pass "
                f"--policy.memory_fusion={' or '.join(fitting)}."
            )
        other = settings_of_another(self.memory, self.memory_settings)
        if other is not None:  # a checkpoint with another memory, from which training starts
            logger.warning("memory_settings are those of memory=%s; memory=%s keeps its own", other, self.memory)
            own = setting_names(self.memory)
            self.memory_settings = {name: value for name, value in self.memory_settings.items() if name in own}
        self.memory_settings = asdict(mechanism_settings(self.memory, self.memory_settings))
        if self.memory_stride is None:
            stride = mechanism.stride
            self.memory_stride = stride.get(self.perception) if isinstance(stride, Mapping) else stride

    # -- checks ----------------------------------------------------------------------------------------------------

    def _check_values(self) -> None:
        for setting in fields(self):
            known, value = setting.metadata.get("values"), getattr(self, setting.name)
            if known and value not in known and not (value is None and setting.default is FROM_SIZE):
                raise MemobenchError(
                    f"memobench_mem has no {setting.name} '{value}': {nearest(str(value), known)} "
                    f"Pass --policy.{setting.name}=<one of {', '.join(known)}>."
                )

    def _check_numbers(self) -> None:
        for setting in fields(self):
            least, most = setting.metadata.get("least", -math.inf), setting.metadata.get("most", math.inf)
            if (least, most) != (-math.inf, math.inf) and not least <= getattr(self, setting.name) <= most:  # nor NaN
                raise MemobenchError(
                    f"--policy.{setting.name}={getattr(self, setting.name)} is out of range; expected at least {least}"
                    + ("." if most == math.inf else f" and {'at most' if isinstance(most, int) else 'below'} 1.")
                )
        if self.n_action_steps > self.chunk_size:
            raise MemobenchError(
                f"--policy.n_action_steps={self.n_action_steps} is more than the {self.chunk_size} actions of a chunk "
                "(policy.chunk_size)."
            )
        if any(weight < 0 for weight in (self.task_weights or {}).values()):
            raise MemobenchError(f"--policy.task_weights={self.task_weights} must not hold negative weights.")

    def _check_alignment(self) -> None:
        if self.align == NONE:
            return
        if (mechanism := self.mechanism) is None:
            raise MemobenchError(
                f"--policy.align={self.align} has no memory to align with --policy.memory=none; name a memory "
                f"({', '.join(mechanism_names())}), or use --policy.align=none."
            )
        if mechanism.reads_text:
            raise MemobenchError(
                f"--policy.align={self.align} aligns memory with the subgoal's text, and a chunk of "
                f"memory={self.memory} reads only that text; use --policy.align=none."
            )
        if self.align == "framewise" and not mechanism.per_frame:
            raise MemobenchError(
                "--policy.align=framewise aligns each remembered frame with its own text, and "
                f"memory={self.memory} has no tokens of single frames; use semantic or contrastive, or "
                "--policy.memory=frames."
            )

    # -- derived properties ----------------------------------------------------------------------------------------

    @property
    def fixed_by_training(self) -> tuple[str, ...]:
        """Fields that must keep their values when a checkpoint acts or its training is resumed."""
        # Ours first, because another setting is the cause of other inputs.
        inherited = [setting.name for setting in fields(PreTrainedConfig)]
        names = [setting.name for setting in fields(self) if setting.name not in MAY_DIFFER]
        return tuple(sorted(names, key=inherited.__contains__))

    @property
    def dimensions(self) -> Dimensions:
        return SIZES[self.size]

    @property
    def mechanism(self) -> type[MemoryMechanism] | None:
        """Class of the memory; None for plain pi0.5."""
        return None if self.memory == NONE else find_mechanism(self.memory)

    @property
    def uses_objects(self) -> bool:
        return self.perception == "objects"

    @property
    def uses_detector(self) -> bool:
        return self.detector is not None

    @property
    def uses_visual_encoder(self) -> bool:
        """Whether images are encoded by the visual encoder of `lerobot_memobench.perception`."""
        return self.size == "small" and not self.uses_objects

    @property
    def uses_images(self) -> bool:
        return self.uses_detector or not self.uses_objects

    @property
    def decodes_no_video(self) -> bool:
        """Whether training samples consist of numbers and features in main memory."""
        return self.uses_objects or self.uses_visual_encoder

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
        """Height and width to which images are resized, pixels."""
        side = SIDE if self.uses_visual_encoder else self.dimensions.vision.image
        return side, side

    @property
    def privileged_memory(self) -> bool:
        """Whether the memory learns from texts of checkpoints."""
        return self.mechanism is not None and self.mechanism.privileged

    @property
    def remembers_thumbnails(self) -> bool:
        """Whether small grey copies of images are remembered instead of their tokens."""
        return self.mechanism is not None and self.mechanism.asks_motion and not self.uses_objects

    @property
    def skips_repeated_frames(self) -> bool:
        """Whether a frame equal to the last remembered one is not remembered.

        The holds of strict tasks would fill the memory and use up the frames that a chunk reads.
        """
        return self.mechanism is not None and not self.mechanism.asks_motion and self.decodes_no_video

    def check_memory_reads(self) -> None:
        """Refuse a memory whose fusion cannot report how much a chunk reads of each remembered entry."""
        mechanism = self.mechanism
        if mechanism is None or (mechanism.fusion is not None and not mechanism.fusion.watches):
            raise MemobenchError(
                f"memory_reads=true is not available for memory={self.memory}, which has no attention weights; leave "
                "it out"
            )

    # -- called by LeRobot -----------------------------------------------------------------------------------------

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        assert self.optimizer_lr is not None  # set by construction
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> WarmupFractionSchedulerConfig:
        final = self.dimensions.final_learning_rate
        return WarmupFractionSchedulerConfig(warmup_fraction=self.warmup_fraction, final=final)

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    observation_delta_indices = reward_delta_indices = None

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        # LeRobot does not recognise the column of objects in a dataset with images.
        if not self.uses_images and PRIVILEGED in features:
            shape = tuple(features[PRIVILEGED]["shape"])
            self.input_features.setdefault(OBS_ENV_STATE, PolicyFeature(FeatureType.ENV, shape))

    def validate_features(self) -> None:
        """Remove features that this perception does not read; with a detector, add its cameras."""
        unseen = FeatureType.ENV if self.uses_images else FeatureType.VISUAL
        for key in [key for key, feature in self.input_features.items() if feature.type is unseen or key in CLOCK]:
            del self.input_features[key]
        if self.uses_detector and not self.image_features:
            shape = (3, IMAGE_SIZE, IMAGE_SIZE)
            self.input_features |= {
                f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, shape) for name in CAMERAS
            }
        if not self.uses_images and OBS_ENV_STATE not in self.input_features:
            raise MemobenchError(
                f"perception=objects reads '{OBS_ENV_STATE}', which the inputs lack; train on a dataset of this "
                "version's `memobench generate`, and evaluate with --env.obs_type=environment_state_agent_pos."
            )
        self._choose_memory_camera()
        self._fit_numbers()
        self.input_features.setdefault(OBS_STATE, PolicyFeature(FeatureType.STATE, (self.max_state_dim,)))
        self.output_features.setdefault(ACTION, PolicyFeature(FeatureType.ACTION, (self.max_action_dim,)))

    def _choose_memory_camera(self) -> None:
        cameras = [*self.image_features]
        if self.memory_camera is None and cameras:
            self.memory_camera = cameras[0]
        if self.uses_images and not self.uses_objects and cameras and self.memory_camera not in cameras:
            raise MemobenchError(
                f"--policy.memory_camera={self.memory_camera} is not among the policy's cameras "
                f"({', '.join(cameras)}); name one of them, or leave it out for the first."
            )

    def _fit_numbers(self) -> None:
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


def conditions(config: Any = MemobenchMemConfig) -> dict[str, Condition]:
    """Return the conditions of the fields of a configuration that are not always used."""
    return {setting.name: setting.metadata["used_if"] for setting in fields(config) if setting.metadata.get("used_if")}


def memory_defaults() -> dict[str, Any]:
    """Return the fields that a memory does not take over from another memory's checkpoint -> their defaults."""
    return {
        setting.name: setting.default
        for setting in fields(MemobenchMemConfig)
        if setting.metadata.get("used_if") in (MEMORY, OBJECT_MEMORY, TEXT_MEMORY)
        and setting.name != "memory_settings"  # construction converts them
    }
