"""Images of class labels in bags: their numbers, their camera, and which scan they follow."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from torchelev.io.bags.labels import attach_images, read_labels, scale_matrix
from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.folders.recording import Frame
from torchelev.io.labels import LabelImage, to_probabilities


def image(pixels, encoding, bigendian=False, step=None):
    data = pixels.astype(pixels.dtype.newbyteorder(">" if bigendian else "<")).tobytes()
    height, width = pixels.shape[:2]
    step = width * pixels.itemsize if step is None else step
    return SimpleNamespace(
        height=height, width=width, step=step, encoding=encoding, is_bigendian=int(bigendian), data=data
    )


@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize(("encoding", "kind"), [("mono8", "u1"), ("8UC1", "u1"), ("16UC1", "u2"), ("mono16", "u2")])
def test_labels_of_both_sizes(encoding, kind, bigendian):
    labels = np.array([[0, 1, 2], [3, 4, 250]], kind)
    np.testing.assert_array_equal(read_labels(image(labels, encoding, bigendian)), labels)


def test_labels_of_a_png_and_not_of_a_jpeg():
    labels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    for suffix in (".png", ".jpg"):
        message = SimpleNamespace(format=f"mono8; {suffix} compressed", data=cv2.imencode(suffix, labels)[1].tobytes())
        if suffix == ".png":
            np.testing.assert_array_equal(read_labels(message), labels)
        else:
            with pytest.raises(CloudError, match="compressed images of 'mono8; .jpg compressed' hold no labels"):
                read_labels(message)


def test_other_images_are_refused():
    with pytest.raises(CloudError, match="images of rgb8 hold no labels"):
        read_labels(image(np.zeros((2, 2, 3), np.uint8), "rgb8"))
    with pytest.raises(CloudError, match="the image has 4 bytes, too few for 3 rows of 2"):
        cut = image(np.zeros((2, 2), np.uint8), "mono8", step=2)
        cut.height = 3
        read_labels(cut)


def test_a_matrix_of_half_the_size():
    """The outer corner of an image stays where it is: its pixel coordinate is -0.5."""
    K = scale_matrix((100.0, 110.0, 49.5, 39.5), (100, 80), (50, 40))
    np.testing.assert_allclose(K, [[50.0, 0.0, 24.5], [0.0, 55.0, 19.5], [0.0, 0.0, 1.0]])
    with pytest.raises(CloudError, match="50 x 50 pixels, and its CameraInfo 100 x 80, another ratio of the sides"):
        scale_matrix((100.0, 110.0, 49.5, 39.5), (100, 80), (50, 50))


def test_labels_without_a_class_say_nothing():
    found = to_probabilities(np.array([[0, 1, 2, 255]], np.uint8), 2)
    np.testing.assert_array_equal(found, [[[1, 0, np.nan, np.nan]], [[0, 1, np.nan, np.nan]]])


def test_images_follow_the_scan_before_them():
    scans = [Frame(np.zeros((0, 3), np.float32), np.eye(4), 0.1, str(k)) for k in range(2)]
    images = [LabelImage(np.full((1, 1), k), np.eye(3), np.eye(4)) for k in range(4)]
    events = [images[0], scans[0], images[1], None, images[2], scans[1], images[3]]
    frames = list(attach_images(events))
    assert [None if frame is None else frame.name for frame in frames] == [None, "0", "1"]
    assert [[int(one.labels[0, 0]) for one in frame.images] for frame in frames if frame is not None] == [[1, 2], [3]]
