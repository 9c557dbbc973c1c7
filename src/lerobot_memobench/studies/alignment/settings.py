"""What a study does, and the folder that belongs to it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.feature_cache.layout import dataset_fingerprint
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import read_json, write_file
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.studies.learning.experiments import EVALUATION_SEEDS, MEMORY, MEMORYLESS

ALIGNMENTS: dict[str, tuple[str, ...]] = {
    MEMORY: (),
    **{name: (f"align={name}",) for name in ("semantic", "contrastive", "framewise")},
    "oracle text": ("policy.integration=none", "policy.oracle_memory=true"),
    MEMORYLESS: ("policy.integration=none",),
}
"""The paper's objectives beside a memory that is aligned with nothing, and the two ends: what was seen told in words,
and nothing of it. Name -> words for `lerobot train`."""


@dataclass(frozen=True)
class StudySettings:
    """What a study does.

    Attributes:
        steps: updates of each policy. seeds: of training; the first ``seeds`` numbers.
        held_out: episodes of each task, its last ones, that are never trained on.
        rollouts: of each task and policy. first_seed: of the rollouts.
        level: of the subgoals that memories are aligned with and asked for.
        frames_per_episode: execution frames, evenly spaced, that are asked about.
    """

    steps: int = 3000
    seeds: int = 3
    held_out: int = 4
    rollouts: int = 20
    first_seed: int = EVALUATION_SEEDS
    level: str = "intermediate"
    frames_per_episode: int = 24


def claim_folder(out: Path, root: Path, settings: StudySettings) -> None:
    """Make ``out`` the folder of a study of the dataset at ``root``; more seeds may be added to one that is there.

    Raises:
        MemobenchError: it holds a study of another dataset, or with other settings.
    """
    wanted = {"dataset": dataset_fingerprint(root, f"{OBS_IMAGES}.{next(iter(CAMERAS))}"), **asdict(settings)}
    del wanted["seeds"]
    path = out / "settings.json"
    if path.is_file():
        there = read_json(path, dict[str, Any], "name another --out, or remove the file")
        different = [key for key in wanted if there.get(key) != wanted[key]]
        if different:
            raise MemobenchError(
                f"{out} holds a study with another {', '.join(different)}; name another --out, or give "
                "the settings in its settings.json"
            )
    out.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(wanted, indent=1))
