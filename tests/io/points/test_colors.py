"""Colours of points: packed as ROS and PCL have them, in three fields, in files and in messages."""

import numpy as np
import plyfile
import pytest
from pypcd4 import PointCloud

from tests.io.bags.synthetic import Writer, make_cloud
from torchelev.io.bags.point_cloud import CloudError, read_points
from torchelev.io.files.clouds import read_cloud_file
from torchelev.io.points.colors import color_fields, to_colors

BYTES = np.array([[255, 0, 51], [0, 128, 255], [1, 2, 3]], np.uint8)
POINTS = np.arange(9, dtype=np.float32).reshape(3, 3)
_RED, _GREEN, _BLUE = BYTES.astype(np.uint32).T
PACKED = _RED << 16 | _GREEN << 8 | _BLUE
OPAQUE = PACKED | np.uint32(0xFF000000)  # as a float this is NaN


def test_packed_by_hand():
    np.testing.assert_allclose(to_colors([np.array([0x00FF8000], np.uint32)]), [[1.0, 128 / 255, 0.0]], atol=1e-6)
    assert color_fields(["x", "rgba", "r"]) == ("rgba",) and color_fields(["x", "r", "g"]) == ()


FIELDS = {
    "floats, as PCL writes them": {"rgb": PACKED.view(np.float32)},
    "floats with alpha": {"rgba": OPAQUE.view(np.float32)},
    "integers": {"rgba": OPAQUE},
    "three bytes": dict(zip(("r", "g", "b"), BYTES.T, strict=True)),
}


@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize("name", FIELDS)
def test_clouds_of_bags(tmp_path, name, bigendian):
    writer = Writer(tmp_path / "bag", "mcap")
    message = make_cloud(writer, POINTS, None, None, pad=3, bigendian=bigendian, colors=FIELDS[name])
    writer.close()
    np.testing.assert_allclose(read_points(message, 0.0, colors=True).colors, BYTES / 255, atol=1e-6)
    assert read_points(message, 0.0).colors is None, "only if they are asked for"


def test_a_packed_field_of_another_size_is_refused(tmp_path):
    writer = Writer(tmp_path / "bag", "mcap")
    message = make_cloud(writer, POINTS, None, None, colors={"rgb": BYTES[:, 0].copy()})
    writer.close()
    with pytest.raises(CloudError, match="rgb: a field of packed colours has 4 bytes, got uint8"):
        read_points(message, 0.0, colors=True)


def write_ply(path, colors):
    kinds = [(axis, "f4") for axis in "xyz"] + [(name, values.dtype.str) for name, values in colors.items()]
    vertices = np.zeros(3, kinds)
    for name, values in (*zip("xyz", POINTS.T, strict=True), *colors.items()):
        vertices[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(path)


@pytest.mark.parametrize("colors", [BYTES, (BYTES / 255).astype("f4"), BYTES.astype("f4")], ids=["u1", "unit", "f255"])
def test_ply(tmp_path, colors):
    write_ply(tmp_path / "a.ply", dict(zip(("red", "green", "blue"), colors.T, strict=True)))
    np.testing.assert_allclose(read_cloud_file(tmp_path / "a.ply").colors, BYTES / 255, atol=1e-6)


def test_pcd(tmp_path):
    PointCloud.from_points([*POINTS.T, PACKED.view(np.float32)], ["x", "y", "z", "rgb"], [np.float32] * 4).save(
        tmp_path / "a.pcd"
    )
    np.testing.assert_allclose(read_cloud_file(tmp_path / "a.pcd").colors, BYTES / 255, atol=1e-6)


def test_files_without_colours_have_none(tmp_path):
    write_ply(tmp_path / "a.ply", {"intensity": np.ones(3, np.float32)})
    assert read_cloud_file(tmp_path / "a.ply").colors is None
    np.save(tmp_path / "a.npy", np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "f8")]))
    assert read_cloud_file(tmp_path / "a.npy").colors is None, "a field that is not packed"
