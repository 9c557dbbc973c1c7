"""The alignment study: the same small policy trained with each objective, and what its memory then knows.

Everything is held equal but the objective: dataset, split, seeds (weights, batches, noise), updates. A run trains
through the policy's own ``forward``, its preprocessor, optimiser, schedule and weight average, as ``lerobot-train``
does; only the frames come from memory-mapped arrays that were decoded once, because twelve runs would otherwise
decode the same videos twelve times. The averaged weights are then frozen and asked, on episodes never trained on,
which subgoal is active (:mod:`retrieval`) and how far their actions are off.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import MemoryCache, dataset_fingerprint
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import masked_mean
from lerobot_memobench.policies.memobench_mem.caching import cache_dataset
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import GatherMemoryProcessorStep
from lerobot_memobench.studies.alignment.retrieval import choose_readout, top1

ALIGNMENTS = ("none", "semantic", "contrastive", "framewise")
EVALUATION_BATCH = 32
PROMPT_LENGTH = 48
"""Tokens of a prompt: the catalogue's longest instruction and eight state values take 45 words."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class StudySettings:
    """What a study does; two studies with equal settings and dataset give equal numbers."""

    steps: int = 300
    batch_size: int = 16
    seeds: int = 3
    held_out: int = 2
    """Episodes of each task, its last ones, that are never trained on."""
    level: str = "intermediate"
    size: str = "tiny"
    chunk: int = 20
    """Actions per prediction; the full recipe's 50 would take half as long again on a CPU."""
    frames_per_episode: int = 24
    """Execution frames, evenly spaced, on which readouts are fitted and tested."""
    action_batches: int = 8
    """Batches of held-out frames on which the action loss is measured, each with fixed noise."""

    def config(self, align: str, features: dict[str, PolicyFeature] | None = None) -> MemobenchMemConfig:
        """The policy that is trained; of the dataset's ``features`` it sees the state and the remembered camera."""
        camera = MemobenchMemConfig.memory_camera
        seen = {key: feature for key, feature in (features or {}).items() if key in (camera, "observation.state")}
        return MemobenchMemConfig(
            input_features=seen,
            size=self.size,
            align=align,
            subgoal_level=self.level,
            device="cpu",
            push_to_hub=False,
            chunk_size=self.chunk,
            n_action_steps=self.chunk,
            tokenizer_max_length=PROMPT_LENGTH,
        )


class Frames:
    """A dataset's frames as arrays: images decoded once into ``folder``, everything else in memory."""

    def __init__(self, root: Path, folder: Path, say: Say) -> None:
        import pyarrow.parquet as pq

        self.root = root
        self.meta = LeRobotDatasetMetadata(root.name, root=root)
        columns = ["index", "observation.state", "action", "task_index"]
        table = pq.read_table(root / "data", columns=columns).sort_by("index")
        self.states = np.array(table.column("observation.state").to_pylist(), dtype=np.float32)
        self.actions = np.array(table.column("action").to_pylist(), dtype=np.float32)
        self.tasks = table.column("task_index").to_numpy()
        self.task_texts = {int(row.task_index): str(text) for text, row in self.meta.tasks.iterrows()}
        starts = [int(first) for first in self.meta.episodes["dataset_from_index"]]
        self.episodes = np.array([*starts, len(self.states)])
        self.features = dataset_to_policy_features(self.meta.features)
        self.images = {
            key: self._decode(key, folder, say)
            for key in self.meta.camera_keys
            if key == MemobenchMemConfig.memory_camera
        }

    def _decode(self, key: str, folder: Path, say: Say) -> np.ndarray:
        from lerobot_memobench.datasets.memory_cache.decoding import frame_reader

        path = folder / f"{key}-{dataset_fingerprint(self.root, key)}.npy"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            height, width, channels = self.meta.features[key]["shape"]
            part = path.with_suffix(".part")
            shape = (len(self.states), channels, height, width)
            store = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
            read = frame_reader(self.root, key)
            for episode, (first, last) in enumerate(zip(self.episodes[:-1], self.episodes[1:], strict=True)):
                store[first:last] = (read(episode, list(range(last - first))) * 255).round().to(torch.uint8).numpy()
                say(f"decoded {key}, episode {episode + 1} of {len(self.episodes) - 1}")
            store.flush()
            os.replace(part, path)
        return np.load(path, mmap_mode="r")

    def batch(self, indices: np.ndarray, chunk: int) -> dict[str, Any]:
        """What LeRobot's loader gives for frames (B,) of the dataset, with chunks of ``chunk`` actions."""
        episode = np.searchsorted(self.episodes, indices, "right") - 1
        wanted = indices[:, None] + np.arange(chunk)
        last = self.episodes[episode + 1][:, None] - 1
        found: dict[str, Any] = {
            key: torch.from_numpy(images[indices].astype(np.float32) / 255.0) for key, images in self.images.items()
        }
        return found | {
            "observation.state": torch.from_numpy(self.states[indices]),
            "action": torch.from_numpy(self.actions[np.minimum(wanted, last)]),
            "action_is_pad": torch.from_numpy(wanted > last),
            "index": torch.from_numpy(indices),
            "episode_index": torch.from_numpy(episode),
            "task": [self.task_texts[int(number)] for number in self.tasks[indices]],
        }


@dataclass(frozen=True)
class Split:
    """Frames of the dataset by their use, as global indices.

    Attributes:
        train: every frame of the training episodes.
        fit, test: execution frames of training and of held-out episodes, evenly spaced.
        episode: (N,) episode of every frame.
    """

    train: np.ndarray
    fit: np.ndarray
    test: np.ndarray
    episode: np.ndarray


def split_frames(frames: Frames, phase: np.ndarray, settings: StudySettings) -> Split:
    """Hold out the last episodes of every task.

    Raises:
        MemobenchError: a task has too few episodes.
    """
    episode = np.repeat(np.arange(len(frames.episodes) - 1), np.diff(frames.episodes))
    task_of = np.array([frames.tasks[first] for first in frames.episodes[:-1]])
    held = np.zeros(len(task_of), dtype=bool)
    for task in np.unique(task_of):
        own = np.flatnonzero(task_of == task)
        if len(own) <= settings.held_out:
            raise MemobenchError(
                f"the task '{frames.task_texts[int(task)]}' has {len(own)} episodes and {settings.held_out} are to be "
                "held out; generate more, or lower --held-out"
            )
        held[own[-settings.held_out :]] = True

    def spaced(episodes: np.ndarray) -> np.ndarray:
        chosen = []
        for number in episodes:
            acting = np.flatnonzero((episode == number) & (phase == 1))
            places = np.linspace(0, len(acting) - 1, min(settings.frames_per_episode, len(acting)))
            chosen.append(acting[places.round().astype(int)])
        return np.concatenate(chosen)

    return Split(
        train=np.flatnonzero(~held[episode]),
        fit=spaced(np.flatnonzero(~held)),
        test=spaced(np.flatnonzero(held)),
        episode=episode,
    )


@dataclass
class Asked:
    """Frames with their histories and right answers, for one split.

    Attributes: indices (N,); labels (N,) candidate that is right; episodes (N,); tasks (N,); allowed (N, C) candidates
    of the frame's own task.
    """

    indices: np.ndarray
    labels: Tensor
    episodes: Tensor
    tasks: np.ndarray
    allowed: Tensor


class Study:
    """A dataset made ready, and runs on it."""

    def __init__(self, root: Path, out: Path, settings: StudySettings, say: Say) -> None:
        self.root, self.out, self.settings, self.say = root, out, settings, say
        self._check_folder()
        self.frames = Frames(root, out / "frames", say)
        config = settings.config("semantic")
        folder = cache_dataset(root, config, progress=lambda done, count: say(f"memory cache: {done} of {count}"))
        meta = json.loads((folder / "meta.json").read_text())
        keys = {key: meta[key] for key in ("frames_key", "camera", "stride", "texts_key")}
        self.cache = MemoryCache.open(root, folder.name, **keys)
        self.split = split_frames(self.frames, self.cache.phase, settings)
        rows = self.cache.text_rows(settings.level)
        used = np.unique(rows[np.concatenate([self.split.fit, self.split.test])])
        self.candidates = self.cache.text_embeddings[torch.from_numpy(used.astype(np.int64))]
        self.texts = [self.cache.texts[row] for row in used]
        number = np.full(len(self.cache.texts), -1)
        number[used] = np.arange(len(used))
        by_task = np.zeros((int(self.frames.tasks.max()) + 1, len(used)), dtype=bool)
        for part in (self.split.fit, self.split.test):
            by_task[self.frames.tasks[part], number[rows[part]]] = True
        self.fit, self.test = (
            Asked(
                indices=part,
                labels=torch.from_numpy(number[rows[part]]),
                episodes=torch.from_numpy(self.split.episode[part]),
                tasks=self.frames.tasks[part],
                allowed=torch.from_numpy(by_task[self.frames.tasks[part]]),
            )
            for part in (self.split.fit, self.split.test)
        )
        self.gather = GatherMemoryProcessorStep(frames=config.memory_frames, align="none", cache=self.cache)

    def _check_folder(self) -> None:
        """A folder belongs to one dataset and one set of settings; more seeds may be added to it."""
        wanted = {"dataset": dataset_fingerprint(self.root, MemobenchMemConfig.memory_camera), **asdict(self.settings)}
        del wanted["seeds"]
        path = self.out / "settings.json"
        if path.is_file():
            there = json.loads(path.read_text())
            different = [key for key in wanted if there.get(key) != wanted[key]]
            if different:
                raise MemobenchError(
                    f"{self.out} holds a study with another {', '.join(different)}; name another --out, or give "
                    "the settings in its settings.json"
                )
        self.out.mkdir(parents=True, exist_ok=True)
        _write_json(path, wanted)

    # -- runs ------------------------------------------------------------------------------------------------------

    def run(self, align: str, seed: int) -> dict[str, Any]:
        """Train and measure one policy; a finished run is read back."""
        path = self.out / "runs" / f"{align}-{seed}.json"
        if path.is_file():
            found: dict[str, Any] = json.loads(path.read_text())
            return found
        started = time.process_time()
        policy, before, after, curve = self._train(align, seed)
        trained = time.process_time()
        assert policy._average is not None
        policy.eval()
        with policy._average.applied():
            found = {"align": align, "seed": seed, **self._measure(policy, before)}
        if seed == 0:  # for `lerobot eval`
            for part in (policy, before, after):
                part.save_pretrained(self.out / "checkpoints" / align / "pretrained_model")
        found |= {
            "curve": curve,
            "train_cpu_s": round(trained - started, 1),
            "measure_cpu_s": round(time.process_time() - trained, 1),
        }
        path.parent.mkdir(exist_ok=True)
        _write_json(path, found)
        return found

    def _train(self, align: str, seed: int) -> tuple[MemobenchMemPolicy, Any, Any, list[dict[str, float]]]:
        """Train one policy; returns it, its processors, and what was logged every twentieth of the run."""
        settings, config = self.settings, self.settings.config(align, self.frames.features)
        torch.manual_seed(seed)
        policy = make_policy(config, ds_meta=self.frames.meta)
        before, after = make_pre_post_processors(config, dataset_stats=self.frames.meta.stats)
        preset = config.get_optimizer_preset()
        optimizer = preset.build(policy.get_optim_params())
        schedule = config.get_scheduler_preset().build(optimizer, settings.steps)
        policy.train()
        # The order of batches and the noise of the flow are the same for every objective.
        rng = np.random.default_rng(seed)
        torch.manual_seed(1_000 + seed)
        curve: list[dict[str, float]] = []
        window: list[dict[str, float]] = []
        every = max(1, settings.steps // 20)
        for step in range(1, settings.steps + 1):
            indices = rng.choice(self.split.train, settings.batch_size, replace=False)
            loss, logged = policy.forward(before(self.frames.batch(indices, config.chunk_size)))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), preset.grad_clip_norm)
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
            policy.update()
            window.append({key: value for key, value in logged.items() if isinstance(value, float)})
            if step % every == 0:
                means = {key: float(np.mean([entry[key] for entry in window])) for key in window[-1]}
                curve.append({"step": step, **means})
                window = []
                self.say(f"{align}, seed {seed}: step {step} of {settings.steps}, loss {means['loss']:.3f}")
        return policy, before, after, curve

    # -- measuring -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _vectors(self, policy: MemobenchMemPolicy, asked: Asked) -> dict[str, Tensor]:
        """Vectors (N, D) of each frame: ``memory``, ``last_frame``, and with a head its ``head`` embedding (N, d_t)."""
        parts: dict[str, list[Tensor]] = {}
        for memory, mask, last in self._memories(policy, asked):
            found = {"memory": masked_mean(memory, mask), "last_frame": masked_mean(memory, last)}
            head: Any = policy.alignment
            if policy.config.align == "framewise":
                found["head"] = head.project(found["last_frame"])
            elif head is not None:
                found["head"] = head.embed(memory, mask)
            for name, vectors in found.items():
                parts.setdefault(name, []).append(vectors)
        return {name: torch.cat(vectors) for name, vectors in parts.items()}

    def _memories(self, policy: MemobenchMemPolicy, asked: Asked) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Memory tokens (n, L, d_m), their mask (n, L), and the mask of the newest frame's alone, in parts."""
        for first in range(0, len(asked.indices), EVALUATION_BATCH):
            part = self.gather.gather(self.cache, asked.indices[first : first + EVALUATION_BATCH].tolist())
            frames = part["memory.mask"]
            memory, mask = policy.model.memory(part["memory.tokens"], part["memory.steps"], frames)
            newest = torch.zeros_like(frames)
            newest[torch.arange(len(frames)), frames.sum(dim=1) - 1] = True
            yield memory, mask, newest.repeat_interleave(memory.shape[1] // frames.shape[1], dim=1)

    def _readout_scores(self, fit: Tensor, test: Tensor) -> dict[str, Any]:
        """Held-out top-1 of the closed-form readout: among all candidates, and among those of the frame's task."""
        readout = choose_readout(fit, self.fit.labels, self.candidates, self.fit.episodes)
        return {**self._scores(readout(test)), "penalty": readout.penalty}

    def _scores(self, embeddings: Tensor) -> dict[str, Any]:
        embeddings = torch.nn.functional.normalize(embeddings, dim=-1)
        asked = self.test
        by_task = {
            self.frames.task_texts[int(task)]: top1(
                embeddings[asked.tasks == task],
                asked.labels[asked.tasks == task],
                self.candidates,
                asked.allowed[asked.tasks == task],
            )
            for task in np.unique(asked.tasks)
        }
        return {
            "all": top1(embeddings, asked.labels, self.candidates),
            "own_task": top1(embeddings, asked.labels, self.candidates, asked.allowed),
            "by_task": by_task,
        }

    def _measure(self, policy: MemobenchMemPolicy, before: Any) -> dict[str, Any]:
        fit, test = self._vectors(policy, self.fit), self._vectors(policy, self.test)
        found: dict[str, Any] = {name: self._readout_scores(fit[name], test[name]) for name in ("memory", "last_frame")}
        if "head" in test:
            found["head"] = self._scores(test["head"])
        return found | {"action_loss": self._action_loss(policy, before)}

    @torch.no_grad()
    def _action_loss(self, policy: MemobenchMemPolicy, before: Any) -> float:
        """Flow-matching loss on held-out execution frames, with the same noise and times for every policy."""
        count = self.settings.action_batches * EVALUATION_BATCH
        places = np.linspace(0, len(self.test.indices) - 1, min(count, len(self.test.indices))).round().astype(int)
        chosen = self.test.indices[places]
        losses, sizes = [], []
        for number, first in enumerate(range(0, len(chosen), EVALUATION_BATCH)):
            part = chosen[first : first + EVALUATION_BATCH]
            torch.manual_seed(10_000 + number)
            _, logged = policy.forward(before(self.frames.batch(part, policy.config.chunk_size)))
            losses.append(logged["action_loss"])
            sizes.append(len(part))
        return float(np.average(losses, weights=sizes))

    @torch.no_grad()
    def baselines(self) -> dict[str, Any]:
        """What needs no training: chance, the commonest subgoal, the frozen tower's tokens, and random weights."""
        path = self.out / "runs" / "baselines.json"
        if path.is_file():
            read: dict[str, Any] = json.loads(path.read_text())
            return read
        common = torch.bincount(self.fit.labels, minlength=len(self.candidates))
        in_task = torch.where(self.test.allowed, common, -1)
        found: dict[str, Any] = {
            "chance": {
                "all": 1.0 / len(self.candidates),
                "own_task": float((1.0 / self.test.allowed.sum(dim=1)).mean()),
            },
            "commonest": {
                "all": float((self.test.labels == common.argmax()).double().mean()),
                "own_task": float((self.test.labels == in_task.argmax(dim=1)).double().mean()),
            },
        }
        raw = {name: self._raw(asked) for name, asked in (("fit", self.fit), ("test", self.test))}
        for name, column in (("tower_history", 0), ("tower_last_frame", 1)):
            found[name] = self._readout_scores(raw["fit"][column], raw["test"][column])
        torch.manual_seed(0)
        policy = make_policy(self.settings.config("none", self.frames.features), ds_meta=self.frames.meta)
        fit, test = self._vectors(policy, self.fit), self._vectors(policy, self.test)
        for name in ("memory", "last_frame"):
            found[f"untrained_{name}"] = self._readout_scores(fit[name], test[name])
        path.parent.mkdir(exist_ok=True)
        _write_json(path, found)
        return found

    def _raw(self, asked: Asked) -> tuple[Tensor, Tensor]:
        """Mean of the tower's own tokens over the history, and over the last frame: (N, D) each, without a clock."""
        history, newest = [], []
        for index in asked.indices.tolist():
            part = self.gather.gather(self.cache, [index])
            tokens = part["memory.tokens"][0][part["memory.mask"][0]].float()
            history.append(tokens.mean(dim=(0, 1)))
            newest.append(tokens[-1].mean(dim=0))
        return torch.stack(history), torch.stack(newest)


def _write_json(path: Path, value: Any) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(value, indent=1))
    os.replace(part, path)
