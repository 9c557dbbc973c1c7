"""``memobench_mem``: pi0.5 with a memory, trained with or without alignment to subgoal texts."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.policies.common.vla_utils import pad_vector
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn
from transformers.initialization import no_init_weights

from lerobot_memobench.constants import EXECUTION, OBS_PHASE, OBS_STEP, PROMPT
from lerobot_memobench.envs.settings import DELETE, NOISE, SWAP
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import load_visual_encoder
from lerobot_memobench.policies.checkpoint import (
    as_trained,
    check_as_trained,
    check_processor_statistics,
)
from lerobot_memobench.policies.compatibility import hint
from lerobot_memobench.policies.memobench_mem.checkpoints import (
    has_another_memory,
    learned_from_answer,
    load_base_weights,
    load_weights,
    read_config,
    read_tensors,
    require_agreement,
    weights_file,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    ALIGN_WEIGHTS,
    SUPERVISED,
    MemobenchMemConfig,
)
from lerobot_memobench.policies.memobench_mem.encoders import ENCODED, ObservationEncoder, VisualTokenEncoder
from lerobot_memobench.policies.memobench_mem.losses import (
    alignment_loss,
    counted_actions,
    losses_of,
    make_alignment,
    mean_losses,
    noise_and_time,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    AHEAD,
    CHOICES,
    EXACT,
    FRAMES,
    PHASE,
    PLACES,
    STEPS,
    SUBGOAL,
    SUBGOALS,
    Histories,
    MemoryTokens,
    Query,
)
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation, Precision
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.rollout import EnvMemory, Rollout
from lerobot_memobench.policies.memobench_mem.sizes import REGRESSION
from lerobot_memobench.policies.memory_reads import Chunk, chunk_reads

# Importing the processor registers the steps of saved pipelines, which are built after the policy.
from lerobot_memobench.policies.memobench_mem import processor_memobench_mem  # noqa: F401  # isort: skip

logger = logging.getLogger(__name__)

LANGUAGE = (OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK)
AT_ONCE = 32
"""Frames that are kept, at most, until they are encoded in one batch."""
OWN_MODULES = (
    *("model.memory", "model.memory_to_expert", "alignment", "model.foresight", "model.subgoal"),
    *("model.state_token", "model.instruction", "paligemma_with_expert.perception"),
)
"""Suffixes of the names of modules that plain pi0.5 does not have; with adapters (``--peft…``), all their weights are
trained."""


class MemobenchMemPolicy(PreTrainedPolicy):
    """pi0.5 with a memory. ``forward`` and ``select_action`` read the same history at the same frame."""

    config_class = MemobenchMemConfig
    name = "memobench_mem"
    config: MemobenchMemConfig
    model: MemoryPI05

    def __init__(
        self,
        config: MemobenchMemConfig,
        *,
        dataset_meta: Any | None = None,
        load_base: bool = True,
        draw: bool = True,
        **kwargs: Any,
    ) -> None:
        """Build the policy from scratch, or from ``config.base_weights``; without ``dataset_meta`` it only acts.

        ``load_base=False`` if a checkpoint's weights are loaded afterwards; then ``draw=False`` skips initial weights,
        which take two minutes at full size.
        """
        super().__init__(config)
        config.validate_features()
        with contextlib.nullcontext() if draw else no_init_weights():
            self.model = MemoryPI05(config)
        dims = config.dimensions
        self.alignment = make_alignment(config.align, dims.vlm.width, dims.text_dim, self.perception.tokens_per_frame)
        self.precision = Precision(list(self.parameters()))
        if dataset_meta is not None:
            self.precision.settle()  # before loading weights, which may be float32
        if config.base_weights and load_base:
            load_base_weights(self.model, read_tensors(weights_file(config.base_weights)), config.base_weights)
            config.supervised_with_answer |= learned_from_answer(config.base_weights)
        elif isinstance(self.perception, VisualTokenEncoder) and load_base:
            assert config.visual_encoder is not None
            self.perception.tower.load_state_dict(load_visual_encoder(config.visual_encoder).state_dict())
        self.to(config.device)
        self._watched = False
        self.open_loop = False  # True if observations do not follow the actions, as in replayed episodes: no stalls
        self.reset()
        self._thread: int | None = None  # set by the first action

    @property
    def perception(self) -> ObservationEncoder:
        return self.model.paligemma_with_expert.perception

    @property
    def _action_dim(self) -> int:
        assert self.config.output_features is not None
        return self.config.output_features[ACTION].shape[0]

    @property
    def _device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def _remembers(self) -> bool:
        return self.model.memory is not None

    def _observed(self, batch: dict[str, Tensor]) -> Observation:
        parts, masks = self.perception.present(batch)
        if self.config.state_token:
            state = pad_vector(batch[OBS_STATE], self.config.max_state_dim)
            parts, masks = [*parts, state], [*masks, torch.ones(len(state), dtype=torch.bool)]
        parts, masks = ([tensor.to(self._device) for tensor in tensors] for tensors in (parts, masks))
        return Observation(parts, masks, *(batch[key] for key in LANGUAGE))

    # -- training --------------------------------------------------------------------------------------------------

    def trained_parameters(self) -> dict[str, nn.Parameter]:
        """Return the trainable parameters by their names in a checkpoint."""
        return {name: parameter for name, parameter in self.named_parameters() if parameter.requires_grad}

    def get_optim_params(self) -> list[nn.Parameter]:
        """Return the trainable parameters in float32: all except the image tower and pi0.5's unused weights."""
        self.precision.settle()
        return list(self.trained_parameters().values())

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Return the action loss, plus the memory's losses and the weighted alignment, and numbers to log.

        When the loss is only measured (``eval_loss``: evaluation mode without gradients), actions follow the subgoal
        that a privileged memory chooses, and the memory's own losses compare the choice with the true one.

        The numbers are ``action_loss``, the memory's losses, and with an alignment ``align_loss`` (unweighted),
        ``align_grad_norm`` (of the weighted loss, over the memory's parameters) and ``align_top1`` (share of memory
        vectors whose nearest text in the batch is their own). ``reduction="none"`` returns a loss per sample (B,).
        """
        batch = self.perception.observed(self._with_phase(batch))
        measures = not self.training and not torch.is_grad_enabled()
        with self.precision.computing(self._device):
            memory = self.read_memory(batch)
            if measures and self.config.privileged_memory:  # actions follow the memory's own choice
                memory = self.read_memory(_without_labels(batch))
            memory_pass = self.model.memory_pass(memory)
            actions = pad_vector(batch[ACTION], self.config.max_action_dim)
            drawn = noise_and_time(self.config.objective, actions)
            squared = self.model.forward(self._observed(batch), actions, *drawn, memory_pass)[..., : self._action_dim]
            losses = losses_of(self.config.objective, squared)
            loss = mean_losses(losses, counted_actions(batch, losses))
            per_sample, total = loss.per_sample, loss.mean
            logged: dict[str, Any] = {"action_loss": total.item(), "loss_per_dim": loss.per_dim.cpu().tolist()}
            own = {} if self.model.memory is None else self.model.memory.losses({**batch, **memory_pass.outputs})
            for name, of_memory in own.items():
                per_sample, total = per_sample + of_memory, total + of_memory.mean()
                logged[f"memory_{name}_loss"] = of_memory.mean().item()
            if self.alignment is not None and memory is not None:
                assert self.model.memory is not None
                encoder = [parameter for parameter in self.model.memory.parameters() if parameter.requires_grad]
                read = memory.rows(), memory.mask
                weighted, numbers = alignment_loss(
                    self.alignment, ALIGN_WEIGHTS[self.config.align], batch, *read, encoder
                )
                per_sample, total, logged = per_sample + weighted, total + weighted, logged | numbers
        logged["loss"] = total.item()
        return (per_sample if reduction == "none" else total), logged

    def _with_phase(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        if self._remembers and FRAMES not in batch:
            raise MemobenchError(
                f"the training batch has no '{FRAMES}': memory={self.config.memory} learns from earlier frames of the "
                "episode, which LeRobot's own trainer does not draw; train with `lerobot train policy=memobench_mem`, "
                "or with --policy.memory=none"
            )
        return {PHASE: batch[OBS_PHASE], **batch} if OBS_PHASE in batch else batch

    def read_memory(self, batch: dict[str, Tensor]) -> MemoryTokens | None:
        """Return the memory tokens of the samples of a batch; None without a memory."""
        if self.model.memory is None:
            return None
        parts = batch[FRAMES], batch[STEPS], batch[PLACES], batch.get(SUBGOALS), batch.get(AHEAD), batch.get(EXACT)
        histories = Histories(*parts).to(self._device)
        return self.model.memory.replay(histories, self._query(batch))

    def _query(self, batch: dict[str, Tensor], rows: Sequence[int] | None = None, *, writes: bool = False) -> Query:
        """Return the present of some rows of a batch (None: all), as far as the memory needs it to read or write."""
        memory, device = self.model.memory, self._device
        assert memory is not None
        rows = range(len(batch[OBS_STATE])) if rows is None else rows
        query, chosen = Query(), list(rows)
        if memory.asks_present and not writes:
            query = query._replace(tokens=memory.pooled(self.perception.remember(batch, chosen).to(device)))
        if memory.privileged:
            labels = batch[SUBGOAL][chosen].to(device) if SUBGOAL in batch else None
            query = query._replace(choices=batch[CHOICES][chosen].to(device), subgoal=labels)
        return query

    # -- acting ----------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Clear histories and planned actions. LeRobot calls it once per batch of episodes."""
        self.rollout = Rollout(self._remembers, self.config.memory_stride)
        self._calls = self._planned = 0
        self._thread = threading.get_ident()
        self._acting: list[EnvMemory] = []
        self._kept: list[tuple[list[tuple[EnvMemory, int]], dict[str, Tensor]]] = []  # see `_keep`

    def corrupt_memory(self, how: str, rows: Sequence[int]) -> None:
        """Change what environments (numbers in the batch) remember, before the next frame; planned actions are kept.

        ``delete``: they remember from the next frame on; ``swap``: they get the memory of the next one of the batch;
        ``noise``: normal noise with the standard deviation of its values is added to it.
        """
        memory, envs = self.model.memory, self.rollout.envs
        assert memory is not None  # `rollouts.plan` refuses others
        self.write_kept()

        def noised(row: int) -> Any:
            return memory.noised(envs[row].memory, torch.Generator().manual_seed(envs[row].seed))

        changed = {DELETE: lambda row: None, SWAP: self.rollout.next_env_memory, NOISE: noised}[how]
        self.rollout.corrupt(rows, changed)

    def drop_queued_actions(self) -> None:
        """Replan at the next step and keep the histories; LeRobot's main branch calls it for a new instruction."""
        for env in self.rollout.envs:
            env.drop_chunk()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action of every environment (B, A), normalised.

        An environment is replanned when its execution begins or its queue is empty. A chunk depends on its own
        environment only. No chunk is planned in the prompt phase, in which actions have no effect, and for frozen
        environments.
        """
        self._check_thread()
        if self.training:  # calling eval() at every step would take a millisecond
            self.eval()
        self.observe(batch)
        envs = self.rollout.envs
        phases = _column(batch, OBS_PHASE) or [EXECUTION] * len(envs)
        acting = [row for row, env in enumerate(envs) if phases[row] != PROMPT and not env.frozen]
        if due := [row for row in acting if not envs[row].queue]:
            chunks = self._plan_new(batch, due)
            states = batch[OBS_RAW_STATE] if self.config.uses_objects and not self.open_loop else None
            for row, chunk in zip(due, chunks, strict=True):
                envs[row].begin_chunk(chunk, self.config.n_action_steps, None if states is None else states[row])
        self._acting = [envs[row] for row in acting]
        for env in self._acting:
            env.last = env.queue.popleft()
        none = torch.zeros(self._action_dim)
        return torch.stack([none if env.last is None else env.last for env in envs]).to(self._device)

    def _plan_new(self, batch: dict[str, Tensor], rows: list[int]) -> list[Tensor]:
        """Return the chunks (chunk, A) of rows, on the CPU.

        Most plans of strict tasks are made in holds, from the inputs of the plan before: they are not computed again.
        """
        self.write_kept()
        envs, noise = [self.rollout.envs[row] for row in rows], self._noise(rows)
        inputs = [*zip(noise, *self._inputs(batch, rows).values(), strict=True)]
        new = [n for n, env in enumerate(envs) if not env.repeats(inputs[n])]
        for n, env in enumerate(envs):
            if self._watched and n not in new:
                env.reads.append({**env.reads[-1], "step": env.position})
        if new:
            chunks = self.plan(batch, [rows[n] for n in new], noise[new]).float().cpu()
            for n, chunk in zip(new, chunks, strict=True):
                envs[n].planned = envs[n].memory, [value.clone() for value in inputs[n]], chunk
        return [env.planned[-1] for env in envs if env.planned is not None]

    def _check_thread(self) -> None:
        # LeRobot's env.max_parallel_tasks would mix several rollouts.
        if self._thread is None:
            self._thread = threading.get_ident()
        if self._thread != threading.get_ident():
            raise MemobenchError(
                "two threads act with one memobench_mem policy, which would mix the memories of their rollouts; "
                "evaluate with --env.max_parallel_tasks=1, and more environments per task by --eval.batch_size."
            )

    def observe(self, batch: dict[str, Tensor]) -> None:
        """Add the present frames of all environments to their histories."""
        name = self.perception.memory_input
        if name not in batch:
            what = f"'{name}'" if name else "image"
            raise MemobenchError(f"the observation has no {what}, which this policy remembers; {hint(name, batch)}")
        steps = _column(batch, OBS_STEP)
        phases = None if steps is None else _column(batch, OBS_PHASE)
        steps = steps or [self._calls] * len(batch[name])
        self._calls += 1
        clocks = list(zip(phases or [EXECUTION] * len(steps), steps, strict=True))
        started = self.rollout.observe(clocks, lambda rows: self._keep(batch, rows))
        observed = [key for key in (name, OBS_STATE, OBS_LANGUAGE_TOKENS) if key in batch]
        for row, (env, begins) in enumerate(zip(self.rollout.envs, started, strict=True)):
            if begins:
                env.draw_seed(batch[key][row] for key in observed)

    def _inputs(self, batch: dict[str, Tensor], rows: list[int]) -> dict[str, Tensor]:
        """Return what memory and plans of some rows of a batch depend on."""
        names = {*self.config.image_features, OBS_ENV_STATE, OBS_RAW_STATE, OBS_STATE, OBS_PHASE, CHOICES, *LANGUAGE}
        return {key: value[rows] for key, value in batch.items() if key in names or key.startswith(ENCODED)}

    def _keep(self, batch: dict[str, Tensor], rows: list[int]) -> None:
        """Keep frames for `write_kept`, with the environments and control steps in which they are observed."""
        envs = [(self.rollout.envs[row], self.rollout.envs[row].position) for row in rows]
        self._kept.append((envs, self._inputs(batch, rows)))
        # On a GPU detections depend on the size of the batch, and repeated ones are recognised by their bits.
        if self.config.skips_repeated_frames or sum(len(envs) for envs, _ in self._kept) >= AT_ONCE:
            self.write_kept()

    @torch.no_grad()
    def write_kept(self) -> None:
        """Encode the observed frames in one batch, and write them to the memories; a plan does so before it reads."""
        memory, skips = self.model.memory, self.config.skips_repeated_frames
        kept, self._kept = self._kept, []
        if not kept or memory is None:
            return
        places = [place for envs, _ in kept for place in envs]
        batch = {key: torch.cat([inputs[key] for _, inputs in kept]) for key in kept[0][1] if key not in LANGUAGE}
        frames = self.perception.remember(batch, range(len(places))).to(self._device)
        with self.precision.computing(self._device):
            # One by one, so that rows are independent.
            for number, ((env, step), frame) in enumerate(zip(places, frames.split(1), strict=True)):
                if skips and env.memory is not None and env.stored is not None and torch.equal(frame, env.stored):
                    continue
                env.stored = frame
                query = self._query(batch, [number], writes=True)
                state = memory.init(1) if env.memory is None else env.memory
                env.memory = memory.observe(state, frame, torch.tensor([step], device=self._device), query)

    def remembered(self, batch: dict[str, Tensor], rows: Sequence[int]) -> MemoryTokens:
        """Return the memory tokens that chunks of some rows of the batch would read now."""
        memory = self.model.memory
        assert memory is not None
        self.write_kept()
        return memory.read(memory.join([self.rollout.envs[row].memory for row in rows]), self._query(batch, rows))

    def plan(self, batch: dict[str, Tensor], rows: list[int], noise: Tensor, training: bool = False) -> Tensor:
        """Return action chunks (n, chunk, A) of some rows of the batch, given their histories and sampling noise.

        A ``training`` batch has its own histories; its labels are not read.
        """
        seen, memory = self._observed(self._inputs(batch, rows)), None
        with self.precision.computing(self._device):
            if training:
                memory = self.read_memory(_without_labels(batch))
            elif self._remembers:
                self._require_history(rows)
                memory = self.remembered(batch, rows)
            watched = self._watched and memory is not None and not training
            memory_pass = self.model.memory_pass(memory, watched)
            actions = self.model.sample_actions(seen, noise.to(self._device), memory_pass)
            if watched and memory is not None:
                envs = [self.rollout.envs[row] for row in rows]
                reads = chunk_reads([env.position for env in envs], memory, memory_pass.attention_shares())
                for env, read in zip(envs, reads, strict=True):
                    env.reads.append(read)
        return actions[:, :, : self._action_dim]

    def watch_memory(self, watched: bool = True) -> None:
        """Start or stop recording how much each chunk reads of the remembered entries, for `memory_reads`."""
        self.config.check_memory_reads()
        self._watched = watched
        for env in self.rollout.envs:
            env.planned = None

    def memory_reads(self) -> list[list[Chunk]]:
        return [env.reads for env in self.rollout.envs]

    def _require_history(self, rows: list[int]) -> None:
        if (missed := self.rollout.missed(rows)) is not None:
            raise MemobenchError(
                f"this policy remembers every {self.rollout.stride} control steps and did not observe step {missed} of "
                "this episode, so its memory would differ from training; pass the observation of every control step to "
                "select_action or observe."
            )

    def _noise(self, rows: Sequence[int], training: bool = False) -> Tensor:
        """Return noise (n, chunk, max_action_dim) for plans; the episodes' own in a rollout, zeros by regression."""
        shape = self.config.chunk_size, self.config.max_action_dim
        if self.config.objective == REGRESSION:
            return torch.zeros(len(rows), *shape)
        return torch.stack([torch.randn(shape) if training else self.rollout.envs[row].noise(shape) for row in rows])

    def needs_observation(self) -> bool:
        """Return after an action whether the next observation's images or objects are read, for memory or a plan.

        The first frames of an episode and of its execution, which only the environment can foresee, are always read.
        """
        return self.rollout.writes_next() or any(not env.queue for env in self._acting)

    def has_planned_action(self) -> bool:
        """Return whether the next action needs only the clock of the observation."""
        return not self.needs_observation()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Observe one frame per environment, and return plans for all of them (B, chunk, A), normalised.

        A policy with a memory must have observed every control step (`observe`), unless observations have a clock
        (``observation.step``); `select_action` observes by itself. A training batch has its own histories. ``noise``
        (B, chunk, max_action_dim) replaces the episodes' own.
        """
        self.eval()
        if training := PHASE in batch:
            rows = [*range(len(batch[PHASE]))]
        else:
            if OBS_STEP in batch or not self._remembers or not self._calls:
                self.observe(batch)
            elif self._calls == self._planned:
                raise MemobenchError(
                    "this policy needs the observation of every control step, and was asked for two plans without an "
                    "observation between them, so its memory would differ from training; pass every observation to "
                    "select_action (--inference.type=sync) or to observe, or train with --policy.memory=none."
                )
            self._planned = self._calls
            rows = [*range(len(self.rollout.envs))]
        return self.plan(batch, rows, self._noise(rows, training) if noise is None else noise, training)

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
        """Load a checkpoint's averaged weights; without ``dataset_meta`` the policy only acts."""
        source = pretrained_name_or_path
        config = read_config(source, config, revision)
        path = weights_file(source, revision)
        if dataset_meta is None:
            check_processor_statistics(source, revision)
        # With an adapter, ``source`` is the base; the processor steps are saved with the adapter.
        saved, of = (config.pretrained_path, config.pretrained_revision) if config.use_peft else (source, revision)
        if saved is not None:
            require_agreement(saved, of, config, training=dataset_meta is not None)
            if dataset_meta is None:
                check_as_trained(saved, config, of)
        trained = as_trained(source, config, revision)
        assert isinstance(trained, MemobenchMemConfig)
        config.supervised_with_answer |= trained.supervised_with_answer  # what was learned stays learned
        policy = cls(config, dataset_meta=dataset_meta, load_base=False, draw=has_another_memory(config, trained))
        load_weights(policy, path, source, trained)
        policy.to(config.device)
        policy.eval()
        return policy

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """Return LeRobot's model card, with the mark of a policy that learned from the hidden answer."""
        card = super().generate_model_card(*args, **kwargs)
        if self.config.supervised_with_answer:
            card.text = f"\n**{SUPERVISED}.**\n{card.text}"
        return card

    # -- adapters --------------------------------------------------------------------------------------------------

    def wrap_with_peft(self, peft_config: Any = None, peft_cli_overrides: dict[str, Any] | None = None) -> Any:
        """Add adapters (LeRobot's ``--peft…``); all weights of memory and heads are trained as well.

        The base of the adapters is a checkpoint's averaged weights, as in evaluation.
        """
        wrapped = super().wrap_with_peft(peft_config, peft_cli_overrides)
        self.precision.settle()
        return wrapped

    def _get_default_peft_targets(self) -> dict[str, Any]:
        projections = "action_in_proj|action_out_proj"
        targets = rf"(.*\.gemma_expert\..*\.self_attn\.(q|v)_proj|model\.({projections}))"
        return {"target_modules": targets, "modules_to_save": self.trained_whole()}

    def _preprocess_peft_cli_overrides(self, cli_overrides: dict[str, Any], peft_method_type: Any) -> dict[str, Any]:
        overrides: dict[str, Any] = super()._preprocess_peft_cli_overrides(cli_overrides, peft_method_type)
        if overrides.get("modules_to_save") is not None:
            overrides["modules_to_save"] = self.trained_whole(overrides["modules_to_save"])
        return overrides

    def trained_whole(self, requested: Iterable[str] = ()) -> list[str]:
        """Return peft's ``modules_to_save``: the ``requested`` modules, and the model's memory and heads."""
        names = [name for name, _ in self.named_modules()]
        own = [end for end in OWN_MODULES if any(name == end or name.endswith(f".{end}") for name in names)]
        own += [name for name in names if name.removeprefix("model.modulators.").isdecimal()]  # peft takes no list
        return [*requested, *(end for end in own if end not in set(requested))]


def _without_labels(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a batch without true subgoals, so that a privileged memory chooses as in a rollout."""
    return {name: value for name, value in batch.items() if name not in (SUBGOAL, SUBGOALS)}


def _column(batch: dict[str, Tensor], key: str) -> list[int] | None:
    """Return an integer per row; None if the batch does not have the key."""
    if key not in batch:
        return None
    return [round(value) for value in batch[key].reshape(len(batch[key]), -1)[:, 0].tolist()]
