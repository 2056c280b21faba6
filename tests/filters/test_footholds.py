"""The foothold score."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.test_geometry import random_layer, terrain, whole
from torchelev.filters.distances.distance import signed_distance
from torchelev.filters.footholds import foothold_score
from torchelev.filters.geometry import slope, standard_deviation
from torchelev.filters.registry import FILTERS, Filter

LIMITS = dict(critical_slope=0.5, critical_deviation=0.04, safe_distance=0.1)


def score(s, d, e, **settings):
    layers = [whole(torch.tensor([[[value]]], dtype=torch.float64)) for value in (s, d, e)]
    return float(foothold_score(*layers, **{**LIMITS, **settings})[0])


def test_by_hand():
    assert score(0.0, 0.0, 0.1) == score(0.0, 0.0, 5.0) == pytest.approx(1)
    assert score(0.25, 0.01, 0.02) == pytest.approx((0.5 + 0.75 + 0.2) / 3)
    weights = dict(weight_slope=1, weight_deviation=1, weight_distance=2)
    assert score(0.25, 0.01, 0.02, **weights) == pytest.approx((0.5 + 0.75 + 2 * 0.2) / 4)
    assert score(0.25, 0.01, 0.02, weight_slope=0, weight_distance=0) == pytest.approx(0.75)


@pytest.mark.parametrize("place", [(0.51, 0.0, 1.0), (0.0, 0.041, 1.0), (0.0, 0.0, -0.01)])
def test_nothing_where_a_foot_must_not_stand(place):
    assert score(*place) == 0


@given(st.integers(0, 10_000))
def test_known_where_all_three_are_and_within_0_and_1(seed):
    s, d, e = (random_layer(seed + k, share=0.8) for k in range(3))
    s, d = (s[0].abs(), s[1]), (d[0].abs() * 0.2, d[1])
    result, known = foothold_score(s, d, e)
    assert torch.equal(known, s[1] & d[1] & e[1])
    assert ((result >= 0) & (result <= 1)).all() and (result > 0).any() and (result[known] == 0).any()


def test_gradients():
    s, d, e = (random_layer(k, (1, 3, 4), 1.0)[0].abs() for k in range(3))
    parts = [s.requires_grad_(), (0.1 * d).detach().requires_grad_(), (0.2 * e).detach().requires_grad_()]
    known = torch.ones(1, 3, 4, dtype=torch.bool)
    assert torch.autograd.gradcheck(lambda *p: foothold_score(*((v, known) for v in p))[0], parts)


def stairs(x, y):
    return 0.16 * torch.floor(x / 0.4)


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08])
def test_the_middle_of_a_tread_is_best(resolution):
    """Scores of stairs at 2, 4 and 8 cm: 1 in the middle of treads, 0 next to their edges."""
    layer, x, y = terrain(stairs, resolution, 3.2)
    around = dict(resolution=resolution, radius=0.08)
    edges = signed_distance(layer, resolution=resolution, step=0.1)
    result, known = foothold_score(slope(layer, **around), standard_deviation(layer, **around), edges)
    from_edge = (x / 0.4 - torch.round(x / 0.4)).abs() * 0.4
    inside = (x.abs() < 1.4) & (y.abs() < 1.4)
    assert known.all() and (result[0][inside & (from_edge > 0.13)] > 0.999).all()
    assert (result[0][inside & (from_edge < 0.05)] == 0).all()


def test_refuses():
    for name in LIMITS:
        with pytest.raises(ValueError, match=name):
            score(0.0, 0.0, 1.0, **{name: 0.0})
    with pytest.raises(ValueError, match="weights"):
        score(0.0, 0.0, 1.0, weight_slope=math.nan)


def test_it_is_a_filter_by_name():
    assert "foothold_score" in FILTERS
    Filter("foothold_score", critical_slope=0.4).try_out(3, 0.04)
