"""Noise, losses and mountings have the statistics that their config says.

Bounds on statistics are five standard errors of the sample.
"""

import math

import pytest
import torch

from tests.devices import NoConstants, OneDevice
from tests.helpers import NoGenerator
from tests.sim.errors.error_cases import LIVELY, NAN, assert_mean, assert_share, assert_sigma, make, poses, rays
from torchelev.sim.errors.error_models import SensorErrorConfig, SensorErrors


def test_no_errors_change_nothing():
    points = rays(2, 50)
    points[0, 3] = NAN
    got = make(2)(points, poses(2))
    torch.testing.assert_close(got.points, points, atol=0, rtol=0, equal_nan=True)
    assert got.points.data_ptr() != points.data_ptr()
    assert torch.equal(got.T_map_sensor, poses(2))
    assert torch.equal(make(2).mounting(), poses(2))


@pytest.mark.parametrize(("distance", "sigma"), [(1.0, 0.005), (2.0, 0.014), (4.0, 0.050)])
def test_range_noise_grows_with_the_distance_and_stays_on_the_ray(distance, sigma):
    points = rays(2, 20_000, distance)
    got = make(2, range_constant=0.002, range_quadratic=0.003)(points).points
    error = got.norm(dim=-1) - distance
    assert_mean(error, 0.0, sigma)
    assert_sigma(error, sigma)
    assert float(torch.linalg.cross(got, points).norm(dim=-1).max()) < 1e-5


def test_point_noise_and_outliers():
    points = rays(1, 40_000)
    got = make(point_noise=0.01, outliers=0.25, outlier_noise=0.3)(points).points - points
    # A mixture of two normals: its variance is the mixture of theirs, its fourth moment gives the sampling error.
    mixed = [(0.75, 0.01), (0.25, 0.3)]
    variance = sum(p * s**2 for p, s in mixed)
    fourth = sum(p * 3 * s**4 for p, s in mixed)
    for axis in range(3):
        assert_mean(got[..., axis], 0.0, math.sqrt(variance))
        assert_mean(got[..., axis].square(), variance, math.sqrt(fourth - variance**2))
    far = got.abs().amax(-1) > 0.06  # beyond 6 sigma of the one, within 0.2 of the other
    within = math.erf(0.06 / 0.3 / math.sqrt(2)) ** 3
    assert_share(far, 0.25 * (1 - within))


def test_dropout_loses_points():
    lost = make(2, dropout=0.1)(rays(2, 20_000)).points.isnan()
    assert torch.equal(lost.all(-1), lost.any(-1))
    assert_share(lost.all(-1), 0.1)
    assert_share(lost[0, :, 0] & lost[1, :, 0], 0.01)  # each environment loses others


def test_missed_frames_lose_whole_clouds():
    errors = make(500, missed_frames=0.3)
    lost = torch.stack([errors(rays(500, 4)).points.isnan().flatten(1) for _ in range(10)])
    assert torch.equal(lost.all(-1), lost.any(-1))
    assert_share(lost.all(-1), 0.3)
    assert len({tuple(row.all(-1).tolist()) for row in lost}) > 1  # not the same at each step


def test_an_environment_depends_on_its_own_cloud_alone():
    clouds = rays(3, 60)
    one, other = (SensorErrors(LIVELY, 3)(c, poses(3), image_shape=(6, 10)).points for c in (clouds, clouds * 0.5))
    mixed = SensorErrors(LIVELY, 3)(torch.stack([clouds[0], clouds[1] * 0.5, clouds[2]]), poses(3), image_shape=(6, 10))
    expected = torch.stack([one[0], other[1], one[2]])
    torch.testing.assert_close(mixed.points, expected, atol=0, rtol=0, equal_nan=True)


def test_mounting_is_rigid_with_the_spread_it_says():
    T = make(20_000, mounting_position=0.02, mounting_rotation_deg=2.0).mounting()
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20_000), atol=1e-5, rtol=0)
    assert T[:, 3].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 20_000
    for axis in range(3):
        assert_sigma(T[:, axis, 3], 0.02)
    turn = torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    for axis in range(3):  # sin(a) / a differs from 1 by 1e-3 at 4 degrees, the bound is 2.5e-2
        assert_mean(turn[:, axis], 0.0, math.radians(2.0))
        assert_sigma(turn[:, axis], math.radians(2.0))


def test_mounting_stays_until_reset():
    errors = make(3, mounting_position=0.02)
    first = errors.mounting()
    errors(rays(3, 5))
    assert torch.equal(errors.mounting(), first)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"dropout": 1.2}, "SensorErrorConfig.dropout"),
        ({"dropout": (0.3, 0.1)}, "low <= high"),
        ({"range_constant": -0.1}, "range_constant"),
        ({"range_constant": NAN}, "finite"),
        ({"range_constant": (0.0, 0.1, 0.2)}, "one value or a pair"),
        ({"range_constant": "0.1"}, "finite"),
        ({"latency": 1.5}, "whole"),
        ({"too_short": 0.6, "too_long": 0.6}, "sum to 1"),
    ],
)
def test_bad_configs_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        SensorErrorConfig(**fields)


def test_bad_calls_are_refused_before_anything_changed():
    errors = make(2, latency=1)
    with pytest.raises(ValueError, match=r"points: expected \(2, M, 3\), got \(3, 5, 3\)"):
        errors(rays(3, 5), poses(2))
    with pytest.raises(ValueError, match="T_map_sensor: must be given where clouds are late"):
        errors(rays(2, 5))
    with pytest.raises(ValueError, match="T_map_sensor"):
        errors(rays(2, 5), poses(3))
    with pytest.raises(ValueError, match="image_shape"):
        errors(rays(2, 5), poses(2), image_shape=(2, 3))
    assert errors.delay.clouds is None
    errors(rays(2, 5), poses(2))
    with pytest.raises(ValueError, match="one SensorErrors for each sensor"):
        errors(rays(2, 6), poses(2))
    with pytest.raises(ValueError, match="exclude"):
        errors.reset(torch.tensor([0]), mask=torch.tensor([True, False]))
    with pytest.raises(ValueError, match="env_ids"):
        errors.reset(torch.tensor([2]))
    with pytest.raises(ValueError, match="mask"):
        errors.reset(mask=torch.tensor([True]))


def test_host_reads_nothing_back(monkeypatch):
    # Tensors on "meta" have no values, so that reading one raises.
    monkeypatch.setattr(torch, "Generator", NoGenerator)
    errors = SensorErrors(LIVELY, 2, "meta")
    points, T = torch.empty(2, 60, 3, device="meta"), torch.empty(2, 4, 4, device="meta")
    with NoConstants(), OneDevice():
        errors(points, T, image_shape=(6, 10))
        errors.mounting()
        errors.reset(mask=torch.empty(2, dtype=torch.bool, device="meta"))
        errors.reset(torch.empty(1, dtype=torch.int64, device="meta"))
