"""The policy as it acts: histories, noise and plans of the rows of a vector environment, each by its own clock."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.freshness import PICTURE_STEP, require_fresh
from lerobot_memobench.policies.memobench_mem.action_objective import REGRESSION
from lerobot_memobench.policies.memobench_mem.noise import EpisodeNoise
from lerobot_memobench.policies.memobench_mem.one_thread import OneThread
from lerobot_memobench.policies.memobench_mem.perception.objects import OBS_PHASE, OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.plans import RowPlans
from lerobot_memobench.policies.memobench_mem.seeing import SeeingPolicy
from lerobot_memobench.policies.shown import cure
from lerobot_memobench.protocol import EXECUTION, PROMPT

OBS_STEP, OBS_PICTURE = "observation.step", f"observation.{PICTURE_STEP}"


class ActingPolicy(SeeingPolicy):
    """``select_action``: rows of a vector environment are independent of one another.

    Attributes:
        plans: what the rows are about to do. noise: that their plans are sampled from.
        thread: the one that acts.
    """

    plans: RowPlans
    noise: EpisodeNoise
    thread: OneThread

    def reset(self) -> None:
        """Forget histories and planned actions. LeRobot calls it once per batch of episodes."""
        super().reset()
        for part in (self.history, self.plans, self.noise):
            part.reset()
        self._calls = self._planned = 0
        self.thread.begin()
        self._acting_rows: list[int] = []

    def looks_next(self) -> bool:
        """Whether pictures or objects of the next observation are read: it is remembered, or a plan is made from it.

        Asked after an action. Whether the next frame is the first of an execution, where plans begin, only the
        environment knows: that one is to be shown in any case, as the first of an episode.
        """
        return self.history.writes_next() or bool(self.plans.wanting(self._acting_rows))

    def observe(self, batch: dict[str, Tensor]) -> tuple[list[int], list[bool], list[bool]]:
        """Take the current frames of all rows into their histories.

        Returns:
            Per row its control step since the episode began, whether a new episode began, and whether it is frozen.
        """
        seen = self.perception.remembers
        if seen not in batch:
            what = f"'{seen}'" if seen else "picture"
            raise MemobenchError(f"The observation has no {what}, which this policy remembers; {cure(seen, batch)}")
        count = len(batch[seen])
        steps = _column(batch, OBS_STEP) or [self._calls] * count  # without a clock one call is one step
        phases = _column(batch, OBS_PHASE) if OBS_STEP in batch else None
        clocks = list(zip(phases or [EXECUTION] * count, steps, strict=True))
        self._calls += 1
        steps, started, frozen = self.history.observe(clocks, lambda rows: self._encode(batch, clocks, rows))
        self.noise.resize(count)
        for row in range(count):
            if started[row]:
                told = (key for key in (seen, OBS_STATE, OBS_LANGUAGE_TOKENS) if key in batch)
                self.noise.begin(row, (batch[key][row] for key in told))
        return steps, started, frozen

    def _encode(self, batch: dict[str, Tensor], clocks: list[tuple[int, int]], rows: list[int]) -> Tensor:
        """Tokens (n, P, D) of the present frames of some rows; a frame of an earlier step is refused."""
        if OBS_PICTURE in batch and self.perception.pictures:
            for row in rows:
                require_fresh(clocks[row][1], round(float(batch[OBS_PICTURE][row])))
        return self.perception.remember(batch, rows)

    def plan(self, batch: dict[str, Tensor], rows: list[int], noise: Tensor, **kwargs: Any) -> Tensor:
        """Actions (n, chunk, A) for some rows of the batch, with their histories and sampling noise."""
        part = {key: batch[key][rows] for key in self._seen if key in batch}
        images, image_masks = self._preprocess_images(part)
        words = part[OBS_LANGUAGE_TOKENS], part[OBS_LANGUAGE_ATTENTION_MASK]
        with self._acting():
            if self._remembers:
                self._require_history(rows)
                self.model.set_memory(*self.history.gather(rows).to(self._device))
            noise = noise.to(self._device)
            actions = self.model.sample_actions(images, image_masks, *words, noise=noise, **kwargs)
        return actions[:, :, : self._action_dim]

    def _require_history(self, rows: list[int]) -> None:
        missed = self.history.missed(rows)
        if missed is not None:
            raise MemobenchError(
                f"This policy remembers every {self.history.stride} control steps, and was not shown step {missed} of "
                "this episode: its memory would be another one than in training; offer it the observation of every "
                "control step, by select_action or by observe."
            )

    def _noise(self, rows: list[int], steps: list[int]) -> Tensor:
        shape = self.config.chunk_size, self.config.max_action_dim
        if self.config.objective == REGRESSION:
            return torch.zeros(len(rows), *shape)
        return self.noise.draw(rows, steps, shape)

    def supports_rtc(self) -> bool:
        """Whether LeRobot's real-time chunking may ask this policy for its plans.

        It guides the denoising of a plan, which regression lacks, and offers one observation per plan, of which no
        history can be made.
        """
        denoises = self.config.objective != REGRESSION
        return bool(super().supports_rtc()) and denoises and not self._remembers

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Take in one observation per row and plan for all rows: (B, chunk, A), normalised.

        A policy that remembers must be offered the observation of every control step by `observe`, this one included,
        unless it tells its step (``observation.step``); or let `select_action` see to it. ``noise``
        (B, chunk, max_action_dim) replaces the episodes' own; other keywords are LeRobot's real-time chunking ones.

        Raises:
            MemobenchError: observations were left out between two plans; or real-time chunking, by regression.
        """
        self.eval()
        if self._rtc_enabled() and self.config.objective == REGRESSION:
            raise MemobenchError(
                "Real-time chunking guides the denoising of a plan, which a policy of objective=regression lacks: its "
                "plans would not continue the last one; use --inference.type=sync, or train with "
                "--policy.objective=flow_matching."
            )
        steps = self._offered(batch)
        rows = list(range(len(steps)))
        noise = kwargs.pop("noise", None)
        return self.plan(batch, rows, self._noise(rows, steps) if noise is None else noise, **kwargs)

    def _offered(self, batch: dict[str, Tensor]) -> list[int]:
        """Take in the observation of a plan, unless it was offered before; return each row's control step."""
        if OBS_STEP in batch or not self._remembers or not self._calls:
            steps, _, _ = self.observe(batch)
        elif self._calls > self._planned:
            steps = [row.position for row in self.history.rows]
        else:
            raise MemobenchError(
                "This policy remembers what it saw at every control step, and was asked for two plans with no "
                "observation between them: its memory would be another one than in training; let select_action see "
                "every observation (--inference.type=sync), offer each to observe before planning, or train with "
                "--policy.integration=none."
            )
        self._planned = self._calls
        return steps

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Next action of every row (B, A), normalised.

        Every row keeps its own plan of ``n_action_steps``, or a whole one (``whole_plan_if_still``), from that row
        alone, so rows of a batch are independent. It is made when the row's execution begins or its last plan is used
        up. In the prompt phase, where actions have no effect, and for frozen rows nothing is planned.
        """
        self.thread.check()
        if self.training:  # a millisecond, if it were said at every step
            self.eval()
        steps, started, frozen = self.observe(batch)
        count = len(steps)
        self.plans.resize(count)
        prompt = [phase == PROMPT for phase in _column(batch, OBS_PHASE) or [EXECUTION] * count]
        for row in range(count):
            if started[row] or prompt[row]:
                self.plans.drop(row)
        acting = self._acting_rows = [row for row in range(count) if not prompt[row] and not frozen[row]]
        wanting = self.plans.wanting(acting)
        if wanting:
            plans = self.plan(batch, wanting, self._noise(wanting, steps))
            states = batch[OBS_RAW_STATE] if self.config.whole_plan_if_still else None
            for row, plan in zip(wanting, plans.float().cpu(), strict=True):
                self.plans.begin(row, plan, self.config.n_action_steps, None if states is None else states[row])
        return self.plans.step(acting).to(self._device)


def _column(batch: dict[str, Tensor], key: str) -> list[int] | None:
    """Return a whole number per row, None where a batch does not have it."""
    if key not in batch:
        return None
    return [round(value) for value in batch[key].reshape(len(batch[key]), -1)[:, 0].tolist()]
