"""The policy as it trains: its actions, and the alignment of its memory to checkpoint text."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor, nn

from lerobot_memobench.computing.bfloat16 import quick_gradients, quick_products
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.action_loss import counted_actions, mean_losses
from lerobot_memobench.policies.memobench_mem.action_objective import losses_of, noise_and_time
from lerobot_memobench.policies.memobench_mem.alignment.loss import alignment_loss
from lerobot_memobench.policies.memobench_mem.alignment.objectives import Alignment
from lerobot_memobench.policies.memobench_mem.averaging import WeightAverage
from lerobot_memobench.policies.memobench_mem.memory.batch import FRAMES, MASK, PHASE, STEPS, TOKENS, MemoryBatch
from lerobot_memobench.policies.memobench_mem.ranks import means_over_ranks
from lerobot_memobench.policies.memobench_mem.seeing import SeeingPolicy
from lerobot_memobench.policies.memobench_mem.training_curve import TrainingCurve


class LearningPolicy(SeeingPolicy):
    """``forward`` and what lerobot-train asks of a policy besides.

    Attributes:
        alignment: what ties memory to text; None without one.
        curve: how its losses fell.
    """

    alignment: Alignment | None
    curve: TrainingCurve

    @property
    def _averages(self) -> bool:
        """Whether weights are averaged: not those of adapters, of which peft writes a checkpoint's file."""
        return bool(self.config.ema_decay) and not self.config.use_peft

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
        """Loss of the actions (`action_objective`) plus weighted alignment on a preprocessed training batch.

        A loss that is only measured (lerobot-train's ``eval_loss``: not training, no gradients) is that of the averaged
        weights, which a checkpoint holds and rollouts act by.

        Args:
            batch: what LeRobot's pi0.5 needs, and ``memory.*`` and ``phase`` as the preprocessor adds them.
            reduction: ``mean`` for a scalar, ``none`` for one loss per sample (B,).

        Returns:
            The loss, and numbers to log: ``action_loss``, and with an alignment ``align_loss`` (unweighted),
            ``align_grad_norm`` (of the weighted loss, over the memory encoder's parameters) and ``align_top1`` (share
            of memory vectors whose nearest text in the batch is theirs).

        Raises:
            MemobenchError: the batch has no memory, or pictures in the place of what eyes saw in them.
        """
        self._require_memory(batch)
        if self._averages and self.average is None and self.training:
            self.average = self._new_average()
        measures = not self.training and not torch.is_grad_enabled()
        quick = self.training and self._device.type == "cpu" and not self.config.sees_tokens
        computing = self._acting() if measures else self.precision.computing(self._device)
        with computing, quick_products() if quick else nullcontext():
            memory = self._read_memory(batch)
            per_sample, total, logged = self._action_loss(batch)
            if self.alignment is not None and memory is not None:
                assert self.config.align_weight is not None
                encoder = [parameter for parameter in self.model.memory.parameters() if parameter.requires_grad]
                weighted, numbers = alignment_loss(self.alignment, self.config.align_weight, batch, *memory, encoder)
                per_sample, total, logged = per_sample + weighted, total + weighted, logged | numbers
        logged["loss"] = total.item()
        if self.training:
            self.curve.note(means_over_ranks(logged, self._device))
        else:
            self.curve.note_held_out(logged)
        loss = per_sample if reduction == "none" else total
        if quick:
            quick_gradients(loss)
        return loss, logged

    def _require_memory(self, batch: dict[str, Tensor]) -> None:
        needed = TOKENS if self._remembers else PHASE
        if needed not in batch:
            raise MemobenchError(
                f"The training batch has no '{needed}': the preprocessor lacks the step memobench_gather_memory; to "
                "start from pi0.5's weights pass --policy.base_weights instead of --policy.pretrained_path."
            )
        if self.config.has_eyes and self.training and any(key in batch for key in self.config.image_features):
            raise MemobenchError(
                "The training batch has pictures, which a policy with eyes does not look at (it reads what was once "
                "seen in them), because a stream or loader processes made it, or because another policy is trained on "
                "the same dataset object: pass --num_workers=0, which is quicker too, leave dataset.streaming out, and "
                "open the dataset once for each policy."
            )

    def _read_memory(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor] | None:
        """Hand a batch's memory to the model; return its tokens (B, L, d_m) and their mask (B, L)."""
        if not self._remembers:
            return None
        memory = MemoryBatch(batch[TOKENS], batch[STEPS], batch[MASK]).to(self._device)
        numbers = batch.get(FRAMES)
        return self.model.set_memory(*memory, numbers=None if numbers is None else numbers.to(self._device))

    def _action_loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Loss of the actions per sample (B,), its mean over the actions that count, and numbers to log."""
        images, image_masks = self._preprocess_images(batch)
        actions = self.prepare_action(batch)
        words = batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]
        drawn = noise_and_time(self.config.objective, self.model, actions)
        squared = self.model.forward(images, image_masks, *words, actions, *drawn)[:, :, : self._action_dim]
        losses = losses_of(self.config.objective, squared)
        found = mean_losses(losses, counted_actions(batch, losses))
        logged = {"action_loss": found.mean.item(), "loss_per_dim": found.per_dim.cpu().tolist()}
        return found.per_sample, found.mean, logged
