"""Log a training: LeRobot's console lines, W&B if asked for, and a CSV file in the run's folder."""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterator, Mapping
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from huggingface_hub.utils import tqdm
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.utils import inside_slurm

logger = logging.getLogger(__name__)

LOSSES = "losses.csv"
"""File of the run's folder: numbers of every ``log_freq`` updates, and of every evaluation."""
COLUMNS = ("step", "mode", "name", "value")


class TrainingLog:
    """Log the numbers of a training.

    Attributes:
        numbers: LeRobot's tracker: means since the last line.
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
        known = signature(MetricsTracker).parameters
        self.numbers = MetricsTracker(
            config.batch_size,
            dataset.num_frames,
            dataset.num_episodes,
            meters,
            step,
            **{name: value for name, value in processes.items() if name in known},
        )
        self._wandb = None
        wandb = getattr(config, "wandb", None)
        if self._first and wandb is not None and wandb.enable and wandb.project:
            from lerobot.common.wandb_utils import WandBLogger

            self._wandb = WandBLogger(config)
        self._file = config.output_dir / LOSSES
        self._bar = tqdm(
            total=config.steps, initial=step, desc="Training", unit="step", disable=not self._first or inside_slurm()
        )
        if self._first:
            logger.info("Output dir: %s", config.output_dir)
            logger.info("%d frames of %d episodes", dataset.num_frames, dataset.num_episodes)
            _keep_until(self._file, step)

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
        if self._first and seconds > 0:
            numbers.samples_per_s = self._batch / seconds
        if self._first:
            logger.info("%s", numbers)
            self._send(step, numbers.to_dict(), "train")
        numbers.reset_averages()

    def write_held_out(self, step: int, loss: float) -> None:
        """Write the mean loss of held-out episodes."""
        if self._first:
            logger.info("step %d: eval_loss=%.4f", step, loss)
            self._send(step, {"eval_loss": loss}, "eval")

    def write_evaluation(self, step: int, found: Mapping[str, Any]) -> None:
        """Write the rates of rollouts."""
        for suite, rates in found.items():
            logger.info("Suite %s aggregated: %s", suite, rates)
        overall = found["overall"]
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
        rows = [(step, mode, name, value) for name, value in numbers.items() if isinstance(value, int | float)]
        with self._file.open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows(rows)


def read_losses(file: Path) -> Iterator[tuple[int, str, str, float]]:
    """Yield step, ``train`` or ``eval``, name and value of each row of a run's ``losses.csv``."""
    with file.open(encoding="utf-8", newline="") as rows:
        for row in csv.DictReader(rows):
            yield int(row["step"]), row["mode"], row["name"], float(row["value"])


def _keep_until(file: Path, step: int) -> None:
    """Remove the rows after the step of a resumed training; create the file if it does not exist."""
    rows = [row for row in read_losses(file) if row[0] <= step] if file.is_file() else []
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as begun:
        csv.writer(begun).writerows([COLUMNS, *rows])
