"""Bodies from MJCF and URDF, and poses of links from MuJoCo's data."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.helpers import rotation, without
from torchelev.frames import transform
from torchelev.io import link_poses, read_body
from torchelev.robot_body import Box, Capsule

mujoco = pytest.importorskip("mujoco")

MJCF = """
<mujoco>
  <asset>
    <mesh name="block" vertex="0 0 0  0.3 0 0  0 0.2 0  0.3 0.2 0  0 0 0.1  0.3 0 0.1  0 0.2 0.1  0.3 0.2 0.1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="table" pos="3 0 0"><geom type="box" size="0.5 0.5 0.5"/></body>
    <body name="base" pos="0 0 0.5" euler="0 0 40">
      <freejoint/>
      <geom type="box" size="0.2 0.1 0.05" pos="0.1 0 0" euler="0 30 0"/>
      <geom type="mesh" mesh="block" contype="0" conaffinity="0"/>
      <body name="head" pos="0.3 0 0.1" euler="0 0 90">
        <geom type="ellipsoid" size="0.1 0.05 0.04" pos="0.02 0 0"/>
      </body>
      <body name="leg" pos="0 0.2 0" euler="0 20 0">
        <joint name="hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.05 0 -0.3" size="0.03"/>
        <geom type="cylinder" fromto="0 0 0 0 0.1 0" size="0.02"/>
        <geom type="cylinder" size="0.06 0.01"/>
        <body name="foot" pos="0.05 0 -0.3">
          <geom type="sphere" size="0.04" pos="0 0 -0.01"/>
        </body>
      </body>
      <body name="arm" pos="-0.1 0 0.1"><joint axis="1 0 0"/><geom type="mesh" mesh="block"/></body>
      <body name="antenna"><joint axis="1 0 0"/><inertial pos="0 0 0" mass="0.1" diaginertia="1 1 1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = f"""
<robot name="r">
  <link name="trunk">{MASS}
    <visual><geometry><mesh filename="package://robot/no_such_file.stl"/></geometry></visual>
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.4 0.2 0.1"/></geometry></collision>
  </link>
  <link name="thigh">{MASS}
    <collision><origin xyz="0 0 -0.1"/><geometry><cylinder radius="0.02" length="0.2"/></geometry></collision>
  </link>
  <link name="toe">{MASS}<collision><geometry><sphere radius="0.03"/></geometry></collision></link>
  <joint name="hip" type="revolute"><parent link="trunk"/><child link="thigh"/><origin xyz="0.2 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="ankle" type="fixed"><parent link="thigh"/><child link="toe"/>
    <origin xyz="0 0 -0.2" rpy="0.3 0 0"/></joint>
</robot>
"""


@pytest.fixture
def mjcf(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(MJCF)
    return path


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(URDF)
    return path


def near(value):
    return pytest.approx(value, abs=1e-6)


def is_capsule(shape, link, start, end, radius):
    """Whether it is this capsule, from either end."""
    ends = {tuple(np.round(point, 6) + 0.0) for point in (shape.start, shape.end)}
    return shape.link == link and ends == {start, end} and shape.radius == near(radius)


def test_mjcf(mjcf):
    body = read_body(mjcf, padding=0.01)
    assert body.padding == 0.01 and body.links == ("leg", "base", "arm")
    shank, rod, foot = body.capsules
    assert is_capsule(shank, "leg", (0.0, 0.0, 0.0), (0.05, 0.0, -0.3), 0.03)
    assert is_capsule(rod, "leg", (0.0, 0.0, 0.0), (0.0, 0.1, 0.0), 0.02)
    assert is_capsule(foot, "leg", (0.05, 0.0, -0.31), (0.05, 0.0, -0.31), 0.04)
    trunk, head, disc, arm = body.boxes
    assert (trunk.link, trunk.center, trunk.half_lengths) == ("base", near((0.1, 0, 0)), near((0.2, 0.1, 0.05)))
    assert trunk.quat_wxyz == near((np.cos(np.pi / 12), 0, np.sin(np.pi / 12), 0))
    # The head is turned by 90 degrees: its x is the base's y.
    assert (head.link, head.center, head.half_lengths) == ("base", near((0.3, 0.02, 0.1)), near((0.1, 0.05, 0.04)))
    assert head.quat_wxyz == near((np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    assert (disc.link, disc.half_lengths) == ("leg", near((0.06, 0.06, 0.01)))
    # The mesh is a block from the origin of its link, whatever the axes in which MuJoCo keeps it.
    assert (arm.link, arm.center) == ("arm", near((0.15, 0.1, 0.05)))
    assert sorted(arm.half_lengths) == near([0.05, 0.1, 0.15])
    R = transform(np.zeros(3), np.array(arm.quat_wxyz))[:3, :3].abs()
    assert (R @ torch.tensor(arm.half_lengths, dtype=torch.float64)).tolist() == near([0.15, 0.1, 0.05])


def test_urdf(urdf):
    body = read_body(urdf)
    assert body.links == ("thigh", "trunk") and len(body.boxes) == 1 and len(body.capsules) == 2
    assert (body.boxes[0].center, body.boxes[0].half_lengths) == (near((0, 0, 0.1)), near((0.2, 0.1, 0.05)))
    assert is_capsule(body.capsules[0], "thigh", (0.0, 0.0, 0.0), (0.0, 0.0, -0.2), 0.02)
    assert is_capsule(body.capsules[1], "thigh", (0.0, 0.0, -0.2), (0.0, 0.0, -0.2), 0.03)


def test_models_and_specs_are_taken_too(mjcf):
    assert read_body(str(mjcf)) == read_body(mujoco.MjModel.from_xml_string(MJCF)) == read_body(mjcf)
    spec = mujoco.MjSpec.from_string(MJCF)
    assert read_body(spec) == read_body(mjcf) and read_body(spec) == read_body(mjcf)


def test_some_links(mjcf):
    assert read_body(mjcf, links=["leg"]).capsules == read_body(mjcf).capsules
    foot = read_body(mjcf, links=("foot",))  # fixed to the leg
    assert foot.links == ("leg",) and foot.capsules == read_body(mjcf).capsules[2:] and not foot.boxes
    assert read_body(mjcf, links=["base"]).boxes == read_body(mjcf).boxes[:2]


def test_cylinders_are_held_by_their_shapes(mjcf):
    body = read_body(mjcf)
    assert isinstance(body.capsules[1], Capsule) and body.capsules[1].length == near(0.1)
    assert isinstance(body.boxes[2], Box)


@pytest.mark.parametrize(
    "options, text",
    [
        (
            dict(links=["leg", "tail"]),
            r"links: must be bodies of the model, got tail; there are table, base, head, leg",
        ),
        (dict(links=["world"]), "links: must be bodies of the model, got world"),
        (dict(links="leg"), "links: must be a tuple of names, got 'leg'"),
        (dict(links=["leg", "antenna"]), "links: must have shapes, got none of antenna"),
        (dict(links=["table"]), "links: must have shapes, got none of table"),
        (dict(padding=-1.0), "body.padding"),
    ],
)
def test_refuses(mjcf, options, text):
    with pytest.raises(ValueError, match=text):
        read_body(mjcf, **options)


def test_refuses_what_is_no_model(tmp_path, mjcf):
    with pytest.raises(ValueError, match=r"source: must be an MJCF or URDF file, got .*missing\.xml; check the path"):
        read_body(tmp_path / "missing.xml")
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><blob/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="source: must be a model that MuJoCo reads, got .*bad.xml: .*blob"):
        read_body(tmp_path / "bad.xml")
    with pytest.raises(TypeError, match="source: must be a path, an MjModel or an MjSpec, got int"):
        read_body(3)
    empty = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom type='plane' size='1 1 1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="source: must have shapes on links that move, got none"):
        read_body(empty)
    mjcf.write_text(MJCF.replace('name="arm" ', ""))
    with pytest.raises(ValueError, match="source: must name the bodies of its shapes, got body 6 without a name"):
        read_body(mjcf)


def test_without_mujoco_it_says_how_to_get_it(mjcf, monkeypatch):
    without(monkeypatch, "mujoco")
    with pytest.raises(ImportError, match="read_body: needs MuJoCo .* pip install mujoco"):
        read_body(mjcf)


def moved(angle=0.7):
    """A model and its data with the robot somewhere and its leg turned."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    data.qpos[:7] = [1.0, -2.0, 0.4, *np.array([0.9, 0.1, -0.2, 0.3]) / np.linalg.norm([0.9, 0.1, -0.2, 0.3])]
    data.qpos[7] = angle
    mujoco.mj_forward(model, data)
    return model, data


def test_poses_of_links_by_hand():
    model, data = moved()
    body = read_body(model)
    T = link_poses(model, data, body)
    assert T.shape == (3, 4, 4) and T.dtype == torch.float64
    assert torch.allclose(T[1], torch.eye(4, dtype=torch.float64), atol=1e-9)  # the base itself
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = rotation(pitch=np.radians(20) + 0.7), (0, 0.2, 0)
    np.testing.assert_allclose(T[0], expected, atol=1e-9)


def test_shapes_lie_where_mujoco_has_them():
    """In MuJoCo's world, each shape's centre is that of its geom."""
    model, data = moved()
    body = read_body(model)
    T_world_base = transform(data.body("base").xpos, data.body("base").xquat)
    T = dict(zip(body.links, T_world_base @ link_poses(model, data, body), strict=True))
    centers = [(s.link, np.add(s.start, s.end) / 2) for s in body.capsules] + [(s.link, s.center) for s in body.boxes]
    for link, center in centers:
        at = (T[link] @ torch.tensor([*center, 1.0], dtype=torch.float64))[:3].numpy()
        assert np.linalg.norm(data.geom_xpos - at, axis=1).min() < 1e-9


def test_poses_of_many_environments():
    model, data = moved()
    _, other = moved(-0.3)
    body = read_body(model)
    both = SimpleNamespace(
        xpos=torch.from_numpy(np.stack([data.xpos, other.xpos])).float(),
        xquat=torch.from_numpy(np.stack([data.xquat, other.xquat])).float(),
    )
    T = link_poses(model, both, body)
    assert T.shape == (2, 3, 4, 4) and T.dtype == torch.float32
    for b, one in enumerate((data, other)):
        torch.testing.assert_close(T[b], link_poses(model, one, body).float(), atol=1e-5, rtol=0)


def test_poses_against_another_base():
    model, data = moved()
    body = read_body(model, links=["leg"])
    T_base_head = link_poses(model, data, read_body(model), base="head")[1]
    torch.testing.assert_close(link_poses(model, data, body, base="leg")[0], torch.eye(4, dtype=torch.float64))
    assert T_base_head[:3, 3].tolist() == near([0, 0.3, -0.1])  # the base, seen from its head
    with pytest.raises(ValueError, match="links: must be bodies of the model, got tail"):
        link_poses(model, data, body, base="tail")


def test_the_filter_takes_what_was_read(urdf):
    """A point on the toe is the robot's own, in a map whose body and poses come from the model."""
    from torchelev import ElevationMap, ElevationMapConfig, SensorConfig

    spec = mujoco.MjSpec.from_file(str(urdf))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = read_body(urdf)
    emap = ElevationMap(ElevationMapConfig(sensor=SensorConfig(body=body)))
    T_map_base = torch.eye(4, dtype=torch.float64)[None]
    toe = torch.tensor([[[0.2, 0.0, -0.23], [0.2, 0.3, -0.23]]])  # its lowest point, and the ground beside it
    sensor = T_map_base.clone()
    sensor[0, :3, 3] = torch.tensor([0.5, 0.0, -0.1])
    points = toe - sensor[0, :3, 3].float()
    m = emap.measure(points, sensor, T_map_base, 0.0, T_base_links=link_poses(model, data, body)[None])
    assert m.used[0].tolist() == [False, True] and m.rejected_body.item() == 1
