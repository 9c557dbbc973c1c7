"""Parts of training: the actions' loss, ranks of a distributed run, and the curve.

Actions are learned by flow matching, as in pi0.5, or by regression, through the same passes of the same model. Flow
matching learns the velocity ``noise - actions`` at every time between the two, and a chunk follows it from drawn noise.
Regression asks at one place only, zero noise at time 1: the velocity there is minus the actions, and one Euler step
ends at them.

LeRobot trains several processes with DDP, which averages gradients over them. All that ranks count together here is
made for that average: it is then the gradient of the joint batch. Every rank must come by at the same time.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from einops import rearrange, reduce
from torch import Tensor
from torch.autograd.function import once_differentiable

from lerobot_memobench.io import draft_of, read_json, write_file
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import REGRESSION
from lerobot_memobench.policies.memobench_mem.memory.mechanism import PHASE

_SMOOTH = 1e-6
"""Square of the error below which the absolute error bends into its square: 0.001 of an action's deviation."""


def noise_and_time(objective: str, model: Any, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return where a batch of actions (B, T, A) is learned: noise (B, T, A) and time (B,)."""
    if objective == REGRESSION:
        return torch.zeros_like(actions), actions.new_ones(actions.shape[0])
    return (
        model.sample_noise(actions.shape, actions.device),
        model.sample_time(actions.shape[0], actions.device),
    )


def losses_of(objective: str, squared: Tensor) -> Tensor:
    """Return losses (B, T, A) of squared errors of the velocity: themselves, and for regression absolute errors with
    them.

    Absolute errors make actions exact, and squared ones are what a memory is learned by: to have chosen another of
    three bowls is a large error in few frames. After 800 updates 20 of 20 bowls were right by both, 15 by squared
    ones, one by absolute ones.
    """
    return squared + (squared + _SMOOTH).sqrt() if objective == REGRESSION else squared


ACTION_IS_PAD = "action_is_pad"


class ActionLoss(NamedTuple):
    """Loss per sample (B,), 0 where none of its actions counts; its mean over samples that count; and per number of an
    action (A,).
    """

    per_sample: Tensor
    mean: Tensor
    per_dim: Tensor


def counted_actions(batch: Mapping[str, Tensor], losses: Tensor) -> Tensor:
    """Return (B, T) 1 for actions of a batch that count: of the execution, and no padding.

    LeRobot pads chunks that reach beyond the end of their episode, and says so by ``action_is_pad`` (B, T).
    """
    counted = torch.ones(losses.shape[:2], device=losses.device)
    if ACTION_IS_PAD in batch:
        counted = counted * ~batch[ACTION_IS_PAD].to(losses.device)
    if PHASE in batch:
        counted = counted * rearrange(batch[PHASE].reshape(-1).to(losses.device) != 0, "b -> b 1")
    return counted


def mean_losses(losses: Tensor, counted: Tensor) -> ActionLoss:
    """Mean of losses (B, T, A) over the actions that count (B, T), each of which weighs the same.

    With several ranks the average of their means is the mean of the joint batch.
    """
    numbers = torch.stack([counted.sum(), counted.any(dim=1).sum()])
    actions, samples = mean_over_ranks(numbers).clamp(min=1.0 / world_size())
    per_sample = (reduce(losses, "b t a -> b t", "mean") * counted).sum(dim=1) * (samples / actions)
    per_dim = reduce(losses.detach() * rearrange(counted, "b t -> b t 1"), "b t a -> a", "sum") / actions
    return ActionLoss(per_sample, per_sample.sum() / samples, per_dim)


# -- ranks ------------------------------------------------------------------------------------------------------------


def world_size() -> int:
    """Return how many processes train together; 1 where none were started."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def mean_over_ranks(value: Tensor) -> Tensor:
    """Return the mean of a number over the ranks, without gradient: a sum's denominator.

    A rank's sum over this is its loss; the average of those losses is the joint sum over the joint count.
    """
    value = value.detach().clone()
    if world_size() > 1:
        dist.all_reduce(value)
    return value / world_size()


def is_first_rank() -> bool:
    """Return whether this process writes what all of them have in common."""
    return world_size() == 1 or dist.get_rank() == 0


def means_over_ranks(numbers: Mapping[str, Any], device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return the same with each float's mean over the ranks, all of which name the same ones."""
    if world_size() == 1:
        return dict(numbers)
    floats = [name for name, value in numbers.items() if isinstance(value, float)]
    means = mean_over_ranks(torch.tensor([numbers[name] for name in floats], device=device))
    return {**numbers, **dict(zip(floats, means.tolist(), strict=True))}


def joint(rows: Tensor) -> Tensor:
    """Return the rows (n, D) of all ranks, (sum of n, D), in the order of the ranks; n may differ, and may be 0.

    Gradients flow back to the rank that a row came from, summed over the ranks. Where each rank computes the same loss
    of the joint rows, that is ``world_size`` times the loss's gradient, which DDP's average makes right again; what
    every rank holds itself (a temperature) gets the same gradient everywhere and keeps it.
    """
    if world_size() == 1:
        return rows
    counts = torch.zeros(world_size(), dtype=torch.int64, device=rows.device)
    counts[dist.get_rank()] = len(rows)
    dist.all_reduce(counts)
    gathered: Tensor = _Gather.apply(rows, counts.tolist())
    return gathered


class _Gather(torch.autograd.Function):
    """All-gather of rows of known counts; backward is its transpose, a sum over ranks."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, counts: list[int]) -> Tensor:
        first = sum(counts[: dist.get_rank()])
        ctx.own = slice(first, first + len(rows))
        # Collectives want equal shapes.
        padded = rows.new_zeros(max(counts), *rows.shape[1:])
        padded[: len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in counts]
        dist.all_gather(parts, padded)
        return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        gradient = gradient.contiguous().clone()
        dist.all_reduce(gradient)
        return gradient[ctx.own], None


# -- curve of the losses ----------------------------------------------------------------------------------------------


PICTURE, NUMBERS = "training_curve.png", "training_curve.json"
WINDOW = 10
"""Updates that one point is the mean of."""
LOSS = "action_loss"
SHARES = ("align_top1",)
"""What is no loss, and runs from 0 to 1."""
HIDDEN = ("loss", "align_grad_norm", "align_temperature")
"""What is kept as numbers, and not drawn."""


class TrainingCurve:
    """Means of what a policy logs, over windows of updates.

    Attributes:
        points: one per whole window, name -> mean.
        held_out: one per look at episodes that are not trained on: after how many updates, and the actions' mean loss.
    """

    def __init__(self) -> None:
        self.points: list[dict[str, float]] = []
        self.held_out: list[dict[str, float]] = []
        self._window: list[dict[str, float]] = []
        self._unseen: list[dict[str, float]] = []

    def note(self, logged: Mapping[str, Any]) -> None:
        """Take in what one update logged; lists are left out."""
        self._end_look()
        self._window.append({name: float(value) for name, value in logged.items() if isinstance(value, int | float)})
        if len(self._window) == WINDOW:
            self.points.append(dict(sorted(mean_of(self._window).items())))
            self._window = []

    def note_held_out(self, logged: Mapping[str, Any]) -> None:
        """Take in what one batch of held-out episodes logged; those between two updates make one look."""
        self._unseen.append({LOSS: logged[LOSS]})

    def _end_look(self) -> None:
        if self._unseen:
            updates = WINDOW * len(self.points) + len(self._window)
            self.held_out.append({"updates": updates, **mean_of(self._unseen)})
            self._unseen = []

    def save(self, folder: Path) -> None:
        """Write numbers and picture to a checkpoint's folder; nothing before the first whole window."""
        self._end_look()
        if not self.points:
            return
        numbers = {"updates_per_point": WINDOW, "points": self.points, "held_out": self.held_out}
        write_file(folder / NUMBERS, json.dumps(numbers))
        measured = {f"{LOSS}, held out": [(look["updates"], look[LOSS]) for look in self.held_out]}
        draw_curve(self.points, WINDOW, folder / PICTURE, marked=measured, hidden=HIDDEN, shares=SHARES, columns=3)

    @classmethod
    def read(cls, folder: Path) -> TrainingCurve:
        """Return the curve of a checkpoint's folder, to go on with; an empty one where there is none."""
        found = cls()
        if (folder / NUMBERS).is_file():
            told = read_json(folder / NUMBERS, dict[str, Any], "remove it; the curve then begins anew")
            found.points, found.held_out = told["points"], told.get("held_out", [])
        return found


STYLES = {"fine": "-", "tokens": ":", "pooled": "--"}
"""How a loss is drawn whose name begins with this word, in one colour with all whose names go on alike."""


def mean_of(window: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the mean of each number over the updates that tell it, in the order in which they first appear."""
    values = {name: [float(one[name]) for one in window if name in one] for name in dict.fromkeys(chain(*window))}
    return {name: sum(found) / len(found) for name, found in values.items()}


def draw_curve(
    points: Sequence[Mapping[str, float]],
    window: int,
    path: Path,
    *,
    marked: Mapping[str, Sequence[tuple[float, float]]] = MappingProxyType({}),
    hidden: Collection[str] = (),
    shares: Collection[str] = (),
    columns: int = 4,
) -> None:
    """Draw means over windows of so many updates to a PNG; nothing before the first.

    Args:
        marked: name -> losses beside these, each after so many updates.
        hidden: names of what is left out. shares: names of what is no loss, and runs from 0 to 1.
        columns: of the legend.
    """
    import matplotlib as mpl

    if not points:
        return
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.4), constrained_layout=True)
    looks = _looks(name for name in dict.fromkeys(chain(*points)) if name not in hidden)
    right = axis.twinx() if set(looks) & set(shares) else None
    updates = [window * (place + 1) for place in range(len(points))]
    for name, look in looks.items():
        own = right if right is not None and name in shares else axis
        own.plot(updates, [point.get(name) for point in points], **look, lw=1.2, label=name)
    for name, places in marked.items():
        if places:
            axis.plot(*zip(*places, strict=True), "o--", color="black", ms=3, lw=0.8, label=name)
    axis.set(xlabel="updates", ylabel="loss", yscale="log")
    if right is not None:
        right.set(ylabel="share", ylim=(0, 1))
    axis.grid(alpha=0.3, which="both", lw=0.5)
    figure.legend(loc="outside upper center", ncols=columns, fontsize=8, frameon=False)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130, format="png")
    plt.close(figure)


def _looks(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return name -> style and colour of its line."""
    colours: dict[str, str] = {}
    looks = {}
    for name in names:
        first, _, rest = name.partition(" ")
        of = rest if first in STYLES else name
        looks[name] = {"linestyle": STYLES.get(first, "-"), "color": colours.setdefault(of, f"C{len(colours)}")}
    return looks
