"""Save a detector to a safetensors file with the names of its kinds, and load it."""

from __future__ import annotations

import json
import logging
from functools import cache
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import BLOCKS, WIDTHS, VisualEncoder

logger = logging.getLogger(__name__)

SHIPPED = Path(__file__).parent / "detector.safetensors"
"""The detector that comes with the package, trained on the scenes that version 0.2 modelled in code."""
PACKAGE = "package"
"""Name of the package's detector."""


def save_detector(detector: Detector, path: Path) -> None:
    """Fold a detector and write it to a file, in bfloat16."""
    detector.fold()
    tensors = {name: value.detach().to(torch.bfloat16).contiguous() for name, value in detector.state_dict().items()}
    shape = {"widths": detector.encoder.widths, "blocks": detector.encoder.blocks, "kinds": detector.kinds}
    write_file(path, save(tensors, {"detector": json.dumps(shape)}))


def load_detector(name: str | Path) -> Detector:
    """Return the detector of `PACKAGE` or a path in float32 and in evaluation mode; warn about the package's.

    Raises:
        MemobenchError: the file does not exist, or `save_detector` did not write it.
    """
    path = detector_file(name)
    if path == SHIPPED:
        warn_of_former_scenes()
    try:
        with safe_open(path, framework="pt") as file:
            shape = json.loads(file.metadata()["detector"])
            detector = Detector(VisualEncoder(tuple(shape["widths"]), tuple(shape["blocks"])), tuple(shape["kinds"]))
            detector.fold()
            # The package's file also holds heads that only its training used.
            detector.load_state_dict({key: file.get_tensor(key).float() for key in detector.state_dict()})
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise MemobenchError(
            f"{path} holds no detector ({reason}); name a file of `python -m research.detector train`"
        ) from None
    return detector.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


@cache
def warn_of_former_scenes() -> None:
    """Log once per process that the package's detector was trained on other scenes."""
    logger.warning(
        "the package's detector and visual encoder were trained on the scenes of version 0.2, whose objects looked "
        "different; train one for this version's with `python -m research.detector train` and name its file"
    )


def load_visual_encoder(name: str) -> VisualEncoder:
    """Return the visual encoder of the detector of `PACKAGE` or a path; refuse one of other sizes than policies use."""
    encoder = load_detector(name).encoder
    if (encoder.widths, encoder.blocks) != (WIDTHS, BLOCKS):
        raise MemobenchError(
            f"the visual encoder of {name} has stages of widths {encoder.widths} and blocks {encoder.blocks}, and "
            f"policies use {WIDTHS} and {BLOCKS}; name a file of this version's `python -m research.detector train`"
        )
    return encoder


def detector_file(name: str | Path) -> Path:
    """Return the file of the detector of `PACKAGE` or a path; refuse one that does not exist."""
    path = SHIPPED if str(name) == PACKAGE else Path(name).expanduser()
    if not path.is_file():
        raise MemobenchError(f"there is no file {path}; name one that `python -m research.detector train` has written")
    return path
