"""URDF files as robots ship them: meshes in packages, visuals that MuJoCo refuses, a single link, xacro."""

import struct
import warnings

import pytest

from torchelev.io import read_body

pytest.importorskip("mujoco")

CORNERS = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
BOX = '<box size="0.3 0.2 0.1"/>'
LINK = """<link name="{name}"><inertial><mass value="0"/></inertial>
  <visual><geometry><mesh filename="package://my_robot/meshes/{name}.dae"/></geometry>
    <material name="a"/><material name="b"/></visual>
  <collision><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="{child}_joint" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
  <limit lower="1" upper="-1" effort="1" velocity="1"/><mimic joint="none"/></joint>"""


def binary_stl():
    rows = [struct.pack("<12fH", 0, 0, 0, *(c for k in face for c in CORNERS[k]), 0) for face in FACES]
    return bytes(80) + struct.pack("<I", len(FACES)) + b"".join(rows)


def text_stl():
    corners = ("".join(f"vertex {' '.join(map(str, CORNERS[k]))}\n" for k in face) for face in FACES)
    facets = "".join(f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n" for loop in corners)
    return f"solid a\n{facets}endsolid a\n".encode()


def robot(shape, first="", extra=""):
    links = LINK.format(name="base", shape=shape) + LINK.format(name="thigh", shape=shape)
    joint = JOINT.format(child="thigh", kind="revolute", parent="base")
    return f'<robot name="r">{extra}{first}{links}{joint}<transmission name="t"/><gazebo/></robot>'


@pytest.fixture
def package(tmp_path):
    for folder in ("urdf", "meshes"):
        (tmp_path / "my_robot" / folder).mkdir(parents=True)
    (tmp_path / "my_robot/meshes/base.stl").write_bytes(binary_stl())
    return tmp_path / "my_robot"


def read(package, text, name="urdf/a.urdf", **options):
    (package / name).write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_body(package / name, **options)


def test_primitives_need_no_visuals_inertia_or_limits(package):
    body = read(package, robot(BOX))
    assert body.links == ("base", "thigh") and len(body.boxes) == 2
    assert body.boxes[0].half_lengths == pytest.approx((0.15, 0.1, 0.05))


@pytest.mark.parametrize("kind", ["floating", "fixed"])
def test_a_base_in_a_world(package, kind):
    world = '<link name="world"/>' + JOINT.format(child="base", kind=kind, parent="world")
    assert read(package, robot(BOX, world)).links == ("base", "thigh")


@pytest.mark.parametrize(
    "filename",
    [
        "package://my_robot/meshes/base.stl",
        "package://my_robot/meshes/base.dae",
        "$(find my_robot)/meshes/base.stl",
        "../meshes/base.stl",
        "meshes/base.stl",
        "file://{package}/meshes/base.stl",
        "/home/someone/my_robot/meshes/base.stl",
    ],
)
@pytest.mark.parametrize("write_stl", [binary_stl, text_stl])
def test_meshes_are_found(package, filename, write_stl):
    (package / "meshes/base.stl").write_bytes(write_stl())
    mesh = f'<mesh filename="{filename.format(package=package)}"/>'
    body = read(package, robot(mesh))
    assert [box.link for box in body.boxes] == ["base", "thigh"]
    assert 0.07 < 2 * max(body.boxes[0].half_lengths) < 0.17


def test_meshdir_and_its_name_in_the_path(package):
    compiler = '<mujoco><compiler meshdir="meshes"/></mujoco>'
    for name in ("meshes/base.stl", "base.stl"):
        assert len(read(package, robot(f'<mesh filename="{name}"/>', extra=compiler), "a.urdf").boxes) == 2


def test_one_mesh_of_two_scales(package):
    text = robot('<mesh filename="base.stl"/>').replace('base.stl"/>', 'base.stl" scale="2 2 2"/>', 1)
    large, small = read(package, text).boxes
    assert max(large.half_lengths) == pytest.approx(2 * max(small.half_lengths))


def test_one_link(package):
    assert read(package, f'<robot name="r">{LINK.format(name="base", shape=BOX)}</robot>').links == ("base",)


def test_a_link_with_visuals_alone(package):
    text = robot(BOX).replace(f"<collision><geometry>{BOX}</geometry></collision>", "", 1)
    assert [box.link for box in read(package, text).boxes] == ["base", "thigh"]  # base.stl lies beside base.dae
    (package / "meshes/base.stl").unlink()
    (package / "urdf/a.urdf").write_text(text)
    with pytest.warns(
        UserWarning, match=r"links are left out: base \(package://my_robot/meshes/base.dae: no such file"
    ):
        assert read_body(package / "urdf/a.urdf").links == ("thigh",)


def test_a_missing_mesh_is_named_with_what_was_tried(package):
    text = robot('<mesh filename="package://my_robot/meshes/gone.stl"/>')
    with pytest.raises(ValueError, match=r"got base: package://my_robot/meshes/gone\.stl: no such file; tried .*/gone"):
        read(package, text)
    (package / "meshes/gone.dae").write_text("")
    with pytest.raises(ValueError, match=r"MuJoCo does not read \.dae; convert it to gone\.stl"):
        read(package, text.replace("gone.stl", "gone.dae"))


def test_meshes_of_other_links_may_be_missing(package):
    text = robot(BOX).replace(BOX, '<mesh filename="gone.stl"/>', 1)
    (package / "urdf/a.urdf").write_text(text)
    with pytest.warns(UserWarning, match="left out: base"):
        assert read_body(package / "urdf/a.urdf", links=("thigh",)).links == ("thigh",)


@pytest.mark.parametrize(
    "text",
    [
        '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
        '<robot name="r"><link name="${a}"/></robot>',
    ],
)
def test_xacro_is_named(package, text):
    with pytest.raises(ValueError, match=r"not its xacro, got .*; expand it first: xacro a\.urdf\.xacro > robot\.urdf"):
        read(package, text, "urdf/a.urdf.xacro")
