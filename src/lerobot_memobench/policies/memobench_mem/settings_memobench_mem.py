"""What may be set of ``memobench_mem``, with what it means (spec: policy.md; paper, Table "reproducibility")."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import NormalizationMode
from lerobot.policies.pi05.configuration_pi05 import PI05Config


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


FIXED = _names(
    """
    size perception object_classes integration oracle_memory memory_camera memory_frames
    tokens_per_frame memory_stride objective chunk_size normalization_mapping image_resolution tokenizer_name
    tokenizer_max_length input_features n_obs_steps paligemma_variant action_expert_variant max_state_dim max_action_dim
    min_period max_period use_relative_actions relative_exclude_joints action_feature_names empty_cameras
    """
)
"""Fields by which a checkpoint was trained, and which are refused where it acts under another value: its weights would
mean something else, mostly without a word. Those that decide others stand before them."""
OF_ACTING = _names(
    """
    n_action_steps whole_plan_if_still eyes num_inference_steps rtc_config device dtype use_amp
    compile_model compile_mode pretrained_path pretrained_revision use_peft output_features
    """
)
"""Fields that are free where a checkpoint acts. ``eyes`` that find objects are no part of it, and its own tower has a
rule of its own (`checkpoints.read_config`); LeRobot makes ``output_features`` of the environment's, which
`policies.shown` compares with the checkpoint's."""
OF_TRAINING = _names(
    """
    sight_errors base_weights align align_weight subgoal_level shuffle_subgoals
    shuffle_seed text_encoder memory_cache_dir ema_decay moments_per_episode balance_tasks prompted_weight
    train_expert_only warmup_fraction final_lr gradient_checkpointing time_sampling_beta_alpha
    time_sampling_beta_beta time_sampling_scale time_sampling_offset optimizer_lr optimizer_betas optimizer_eps
    optimizer_weight_decay optimizer_grad_clip_norm scheduler_warmup_steps scheduler_decay_steps scheduler_decay_lr
    push_to_hub repo_id private tags license
    """
)
"""Fields that say how a policy is trained and where it goes: a checkpoint that acts reads none of them, and another
value is refused there, or its card would tell of a training that never was."""
SINCE_BEGUN = _names(
    """
    align subgoal_level shuffle_subgoals shuffle_seed text_encoder base_weights train_expert_only
    ema_decay warmup_fraction final_lr optimizer_lr optimizer_betas optimizer_eps optimizer_weight_decay
    optimizer_grad_clip_norm scheduler_warmup_steps scheduler_decay_steps scheduler_decay_lr
    """
)
"""Those of `OF_TRAINING` that a training keeps where it is gone on with: they decide the model's parts and what these
learn, or stand in the optimizer's saved state, which LeRobot makes from them once."""

SIZES_OWN: Any = None
"""Default of what the size or the perception decides once the rest is known; then it is a number."""


@dataclass
class MemobenchMemSettings(PI05Config):
    """pi0.5's fields plus the memory's. Fields that are ``None`` here take the size's value after construction."""

    knows_phases: ClassVar[bool] = True
    execution_only: ClassVar[bool] = True
    fixed_by_training: ClassVar[tuple[str, ...]] = FIXED
    of_training_alone: ClassVar[tuple[str, ...]] = OF_TRAINING
    kept_since_begun: ClassVar[tuple[str, ...]] = (*FIXED, *SINCE_BEGUN)

    size: str = "tiny"
    """``small`` (from scratch, learns from objects in minutes on a CPU), ``tiny`` (from scratch, trains on a CPU) or
    ``pi05`` (3.2 B)."""

    perception: str = "pixels"
    """How a moment is seen: ``pixels``, by the image tower, or ``objects``, by the slots of
    ``observation.environment_state`` (`sim.object_slots`), without any picture, or as ``eyes`` find them."""
    eyes: str | None = None
    """What pictures are seen through: a file of `memobench eyes train`, ``package``: the eyes that come with the
    package, or ``random``: pi0.5's image tower with random weights. With ``perception=objects``, the eyes that find
    them in pictures; none: the environment tells them. With pixels at ``size=small``, whose tower's tokens are seen;
    none: ``package``. A checkpoint of pixels holds its tower; there this only says where it was from."""
    sight_errors: float = 0.0
    """With which errors told objects are seen in training, so that the policy acts through ``eyes`` afterwards; 1: as
    large as those of the package's eyes, 0: none."""
    object_classes: list[str] | None = None
    """Names of the classes that slots were trained with, in order of their indices; none: those of this version."""

    base_weights: str | None = None
    """Folder or repository of pi0.5 weights to start from (e.g. ``lerobot/pi05_base``); none: from scratch."""

    # -- alignment
    align: str = "none"
    align_weight: float | None = None
    """Weight of the alignment loss; none or 0: the paper's for this objective (``align=none`` trains without one)."""
    subgoal_level: str = "intermediate"
    shuffle_subgoals: bool = False
    """Control of the paper: the subgoal texts of an episode change places among themselves, or with those of other
    episodes where it has fewer than three."""
    shuffle_seed: int = 7
    """Which shuffle; the same for every epoch and on every machine."""
    text_encoder: str | None = None

    # -- memory
    integration: str = "modulation"
    """How actions read memory: ``modulation``, ``context`` (memory joins the prefix), or ``none``: plain pi0.5, the
    baseline that never sees the past."""
    oracle_memory: bool = False
    """Control of the paper: ground-truth memory text stands in the prompt, from the dataset's column ``memory`` in
    training and from the environment (``--env.oracle_memory=true``) at evaluation."""
    memory_camera: str | None = None
    """Whose pictures are remembered; none: the first camera's that the policy sees."""
    memory_frames: int = 32
    tokens_per_frame: int = SIZES_OWN
    """Memory tokens of a remembered frame: 16 of a picture; 2, or another number, of objects."""
    memory_stride: int = SIZES_OWN
    """Every how many control steps a frame enters the history (and the cache); none: 8 with objects and
    with eyes, 1 with other pixels."""
    memory_cache_dir: str | None = None
    """Folder for feature caches, of several datasets perhaps; none: ``feature_cache`` in the dataset's folder."""

    # -- training
    objective: str = SIZES_OWN
    """How actions are learned: ``flow_matching``, as in pi0.5, or ``regression``, whose plan is one pass of the model
    instead of ten (`action_objective`). None: the size's, ``regression`` at ``small``."""
    ema_decay: float = SIZES_OWN
    """Decay of the weights' moving average, which evaluation uses; 0 turns it off. None: the size's, the paper's
    0.999 or 0.995 at ``small``."""
    moments_per_episode: int = SIZES_OWN
    """How many frames of an episode stand side by side in a batch, which shares what they remember; none: 6 with
    objects and with eyes, and 1, LeRobot's order, with other pixels. ``batch_size`` counts frames all the same."""
    balance_tasks: float = SIZES_OWN
    """1: each task is drawn equally often, however long its episodes are; 0: each frame once per epoch; between: in
    proportion to its frames to the power 1 - balance_tasks. None: 1 with objects and with eyes, else 0."""
    prompted_weight: float = 1.0
    """How many times as often as another a task that begins with a prompt is drawn, where tasks are balanced: to read a
    prompt takes more updates than to act."""
    warmup_fraction: float = 0.05
    final_lr: float = SIZES_OWN
    """Learning rate at the end, as a fraction of the highest, to which it falls as a cosine; 1: it stays constant.
    None: the size's, 0.02 at ``small`` and the paper's 1 elsewhere."""

    # -- pi0.5's fields with this recipe's values, or the size's where they are None or empty
    chunk_size: int = SIZES_OWN
    n_action_steps: int = SIZES_OWN
    whole_plan_if_still: bool = False
    """Whether all of a plan is carried out, and not its first ``n_action_steps``, where the hand stands as it stood at
    the plan before: on a rim it might stand for ever, and plan each time to let go a little later."""
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)
    image_resolution: tuple[int, int] | None = None
    tokenizer_name: str | None = None
    tokenizer_max_length: int | None = None
    optimizer_lr: float | None = None
    optimizer_weight_decay: float = SIZES_OWN
