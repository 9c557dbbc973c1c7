"""``memobench_mem``: LeRobot's pi0.5 with a visual memory, trained with or without aligning it to checkpoint text."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from safetensors.torch import load_file
from torch import Tensor
from transformers.initialization import no_init_weights

from lerobot_memobench.computing.freed_memory import keep_freed_memory
from lerobot_memobench.datasets.feature_cache.reading import RecordedFrames
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.weights import load_tower
from lerobot_memobench.policies.checkpoint import check_as_trained
from lerobot_memobench.policies.memobench_mem.acting import ActingPolicy
from lerobot_memobench.policies.memobench_mem.adapters import trained_whole
from lerobot_memobench.policies.memobench_mem.alignment.objectives import make_alignment
from lerobot_memobench.policies.memobench_mem.averaging import WeightAverage
from lerobot_memobench.policies.memobench_mem.caching import open_frames
from lerobot_memobench.policies.memobench_mem.checkpoints import (
    load_base_weights,
    load_weights,
    read_config,
    restore_average,
    save_training_weights,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.drawn_statistics import count_drawn_only
from lerobot_memobench.policies.memobench_mem.execution_frames import (
    Drawn,
    execution_starts,
    prompted_factors,
    task_of_frames,
)
from lerobot_memobench.policies.memobench_mem.fused_attention import attend_fused
from lerobot_memobench.policies.memobench_mem.learning import LearningPolicy
from lerobot_memobench.policies.memobench_mem.memory.registry import make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.rollout import RolloutMemory
from lerobot_memobench.policies.memobench_mem.memory_pi05 import MemoryPI05
from lerobot_memobench.policies.memobench_mem.noise import EpisodeNoise
from lerobot_memobench.policies.memobench_mem.one_thread import OneThread
from lerobot_memobench.policies.memobench_mem.perception.eyes import EyePerception
from lerobot_memobench.policies.memobench_mem.plans import RowPlans
from lerobot_memobench.policies.memobench_mem.precision import Precision
from lerobot_memobench.policies.memobench_mem.processing.subgoals import require_texts
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun, begin_training
from lerobot_memobench.policies.memobench_mem.recorded_items import read_from_memory
from lerobot_memobench.policies.memobench_mem.saved_steps import require_agreement
from lerobot_memobench.policies.memobench_mem.training_curve import TrainingCurve
from lerobot_memobench.policies.memobench_mem.weights import require_statistics, weights_file

# A saved pipeline is built right after its policy, by the names under which its steps register when imported.
from lerobot_memobench.policies.memobench_mem import processor_memobench_mem  # noqa: F401  # isort: skip

logger = logging.getLogger(__name__)


class MemobenchMemPolicy(LearningPolicy, ActingPolicy):
    """pi0.5 plus memory. ``forward`` trains, ``select_action`` acts; both see the same history for the same frame.

    Attributes:
        average: moving average of the trained weights, which evaluation uses; None before training, or without one.
        history: what the rows of a rollout remember. plans: what they are about to do.
        run: what it is trained with; None where it only acts.
    """

    config_class = MemobenchMemConfig
    name = "memobench_mem"
    config: MemobenchMemConfig

    def __init__(
        self, config: MemobenchMemConfig, *, dataset_meta: Any | None = None, load_base: bool = True, **kwargs: Any
    ) -> None:
        """Build the policy from scratch, or from ``config.base_weights``.

        Args:
            dataset_meta: metadata of the dataset to train on; its feature cache is checked, and made or finished.
            load_base: whether this is all; not when a checkpoint follows, with which training begins.
        """
        # As PI05Policy.__init__, which names its model class.
        PreTrainedPolicy.__init__(self, config)
        if config.compile_model:
            raise MemobenchError(
                "--policy.compile_model=true would compile pi0.5's forward pass, and set torch's precision of products "
                "for the whole process, while this policy hands its memory to the pass from outside; leave it out "
                "(--use_torch_compile too)."
            )
        if dataset_meta is not None:
            require_texts(Path(dataset_meta.root), config)
        config.validate_features()
        self.init_rtc_processor()
        # What a checkpoint holds is not drawn first: at full size that takes two minutes.
        with nullcontext() if load_base else no_init_weights():
            self.model = MemoryPI05(config, rtc_processor=self.rtc_processor)
        dims = config.dimensions
        self.alignment = make_alignment(
            config.align, dims.vlm.width, dims.text_dim, config.memory_frames, config.tokens_per_frame
        )
        self.precision = Precision(list(self.parameters()))
        if dataset_meta is not None:
            self.precision.settle()  # before weights are loaded, which may be finer than bfloat16
        if config.base_weights and load_base:
            self._load_base_weights(config.base_weights)
        elif isinstance(self.perception, EyePerception) and load_base:
            assert config.eyes is not None
            self.perception.tower.load_state_dict(load_tower(config.eyes).state_dict())
        if config.gradient_checkpointing:
            self.model.gradient_checkpointing_enable()
        self.to(config.device)
        self.average: WeightAverage | None = None
        self.run: TrainingRun | None = None
        self.curve = TrainingCurve()
        self.history = RolloutMemory(make_mechanism(config.memory, config.memory_frames), config.memory_stride)
        self.plans, self.noise = RowPlans(self._action_dim), EpisodeNoise()
        self.thread = OneThread()
        self.reset()
        self.thread.forget()
        if dataset_meta is not None and load_base:
            self._begin_training(dataset_meta)

    def _begin_training(self, meta: Any) -> None:
        """Make ready to train on a dataset: what the preprocessor looks up, and what LeRobot draws."""
        cache = open_frames(Path(meta.root), self.config, self.perception)
        self.run = TrainingRun(self.config, cache, meta)
        begin_training(self.run)
        if isinstance(cache, RecordedFrames):
            read_from_memory(self.run)
            count_drawn_only(meta.stats, cache, cache.phase != 0)
        if self.config.sees_tokens:
            attend_fused(self.model)
        if self._device.type == "cpu":
            keep_freed_memory()
        starts = execution_starts(cache.episodes, cache.phase)
        balance = self.config.balance_tasks
        tasks = task_of_frames(meta, cache.episodes) if balance else None
        factors = None if tasks is None else prompted_factors(tasks, cache.phase, self.config.prompted_weight)
        order = Drawn(starts, self.config.moments_per_episode, tasks, balance, factors)
        self.config.drop_n_last_frames = order  # type: ignore[assignment]  # a number to nobody but LeRobot's sampler

    # -- checkpoints -----------------------------------------------------------------------------------------------

    def _load_base_weights(self, source: str) -> None:
        path = weights_file(source, named=f"--policy.base_weights='{source}'", fix="give a pi0.5 checkpoint")
        load_base_weights(self.model, self._fix_pytorch_state_dict_keys(load_file(path), self.config), source)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        revision: str | None = None,
        dataset_meta: Any | None = None,
        **kwargs: Any,
    ) -> MemobenchMemPolicy:
        """Load a checkpoint, with its averaged weights; to train on (``dataset_meta``), with its trained ones.

        LeRobot's pi0.5 goes on with random weights when loading fails; this does not.

        Raises:
            MemobenchError: weights that do not fit, or, for evaluation, missing statistics.
        """
        source = pretrained_name_or_path
        config = read_config(source, config, revision)
        path = weights_file(source, revision, named=f"The checkpoint '{source}'", fix="give a pretrained_model folder")
        if dataset_meta is None:
            require_statistics(source, revision)
        # The steps lie with an adapter, and not with what it adapts, of which these are the weights.
        saved, of = (config.pretrained_path, config.pretrained_revision) if config.use_peft else (source, revision)
        if saved is not None:
            require_agreement(saved, of, config, training=dataset_meta is not None)
            if dataset_meta is None:
                check_as_trained(saved, config, of)
        policy = cls(config, dataset_meta=dataset_meta, load_base=False)
        load_weights(policy, path, source, remembers=config.memory != "none")
        policy.to(config.device)
        policy.eval()
        if dataset_meta is None:
            return policy
        if policy._averages:
            policy.average = restore_average(policy._new_average(), source, revision)
        policy.curve = TrainingCurve.read(Path(source))
        policy._begin_training(dataset_meta)
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Save the averaged weights as the model, and beside it the trained ones for going on and the losses."""
        self.curve.save(save_directory)
        if self.average is None or state_dict is not None:
            if self.average is not None:
                logger.warning("Sharded training: the checkpoint holds the trained weights, not their average.")
            super()._save_pretrained(save_directory, state_dict=state_dict)
            return
        with self.average.applied():  # in float32, whatever precision it is evaluated in
            super()._save_pretrained(save_directory)
        save_training_weights(self.average, save_directory)

    # -- adapters --------------------------------------------------------------------------------------------------

    def wrap_with_peft(self, peft_config: Any = None, peft_cli_overrides: dict[str, Any] | None = None) -> Any:
        """Wrap the policy with adapters (LeRobot's ``--peft…``); memory and heads are trained whole beside them.

        The adapters' base is what evaluation loads beneath them: a checkpoint's averaged weights.
        """
        if self.average is not None:
            self.average.keep()
            self.average = None
        wrapped = super().wrap_with_peft(peft_config, peft_cli_overrides)
        self.precision.settle()
        return wrapped

    def _get_default_peft_targets(self) -> dict[str, Any]:
        return super()._get_default_peft_targets() | {"modules_to_save": trained_whole(self)}

    def _preprocess_peft_cli_overrides(self, cli_overrides: dict[str, Any], peft_method_type: Any) -> dict[str, Any]:
        overrides: dict[str, Any] = super()._preprocess_peft_cli_overrides(cli_overrides, peft_method_type)
        if overrides.get("modules_to_save") is not None:
            overrides["modules_to_save"] = trained_whole(self, overrides["modules_to_save"])
        return overrides
