"""Which failures a user can mend, and the one sentence that says how."""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator
from http.client import HTTPException
from urllib.error import URLError

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import disk_refusal

BACKBONE = "policy.pretrained_backbone_weights"
"""Where LeRobot's policies with a backbone of torchvision's, such as act and diffusion, name its weights."""
FETCHING = (URLError, HTTPException, ConnectionError, TimeoutError)
"""What torch raises where it cannot fetch weights."""


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and the errors that led to it, outermost first."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        yield current
        current = current.__cause__ or (None if current.__suppress_context__ else current.__context__)


def one_sentence(error: BaseException) -> str | None:
    """Return what to tell the user in one line, or None for a failure that needs its traceback."""
    errors = list(chain(error))
    for found in errors:
        if isinstance(found, MemobenchError):
            return _line(found)
    from draccus.utils import ParsingError

    if isinstance(errors[0], ParsingError):
        # draccus hides what a configuration's own check says behind "couldn't instantiate".
        return _line(next((e for e in reversed(errors) if isinstance(e, ValueError | TypeError)), errors[0]))
    if isinstance(errors[0], ImportError) and "required but not installed" in str(errors[0]):
        return _line(errors[0])  # LeRobot's own words for a missing extra
    if isinstance(errors[0], FileExistsError):
        return _line(errors[0])
    refusal = disk_refusal(error)
    if refusal is not None:
        named = next((found.filename for found in errors if isinstance(found, OSError) and found.filename), None)
        where = f" {os.fsdecode(named)}" if isinstance(named, str | bytes) else ""
        return f"the disk does not take{where or ' what is written'} ({refusal}): make room, or name another folder"
    fetched = next((found for found in errors if isinstance(found, FETCHING)), None)
    if fetched is not None and _came_through(fetched, "torch.hub"):
        return (
            "the pretrained weights of a backbone are not on this machine and could not be fetched "
            f"({_line(fetched)[:200]}); "
            f"{BACKBONE}=null begins with random ones, a checkpoint brings its own all the same"
        )
    hub = next((found for found in errors if _is_hub_error(found)), None)
    if hub is not None and any(_came_through(found, "lerobot.datasets.") for found in errors):
        return (
            f"the dataset is not on this machine and could not be fetched from the hub ({_line(hub)[:200]}); name a "
            "folder that is here, dataset=<folder>, or make one: `memobench generate --tasks object --episodes 5 --out "
            "outputs/demonstrations`, then dataset=outputs/demonstrations"
        )
    if hub is not None:
        return (
            f"what was asked for is not on this machine and could not be fetched from the hub ({_line(hub)[:200]}); "
            "name a folder that is here: dataset=<folder> or policy=<folder>"
        )
    return None


def _came_through(error: BaseException, package: str) -> bool:
    """Whether a module of a package was at work when an error arose."""
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(str(frame.f_globals.get("__name__")).startswith(package) for frame in frames)


def _is_hub_error(error: BaseException) -> bool:
    import httpx
    from huggingface_hub import errors as hub

    return isinstance(
        error, hub.HfHubHTTPError | hub.LocalEntryNotFoundError | hub.OfflineModeIsEnabled | httpx.TransportError
    )


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
