"""What a study does, and the folder that belongs to it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot.configs import PolicyFeature

from lerobot_memobench.datasets.memory_cache import dataset_fingerprint
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.files import write_file
from lerobot_memobench.files.reading import read_json
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

ALIGNMENTS = ("none", "semantic", "contrastive", "framewise")
PROMPT_LENGTH = 48
"""Tokens of a prompt: the catalogue's longest instruction and eight state values take 45 words."""


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


def claim_folder(out: Path, root: Path, settings: StudySettings) -> None:
    """Make ``out`` the folder of a study of the dataset at ``root``; more seeds may be added to one that is there.

    Raises:
        MemobenchError: it holds a study of another dataset, or with other settings.
    """
    wanted = {"dataset": dataset_fingerprint(root, MemobenchMemConfig.memory_camera), **asdict(settings)}
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
