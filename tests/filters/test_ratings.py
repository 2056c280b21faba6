"""Three-part traversability, and the foothold score."""

import functools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.terrains import random_layer, terrain, whole
from torchelev.filters.distances.distance import signed_distance
from torchelev.filters.geometry import slope, standard_deviation
from torchelev.filters.ratings import foothold_score, traversability_three_part
from torchelev.filters.registry import FILTERS, Filter

SEEDS = st.integers(0, 10_000)


def rated(s, h, r, **settings):
    layers = [whole(torch.tensor([[[value]]])) for value in (s, h, r)]
    return float(traversability_three_part(*layers, **settings)[0])


def test_three_part_traversability_by_hand():
    limits = dict(critical_slope=0.5, critical_step=0.2, critical_roughness=0.1)
    assert rated(0.0, 0.0, 0.0, **limits) == pytest.approx(1)
    assert rated(0.25, 0.05, 0.02, **limits) == pytest.approx((0.5 + 0.75 + 0.8) / 3)
    weights = dict(weight_slope=2, weight_step=1, weight_roughness=1)
    assert rated(0.25, 0.05, 0.02, **limits, **weights) == pytest.approx((2 * 0.5 + 0.75 + 0.8) / 4)
    assert rated(0.51, 0.0, 0.0, **limits) == rated(0.0, 0.21, 0.0, **limits) == rated(0.0, 0.0, 0.11, **limits) == 0
    assert rated(0.4999, 0.0, 0.0, **limits) == pytest.approx(2 / 3, abs=1e-3)


@given(SEEDS)
def test_three_part_traversability(seed):
    """Known where all three parts are, and within 0 and 1."""
    layers = [random_layer(seed + k, share=0.8) for k in range(3)]
    layers = [(values.abs(), known) for values, known in layers]
    result, known = traversability_three_part(*layers, critical_step=0.25, critical_roughness=0.25)
    assert torch.equal(known, functools.reduce(torch.logical_and, (mask for _, mask in layers)))
    assert ((result >= 0) & (result <= 1)).all() and (result > 0).any() and (result[known] == 0).any()


def test_gradient_of_three_part_traversability():
    layers = [random_layer(k, (1, 3, 3), 1.0) for k in range(3)]
    parts = [(0.1 * values.abs()).requires_grad_() for values, _ in layers]
    known = layers[0][1]

    def rate(*parts):
        return traversability_three_part(*((p, known) for p in parts), critical_roughness=0.1)[0]

    assert torch.autograd.gradcheck(rate, parts)


@pytest.mark.parametrize(
    "settings", [{"critical_slope": 0.0}, {"critical_step": -1.0}, {"critical_roughness": math.inf}]
)
def test_refuses_critical_values(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        rated(0.0, 0.0, 0.0, **settings)


@pytest.mark.parametrize("weights", [(0, 0, 0), (-1, 1, 1), (math.nan, 1, 1), (math.inf, 1, 1)])
def test_refuses_weights(weights):
    names = ("weight_slope", "weight_step", "weight_roughness")
    with pytest.raises(ValueError, match="weights"):
        rated(0.0, 0.0, 0.0, **dict(zip(names, weights, strict=True)))


LIMITS = dict(critical_slope=0.5, critical_deviation=0.04, safe_distance=0.1)


def score(s, d, e, **settings):
    layers = [whole(torch.tensor([[[value]]], dtype=torch.float64)) for value in (s, d, e)]
    return float(foothold_score(*layers, **{**LIMITS, **settings})[0])


def test_foothold_score_by_hand():
    assert score(0.0, 0.0, 0.1) == score(0.0, 0.0, 5.0) == pytest.approx(1)
    assert score(0.25, 0.01, 0.02) == pytest.approx((0.5 + 0.75 + 0.2) / 3)
    weights = dict(weight_slope=1, weight_deviation=1, weight_distance=2)
    assert score(0.25, 0.01, 0.02, **weights) == pytest.approx((0.5 + 0.75 + 2 * 0.2) / 4)
    assert score(0.25, 0.01, 0.02, weight_slope=0, weight_distance=0) == pytest.approx(0.75)


@pytest.mark.parametrize("place", [(0.51, 0.0, 1.0), (0.0, 0.041, 1.0), (0.0, 0.0, -0.01)])
def test_no_score_where_a_foot_must_not_stand(place):
    assert score(*place) == 0


@given(st.integers(0, 10_000))
def test_score_is_known_where_all_three_are_and_within_0_and_1(seed):
    s, d, e = (random_layer(seed + k, share=0.8) for k in range(3))
    s, d = (s[0].abs(), s[1]), (d[0].abs() * 0.2, d[1])
    result, known = foothold_score(s, d, e)
    assert torch.equal(known, s[1] & d[1] & e[1])
    assert ((result >= 0) & (result <= 1)).all() and (result > 0).any() and (result[known] == 0).any()


def test_gradients_of_the_score():
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


def test_foothold_score_refuses():
    for name in LIMITS:
        with pytest.raises(ValueError, match=name):
            score(0.0, 0.0, 1.0, **{name: 0.0})
    with pytest.raises(ValueError, match="weights"):
        score(0.0, 0.0, 1.0, weight_slope=math.nan)


def test_foothold_score_is_a_filter_by_name():
    assert "foothold_score" in FILTERS
    Filter("foothold_score", critical_slope=0.4).try_out(3, 0.04)
