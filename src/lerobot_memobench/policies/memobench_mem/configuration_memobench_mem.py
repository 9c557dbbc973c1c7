"""Configuration of ``memobench_mem``: its settings, with what size and perception decide, checked."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES

from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED
from lerobot_memobench.envs.observations import DETECTIONS, SEEN_PIXELS
from lerobot_memobench.envs.observations import PRIVILEGED as SEEN_OBJECTS
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.perception.tower import SIDE
from lerobot_memobench.perception.weights import PACKAGE, RANDOM
from lerobot_memobench.policies.memobench_mem.action_objective import OBJECTIVES, REGRESSION
from lerobot_memobench.policies.memobench_mem.dimensions import GRID, SIZES, Dimensions
from lerobot_memobench.policies.memobench_mem.schedule import FusedAdamWConfig, WarmupFractionSchedulerConfig
from lerobot_memobench.policies.memobench_mem.settings_memobench_mem import MemobenchMemSettings
from lerobot_memobench.protocol import CAMERAS, IMAGE_SIZE

logger = logging.getLogger(__name__)

ALIGN_WEIGHTS = {"none": 0.0, "semantic": 0.1, "contrastive": 0.1, "framewise": 0.05}
INTEGRATIONS = ("modulation", "context", "none")
PERCEPTIONS = ("pixels", "objects")
SUBGOAL_LEVELS = ("coarse", "intermediate", "fine")
TOKENS_PER_FRAME = {"pixels": GRID**2, "objects": 2}
MEMORY_STRIDE, MOMENTS_PER_EPISODE = 8, 6
"""Where samples are made of what was read before training; 1 elsewhere."""
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
class MemobenchMemConfig(MemobenchMemSettings):
    """The settings, completed and checked."""

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
        _choose("perception", self.perception, PERCEPTIONS)
        _choose("integration", self.integration, INTEGRATIONS)
        _choose("subgoal_level", self.subgoal_level, SUBGOAL_LEVELS)
        self._choose_eyes()
        dims = self.dimensions
        for name, value in self._defaults().items():
            if getattr(self, name) is None:
                setattr(self, name, value)
        _choose("objective", self.objective, OBJECTIVES)
        if not self.normalization_mapping:
            mode = NormalizationMode(dims.recipe.normalization)
            self.normalization_mapping = {"VISUAL": NormalizationMode.IDENTITY, "STATE": mode, "ACTION": mode}
        if self.image_resolution is None:
            side = SIDE if self.sees_tokens else dims.vision.image
            self.image_resolution = (side, side)
        # A checkpoint without oracle memory holds the length of prompts without it, which would cut the text off.
        if self.tokenizer_max_length in (None, dims.tokenizer_max_length):
            room = ORACLE_TOKENS if self.oracle_memory and dims.tokenizer == "words" else 0
            self.tokenizer_max_length = dims.tokenizer_max_length + room
        self.tokenizer_name = self.tokenizer_name or dims.tokenizer
        self.text_encoder = self.text_encoder or dims.text_encoder
        # A checkpoint with align=none holds a weight of 0, with which another objective would change nothing.
        if not self.align_weight:
            self.align_weight = ALIGN_WEIGHTS[self.align]
        if self.objective == REGRESSION:
            self.num_inference_steps = 1
        self.freeze_vision_encoder = True  # memory tokens are cached from the tower, and must stay what they are
        super().__post_init__()
        self._check_numbers()
        self._check_perception()
        self._check_objective()
        self._check_alignment()

    def _defaults(self) -> dict[str, Any]:
        """Return what the size and the perception decide where nobody else does."""
        recipe = self.dimensions.recipe
        return {
            "chunk_size": recipe.chunk_size,
            "n_action_steps": min(recipe.n_action_steps, self.chunk_size or recipe.chunk_size),
            "ema_decay": recipe.ema_decay,
            "final_lr": recipe.final_lr,
            "objective": recipe.objective,
            "optimizer_weight_decay": recipe.weight_decay,
            "optimizer_lr": self.dimensions.learning_rate,
            "tokens_per_frame": TOKENS_PER_FRAME[self.perception],
            "memory_stride": MEMORY_STRIDE if self.decodes_nothing else 1,
            "balance_tasks": float(self.decodes_nothing),
            "moments_per_episode": MOMENTS_PER_EPISODE if self.decodes_nothing else 1,
        }

    def _choose_eyes(self) -> None:
        if self.size == "small" and not self.sees_objects:
            self.eyes = self.eyes or PACKAGE
        elif self.eyes is not None and not self.sees_objects:
            raise MemobenchError(
                f"--policy.eyes={self.eyes} is for --policy.size=small, or --policy.perception=objects, and not for "
                f"size={self.size} perception={self.perception}; leave it out."
            )
        elif self.eyes == RANDOM:
            raise MemobenchError(
                f"--policy.eyes={RANDOM} finds no objects; name {PACKAGE} or a file of `memobench eyes train`, or "
                "leave it out: then objects are told by the environment."
            )

    def _check_numbers(self) -> None:
        counts = ("memory_frames", "memory_stride", "n_action_steps", "tokens_per_frame", "moments_per_episode")
        for name in counts:
            if getattr(self, name) < 1:
                raise MemobenchError(f"--policy.{name}={getattr(self, name)} must be at least 1.")
        if not 0.0 <= self.final_lr <= 1.0:
            raise MemobenchError(f"--policy.final_lr={self.final_lr} must be in [0, 1]; 1 keeps the rate constant.")
        if not 0.0 <= self.balance_tasks <= 1.0:
            raise MemobenchError(f"--policy.balance_tasks={self.balance_tasks} must be in [0, 1]; 1 draws them alike.")
        if self.prompted_weight <= 0.0 or (self.prompted_weight != 1.0 and not self.balance_tasks):
            raise MemobenchError(
                f"--policy.prompted_weight={self.prompted_weight} must be above 0, and 1 where tasks are not balanced "
                f"(--policy.balance_tasks={self.balance_tasks})."
            )
        if not 0.0 <= self.ema_decay < 1.0:
            raise MemobenchError(f"--policy.ema_decay={self.ema_decay} must be in [0, 1); 0 turns it off.")
        if self.align_weight is not None and self.align_weight < 0:
            raise MemobenchError(f"--policy.align_weight={self.align_weight} must not be negative.")

    def _check_perception(self) -> None:
        if self.sight_errors < 0 or (self.sight_errors and not self.sees_objects):
            raise MemobenchError(
                f"--policy.sight_errors={self.sight_errors} must not be negative, and are errors of objects: leave it "
                "out, or use --policy.perception=objects."
            )
        if self.whole_plan_if_still and not self.sees_objects:
            raise MemobenchError(
                "--policy.whole_plan_if_still=true is for policies that see objects, which are told where the hand is; "
                "leave it out, or use --policy.perception=objects."
            )
        if self.perception == "pixels" and self.tokens_per_frame != GRID**2:
            raise MemobenchError(
                f"--policy.tokens_per_frame={self.tokens_per_frame} is not supported: frames are pooled to a "
                f"4x4 grid, so leave it at {GRID**2}."
            )
        if self.sees_tokens:
            if self.image_size != (SIDE, SIDE):
                raise MemobenchError(
                    f"--policy.image_resolution={self.image_resolution} cannot be used: eyes look at {SIDE} x {SIDE} "
                    "pixels; leave it out, or use --policy.eyes=random."
                )
            return
        patch = self.dimensions.vision.patch
        if any(side % patch or (side // patch) % GRID for side in self.image_size):
            raise MemobenchError(
                f"--policy.image_resolution={self.image_resolution} must be a multiple of {GRID * patch} pixels at "
                f"size {self.size}, so that its patches pool to a 4x4 grid."
            )

    def _check_objective(self) -> None:
        if self.objective == REGRESSION and self.rtc_config is not None:
            raise MemobenchError(
                "--policy.rtc_config guides the denoising of a plan, which --policy.objective=regression lacks; "
                "leave it out, or use --policy.objective=flow_matching."
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
    def sees_objects(self) -> bool:
        """Whether a moment is seen as objects."""
        return self.perception == "objects"

    @property
    def has_eyes(self) -> bool:
        """Whether pictures are seen through `lerobot_memobench.perception`."""
        return self.eyes not in (None, RANDOM)

    @property
    def sees_tokens(self) -> bool:
        """Whether what is seen of pictures are the tokens of eyes."""
        return self.has_eyes and not self.sees_objects

    @property
    def finds_objects(self) -> bool:
        """Whether the objects that are seen are those that eyes find in pictures."""
        return self.has_eyes and self.sees_objects

    @property
    def sees(self) -> tuple[str, ...]:
        """What it sees in a rollout, in the words of `envs.observations`."""
        if not self.sees_objects:
            return (SEEN_PIXELS,)
        return (DETECTIONS,) if self.finds_objects else (SEEN_OBJECTS,)

    @property
    def sees_pictures(self) -> bool:
        """Whether pictures are looked at."""
        return self.has_eyes or not self.sees_objects

    @property
    def cache_place(self) -> Path | None:
        """Folder that holds feature caches; None: the one beside each dataset."""
        return None if self.memory_cache_dir is None else Path(self.memory_cache_dir).expanduser()

    @property
    def decodes_nothing(self) -> bool:
        """Whether training samples are made of what was read, or seen, before; no video is decoded for them."""
        return self.sees_objects or self.has_eyes

    @property
    def state_token(self) -> bool:
        """Whether the state enters as numbers, by a token of the prefix; otherwise as words of the prompt.

        Words at full size, as in pi0.5, and in tiny policies of pixels, which were so from the beginning.
        """
        return self.dimensions.tokenizer == "words" and (self.sees_objects or self.size != "tiny")

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
        """Whether pictures count that are shown between two plans."""
        return self.memory != "none" and self.sees_pictures

    @property
    def cache_name(self) -> str:
        """What the name of the feature cache begins with that this policy reads."""
        return f"{self.size}-stride{self.memory_stride}"

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """Return the optimizer that lerobot-train takes."""
        return FusedAdamWConfig(**vars(super().get_optimizer_preset()))

    def get_scheduler_preset(self) -> WarmupFractionSchedulerConfig:
        """Return the schedule that lerobot-train takes."""
        return WarmupFractionSchedulerConfig(warmup_fraction=self.warmup_fraction, final=self.final_lr)

    def set_dataset_feature_metadata(self, features: dict[str, Any]) -> None:
        """Take the objects of a dataset with pictures for the input that LeRobot does not take them for.

        LeRobot calls this with a dataset's ``features`` before it makes a policy for it.
        """
        if not self.sees_pictures and PRIVILEGED in features:
            shape = tuple(features[PRIVILEGED]["shape"])
            self.input_features.setdefault(OBS_ENV_STATE, PolicyFeature(FeatureType.ENV, shape))

    def validate_features(self) -> None:
        """Keep of the features what this perception looks at, besides the state.

        A checkpoint that was trained on the environment's objects has no pictures among them; eyes look at all cameras.

        Raises:
            MemobenchError: they lack the slots of objects or the camera that is remembered, or have more numbers than
                the weights to start from.
        """
        unseen = FeatureType.ENV if self.sees_pictures else FeatureType.VISUAL
        for key in [key for key, feature in self.input_features.items() if feature.type is unseen]:
            del self.input_features[key]
        if self.finds_objects and not self.image_features:
            shape = (3, IMAGE_SIZE, IMAGE_SIZE)
            self.input_features |= {
                f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, shape) for name in CAMERAS
            }
        if not self.sees_pictures and OBS_ENV_STATE not in self.input_features:
            raise MemobenchError(
                f"perception=objects sees by '{OBS_ENV_STATE}', which is not there; train on a dataset of this "
                "version's `memobench generate`, and evaluate with --env.obs_type=environment_state_agent_pos."
            )
        self._choose_memory_camera()
        self._fit_numbers()
        super().validate_features()

    def _choose_memory_camera(self) -> None:
        cameras = [*self.image_features]
        if self.memory_camera is None and cameras:
            self.memory_camera = cameras[0]
        if self.sees_pictures and not self.sees_objects and cameras and self.memory_camera not in cameras:
            raise MemobenchError(
                f"--policy.memory_camera={self.memory_camera} is none of the cameras that this policy sees "
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
