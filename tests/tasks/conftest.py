"""A small valid task to modify, and the published task files next to the checkout."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"

BDDL = """\
(define (problem KITCHEN)
  (:domain robosuite)
  (:language put the cup, the red one, into the drawer)
  (:regions
    (cup_place (:target table_1) (:ranges ((0.0 0.0 0.1 0.1) (0.2 0.2 0.3 0.3))) (:yaw_rotation ((0.0 1.5))))
    (box_place (:target table_1) (:ranges ((-0.1 -0.1 0.0 0.0))))
    (top_region (:target box_1))
  )
  (:fixtures
    table_1 - kitchen_table
    box_1 - wooden_cabinet
  )
  (:objects
    cup_1 cup_2 - cup ; two of them
    lid,v1.2 - lid
  )
  (:obj_of_interest cup_1 box_1)
  (:init
    (On box_1 table_1_box_place)
    (On cup_1 table_1_cup_place)
    (On cup_2 table_1_cup_place)
    (On lid,v1.2 cup_2)
    (Close box_1_top_region)
  )
  (:goal (And (In cup_1 box_1_top_region) (Not (Open box_1_top_region))))
)
"""

METADATA: dict[str, Any] = {
    "key_frame": [-1, -1],
    "memory": [["a", "b", "c"], ["d", "e", "f"]],
    "operating_type": [[0, 0, 0], [1, 2, 1]],
    "subtask_goals": [{"and": [["wasopen", "box_1_top_region"]]}, {"and": [["in", "cup_1", "box_1_top_region"]]}],
}


@pytest.fixture
def metadata() -> dict[str, Any]:
    return copy.deepcopy(METADATA)


@pytest.fixture
def bddl() -> str:
    return BDDL


@pytest.fixture
def write_task(tmp_path: Path) -> Callable[..., Path]:
    """Write a task folder; metadata may be a dict, raw text or None (no file)."""

    def write(bddl: str = BDDL, metadata: Any = METADATA, parent: str = "tasks", name: str = "my_task") -> Path:
        folder = tmp_path / parent / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "task_config.bddl").write_text(bddl)
        if metadata is not None:
            text = metadata if isinstance(metadata, str) else json.dumps(metadata)
            (folder / "task_config.meta.json").write_text(text)
        return folder

    return write


@pytest.fixture
def published() -> Path:
    """Return the published task folders; skip without them."""
    folder = SHARED / "upstream_tasks"
    if not folder.is_dir():
        pytest.skip("no published task folders next to the checkout")
    return folder
