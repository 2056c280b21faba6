"""Noise has the statistics it promises and stays on the ray."""

import pytest
import torch

from torchelev.sim import dropout, outliers, range_noise


def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def points():
    """Rays in many directions, 1 to 4 m long."""
    d = torch.nn.functional.normalize(torch.randn(40000, 3, generator=generator(), dtype=torch.float64), dim=-1)
    return d * (1 + 3 * torch.rand(40000, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64))


def test_range_noise_has_the_spread_it_says_and_stays_on_the_ray(points):
    got = range_noise(points, generator(), constant=0.002, quadratic=0.003)
    d = points.norm(dim=-1)
    error = (got * points).sum(-1) / d - d
    assert float((torch.linalg.cross(got, points)).norm(dim=-1).max()) < 1e-9
    standardised = error / (0.002 + 0.003 * d**2)
    assert abs(float(standardised.mean())) < 0.02 and abs(float(standardised.std()) - 1) < 0.02


def test_dropout_share(points):
    lost = dropout(points, generator(), share=0.1).isnan().all(-1)
    assert abs(float(lost.double().mean()) - 0.1) < 0.01


@pytest.mark.parametrize(("kind", "low", "high"), [("dust", 0.1, 1.0), ("too_long", 1.05, 2.0)])
def test_outlier_ranges(points, kind, low, high):
    got = outliers(points, generator(), **{kind: 0.2})
    ratio = got.norm(dim=-1) / points.norm(dim=-1)
    moved = (ratio - 1).abs() > 1e-9
    assert abs(float(moved.double().mean()) - 0.2) < 0.01
    assert float(ratio[moved].min()) >= low and float(ratio[moved].max()) <= high


def test_flying_pixels_lie_between_neighbours(points):
    got = outliers(points, generator(), flying=0.3).norm(dim=-1)
    d = points.norm(dim=-1)
    low, high = torch.minimum(d, d.roll(-1)), torch.maximum(d, d.roll(-1))
    assert bool(((got >= low - 1e-9) & (got <= high + 1e-9)).all())
    assert abs(float(((got - d).abs() > 1e-9).double().mean()) - 0.3) < 0.01


def test_missing_points_stay_missing(points):
    points[::3] = float("nan")
    for f in (range_noise, dropout, lambda p, g: outliers(p, g, dust=0.1, flying=0.1, too_long=0.1)):
        got = f(points, generator())
        assert bool(got[::3].isnan().all())
        assert bool(got[1::3].isfinite().any())


def test_same_seed_same_noise(points):
    torch.testing.assert_close(range_noise(points, generator()), range_noise(points, generator()), atol=0, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_noise_of_halves_is_that_of_float32(points, dtype):
    """The square of 300 m is beyond what float16 holds, and bfloat16 has no share of 0.001."""
    far = (points * 60).to(dtype)
    for noise in (range_noise, dropout, lambda p, g: outliers(p, g, dust=0.001)):
        exact = noise(far.float(), torch.Generator().manual_seed(0))
        halves = noise(far, torch.Generator().manual_seed(0))
        torch.testing.assert_close(halves, exact.to(dtype), equal_nan=True)
