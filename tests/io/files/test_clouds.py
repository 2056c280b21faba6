"""Every cloud format: written, read back, and broken."""

import numpy as np
import plyfile
import pytest
from pypcd4 import Encoding, PointCloud

from torchelev.io import RecordingError, read_cloud


@pytest.fixture
def points():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    points[7] = np.nan
    return points


def write_bin(path, points):
    np.hstack([points, np.ones((len(points), 1), np.float32)]).tofile(path)


def write_npz(path, points):
    np.savez(path, points=points, stamp=3.0)


def write_ply(path, points, text=False):
    vertices = np.zeros(len(points), dtype=[("intensity", "f4"), ("x", "f8"), ("y", "f4"), ("z", "f4")])
    vertices["x"], vertices["y"], vertices["z"] = points.T
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], text=text).write(path)


def write_ply_text(path, points):
    write_ply(path, points, text=True)


def pcd_writer(encoding):
    def write(path, points):
        intensity = np.zeros((len(points), 1), np.float32)
        PointCloud.from_xyzi_points(np.hstack([points, intensity])).save(path, encoding=encoding)

    return write


WRITERS = {
    "kitti.bin": write_bin,
    "float.npy": np.save,
    "named.npz": write_npz,
    "binary.ply": write_ply,
    "text.ply": write_ply_text,
    "ascii.pcd": pcd_writer(Encoding.ASCII),
    "binary.pcd": pcd_writer(Encoding.BINARY),
    "compressed.pcd": pcd_writer(Encoding.BINARY_COMPRESSED),
}


@pytest.mark.parametrize("name", WRITERS)
def test_reads_back_what_was_written(tmp_path, points, name):
    WRITERS[name](tmp_path / name, points)
    read = read_cloud(tmp_path / name)
    assert read.dtype == np.float32 and read.flags["C_CONTIGUOUS"]
    np.testing.assert_allclose(read, points, atol=1e-6)


@pytest.mark.parametrize("keep", [0.3, 0.6, "almost all"])
@pytest.mark.parametrize("name", WRITERS)
def test_refuses_a_truncated_file(tmp_path, points, name, keep):
    path = tmp_path / name
    WRITERS[name](path, points)
    raw = path.read_bytes()
    # A text PCD or PLY is complete as long as its last number has a digit left: cut the whole last line.
    cut = raw.rstrip().rfind(b"\n") if name in ("text.ply", "ascii.pcd") else len(raw) - 9
    path.write_bytes(raw[: cut if keep == "almost all" else int(len(raw) * keep) // 16 * 16 + 5])
    with pytest.raises(RecordingError, match=name) as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [*WRITERS, "text.npy"])
def test_refuses_an_empty_file_and_junk(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="empty"):
        read_cloud(path)
    path.write_bytes(b"this is no cloud at all, whatever its name says\n" * 3 + b"?")
    with pytest.raises(RecordingError, match=name):
        read_cloud(path)


def test_refuses_a_missing_file_and_an_unknown_format(tmp_path):
    with pytest.raises(RecordingError, match="no such file"):
        read_cloud(tmp_path / "gone.bin")
    with pytest.raises(RecordingError, match=r"unknown format '\.las'.*\.bin \.npy \.npz \.pcd \.ply"):
        read_cloud(tmp_path / "scan.las")


def test_refuses_clouds_without_coordinates(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros(12))
    np.savez(tmp_path / "many.npz", a=np.zeros((2, 3)), b=np.zeros((2, 3)))
    PointCloud.from_points([np.zeros(3, np.float32)] * 2, ["x", "y"], [np.float32] * 2).save(tmp_path / "xy.pcd")
    for name, problem in {"flat.npy": "got float64", "many.npz": "no array 'points'", "xy.pcd": "no field z"}.items():
        with pytest.raises(RecordingError, match=problem):
            read_cloud(tmp_path / name)


def test_reads_organised_and_structured_arrays(tmp_path):
    np.save(tmp_path / "image.npy", np.arange(24.0).reshape(2, 3, 4))
    assert read_cloud(tmp_path / "image.npy").tolist()[1] == [4, 5, 6]
    np.save(tmp_path / "rows.npy", np.array([(1, 2, 3)], dtype=[("z", "f4"), ("y", "f4"), ("x", "f4")]))
    assert read_cloud(tmp_path / "rows.npy").tolist() == [[3, 2, 1]]


def test_a_transposed_cloud_is_refused(tmp_path):
    np.save(tmp_path / "0.npy", np.zeros((3, 500), np.float32))
    with pytest.raises(RecordingError, match="transposed"):
        read_cloud(tmp_path / "0.npy")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", WRITERS)
def test_a_damaged_cloud_is_a_recording_error(tmp_path, points, name):
    """Flipped bits, most of them in the header; what cannot be noticed may be read."""
    path, rng = tmp_path / name, np.random.default_rng(1)
    WRITERS[name](path, points)
    whole = path.read_bytes()
    for k in range(80):
        place = int(rng.integers(0, len(whole) if k % 4 == 0 else min(len(whole), 400)))
        path.write_bytes(whole[:place] + bytes([whole[place] ^ (1 << int(rng.integers(8)))]) + whole[place + 1 :])
        try:
            read_cloud(path)
        except RecordingError as error:
            assert name in str(error)
