"""Texts of a dataset that a policy learns from: subgoals, those of controls, and oracle memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_memobench.datasets.frames import LEVEL_COLUMNS, MEMORY_COLUMN, FrameTable, read_frame_table
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    ANSWERS,
    PROGRESS,
    SHUFFLED,
    MemobenchMemConfig,
)
from lerobot_memobench.policies.memobench_mem.memory import NONE
from lerobot_memobench.policies.memobench_mem.texts import answers, progress, shuffled, subgoals_of, texts_of


def set_subgoals(config: MemobenchMemConfig, meta: LeRobotDatasetMetadata) -> None:
    """Set the subgoals of a memory that learns from texts, and check that the dataset has all texts of the policy.

    Raises:
        MemobenchError: the dataset lacks texts, or has some that the memory does not know.
    """
    if config.align == NONE and not config.oracle_memory and not config.privileged_memory:
        return
    table = read_frame_table(Path(meta.root))
    require_texts(table, config, Path(meta.root))
    if not config.privileged_memory:
        return
    level = config.subgoal_level
    own = subgoals_of(table.subgoals.get(level, []), table.episodes, meta.episodes["tasks"])
    if not any(own.values()):
        raise MemobenchError(
            f"The dataset {meta.root} has no {level} subgoals (no text in a column '{LEVEL_COLUMNS[level]}'), from "
            "which this memory learns; name a dataset of `memobench generate`, another policy.subgoal_level, or "
            "another policy.memory."
        )
    config.subgoals = config.subgoals or own
    if new := sorted({*texts_of(own)} - {*texts_of(config.subgoals)}):
        raise MemobenchError(
            f"The dataset {meta.root} has {len(new)} checkpoint texts that this memory does not know, the first "
            f"being {new[0]!r}; train on the tasks it was trained on, or train a new memory with "
            "--policy.subgoals=null."
        )


def require_texts(table: FrameTable, config: MemobenchMemConfig, root: Path) -> None:
    """Check that a dataset has the texts that an alignment or oracle memory reads.

    Raises:
        MemobenchError: it has no subgoals at the level of the alignment, or no oracle memory.
    """
    levels = [level for level in LEVEL_COLUMNS if any(table.subgoals.get(level, []))]
    if config.align != NONE and config.subgoal_level not in levels:
        fix = (
            f"it has {' and '.join(levels)} subgoals: choose one with --policy.subgoal_level"
            if levels
            else "use --policy.align=none, or a dataset that has the subgoal of each frame there"
        )
        raise MemobenchError(
            f"The dataset {root} has no {config.subgoal_level} subgoals (no text in a column "
            f"'{LEVEL_COLUMNS[config.subgoal_level]}'), so --policy.align={config.align} has no text to align memory "
            f"with; {fix}."
        )
    if config.oracle_memory and not any(table.memory or []):
        raise MemobenchError(
            f"The dataset {root} has no text in a column '{MEMORY_COLUMN}', which --policy.oracle_memory=true reads; "
            "leave it out, or generate the dataset again with this version."
        )


def with_targets(table: FrameTable, config: MemobenchMemConfig, root: Path) -> FrameTable:
    """Return a dataset's frames with the texts of ``config.align_targets`` in place of the aligned subgoals.

    Raises:
        MemobenchError: there is a single text to shuffle, or an episode's task is unknown.
    """
    level, texts = config.subgoal_level, table.subgoals.get(config.subgoal_level, [])
    if config.align == NONE or not any(texts):
        return table
    if config.align_targets == SHUFFLED:
        if len({*texts} - {""}) < 2:
            raise MemobenchError(
                f"The dataset of {root} has one subgoal at the level of the alignment, and --policy.align_targets="
                f"{SHUFFLED} needs at least two; use a dataset of several tasks, or another --policy.subgoal_level."
            )
        texts = shuffled(texts, table.episodes)
    elif config.align_targets == ANSWERS:
        texts = answers(texts, table.episodes)
    elif config.align_targets == PROGRESS:
        records = [place.record for place in list_episodes(root)]
        if None in records:
            raise MemobenchError(f"The dataset {root} cannot be aligned with align_targets={PROGRESS}: {STRANGER}.")
        texts = progress(texts, table.episodes, [record.task_name for record in records if record is not None])
    return replace(table, subgoals={**table.subgoals, level: texts})
