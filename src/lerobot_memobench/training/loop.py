"""Train ``policy=memobench_mem``: datasets, policy, processors, updates, checkpoints.

The checkpoints are LeRobot's, so that LeRobot and `lerobot eval` load them: the model file holds the moving average of
the weights, ``training_weights.safetensors`` the weights. A resumed training continues bit for bit.
"""

from __future__ import annotations

import csv
import ctypes
import logging
import platform
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, DistributedType
from huggingface_hub.utils import tqdm
from lerobot.common.train_utils import (
    get_step_checkpoint_dir,
    get_step_identifier,
    push_checkpoint_to_hub,
    should_save_checkpoint,
    update_last_checkpoint,
)
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import close_envs, make_env
from lerobot.optim import load_optimizer_state, load_scheduler_state, save_optimizer_state, save_scheduler_state
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.collate import lerobot_collate_fn
from lerobot.utils.constants import PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.io_utils import write_json
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import save_rng_state, set_seed
from lerobot.utils.utils import cycle, init_logging, inside_slurm
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.checkpoint import as_trained, checkpoint_file, read_checkpoint_json, undamaged_tensors
from lerobot_memobench.policies.memobench_mem.checkpoints import read_tensors, restarted
from lerobot_memobench.training.data import Training, check_environment, open_datasets, open_training
from lerobot_memobench.training.sampler import FrameSampler, seed_of, task_weights

logger = logging.getLogger(__name__)

TRAINING_FILE = "training_weights.safetensors"
LOSSES = "losses.csv"
"""File of the run's folder: numbers of every ``log_freq`` updates, and of every evaluation."""
DISTRIBUTED = (DistributedType.NO, DistributedType.MULTI_CPU, DistributedType.MULTI_GPU)


def train(config: TrainPipelineConfig) -> None:
    """Train a memory policy by a configuration of `command.complete_training`."""
    accelerator = begin(config)
    with accelerator.main_process_first():  # the others find the dataset downloaded
        datasets = open_datasets(config)
    meta = datasets[0].meta
    check_environment(config, meta, meta.features)
    training = open_training(config, datasets)
    policy_config: Any = config.policy
    average = begin_average(training.policy)
    optimizer, scheduler = make_optimizer_and_scheduler(config, training.policy)
    sampler, step = make_sampler(config, training), 0
    if config.resume:
        assert config.checkpoint_path is not None
        progress = load_state(config.checkpoint_path, optimizer, scheduler)
        step, batch_size = progress["step"], progress.get("batch_size") or config.batch_size
        sampler.resume_from(step, batch_size, progress.get("num_processes") or accelerator.num_processes)
    loader = make_loader(config, training, training.samples(), sampler=sampler)
    held_out_loader = None if training.held_out is None else make_held_out_loader(config, training)
    model, optimizer, loader, scheduler, held_out_loader = accelerator.prepare(
        training.policy, optimizer, loader, scheduler, held_out_loader
    )
    state = TrainingState(config, accelerator, training, model, average, optimizer, scheduler)
    interrupted = accelerator.is_main_process and rollouts_missing(config, step)
    log, batches = TrainingLog(config, training.dataset, accelerator, step), cycle(loader)
    model.train()
    seed = torch.initial_seed() if config.seed is None else config.seed
    if interrupted:
        log.write_evaluation(step, state.evaluate(step))
    accelerator.wait_for_everyone()
    while step < config.steps:
        # Processes draw different noise, and a resumed training draws what an uninterrupted one does.
        set_seed(seed_of(seed, accelerator.process_index, step))
        begun = time.perf_counter()
        batch = state.preprocessed(next(batches))
        log.numbers.dataloading_s = time.perf_counter() - begun
        log.note(state.update(batch))
        step += 1
        if config.log_freq > 0 and step % config.log_freq == 0:
            log.write(step)
        if held_out_loader is not None and config.eval_steps > 0 and step % config.eval_steps == 0:
            log.write_held_out(step, state.held_out_loss(held_out_loader))
        if config.save_checkpoint and should_save_checkpoint(step, config.save_freq, config.steps):
            if accelerator.is_main_process:
                log.keep_model(state.save(step))
            accelerator.wait_for_everyone()
        if rollouts_due(config, step):
            if accelerator.is_main_process:
                log.write_evaluation(step, state.evaluate(step))
            accelerator.wait_for_everyone()
    log.close()
    accelerator.wait_for_everyone()
    accelerator.end_training()  # LeRobot's main branch would wait for the others of the group in an upload
    if accelerator.is_main_process and policy_config.push_to_hub:
        state.push()


def rollouts_due(config: TrainPipelineConfig, step: int) -> bool:
    """Return whether the policy is evaluated after ``step`` updates."""
    return config.env is not None and config.env_eval_freq > 0 and step > 0 and step % config.env_eval_freq == 0


def rollouts_missing(config: TrainPipelineConfig, step: int) -> bool:
    """Return whether a training was interrupted in the rollouts after ``step`` updates, which follow the checkpoint."""
    assert config.output_dir is not None
    rates = ("eval", "pc_success")
    return rollouts_due(config, step) and not any(
        row[0] == str(step) and tuple(row[1:3]) == rates for row in written_rows(config.output_dir / LOSSES)
    )


def written_rows(file: Path) -> list[list[str]]:
    """Return the rows of a training's log below its heading; none where the file is missing."""
    if not file.is_file():
        return []
    with file.open(encoding="utf-8", newline="") as before:
        return [row for row in csv.reader(before) if row and row[0].isdecimal()]


def begin(config: TrainPipelineConfig) -> Accelerator:
    """Return accelerate's handle of this process, after seeding and settings as in LeRobot's trainer."""
    policy: Any = config.policy
    accelerator = Accelerator(
        step_scheduler_with_optimizer=False,  # else accelerate steps the schedule once for each process
        mixed_precision={"bfloat16": "bf16", "float16": "fp16", "float32": "no"}.get(policy.dtype),
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
        cpu=policy.device == "cpu",
    )
    if accelerator.distributed_type not in DISTRIBUTED:
        raise MemobenchError(
            f"found {accelerator.distributed_type}; each process of this training holds the whole policy: launch it "
            "with --multi_gpu"
        )
    if accelerator.gradient_accumulation_steps != 1:
        raise MemobenchError(
            f"found gradient_accumulation_steps={accelerator.gradient_accumulation_steps} of accelerate; each batch is "
            "an update: launch it without, and set batch_size="
        )
    init_logging(accelerator=accelerator)
    if config.seed is not None:
        set_seed(config.seed, accelerator=accelerator)
    torch.backends.cudnn.deterministic = config.cudnn_deterministic
    torch.backends.cudnn.benchmark = not config.cudnn_deterministic
    torch.backends.cuda.matmul.allow_tf32 = True
    if accelerator.device.type == "cpu":
        keep_freed_memory()
    return accelerator


@dataclass
class TrainingState:
    """Model, as accelerate wraps it, weight average, optimizer and schedule of a training."""

    config: TrainPipelineConfig
    accelerator: Accelerator
    training: Training
    model: Any
    average: WeightAverage | None
    optimizer: Any
    scheduler: Any

    def preprocessed(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return the model's inputs of a batch of samples."""
        for key in self.training.dataset.meta.camera_keys:
            if key in batch and batch[key].dtype == torch.uint8:
                batch[key] = batch[key].to(torch.float32) / 255.0
        inputs: dict[str, Any] = self.training.processors[0](batch)
        return inputs

    def update(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Train on a batch; return the numbers to log."""
        begun = time.perf_counter()
        with self.accelerator.autocast():
            loss, logged = self.model(batch)
        self.accelerator.backward(loss)
        assert self.config.optimizer is not None
        most = self.config.optimizer.grad_clip_norm
        norm = self.accelerator.clip_grad_norm_(self.model.parameters(), most if most > 0 else float("inf"))
        self.optimizer.step()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        if self.average is not None:
            self.average.update()
        return {
            **logged,
            "loss": loss.item(),
            "grad_norm": norm.item(),
            "lr": self.optimizer.param_groups[0]["lr"],
            "update_s": time.perf_counter() - begun,
        }

    @contextmanager
    def _averaged(self, *, acting: bool = False) -> Iterator[None]:
        """Let the model hold the average: in the precision that a loaded checkpoint acts in, or as it is saved."""
        narrowed = self.training.policy.precision.narrowed() if acting else None
        with nullcontext() if self.average is None else self.average.applied(narrowed):
            yield

    def held_out_loss(self, loader: Any) -> float:
        """Return the mean loss of held-out samples over all processes."""
        self.model.eval()
        losses: list[float] = []
        with self._averaged(acting=True), torch.no_grad(), self.accelerator.autocast():
            for batch in loader:
                loss, _ = self.model(self.preprocessed(batch))
                losses.append(loss.item())
        self.model.train()
        mean = torch.tensor(sum(losses) / max(len(losses), 1), device=self.accelerator.device)
        return float(self.accelerator.reduce(mean, reduction="mean").item())

    def save(self, step: int) -> Path:
        """Save a checkpoint in LeRobot's layout; return its folder."""
        config = self.config
        assert config.output_dir is not None
        assert config.policy is not None
        logger.info("Checkpoint policy after step %d", step)
        folder: Path = get_step_checkpoint_dir(config.output_dir, config.steps, step)
        pretrained = folder / PRETRAINED_MODEL_DIR
        if self.average is not None:  # before LeRobot's files, so that a checkpoint that looks whole has it
            self.average.save(pretrained)
        with self._averaged():
            self.accelerator.unwrap_model(self.model).save_pretrained(pretrained)
        config.save_pretrained(pretrained)
        if self.training.policy.config.use_peft:  # PEFT saves adapters alone
            self.training.policy.config.save_pretrained(pretrained)
        for processor in self.training.processors:
            processor.save_pretrained(pretrained)
        progress = {"step": step, "batch_size": config.batch_size, "num_processes": self.accelerator.num_processes}
        save_state(folder, progress, self.optimizer, self.scheduler)
        update_last_checkpoint(folder)
        if config.save_checkpoint_to_hub:
            push_checkpoint_to_hub(folder, config.policy.repo_id, private=config.policy.private)
        return folder

    def evaluate(self, step: int) -> Mapping[str, Any]:
        """Return the rates of rollouts in ``config.env``, as LeRobot's trainer does."""
        config = self.config
        assert config.output_dir is not None
        assert config.env is not None
        environments = make_env(config.env, n_envs=config.eval.batch_size, use_async_envs=config.eval.use_async_envs)
        before, after = config.env.get_env_processors()
        try:
            with self._averaged(acting=True), torch.no_grad(), self.accelerator.autocast():
                rates: Mapping[str, Any] = eval_policy_all(
                    envs=environments,
                    policy=self.accelerator.unwrap_model(self.model),
                    env_preprocessor=before,
                    env_postprocessor=after,
                    preprocessor=self.training.processors[0],
                    postprocessor=self.training.processors[1],
                    n_episodes=config.eval.n_episodes,
                    videos_dir=config.output_dir / "eval" / f"videos_step_{get_step_identifier(step, config.steps)}",
                    max_episodes_rendered=4,
                    start_seed=config.seed,
                    max_parallel_tasks=config.env.max_parallel_tasks,
                )
        finally:
            close_envs(environments)
        self.model.train()
        return rates

    def push(self) -> None:
        """Upload the model and its processors to the hub."""
        model = self.accelerator.unwrap_model(self.model)
        adapters = {"peft_model": model} if self.training.policy.config.use_peft else {}
        with self._averaged():
            model.push_model_to_hub(self.config, dataset_meta=self.training.dataset.meta, **adapters)
        for processor in self.training.processors:
            processor.push_to_hub(self.training.policy.config.repo_id)


# -- average of the weights --------------------------------------------------------------------------------------------


class WeightAverage:
    """Moving average of trained weights: parameters, averages and numbers of updates by the parameter's name.

    It is kept outside the module, so that optimizer, DDP and ``state_dict`` do not see it; torch's ``AveragedModel`` is
    a copy of the module with one number of updates for all parameters. The decay grows to the given value as
    (1 + n) / (10 + n) over the first updates n of a parameter, so that the average of a short run is not dominated by
    the initial weights. Averages are float32, because bfloat16 cannot hold steps of a thousandth.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay, self.parameters = decay, dict(parameters)
        self.counts = dict.fromkeys(self.parameters, 0)
        self.average = {name: weight.detach().to(torch.float32, copy=True) for name, weight in self.parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the current weights by one step."""
        for count in set(self.counts.values()):
            names = [name for name, updates in self.counts.items() if updates == count]
            decay = min(self.decay, (1 + count) / (10 + count))
            weights = [self.parameters[name].detach().to(torch.float32) for name in names]
            torch._foreach_lerp_([self.average[name] for name in names], weights, 1.0 - decay)
        self.counts = {name: updates + 1 for name, updates in self.counts.items()}

    @contextmanager
    def applied(self, dtypes: Mapping[nn.Parameter, torch.dtype] | None = None) -> Iterator[None]:
        """Set the parameters to the average inside the block, some in other ``dtypes``; float32 ones are not copied."""
        trained = {name: parameter.data for name, parameter in self.parameters.items()}
        try:
            for name, parameter in self.parameters.items():
                parameter.data = self.average[name].to((dtypes or {}).get(parameter, parameter.dtype))
            yield
        finally:
            for name, parameter in self.parameters.items():
                parameter.data = trained[name]

    def save(self, folder: Path) -> None:
        """Write the trained weights, and the averages that the precision of the model's file would round."""
        tensors = {f"weights.{name}": parameter.detach().contiguous() for name, parameter in self.parameters.items()}
        for name, parameter in self.parameters.items():
            if parameter.dtype != torch.float32:
                tensors[f"average.{name}"] = self.average[name]
        longest = max(self.counts.values(), default=0)
        other_counts = {f"updates.{name}": str(count) for name, count in self.counts.items() if count != longest}
        folder.mkdir(parents=True, exist_ok=True)
        save_file(tensors, folder / TRAINING_FILE, metadata={"updates": str(longest), **other_counts})

    @torch.no_grad()
    def restore(self, path: Path, names: Collection[str]) -> list[str]:
        """Restore weights, averages and numbers of updates of these parameters in a module that holds the average.

        Return the parameters without a saved state, whose average starts at their present weights.
        """
        with undamaged_tensors(path), safe_open(path, framework="pt") as file:
            metadata = file.metadata()
        tensors: Mapping[str, Tensor] = read_tensors(path)
        saved = {name: tensors[f"weights.{name}"] for name in names if f"weights.{name}" in tensors}
        for name, weights in saved.items():
            parameter = self.parameters[name]
            if weights.shape != parameter.shape:
                raise MemobenchError(
                    f"{path} holds '{name}' in another shape than this policy; copy the checkpoint again"
                )
            average = tensors.get(f"average.{name}", parameter.detach())  # else the model's file holds it exactly
            self.average[name] = average.to(parameter.device, torch.float32, copy=True)
            self.counts[name] = int(metadata.get(f"updates.{name}", metadata["updates"]))
            parameter.copy_(weights.to(parameter.device))
        return [name for name in self.parameters if name not in saved]


def begin_average(policy: Any) -> WeightAverage | None:
    """Return the average of a policy in training; None without one (``ema_decay=0``, adapters).

    A policy loaded from a checkpoint holds the average. Its trained weights are restored, and the average continues;
    it starts again for parts that are initialised again, or that the checkpoint did not train.
    """
    config = policy.config
    if not config.ema_decay or config.use_peft:
        return None
    average = WeightAverage(policy.trained_parameters(), config.ema_decay)
    source, revision = config.pretrained_path, config.pretrained_revision
    path = None if source is None else checkpoint_file(source, TRAINING_FILE, revision)
    if path is None:
        return average
    trained: Any = as_trained(source, config, revision)
    new = average.restore(path, average.parameters.keys() - restarted(policy, trained))
    if new:
        logger.info("the average continues from '%s'; that of %s starts again", source, ", ".join(new))
    return average


# -- batches -----------------------------------------------------------------------------------------------------------


def make_sampler(config: TrainPipelineConfig, training: Training) -> FrameSampler:
    """Return the sampler of the frames that are trained on."""
    policy, lookup, dataset = training.policy.config, training.lookup, training.dataset
    weights = policy.task_weights
    tasks = None if weights is None else task_weights(dataset.meta, lookup.episodes, lookup.phase, weights)
    return FrameSampler(
        lookup.episodes,
        lookup.acts,
        dataset.episodes,
        together=policy.frames_per_episode,
        tasks=tasks,
        seed=training.seed,
        numbered=config.dataset.image_transforms.enable and not lookup.columns,
    )


def make_loader(
    config: TrainPipelineConfig, training: Training, samples: Any, sampler: FrameSampler | None = None
) -> DataLoader[Any]:
    """Return batches of samples: as a sampler draws them, or each sample once in order."""
    workers = 0 if training.lookup.columns else config.num_workers  # samples in main memory need no processes
    decoding: dict[str, Any] = {
        "prefetch_factor": config.prefetch_factor,
        "persistent_workers": config.persistent_workers,
        "multiprocessing_context": config.dataloader_multiprocessing_context,
    }
    return DataLoader(
        samples,
        batch_size=config.batch_size,
        sampler=sampler,
        num_workers=workers,
        pin_memory=training.policy.config.device != "cpu",
        collate_fn=lerobot_collate_fn if training.dataset.meta.has_language_columns else None,
        # Each iteration draws from it, and a resumed training starts one more than an uninterrupted one.
        generator=torch.Generator(),
        **(decoding if workers else {}),
    )


def make_held_out_loader(config: TrainPipelineConfig, training: Training) -> DataLoader[Any]:
    """Return batches of ``max_eval_samples`` frames of held-out episodes, at equal distances in those of each task."""
    dataset, lookup = training.held_out, training.lookup
    assert dataset is not None
    frames = FrameSampler(lookup.episodes, lookup.acts, dataset.episodes).frames.tolist()
    if config.max_eval_samples > 0:
        tasks, rows = dataset.hf_dataset.data.column("task_index").to_pylist(), dataset.absolute_to_relative_idx
        of_task: dict[int, list[int]] = {}
        for frame in frames:
            of_task.setdefault(tasks[frame if rows is None else rows[frame]], []).append(frame)
        most = max(1, config.max_eval_samples // len(of_task))
        frames = [frame for task in sorted(of_task) for frame in of_task[task][:: -(-len(of_task[task]) // most)]]
    return make_loader(config, training, Subset(training.samples(dataset), frames))


# -- state in a checkpoint ---------------------------------------------------------------------------------------------


# Names and formats are those of LeRobot 0.6 and of its main branch, which read each other's files. The functions that
# write all of them at once differ between the two.


def save_state(checkpoint: Path, progress: dict[str, int], optimizer: Any, scheduler: Any) -> None:
    """Write ``training_state`` of a checkpoint, the optimizer's parameter groups last.

    ``progress``: ``step`` and, per update, ``batch_size`` of a process and ``num_processes``.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    folder.mkdir(parents=True, exist_ok=True)
    write_json({**progress, "dp_world_size": progress["num_processes"]}, folder / TRAINING_STEP)
    save_rng_state(folder)
    if scheduler is not None:
        save_scheduler_state(scheduler, folder)
    save_optimizer_state(optimizer, folder)


def load_state(checkpoint: Path, optimizer: Any, scheduler: Any) -> dict[str, int]:
    """Restore optimizer and schedule of a checkpoint, not the random state; return its ``progress``."""
    folder = checkpoint / TRAINING_STATE_DIR
    progress = read_checkpoint_json(folder / TRAINING_STEP)
    load_optimizer_state(optimizer, folder)
    if scheduler is not None:
        load_scheduler_state(scheduler, folder)
    return progress


# -- log ---------------------------------------------------------------------------------------------------------------


class TrainingLog:
    """Log a training: LeRobot's console lines, W&B if it is enabled, and a CSV file in the run's folder.

    ``numbers`` is LeRobot's tracker of the means since the last line.
    """

    def __init__(
        self, config: TrainPipelineConfig, dataset: LeRobotDataset, accelerator: Accelerator, step: int
    ) -> None:
        assert config.output_dir is not None
        self._first = accelerator.is_main_process
        self._batch = config.batch_size * accelerator.num_processes
        meters = {
            "loss": AverageMeter("loss", ":.3f", reduction="mean"),
            "grad_norm": AverageMeter("grdn", ":.3f"),
            "lr": AverageMeter("lr", ":0.1e"),
            "update_s": AverageMeter("updt_s", ":.3f", reduction="max"),
            "dataloading_s": AverageMeter("data_s", ":.3f", reduction="max"),
            "samples_per_s": AverageMeter("smp/s", ":.0f"),
        }
        if torch.cuda.is_available():
            meters["gpu_mem_gb"] = AverageMeter("mem_gb", ":.2f", reduction="max")
        processes = {"accelerator": accelerator, "dp_world_size": accelerator.num_processes}  # LeRobot 0.6, its main
        known = {name: processes[name] for name in processes if name in signature(MetricsTracker).parameters}
        frames, episodes = dataset.num_frames, dataset.num_episodes
        self.numbers = MetricsTracker(config.batch_size, frames, episodes, meters, step, **known)
        self._wandb = None
        if self._first and config.wandb.enable and config.wandb.project:
            from lerobot.common.wandb_utils import WandBLogger

            self._wandb = WandBLogger(config)
        self._file = config.output_dir / LOSSES
        self._bar = tqdm(
            total=config.steps, initial=step, desc="Training", unit="step", disable=not self._first or inside_slurm()
        )
        if self._first:
            logger.info("Output dir: %s", config.output_dir)
            logger.info("%d frames of %d episodes", frames, episodes)
            rows = [["step", "mode", "name", "value"]]  # a resumed training writes the later rows again
            rows += [row for row in written_rows(self._file) if int(row[0]) <= step]
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._write_rows(rows, "w")

    def note(self, logged: Mapping[str, Any]) -> None:
        """Add the numbers of an update."""
        for name in ("loss", "grad_norm", "lr", "update_s"):
            setattr(self.numbers, name, logged[name])
        if torch.cuda.is_available():
            self.numbers.gpu_mem_gb = torch.cuda.max_memory_allocated() / 1024**3
            torch.cuda.reset_peak_memory_stats()
        self.numbers.update_metrics(logged)
        self.numbers.step()
        self._bar.update(1)

    def write(self, step: int) -> None:
        """Write the means since the last call, over all processes."""
        numbers = self.numbers
        numbers.reduce_across_ranks()
        seconds = numbers.update_s.avg + numbers.dataloading_s.avg
        if self._first:
            if seconds > 0:
                numbers.samples_per_s = self._batch / seconds
            logger.info("%s", numbers)
            self._send(step, numbers.to_dict(), "train")
        numbers.reset_averages()

    def write_held_out(self, step: int, loss: float) -> None:
        """Write the mean loss of held-out episodes."""
        if self._first:
            logger.info("step %d: eval_loss=%.4f", step, loss)
            self._send(step, {"eval_loss": loss}, "eval")

    def write_evaluation(self, step: int, by_suite: Mapping[str, Any]) -> None:
        """Write the rates of rollouts."""
        for suite, rates in by_suite.items():
            logger.info("Suite %s aggregated: %s", suite, rates)
        overall = by_suite["overall"]
        self._send(step, {name: overall[name] for name in ("avg_sum_reward", "pc_success", "eval_s")}, "eval")
        if self._wandb is not None and overall.get("video_paths"):
            self._wandb.log_video(overall["video_paths"][0], step, mode="eval")

    def keep_model(self, checkpoint: Path) -> None:
        """Send a checkpoint to W&B, if it is enabled."""
        if self._wandb is not None:
            self._wandb.log_policy(checkpoint)

    def close(self) -> None:
        """End the progress bar."""
        self._bar.close()
        if self._first:
            logger.info("End of training")

    def _send(self, step: int, numbers: dict[str, Any], mode: str) -> None:
        if self._wandb is not None:
            self._wandb.log_dict(numbers, step, mode=mode)
        self._write_rows([(step, mode, name, n) for name, n in numbers.items() if isinstance(n, int | float)], "a")

    def _write_rows(self, rows: Iterable[Iterable[Any]], how: str) -> None:
        with self._file.open(how, encoding="utf-8", newline="") as file:
            csv.writer(file).writerows(rows)


# -- memory on a CPU ---------------------------------------------------------------------------------------------------


def keep_freed_memory() -> None:
    """Make malloc keep freed memory in this process; only glibc supports it.

    An update of a small policy frees and allocates some hundred MB. Without the page faults it took 16 % less time.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3  # of glibc's malloc.h
    largest = 32 << 20  # bytes: the largest threshold of mapped blocks that glibc allows
    for parameter, value in ((mmap_threshold, largest), (trim_threshold, 2**31 - 1), (top_pad, 8 * largest)):
        libc.mallopt(parameter, value)
