"""What keeps a run in a folder apart from later ones: the request that it answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.staging import LEROBOT, write_json
from lerobot_memobench.errors import MemobenchError

REQUEST_FILE = "request.json"


def check_request(staging: Path, request: dict[str, Any], out: Path, advice: str) -> None:
    """Remember the request in an unfinished run's folder; raise where it was another one."""
    path = staging / REQUEST_FILE
    try:
        earlier = json.loads(path.read_text())
    except FileNotFoundError:
        write_json(request, path)
        return
    compare_requests(earlier, request, f"{out} holds an unfinished run", advice)


def compare_requests(earlier: dict[str, Any], request: dict[str, Any], what: str, advice: str) -> None:
    """Raise with the first thing that was asked for differently."""
    earlier = {"formats": [LEROBOT], **earlier}  # written before there were two
    for key, value in request.items():
        if earlier.get(key) != value:
            raise MemobenchError(f"{what} with {key}={earlier.get(key)!r}, now {value!r} was asked for; {advice}")
