"""Checkpoint texts as LeRobot's persistent language rows, for its training recipes.

LeRobot 0.6 keeps language beside the frames in the column ``language_persistent``: one list of rows per
episode, repeated on every frame, each row active from its timestamp until the next of its style
(``lerobot.datasets.language``). The styles written here are those its annotation pipeline writes: ``subtask``
(what to do, as an instruction) and ``memory`` (what has been done, in the past tense; none before the first
completion).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_memobench.datasets.labels import Labels
from lerobot_memobench.protocol import CONTROL_HZ

MIN_FRAMES_BETWEEN_ROWS = 5
"""LeRobot's ``emitted_at`` looks 0.1 s to either side and raises when it finds two rows of a style, so rows
of one style must be more than 0.2 s apart: at 20 frames/s, at least 5 frames."""

LanguageRow = dict[str, Any]


def persistent_rows(found: Labels, fps: int = CONTROL_HZ) -> list[LanguageRow]:
    """Return an episode's rows, sorted as LeRobot's own writer sorts them (timestamp, style, role).

    A text that is replaced again within 0.2 s (checkpoints completed at nearly the same time) gets no row;
    the text before it stays active until the one after it begins, so a row never claims something too early.
    The per-frame string columns keep every change.
    """
    rows = [_row("subtask", text, frame, fps) for frame, text in _changes(found.subtask)]
    rows += [_row("memory", text, frame, fps) for frame, text in _changes(found.memory) if text]
    return sorted(rows, key=lambda row: (row["timestamp"], row["style"], row["role"]))


def _changes(texts: list[str]) -> list[tuple[int, str]]:
    """Return (frame, text) wherever a text begins, without empty and short-lived ones."""
    kept: list[tuple[int, str]] = []
    for frame, text in enumerate(texts):
        if not text or (frame > 0 and text == texts[frame - 1]):
            continue
        if kept and frame - kept[-1][0] < MIN_FRAMES_BETWEEN_ROWS:
            replaced, _ = kept.pop()
            frame = 0 if replaced == 0 else frame  # something must be active from the episode's first frame on
        kept.append((frame, text))
    return kept


def _row(style: str, text: str, frame: int, fps: int) -> LanguageRow:
    # LeRobot's frame timestamps are float32; a row must equal its frame's to the bit.
    timestamp = float(np.float32(frame / fps))
    return {
        "role": "assistant",
        "content": text,
        "style": style,
        "timestamp": timestamp,
        # LeRobot's annotation writer puts None here, and then its own `lerobot-dataset-viz` cannot open the dataset:
        # it batches frames with torch's collate function, which knows no None. Empty means the same to LeRobot's
        # recipes: they look at a camera only when asked for one, and at tool calls if there are any.
        "camera": "",
        "tool_calls": [],
    }
