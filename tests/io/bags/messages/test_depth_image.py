"""Depth images: units, axes, step 0, and depths that no camera gives."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.messages.depth_image import CameraSettings, read_depth_image

CAMERA = SimpleNamespace(height=2, width=3, k=np.array([1.0, 0, 1, 0, 1, 1, 0, 0, 1]), p=np.zeros(12), d=())
DEPTH = np.array([[1.0, 2, 3], [2, 3, 4]])


def image(depth, encoding="16UC1", unit=1e-3, step=None):
    raw = np.round(depth / unit).astype("<u2") if encoding != "32FC1" else (depth / unit).astype("<f4")
    height, width = depth.shape
    data = raw.tobytes()
    step = len(data) // height if step is None else step
    return SimpleNamespace(height=height, width=width, encoding=encoding, is_bigendian=0, step=step, data=data)


def read(message, **settings):
    cloud = read_depth_image(message, CameraSettings(CAMERA, **settings))
    return cloud.points.reshape(2, 3, 3), [note.text for note in cloud.notes]


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_the_unit_is_that_of_the_encoding_or_the_one_given(encoding):
    metres = 1.0 if encoding == "32FC1" else 1e-3
    for scale in (None, 1e-4):
        points, notes = read(image(DEPTH, encoding, scale or metres), scale=scale)
        np.testing.assert_allclose(points[..., 2], DEPTH, atol=1e-4)
        assert notes == []


@pytest.mark.parametrize("step", [0, 5000])
def test_rows_without_padding_are_read_whatever_step_says(step):
    np.testing.assert_allclose(read(image(DEPTH, step=step))[0][..., 2], DEPTH)


def test_axes_of_a_body_frame_are_forward_left_up():
    optical, body = read(image(DEPTH))[0], read(image(DEPTH), axes="forward")[0]
    np.testing.assert_allclose(body, np.stack([optical[..., 2], -optical[..., 0], -optical[..., 1]], -1))


@pytest.mark.parametrize(
    ("depth", "encoding", "words"),
    [
        (DEPTH * 10, "16UC1", "half of the depths are beyond 25 m, unlikely for a camera; if their unit"),
        (DEPTH * 1e3, "32FC1", "half of the depths are beyond 2.5e+03 m"),
        (DEPTH / 100, "16UC1", "half of the depths are below 0.025 m"),
        (DEPTH * 3, "16UC1", ""),
        (DEPTH * 20, "32FC1", ""),
        (np.where(DEPTH > 2, 65.535, DEPTH), "16UC1", ""),  # the sky
        (np.where(DEPTH > 2, 1000.0, DEPTH), "32FC1", ""),
        (np.where(DEPTH > 1, 0.0, DEPTH), "16UC1", ""),
    ],
)
def test_depths_that_no_camera_gives_are_doubted(depth, encoding, words):
    _, notes = read(image(depth, encoding, 1.0 if encoding == "32FC1" else 1e-3))
    assert len(notes) == bool(words) and words in " ".join(notes)
