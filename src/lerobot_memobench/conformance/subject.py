"""The checked policy: made or loaded as by ``lerobot train``, driven as by ``lerobot eval``."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.overrides import TorchFunctionMode

from lerobot_memobench.commands.command_line import (
    PATH,
    SHORT_FORMS,
    parse_words,
    policy_config,
    read_words,
    setting_kind,
)
from lerobot_memobench.conformance.streams import (
    EXECUTION_FRAMES,
    Stream,
    as_float,
    read_streams,
    task_of_texts,
    write_streams,
)
from lerobot_memobench.constants import CLOCK, MEMORY_POLICY
from lerobot_memobench.datasets.frames import read_frame_table
from lerobot_memobench.datasets.layout import OBJECTS as OBJECTS_COLUMN
from lerobot_memobench.datasets.layout import objects_column
from lerobot_memobench.envs.observations import obs_type_of, reads_prompt
from lerobot_memobench.envs.settings import BOTH, OBJECTS, PIXELS
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.checkpoint import check_device, check_weights, quiet
from lerobot_memobench.policies.compatibility import chosen_convention, trained_convention
from lerobot_memobench.rollouts.rollout import ActionQueue
from lerobot_memobench.sim.convention import UPRIGHT, convention_of
from lerobot_memobench.training.command import take_training_options

REPLAN = 3  # default actions per chunk, so that a short stream has several chunks
STREAMS = 3  # number of episodes: a row, and two others in its batch
KEYS = ("policy", "dataset", "obs_type")

Actions = NDArray[np.float32]  # actions (calls, rows, A) of a policy


@dataclass
class Subject:
    """A policy with its processors, a dataset, and the observations of its episodes in a rollout."""

    name: str
    policy: Any
    preprocessor: Any
    postprocessor: Any
    dataset: Any  # samples as in training, with the policy's delta timestamps
    streams: list[Stream]  # `STREAMS` episodes
    cameras: list[str]  # of the dataset
    numbers: NDArray[np.int64]  # (N,) index in ``dataset`` of each frame of the named dataset

    def roll(self, streams: Sequence[Stream], *, equal_noise: bool = True, sparing: bool = False) -> Actions:
        """Reset the policy and let it act on streams, one row each, until the longest ends.

        Args:
            equal_noise: let every row and call draw the same noise, so that actions can be compared.
            sparing: repeat earlier images and objects if the policy does not need new ones, and everything except
                the clock if its next action is planned already, as evaluations do.
        """
        actions, answers = ActionQueue(self.policy), []
        last: dict[str, Any] = {}
        actions.reset()
        with EqualNoise() if equal_noise else nullcontext():
            for call in range(max(len(stream) for stream in streams)):
                shown = [stream.at(call) for stream in streams]
                batch: dict[str, Any] = {key: torch.stack([frame[key] for frame in shown]) for key in shown[0]}
                batch["task"] = [stream.task for stream in streams]
                begins = any(call in (0, stream.start) for stream in streams)
                costly = [key for key in batch if key.startswith(("observation.images", OBJECTS_COLUMN))]
                if sparing and not begins and actions.has_planned_action():
                    batch |= {key: last[key] for key in batch if key not in CLOCK}
                elif sparing and not begins and not actions.needs_observation():
                    batch |= {key: last[key] for key in costly}
                last = batch
                action = self.postprocessor(actions.select(self.preprocessor(batch)))
                answers.append(action.to("cpu", torch.float32).numpy().copy())
        return np.stack(answers)

    def predict(self, stream: Stream, calls: Sequence[int]) -> Actions:
        """Return the first actions (calls, A) of the chunks predicted for a training batch of these frames."""
        from lerobot.utils.collate import lerobot_collate_fn

        batch = lerobot_collate_fn([self.dataset[int(self.numbers[stream.indices[call]])] for call in calls])
        batch |= {key: as_float(batch[key]) for key in self.cameras if key in batch}
        self.policy.reset()
        with EqualNoise(), torch.inference_mode():
            chunks = self.policy.predict_action_chunk(self.preprocessor(batch))
            first: Tensor = self.postprocessor(chunks[:, 0])
        return first.to("cpu", torch.float32).numpy()


class EqualNoise(TorchFunctionMode):
    """Make random tensors equal at every call, and along every axis except the last one.

    The noise of a row then depends neither on the number of rows nor on earlier draws.
    """

    DRAWS = (torch.randn, torch.randn_like, torch.normal, torch.rand, torch.rand_like, Tensor.normal_, Tensor.uniform_)

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        drawn = function(*args, **(kwargs or {}))
        if function in self.DRAWS:
            width = drawn.shape[-1] if drawn.dim() > 1 else 1
            drawn.copy_(torch.rand(width, generator=torch.Generator().manual_seed(width)).to(drawn))
        return drawn


def load_subject(words: Sequence[str], folder: Path) -> Subject:
    """Make or load a policy and its observations.

    Args:
        words: ``policy=…``, settings of it, ``dataset=…``, ``obs_type=…``, as ``lerobot train`` takes them.
        folder: empty, for a dataset if none is named.
    """
    _, obs_type, user_settings = take_training_options(parse_words(words))
    short = [key for key, fields in SHORT_FORMS["train"].items() if fields[0].startswith("policy.")]
    for key in user_settings:
        if key.partition(".")[0] not in KEYS and key not in short:
            raise MemobenchError(f"memobench conformance has no setting {key!r}, {nearest(key, [*KEYS, *short])}")
    settings = read_words("train", user_settings)
    path = settings.get(f"policy.{PATH}")
    if "dataset" not in user_settings:
        policy = policy_config(settings)
        convention = None if path is None or policy is None else trained_convention(path, policy)[0]
        task = task_of_texts(getattr(policy, "subgoals", None) or {})
        dataset = write_streams(folder / "streams", task=task, convention=convention or UPRIGHT)
        settings = read_words("train", {**user_settings, "dataset": str(dataset)})
    check_device(settings.get("policy.device"))
    if not torch.cuda.is_available():
        settings = settings.default("policy.device", "cpu")
    if setting_kind(settings, "policy.n_action_steps") is not None:
        settings = settings.default("policy.n_action_steps", REPLAN)
    config: Any = policy_config(settings)
    if config is None:
        raise MemobenchError("name a policy: a checkpoint folder, policy=memobench_strict, or a type (policy=act)")
    data = str(settings.get("dataset.repo_id")), settings.get("dataset.root")
    errors = []
    for kind in [obs_type] if obs_type else [None, OBJECTS, BOTH]:
        try:
            with quiet():
                # A copy, because `make_policy` sets the features; and one call, because some raise only there.
                subject = _built(copy.deepcopy(config), *data, kind, folder / f"view {kind}")
                subject.roll([subject.streams[0].until(subject.streams[0].start)])
            return subject
        except MemobenchError:
            raise
        except Exception as error:  # a policy may raise anything where it lacks an input
            errors.append(error)
    raise MemobenchError(
        f"{config.type} does not act on this benchmark's observations: {type(errors[0]).__name__}: {errors[0]}; let it "
        "read inputs that the dataset has, or choose them by obs_type="
    ) from errors[0]


def _built(config: Any, repository: str, root: str | None, obs_type: str | None, view: Path) -> Subject:
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets import LeRobotDataset
    from lerobot.datasets.factory import make_dataset
    from lerobot.policies import make_policy, make_pre_post_processors

    from lerobot_memobench.training.data import open_datasets, open_training
    from lerobot_memobench.training.trainer import needs_view, view_options, write_view

    raw = LeRobotDataset(repository, root=root)
    if not set(CLOCK) <= set(raw.meta.features):
        raise MemobenchError(f"{raw.root} has no {CLOCK[0]}; name a dataset of `memobench generate`, or none")
    path = config.pretrained_path
    if path is not None:
        chosen_convention(str(path), config, convention_of(raw.meta.features))
        check_weights(path, config)
    whole, numbers = TrainPipelineConfig(DatasetConfig(repository, root=root), policy=config), np.arange(raw.num_frames)
    torch.manual_seed(0)
    if config.type == MEMORY_POLICY:
        training = open_training(whole, open_datasets(whole))
        policy, (before, after), dataset = training.policy, training.processors, training.samples()
        policy.open_loop = True  # replayed hands do not follow its actions
    else:
        options = view_options(config, raw.meta.features, None, obs_type)
        if not options.prompts:
            numbers = np.cumsum(read_frame_table(Path(raw.root)).acts) - 1  # the view lacks the other frames
        if needs_view(raw.meta.features, options):
            write_view(Path(raw.root), view, options)
            whole.dataset.root = str(view)
        dataset = make_dataset(whole)
        policy = make_policy(config, ds_meta=dataset.meta)
        loaded = {} if path is None else {"preprocessor_overrides": {"device_processor": {"device": config.device}}}
        before, after = make_pre_post_processors(config, path, dataset_stats=dataset.meta.stats, **loaded)
    if path is None:
        _draw_zero_weights(policy)
    policy.eval()
    shown = obs_type_of(config) or PIXELS
    objects = objects_column(raw.meta.features) if shown in (OBJECTS, BOTH) else None
    episodes = read_streams(raw, shown in (PIXELS, BOTH), objects, reads_prompt(config), EXECUTION_FRAMES)
    streams = [*itertools.islice(episodes, STREAMS)]
    if len(streams) < STREAMS:
        raise MemobenchError(f"{raw.root} has {len(streams)} episodes; name a dataset of at least {STREAMS}, or none")
    return Subject(config.type, policy, before, after, dataset, streams, raw.meta.camera_keys, numbers)


def _draw_zero_weights(policy: Any) -> None:
    # Behind weights that are initialised to zero, a memory would have no effect.
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weights in policy.parameters():
            if weights.requires_grad and not weights.any():
                weights.copy_(0.1 * torch.randn(weights.shape, generator=generator))
