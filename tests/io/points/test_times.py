"""Times of points: in any unit, of one scan, and only those of returns."""

import numpy as np
import pytest

from tests.io.bags.test_point_cloud import SPAN, STAMP, cloud
from torchelev.io.bags.point_cloud import read_points, to_seconds

PERIOD = 0.1  # [s]
POINTS = np.ones((5, 3), np.float32)


@pytest.mark.parametrize(("unit", "dtype"), [(1, "f4"), (1e3, "f4"), (1e6, "u4"), (1e9, "u4"), (1e9, "f8")])
def test_a_scan_takes_no_longer_than_the_period_in_any_unit(unit, dtype):
    np.testing.assert_allclose(to_seconds((SPAN * unit).astype(dtype), STAMP, PERIOD), SPAN, atol=1e-6)
    assert to_seconds((15 * SPAN * unit).astype(dtype), STAMP, PERIOD) is None
    assert to_seconds((15 * SPAN * unit).astype(dtype), STAMP) is not None


def test_times_from_0_to_1_are_fractions_of_the_period_and_said():
    np.testing.assert_allclose(to_seconds(np.float32(SPAN * 10 - 1), STAMP, PERIOD), SPAN - 0.1, atol=1e-6)
    assert to_seconds(np.float32(SPAN * 10), STAMP, 0.3) is None  # of a topic from which scans were dropped
    raw = np.float32(SPAN * 10)
    np.testing.assert_allclose(to_seconds(raw, STAMP, PERIOD), SPAN, atol=1e-6)
    np.testing.assert_allclose(to_seconds(raw, STAMP, 1.0), SPAN * 10, atol=1e-6)  # a scan of a second


def read(times, points=POINTS, period=PERIOD, scale=1.0):
    """The cloud whose field of times holds these numbers."""
    message = cloud(points, np.zeros(len(points)), time="timestamp")
    table = message.data.reshape(len(points), message.point_step)
    table[:, 12:20] = (np.asarray(times, dtype="<f8") * scale).reshape(-1, 1).view(np.uint8)
    return read_points(message, STAMP, period)


def test_the_note_says_which_number_is_odd():
    (note,) = read(SPAN * 15).notes
    assert note.text == (
        "the times in field timestamp run from 0 to 1.5: in no unit is that a scan of at most 0.12 s at its stamp, "
        "1700000000.25 s; they are not used"
    )
    (note,) = read(SPAN * 10).notes
    assert note.text == "the times in field timestamp run from 0 to 1: taken as fractions of the period of 0.1 s"
    assert read(SPAN * 15).times is None and read(np.zeros(5)).notes == ()


@pytest.mark.parametrize("scale", [1.0, 1e9], ids=["s", "ns"])
@pytest.mark.parametrize("absent", [np.nan, 0.0], ids=["NaN", "at the origin"])
@pytest.mark.parametrize("junk", [0.0, 1e300, -5.0])
def test_only_times_of_returns_count(scale, absent, junk):
    points = POINTS.copy()
    points[[1, 3]] = absent
    times = STAMP + SPAN
    times[[1, 3]] = junk / scale
    cloud = read(times, points, scale=scale)
    np.testing.assert_allclose(cloud.times[[0, 2, 4]], SPAN[[0, 2, 4]], atol=1e-6)
    assert np.isnan(cloud.times[[1, 3]]).all() and cloud.notes == ()


def test_points_without_a_time_are_left_out_and_counted():
    times = STAMP + SPAN
    times[1] = 0.0
    cloud = read(times)
    assert np.isnan(cloud.times[1])
    assert cloud.notes[0].text == "1 of 5 points have no time in field timestamp, and are left out"


@pytest.mark.parametrize("odd", [3.0, -3.0, 1e9])
def test_few_times_that_lie_apart_do_not_change_the_unit(odd):
    times = np.linspace(0, 0.1, 500)
    times[7] = odd
    seconds = to_seconds(times.astype(np.float32), STAMP, PERIOD)
    assert np.isnan(seconds[7])
    np.testing.assert_allclose(np.delete(seconds, 7), np.delete(times, 7), atol=1e-6)


@pytest.mark.parametrize("offset", [37.0, -1_699_999_000.0, 5.0])
def test_times_by_another_clock_are_not_used(offset):
    assert to_seconds(STAMP + offset + SPAN, STAMP, PERIOD) is None
