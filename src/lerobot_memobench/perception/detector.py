"""Detect objects in images: a feature pyramid, linear heads and a refinement head on the tokens of a visual encoder.

One token of 192 numbers covers a square that may show four objects, which is too coarse to separate them. Objects are
detected on a map four times as fine, which a feature pyramid (Lin et al. 2017) computes from the tokens and the
encoder's feature maps. Linear heads predict a heat map of the objects' visible centres (CenterNet, Zhou et al. 2019),
their geometry and a mask. Linear heads confuse kinds if little of an object is visible, so a small network scores each
peak of the heat map again by its surroundings, like the second stage of Faster R-CNN (Ren et al. 2015).

A detector is one safetensors file with the names of its kinds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from scipy.special import expit
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, pad, relu

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file
from lerobot_memobench.perception.visual_encoder import (
    BLOCKS,
    GRID,
    WIDTHS,
    ResidualBlock,
    VisualEncoder,
    fold_norms,
)

LEVELS = 2  # levels of the feature pyramid, each twice as fine as the one before
FINER = 2**LEVELS  # cells of the finest map along a token's side
FINE, COARSE = 4, 2  # cells along a token's side: of heat map and mask, and of geometry
GEOMETRY = ("across", "down", "depth", "height", "joint", "lit", "turn cosine", "turn sine")
"""Values predicted for an object of each kind in each coarse cell. ``across``, ``down``: from the cell's centre to the
object's origin, in cells. ``depth``: of its origin along the camera's view, m. ``height``: of its origin over the
table, m. ``joint``: of a moving part, m or rad. ``lit``: logit of a highlight around it. ``turn``: of twice the
angle of its x axis in the image, which a half turn leaves as it is."""
UNCERTAINTIES = ("place", "depth", "height")
"""Predicted expected errors: of ``across`` and ``down`` together in cells, of the others in m."""
FIRST_UNCERTAINTIES = (0.3, 0.01, 0.01)  # before training
PRIOR = 0.01  # probability of an object in a cell before training: most cells show none

REFINEMENT_WIDTH, REDUCED_CHANNELS = 96, 24  # the refinement head reduces the encoder's feature map
MAP_WINDOW, FEATURE_WINDOW = 5, 13
"""Side of the square around a peak that the refinement head reads: in cells of the finest map, and in cells of the
encoder's feature map, which are half as wide."""
LOGIT_SCALE = 4.0  # about the standard deviation of heat map logits

DETECTION = np.dtype(
    [("kind", "u1"), ("place", "<f4", 2), ("turn", "<f4", 2), ("uncertainty", "<f4", len(UNCERTAINTIES))]
    + [(name, "<f4") for name in ("score", "depth", "height", "joint", "lit")]
)
"""A detected object. ``score``: probability. ``place``: of its origin in the image, fractions of the side from the
upper left corner. ``lit``: probability. ``uncertainty``: expected error of its place, a fraction of the image's side,
of its depth and of its height, m; 0 if it is not predicted. The others as in `GEOMETRY`."""
Detections = NDArray[np.void]  # detections (n,) of one image, of dtype `DETECTION`
MIN_SCORE = 0.03  # smallest score of a detection
MAX_DETECTIONS = 64  # in an image

CellQuery = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Maps image, kind, row and column of coarse cells, (n,) each, to (n, values), float32: predictions for an object of
that kind in that cell. Querying few cells is much faster than predicting all kinds in all cells."""


@dataclass(frozen=True)
class DetectorOutput:
    """Predictions of heads for images."""

    heatmap: Tensor  # (N, kinds, cells, cells), logits of an object's visible centre
    geometry: CellQuery  # len(GEOMETRY) values
    side: int  # coarse cells along the image's side
    mask: Tensor  # (N, kinds + 1, cells, cells), logits of the visible kind; the first is background
    uncertainty: CellQuery | None = None  # logarithms of `UNCERTAINTIES`; None: not predicted
    score: CellQuery | None = None  # a logit per kind of an object at a peak of the heat map; None: not refined


class Detector(nn.Module):
    """Visual encoder, feature pyramid, heads on its finest map, and a head that scores the peaks of the heat map."""

    def __init__(self, encoder: VisualEncoder, kinds: tuple[str, ...]) -> None:
        super().__init__()
        self.encoder, self.fpn, self.kinds = encoder, FeaturePyramid(encoder), kinds
        self.fine_heads = Heads(self.fpn.width, len(kinds), FINER * GRID, FINE // FINER, 1, uncertain=True)
        self.refinement_head = RefinementHead(self.fpn.width, encoder.widths[-2 - LEVELS], len(kinds))

    def forward(self, images: Tensor) -> DetectorOutput:
        """Return the refined output for images (N, 3, SIDE, SIDE) in [0, 1]."""
        tokens, maps = self.encoder.tokens_and_maps(images)
        return self.read(self.fpn(tokens, maps), maps)

    def read(self, fine: Tensor, maps: Sequence[Tensor]) -> DetectorOutput:
        """Return the refined output for the finest map (N, (GRID FINER)², width) and the encoder's feature maps."""
        output: DetectorOutput = self.fine_heads(fine)
        return replace(output, score=self.refinement_head(fine, maps[-1 - LEVELS], output.heatmap))

    def fold(self) -> None:
        """Fold batch normalisation into the convolutions. A folded detector is not trained further."""
        self.encoder.fold()
        fold_norms(self.fpn)


class FeaturePyramid(nn.Module):
    """Map tokens and the encoder's feature maps to a finer map, as wide as the encoder's at that resolution."""

    def __init__(self, encoder: VisualEncoder) -> None:
        super().__init__()
        widths = encoder.widths[: -2 - LEVELS : -1]
        self.width = widths[-1]
        self.levels = nn.ModuleList(PyramidLevel(*pair) for pair in pairwise(widths))

    def forward(self, tokens: Tensor, maps: Sequence[Tensor]) -> Tensor:
        """Return the finest map (N, (GRID FINER)², width), row by row."""
        x = tokens.unflatten(1, (GRID, GRID))
        for level, lateral in zip(self.levels, reversed(maps), strict=False):  # the finest maps are left over
            x = level(x, lateral)
        return x.flatten(1, 2)


class PyramidLevel(nn.Module):
    """Map a coarse map and the encoder's feature map, twice as fine, to a finer map; arguments are their channels."""

    def __init__(self, coarse: int, lateral: int) -> None:
        super().__init__()
        self.upsample = nn.Linear(coarse, 4 * lateral)
        self.lateral = nn.Conv2d(lateral, lateral, 1)
        self.block = ResidualBlock(lateral)

    def forward(self, coarse: Tensor, lateral: Tensor) -> Tensor:
        """Map (N, side, side, coarse) and (N, lateral, 2 side, 2 side) to (N, 2 side, 2 side, lateral)."""
        around = rearrange(self.upsample(coarse), "n gy gx (d y x) -> n d (gy y) (gx x)", y=2, x=2)
        around = around.contiguous(memory_format=torch.channels_last)
        return self.block(relu(around + self.lateral(lateral))).permute(0, 2, 3, 1)


class Heads(nn.Module):
    """Linear maps from ``grid`` x ``grid`` tokens, or cells of a map, to a `DetectorOutput`."""

    def __init__(
        self, width: int, kinds: int, grid: int, fine: int = FINE, coarse: int = COARSE, *, uncertain: bool = False
    ) -> None:
        super().__init__()
        self.grid, self.fine, self.coarse = grid, fine, coarse
        self.heatmap = nn.Linear(width, kinds * fine**2)
        self.geometry = nn.Linear(width, kinds * len(GEOMETRY) * coarse**2)
        self.mask = nn.Linear(width, (kinds + 1) * fine**2)
        self.uncertainty = nn.Linear(width, kinds * len(UNCERTAINTIES) * coarse**2) if uncertain else None
        nn.init.constant_(self.heatmap.bias, float(torch.logit(torch.tensor(PRIOR))))
        if self.uncertainty is not None:
            nn.init.zeros_(self.uncertainty.weight)
            first = torch.tensor(FIRST_UNCERTAINTIES).log()
            self.uncertainty.bias.data = first.repeat_interleave(coarse**2).repeat(kinds)

    def forward(self, tokens: Tensor) -> DetectorOutput:
        """Return the output for tokens (N, grid², width)."""
        return DetectorOutput(
            self._as_map(self.heatmap(tokens)),
            self._query(self.geometry, tokens, len(GEOMETRY)),
            self.grid * self.coarse,
            self._as_map(self.mask(tokens)),
            None if self.uncertainty is None else self._query(self.uncertainty, tokens, len(UNCERTAINTIES)),
        )

    def _query(self, linear: nn.Linear, tokens: Tensor, values: int) -> CellQuery:
        c, layout = self.coarse, "(k v y x) ... -> (k y x) v ..."
        weight, bias = (rearrange(part, layout, v=values, y=c, x=c) for part in (linear.weight, linear.bias))

        def query(image: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
            which = (kind * c + row % c) * c + column % c
            token = (image * self.grid + row // c) * self.grid + column // c
            inputs = tokens.flatten(0, 1).index_select(0, token).float()
            return bias.index_select(0, which) + torch.einsum("nvw,nw->nv", weight.index_select(0, which), inputs)

        return query

    def _as_map(self, values: Tensor) -> Tensor:
        sides = {"gy": self.grid, "gx": self.grid, "y": self.fine, "x": self.fine}
        return rearrange(values.float(), "n (gy gx) (v y x) -> n v (gy y) (gx x)", **sides)


class RefinementHead(nn.Module):
    """Score the peaks of a heat map by their surroundings in the finest map and in a feature map, twice as fine."""

    def __init__(self, width: int, channels: int, kinds: int) -> None:
        super().__init__()
        self.around = nn.Linear(width * MAP_WINDOW**2, REFINEMENT_WIDTH)
        self.reduce = nn.Conv2d(channels, REDUCED_CHANNELS, 3, stride=2)
        self.near = nn.Linear(REDUCED_CHANNELS * (FEATURE_WINDOW // 2) ** 2, REFINEMENT_WIDTH, bias=False)
        self.heat = nn.Linear(kinds, REFINEMENT_WIDTH, bias=False)
        self.hidden = nn.Linear(REFINEMENT_WIDTH, REFINEMENT_WIDTH)
        self.score = nn.Linear(REFINEMENT_WIDTH, kinds)

    def forward(self, fine: Tensor, maps: Tensor, heatmap: Tensor) -> CellQuery:
        """Return a query of scores: a logit per kind of an object in a cell of the finest map (N, side², width)."""
        grid = fine.unflatten(1, heatmap.shape[-2:]).permute(0, 3, 1, 2)

        def query(image: Tensor, _: Tensor, row: Tensor, column: Tensor) -> Tensor:
            where = (image, slice(None), row, column)
            around = _squares(grid, MAP_WINDOW, 1)[where]
            near = relu(self.reduce(_squares(maps, FEATURE_WINDOW, 2)[where]))
            heat = max_pool2d(heatmap, 3, 1, 1)[where] / LOGIT_SCALE
            hidden = relu(self.around(around.flatten(1)) + self.near(near.flatten(1)) + self.heat(heat))
            score: Tensor = self.score(hidden + relu(self.hidden(hidden)))
            return score

        return query


def _squares(maps: Tensor, side: int, step: int) -> Tensor:
    # (N, C, H, W) to zero-padded squares around every step-th cell, (N, C, H', W', side, side)
    return pad(maps.float(), (side // 2,) * 4).unfold(2, side, step).unfold(3, side, step)


def detections(output: DetectorOutput) -> list[Detections]:
    """Return the detections of each image with scores above `MIN_SCORE`, highest first."""
    scores, cells = peaks(output)
    scores, order = scores.sort(dim=1, descending=True, stable=True)
    which, rank = torch.nonzero(scores > MIN_SCORE, as_tuple=True)
    image, kind, row, column = (cell.gather(1, order)[which, rank] for cell in cells)

    def in_image(image: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
        # Offsets from different cells cannot be interpolated, places in the image can.
        offset, rest = output.geometry(image, kind, row, column).split([2, len(GEOMETRY) - 2], dim=1)
        return torch.cat([(offset + torch.stack([column, row], dim=1) + 0.5) / output.side, rest], dim=1)

    side = output.heatmap.shape[-1]
    positions = (image, kind, (row + 0.5) / side, (column + 0.5) / side)
    geometry = _interpolated(in_image, output.side, *positions)
    detected = np.zeros(len(image), DETECTION)
    detected["kind"], detected["score"] = kind.numpy(), scores[which, rank].detach().numpy()
    detected["place"], detected["turn"] = geometry[:, :2], geometry[:, -2:]
    for name in ("depth", "height", "joint"):
        detected[name] = geometry[:, GEOMETRY.index(name)]
    detected["lit"] = expit(geometry[:, GEOMETRY.index("lit")])
    if output.uncertainty is not None:
        uncertainty = np.exp(_interpolated(output.uncertainty, output.side, *positions))
        detected["uncertainty"] = uncertainty / [output.side, 1, 1]
    owner = image.numpy()
    return [detected[owner == number] for number in range(len(scores))]


def peaks(output: DetectorOutput) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return the local maxima of heat maps: scores (N, MAX_DETECTIONS), 0 if there are fewer, and their cells.

    A cell is image, kind, row and column, (N, MAX_DETECTIONS) each.
    """
    heat, side = torch.sigmoid(output.heatmap), output.heatmap.shape[-1]
    scores, indices = (
        torch.where(heat == max_pool2d(heat, 3, 1, 1), heat, torch.zeros(())).flatten(1).topk(MAX_DETECTIONS, dim=1)
    )
    images = torch.arange(len(heat))[:, None].expand_as(indices)
    cells = (images, indices // side**2, indices // side % side, indices % side)
    if output.score is not None:
        logits = output.score(*(cell.flatten() for cell in cells)).view(*scores.shape, -1)
        refined = torch.sigmoid(logits.gather(2, cells[1][..., None])[..., 0])
        scores = torch.where(scores > 0, refined, scores)
    return scores, cells


def _interpolated(
    query: CellQuery, side: int, image: Tensor, kind: Tensor, down: Tensor, across: Tensor
) -> NDArray[np.float32]:
    # Bilinear, from at most four cells of each object: `grid_sample` would need predictions in all cells.
    y, x = down * side - 0.5, across * side - 0.5
    total = weights = torch.zeros(len(y), 1)
    for row, column in ((y.floor() + a, x.floor() + b) for a in (0, 1) for b in (0, 1)):
        inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
        weight = (inside * (1 - (y - row).abs()) * (1 - (x - column).abs()))[:, None]
        cell = (row.long().clamp(0, side - 1), column.long().clamp(0, side - 1))
        total, weights = total + weight * query(image, kind, *cell).detach(), weights + weight
    return np.asarray((total / weights).numpy())


# --- files ---

PACKAGE, SHIPPED = "package", Path(__file__).parent / "detector.safetensors"
"""Name and file of the package's detector (``results/detector.md``)."""


def save_detector(detector: Detector, path: Path) -> None:
    """Fold a detector and write it to a file, in bfloat16."""
    detector.fold()
    tensors = {name: value.detach().to(torch.bfloat16).contiguous() for name, value in detector.state_dict().items()}
    shape = {"widths": detector.encoder.widths, "blocks": detector.encoder.blocks, "kinds": detector.kinds}
    write_file(path, save(tensors, {"detector": json.dumps(shape)}))


def load_detector(name: str | Path) -> Detector:
    """Return the detector of `PACKAGE` or a path in float32 and in evaluation mode."""
    path = detector_file(name)
    try:
        with safe_open(path, framework="pt") as file:
            shape = json.loads(file.metadata()["detector"])
            detector = Detector(VisualEncoder(tuple(shape["widths"]), tuple(shape["blocks"])), tuple(shape["kinds"]))
            detector.fold()
            detector.load_state_dict({key: file.get_tensor(key).float() for key in detector.state_dict()})
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise MemobenchError(
            f"{path} holds no detector ({reason}); name a file of `python -m research.detector train`"
        ) from None
    return detector.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


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
