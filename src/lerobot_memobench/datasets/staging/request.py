"""What keeps a run in a folder apart from later ones: the request that it answers."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.staging.episode import LEROBOT
from lerobot_memobench.datasets.staging.folders import STAGING, clean_temporaries
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import read_json, remove_drafts, short, write_file
from lerobot_memobench.jobs.processes import locked

REQUEST_FILE = "request.json"


@contextlib.contextmanager
def episodes_folder(out: Path, request: dict[str, Any], advice: str, *, anew: bool = False) -> Iterator[Path]:
    """Hold the destination ``out`` for a run that answers ``request``; yield the folder for its finished episodes.

    Those of an unfinished run of the same request are there already, unless it is to begin ``anew``.

    Raises:
        MemobenchError: another run is writing there, or an unfinished one answers another request; ``advice`` ends
            that sentence.
    """
    staging = out / STAGING
    staging.mkdir(parents=True, exist_ok=True)
    with locked(staging, out):
        folder = staging / "episodes"
        if anew:
            shutil.rmtree(folder, ignore_errors=True)
            (staging / REQUEST_FILE).unlink(missing_ok=True)
        remove_drafts(staging)
        _check_request(staging, request, out, advice)
        folder.mkdir(exist_ok=True)
        clean_temporaries(folder)
        yield folder.absolute()


def _check_request(staging: Path, request: dict[str, Any], out: Path, advice: str) -> None:
    """Remember the request in an unfinished run's folder; raise where it was another one."""
    path = staging / REQUEST_FILE
    try:
        earlier = read_json(path, dict[str, Any], "delete the folder that it is in to start anew")
    except FileNotFoundError:
        write_file(path, json.dumps(request, indent=1), durable=True)
        return
    compare_requests(earlier, request, f"{out} holds an unfinished run", advice)


def compare_requests(earlier: dict[str, Any], request: dict[str, Any], what: str, advice: str) -> None:
    """Raise with the first thing that was asked for differently."""
    before = {"formats": [LEROBOT], "perturb": False, "policy": None, "prompted_episodes": None}
    earlier = {**before, **earlier}  # written before there was a choice
    for key, value in request.items():
        if earlier.get(key) != value:
            there = short(earlier.get(key))
            raise MemobenchError(f"{what} with {key}={there}, now {short(value)} was asked for; {advice}")
