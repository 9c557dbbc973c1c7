"""Eyes learn from labelled pictures; a run that was stopped goes on where it was."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_memobench.computing.bfloat16 import quicker_in_bfloat16
from lerobot_memobench.computing.freed_memory import keep_freed_memory
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import draft_of, draw_curve, mean_of
from lerobot_memobench.perception.heads import COARSE, FINE
from lerobot_memobench.perception.labels import Rows, images_of
from lerobot_memobench.perception.neck import FINER
from lerobot_memobench.perception.pictures import Pictures
from lerobot_memobench.perception.targets import doubt_loss, loss, sure_loss, targets
from lerobot_memobench.perception.tower import GRID, POOLED, Tower
from lerobot_memobench.perception.weights import Eyes, save_eyes
from lerobot_memobench.perception.whitening import whiten

CHECKPOINT, LAST, WEIGHTS, CURVE = "training.pt", "last.pt", "eyes.safetensors", "training_curve.png"
SHARES = {"heat": 1.0, "place": 2.0, "rest": 1.0, "mask": 0.5}
"""What each loss counts."""
COUNT = {"fine": 1.0, "tokens": 0.5, "pooled": 0.5}
"""What the losses of each reading count."""
CELLS = {"fine": (FINER * GRID, FINE // FINER, 1), "tokens": (GRID, FINE, COARSE), "pooled": (POOLED, FINE, COARSE)}
"""Side of the square of tokens, and the cells of heat and geometry along a token's side, in each reading."""
GAIN, SHIFT, NOISE = 0.12, 0.06, 0.02
"""Changes of pictures: largest gain of each colour and shift of all, and the noise's standard deviation at most, as
shares of white. Videos change colours and edges about as much."""
WINDOW = 10
"""Updates that one point of the curve is the mean of."""
WHITENED = 2048
"""Pictures over which tokens are made white in the end."""
LAST_UPDATES, DOUBT_RATE, SURE_RATE = 5000, 1e-2, 3e-3
"""Updates of the doubts and the second look alone, after that, and the highest learning rates of both."""
BATCH = 64
"""Pictures that are looked at together then."""
CLIP = 5.0
"""Norm that a gradient is cut to."""

Progress = Callable[[int, int, str], None]
"""Told of updates done, of how many, and of the newest losses."""


@dataclass(frozen=True)
class Training:
    """What a training depends on besides its pictures.

    Attributes:
        updates: how many. batch: pictures of each. rate: highest learning rate; it rises for a twentieth of the updates
            and falls as a cosine. decay: of the weights. seed: of weights, order and changes of pictures.
    """

    updates: int = 18_000
    batch: int = 32
    rate: float = 2e-3
    decay: float = 0.02
    seed: int = 0


def train(
    pictures: Pictures,
    kinds: tuple[str, ...],
    folder: Path,
    settings: Training,
    *,
    tower: Callable[[], Tower] = Tower,
    save_every: int = 50,
    progress: Progress | None = None,
) -> Path:
    """Train eyes, or go on with the training that a folder holds; return the file of their weights.

    Args:
        pictures: with labels. kinds: names of the things in them. folder: gets checkpoint, curve and weights.
        tower: makes the one to train. save_every: updates between two checkpoints.

    Raises:
        MemobenchError: the folder's training has other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    keep_freed_memory()
    torch.manual_seed(settings.seed)
    learner = _Learner(Eyes(tower(), kinds), settings, len(pictures))
    learner.restore(folder / CHECKPOINT)
    if learner.update < settings.updates:
        (folder / LAST).unlink(missing_ok=True)  # of other eyes, whose checkpoint was taken away
    while learner.update < settings.updates:
        learner.learn(pictures.rows(learner.order()))
        if learner.update % save_every == 0 or learner.update == settings.updates:
            learner.save(folder)
        if progress is not None and learner.update % WINDOW == 0:
            newest = ", ".join(f"{name} {value:.3f}" for name, value in learner.points[-1].items())
            progress(learner.update, settings.updates, newest)
    whiten(learner.eyes, _some(pictures))
    learn_last(learner.eyes, pictures, settings, progress, folder / LAST, save_every)
    save_eyes(learner.eyes, folder / WEIGHTS)
    return folder / WEIGHTS


def _some(pictures: Pictures) -> Iterator[Tensor]:
    """Yield batches of pictures from all over."""
    chosen = np.linspace(0, len(pictures) - 1, min(len(pictures), WHITENED)).astype(np.int64)
    for numbers in np.array_split(chosen, -(-len(chosen) // BATCH)):
        yield images_of(pictures.rows(numbers))


def learn_last(
    eyes: Eyes,
    pictures: Pictures,
    settings: Training,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    save_every: int = 50,
) -> None:
    """Have trained eyes learn how far off they are where they find things, and how sure finds are at a second look; all
    else in them stays as it is. It goes on from a checkpoint, if there is one.
    """
    eyes.eval().requires_grad_(False)
    doubt, second_look = eyes.fine_heads.doubt, eyes.second_look
    assert doubt is not None
    updates = min(LAST_UPDATES, settings.updates)
    parts = ((doubt, DOUBT_RATE), (second_look, SURE_RATE))
    optimizer = torch.optim.Adam(
        [{"params": part.requires_grad_(True).parameters(), "lr": rate} for part, rate in parts]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    kept = {"doubt": doubt, "second look": second_look, "optimizer": optimizer, "schedule": schedule}
    if checkpoint is not None and checkpoint.is_file():
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        for name, part in kept.items():
            part.load_state_dict(state[name])
    for update in range(schedule.last_epoch, updates):
        rows = pictures.rows(_chosen(settings, settings.updates + update, len(pictures)))
        images = changed(images_of(rows), _chance(settings, settings.updates + update))
        with torch.autocast("cpu", torch.bfloat16, enabled=quicker_in_bfloat16()):
            tokens, maps = eyes.tower.looked(images)
            fine = eyes.neck(tokens, maps)
        said = eyes.read(fine.float(), maps)  # bfloat16 is off itself
        wanted = targets(rows, len(eyes.kinds), *CELLS["fine"])
        off, wrong = doubt_loss(said, wanted), sure_loss(said, wanted)
        optimizer.zero_grad()
        (off + wrong).backward()
        optimizer.step()
        schedule.step()
        if checkpoint is not None and (update + 1) % save_every == 0:
            with draft_of(checkpoint) as draft:
                torch.save({name: part.state_dict() for name, part in kept.items()}, draft)
        if progress is not None and update % WINDOW == WINDOW - 1:
            newest = f"doubt {off.item():.2f}, sure {wrong.item():.3f} after {update + 1} of {updates}"
            progress(settings.updates, settings.updates, newest)


def _chosen(settings: Training, update: int, count: int) -> NDArray[np.int64]:
    """Return the numbers of the pictures of an update: all of them once, then all in another order."""
    size = min(settings.batch, count)
    epoch, place = divmod(update, count // size)
    return _permutation(settings.seed, epoch, count)[place * size : (place + 1) * size]


def _chance(settings: Training, update: int) -> torch.Generator:
    """Return where an update's changes of pictures are drawn from."""
    return torch.Generator().manual_seed(settings.seed * 2**32 + update)


class _Learner:
    """Eyes and all that decides how they go on."""

    def __init__(self, eyes: Eyes, settings: Training, pictures: int) -> None:
        self.eyes, self._settings, self._pictures = eyes, settings, pictures
        eyes.to(memory_format=torch.channels_last)
        self._optimizer = torch.optim.AdamW(eyes.parameters(), settings.rate, weight_decay=settings.decay)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, settings.rate, settings.updates, pct_start=0.05, cycle_momentum=False
        )
        self.update = 0
        self.points: list[dict[str, float]] = []
        self._window: list[Mapping[str, Tensor]] = []

    def order(self) -> NDArray[np.int64]:
        """Return the numbers of the pictures of the next update."""
        return _chosen(self._settings, self.update, self._pictures)

    def learn(self, rows: Rows) -> None:
        """Make one update."""
        self.eyes.train()
        losses = self._losses(rows)
        total = [COUNT[name.split()[0]] * SHARES[name.split()[1]] * value for name, value in losses.items()]
        self._optimizer.zero_grad()
        torch.stack(total).sum().backward()
        torch.nn.utils.clip_grad_norm_(self.eyes.parameters(), CLIP)
        self._optimizer.step()
        self._schedule.step()
        self.update += 1
        self._window.append({name: value.detach() for name, value in losses.items()})
        if len(self._window) == WINDOW:
            self.points.append(mean_of(self._window))
            self._window = []

    def _losses(self, rows: Rows) -> dict[str, Tensor]:
        images = changed(images_of(rows), _chance(self._settings, self.update))
        with torch.autocast("cpu", torch.bfloat16, enabled=quicker_in_bfloat16()):
            said = self.eyes(images)
        return {
            f"{reading} {name}": value
            for reading, cells in CELLS.items()
            for name, value in loss(said[reading], targets(rows, len(self.eyes.kinds), *cells)).items()
        }

    def save(self, folder: Path) -> None:
        """Write checkpoint and curve."""
        state = {
            "settings": asdict(self._settings),
            "pictures": self._pictures,
            "eyes": self.eyes.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(),
            "update": self.update,
            "points": self.points,
            "window": self._window,
        }
        with draft_of(folder / CHECKPOINT) as draft:
            torch.save(state, draft)
        draw_curve(self.points, WINDOW, folder / CURVE)

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one."""
        if not path.is_file():
            return
        state: dict[str, Any] = torch.load(path, weights_only=True)
        if (state["settings"], state["pictures"]) != (asdict(self._settings), self._pictures):
            raise MemobenchError(
                f"{path} is of a training with {state['settings']} and {state['pictures']} pictures, and now "
                f"{asdict(self._settings)} and {self._pictures} are asked for; ask for the same, or take another folder"
            )
        self.eyes.load_state_dict(state["eyes"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        self.update, self.points, self._window = state["update"], state["points"], state["window"]


@lru_cache(maxsize=1)
def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)


def changed(images: Tensor, chance: torch.Generator) -> Tensor:
    """Return pictures (N, 3, H, W) in [0, 1] in another light and with noise, each by itself."""

    def draw(channels: int) -> Tensor:
        return 2 * torch.rand(len(images), channels, 1, 1, generator=chance) - 1

    images = (images * (1 + GAIN * draw(3))).add_(SHIFT * draw(1))
    return images.addcmul_(NOISE * draw(1).abs(), torch.randn(images.shape, generator=chance)).clamp_(0, 1)
