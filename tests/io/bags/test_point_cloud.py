"""Points and times out of PointCloud2 messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.bags.synthetic import make_cloud
from torchelev.io.bags.point_cloud import CloudError, read_points, to_seconds
from torchelev.io.bags.scans import read_scan

STAMP = 1_700_000_000.25


class Plain:
    """Makes messages without a typestore."""

    def make(self, type_, /, **fields):
        return SimpleNamespace(**fields)


HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=250_000_000), frame_id="/lidar")
LAYOUTS = dict(
    dtype=st.sampled_from(["f4", "f8"]),
    order=st.permutations("xyz").map("".join),
    pad=st.integers(0, 5),
    bigendian=st.booleans(),
    rows=st.sampled_from([1, 2, 3]),
)


def cloud(points, times=None, **layout):
    return make_cloud(Plain(), points, times, HEADER, **layout)


@given(st.integers(0, 10_000), st.sampled_from([0, 6, 24]), st.booleans(), st.fixed_dictionaries(LAYOUTS))
def test_any_layout_is_read(seed, num_points, has_times, layout):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(num_points, 3)).astype(np.float32)
    times = rng.permutation(np.linspace(-0.1, 0.0, num_points)) if has_times and num_points else None
    read = read_points(cloud(points, times, time="timestamp", **layout), STAMP)
    np.testing.assert_array_equal(read.points, points)
    if times is None:
        assert read.times is None
    else:
        np.testing.assert_allclose(read.times, times, atol=1e-6)
    assert read.notes == ()


SPAN = np.linspace(0.0, 0.1, 5)  # [s]
TIMES = {
    "velodyne: s, float32, before the stamp": (np.float32(SPAN - 0.1), SPAN - 0.1),
    "ouster: ns, uint32": ((SPAN * 1e9).astype(np.uint32), SPAN),
    "hesai: s since 1970, float64": (STAMP + SPAN, SPAN),
    "livox: ns since 1970, float64": ((STAMP + SPAN) * 1e9, SPAN),
    "us, float32": (np.float32(SPAN * 1e6), SPAN),
    "ms, float32": (np.float32(SPAN * 1e3), SPAN),
    "us, uint32": ((SPAN * 1e6).astype(np.uint32), SPAN),
    "ns since 1970, uint64": (((STAMP + SPAN) * 1e9).astype(np.uint64), SPAN),
}


@pytest.mark.parametrize(("raw", "expected"), TIMES.values(), ids=TIMES)
def test_units_are_told_by_the_length_of_a_scan(raw, expected):
    np.testing.assert_allclose(to_seconds(raw, STAMP), expected, atol=1e-6)


@pytest.mark.parametrize("raw", [np.zeros(4), np.arange(4) * 1e12, np.full(4, np.nan), STAMP + 3600 + SPAN])
def test_times_that_are_none_are_not_used(raw):
    assert to_seconds(np.asarray(raw, dtype=np.float64), STAMP) is None


def test_unclear_times_are_said():
    message = cloud(np.zeros((5, 3), np.float32), SPAN * 100, time="timestamp")
    (note,) = read_points(message, STAMP).notes
    assert "the times in field timestamp run from 1700000000.25 to 1700000010.25: in no unit" in note.text


@given(
    st.lists(st.integers(0, 60), min_size=3, max_size=3), st.integers(0, 40), st.integers(0, 400),
    st.integers(0, 9), st.integers(0, 9), st.integers(0, 200), st.sampled_from([0, 1, 7, 8, 200]),
)  # fmt: skip
def test_nonsense_is_refused_or_read_and_never_raises_otherwise(offsets, step, row, height, width, size, datatype):
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=datatype, count=1)
        for name, offset in zip("xyz", offsets, strict=True)
    ]
    message = SimpleNamespace(
        fields=fields, is_bigendian=False, height=height, width=width, point_step=step, row_step=row,
        data=np.zeros(size, np.uint8),
    )  # fmt: skip
    try:
        assert read_points(message, 0.0).points.shape == (height * width, 3)
    except CloudError as error:
        assert "contradict" in str(error) or "unknown type" in str(error)


@pytest.mark.parametrize("row_step", [0, 12 * 4000])
def test_rows_without_padding_are_read_whatever_row_step_says(row_step):
    points = np.random.default_rng(0).normal(size=(32, 3)).astype(np.float32)
    message = cloud(points, rows=4)
    message.row_step = row_step
    np.testing.assert_array_equal(read_points(message, STAMP).points, points)
    message.data = message.data[:-1]
    with pytest.raises(CloudError, match="contradict each other: 4 x 8 points of 12 bytes"):
        read_points(message, STAMP)


def test_data_may_be_bytes():
    points = np.random.default_rng(0).normal(size=(32, 3)).astype(np.float32)
    message = cloud(points)
    for data in (message.data.tobytes(), bytearray(message.data), message.data.tolist()):
        message.data = data
        np.testing.assert_array_equal(read_points(message, STAMP).points, points)


def test_what_is_no_message_is_refused_in_words():
    with pytest.raises(
        CloudError, match="expected a PointCloud2 with fields and point_step, got bytes; deserialise it"
    ):
        read_points(b"0123", STAMP)


def test_a_cloud_without_heights_is_refused():
    message = cloud(np.zeros((2, 3), np.float32), order="xy")
    with pytest.raises(CloudError, match="the cloud has no field z; it has x, y"):
        read_points(message, 0.0)


def test_a_laser_scan():
    message = SimpleNamespace(
        header=HEADER, ranges=np.array([1.0, 2.0, np.inf, 0.05]), angle_min=0.0, angle_increment=np.pi / 2,
        range_min=0.1, range_max=10.0, time_increment=0.01,
    )  # fmt: skip
    scan = read_scan(message)
    expected = [[1, 0, 0], [0, 2, 0], [np.nan] * 3, [np.nan] * 3]
    np.testing.assert_allclose(scan.points, expected, atol=1e-6)
    np.testing.assert_allclose(scan.times, [0, 0.01, 0.02, 0.03])
    assert (scan.frame, scan.stamp) == ("lidar", STAMP)


IMAGE = dict(header=HEADER, height=2, width=3, is_bigendian=0, encoding="32FC1", step=12, data=np.zeros(24, np.uint8))
INFO = SimpleNamespace(height=2, width=3, k=np.array([1.0, 0, 1, 0, 1, 1, 0, 0, 1]), p=np.zeros(12), d=np.zeros(5))
BAD_IMAGES = {
    "colour": (dict(encoding="rgb8"), {}, "images of rgb8 hold no depth; 16UC1 and 32FC1 do"),
    "cut": (dict(data=np.zeros(20, np.uint8)), {}, "has 20 bytes, too few for 2 rows of 12"),
    "other size": ({}, dict(width=4), "has 3 x 2 pixels, and its CameraInfo 4 x 2"),
    "uncalibrated": ({}, dict(k=np.zeros(9)), "holds no calibration"),
}


@pytest.mark.parametrize(("image", "info", "words"), BAD_IMAGES.values(), ids=BAD_IMAGES)
def test_bad_images_are_refused(image, info, words):
    with pytest.raises(CloudError, match=words):
        read_scan(SimpleNamespace(**(IMAGE | image)), SimpleNamespace(**(vars(INFO) | info)))


def test_a_compressed_image_without_depth_is_refused():
    message = SimpleNamespace(header=HEADER, format="jpeg", data=np.arange(50, dtype=np.uint8))
    with pytest.raises(CloudError, match="compressed images of 'jpeg' hold no depth"):
        read_scan(message, INFO)
