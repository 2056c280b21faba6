"""Shapes count, whether they collide or not; pictures only where there is nothing else."""

import pytest

from torchelev.io import read_body

pytest.importorskip("mujoco")

BLOCK = "0 0 0  0.05 0 0  0 0.05 0  0.05 0.05 0  0 0 {0}  0.05 0 {0}  0 0.05 {0}  0.05 0.05 {0}"
MJX = """
<mujoco><default><geom contype="0" conaffinity="0"/>
  <default class="collision"><geom group="3"/></default>
  <default class="foot"><geom group="3" contype="{feet}" conaffinity="{feet}"/></default></default>
<asset><mesh name="shank" vertex="SHANK"/><mesh name="plate" vertex="PLATE"/></asset>
<worldbody><body name="trunk" pos="0 0 0.3"><freejoint/>
  <geom type="mesh" mesh="plate" mass="5" group="2"/>
  <geom class="collision" type="box" size="0.2 0.1 0.05"/>
  <body name="thigh" pos="0.2 -0.1 0"><joint axis="0 1 0"/>
    <geom class="collision" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="1"/>
    <body name="calf" pos="0 0 -0.2"><joint axis="0 1 0"/>
      <geom type="mesh" mesh="shank" mass="0.1"/>
      <geom class="foot" type="sphere" pos="0 0 0.2" size="0.022"/>
    </body></body>
  <body name="head"><joint axis="0 0 1"/><geom type="mesh" mesh="plate" mass="0.1"/></body></body>
  <geom name="floor" type="plane" size="5 5 0.1" contype="1" conaffinity="1"/></worldbody></mujoco>
"""


@pytest.mark.parametrize("feet", [0, 1])
def test_a_model_whose_feet_alone_collide(tmp_path, feet):
    (tmp_path / "robot.xml").write_text(
        MJX.format(feet=feet).replace("SHANK", BLOCK.format(-0.2)).replace("PLATE", BLOCK.format(0.05))
    )
    body = read_body(tmp_path / "robot.xml")
    assert set(body.links) == {"trunk", "thigh", "calf", "head"}
    assert [shape.link for shape in body.capsules] == ["thigh", "calf"]
    # The trunk's picture has a shape of its size; the shank's only a foot, and the head's none.
    assert [shape.link for shape in body.boxes] == ["trunk", "calf", "head"]
    assert sorted(body.boxes[1].half_lengths) == pytest.approx([0.025, 0.025, 0.1], abs=1e-6)
