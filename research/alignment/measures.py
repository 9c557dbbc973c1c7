"""How well a policy's memory tells the active subgoal, and how far its actions are off.

A readout is fitted in closed form on frozen vectors of training episodes, for every policy alike, so that policies
trained without an alignment can be compared with those that have a head of their own. It has the form of the heads: a
linear map to the text embedding, answered by the nearest candidate text.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from lerobot.policies import make_pre_post_processors
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_memobench.datasets.frames import FrameLookup
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import SemanticAlignment, masked_mean
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import follow_training
from lerobot_memobench.protocol import PROMPT
from lerobot_memobench.tasks.catalogue import suite_of
from lerobot_memobench.training.data import RecordedSamples

# --- episodes: their tasks, and which are held out ---


@dataclass(frozen=True)
class Split:
    """A dataset's episodes.

    Attributes:
        tasks: names of its tasks, in order. referent: of all its episodes.
        task: (E,) number of each episode's task. held: (E,) whether it is held out.
    """

    tasks: tuple[str, ...]
    referent: str
    task: np.ndarray
    held: np.ndarray

    @property
    def trained(self) -> list[int]:
        """Numbers of the episodes to train on."""
        return [int(number) for number in np.flatnonzero(~self.held)]

    def frames(self, askable: np.ndarray, episodes: np.ndarray, count: int, *, held: bool) -> np.ndarray:
        """Return frames of the episodes that are held out, or of the others, at most ``count`` of each, evenly spaced.

        Args:
            askable: (N,) which frames may be taken. episodes: (E + 1,) first frame of each episode.
        """
        chosen = np.flatnonzero(self.held == held)
        own = (episodes[k] + np.flatnonzero(askable[episodes[k] : episodes[k + 1]]) for k in chosen)
        return np.concatenate([_spaced(frames, count) for frames in own])


def split_episodes(root: Path, held_out: int) -> Split:
    """Hold out the last ``held_out`` episodes of every task of a dataset.

    Raises:
        MemobenchError: it is none of this package, of several suites or referents, or a task has too few episodes.
    """
    records = [place.record for place in list_episodes(root)]
    known = [record for record in records if record is not None]
    if len(known) < len(records):
        raise MemobenchError(f"of the episode {records.index(None)} of {root}, {STRANGER}")
    kinds = {(suite_of(record.task_name), record.referent) for record in known}
    if len(kinds) != 1:
        raise MemobenchError(
            f"{root} holds demonstrations of {len(kinds)} kinds, told apart by suite and referent; a study rolls out "
            "by one of each, so give a dataset of one `memobench generate`"
        )
    ((_, referent),) = kinds
    tasks, task = np.unique([record.task_name for record in known], return_inverse=True)
    return Split(tuple(map(str, tasks)), referent, task, _last(task, tasks, held_out))


def _last(task: np.ndarray, names: np.ndarray, count: int) -> np.ndarray:
    """Return which episodes (E,) are among the last ``count`` of their task (E,)."""
    held = np.zeros(len(task), dtype=bool)
    for number, name in enumerate(names):
        own = np.flatnonzero(task == number)
        if len(own) <= count:
            raise MemobenchError(
                f"the task '{name}' has {len(own)} episodes and {count} are to be held out; generate more, or lower "
                "--held-out"
            )
        held[own[-count:]] = True
    return held


def _spaced(frames: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of these frames, evenly spaced."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return frames[places.round().astype(int)]


# --- questions: which subgoal is active at a frame ---


@dataclass(frozen=True)
class Asked:
    """Frames with their right answers, for one split.

    Attributes:
        indices: (N,) frames of the dataset.
        labels: (N,) candidate that is right.
        episodes: (N,). tasks: (N,) numbers, as the split has them.
        allowed: (N, C) candidates of the frame's own task.
    """

    indices: np.ndarray
    labels: Tensor
    episodes: Tensor
    tasks: np.ndarray
    allowed: Tensor


@dataclass(frozen=True)
class Questions:
    """All frames that are asked about, and the candidates among which an answer is chosen.

    Attributes:
        candidates: (C, d_t) embeddings of the subgoals that are right anywhere. texts: the C subgoals.
        fit, test: of training and of held-out episodes.
    """

    candidates: Tensor
    texts: list[str]
    fit: Asked
    test: Asked


def make_questions(frames: FrameLookup, level: str, split: Split, per_episode: int) -> Questions:
    """Ask for the subgoal of ``level`` at execution frames, at most ``per_episode`` of each episode."""
    rows, episodes = frames.text_rows(level), frames.episodes
    askable = (frames.phase != PROMPT) & (rows >= 0)
    parts = [split.frames(askable, episodes, per_episode, held=held) for held in (False, True)]
    used, numbers = np.unique(rows[np.concatenate(parts)], return_inverse=True)
    episode_of = np.repeat(np.arange(len(split.task)), np.diff(episodes))
    task_of = split.task[episode_of]
    by_task = np.zeros((len(split.tasks), len(used)), dtype=bool)
    by_task[task_of[np.concatenate(parts)], numbers] = True
    fit, test = (
        Asked(
            indices=indices,
            labels=torch.from_numpy(labels),
            episodes=torch.from_numpy(episode_of[indices]),
            tasks=task_of[indices],
            allowed=torch.from_numpy(by_task[task_of[indices]]),
        )
        for indices, labels in zip(parts, np.split(numbers, [len(parts[0])]), strict=True)
    )
    return Questions(
        candidates=frames.text_embeddings[torch.from_numpy(used.astype(np.int64))],
        texts=[frames.texts[row] for row in used],
        fit=fit,
        test=test,
    )


def guesses(questions: Questions) -> dict[str, Any]:
    """Return what is right without looking: at random, and by the commonest subgoal of the training episodes."""
    test, count = questions.test, len(questions.candidates)
    common = torch.bincount(questions.fit.labels, minlength=count)
    in_task = torch.where(test.allowed, common, -1)
    return {
        "chance": {"all": 1.0 / count, "own_task": float((1.0 / test.allowed.sum(dim=1)).mean())},
        "commonest": {
            "all": float((test.labels == common.argmax()).double().mean()),
            "own_task": float((test.labels == in_task.argmax(dim=1)).double().mean()),
        },
    }


# --- readouts ---

PENALTIES = tuple(10.0**k for k in range(-4, 3))
FOLDS = 3


@dataclass(frozen=True)
class Readout:
    """Ridge regression from standardised vectors to text embeddings."""

    mean: Tensor  # (D,)
    scale: Tensor  # (D,)
    weight: Tensor  # (D, d_t)
    bias: Tensor  # (d_t,)
    penalty: float

    def __call__(self, vectors: Tensor) -> Tensor:
        """Predicted embeddings (N, d_t) of vectors (N, D), normalised."""
        return F.normalize((vectors.double() - self.mean) / self.scale @ self.weight + self.bias, dim=-1)


def fit_readout(vectors: Tensor, texts: Tensor, penalty: float) -> Readout:
    """Fit vectors (N, D) to texts (N, d_t); ``penalty`` is relative to N, as every input has variance 1."""
    vectors, texts = vectors.double(), texts.double()
    mean, scale = vectors.mean(dim=0), vectors.std(dim=0).clamp(min=1e-8)
    inputs, bias = (vectors - mean) / scale, texts.mean(dim=0)
    gram = inputs.T @ inputs + penalty * len(inputs) * torch.eye(inputs.shape[1], dtype=torch.float64)
    weight = torch.linalg.solve(gram, inputs.T @ (texts - bias))
    return Readout(mean, scale, weight, bias, penalty)


def choose_readout(vectors: Tensor, labels: Tensor, candidates: Tensor, episodes: Tensor) -> Readout:
    """Fit a readout whose penalty was chosen on the training episodes alone.

    Args:
        vectors: (N, D). labels: (N,) row of ``candidates`` that is right.
        candidates: (C, d_t) text embeddings.
        episodes: (N,) a number per episode; whole episodes are left out, a third of them at a time.
    """
    folds = episodes % FOLDS

    def score(penalty: float) -> float:
        """How many frames of left-out episodes are told right."""
        right = 0.0
        for fold in range(FOLDS):
            out = folds == fold
            if not bool(out.any()) or bool(out.all()):
                continue
            readout = fit_readout(vectors[~out], candidates[labels[~out]], penalty)
            right += float((nearest(readout(vectors[out]), candidates) == labels[out]).sum())
        return right

    best = max(PENALTIES, key=lambda penalty: (score(penalty), penalty))  # of equals, the simpler readout
    return fit_readout(vectors, candidates[labels], best)


def nearest(embeddings: Tensor, candidates: Tensor, allowed: Tensor | None = None) -> Tensor:
    """Row (N,) of the candidate (C, d_t) nearest to each embedding (N, d_t), among those ``allowed`` (N, C)."""
    similarity = embeddings.double() @ F.normalize(candidates.double(), dim=-1).T
    if allowed is not None:
        similarity = similarity.masked_fill(~allowed, -torch.inf)
    return similarity.argmax(dim=1)


def top1(embeddings: Tensor, labels: Tensor, candidates: Tensor, allowed: Tensor | None = None) -> float:
    """Share of embeddings (N, d_t) whose nearest candidate is the right one."""
    return float((nearest(embeddings, candidates, allowed) == labels).double().mean())


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and sample standard deviation; None for a single value, which has none."""
    tensor = torch.tensor(values, dtype=torch.float64)
    return float(tensor.mean()), float(tensor.std()) if len(values) > 1 else None


# --- measures of a policy ---

EVALUATION_BATCH = 32


class Measures:
    """Questions about a dataset's frames, put to finished policies that see objects.

    Args:
        frames: of the dataset. meta: its metadata, as LeRobot has it. tasks: names of its tasks.
    """

    def __init__(self, frames: FrameLookup, meta: Any, tasks: tuple[str, ...], questions: Questions) -> None:
        self.frames, self.meta, self.tasks, self.questions = frames, meta, tasks, questions

    def of_checkpoint(self, folder: Path) -> dict[str, Any]:
        """Measure the policy of a checkpoint, by its averaged weights."""
        policy = MemobenchMemPolicy.from_pretrained(folder)
        before, _ = make_pre_post_processors(policy.config, pretrained_path=str(folder))
        follow_training(before.steps, policy.config, self.meta, self.frames)
        found: dict[str, Any] = self.of_memory(policy, before) if policy.config.memory != "none" else {}
        return found | {"action_loss": self.action_loss(policy, before)}

    # -- the active subgoal ----------------------------------------------------------------------------------------

    def of_memory(self, policy: MemobenchMemPolicy, before: Any) -> dict[str, Any]:
        """Ask the memory of a policy, whose preprocessor is ``before``, for the active subgoal."""
        fit, test = (self._vectors(policy, before, asked) for asked in (self.questions.fit, self.questions.test))
        found: dict[str, Any] = {name: self._readout(fit[name], test[name]) for name in ("memory", "last_frame")}
        return found | {name: self._scores(test[name]) for name in ("head",) if name in test}

    @torch.no_grad()
    def _vectors(self, policy: MemobenchMemPolicy, before: Any, asked: Asked) -> dict[str, Tensor]:
        """Vectors (N, D) of each frame: ``memory``, ``last_frame``, and with a head its ``head`` embedding (N, d_t)."""
        parts: dict[str, list[Tensor]] = {}
        for _, batch in self._batches(policy, before, asked):
            read = policy.read_memory(batch)
            assert read is not None
            assert read.steps is not None
            memory, mask = read.rows(), read.mask
            last = mask & (read.steps == read.steps.masked_fill(~mask, -1).amax(dim=1, keepdim=True))
            found = {"memory": masked_mean(memory, mask), "last_frame": masked_mean(memory, last)}
            head = policy.alignment
            if isinstance(head, SemanticAlignment):
                found["head"] = head.embed(memory, mask)
            elif head is not None:  # of frames
                found["head"] = head.project(masked_mean(memory, last))
            for name, vectors in found.items():
                parts.setdefault(name, []).append(vectors.cpu())
        return {name: torch.cat(vectors) for name, vectors in parts.items()}

    def _readout(self, fit: Tensor, test: Tensor) -> dict[str, Any]:
        """Held-out top-1 of the closed-form readout: among all candidates, and among those of the frame's task."""
        own = self.questions.fit
        readout = choose_readout(fit, own.labels, self.questions.candidates, own.episodes)
        return {**self._scores(readout(test)), "penalty": readout.penalty}

    def _scores(self, embeddings: Tensor) -> dict[str, Any]:
        """Held-out top-1 of embeddings (N, d_t) of the test frames."""
        embeddings = torch.nn.functional.normalize(embeddings, dim=-1)
        asked, candidates = self.questions.test, self.questions.candidates

        def within(task: int) -> float:
            """Top-1 of a task's frames, among its own subgoals."""
            own = asked.tasks == task
            return top1(embeddings[own], asked.labels[own], candidates, asked.allowed[own])

        return {
            "all": top1(embeddings, asked.labels, candidates),
            "own_task": top1(embeddings, asked.labels, candidates, asked.allowed),
            "by_task": {self.tasks[int(task)]: within(task) for task in np.unique(asked.tasks)},
        }

    # -- actions ---------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def action_loss(self, policy: MemobenchMemPolicy, before: Any) -> float:
        """The policy's own loss of its actions on held-out frames; with flow matching, of the same noise for all."""
        losses, sizes = [], []
        for number, batch in self._batches(policy, before, self.questions.test):
            torch.manual_seed(10_000 + number)
            _, logged = policy.forward(batch)
            losses.append(logged["action_loss"])
            sizes.append(len(batch["action"]))
        return float(np.average(losses, weights=sizes))

    def _batches(
        self, policy: MemobenchMemPolicy, before: Any, asked: Asked
    ) -> Iterator[tuple[int, dict[str, Tensor]]]:
        """Numbered batches of these frames, as LeRobot's loader and the preprocessor make them."""
        tasks = self.meta.tasks.index.tolist()
        recorded = RecordedSamples(self.frames, tasks, policy.config.action_delta_indices)
        for first in range(0, len(asked.indices), EVALUATION_BATCH):
            part = asked.indices[first : first + EVALUATION_BATCH].tolist()
            samples = default_collate([recorded[number] for number in part])
            yield first // EVALUATION_BATCH, before(samples)
