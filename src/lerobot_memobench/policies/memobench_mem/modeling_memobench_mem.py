"""``memobench_mem``: LeRobot's pi0.5 with a visual memory, trained with or without aligning it to checkpoint text."""

from __future__ import annotations

import hashlib
import logging
import re
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_memobench.datasets.memory_cache import MemoryCache, build_memory_cache, read_meta
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import make_alignment, retrieval_accuracy
from lerobot_memobench.policies.memobench_mem.backbone import MemoryPI05
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.ema import WeightAverage
from lerobot_memobench.policies.memobench_mem.memory import RolloutMemory
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import (
    MASK,
    PHASE,
    STEPS,
    TEXT,
    TEXT_MASK,
    TOKENS,
    set_training_cache,
)
from lerobot_memobench.policies.memobench_mem.text import make_text_encoder
from lerobot_memobench.policies.memobench_mem.weights import (
    MODEL_FILE,
    TRAINING_FILE,
    checkpoint_file,
    load_exactly,
    require_statistics,
)

logger = logging.getLogger(__name__)

OBS_STEP, OBS_PHASE = "observation.step", "observation.phase"


class MemobenchMemPolicy(PI05Policy):
    """pi0.5 plus memory. ``forward`` trains, ``select_action`` acts; both see the same history for the same frame."""

    config_class = MemobenchMemConfig
    name = "memobench_mem"
    config: MemobenchMemConfig

    def __init__(
        self, config: MemobenchMemConfig, *, dataset_meta: Any | None = None, load_base: bool = True, **kwargs: Any
    ) -> None:
        """Build the policy from scratch, or from ``config.base_weights``.

        Args:
            dataset_meta: metadata of the dataset to train on; its memory cache is checked, and made when missing.
            load_base: whether to read ``config.base_weights`` (not when a checkpoint follows).
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
        if config.base_weights and load_base:
            self._load_base_weights(config.base_weights)
        if config.gradient_checkpointing:
            self.model.gradient_checkpointing_enable()
        self.to(config.device)
        self._frames = self.model.paligemma_with_expert.frame_encoder(config.image_size)
        self._history = RolloutMemory(config.memory_frames, config.memory_stride)
        self._average: WeightAverage | None = None
        self.reset()
        if dataset_meta is not None:
            self._attach_dataset(Path(dataset_meta.root))

    # -- checkpoints -----------------------------------------------------------------------------------------------

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
        if config is None:
            config = PreTrainedConfig.from_pretrained(source, revision=revision)
        if not isinstance(config, MemobenchMemConfig):
            raise MemobenchError(
                f"'{source}' is a '{config.type}' checkpoint and not memobench_mem; to start from pi0.5's weights "
                "pass --policy.type=memobench_mem --policy.base_weights=<checkpoint>."
            )
        path = checkpoint_file(source, MODEL_FILE, revision)
        if path is None:
            raise MemobenchError(f"The checkpoint '{source}' has no {MODEL_FILE}; give a pretrained_model folder.")
        if dataset_meta is None:
            require_statistics(source, revision)
        policy = cls(config, load_base=False)
        weights = load_file(path)
        if config.integration != "none" and not any(name.startswith("model.memory.") for name in weights):
            raise MemobenchError(
                f"'{source}' holds weights without a memory; to start from pi0.5's weights pass "
                "--policy.base_weights=<checkpoint> instead of a pretrained path."
            )
        # A run may change the objective of the one it goes on from; its heads then start anew.
        heads = {name for name in policy.state_dict() if name.startswith("alignment.")}
        load_exactly(policy, weights, source, optional=heads)
        policy.to(config.device)
        policy.eval()
        if dataset_meta is not None:
            policy._restore_average(source, revision)
            policy._attach_dataset(Path(dataset_meta.root))
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Save the averaged weights as the model, and the trained ones beside it for going on."""
        if self._average is None or state_dict is not None:
            if self._average is not None:
                logger.warning("Sharded training: the checkpoint holds the trained weights, not their average.")
            super()._save_pretrained(save_directory, state_dict=state_dict)
            return
        with self._average.applied():
            super()._save_pretrained(save_directory)
        tensors, metadata = self._average.state()
        save_file(tensors, save_directory / TRAINING_FILE, metadata=metadata)

    def _restore_average(self, source: str | Path, revision: str | None) -> None:
        path = checkpoint_file(source, TRAINING_FILE, revision)
        if path is None or self.config.ema_decay == 0:
            return
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
        tensors = load_file(path)
        average = WeightAverage(self._trained(), self.config.ema_decay)
        if all(f"weights.{name}" in tensors for name in average.parameters):
            average.restore(tensors, metadata)
            self._average = average

    def _load_base_weights(self, source: str) -> None:
        """Start from a pi0.5 checkpoint; only the memory's own parameters stay at their initial values."""
        path = checkpoint_file(source, MODEL_FILE)
        if path is None:
            raise MemobenchError(f"--policy.base_weights='{source}' has no {MODEL_FILE}; give a pi0.5 checkpoint.")
        weights = self._fix_pytorch_state_dict_keys(load_file(path), self.config)
        renamed = {}
        for name, tensor in weights.items():
            name = name.removeprefix("model.")
            if self.config.integration == "modulation" and ".gemma_expert." in name:
                name = re.sub(r"post_attention_layernorm\.(dense|weight)", r"post_attention_layernorm.norm.\1", name)
            renamed[name] = tensor
        load_exactly(self.model, renamed, source, optional=set(self.model.memory_parameters()))

    def _trained(self) -> dict[str, nn.Parameter]:
        return {name: parameter for name, parameter in self.named_parameters() if parameter.requires_grad}

    def get_optim_params(self) -> list[nn.Parameter]:
        """Parameters that learn: all but the image tower and what pi0.5 never uses."""
        return list(self._trained().values())

    def update(self) -> None:
        """Called by lerobot-train after each optimiser step: move the average of the weights."""
        if self._average is not None:
            self._average.update()

    # -- training --------------------------------------------------------------------------------------------------

    def _attach_dataset(self, root: Path) -> None:
        """Open the dataset's memory cache for the preprocessor; make it when there is none.

        Raises:
            MemobenchError: the cache there is stale or foreign.
        """
        config = self.config
        assert config.text_encoder is not None  # set by the configuration
        texts = make_text_encoder(config.text_encoder, config.dimensions.text_dim, str(config.device))
        if read_meta(root, config.cache_name) is None:
            logger.info("No memory cache beside %s yet: encoding its frames once.", root)
            build_memory_cache(
                root,
                config.cache_name,
                self._frames,
                texts,
                camera=config.memory_camera,
                stride=config.memory_stride,
                progress=lambda done, count: logger.info("memory cache: %d of %d episodes", done, count),
            )
        cache = MemoryCache.open(
            root,
            config.cache_name,
            frames_key=self._frames.key,
            camera=config.memory_camera,
            stride=config.memory_stride,
            texts_key=None if config.align == "none" else texts.key,
        )
        set_training_cache(cache)

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
        needed = PHASE if self.config.integration == "none" else TOKENS
        if needed not in batch:
            raise MemobenchError(
                f"The training batch has no '{needed}': the preprocessor lacks the step memobench_gather_memory; to "
                "start from pi0.5's weights pass --policy.base_weights instead of --policy.pretrained_path."
            )
        if self.config.ema_decay > 0 and self._average is None and self.training:
            self._average = WeightAverage(self._trained(), self.config.ema_decay)
        device = next(self.parameters()).device
        if self.config.integration != "none":
            memory, memory_mask = self.model.set_memory(
                batch[TOKENS].to(device), batch[STEPS].to(device), batch[MASK].to(device)
            )
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
        )
        losses = losses[:, :, : self._action_dim]
        weights = self._sample_weights(batch, losses)
        per_sample = losses.mean(dim=(1, 2)) * weights
        action_loss = per_sample.sum() / weights.sum().clamp(min=1.0)
        per_dim = (losses.mean(dim=1) * weights[:, None]).sum(dim=0) / weights.sum().clamp(min=1.0)
        logged: dict[str, Any] = {
            "action_loss": action_loss.item(),
            "loss_per_dim": per_dim.detach().cpu().tolist(),
        }
        total = action_loss
        if self.alignment is not None:
            weighted = self._alignment_loss(batch, memory, memory_mask, logged)
            total = action_loss + weighted
            per_sample = per_sample + weighted
        logged["loss"] = total.item()
        return (per_sample, logged) if reduction == "none" else (total, logged)

    @property
    def _action_dim(self) -> int:
        assert self.config.output_features is not None
        return self.config.output_features[ACTION].shape[0]

    def _sample_weights(self, batch: dict[str, Tensor], losses: Tensor) -> Tensor:
        """(B,) 1 for samples whose actions count: those of the execution phase."""
        if self.config.prompt_loss or PHASE not in batch:
            return torch.ones(len(losses), device=losses.device)
        return (batch[PHASE].reshape(-1) != 0).to(losses)

    def _alignment_loss(self, batch: dict[str, Tensor], memory: Tensor, mask: Tensor, logged: dict[str, Any]) -> Tensor:
        """Weighted alignment loss (scalar); fills ``logged``."""
        assert self.alignment is not None
        assert self.config.align_weight is not None
        memory = memory.to(torch.float32)  # means over hundreds of tokens and cosines, under mixed precision too
        text, text_mask = batch[TEXT].to(memory), batch[TEXT_MASK].to(memory.device)
        if self.config.align == "framewise":
            arguments: tuple[Tensor, ...] = (memory, mask, text, text_mask)
        else:
            # Samples of an episode without any text have nothing to align to.
            arguments = (memory[text_mask], mask[text_mask], text[text_mask])
        if not bool(text_mask.any()):
            # Still touch every parameter, so that distributed training sees the same graph on all ranks.
            return 0.0 * sum(parameter.sum() for parameter in self.alignment.parameters())
        with torch.autocast(memory.device.type, enabled=False):
            loss = self.alignment(*arguments)
        weighted = self.config.align_weight * loss
        logged["align_loss"] = loss.item()
        if memory.requires_grad and torch.is_grad_enabled():
            # Two matrix products: cheap, and comparable with the gradient norm that LeRobot logs.
            gradients = torch.autograd.grad(weighted, list(self.model.memory.parameters()), retain_graph=True)
            logged["align_grad_norm"] = torch.stack([gradient.norm() for gradient in gradients]).norm().item()
        with torch.no_grad():
            logged["align_top1"] = retrieval_accuracy(*self.alignment.pairs(*arguments))
        if hasattr(self.alignment, "log_temperature"):
            logged["align_temperature"] = self.alignment.log_temperature.exp().item()
        return weighted

    # -- rollout ---------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget histories and planned actions. LeRobot calls it once per batch of episodes."""
        super().reset()
        if hasattr(self, "_history"):
            self._history.reset()
        self._queues_by_row: list[deque[Tensor]] = []
        self._last_actions: list[Tensor] = []
        self._noise_seeds: list[int] = []
        self._calls = 0

    def _observe(self, batch: dict[str, Tensor]) -> tuple[list[int], list[bool], list[bool]]:
        """Take the current frames of all rows into their histories; returns steps, new episodes and frozen rows."""
        if self.config.memory_camera not in batch:
            cameras = ", ".join(key for key in batch if key.startswith("observation.images.")) or "none"
            raise MemobenchError(
                f"The observation has no '{self.config.memory_camera}', which this policy remembers; it has {cameras}. "
                "Map its names with --rename_map."
            )
        camera = batch[self.config.memory_camera]
        if OBS_STEP in batch:
            steps = [round(step) for step in batch[OBS_STEP].reshape(len(camera), -1)[:, 0].tolist()]
        else:
            steps = [self._calls] * len(camera)  # an environment without a clock: one call is one step
        self._calls += 1
        encode = None if self.config.integration == "none" else lambda rows: self._frames(camera[rows])
        started, frozen = self._history.observe(steps, encode)
        if len(self._noise_seeds) != len(camera):
            self._noise_seeds = [0] * len(camera)
        for row in np.flatnonzero(started):
            self._noise_seeds[row] = self._episode_seed(batch, int(row))
        return steps, started, frozen

    def _episode_seed(self, batch: dict[str, Tensor], row: int) -> int:
        """Seed of one episode's sampling noise, from its first observation and the process's seed.

        Noise drawn from a common generator would make a row's actions depend on how many rows run beside it.
        """
        digest = hashlib.blake2b(str(torch.initial_seed()).encode(), digest_size=7)
        for key in (self.config.memory_camera, OBS_STATE, OBS_LANGUAGE_TOKENS):
            if key in batch:
                digest.update(batch[key][row].detach().to("cpu").contiguous().numpy().tobytes())
        return int.from_bytes(digest.digest(), "big")

    def _noise(self, rows: list[int], steps: list[int]) -> Tensor:
        """Sampling noise (n, chunk, max_action_dim) of some rows, each from its own episode's seed and step."""
        shape = (self.config.chunk_size, self.config.max_action_dim)
        drawn = [
            torch.randn(shape, generator=torch.Generator().manual_seed(self._noise_seeds[row] + steps[row]))
            for row in rows
        ]
        return torch.stack(drawn).to(next(self.parameters()).device)

    def _plan(self, batch: dict[str, Tensor], rows: list[int], noise: Tensor, **kwargs: Any) -> Tensor:
        """Actions (n, chunk, A) for some rows of the batch, with their histories."""
        keys = [*self.config.image_features, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK]
        part = {key: batch[key][rows] for key in keys if key in batch}
        device = next(self.parameters()).device
        memory = None if self.config.integration == "none" else self._history.gather(rows)
        images, image_masks = self._preprocess_images(part)

        def sample() -> Tensor:
            if memory is not None:
                self.model.set_memory(*(tensor.to(device) for tensor in memory))
            return self.model.sample_actions(
                images,
                image_masks,
                part[OBS_LANGUAGE_TOKENS],
                part[OBS_LANGUAGE_ATTENTION_MASK],
                noise=noise,
                **kwargs,
            )

        if self._average is None:
            actions = sample()
        else:  # evaluation during training
            with self._average.applied():
                actions = sample()
        return actions[:, :, : self._action_dim]

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Take in one observation per row and plan for all rows: (B, chunk, A), normalised.

        Call it at every control step, or pass ``observation.step``, for the history to be complete. ``noise``
        (B, chunk, max_action_dim) replaces the episodes' own; other keywords are LeRobot's real-time chunking ones.
        """
        self.eval()
        steps, _, _ = self._observe(batch)
        rows = list(range(len(steps)))
        noise = kwargs.pop("noise", None)
        return self._plan(batch, rows, self._noise(rows, steps) if noise is None else noise, **kwargs)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Next action of every row (B, A), normalised.

        Every row keeps its own plan of ``n_action_steps``: it is made when the row's execution begins or its last plan
        is used up, from that row alone, so rows of a batch are independent. In the prompt phase, where actions have no
        effect, and for frozen rows nothing is planned.
        """
        self.eval()
        steps, started, frozen = self._observe(batch)
        count = len(steps)
        if len(self._queues_by_row) != count:
            self._queues_by_row = [deque() for _ in range(count)]
            self._last_actions = [torch.zeros(self._action_dim) for _ in range(count)]
        prompt = [False] * count
        if OBS_PHASE in batch:
            prompt = (batch[OBS_PHASE].reshape(count, -1)[:, 0] < 0.5).tolist()
        for row in range(count):
            if started[row] or prompt[row]:
                self._queues_by_row[row].clear()
                self._last_actions[row] = torch.zeros(self._action_dim)
        acting = [row for row in range(count) if not prompt[row] and not frozen[row]]
        wanting = [row for row in acting if not self._queues_by_row[row]]
        if wanting:
            plans = self._plan(batch, wanting, self._noise(wanting, steps))
            for row, plan in zip(wanting, plans[:, : self.config.n_action_steps].float().cpu(), strict=True):
                self._queues_by_row[row].extend(plan)
        for row in acting:
            self._last_actions[row] = self._queues_by_row[row].popleft()
        return torch.stack(self._last_actions).to(next(self.parameters()).device)
