"""PCD headers that PCL writes and parsers refuse."""

import numpy as np
import pytest

from torchelev.io import read_cloud

POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)


def write(path, rows, data):
    header = ["# .PCD v0.7", "VERSION 0.7", *rows, "WIDTH 20", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", "POINTS 20"]
    path.write_bytes(("\n".join([*header, "DATA binary"]) + "\n").encode() + data)


@pytest.mark.parametrize("end", ["", "\r"])
def test_fields_of_count_0_take_no_bytes(tmp_path, end):
    """The layout of an Ouster, as pcl_ros stores it."""
    rows = ["FIELDS x _ y z _ t _", "SIZE 4 1 4 4 1 4 1", "TYPE F U F F U U U", "COUNT 1 0 1 1 0 1 4"]
    kind = np.dtype([("xyz", "<f4", 3), ("t", "<u4"), ("pad", "u1", 4)])
    data = np.zeros(20, kind)
    data["xyz"], data["t"] = POINTS, np.arange(20)
    write(tmp_path / "a.pcd", [row + end for row in rows], data.tobytes())
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)


def test_a_header_without_counts(tmp_path):
    write(tmp_path / "a.pcd", ["FIELDS x y z", "SIZE 4 4 4", "TYPE F F F"], POINTS.tobytes())
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)
