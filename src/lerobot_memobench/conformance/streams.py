"""Observations for a policy: a small dataset like those of `memobench generate`, and the episodes of a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_memobench.constants import ACTION_DIM, CAMERAS, CLOCK, EXECUTION, IMAGE_SIZE, OBS_PHASE, PROPRIO_DIM
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.frames import read_frame_table
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.sim.convention import UPRIGHT
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import Task

TASK = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
"""A task with three checkpoints, for memories that choose among subgoals."""
PROMPTS = (8, 11, 14)
"""Frames of each episode's prompt. They differ, so that the rows of a batch begin to act at different calls."""
EXECUTION_FRAMES = 27
THINGS = 4  # objects of a synthetic scene


def write_streams(
    folder: Path, images: bool = True, frames: int = EXECUTION_FRAMES, task: str = TASK, convention: str = UPRIGHT
) -> Path:
    """Write a dataset of three episodes of few execution frames, with real columns and shapes and synthetic values."""
    episodes = (_episode(get_task(task), seed, prompt, images, frames) for seed, prompt in enumerate(PROMPTS))
    return write_dataset(episodes, folder, convention=convention)


def task_of_texts(subgoals: Mapping[str, Sequence[str]]) -> str:
    """Return a task for a memory's texts of each instruction, preferably with a prompt and many checkpoints."""
    known = {text for own in subgoals.values() for text in own}

    def fits(task: Task) -> bool:
        levels = zip(*(checkpoint.language for checkpoint in task.checkpoints), strict=True)
        return task.language in subgoals and any(known.issuperset(texts) for texts in levels)

    fitting = filter(fits, map(get_task, task_names(suite=None)))
    best = max(fitting, key=lambda task: (task.prompt is not None, len(task.checkpoints)), default=None)
    return TASK if best is None else best.name


def _episode(task: Task, seed: int, prompt: int, images: bool, frames: int) -> Demonstration:
    rng, length = np.random.default_rng(seed), prompt + frames
    count = len(task.checkpoints)
    completed = prompt + frames * np.arange(1, count + 1) // (count + 1)
    times = np.arange(length)[:, None] / 2

    def moving(width: int) -> NDArray[np.float32]:
        waves = np.sin(times * rng.uniform(0.5, 1.5, width) + rng.uniform(0, 6, width))
        return waves.astype(np.float32)

    slots = np.zeros((length, SLOTS, WIDTH), np.float32)
    position, rotation = STARTS["position"], STARTS["rotation"]
    for thing in range(THINGS):
        slots[:, thing, :position] = [1, 3 + thing]
        slots[:, thing, position : position + 3] = [0, 0, 0.95] + 0.2 * moving(3)
        slots[:, thing, rotation : rotation + 6] = [1, 0, 0, 1, 0, 0]
    return Demonstration(
        task=task,
        seed=seed,
        referent="fixed",
        variant=0,
        states=np.zeros((length, 1)),
        actions=moving(ACTION_DIM),
        proprio=np.array([0, 0, 1.1, 3.1, 0, 0, 0, 0], np.float32) + 0.1 * moving(PROPRIO_DIM),
        images={name: _images(rng, moving(2)) for name in CAMERAS} if images else None,
        exec_start=prompt,
        satisfied=np.arange(length)[:, None] >= completed,
        success=True,
        objects=slots.reshape(length, -1),
    )


def _images(rng: np.random.Generator, positions: NDArray[np.float32]) -> NDArray[np.uint8]:
    # a coloured square that moves along positions (T, 2) in [-1, 1]
    images = np.full((len(positions), IMAGE_SIZE, IMAGE_SIZE, 3), 40, np.uint8)
    side, colour = IMAGE_SIZE // 4, rng.integers(80, 255, 3)
    corners = ((positions + 1) / 2 * (IMAGE_SIZE - side)).astype(int)
    for image, (top, left) in zip(images, corners, strict=True):
        image[top : top + side, left : left + side] = colour
    return images


@dataclass(frozen=True)
class Stream:
    """Observations of one environment, call by call; a finished one repeats its last frame, as LeRobot's do."""

    frames: tuple[dict[str, Tensor], ...]  # by the names at the policy, without a batch dimension
    task: str  # the instruction
    indices: tuple[int, ...]  # of the frames in the dataset

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, call: int) -> dict[str, Tensor]:
        """Return the observation at a call."""
        return self.frames[min(call, len(self) - 1)]

    @property
    def start(self) -> int:
        """The first call of the execution."""
        return next(call for call, frame in enumerate(self.frames) if float(frame[OBS_PHASE]) == EXECUTION)

    def until(self, call: int) -> Stream:
        """Return the stream that ends after a call."""
        return replace(self, frames=self.frames[: call + 1])

    def only(self, call: int) -> Stream:
        """Return the stream of one observation."""
        return Stream(self.frames[call : call + 1], self.task, self.indices[call : call + 1])

    def showing(self, other: Stream, calls: Sequence[int]) -> Stream:
        """Return the stream with another one's observations at some calls; phase and step stay its own."""
        shown = {call: {**other.at(call), **{name: self.at(call)[name] for name in CLOCK}} for call in calls}
        return replace(self, frames=tuple(shown.get(call, frame) for call, frame in enumerate(self.frames)))


def read_streams(dataset: Any, images: bool, objects: str | None, prompts: bool, frames: int) -> Iterator[Stream]:
    """Yield the beginning of each episode of a LeRobotDataset, without delta timestamps, as a rollout observes it.

    It has ``frames`` execution frames that are not held. ``objects``: the observed column of object state, or None.
    With ``prompts``, prompt and held frames are observed (a memory's history in training has them, and a policy that
    reads no prompt does not train on them), and prompted episodes of few frames come first.
    """
    from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

    table = read_frame_table(Path(dataset.root))
    episodes: list[tuple[bool, tuple[int, ...], str]] = []
    for episode in dataset.meta.episodes:
        first, end = episode["dataset_from_index"], episode["dataset_to_index"]
        acting = (first + np.flatnonzero(table.acts[first:end])[:frames]).tolist()
        if acting:
            indices = range(first, acting[-1] + 1) if prompts else acting
            prompted = float(dataset.hf_dataset[first][OBS_PHASE]) != EXECUTION
            episodes.append((not prompted, tuple(indices), episode["tasks"][0]))
    if prompts:
        episodes.sort(key=lambda episode: (episode[0], len(episode[1])))
    for _, indices, task in episodes:
        shown: list[dict[str, Tensor]] = []
        for index in indices:
            item = dataset[index] if images else dataset.hf_dataset[index]
            frame = {key: item[key] for key in (OBS_STATE, *CLOCK)}
            frame |= {key: as_float(item[key]) for key in item if images and key.startswith(f"{OBS_IMAGES}.")}
            frame |= {} if objects is None else {OBS_ENV_STATE: item[objects]}
            shown.append(frame)
        yield Stream(tuple(shown), task, indices)


def as_float(image: Tensor) -> Tensor:
    """Return an image in [0, 1], as LeRobot's training loop gives it to a policy."""
    return image.to(torch.float32) / 255 if image.dtype == torch.uint8 else image
