"""``memobench_mem``: LeRobot's pi0.5 with a visual memory, trained with or without aligning it to checkpoint text."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.freshness import PICTURE_STEP, require_fresh
from lerobot_memobench.policies.memobench_mem.action_loss import counted_actions, mean_losses
from lerobot_memobench.policies.memobench_mem.adapters import trained_whole
from lerobot_memobench.policies.memobench_mem.alignment.loss import alignment_loss
from lerobot_memobench.policies.memobench_mem.alignment.objectives import make_alignment
from lerobot_memobench.policies.memobench_mem.averaging import WeightAverage
from lerobot_memobench.policies.memobench_mem.caching import open_cache
from lerobot_memobench.policies.memobench_mem.checkpoints import (
    load_base_weights,
    load_weights,
    read_config,
    restore_average,
    save_training_weights,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.execution_frames import FromStarts, execution_starts
from lerobot_memobench.policies.memobench_mem.memory.batch import MASK, PHASE, STEPS, TOKENS, MemoryBatch
from lerobot_memobench.policies.memobench_mem.memory.registry import make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.rollout import RolloutMemory
from lerobot_memobench.policies.memobench_mem.memory_pi05 import MemoryPI05
from lerobot_memobench.policies.memobench_mem.noise import EpisodeNoise
from lerobot_memobench.policies.memobench_mem.one_thread import OneThread
from lerobot_memobench.policies.memobench_mem.plans import RowPlans
from lerobot_memobench.policies.memobench_mem.precision import Precision
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun, begin_training
from lerobot_memobench.policies.memobench_mem.saved_steps import require_agreement
from lerobot_memobench.policies.memobench_mem.weights import require_statistics, weights_file
from lerobot_memobench.policies.shown import cure

# A saved pipeline is built right after its policy, by the names under which its steps register when imported.
from lerobot_memobench.policies.memobench_mem import processor_memobench_mem  # noqa: F401  # isort: skip

logger = logging.getLogger(__name__)

OBS_STEP, OBS_PHASE, OBS_PICTURE = "observation.step", "observation.phase", f"observation.{PICTURE_STEP}"


class MemobenchMemPolicy(PI05Policy):
    """pi0.5 plus memory. ``forward`` trains, ``select_action`` acts; both see the same history for the same frame.

    Attributes:
        average: moving average of the trained weights, which evaluation uses; None before training, or without one.
        history: what the rows of a rollout remember.
        plans: what they are about to do.
    """

    config_class = MemobenchMemConfig
    name = "memobench_mem"
    config: MemobenchMemConfig

    def __init__(
        self, config: MemobenchMemConfig, *, dataset_meta: Any | None = None, load_base: bool = True, **kwargs: Any
    ) -> None:
        """Build the policy from scratch, or from ``config.base_weights``.

        Args:
            dataset_meta: metadata of the dataset to train on; its memory cache is checked, and made or finished.
            load_base: whether this is all; not when a checkpoint follows, with which training begins.
        """
        # As PI05Policy.__init__, which names its model class.
        PreTrainedPolicy.__init__(self, config)
        config.validate_features()
        self.init_rtc_processor()
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
        if config.gradient_checkpointing:
            self.model.gradient_checkpointing_enable()
        self.to(config.device)
        self.perception = self.model.paligemma_with_expert.perception
        self.average: WeightAverage | None = None
        self.history = RolloutMemory(make_mechanism(config.memory, config.memory_frames), config.memory_stride)
        self.plans, self.noise = RowPlans(self._action_dim), EpisodeNoise()
        self.thread = OneThread()
        self.reset()
        self.thread.forget()
        if dataset_meta is not None and load_base:
            self._begin_training(dataset_meta)

    @property
    def _action_dim(self) -> int:
        assert self.config.output_features is not None
        return self.config.output_features[ACTION].shape[0]

    @property
    def _device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def _remembers(self) -> bool:
        return self.history.mechanism.frames > 0

    def _begin_training(self, meta: Any) -> None:
        """Make ready to train on a dataset: its memory cache for the preprocessor, its execution frames for LeRobot."""
        cache = open_cache(Path(meta.root), self.config, self.perception)
        begin_training(TrainingRun(self.config, cache, meta))
        drawn = FromStarts.of(execution_starts(cache.episodes, cache.phase))
        self.config.drop_n_last_frames = 0 if self.config.prompt_loss else drawn

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
        policy = cls(config, dataset_meta=dataset_meta, load_base=False)
        load_weights(policy, path, source, remembers=config.memory != "none")
        policy.to(config.device)
        policy.eval()
        if dataset_meta is None:
            begin_training(None)
            return policy
        if policy._averages:
            policy.average = restore_average(policy._new_average(), source, revision)
        policy._begin_training(dataset_meta)
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Save the averaged weights as the model, and the trained ones beside it for going on."""
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

    # -- training --------------------------------------------------------------------------------------------------

    @property
    def _averages(self) -> bool:
        """Whether weights are averaged: not those of adapters, of which peft writes a checkpoint's file."""
        return self.config.ema_decay > 0 and not self.config.use_peft

    def _trained(self) -> dict[str, nn.Parameter]:
        return {name: parameter for name, parameter in self.named_parameters() if parameter.requires_grad}

    def _new_average(self) -> WeightAverage:
        return WeightAverage(self._trained(), self.config.ema_decay)

    def get_optim_params(self) -> list[nn.Parameter]:
        """Parameters that learn, in float32: all but the image tower and what pi0.5 never uses."""
        self.precision.settle()
        return list(self._trained().values())

    def update(self) -> None:
        """Called by lerobot-train after each optimiser step: move the average of the weights."""
        if self.average is not None:
            self.average.update()

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Flow-matching loss plus weighted alignment on a preprocessed training batch.

        Args:
            batch: what LeRobot's pi0.5 needs, and ``memory.*`` and ``phase`` as the preprocessor adds them.
            reduction: ``mean`` for a scalar, ``none`` for one loss per sample (B,).

        Returns:
            The loss, and numbers to log: ``action_loss``, and with an alignment ``align_loss`` (unweighted),
            ``align_grad_norm`` (of the weighted loss, over the memory encoder's parameters) and ``align_top1`` (share
            of memory vectors whose nearest text in the batch is theirs).

        Raises:
            MemobenchError: the batch has no memory.
        """
        self._require_memory(batch)
        if self._averages and self.average is None and self.training:
            self.average = self._new_average()
        with self.precision.computing(self._device):
            memory = self._read_memory(batch)
            per_sample, total, logged = self._action_loss(batch)
            if self.alignment is not None and memory is not None:
                assert self.config.align_weight is not None
                encoder = [parameter for parameter in self.model.memory.parameters() if parameter.requires_grad]
                weighted, numbers = alignment_loss(self.alignment, self.config.align_weight, batch, *memory, encoder)
                per_sample, total, logged = per_sample + weighted, total + weighted, logged | numbers
        logged["loss"] = total.item()
        return (per_sample, logged) if reduction == "none" else (total, logged)

    def _require_memory(self, batch: dict[str, Tensor]) -> None:
        needed = TOKENS if self._remembers else PHASE
        if needed not in batch:
            raise MemobenchError(
                f"The training batch has no '{needed}': the preprocessor lacks the step memobench_gather_memory; to "
                "start from pi0.5's weights pass --policy.base_weights instead of --policy.pretrained_path."
            )

    def _read_memory(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor] | None:
        """Hand a batch's memory to the model; return its tokens (B, L, d_m) and their mask (B, L)."""
        if not self._remembers:
            return None
        return self.model.set_memory(*MemoryBatch(batch[TOKENS], batch[STEPS], batch[MASK]).to(self._device))

    def _action_loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Flow-matching loss per sample (B,), its mean over the actions that count, and numbers to log."""
        images, image_masks = self._preprocess_images(batch)
        actions = self.prepare_action(batch)
        losses = self.model.forward(
            images,
            image_masks,
            batch[OBS_LANGUAGE_TOKENS],
            batch[OBS_LANGUAGE_ATTENTION_MASK],
            actions,
            self.model.sample_noise(actions.shape, actions.device),
            self.model.sample_time(actions.shape[0], actions.device),
        )[:, :, : self._action_dim]
        found = mean_losses(losses, counted_actions(batch, losses, prompt_loss=self.config.prompt_loss))
        logged = {"action_loss": found.mean.item(), "loss_per_dim": found.per_dim.cpu().tolist()}
        return found.per_sample, found.mean, logged

    # -- rollout ---------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget histories and planned actions. LeRobot calls it once per batch of episodes."""
        super().reset()
        for part in (self.history, self.plans, self.noise):
            part.reset()
        self._calls = 0
        self.thread.begin()
        self._acting_rows: list[int] = []

    def looks_next(self) -> bool:
        """Whether the pictures of the next observation are read: it is remembered, or a plan is made from it.

        Asked after an action. Whether the next frame is the first of an execution, where plans begin, only the
        environment knows: that one is to be shown in any case, as the first of an episode.
        """
        return self.history.writes_next() or bool(self.plans.wanting(self._acting_rows))

    def observe(self, batch: dict[str, Tensor]) -> tuple[list[int], list[bool], list[bool]]:
        """Take the current frames of all rows into their histories; return steps, new episodes and frozen rows."""
        seen = self.perception.remembers
        if seen not in batch:
            raise MemobenchError(f"The observation has no '{seen}', which this policy remembers; {cure(seen, batch)}")
        count = len(batch[seen])
        if OBS_STEP in batch:
            steps = [round(step) for step in batch[OBS_STEP].reshape(count, -1)[:, 0].tolist()]
        else:
            steps = [self._calls] * count  # an environment without a clock: one call is one step
        self._calls += 1
        started, frozen = self.history.observe(steps, lambda rows: self._encode(batch, steps, rows))
        self.noise.resize(count)
        for row in range(count):
            if started[row]:
                told = (key for key in (seen, OBS_STATE, OBS_LANGUAGE_TOKENS) if key in batch)
                self.noise.begin(row, (batch[key][row] for key in told))
        return steps, started, frozen

    def _encode(self, batch: dict[str, Tensor], steps: list[int], rows: list[int]) -> Tensor:
        """Tokens (n, P, D) of the present frames of some rows; a frame of an earlier step is refused."""
        if OBS_PICTURE in batch:
            for row in rows:
                require_fresh(steps[row], round(float(batch[OBS_PICTURE][row])))
        return self.perception(batch[self.perception.remembers][rows])

    def plan(self, batch: dict[str, Tensor], rows: list[int], noise: Tensor, **kwargs: Any) -> Tensor:
        """Actions (n, chunk, A) for some rows of the batch, with their histories and sampling noise."""
        keys = [*self.config.image_features, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK]
        part = {key: batch[key][rows] for key in keys if key in batch}
        images, image_masks = self._preprocess_images(part)
        words = part[OBS_LANGUAGE_TOKENS], part[OBS_LANGUAGE_ATTENTION_MASK]
        with self._acting():
            if self._remembers:
                self.model.set_memory(*self.history.gather(rows).to(self._device))
            noise = noise.to(self._device)
            actions = self.model.sample_actions(images, image_masks, *words, noise=noise, **kwargs)
        return actions[:, :, : self._action_dim]

    @contextlib.contextmanager
    def _acting(self) -> Iterator[None]:
        """Act as the checkpoint of this moment would: by the average, in the precision that it is loaded in."""
        wide = self.precision.narrowed()
        average = contextlib.nullcontext() if self.average is None else self.average.applied(wide)
        with average, self.precision.computing(self._device):
            yield

    def _noise(self, rows: list[int], steps: list[int]) -> Tensor:
        return self.noise.draw(rows, steps, (self.config.chunk_size, self.config.max_action_dim))

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Take in one observation per row and plan for all rows: (B, chunk, A), normalised.

        Call it at every control step, or pass ``observation.step``, for the history to be complete. ``noise``
        (B, chunk, max_action_dim) replaces the episodes' own; other keywords are LeRobot's real-time chunking ones.
        """
        self.eval()
        steps, _, _ = self.observe(batch)
        rows = list(range(len(steps)))
        noise = kwargs.pop("noise", None)
        return self.plan(batch, rows, self._noise(rows, steps) if noise is None else noise, **kwargs)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Next action of every row (B, A), normalised.

        Every row keeps its own plan of ``n_action_steps``: it is made when the row's execution begins or its last plan
        is used up, from that row alone, so rows of a batch are independent. In the prompt phase, where actions have no
        effect, and for frozen rows nothing is planned.
        """
        self.thread.check()
        self.eval()
        steps, started, frozen = self.observe(batch)
        count = len(steps)
        self.plans.resize(count)
        prompt = [False] * count
        if OBS_PHASE in batch:
            prompt = (batch[OBS_PHASE].reshape(count, -1)[:, 0] < 0.5).tolist()
        for row in range(count):
            if started[row] or prompt[row]:
                self.plans.drop(row)
        acting = self._acting_rows = [row for row in range(count) if not prompt[row] and not frozen[row]]
        wanting = self.plans.wanting(acting)
        if wanting:
            plans = self.plan(batch, wanting, self._noise(wanting, steps))
            for row, plan in zip(wanting, plans[:, : self.config.n_action_steps].float().cpu(), strict=True):
                self.plans.queues[row].extend(plan)
        return self.plans.step(acting).to(self._device)
