"""A second look at finds: how sure they are, by what is around them and all that the same place is taken for.

A cell's heat is read off its own numbers by a linear map, kind by kind: where little shows, it speaks of several kinds
at once, and each may pass for found. Only the few peaks are looked at again, so this may be a network, see what is
around, and see the tower's map of cells half as wide: the second stage of a detector (Faster R-CNN, Ren et al. 2015).
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import max_pool2d, pad, relu

from lerobot_memobench.perception.heads import Ask

HIDDEN, CLOSE = 96, 24
"""Width of the network, and channels of what it sees of the tower."""
AROUND, NEAR = 5, 13
"""Side of the square around a find that it sees: in cells of the finer map, and in the tower's, half as wide."""
SPREAD = 4.0
"""What logits of the heat are divided by: about how far apart they are."""


class SecondLook(nn.Module):
    """From the finer map, the tower's that is twice as fine, and the heat to how sure finds are.

    Args:
        width: of the finer map. close: channels of the tower's. kinds: how many kinds of things there are.
    """

    def __init__(self, width: int, close: int, kinds: int) -> None:
        super().__init__()
        self.around = nn.Linear(width * AROUND**2, HIDDEN)
        self.close = nn.Conv2d(close, CLOSE, 3, stride=2)
        self.near = nn.Linear(CLOSE * (NEAR // 2) ** 2, HIDDEN, bias=False)
        self.heard = nn.Linear(kinds, HIDDEN, bias=False)
        self.deeper = nn.Linear(HIDDEN, HIDDEN)
        self.sure = nn.Linear(HIDDEN, kinds)

    def forward(self, fine: Tensor, close: Tensor, heat: Tensor) -> Ask:
        """Return what says of peaks' places whether a thing of each kind is there, a logit each.

        Args:
            fine: (N, side², width) the finer map, row by row. close: (N, channels, 2 side, 2 side) the tower's.
            heat: (N, kinds, side, side) logits of the finer map.
        """
        finer = fine.unflatten(1, heat.shape[-2:]).permute(0, 3, 1, 2)

        def ask(picture: Tensor, _: Tensor, row: Tensor, column: Tensor) -> Tensor:
            where = (picture, slice(None), row, column)
            around = _squares(finer, AROUND, 1)[where]
            near = relu(self.close(_squares(close, NEAR, 2)[where]))
            heard = max_pool2d(heat, 3, 1, 1)[where] / SPREAD
            seen = relu(self.around(around.flatten(1)) + self.near(near.flatten(1)) + self.heard(heard))
            said: Tensor = self.sure(seen + relu(self.deeper(seen)))
            return said

        return ask


def _squares(maps: Tensor, side: int, step: int) -> Tensor:
    """Return the squares around every ``step``-th cell of maps (N, C, H, W), zeros outside of them.

    Returns:
        (N, C, H / step, W / step, side, side).
    """
    return pad(maps.float(), (side // 2,) * 4).unfold(2, side, step).unfold(3, side, step)
