"""Depth PNGs and intrinsics files."""

import cv2
import numpy as np
import pytest

from torchelev.io import Intrinsics, RecordingError, read_depth, read_intrinsics
from torchelev.io.files.depth import read_depth_points
from torchelev.io.folders.scan_files import find_scans


def test_depth_round_trip_in_metres(tmp_path):
    image = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    cv2.imwrite(str(tmp_path / "depth.png"), image)
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png"), image / 1000.0)
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png", 0.0002), image / 5000.0, rtol=1e-6)


def test_refuses_truncated_and_wrong_images(tmp_path):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 9000, (40, 40), dtype=np.uint16))
    raw = path.read_bytes()
    for cut in (len(raw) // 2, len(raw) - 9, 20):
        path.write_bytes(raw[:cut])
        with pytest.raises(RecordingError, match=r"depth\.png: cut short"):
            read_depth(path)
    cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(RecordingError, match="expected one 16-bit channel, got uint8"):
        read_depth(path)
    with pytest.raises(RecordingError, match="no such file"):
        read_depth(tmp_path / "gone.png")


@pytest.mark.parametrize(
    "text",
    [
        "500 510 320 240",
        "500, 510, 320, 240",
        "# fx fy cx cy\n500 510 320 240 0.001\n",
        "500 0 320\n0 510 240\n0 0 1\n",
        "fx: 500\nfy: 510\ncx: 320\ncy: 240\n",
        "K: [500, 0, 320, 0, 510, 240, 0, 0, 1]",
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   data: [500, 0, 320, 0, 510, 240, 0, 0, 1]\n",
    ],
)
def test_intrinsics_in_the_forms_people_have(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    intrinsics = read_intrinsics(tmp_path / "camera.yaml")
    np.testing.assert_array_equal(intrinsics.matrix, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    assert (intrinsics.depth_scale, intrinsics.along) == (0.001, "z")


def test_intrinsics_with_scale_and_ray_depth(tmp_path):
    (tmp_path / "camera.yaml").write_text("{fx: 5, fy: 5, cx: 2, cy: 2, depth_scale: 0.0002, along: ray}")
    intrinsics = read_intrinsics(tmp_path / "camera.yaml")
    assert (intrinsics.depth_scale, intrinsics.along) == (0.0002, "ray")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "holds no intrinsics"),
        ("500 510 320", "holds 3 numbers"),
        ("fx: 500\nfy: 510\n", "no fx, fy, cx, cy"),
        ("fx: [\n", "neither text nor YAML"),
        ("0 510 320 240", "must be positive"),
        ("500 510 320 240 5000", "metres per unit"),
        ("{fx: 5, fy: 5, cx: 2, cy: 2, along: x}", "'z' or 'ray'"),
    ],
)
def test_refuses_bad_intrinsics(tmp_path, text, problem):
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(RecordingError, match=problem):
        read_intrinsics(tmp_path / "camera.txt")


INFO = "height: 480\nd: [0.0]\nk: [{k}]\np: [{p}]\nbinning_x: 0\n---\nk: [1, 0, 1, 0, 1, 1, 0, 0, 1]\n"
K = "385.5, 0.0, 318.5, 0.0, 385.5, 239.5, 0.0, 0.0, 1.0"


@pytest.mark.parametrize(
    ("text", "camera"),
    [
        (INFO.format(k=K, p="385.5"), (385.5, 318.5, 239.5)),
        (INFO.format(k=K, p="380, 0, 310, 0, 0, 380, 230, 0, 0, 0, 1, 0"), (380, 310, 230)),
        ('{"width": 640, "intrinsic_matrix": [525, 0, 0, 0, 525, 0, 319.5, 239.5, 1]}', (525, 319.5, 239.5)),
        ("[525, 0, 0, 0, 525, 0, 319.5, 239.5, 1]", (525, 319.5, 239.5)),
        ('{"intrinsics": {"fx": 385.5, "fy": 385.5, "ppx": 318.5, "ppy": 239.5}}', (385.5, 318.5, 239.5)),
        ("cam0:\n  intrinsics: [385.5, 385.5, 318.5, 239.5]\n", (385.5, 318.5, 239.5)),
    ],
)
def test_intrinsics_as_drivers_and_libraries_write_them(tmp_path, text, camera):
    (tmp_path / "c.yaml").write_text(text)
    matrix = read_intrinsics(tmp_path / "c.yaml").matrix
    assert (matrix[0, 0], matrix[0, 2], matrix[1, 2]) == camera


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (INFO.format(k="0, 0, 0, 0, 0, 0, 0, 0, 0", p=""), "is not calibrated"),
        ("a: {fx: 1, fy: 1, cx: 1, cy: 1}\nb: {fx: 1, fy: 1, cx: 1, cy: 1}", "several cameras: a, b"),
    ],
)
def test_intrinsics_that_are_open(tmp_path, text, problem):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(RecordingError, match=problem):
        read_intrinsics(tmp_path / "c.yaml")


@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 1), (1, 6, 8)])
def test_arrays_of_floats_are_metres(tmp_path, shape):
    depth = np.full(shape, 2.5, np.float32)
    depth.flat[0], depth.flat[1] = np.inf, np.nan
    np.save(tmp_path / "d.npy", depth)
    np.savez(tmp_path / "d.npz", depth=depth, other=1)
    for name in ("d.npy", "d.npz"):
        read = read_depth(tmp_path / name)
        assert read.shape == (6, 8) and read.ravel()[:3].tolist() == [0, 0, 2.5]


def test_arrays_of_millimetres(tmp_path):
    np.save(tmp_path / "d.npy", np.full((6, 8), 2500, np.uint16))
    assert read_depth(tmp_path / "d.npy")[0, 0] == 2.5
    np.save(tmp_path / "d.npy", np.full((6, 8), 2500.0))
    with pytest.raises(RecordingError, match="the median depth is 2500 m; give the metres per unit with --depth-scale"):
        read_depth(tmp_path / "d.npy")


def test_depth_along_rays_is_told_by_the_name(tmp_path):
    camera = Intrinsics(np.array([[4.0, 0, 4], [0, 4, 3], [0, 0, 1]]))
    for name, distance in (("distance_to_camera_0", 1.0), ("distance_to_image_plane_0", None)):
        np.save(tmp_path / f"{name}.npy", np.ones((6, 8), np.float32))
        points = read_depth_points(tmp_path / f"{name}.npy", camera)
        length = np.linalg.norm(points[0]) if distance else points[0, 2]
        assert length == pytest.approx(1.0)


def test_simulators_write_pictures_beside_depth(tmp_path):
    for k in range(2):
        np.save(tmp_path / f"distance_to_image_plane_{k}.npy", np.ones((6, 8), np.float32))
        cv2.imwrite(str(tmp_path / f"rgb_{k}.png"), np.zeros((6, 8, 3), np.uint8))
    assert [path.suffix for path in find_scans(tmp_path, depth=True)] == [".npy", ".npy"]
