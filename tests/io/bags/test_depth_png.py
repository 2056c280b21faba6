"""Depth in PNGs: in millimetres, or quantised; whole images only."""

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.io.bags.synthetic import CAMERA, T_BASE_CAMERA, Writer, drive
from tests.io.bags.test_recording import map_bag
from torchelev.io.bags import BagRequest
from torchelev.io.bags.messages.depth_png import decode_depth
from torchelev.io.bags.point_cloud import CloudError
from torchelev.io.bags.scans import read_scan

DEPTH = np.random.default_rng(0).uniform(0.3, 9.5, (CAMERA.height, CAMERA.width)).astype(np.float32)
DEPTH[3, 4] = np.nan
QUANTISED, MILLIMETRES = "32FC1; compressedDepth png", "16UC1; compressedDepth png"


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def quantise(depth, z0=100.0, depth_max=10.0):
    """As compressed_depth_image_transport does, with its default settings."""
    a = z0 * (z0 + 1)
    b = 1 - a / depth_max
    inverse = np.where(np.isfinite(depth), a / depth + b, 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + png(inverse)


def test_quantised_depth_is_that_of_the_sensor_to_its_quantisation():
    decoded = decode_depth(quantise(DEPTH), QUANTISED)
    assert decoded.dtype == np.float32 and decoded[3, 4] == 0
    known = np.isfinite(DEPTH)
    step = DEPTH**2 / (100 * 101)  # of the depth by one step of the inverse
    assert (np.abs(decoded - DEPTH) <= 1.1 * step + 1e-5)[known].all()


def test_quantised_depth_becomes_points():
    data = np.frombuffer(quantise(DEPTH), np.uint8)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="camera")
    message = SimpleNamespace(header=header, format=QUANTISED, data=data)
    camera = SimpleNamespace(k=CAMERA.intrinsics.numpy().ravel(), width=CAMERA.width, height=CAMERA.height)
    z = read_scan(message, camera).points[:, 2].reshape(DEPTH.shape)
    assert np.isnan(z[3, 4]) and np.nanmax(np.abs(z - DEPTH)) < 0.01


@pytest.mark.parametrize("encoding", [QUANTISED, MILLIMETRES])
def test_a_png_that_is_cut_or_damaged_anywhere_is_refused(encoding):
    whole, rng = quantise(DEPTH), np.random.default_rng(0)
    expected = decode_depth(whole, encoding)
    for size in range(20, len(whole), 7):
        with pytest.raises(CloudError, match="of a depth image is cut short|hold no depth"):
            decode_depth(whole[:size], encoding)
    for place in rng.integers(20, len(whole), 100):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(CloudError, match="is damaged: a checksum is wrong|is cut short"):
            decode_depth(bytes(damaged), encoding)
    np.testing.assert_array_equal(decode_depth(whole + b"padding", encoding), expected)


REFUSED = {
    "a jpeg": (b"\xff\xd8" + bytes(50), "jpeg", "images of 'jpeg' hold no depth"),
    "8 bits": (png(np.zeros((3, 4), np.uint8)), "png", "images of 'png' hold no depth"),
    "no header": (quantise(DEPTH)[12:], QUANTISED, "has a header of 0 bytes; expected 12"),
    "no quantisation": (bytes(12) + quantise(DEPTH)[12:], QUANTISED, "quantisation a = 0, b = 0; a must be positive"),
    "nan": (struct.pack("<iff", 0, 1, np.nan) + quantise(DEPTH)[12:], QUANTISED, "quantisation a = 1, b = nan"),
}


@pytest.mark.parametrize(("data", "encoding", "words"), REFUSED.values(), ids=REFUSED)
def test_what_holds_no_depth_is_refused(data, encoding, words):
    with pytest.raises(CloudError, match=words):
        decode_depth(data, encoding)


def test_a_cut_image_is_a_scan_left_out(tmp_path, monkeypatch):
    writer, topic = Writer(tmp_path / "drive", "mcap"), "/camera/depth/image_raw/compressedDepth"
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "camera", T @ T_BASE_CAMERA.numpy())
    (first, depth), (second, _), *_ = drive().depths
    writer.camera_info(first.stamp)
    writer.depth(first.stamp, depth, "png", topic)
    encode = cv2.imencode
    monkeypatch.setattr(cv2, "imencode", lambda *given: (True, encode(*given)[1][:-20]))
    writer.depth(second.stamp, depth, "png", topic)
    writer.close()
    _, frames, recording = map_bag(tmp_path / "drive", BagRequest(depths=[topic]))
    assert len(frames) == 1
    assert recording.warnings == ["1 of 2 scans were left out: the PNG of a depth image is cut short"]
