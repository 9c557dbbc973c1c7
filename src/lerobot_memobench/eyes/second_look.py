"""A second look at finds: how sure they are, by what is around them and all that the same place is taken for.

A cell's heat is read off its own numbers by a linear map, kind by kind: where little shows, it speaks of several kinds
at once, and each may pass for found. Only the few peaks are looked at again, so this may be a network, see what is
around, and see the tower's map of cells half as wide: the second stage of a detector (Faster R-CNN, Ren et al. 2015).
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import max_pool2d, pad, relu

from lerobot_memobench.eyes.heads import Ask

HIDDEN, CLOSE = 96, 24
"""Width of the network, and channels of what it sees of the tower."""
AROUND, NEAR = 5, 13
"""Side of the square around a find that it sees: in cells of the finer map, and in the tower's, half as wide."""
HOT = 4.0
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
        side, edge = heat.shape[-1], AROUND // 2

        def ask(picture: Tensor, _: Tensor, row: Tensor, column: Tensor) -> Tensor:
            around = pad(fine.unflatten(1, (side, side)).float(), (0, 0, edge, edge, edge, edge))
            around = around.unfold(1, AROUND, 1).unfold(2, AROUND, 1)[picture, row, column]
            near = pad(close.float(), (NEAR // 2,) * 4).unfold(2, NEAR, 2).unfold(3, NEAR, 2)[picture, :, row, column]
            heard = max_pool2d(heat, 3, 1, 1)[picture, :, row, column] / HOT
            closer = relu(self.close(near))
            seen = relu(self.around(around.flatten(1)) + self.near(closer.flatten(1)) + self.heard(heard))
            said: Tensor = self.sure(seen + relu(self.deeper(seen)))
            return said

        return ask
