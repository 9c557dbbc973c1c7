"""A contact sheet of assets: ``python -m lerobot_memobench.sim.assets.preview OUT.png [classes...]``.

Each class gets a row: from about where the agentview camera stands, from near on two sides, and from behind;
fixtures are shown closed and, last, open or on. Needs a GL backend, such as ``MUJOCO_GL=egl``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_memobench.sim.assets.base import Asset
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP, build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset, known_classes

TILE = 256


def scene(class_name: str) -> tuple[mujoco.MjModel, mujoco.MjData, Asset]:
    """Return a kitchen with one instance of ``class_name`` in the middle of the table."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 2 * TILE
    build_kitchen(spec)
    asset = build_asset(spec, spec.worldbody, "thing", class_name)
    if asset.kind == "object":
        spec.body("thing").add_freejoint(name="thing_joint0")
    spec.body("thing").pos = [0.0, 0.0, TABLE_TOP - asset.bottom + 0.0005]
    model = spec.compile()
    data = mujoco.MjData(model)
    for articulation in asset.articulations.values():
        data.joint(articulation.joint).qpos[0] = articulation.closed_q
    mujoco.mj_forward(model, data)
    return model, data, asset


def shoot(
    renderer: mujoco.Renderer,
    data: mujoco.MjData,
    azimuth: float,
    elevation: float,
    distance: float,
    height: float,
) -> NDArray[np.uint8]:
    """Return a picture from a free camera around the middle of the table; azimuth 0 looks from +x."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = [0.0, 0.0, TABLE_TOP + height]
    camera.azimuth, camera.elevation, camera.distance = azimuth + 180, elevation, distance
    option = mujoco.MjvOption()
    option.geomgroup[:] = 0
    option.geomgroup[1] = 1
    renderer.update_scene(data, camera, option)
    return renderer.render()


def row(class_name: str) -> Image.Image:
    """Return the pictures of one class beside each other."""
    model, data, asset = scene(class_name)
    # Classes that are placed with a half turn in the published scenes face the camera's right.
    turned = class_name in ("wooden_cabinet", "microwave", "wooden_two_layer_shelf")
    if turned:
        model.body("thing").quat = [0, 0, 0, 1]
        mujoco.mj_forward(model, data)
    size = max(*asset.half_extents, (asset.top - asset.bottom) / 2)
    middle = (asset.top - asset.bottom) / 2
    pictures = []
    with mujoco.Renderer(model, TILE, TILE) as renderer:
        pictures.append(shoot(renderer, data, 0, -50, 1.05, 0.0))
        base = 45.0 if turned else 0.0
        for azimuth in (base, base + 60):
            pictures.append(shoot(renderer, data, azimuth, -35, 0.06 + 3.8 * size, middle))
        for articulation in asset.articulations.values():
            data.joint(articulation.joint).qpos[0] = articulation.open_q
        for geom in asset.glow if asset.articulations else ():
            model.geom(geom).rgba = asset.glow_on
        mujoco.mj_forward(model, data)
        distance = 0.06 + (4.6 if asset.articulations else 3.8) * size
        pictures.append(
            shoot(renderer, data, base + (0 if asset.articulations else 200), -35, distance, middle)
        )
    sheet = Image.new("RGB", (TILE * len(pictures), TILE))
    for k, picture in enumerate(pictures):
        sheet.paste(Image.fromarray(picture), (k * TILE, 0))
    faces = sum(int(model.mesh(model.geom_dataid[g]).facenum[0]) for g in _drawn(model))
    ImageDraw.Draw(sheet).text((4, 4), f"{class_name}  {faces} faces", fill=(255, 0, 0))
    return sheet


def _drawn(model: mujoco.MjModel) -> list[int]:
    root = model.body("thing").id
    return [
        g
        for g in range(model.ngeom)
        if model.body_rootid[model.geom_bodyid[g]] == root and model.geom_dataid[g] >= 0
    ]


def main(arguments: list[str]) -> int:
    """Write the sheet; without classes, all of them."""
    if not arguments:
        print("usage: python -m lerobot_memobench.sim.assets.preview OUT.png [classes...]", file=sys.stderr)
        return 2
    classes = arguments[1:] or [name for name in known_classes() if name != "kitchen_table"]
    rows = [row(name) for name in classes]
    sheet = Image.new("RGB", (rows[0].width, TILE * len(rows)))
    for k, picture in enumerate(rows):
        sheet.paste(picture, (0, k * TILE))
    sheet.save(Path(arguments[0]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
