"""The record of an episode in a dataset: its fields as a whole, written to and read from two tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels
from lerobot_memobench.datasets.lerobot_format.columns import EPISODE_INFO
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Malformed, Number, Whole, checked, parsed
from lerobot_memobench.sim.scene_hash import LIBERO

DETERMINED = {
    "memory_type",
    "family",
    "operations",
    "success",
    "key_frames",
    "scene_hash",
    "fixture_poses",
    "digest",
}


class EpisodeRecord(BaseModel):
    """Fields of an episode as a whole: its task, seed, placement, hashes.

    A dataset stores it twice: in ``meta/episodes``, which ``LeRobotDataset(…, episode_filter=…)`` reads, and as JSON in
    the frames' column `EPISODE_INFO`, at each episode's first frame. LeRobot's dataset tools (``lerobot-edit-dataset``)
    keep the columns of frames, but drop unknown columns of ``meta/episodes`` and unknown files.

    A field's description is its meaning in the dataset card.

    Attributes:
        seed: -1 if unknown.
        digest: None in datasets of earlier versions.
        world: ``libero``; None for the scenes that version 0.2 modelled in code, as for stand_ins.
        stand_ins: classes whose missing scans this package's objects replaced.
        versions: versions of the packages on which the numbers depend; None if unknown.
    """

    model_config = ConfigDict(frozen=True)

    task_name: str = Field(description="task of the catalogue")
    memory_type: str = Field(description="temporal, spatial, object or procedural")
    family: str = Field("", description="group of similar tasks")
    operations: str = Field("", description="labels of the checkpoints in order, e.g. SUC")
    seed: Whole = Field(description="seed of the scene")
    referent: str = Field(
        "fixed",
        description="fixed; random: the demonstration prompt decides the goal; drawn: the seed decides it "
        "(strict tasks)",
    )
    variant: Count = Field(description="number of the referent or order; 0 is the published one")
    success: bool | None = Field(None, description="the goal was reached")
    exec_start_index: Count = Field(description="first frame of the execution")
    key_frames: list[Whole] = Field(description="frame at which each checkpoint was completed in order, −1 if never")
    scene_hash: str | None = Field(None, description="hash of the initial scene")
    fixture_poses: dict[str, list[Number]] | None = Field(
        None, description="JSON, fixture to position and quaternion wxyz"
    )
    digest: str | None = Field(None, description="sha256 of states, actions and labels")
    world: str | None = None
    stand_ins: list[str] | None = None
    versions: dict[str, str] | None = None

    @classmethod
    def meanings(cls) -> dict[str, str]:
        """Return the described fields and their descriptions."""
        return {name: field.description for name, field in cls.model_fields.items() if field.description}

    @classmethod
    def of(cls, demo: Demonstration) -> EpisodeRecord:
        """Return the record of a demonstration, without ``versions``."""
        return cls(
            task_name=demo.task.name,
            memory_type=demo.task.memory_type,
            family=demo.task.family,
            operations=demo.task.operations,
            seed=int(demo.seed),
            referent=demo.referent,
            variant=int(demo.variant),
            success=bool(demo.success),
            exec_start_index=int(demo.exec_start),
            key_frames=labels(demo).key_frames.tolist(),
            scene_hash=demo.scene_hash,
            fixture_poses={name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
            digest=digest(demo),
            world=LIBERO,
            stand_ins=list(demo.stand_ins),
        )

    def determined(self) -> dict[str, Any]:
        """Return the fields that are determined by task, seed and actions."""
        return self.model_dump(include=DETERMINED)

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
    """Return the record in the text of an episode's first frame.

    Args:
        text: JSON.
        where: dataset and episode, for the message.

    Raises:
        MemobenchError: the text is no record.
    """
    try:
        record: EpisodeRecord = checked(parsed(text), EpisodeRecord)
    except Malformed as error:
        raise MemobenchError(
            f"{where}: its column {EPISODE_INFO} is not as this package writes it ({error}); take the dataset from its "
            "source again"
        ) from None
    return record


def from_meta(row: Mapping[str, Any]) -> EpisodeRecord | None:
    """Return the record in a row of ``meta/episodes``; None if it is missing or incomplete."""
    values = {key: row[key] for key in EpisodeRecord.model_fields if row.get(key) is not None}
    try:
        in_json = {key: json.loads(values.get(key, "null")) for key in ("fixture_poses", "stand_ins")}
        return EpisodeRecord.model_validate(values | in_json)
    except (ValidationError, ValueError, TypeError):
        return None
