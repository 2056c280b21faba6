"""Clouds in Livox's own messages."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.scans import read_scan

STAMP = SimpleNamespace(sec=1_700_000_000, nanosec=500_000_000)


def message(timebase):
    rows = [(1.0, 2.0, 3.0, 0), (0.0, 0.0, 0.0, 40_000_000), (4.0, 5.0, 6.0, 90_000_000)]
    points = [SimpleNamespace(x=x, y=y, z=z, offset_time=t) for x, y, z, t in rows]
    return SimpleNamespace(
        header=SimpleNamespace(stamp=STAMP, frame_id="livox_frame"), timebase=timebase, point_num=3, points=points
    )


@pytest.mark.parametrize(("timebase", "start"), [(1_700_000_000_400_000_000, -0.1), (812_000_000_000, 0.0), (0, 0.0)])
def test_times_count_from_timebase_unless_it_is_by_another_clock(timebase, start):
    scan = read_scan(message(timebase))
    np.testing.assert_allclose(scan.points, [[1, 2, 3], [np.nan] * 3, [4, 5, 6]])
    np.testing.assert_allclose(scan.times, start + np.array([0, 0.04, 0.09]), atol=1e-6)
    assert (scan.frame, scan.stamp) == ("livox_frame", 1_700_000_000.5)


def test_a_message_without_points():
    empty = message(0)
    empty.points = []
    scan = read_scan(empty)
    assert scan.points.shape == (0, 3) and scan.times is None
