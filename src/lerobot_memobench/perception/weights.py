"""Keep a detector in a safetensors file with the names of its kinds.

Weights are bfloat16, but for the heads of tokens, which are as large as the encoder and only read by tests: those are
int8 with a scale per row.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import BLOCKS, WIDTHS, VisualEncoder

SHIPPED = Path(__file__).parent / "detector.safetensors"
"""The detector that comes with the package: results/detector.md."""
PACKAGE, RANDOM = "package", "random"
"""Names that are no file's: the package's detector, and a visual encoder with random weights."""

QUANTISED, SCALE = ("token_heads.", "pooled_heads."), " scale"
"""Prefixes of the int8 weights, and the suffix of their scales' names."""


def save_detector(detector: Detector, path: Path) -> None:
    """Fold a detector and write it to a file."""
    detector.fold()
    tensors = {}
    for name, value in detector.state_dict().items():
        kept = value.detach()
        if name.startswith(QUANTISED) and kept.ndim > 1:
            scale = kept.abs().amax(dim=1, keepdim=True).clamp(min=1e-12) / 127
            tensors[name], tensors[name + SCALE] = (kept / scale).round().to(torch.int8).contiguous(), scale
        else:
            tensors[name] = kept.to(torch.bfloat16).contiguous()
    shape = {"widths": detector.encoder.widths, "blocks": detector.encoder.blocks, "kinds": detector.kinds}
    write_file(path, save(tensors, {"detector": json.dumps(shape)}))


def load_detector(name: str | Path) -> Detector:
    """Return the detector of a name, `PACKAGE` or a path, in float32 and in evaluation.

    Raises:
        MemobenchError: the file is not there, or was not written by `save_detector`.
    """
    path = detector_file(name)
    try:
        with safe_open(path, framework="pt") as file:
            shape = json.loads(file.metadata()["detector"])
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (not a dict)
        for scale in [key for key in tensors if key.endswith(SCALE)]:
            tensors[scale.removesuffix(SCALE)] *= tensors.pop(scale)
        encoder = VisualEncoder(tuple(shape["widths"]), tuple(shape["blocks"]))
        detector = Detector(encoder, tuple(shape["kinds"]))
        detector.fold()
        detector.load_state_dict(tensors)
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise MemobenchError(
            f"{path} holds no detector ({reason}); name a file of `python -m research.detector train`"
        ) from None
    return detector.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def load_visual_encoder(name: str) -> VisualEncoder:
    """Return the visual encoder of the detector of a name, `PACKAGE` or a path, as policies use it.

    Raises:
        MemobenchError: there is no such detector, or its encoder has other sizes than this version's.
    """
    encoder = load_detector(name).encoder
    if (encoder.widths, encoder.blocks) != (WIDTHS, BLOCKS):
        raise MemobenchError(
            f"the visual encoder of {name} has stages of widths {encoder.widths} and blocks {encoder.blocks}, and "
            f"policies use {WIDTHS} and {BLOCKS}; name a file of this version's `python -m research.detector train`"
        )
    return encoder


def detector_file(name: str | Path) -> Path:
    """Return the file of the detector of a name, `PACKAGE` or a path.

    Raises:
        MemobenchError: it is not there.
    """
    path = SHIPPED if str(name) == PACKAGE else Path(name).expanduser()
    if not path.is_file():
        raise MemobenchError(f"there is no file {path}; name one that `python -m research.detector train` has written")
    return path
