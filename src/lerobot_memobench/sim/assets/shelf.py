"""The wooden shelf with two layers, open to local -y and to the back."""

from __future__ import annotations

from collections.abc import Callable

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder
from lerobot_memobench.sim.assets.meshes import Block, blocks
from lerobot_memobench.sim.assets.paint import wood

_HALF_X = 0.176
_FRONT, _BACK = -0.075, 0.116
_HIGH = 0.210
_BOARD = 0.010
_MIDDLE = 0.105  # top of the board between the layers


def _boards() -> list[Block]:
    y, depth = (_FRONT + _BACK) / 2, (_BACK - _FRONT) / 2
    inner = _HALF_X - _BOARD
    return [
        *(
            Block(
                (s * (_HALF_X - _BOARD / 2), y, (_HIGH - _BOARD) / 2),
                (_BOARD / 2, depth, (_HIGH - _BOARD) / 2),
                2,
            )
            for s in (-1.0, 1.0)
        ),
        Block((0, y, _HIGH - _BOARD / 2), (_HALF_X, depth, _BOARD / 2), 0),
        Block((0, y, _MIDDLE - _BOARD / 2), (inner, depth, _BOARD / 2), 0),
        Block((0, y, _BOARD / 2), (inner, depth, _BOARD / 2), 0),
    ]


def _shelf(b: Builder) -> Asset:
    dark = b.material("shelf_wood", lambda: wood((70, 46, 32), (122, 86, 62), seed=9, waves=6), specular=0.15)
    b.visual_mesh(b.mesh("shelf", lambda: blocks(_boards(), tile=0.25)), dark)
    for part in _boards():
        b.collision("box", part.half, 0.5, part.centre)
    y, depth = (_FRONT + _BACK) / 2, (_BACK - _FRONT) / 2
    inner = _HALF_X - _BOARD

    def inside(low: float, high: float, name: str) -> str:
        return b.site(name, (0, y, (low + high) / 2), (inner, depth, (high - low) / 2), box=True)

    regions = {
        "top_side": b.site("top_side", (0, y, _HIGH - 0.001), (_HALF_X, depth, 0.001), box=True),
        "top_region": inside(_MIDDLE, _HIGH - _BOARD, "top_region"),
        "bottom_region": inside(_BOARD, _MIDDLE - _BOARD, "bottom_region"),
    }
    return b.fixture(low=(-_HALF_X, _FRONT, 0), high=(_HALF_X, _BACK, _HIGH), regions=regions, clear=depth)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"wooden_two_layer_shelf": _shelf}
