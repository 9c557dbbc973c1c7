"""Build the microwave and the stove.

The microwave's door is on the local -y side, hinged on the left, with limit q = -2.094. The body is set back from its
origin to make room for a plate that starts at the position of the published microwave's door.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.sim.assets.asset import Articulation, Asset, Handle
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Block, Floats, MeshData, Quad, blocks, box, cell_uv, lathe, quads_mesh
from lerobot_memobench.sim.assets.paint import Canvas, Pixels, draw_texture, speckle

DOOR_RANGE = (-2.094, 0.0)

_HALF_X = 0.1725
_FRONT, _BACK = 0.000, 0.196  # y of the box without door
_HIGH = 0.189
_PLINTH = 0.028  # the door sweeps over a plate on the table
_BOARD = 0.010
_FLOOR = _PLINTH + _BOARD  # z of the interior floor
_MIDDLE = (_FRONT + _BACK) / 2
_INNER_DEPTH = (_BACK - _BOARD - _FRONT) / 2
_DOOR_THICK = 0.020
_DOOR_GAP = 0.001
_HANDLE_OUT = 0.045
_HANDLE_THICK = 0.012
_HANDLE_HALF = 0.050
_PANEL = 0.075  # width of the strip with buttons on the door's front


def _shell() -> list[Block]:
    """Return floor, top, back and sides; the floor is the thick plinth, set back from the front."""
    x = _HALF_X
    middle, depth = (_FRONT + _BACK) / 2, (_BACK - _FRONT) / 2
    z = (_HIGH + _PLINTH) / 2
    half = (_HIGH - _PLINTH) / 2
    return [
        Block((0, middle, _PLINTH + _BOARD / 2), (x, depth, _BOARD / 2), 0),
        Block((0, middle, _HIGH - _BOARD / 2), (x, depth, _BOARD / 2), 0),
        Block((0, _BACK - _BOARD / 2, z), (x, _BOARD / 2, half - _BOARD), 0),
        Block((-x + _BOARD / 2, middle, z), (_BOARD / 2, depth, half - _BOARD), 1),
        Block((x - _BOARD / 2, middle, z), (_BOARD / 2, depth, half - _BOARD), 1),
        Block((0, middle + 0.015, _PLINTH / 2), (x - 0.02, depth - 0.03, _PLINTH / 2), 0),
    ]


def _lining() -> list[Block]:
    """Return thin light boards of the interior."""
    x = _HALF_X - _BOARD
    middle, depth = (_FRONT + _BACK - _BOARD) / 2, (_BACK - _BOARD - _FRONT) / 2
    low, high = _PLINTH + _BOARD, _HIGH - _BOARD
    z, half = (low + high) / 2, (high - low) / 2
    thin = 0.0006
    return [
        Block((0, middle, low + thin), (x, depth - 0.001, thin), 0),
        Block((0, _BACK - _BOARD - thin, z), (x, thin, half), 0),
        Block((-x + thin, middle, z), (thin, depth - 0.001, half), 1),
        Block((x - thin, middle, z), (thin, depth - 0.001, half), 1),
    ]


_DOOR_HIGH = (_HIGH - _PLINTH) / 2 - 0.001
_DOOR_Z = (_HIGH + _PLINTH) / 2


def _door_mesh() -> MeshData:
    """Return the door in the frame of its hinge, closed: the door runs to +x, its front is at -y."""
    wide, thick, high = 2 * _HALF_X, _DOOR_THICK, _DOOR_HIGH
    lo, hi = -high, high
    quads: list[Quad] = [
        [(0, -thick, lo), (wide, -thick, lo), (wide, -thick, hi), (0, -thick, hi)],
        [(wide, 0, lo), (0, 0, lo), (0, 0, hi), (wide, 0, hi)],
        [(wide, -thick, lo), (wide, 0, lo), (wide, 0, hi), (wide, -thick, hi)],
        [(0, 0, lo), (0, -thick, lo), (0, -thick, hi), (0, 0, hi)],
        [(0, -thick, hi), (wide, -thick, hi), (wide, 0, hi), (0, 0, hi)],
        [(0, 0, lo), (wide, 0, lo), (wide, -thick, lo), (0, -thick, lo)],
    ]
    # Image layout: left half front, right half all other sides.
    front, back = cell_uv(0, 0, 2, 1), cell_uv(1, 0, 2, 1)
    edge = np.full((4, 2), (0.985, 0.015))
    return quads_mesh(quads, [front, back, edge, edge, edge, edge])


def _door_texture() -> Pixels:
    grey, dark, glass = (62, 64, 67), (38, 39, 41), (14, 15, 17)

    def paint(canvas: Canvas) -> None:
        half = 0.5
        canvas.rect(0, 0, half, 1, grey)
        # Left of the front: clock and buttons; right: the window, and the handle at its edge.
        canvas.rect(0.012, 0.06, 0.115, 0.94, dark)
        canvas.rect(0.022, 0.10, 0.105, 0.26, (8, 20, 14))
        canvas.text("12:00", 0.027, 0.125, 0.10, 0.235, (90, 240, 150))
        for row in range(4):
            for column in range(3):
                x, y = 0.027 + 0.028 * column, 0.34 + 0.12 * row
                canvas.rect(x, y, x + 0.019, y + 0.07, (178, 180, 182))
        canvas.oval(0.045, 0.83, 0.085, 0.92, (70, 170, 90))
        canvas.rect(0.135, 0.10, 0.42, 0.90, glass)
        canvas.shape((34, 37, 40), 0.16, 0.90, 0.25, 0.10, 0.30, 0.10, 0.21, 0.90)
        # Inside of the door.
        canvas.rect(half, 0, 1, 1, (176, 178, 178))
        canvas.rect(half + 0.06, 0.14, half + 0.35, 0.86, glass)
        canvas.rect(0.975, 0, 1, 0.05, grey)

    return draw_texture(512, 160, grey, paint)


def _handle() -> list[Block]:
    """Return a vertical bar on two posts at the door's free edge, in the hinge's frame."""
    x, t = 2 * _HALF_X - 0.028, _HANDLE_THICK / 2
    y = -_DOOR_THICK
    reach = (_HANDLE_OUT - _HANDLE_THICK) / 2
    return [
        Block((x, y - _HANDLE_OUT + t, 0), (t, t, _HANDLE_HALF), 2),
        *(Block((x, y - reach, s * (_HANDLE_HALF - t)), (t, reach, t), 1) for s in (-1.0, 1.0)),
    ]


def _microwave(b: Builder) -> Asset:
    case = b.material("microwave_case", rgba=(0.23, 0.235, 0.245, 1), specular=0.4, shininess=0.4)
    lining = b.material("microwave_lining", rgba=(0.72, 0.73, 0.72, 1), specular=0.2)
    front = b.material("microwave_door", _door_texture, specular=0.5, shininess=0.6)
    metal = b.material("microwave_handle", rgba=(0.66, 0.67, 0.69, 1), specular=0.8, shininess=0.6)
    glass = b.material("microwave_tray", rgba=(0.86, 0.90, 0.90, 1), specular=0.5)
    b.visual_mesh(b.mesh("microwave_case", lambda: blocks(_shell())), case)
    b.visual_mesh(b.mesh("microwave_lining", lambda: blocks(_lining())), lining)
    b.visual("cylinder", (0.070, 0.001), glass, (0.03, _MIDDLE - 0.005, _FLOOR + 0.0022))
    for part in _shell():
        b.collision("box", part.half, 0.5, part.centre)
    articulation = _door(b, front, metal)
    return b.fixture(
        low=(-_HALF_X, _FRONT - _DOOR_GAP - _DOOR_THICK - _HANDLE_OUT, 0),
        high=(_HALF_X, _BACK, _HIGH),
        regions=_regions(b),
        articulations={"": articulation},
        clear=_INNER_DEPTH,
    )


def _door(b: Builder, front: str, metal: str) -> Articulation:
    """Add the door with its joint and handle."""
    door = b.child("door", (-_HALF_X, _FRONT - _DOOR_GAP, _DOOR_Z))
    b.spec.add_exclude(bodyname1=b.body.name, bodyname2=door.name)
    joint = b.joint(door, "microjoint", "hinge", (0, 0, 1), DOOR_RANGE, damping=0.5, frictionloss=0.15)
    b.visual_mesh(b.mesh("microwave_door", _door_mesh), front, body=door)
    b.visual_mesh(b.mesh("microwave_bar", lambda: blocks(_handle())), metal, body=door)
    b.collision("box", (_HALF_X, _DOOR_THICK / 2, _DOOR_HIGH), 0.5, (_HALF_X, -_DOOR_THICK / 2, 0), body=door)
    for part in _handle():
        b.collision("box", part.half, 0.03, part.centre, body=door, friction=GRIP_FRICTION)
    bar = _handle()[0].centre
    return Articulation(
        joint=joint,
        kind="door",
        closed_q=0.0,
        open_q=-1.9,
        # The handle's frame has x along the bar (up) and y out of the door: turn z up to x about y.
        handle_site=b.site("door_handle", bar, quat=(np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0), body=door),
        handle=Handle(2 * _HANDLE_HALF, (_HANDLE_THICK, _HANDLE_THICK), _HANDLE_OUT - _HANDLE_THICK),
        open_below=-1.3,
        closed_above=-0.005,
    )


def _regions(b: Builder) -> dict[str, str]:
    """Add the regions of interior and top, and return their full names."""
    high = (_HIGH - _BOARD - _FLOOR) / 2
    inside = ((0, _FRONT + _INNER_DEPTH, _FLOOR + high), (_HALF_X - _BOARD, _INNER_DEPTH, high))
    top = ((0, _MIDDLE, _HIGH - 0.001), (_HALF_X, (_BACK - _FRONT) / 2, 0.001))
    return {
        "heating_region": b.site("heating_region", *inside, box=True),
        "top_side": b.site("top_side", *top, box=True),
    }


# Flat stove with one burner and a knob -----------------------------------------------------------
# The origin is the knob's axis, on the robot's side; the burner plate is on the camera's side. At q = 0 (off) the ridge
# of the knob is along the fixture's x axis; switching on turns it counter-clockwise from above.

_PLATE = (0.062, 0.250)  # from x to x
_HALF_WIDTH = 0.095
_TOP = 0.026
_BURNER = 0.156  # x of the burner's middle
_BURNER_RADIUS = 0.068
_BURNER_TOP = 0.030
_KNOB_RADIUS = 0.044
_KNOB_BASE = 0.020
_RIDGE = (0.030, 0.0085)  # half length and half thickness
_RIDGE_TOP = 0.070
BUTTON_RANGE = (-0.005, 2.1)


def _plate_mesh() -> MeshData:
    """Return a box with a bevelled edge towards the camera."""
    x0, x1 = _PLATE
    y, z, bevel = _HALF_WIDTH, _TOP, 0.028
    front_z = 0.014
    quads: list[Quad] = [
        [(x0, -y, z), (x1 - bevel, -y, z), (x1 - bevel, y, z), (x0, y, z)],
        [(x1 - bevel, -y, z), (x1, -y, front_z), (x1, y, front_z), (x1 - bevel, y, z)],
        [(x1, -y, 0), (x1, y, 0), (x1, y, front_z), (x1, -y, front_z)],
        [(x0, y, 0), (x0, -y, 0), (x0, -y, z), (x0, y, z)],
        [(x0, -y, 0), (x1, -y, 0), (x1, -y, front_z), (x0, -y, z)],
        [(x1, y, 0), (x0, y, 0), (x0, y, z), (x1, y, front_z)],
        [(x1 - bevel, -y, z), (x0, -y, z), (x1, -y, front_z), (x1, -y, front_z)],
        [(x0, y, z), (x1 - bevel, y, z), (x1, y, front_z), (x1, y, front_z)],
    ]
    return quads_mesh(quads, [cell_uv(0, 0, 1, 1)] * len(quads))


def _disc_mesh() -> MeshData:
    r, low = _BURNER_RADIUS, _TOP
    profile = [(r + 0.003, low), (r, _BURNER_TOP - 0.001), (r - 0.002, _BURNER_TOP), (0.0, _BURNER_TOP)]
    return lathe(profile, 24, by_length=True).moved((_BURNER, 0, 0))


def _coil_texture() -> Pixels:
    """Return a spiral in polar coordinates, around by radius: the coil bright, the gaps dark."""
    high, wide = 128, 128
    v, u = np.mgrid[0:high, 0:wide] / np.array([high, wide])[:, None, None]
    turn = (4.6 * v + u) % 1.0
    bright = np.where((turn > 0.26) & (v > 0.08) & (v < 0.90), 1.0, 0.42)
    return np.repeat((255 * bright).astype(np.uint8)[..., None], 3, axis=2)


def _knob_mesh() -> MeshData:
    r, h = _KNOB_RADIUS, _KNOB_BASE
    return lathe([(r, 0.0), (r, 0.5 * h), (r - 0.004, h - 0.002), (r - 0.010, h), (0.0, h + 0.001)], segments=20)


def _ridge_mesh() -> MeshData:
    half = 0.5 * (_RIDGE_TOP - _KNOB_BASE) + 0.002

    def taper(points: Floats) -> Floats:
        up = points[:, 2] > 0
        points[up, 0] *= 0.90
        points[up, 1] *= 0.92
        return points

    return box((*_RIDGE, half)).warped(taper).moved((0, 0, _RIDGE_TOP - half))


def _ridge_texture() -> Pixels:
    # The top face (row 0, column 2) has a white line towards +x, the pointer.
    return draw_texture(96, 64, (24, 24, 26), lambda c: c.rect(2 / 3 + 0.13, 0.25, 2 / 3 + 0.2, 0.5, (235, 235, 235)))


def _stove(b: Builder) -> Asset:
    steel = b.material(
        "stove_steel", lambda: speckle((196, 194, 184), 6, seed=3, along=0.02), specular=0.7, shininess=0.6
    )
    coil = b.material("stove_coil", _coil_texture, specular=0.2, shininess=0.2, emission=0.3)
    black = b.material("stove_black", rgba=(0.10, 0.10, 0.11, 1), specular=0.5, shininess=0.5)
    ridge = b.material("stove_ridge", _ridge_texture, specular=0.5, shininess=0.5)
    b.visual_mesh(b.mesh("stove_plate", _plate_mesh), steel)
    glowing = b.visual_mesh(b.mesh("stove_coil", _disc_mesh), coil)

    x0, x1 = _PLATE
    b.collision("box", ((x1 - x0) / 2, _HALF_WIDTH, _TOP / 2), 3.5, ((x0 + x1) / 2, 0, _TOP / 2))
    half = 0.5 * (_BURNER_TOP - _TOP)
    b.collision("cylinder", (_BURNER_RADIUS, half), 0.3, (_BURNER, 0, _TOP + half))
    articulation = _knob(b, black, ridge)
    cook = b.site("cook_region", (_BURNER, 0, _BURNER_TOP - 0.001), (0.085, 0.085, 0.001), box=True)
    asset = b.fixture(
        low=(-_KNOB_RADIUS, -_HALF_WIDTH, 0),
        high=(x1, _HALF_WIDTH, _RIDGE_TOP),
        regions={"cook_region": cook},
        articulations={"": articulation},
        supports=_BURNER_TOP,
        clear=_BURNER_RADIUS,
        glow=(glowing.name,),
    )
    glowing.rgba = list(asset.glow_off)
    return asset


def _knob(b: Builder, black: str, ridge: str) -> Articulation:
    """Add the knob with its joint."""
    knob = b.child("knob")
    joint = b.joint(knob, "button", "hinge", (0, 0, 1), BUTTON_RANGE, damping=0.2, frictionloss=0.05)
    b.visual_mesh(b.mesh("stove_knob", _knob_mesh), black, body=knob)
    b.visual_mesh(b.mesh("stove_ridge", _ridge_mesh), ridge, body=knob)
    b.collision("cylinder", (_KNOB_RADIUS, _KNOB_BASE / 2 - 0.0005), 0.1, (0, 0, _KNOB_BASE / 2 + 0.0005), body=knob)
    rise = 0.5 * (_RIDGE_TOP - _KNOB_BASE)
    b.collision("box", (*_RIDGE, rise), 0.05, (0, 0, _KNOB_BASE + rise), body=knob, friction=GRIP_FRICTION)
    return Articulation(
        joint=joint,
        kind="knob",
        closed_q=BUTTON_RANGE[0],
        open_q=1.0,
        handle_site=b.site("button_handle", (0, 0, _RIDGE_TOP - 0.02), body=knob),
        handle=Handle(2 * _RIDGE[0], (2 * _RIDGE[1], _RIDGE_TOP - _KNOB_BASE), 0.03),
        on_at_least=0.5,
        off_below=0.0,
    )


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"microwave": _microwave, "flat_stove": _stove}
