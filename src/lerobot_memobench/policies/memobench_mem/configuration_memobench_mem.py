"""Configuration of ``memobench_mem``: pi0.5 with a visual memory (spec: policy.md; paper, Table "reproducibility")."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.memobench_mem.dimensions import GRID, SIZES, Dimensions
from lerobot_memobench.policies.memobench_mem.schedule import WarmupFractionSchedulerConfig

logger = logging.getLogger(__name__)

ALIGN_WEIGHTS = {"none": 0.0, "semantic": 0.1, "contrastive": 0.1, "framewise": 0.05}
INTEGRATIONS = ("modulation", "context", "none")
SUBGOAL_LEVELS = ("coarse", "intermediate", "fine")
TOKENS_PER_FRAME = GRID**2
ORACLE_TOKENS = 128
"""Room that oracle memory text needs in a prompt of the word tokenizer: six checkpoints of some ten words."""


def _choose(field: str, given: str, known: tuple[str, ...]) -> None:
    if given not in known:
        raise MemobenchError(
            f"memobench_mem has no {field} '{given}': {nearest(str(given), known)} "
            f"Pass --policy.{field}=<one of {', '.join(known)}>."
        )


@PreTrainedConfig.register_subclass("memobench_mem")
@dataclass
class MemobenchMemConfig(PI05Config):
    """pi0.5's fields plus the memory's. Fields that are ``None`` here take the size's value after construction."""

    knows_phases: ClassVar[bool] = True

    size: str = "tiny"
    """``tiny`` (from scratch, trains on a CPU) or ``pi05`` (3.2 B)."""

    base_weights: str | None = None
    """Folder or repository of pi0.5 weights to start from (e.g. ``lerobot/pi05_base``); none: from scratch."""

    # -- alignment
    align: str = "none"
    align_weight: float | None = None
    """Weight of the alignment loss; none or 0: the paper's for this objective (``align=none`` trains without one)."""
    subgoal_level: str = "intermediate"
    shuffle_subgoals: bool = False
    """Control of the paper: the subgoal texts of an episode change places among themselves."""
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
    memory_camera: str = "observation.images.image"
    memory_frames: int = 32
    tokens_per_frame: int = TOKENS_PER_FRAME
    memory_stride: int = 1
    """Every how many control steps a frame enters the history (and the cache)."""
    memory_cache_dir: str | None = None
    """Folder for memory caches, of several datasets perhaps; none: ``memory_cache`` in the dataset's folder."""

    # -- training
    prompt_loss: bool = False
    """Whether prompt frames (``phase == 0``), whose actions have no effect, count in the action loss."""
    ema_decay: float = 0.999
    """Decay of the weights' moving average, which evaluation uses; 0 turns it off."""
    freeze_vision_encoder: bool = True
    warmup_fraction: float = 0.05

    # -- pi0.5's fields with this recipe's values
    image_resolution: tuple[int, int] | None = None
    tokenizer_name: str | None = None
    tokenizer_max_length: int | None = None
    optimizer_lr: float | None = None
    optimizer_weight_decay: float = 0.0

    def __post_init__(self) -> None:
        try:
            self._complete()
        except MemobenchError as error:
            # LeRobot's parser reports only that the class "couldn't be instantiated".
            logger.warning("%s", error)
            raise

    def _complete(self) -> None:
        """Fill in what the size and the objective decide, and check every field."""
        _choose("size", self.size, tuple(SIZES))
        _choose("align", self.align, tuple(ALIGN_WEIGHTS))
        _choose("integration", self.integration, INTEGRATIONS)
        _choose("subgoal_level", self.subgoal_level, SUBGOAL_LEVELS)
        dims = self.dimensions
        if self.image_resolution is None:
            self.image_resolution = (dims.vision.image, dims.vision.image)
        # A checkpoint without oracle memory holds the length of prompts without it, which would cut the text off.
        if self.tokenizer_max_length in (None, dims.tokenizer_max_length):
            room = ORACLE_TOKENS if self.oracle_memory and dims.tokenizer == "words" else 0
            self.tokenizer_max_length = dims.tokenizer_max_length + room
        if self.optimizer_lr is None:
            self.optimizer_lr = dims.learning_rate
        self.tokenizer_name = self.tokenizer_name or dims.tokenizer
        self.text_encoder = self.text_encoder or dims.text_encoder
        # A checkpoint with align=none holds a weight of 0, with which another objective would change nothing.
        if not self.align_weight:
            self.align_weight = ALIGN_WEIGHTS[self.align]
        super().__post_init__()
        self._check_numbers()
        self._check_perception()
        self._check_alignment()

    def _check_numbers(self) -> None:
        for field in ("memory_frames", "memory_stride", "n_action_steps"):
            if getattr(self, field) < 1:
                raise MemobenchError(f"--policy.{field}={getattr(self, field)} must be at least 1.")
        if not 0.0 <= self.ema_decay < 1.0:
            raise MemobenchError(f"--policy.ema_decay={self.ema_decay} must be in [0, 1); 0 turns it off.")
        if self.align_weight is not None and self.align_weight < 0:
            raise MemobenchError(f"--policy.align_weight={self.align_weight} must not be negative.")

    def _check_perception(self) -> None:
        if self.tokens_per_frame != TOKENS_PER_FRAME:
            raise MemobenchError(
                f"--policy.tokens_per_frame={self.tokens_per_frame} is not supported: frames are pooled to a "
                f"4x4 grid, so leave it at {TOKENS_PER_FRAME}."
            )
        if not self.freeze_vision_encoder:
            raise MemobenchError(
                "--policy.freeze_vision_encoder=false cannot be used: memory tokens are cached from the frozen "
                "vision tower, and would no longer match a tower that learns."
            )
        patch = self.dimensions.vision.patch
        if any(side % patch or (side // patch) % GRID for side in self.image_size):
            raise MemobenchError(
                f"--policy.image_resolution={self.image_resolution} must be a multiple of {GRID * patch} pixels at "
                f"size {self.size}, so that its patches pool to a 4x4 grid."
            )

    def _check_alignment(self) -> None:
        if self.align != "none" and self.memory == "none":
            raise MemobenchError(
                f"--policy.align={self.align} has no memory to align with --policy.integration=none; use modulation or "
                "context, or --policy.align=none."
            )
        if self.shuffle_subgoals and self.align == "none":
            raise MemobenchError(
                "--policy.shuffle_subgoals=true changes nothing with --policy.align=none, which reads no subgoals; "
                "name an alignment too."
            )

    # No field: LeRobot asks it of a configuration when it makes its sampler (see `execution_frames`).
    drop_n_last_frames = 0

    @property
    def dimensions(self) -> Dimensions:
        """Dimensions of this size."""
        return SIZES[self.size]

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the images the policy sees; ``image_resolution``, known to be set."""
        assert self.image_resolution is not None
        return tuple(self.image_resolution)  # type: ignore[return-value]  # a checkpoint gives a list

    @property
    def memory(self) -> str:
        """Name of the memory mechanism, one of ``memory.registry.MECHANISMS``."""
        return "none" if self.integration == "none" else "frame_sampling"

    @property
    def watches(self) -> bool:
        """Whether frames count that are seen between two plans."""
        return self.memory != "none"

    @property
    def cache_name(self) -> str:
        """What the name of the memory cache begins with that this policy reads."""
        return f"{self.size}-stride{self.memory_stride}"

    def get_scheduler_preset(self) -> WarmupFractionSchedulerConfig:
        """Return the schedule that lerobot-train takes."""
        return WarmupFractionSchedulerConfig(warmup_fraction=self.warmup_fraction)
