"""Train the detector on labelled images, in a run that can be resumed.

The first part trains everything except expected errors and refinement head. Linear heads on the 64 tokens and on the 16
pooled ones are trained too, so that these hold the objects; they are not saved. Then the tokens are whitened and batch
normalisation is folded, which leaves the output as it was. The last part trains expected errors and refinement head.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, logsigmoid

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, write_file
from lerobot_memobench.perception.detector import (
    COARSE,
    FINE,
    FINER,
    GEOMETRY,
    Detector,
    DetectorOutput,
    Heads,
    PyramidLevel,
    load_detector,
    peaks,
    save_detector,
)
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, ConvNorm, VisualEncoder
from lerobot_memobench.sim.asset import TABLE_TOP
from lerobot_memobench.training.loop import keep_freed_memory
from research.detector.data import Pictures
from research.detector.labels import MASK, Rows, images_of, projected

CHECKPOINT, LAST_CHECKPOINT = "training.pt", "last.pt"
WEIGHTS, LOSSES = "detector.safetensors", "losses.csv"
LOSS_WEIGHTS = {"heat": 1.0, "place": 2.0, "rest": 1.0, "mask": 0.5}
READING_WEIGHTS = {"fine": 1.0, "tokens": 0.5, "pooled": 0.5}
CELLS = {"fine": (FINER * GRID, FINE // FINER, 1), "tokens": (GRID, FINE, COARSE), "pooled": (POOLED, FINE, COARSE)}
"""Side of the square of tokens, and the cells of heat map and geometry along a token's side, of each reading."""
GAIN, SHIFT, NOISE = 0.12, 0.06, 0.02
"""Augmentation: largest gain of each colour and shift of all, and the noise's standard deviation at most, as shares of
white. Videos change colours and edges about as much."""
WINDOW = 10
"""Updates over which a row of `LOSSES` averages."""
WHITENING_IMAGES = 2048
"""Images over which tokens are whitened."""
LAST_UPDATES, UNCERTAINTY_RATE, SCORE_RATE = 1000, 1e-2, 3e-3
"""Updates of the last part, and the highest learning rates of expected errors and of the refinement head."""
BATCH = 64
"""Images of a batch for whitening."""
CLIP = 5.0
"""Norm to which gradients are clipped."""

LEAST_PIXELS = 15
"""Pixels of the rendered image that must show an object for it to be a target."""
SIGMA, SPREAD = 0.8, 2
"""Standard deviation and half side of an object's peak in the heat map, in cells."""
RIGHT_HEAT = 0.2
"""Target heat from which on a peak is right: the centre's cell and those that touch it."""
SCALES = (1.0, 1.0, 5.0, 5.0, 10.0, 1.0, 0.3, 0.3)
"""Weight of an error of one, for each of `GEOMETRY`: cells, metres (radians), cross entropy, parts of a circle."""
DEPTH, HEIGHT, LIT = (GEOMETRY.index(name) for name in ("depth", "height", "lit"))
REACH = 1.0
"""Largest offset of an object's origin from a cell's centre along each side of the image, its side being one: of a
door, a stove or a pan the wrist camera shows a part, and the origin lies outside."""
FLOOR = 1e-3
"""Share of the largest variance below which whitening does not enlarge a direction: it is noise."""

half = partial(torch.autocast, "cpu", torch.bfloat16)
"""Passes forward in bfloat16: an update takes 0.7 instead of 1.2 s. Losses, weights and saved outputs are float32."""

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with the updates done, their number, and the newest losses."""


@dataclass(frozen=True)
class Training:
    """Settings of a training; ``rate`` is the highest learning rate, after a twentieth of the updates."""

    updates: int = 2000
    batch: int = 32
    rate: float = 2e-3
    decay: float = 0.02
    seed: int = 0
    start: str | None = None
    """Detector to begin with, a file or `detector.PACKAGE`; None: random weights. After 40 updates in the scenes of
    LIBERO, that of version 0.2 had a heat loss of 0.87, random weights 3.41."""


def train(
    pictures: Pictures,
    kinds: tuple[str, ...],
    folder: Path,
    settings: Training,
    *,
    encoder: Callable[[], VisualEncoder] = VisualEncoder,
    save_every: int = 50,
    progress: Progress | None = None,
) -> Path:
    """Train a detector of ``kinds``, or resume the training in ``folder``; return the file of its weights."""
    folder.mkdir(parents=True, exist_ok=True)
    keep_freed_memory()
    torch.manual_seed(settings.seed)
    if settings.start is None:
        detector = Detector(encoder(), kinds)
    else:
        detector = load_detector(settings.start)
        if detector.kinds != kinds:
            raise MemobenchError(f"the detector of {settings.start} knows other kinds of objects; leave start out")
        unfold(detector, images_of(pictures.rows(_chosen(settings, 0, len(pictures)))))
    trainer = _Trainer(TokenHeads(detector), settings, len(pictures))
    trainer.restore(folder / CHECKPOINT)
    if trainer.update < settings.updates:
        (folder / LAST_CHECKPOINT).unlink(missing_ok=True)  # of another detector, whose checkpoint was taken away
    while trainer.update < settings.updates:
        trainer.step(pictures.rows(_chosen(settings, trainer.update, len(pictures))))
        if trainer.update % save_every == 0 or trainer.update == settings.updates:
            trainer.save(folder)
        if progress is not None and trainer.update % WINDOW == 0:
            newest = ", ".join(f"{name} {value:.3f}" for name, value in trainer.points[-1].items())
            progress(trainer.update, settings.updates, newest)
    whiten(detector, _sample(pictures))
    train_last(detector, pictures, settings, progress, folder / LAST_CHECKPOINT, save_every)
    save_detector(detector, folder / WEIGHTS)
    return folder / WEIGHTS


@torch.no_grad()
def unfold(detector: Detector, images: Tensor) -> None:
    """Put batch normalisation back behind the convolutions of a folded detector.

    Its output for ``images`` stays, because each normalisation scales to the mean and variance that it finds there.
    """

    def match(norm: nn.BatchNorm2d, conv: nn.Module, inputs: tuple[Tensor], output: Tensor) -> None:
        variance, mean = torch.var_mean(output, dim=(0, 2, 3), correction=0)
        moments = {"running_mean": mean, "running_var": variance, "num_batches_tracked": torch.tensor(0)}
        norm.load_state_dict({"weight": (variance + norm.eps).sqrt(), "bias": mean, **moments})

    handles = []
    for part in detector.modules():
        if isinstance(part, ConvNorm):
            part.norm = nn.BatchNorm2d(part.conv.out_channels).eval()
            handles.append(part.conv.register_forward_hook(partial(match, part.norm)))
    detector(images)
    for handle in handles:
        handle.remove()


class TokenHeads(nn.Module):
    """A detector in training, with heads on its encoder's tokens and pooled tokens."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        width, kinds = detector.encoder.width, len(detector.kinds)
        self.detector = detector
        self.token_heads, self.pooled_heads = Heads(width, kinds, GRID), Heads(width, kinds, POOLED)

    def forward(self, images: Tensor) -> dict[str, DetectorOutput]:
        """Return the output of each of `CELLS` for images (N, 3, SIDE, SIDE) in [0, 1]."""
        encoder = self.detector.encoder
        tokens, maps = encoder.tokens_and_maps(images)
        return {
            "fine": self.detector.read(self.detector.fpn(tokens, maps), maps),
            "tokens": self.token_heads(tokens),
            "pooled": self.pooled_heads(encoder.pooled(tokens)),
        }


class _Trainer:
    def __init__(self, model: TokenHeads, settings: Training, pictures: int) -> None:
        self.model, self._settings, self._pictures = model, settings, pictures
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._optimizer = torch.optim.AdamW(model.parameters(), settings.rate, weight_decay=settings.decay)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, settings.rate, settings.updates, pct_start=0.05, cycle_momentum=False
        )
        self.update = 0
        self.points: list[dict[str, float]] = []
        self._window: list[Mapping[str, Tensor]] = []

    def step(self, rows: Rows) -> None:
        """Make one update."""
        self.model.train()
        images = augmented(images_of(rows), _generator(self._settings, self.update))
        with half():
            outputs = self.model(images)
        losses, weighted = {}, []
        for reading, cells in CELLS.items():
            for name, value in loss(outputs[reading], targets(rows, len(self.model.detector.kinds), *cells)).items():
                losses[f"{reading} {name}"] = value.detach()
                weighted.append(READING_WEIGHTS[reading] * LOSS_WEIGHTS[name] * value)
        self._optimizer.zero_grad()
        torch.stack(weighted).sum().backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), CLIP)
        self._optimizer.step()
        self._schedule.step()
        self.update += 1
        self._window.append(losses)
        if len(self._window) == WINDOW:
            means = {name: float(torch.stack([one[name] for one in self._window]).mean()) for name in losses}
            self.points.append(means)
            self._window = []

    def save(self, folder: Path) -> None:
        """Write checkpoint and losses."""
        state = {
            "settings": asdict(self._settings),
            "pictures": self._pictures,
            "model": self.model.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(),
            "update": self.update,
            "points": self.points,
            "window": self._window,
        }
        with draft_of(folder / CHECKPOINT) as draft:
            torch.save(state, draft)
        rows = [",".join(["update", *(self.points[0] if self.points else ())])]
        rows += [
            f"{WINDOW * (place + 1)},{','.join(map(str, means.values()))}" for place, means in enumerate(self.points)
        ]
        write_file(folder / LOSSES, "\n".join(rows) + "\n")

    def restore(self, path: Path) -> None:
        """Resume from a checkpoint, if there is one."""
        if not path.is_file():
            return
        state: dict[str, Any] = torch.load(path, weights_only=True)
        if (state["settings"], state["pictures"]) != (asdict(self._settings), self._pictures):
            raise MemobenchError(
                f"{path} is of a training with {state['settings']} and {state['pictures']} pictures, and now "
                f"{asdict(self._settings)} and {self._pictures} are asked for; ask for the same, or take another folder"
            )
        self.model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.update, self.points, self._window = state["update"], state["points"], state["window"]


def train_last(
    detector: Detector,
    pictures: Pictures,
    settings: Training,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    save_every: int = 50,
) -> None:
    """Train expected errors and refinement head of a trained detector, or resume this; all else in it stays."""
    detector.eval().requires_grad_(False)
    uncertainty, refinement = detector.fine_heads.uncertainty, detector.refinement_head
    assert uncertainty is not None
    updates = min(LAST_UPDATES, settings.updates)
    parts = ((uncertainty, UNCERTAINTY_RATE), (refinement, SCORE_RATE))
    optimizer = torch.optim.Adam(
        [{"params": part.requires_grad_(True).parameters(), "lr": rate} for part, rate in parts]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    kept: dict[str, Any] = {
        "uncertainty": uncertainty,
        "refinement": refinement,
        "optimizer": optimizer,
        "schedule": schedule,
    }
    if checkpoint is not None and checkpoint.is_file():
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        for name, part in kept.items():
            part.load_state_dict(state[name])
    for update in range(schedule.last_epoch, updates):
        rows = pictures.rows(_chosen(settings, settings.updates + update, len(pictures)))
        images = augmented(images_of(rows), _generator(settings, settings.updates + update))
        with half():
            tokens, maps = detector.encoder.tokens_and_maps(images)
            output = detector.read(detector.fpn(tokens, maps), maps)
        wanted = targets(rows, len(detector.kinds), *CELLS["fine"])
        errors, wrong = uncertainty_loss(output, wanted), score_loss(output, wanted)
        optimizer.zero_grad()
        (errors + wrong).backward()
        optimizer.step()
        schedule.step()
        if checkpoint is not None and (update + 1) % save_every == 0:
            with draft_of(checkpoint) as draft:
                torch.save({name: part.state_dict() for name, part in kept.items()}, draft)
        if progress is not None and update % WINDOW == WINDOW - 1:
            newest = f"uncertainty {errors.item():.2f}, score {wrong.item():.3f} after {update + 1} of {updates}"
            progress(settings.updates, settings.updates, newest)


def _sample(pictures: Pictures) -> Iterator[Tensor]:
    chosen = np.linspace(0, len(pictures) - 1, min(len(pictures), WHITENING_IMAGES)).astype(np.int64)
    for indices in np.array_split(chosen, -(-len(chosen) // BATCH)):
        yield images_of(pictures.rows(indices))


def _chosen(settings: Training, update: int, count: int) -> NDArray[np.int64]:
    """Return the indices of an update's images: all of them once, then all in another order."""
    size = min(settings.batch, count)
    epoch, place = divmod(update, count // size)
    return _permutation(settings.seed, epoch, count)[place * size : (place + 1) * size]


@lru_cache(maxsize=1)
def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)


def _generator(settings: Training, update: int) -> torch.Generator:
    return torch.Generator().manual_seed(settings.seed * 2**32 + update)


def augmented(images: Tensor, generator: torch.Generator) -> Tensor:
    """Return images (N, 3, H, W) in [0, 1] in another light and with noise, each by itself."""

    def draw(channels: int) -> Tensor:
        return 2 * torch.rand(len(images), channels, 1, 1, generator=generator) - 1

    images = (images * (1 + GAIN * draw(3))).add_(SHIFT * draw(1))
    return images.addcmul_(NOISE * draw(1).abs(), torch.randn(images.shape, generator=generator)).clamp_(0, 1)


@dataclass(frozen=True)
class Targets:
    """Targets of a batch of images.

    Attributes:
        heat: (N, kinds, cells, cells), 1 at an object's visible centre, falling off around it.
        cells: (n, 4) coarse cells near objects: image, kind, row, column.
        geometry: (n, len(GEOMETRY)) of those, NaN where there is none. weights: (n,).
        mask: (N, cells, cells), visible kind + 1, 0 for background.
    """

    heat: Tensor
    cells: Tensor
    geometry: Tensor
    weights: Tensor
    mask: Tensor


def targets(rows: Rows, kinds: int, grid: int, fine: int = FINE, coarse: int = COARSE) -> Targets:
    """Return the targets of labelled images (N,); other arguments as of `detector.Heads`."""
    images, places = np.nonzero(
        (np.arange(rows["things"].shape[1]) < rows["count"][:, None]) & (rows["things"]["pixels"] >= LEAST_PIXELS)
    )
    things = rows["things"][images, places]
    cells, geometry, weights = _geometry(rows, things, images, coarse * grid)
    step = MASK // (fine * grid)
    mask = rows["mask"][:, step // 2 :: step, step // 2 :: step].astype(np.int64)
    return Targets(
        torch.from_numpy(_heat(things, images, (len(rows), kinds, fine * grid, fine * grid))),
        torch.from_numpy(cells),
        torch.from_numpy(geometry.astype(np.float32)),
        torch.from_numpy(weights.astype(np.float32)),
        torch.from_numpy(mask),
    )


def _heat(things: Rows, images: NDArray[np.int64], shape: tuple[int, int, int, int]) -> NDArray[np.float32]:
    heat, side = np.zeros(shape, np.float32), shape[-1]
    cell = np.clip((things["anchor"] * side).astype(np.int64), 0, side - 1)
    for down in range(-SPREAD, SPREAD + 1):
        for across in range(-SPREAD, SPREAD + 1):
            x, y = cell[:, 0] + across, cell[:, 1] + down
            inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
            where = (images[inside], things["kind"][inside].astype(np.int64), y[inside], x[inside])
            np.maximum.at(heat, where, np.float32(np.exp(-(across**2 + down**2) / (2 * SIGMA**2))))
    return heat


def _geometry(rows: Rows, things: Rows, images: NDArray[np.int64], side: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the four cells around each visible centre, (n, 4), the geometry there and its weights."""
    place, depth = projected(things["position"].astype(np.float64), rows[images])
    facts = np.column_stack(
        [depth, things["position"][:, 2] - TABLE_TOP, things["joint"], things["lit"], things["turn"]]
    )
    corner = np.floor(things["anchor"] * side - 0.5).astype(np.int64)
    found: list[tuple[NDArray[np.int64], Array, Array]] = []
    for offset in np.ndindex(2, 2):
        cell = corner + np.array(offset)
        far = np.abs(things["anchor"] * side - 0.5 - cell)
        from_centre = np.clip(place * side - 0.5 - cell, -REACH * side, REACH * side)
        index = np.column_stack([images, things["kind"], cell[:, 1], cell[:, 0]]).astype(np.int64)
        found.append((index, np.column_stack([from_centre, facts]), np.prod(1 - far, axis=1)))
    cells, geometry, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    inside = ((cells[:, 2:] >= 0) & (cells[:, 2:] < side)).all(axis=1)
    order = np.argsort(-weights[inside], kind="stable")  # of two of a kind in a cell the nearer is the target
    cells, geometry, weights = cells[inside][order], geometry[inside][order], weights[inside][order]
    _, first = np.unique(cells, axis=0, return_index=True)
    return cells[first], geometry[first], weights[first]


def loss(output: DetectorOutput, wanted: Targets) -> dict[str, Tensor]:
    """Return the losses (scalars) of an output: ``heat``, ``place``, ``rest`` of the geometry, and ``mask``."""
    geometry = output.geometry(*wanted.cells.T)
    error = (geometry - wanted.geometry).abs()
    error[:, LIT] = binary_cross_entropy_with_logits(geometry[:, LIT], wanted.geometry[:, LIT], reduction="none")
    error = error * torch.tensor(SCALES)
    error = torch.where(wanted.geometry.isnan(), torch.zeros(()), error) * wanted.weights[:, None]
    each = error.sum(dim=0) / wanted.weights.sum().clamp(min=1.0)
    return {
        "heat": _heat_loss(output.heatmap, wanted.heat),
        "place": each[:DEPTH].sum(),
        "rest": each[DEPTH:].sum(),
        "mask": cross_entropy(output.mask, wanted.mask),
    }


def _heat_loss(logits: Tensor, heat: Tensor) -> Tensor:
    """CenterNet's focal loss: less weight near a centre than far from it."""
    there = heat == 1
    likely = torch.sigmoid(logits.detach())
    weight = torch.where(there, (1 - likely) ** 2, (1 - heat) ** 4 * likely**2)
    return -(weight * logsigmoid(torch.where(there, logits, -logits))).sum() / there.sum().clamp(min=1)


def uncertainty_loss(output: DetectorOutput, wanted: Targets) -> Tensor:
    """Return the negative log likelihood of the geometry's errors, Laplace distributed; no gradient reaches those."""
    if output.uncertainty is None:
        raise ValueError("these heads predict no uncertainty")
    off = (output.geometry(*wanted.cells.T).detach() - wanted.geometry).abs()
    size = torch.column_stack([torch.linalg.vector_norm(off[:, :2], dim=1), off[:, DEPTH], off[:, HEIGHT]])
    log = output.uncertainty(*wanted.cells.T)
    return ((log + size * torch.exp(-log)).sum(dim=1) * wanted.weights).sum() / wanted.weights.sum().clamp(min=1.0)


def score_loss(output: DetectorOutput, wanted: Targets) -> Tensor:
    """Return the cross entropy of the scores of all peaks, plus that of all kinds at their cells.

    The second counts as much and trains the same network.
    """
    if output.score is None:
        raise ValueError("this output is not refined")
    _, cells = peaks(replace(output, score=None))  # queried below, once
    image, kind, row, column = (cell.flatten() for cell in cells)
    right = (wanted.heat[image, :, row, column] > RIGHT_HEAT).float()
    every = binary_cross_entropy_with_logits(output.score(image, kind, row, column), right, reduction="none")
    return every.gather(1, kind[:, None]).mean() + every.mean()


@torch.no_grad()
def whiten(detector: Detector, batches: Iterable[Tensor]) -> None:
    """Fold a detector and whiten its encoder's tokens and pooled tokens over images; its output stays as it was.

    Half of all variance of the encoder's own tokens is in one direction, and their mean is as large as what varies;
    gradients learn that first. Of whitened tokens, a memory of where the butter was put is read after 50 updates
    instead of 200 (three layers of a policy's memory on 100 prompts, the place taught directly).

    Args:
        batches: images (N, 3, SIDE, SIDE) in [0, 1].
    """
    encoder = detector.eval().encoder
    encoder.fold()
    ours, pooled = _Moments(encoder.width), _Moments(encoder.width)
    for images in batches:
        tokens = encoder(images)
        ours.add(tokens)
        pooled.add(encoder.pooled(tokens))
    mean, whitening = ours.whitening()
    assert isinstance(encoder.decorrelate, nn.Linear)
    _whiten_output(encoder.decorrelate, whitening, mean)
    near = encoder.pool.in_features // encoder.width
    _undo_in_input(encoder.pool, torch.block_diag(*[whitening] * near), mean.repeat(near))
    coarsest = detector.fpn.levels[0]
    assert isinstance(coarsest, PyramidLevel)
    _undo_in_input(coarsest.upsample, whitening, mean)
    mean, whitening = pooled.whitening()
    _whiten_output(encoder.pool, whitening, mean)


class _Moments:
    def __init__(self, width: int) -> None:
        self.count, self.total = 0, torch.zeros(width, dtype=torch.float64)
        self.squares = torch.zeros(width, width, dtype=torch.float64)

    def add(self, tokens: Tensor) -> None:
        """Take tokens (..., d)."""
        rows = tokens.flatten(0, -2).double()
        self.count += len(rows)
        self.total += rows.sum(dim=0)
        self.squares += rows.T @ rows

    def whitening(self) -> tuple[Tensor, Tensor]:
        """Return the mean m (d,) and A (d, d) such that A (x - m) is white; A as bfloat16 holds it, in float64."""
        mean = self.total / self.count
        variances, directions = torch.linalg.eigh(self.squares / self.count - torch.outer(mean, mean))
        sizes = variances.clamp_min(FLOOR * float(variances[-1])).sqrt()
        return mean, ((directions / sizes) @ directions.T).bfloat16().double()


def _whiten_output(linear: nn.Linear, whitening: Tensor, mean: Tensor) -> None:
    """Change a Linear so that it returns A (y - m) instead of y."""
    _set(linear, whitening @ linear.weight.double(), whitening @ (linear.bias.double() - mean))


def _undo_in_input(linear: nn.Linear, whitening: Tensor, mean: Tensor) -> None:
    """Change a Linear so that its output for A (x - m) is the former output for x."""
    weight = linear.weight.double()
    _set(linear, weight @ torch.linalg.inv(whitening), linear.bias.double() + weight @ mean)


def _set(linear: nn.Linear, weight: Tensor, bias: Tensor) -> None:
    linear.weight.copy_(weight)
    linear.bias.copy_(bias)
