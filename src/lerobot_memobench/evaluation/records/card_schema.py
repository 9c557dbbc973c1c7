"""Of which types is a result card? What its parts mean, `engine.card` says."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from annotated_types import Ge, Le, MinLen

from lerobot_memobench.envs.episode_log import CheckpointRecord, Outcome, Protocol, WholeProtocol
from lerobot_memobench.io import LARGEST, Count, Name, Whole


class PolicySettings(TypedDict, total=False):
    """Whatever a policy can be set to; what reports and `memobench rerun` read of it."""

    n_action_steps: Count | None
    perception: str | None
    eyes: str | None


class Policy(TypedDict, total=False):
    """What identifies a policy; {} where nothing is known of it."""

    type: Name | None
    seed: Whole | None
    settings: PolicySettings
    sha256: str | None
    eyes_sha256: str


class Checkpoint(TypedDict):
    """Where a policy's weights were, and the hash of each file."""

    path: str
    revision: NotRequired[str | None]
    files: NotRequired[dict[str, str]]


BatchSize = Annotated[int, Ge(1), Le(LARGEST)]


class Start(TypedDict):
    """One start of the evaluation, on one machine."""

    command: list[str]
    batch_size: BatchSize
    versions: dict[str, str]
    git_commit: str | None
    machine: dict[str, Any]
    gl: dict[str, Any]
    times: NotRequired[Count]


class Found(Outcome):
    """What an episode came to."""

    task: Name
    episode: Whole
    memory_type: NotRequired[str]
    success: NotRequired[bool]
    checkpoints: NotRequired[list[CheckpointRecord]]


class Told(TypedDict, total=False):
    """What is taken from a start where the rest of it does not matter."""

    command: list[str]
    batch_size: BatchSize


class Card(TypedDict):
    """What reports take from a card: all but the protocol may be absent."""

    protocol: Protocol
    policy: NotRequired[Policy]
    runs: NotRequired[list[Told]]


class WholeCard(TypedDict):
    """A card from which an evaluation is gone on with, merged or repeated."""

    format: Literal[1]
    written: NotRequired[str]
    protocol: WholeProtocol
    policy: Policy
    checkpoint: Checkpoint | None
    trained_on: dict[str, Any] | None
    task_files: dict[str, str]
    flags: list[str]
    shard: str | None
    runs: Annotated[list[Start], MinLen(1)]
    episodes: list[Found]
