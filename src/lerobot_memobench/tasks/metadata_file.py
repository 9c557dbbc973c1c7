"""Read the files of a task's folder; every complaint names the file and says what should be in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula_parsing import short

HOLDS = (
    "'memory' (three texts per checkpoint: coarse, intermediate, fine), 'operating_type' (three labels per checkpoint: "
    "0 Storage, 1 Update, 2 Compression), 'subtask_goals' (one formula per checkpoint) and 'key_frame' (-1 per "
    "checkpoint)"
)
"""What a metadata file holds, for messages."""


def read_text(path: Path, holds: str) -> str:
    """Return a file's text; ``holds`` says what should be in it, for the message when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MemobenchError(f"{path} is missing, expected a file that holds {holds}") from None
    except UnicodeDecodeError as error:
        raise MemobenchError(
            f"{path}: found a byte at offset {error.start} that is no UTF-8, expected UTF-8 text"
        ) from None
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror}), expected a file that holds {holds}") from None


def json_object(path: Path) -> dict[str, Any]:
    """Return the object that a metadata file holds; a key that stands twice in one is an error."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        for key in keys:
            if keys.count(key) > 1:
                raise MemobenchError(f"{path}: found the key {key!r} twice in one object, expected it once")
        return dict(pairs)

    text = read_text(path, HOLDS)
    try:
        data = json.loads(text, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise MemobenchError(
            f"{path}, line {error.lineno}: found no valid JSON ({error.msg}), expected an object"
        ) from None
    except MemobenchError:
        raise
    except (ValueError, RecursionError) as error:
        raise MemobenchError(f"{path}: found JSON that cannot be read ({error}), expected an object") from None
    if not isinstance(data, dict):
        raise MemobenchError(f"{path}: found {short(data)}, expected a JSON object that holds {HOLDS}")
    return data
