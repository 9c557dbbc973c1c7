"""Under whose terms does a dataset stand? Under those of the world in which it was recorded, and of who recorded it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from lerobot_memobench.tasks.catalogue import get_task, suite_of
from lerobot_memobench.tasks.task import LIBERO

OWN = "Apache-2.0: the demonstrations, and `lerobot_memobench`, which made them."
_LIBERO = (
    "The scenes are of LIBERO's assets (Liu et al., 2023). LIBERO has its code under MIT and its datasets under CC BY "
    "4.0; the packages of its assets say MIT. Name LIBERO where you show the pictures. What `lerobot_memobench` adds, "
    "such as actions, labels and tables, is under Apache-2.0."
)
_AUTHORS = (
    "{what} of MEMOBench's authors are under CC BY-NC 4.0 by the licence of their repository, "
    "Collab-Gen/MEMOBench; their paper announces CC BY 4.0 for the data. Unless they say otherwise, use this dataset "
    "for research that is not commercial, and name them (Sun et al.)."
)
NOT_COMMERCIAL, SEVERAL = "cc-by-nc-4.0", "other"
"""Identifiers of licences on the hub."""


def terms(infos: Iterable[Mapping[str, Any]]) -> tuple[str, str]:
    """Return a dataset's licence, as the hub names it, and the section of its card on it.

    Args:
        infos: of its episodes (`staging.Info`).
    """
    infos = list(infos)
    there = [info for info in infos if info.get("world") == LIBERO]
    theirs = {
        "The demonstrations": any(info["seed"] < 0 for info in infos),  # converted: `memobench generate` knows the seed
        "The scanned objects": any(map(_shows_scans, there)),
    }
    parts = [_AUTHORS.format(what=what) for what, shown in theirs.items() if shown]
    if not there and not parts:
        return "apache-2.0", OWN
    return NOT_COMMERCIAL if parts else SEVERAL, "\n\n".join([*([_LIBERO] if there else []), *parts])


def _shows_scans(info: Mapping[str, Any]) -> bool:
    """Whether a scan of the authors' is in an episode's scene: every object of a spatial task is one, or a stand-in."""
    name = info["task_name"]
    if info["memory_type"] != "spatial" or suite_of(name) is None:
        return False
    return not set(get_task(name).objects.values()) <= set(info.get("stand_ins") or ())
