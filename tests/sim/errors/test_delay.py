"""Clouds arrive late by each environment's latency, with the poses at which they were taken."""

import pytest
import torch

from tests.sim.errors.error_cases import NAN, assert_share, make, poses


def numbered(errors, count, first=0, B=4):
    """Feed clouds numbered by their x, at poses of the same number; return the numbers that come out (count, B)."""
    actual, where = [], []
    for k in range(first, first + count):
        got = errors(torch.full((B, 3, 3), float(k)), poses(B, k))
        actual.append(got.points[:, 0, 0])
        where.append(got.T_map_sensor[:, 0, 3])
    return torch.stack(actual), torch.stack(where)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_clouds_are_late_by_exactly_n_calls_with_their_own_pose(n):
    actual, where = numbered(make(4, latency=n), 8)
    for k in range(8):
        if k < n:
            assert bool(actual[k].isnan().all()) and where[k].tolist() == [k] * 4  # nothing has come yet
        else:
            assert actual[k].tolist() == [k - n] * 4 and where[k].tolist() == [k - n] * 4


def test_a_clock_offset_brings_the_pose_of_now():
    actual, where = numbered(make(4, latency=2, clock_offset=True), 6)
    assert actual[5].tolist() == [3.0] * 4 and where[5].tolist() == [5.0] * 4


def test_each_environment_has_its_own_latency_and_reset_forgets_its_clouds_alone():
    errors = make(64, latency=(0, 2))
    n = errors.value("latency")
    assert set(n.tolist()) == {0.0, 1.0, 2.0}
    actual, _ = numbered(errors, 5, B=64)
    torch.testing.assert_close(actual[4], 4 - n)
    mask = torch.arange(64) < 10
    errors.reset(mask=mask)
    n = torch.where(mask, errors.value("latency"), n)
    actual, where = numbered(errors, 3, first=5, B=64)
    for k in range(3):
        expected = torch.where(mask & (n > k), torch.tensor(NAN), 5 + k - n)
        torch.testing.assert_close(actual[k], expected, equal_nan=True)
    torch.testing.assert_close(where[2], 7 - n)


def test_latencies_are_drawn_evenly_with_both_ends():
    n = make(30_000, latency=(1, 4)).value("latency")
    for k in (1, 2, 3, 4):
        assert_share(n == k, 0.25)


def test_a_ring_made_in_inference_mode_can_be_written_outside():
    errors = make(4, latency=1)
    with torch.inference_mode():
        numbered(errors, 2)
        errors.reset(torch.tensor([1]))
    actual, _ = numbered(errors, 2, first=2)
    assert actual[1].tolist() == [2.0] * 4
