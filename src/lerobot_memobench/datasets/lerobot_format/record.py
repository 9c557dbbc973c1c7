"""The record of an episode as a whole, and the two places in which a dataset holds it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from lerobot_memobench.datasets.lerobot_format.layout import EPISODE_INFO
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Malformed, Number, Whole, first_fault, parsed
from lerobot_memobench.tasks.task import World


class EpisodeRecord(BaseModel):
    """Fields of an episode as a whole: its task, seed, placement, hashes.

    A dataset holds it twice. In ``meta/episodes``, where ``LeRobotDataset(…, episode_filter=…)`` looks; and as JSON in
    the frames' column `EPISODE_INFO`, at each episode's first frame, because LeRobot's dataset tools
    (``lerobot-edit-dataset``) keep the frames' columns and drop every column of ``meta/episodes`` and every file that
    LeRobot does not know.

    Attributes:
        seed: of the scene; -1 where it is not known.
        key_frames: one per checkpoint, -1 where it was not completed.
        fixture_poses: fixture to position and quaternion wxyz.
        digest: sha256 of states, actions and labels; None in datasets from before there was one.
        world: of its scene; None in the package's own.
        stand_ins: classes with missing scans, for which others were used; None in the package's own world.
        versions: of the packages on which the numbers depend, where they are known.
    """

    model_config = ConfigDict(frozen=True)

    task_name: str
    memory_type: str
    family: str = ""
    operations: str = ""
    seed: Whole
    referent: str = "fixed"
    variant: Count
    success: bool | None = None
    exec_start_index: Count
    key_frames: list[Whole]
    scene_hash: str | None = None
    fixture_poses: dict[str, list[Number]] | None = None
    digest: str | None = None
    world: World | None = None
    stand_ins: list[str] | None = None
    versions: dict[str, str] | None = None

    def in_frames(self) -> str:
        """Return the text of the first frame's column."""
        return self.model_dump_json(exclude_none=True)

    def in_meta(self) -> dict[str, Any]:
        """Return the columns of ``meta/episodes``."""
        elsewhere = {} if self.world is None else {"world": self.world, "stand_ins": json.dumps(self.stand_ins or [])}
        return self.model_dump(exclude={"versions", "world", "stand_ins"}) | {
            "key_frames": np.array(self.key_frames, dtype=np.int64),
            "fixture_poses": json.dumps(self.fixture_poses),
            **elsewhere,
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
        in_json = {key: json.loads(values.get(key, "null")) for key in ("fixture_poses", "stand_ins")}
        return EpisodeRecord.model_validate(values | in_json)
    except (ValidationError, ValueError, TypeError):
        return None
