"""What a dataset says of an episode as a whole: its task, seed, placement, hashes.

It stands twice. In ``meta/episodes``, where ``LeRobotDataset(…, episode_filter=…)`` looks; and as JSON in the frames'
column ``episode_info``, at each episode's first frame, because LeRobot's dataset tools (``lerobot-edit-dataset``) keep
the frames' columns and drop every column of ``meta/episodes`` and every file that LeRobot does not know.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Malformed, first_fault, parsed

EPISODE_INFO = "episode_info"
"""The frames' column; empty but at an episode's first frame."""


class EpisodeRecord(BaseModel):
    """An episode as a whole.

    Attributes:
        seed: of the scene; -1 where it is not known.
        key_frames: one per checkpoint, -1 where it was not completed.
        fixture_poses: fixture to position and quaternion wxyz.
        digest: sha256 of states, actions and labels; None in datasets from before there was one.
        versions: of the packages on which the numbers depend, where they are known.
    """

    model_config = ConfigDict(frozen=True)

    task_name: str
    memory_type: str
    family: str = ""
    operations: str = ""
    seed: int
    referent: str = "fixed"
    variant: int
    success: bool | None = None
    exec_start_index: int
    key_frames: list[int]
    scene_hash: str | None = None
    fixture_poses: dict[str, list[float]] | None = None
    digest: str | None = None
    versions: dict[str, str] | None = None

    def in_frames(self) -> str:
        """Return the text of the first frame's column."""
        return self.model_dump_json(exclude_none=True)

    def in_meta(self) -> dict[str, Any]:
        """Return the columns of ``meta/episodes``."""
        return self.model_dump(exclude={"versions"}) | {
            "key_frames": np.array(self.key_frames, dtype=np.int64),
            "fixture_poses": json.dumps(self.fixture_poses),
        }


def from_frames(text: str, where: str) -> EpisodeRecord:
    """Return the record that a first frame holds; ``where`` begins the message.

    Raises:
        MemobenchError: the text is no record.
    """
    try:
        value = parsed(text)
        try:
            return EpisodeRecord.model_validate(value)
        except ValidationError as error:
            raise Malformed(first_fault(error.errors(include_url=False), value)) from None
    except Malformed as error:
        raise MemobenchError(
            f"{where}: its column {EPISODE_INFO} is none that this package writes ({error}); take the dataset from its "
            "source again"
        ) from None


def from_meta(row: Mapping[str, Any]) -> EpisodeRecord | None:
    """Return the record that a row of ``meta/episodes`` holds; None where it holds none, or a part of one."""
    values = {key: row[key] for key in EpisodeRecord.model_fields if row.get(key) is not None}
    try:
        return EpisodeRecord.model_validate(values | {"fixture_poses": json.loads(values.get("fixture_poses", "null"))})
    except (ValidationError, ValueError, TypeError):
        return None
