"""Inputs of observations: noise, feet, and what is refused."""

import dataclasses

import pytest
import torch

from tests.helpers import pose, small_map
from tests.observations.maps import BASE, flat, ground_map
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage

ONE = HeightScan.points([(0.0, 0.0)])  # right below the base


def test_noise_is_off_unless_asked_for():
    emap, T, scan = ground_map(flat), pose(BASE), HeightScan.isaac_lab()
    assert torch.equal(scan(emap, T)[0], scan(emap, T)[0])
    torch.manual_seed(0)
    error = scan(emap, T, noise=True)[0] - scan(emap, T)[0]
    assert error.abs().max() <= 0.1 and error.max() > 0.08 and error.min() < -0.08 and len(error.unique()) > 150
    torch.manual_seed(0)
    assert torch.equal(scan(emap, T, noise=True)[0] - scan(emap, T)[0], error)


def test_a_nan_foot_reads_nothing():
    emap, T = ground_map(flat), pose(BASE)
    feet = T[:, None, :3, 3].repeat(1, 2, 1)
    feet[0, 1] = torch.nan
    values, valid = HeightScan.feet(num_feet=2)(emap, T, feet)
    assert valid[:, :52].all() and not valid[:, 52:].any() and not values[:, 52:].any()


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda e, T: ONE(e, T[0]), r"T_map_base: expected \(2, 4, 4\) on cpu, got \(4, 4\)"),
        (lambda e, T: ONE(e, T.int()), "T_map_base: must be float32, float64"),
        (lambda e, T: ONE(e, T * 2), "T_map_base: must be rigid"),
        (lambda e, T: MapImage(length_x=0.4, length_y=0.4)(e, T[:1]), r"T_map_base: expected \(2, 4, 4\)"),
        (lambda e, T: ONE(e, T, torch.zeros(2, 4, 3)), "feet: must be left out, got feet for a scan around the base"),
        (lambda e, T: HeightScan.feet(reach=0.3)(e, T), r"feet: expected \(2, 4, 3\), got None"),
        (lambda e, T: HeightScan.feet(reach=0.3)(e, T, T[:, :3, :3]), r"feet: expected \(2, 4, 3\), got \(2, 3, 3\)"),
        (lambda e, T: ONE(e, T, noise=True), "noise: must be off, as this scan has none, got on; build"),
        (lambda e, T: dataclasses.replace(ONE, noise=0.1)(e, T, noise=torch.rand(2)), r"noise: expected \(2, 1\)"),
    ],
)
def test_bad_inputs_are_refused(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call(small_map(2, (20, 20)), pose(num_envs=2))


def test_a_scan_around_feet_asks_for_them():
    with pytest.raises(ValueError, match=r"feet: expected \(1, 4, 3\), got None; give the feet's positions"):
        HeightScan.feet()(small_map(1, (30, 30)), pose())
