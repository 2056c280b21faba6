"""Depth PNGs and intrinsics files."""

import cv2
import numpy as np
import pytest

from torchelev.io import RecordingError, read_depth, read_intrinsics


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
    assert intrinsics[1:] == (0.001, "z")


def test_intrinsics_with_scale_and_ray_depth(tmp_path):
    (tmp_path / "camera.yaml").write_text("{fx: 5, fy: 5, cx: 2, cy: 2, depth_scale: 0.0002, along: ray}")
    assert read_intrinsics(tmp_path / "camera.yaml")[1:] == (0.0002, "ray")


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
