"""Times of the rays of a LaserScan: a scan lasts no longer than its period, whatever time_increment says."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.messages.laser_scan import read_laser_scan

NUM, PERIOD = 101, 0.1
INCREMENT = 0.08 / (NUM - 1)


def scan(increment):
    return SimpleNamespace(
        ranges=np.ones(NUM), angle_min=0.0, angle_increment=0.01, range_min=0.1, range_max=9.0, time_increment=increment
    )


@pytest.mark.parametrize(("scale", "unit"), [(1, ""), (1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_the_unit_is_that_in_which_a_scan_fits_its_period(scale, unit):
    cloud = read_laser_scan(scan(INCREMENT * scale), PERIOD)
    np.testing.assert_allclose(cloud.times[[0, -1]], [0, 0.08], atol=1e-9)
    texts = [note.text for note in cloud.notes]
    assert texts == ([] if not unit else [texts[0]])
    if unit == "ms":
        expected = "time_increment is 0.8: 101 rays would take 80 s, but scans come every 0.1 s; it is taken as ms"
        assert texts == [expected]


@pytest.mark.parametrize("increment", [INCREMENT * 30, INCREMENT * 4e4, np.inf])
def test_an_increment_that_fits_no_unit_is_not_used_and_named(increment):
    cloud = read_laser_scan(scan(increment), PERIOD)
    assert cloud.times is None and cloud.notes[0].text.startswith(f"time_increment is {increment:.6g}: 101 rays would")
    assert cloud.notes[0].text.endswith("but scans come every 0.1 s; it is not used")


@pytest.mark.parametrize("increment", [0.0, -1.0, np.nan])
def test_no_increment_is_no_time(increment):
    assert read_laser_scan(scan(increment), PERIOD)[1:3] == (None, ())


def test_of_a_single_scan_two_seconds_are_believed():
    assert read_laser_scan(scan(INCREMENT * 20)).times is not None
    assert "a scan takes 2 s at most; it is not used" in read_laser_scan(scan(INCREMENT * 30)).notes[0].text
