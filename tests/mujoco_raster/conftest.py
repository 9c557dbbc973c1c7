"""A model with all kinds of geoms, textures and lights."""

from __future__ import annotations

from pathlib import Path

import pytest

MODEL = """
<mujoco>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2="0 0 0" width="64" height="384"/>
    <texture name="grid" type="2d" builtin="checker" rgb1=".2 .3 .4" rgb2=".1 .2 .3" width="64" height="64"/>
    <texture name="faces" type="cube" builtin="checker" rgb1=".8 .3 .4" rgb2=".1 .8 .3" width="64" height="64"/>
    <material name="grid" texture="grid" texrepeat="1 1" texuniform="true" reflectance=".2"/>
    <material name="faces" texture="faces"/>
    <hfield name="hills" nrow="2" ncol="3" elevation="0 1 2 0 1 2" size=".5 .5 .2 .1"/>
  </asset>
  <worldbody>
    <light pos="0 0 3" directional="true" castshadow="false"/>
    <light pos="2 -2 3" dir="-1 1 -1" cutoff="40" castshadow="false"/>
    <camera name="corner" pos="1.5 -1.5 1.2" xyaxes="1 1 0 -.4 .4 1"/>
    <geom type="plane" size="0 0 .05" material="grid"/>
    <geom size=".2" pos="0 0 .2" rgba="1 .2 .2 1"/>
    <geom type="hfield" hfield="hills" pos="-.3 1.2 .1"/>
    <body pos=".5 .3 .2">
      <freejoint/>
      <geom type="box" size=".15 .1 .2" material="faces" euler="0 0 30"/>
      <geom type="capsule" size=".08 .2" pos="-.8 .2 .3" rgba=".2 1 .2 1"/>
      <geom type="ellipsoid" size=".1 .2 .3" pos="-.7 -.6 .3"/>
      <geom type="cylinder" size=".15 .2" pos="-.2 -.7 .1" rgba=".3 .3 1 .4"/>
    </body>
  </worldbody>
  <keyframe><key name="lifted" qpos=".5 .3 1 1 0 0 0"/></keyframe>
</mujoco>
"""


@pytest.fixture
def model_file(tmp_path: Path) -> Path:
    path = tmp_path / "model.xml"
    path.write_text(MODEL)
    return path
