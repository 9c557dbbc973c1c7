"""A memory policy to start from: it attends to a window of its own past, demonstration prompt included.

It remembers the frames t, t - stride, t - 2 stride, … of its episode. It reads no instruction, so train it on one task:

    lerobot train policy=window dataset=data policy.push_to_hub=false
    lerobot eval env=memobench policy=outputs/train/<run>/checkpoints/last/pretrained_model tasks=<task>
"""

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import make_default_policy_processor_steps, make_policy_processor_pipelines
from torch import nn

STATE, OBJECTS, PHASE, STEP = (f"observation.{name}" for name in ("state", "environment_state", "phase", "step"))


@PreTrainedConfig.register_subclass("window")
@dataclass
class WindowConfig(PreTrainedConfig):
    """Settings of the policy; `frames` x `stride` control steps are the span that it remembers."""

    reads_prompt: ClassVar[bool] = True  # the prompt is shown step by step, and its frames are trained on
    frames: int = 16
    stride: int = 20
    width: int = 128
    chunk_size: int = 16
    n_action_steps: int = 8
    lr: float = 3e-4
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.IDENTITY,
            "VISUAL": NormalizationMode.IDENTITY,
        }
    )

    @property
    def observation_delta_indices(self):
        """LeRobot loads these frames for a sample and repeats the episode's first frame for earlier indices."""
        return [-age * self.stride for age in reversed(range(self.frames))]

    @property
    def action_delta_indices(self):
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self):
        return None

    def validate_features(self):
        for clock in (PHASE, STEP):  # they reach the policy all the same, and as no input they are not normalised
            self.input_features.pop(clock, None)

    def get_optimizer_preset(self):
        return AdamWConfig(lr=self.lr)

    def get_scheduler_preset(self):
        return None


class Row:
    """State of one environment of a rollout: tokens of its past, planned actions, its last phase and step."""

    def __init__(self, span):
        self.past, self.queue, self.clock = deque(maxlen=span), deque(), None


class WindowPolicy(PreTrainedPolicy):
    """A token per remembered frame, attention over them, and a chunk of actions read off the present one."""

    config_class, name = WindowConfig, "window"

    def __init__(self, config, **_):
        super().__init__(config)
        config.validate_features()
        width, self.actions = config.width, config.output_features["action"].shape[0]
        self.numbers = [key for key in (STATE, OBJECTS) if key in config.input_features]
        self.from_numbers = nn.Linear(sum(config.input_features[key].shape[0] for key in self.numbers), width)
        self.from_images = nn.ModuleList(  # one for each camera; none where there are no images
            nn.Sequential(
                *(nn.Conv2d(3, 16, 8, 4), nn.ReLU(), nn.Conv2d(16, 32, 4, 2), nn.ReLU()),
                *(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(32 * 16, width)),
            )
            for _ in config.image_features
        )
        self.phase, self.age = nn.Embedding(2, width), nn.Embedding(config.frames, width)
        layer = nn.TransformerEncoderLayer(width, 4, 4 * width, dropout=0.0, batch_first=True)
        self.attend = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)
        self.act = nn.Linear(width, config.chunk_size * self.actions)
        self.reset()

    def get_optim_params(self):
        return self.parameters()

    def tokens(self, batch):
        """Return a token per frame: (B, frames, width) of a training batch, (B, width) of a rollout's observation."""
        tokens = self.from_numbers(torch.cat([batch[key] for key in self.numbers], -1)) + self.phase(
            batch[PHASE].long()
        )
        for key, encode in zip(self.config.image_features, self.from_images, strict=True):
            tokens = tokens + encode(batch[key].flatten(0, -4)).reshape(tokens.shape)
        return tokens

    def plan(self, tokens, padding):
        """Return chunks (B, chunk_size, A) of histories (B, frames, width), oldest frame first."""
        found = self.attend(tokens + self.age.weight, src_key_padding_mask=padding)
        return self.act(found[:, -1]).unflatten(-1, (-1, self.actions))

    # -- training: LeRobot brings the history of each sample

    def predict_action_chunk(self, batch, **_):
        return self.plan(self.tokens(batch), batch[f"{STATE}_is_pad"])

    def forward(self, batch):
        errors = (self.predict_action_chunk(batch) - batch["action"]).abs().mean(-1)
        mine = (batch[PHASE][:, -1:] == 1) & ~batch["action_is_pad"]  # in a prompt the actions are not the policy's
        loss = (errors * mine).sum() / mine.sum().clamp(min=1)
        return loss, {"l1": loss.item()}

    # -- a rollout: the policy keeps the history of each row

    def reset(self):
        self.rows = []

    @torch.no_grad()
    def select_action(self, batch, **_):
        clocks = list(zip(batch[PHASE].tolist(), batch[STEP].tolist(), strict=True))
        span = (self.config.frames - 1) * self.config.stride + 1
        self.rows = self.rows or [Row(span) for _ in clocks]
        for row, token, clock in zip(self.rows, self.tokens(batch), clocks, strict=True):
            if clock[1] == -1 or clock != row.clock:  # -1: strict, no clock; a row that is over repeats its frame
                row.past.append(token)
            if row.clock is None or clock[0] != row.clock[0]:  # a phase begins: earlier plans are void
                row.queue.clear()
            row.clock = clock
        acting = [row for row in self.rows if row.clock[0] == 1]
        planning = [row for row in acting if not row.queue]
        if planning:
            chunks = self.plan(*(torch.stack(part) for part in zip(*map(self.window, planning), strict=True)))
            for row, chunk in zip(planning, chunks, strict=True):
                row.queue.extend(chunk[: self.config.n_action_steps])
        none = batch[STATE].new_zeros(self.actions)
        return torch.stack([row.queue.popleft() if row in acting else none for row in self.rows])

    def window(self, row):
        """Return what `observation_delta_indices` loads of a dataset: tokens (frames, width), and which are padding."""
        places = [len(row.past) - 1 + delta for delta in self.config.observation_delta_indices]
        tokens = torch.stack([row.past[max(place, 0)] for place in places])
        return tokens, torch.tensor([place < 0 for place in places], device=tokens.device)


def make_window_pre_post_processors(config, dataset_stats=None):
    """Return LeRobot's usual steps before and after the policy."""
    steps = make_default_policy_processor_steps(config, dataset_stats)
    before = [steps.rename_observations, steps.add_batch_dim, steps.to_device, steps.normalize]
    return make_policy_processor_pipelines(input_steps=before, output_steps=[steps.unnormalize, steps.to_cpu])
