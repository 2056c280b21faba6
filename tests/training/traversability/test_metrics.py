"""Metrics of traversability against hand-worked values and slow loops."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.traversability.metrics import (
    RatedMap,
    calibration_error,
    edge_length,
    inflation,
    intersection_over_union,
    measure,
    threshold_at_safe_recall,
    threshold_at_unsafe_recall,
)

SEEDS = st.integers(0, 10_000)


def random_map(seed, shape=(12, 9), resolution=0.1, steps=6):
    """A map with many equal scores."""
    rng = np.random.default_rng(seed)
    score, label = (rng.integers(0, steps, shape) / (steps - 1) for _ in range(2))
    return RatedMap(score, label, rng.random(shape) < 0.8, resolution)


def test_the_threshold_at_95_percent_recall_of_safe_keeps_19_of_20():
    score = np.arange(1, 21) / 20
    assert threshold_at_safe_recall(score) == 0.1
    assert threshold_at_safe_recall(np.array([0.3])) == 0.3


def test_the_threshold_at_95_percent_recall_of_unsafe_leaves_19_of_20_below_it():
    score = (np.arange(1, 21) / 20).astype(np.float32)
    threshold = threshold_at_unsafe_recall(score)
    assert (score < threshold).sum() == 19 and threshold == pytest.approx(0.95)


@given(SEEDS, st.sampled_from([0.5, 0.9, 0.95, 1.0]))
def test_thresholds_are_the_tightest_of_all(seed, recall):
    rng = np.random.default_rng(seed)
    score = rng.integers(0, 8, rng.integers(1, 40)) / 8
    kept = [t for t in np.unique(score) if (score >= t).mean() >= recall - 1e-9]
    assert threshold_at_safe_recall(score, recall) == max(kept)
    left = [t for t in np.unique(score) if (score <= t).mean() >= recall - 1e-9]
    found = threshold_at_unsafe_recall(score, recall)
    assert found == np.nextafter(min(left), np.inf)


def test_calibration_error_by_hand():
    score, label = np.array([0.1, 0.1, 0.9, 0.9, 0.94, 1.0]), np.array([0.0, 0.2, 1.0, 1.0, 1.0, 0.64])
    # 0.1, 0.1: right on average. 0.9, 0.9: two too low by 0.1. 0.94, 1.0: the last bin, 0.3 too high together.
    assert calibration_error(score, label) == pytest.approx((2 * 0.1 + 0.3) / 6)
    assert calibration_error(score[:0], label[:0]) is None


@given(SEEDS)
def test_calibration_error_equals_a_loop_over_bins(seed):
    rng = np.random.default_rng(seed)
    score, label = rng.random(50), rng.random(50)
    total = 0.0
    for k in range(15):
        here = [n for n in range(50) if k / 15 <= score[n] < (k + 1) / 15]
        if here:
            total += len(here) / 50 * abs(np.mean(score[here]) - np.mean(label[here]))
    assert calibration_error(score, label) == pytest.approx(total)


def pairs_won(safe, unsafe):
    return np.mean([1.0 if a > b else 0.5 if a == b else 0.0 for a in safe for b in unsafe])


def precision_recall_steps(score, positive):
    """Sum of precision times what recall gains, from the highest threshold down."""
    total, before = 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        found = score >= threshold
        precision, recall = positive[found].mean(), positive[found].sum() / positive.sum()
        total, before = total + precision * (recall - before), recall
    return total


@given(SEEDS)
def test_measure_equals_loops(seed):
    m = random_map(seed)
    score, safe = m.score[m.rated], m.label[m.rated] >= 0.5
    found = measure([m])
    assert found["cells"] == m.rated.sum() and found["safe_share"] == pytest.approx(safe.mean())
    assert found["roc_auc"] == pytest.approx(pairs_won(score[safe], score[~safe]))
    assert found["average_precision"] == pytest.approx(precision_recall_steps(score, safe))
    assert found["average_precision_unsafe"] == pytest.approx(precision_recall_steps(-score, ~safe))
    accept = max(t for t in set(score) if (score[safe] >= t).mean() >= 0.95)
    assert found["false_safe"] == pytest.approx((score[~safe] >= accept).mean())
    both, either = (np.sum(f(score >= 0.5, safe)) for f in (np.logical_and, np.logical_or))
    assert found["iou"] == pytest.approx(both / either)


def test_a_perfect_score_is_perfect():
    m = random_map(1)
    found = measure([m._replace(score=m.label)])
    assert found["average_precision"] == found["roc_auc"] == found["iou"] == pytest.approx(1.0)
    assert found["false_safe"] == found["calibration_error"] == found["inflation_cm"] == 0.0
    assert found["inflation_at_recall_cm"] == 0.0


def test_ground_of_one_sort_has_no_ranking():
    m = random_map(1)
    for label in (np.ones_like(m.label), np.zeros_like(m.label)):
        found = measure([m._replace(label=label)])
        assert found["roc_auc"] is found["average_precision"] is found["inflation_cm"] is None
        assert found["calibration_error"] is not None
    nothing = measure([m._replace(rated=np.zeros_like(m.rated))])
    assert nothing["cells"] == 0 and nothing["iou"] is nothing["calibration_error"] is None


@pytest.mark.parametrize("name", ["score", "label"])
@pytest.mark.parametrize("bad", [np.nan, 1.1, -0.1])
def test_what_is_no_share_is_refused(name, bad):
    m = random_map(1)
    with pytest.raises(ValueError, match=f"{name}: must lie within 0 to 1"):
        measure([m._replace(**{name: np.full_like(m.score, bad)})])


def half_unsafe(width=20):
    """Ten rows of 10 cm; the first five columns are unsafe."""
    label = np.ones((10, width))
    label[:, :5] = 0
    return RatedMap(label.copy(), label, np.ones_like(label, bool), 0.1)


def test_inflation_by_hand():
    m = half_unsafe()
    m.score[:, 5] = 0.4  # one column too much: 0.1 m^2 along an edge of 1 m, which counts pi / 4
    assert edge_length(m) == pytest.approx(math.pi / 4)
    assert inflation([m], 0.5) == pytest.approx(10 * 4 / math.pi)
    assert inflation([m], 0.4) == 0.0
    m.score[:, 11] = 0.0  # 0.7 m away
    assert inflation([m], 0.5) == pytest.approx(10 * 4 / math.pi)
    m.rated[:, 5] = False
    assert inflation([m], 0.5) is None, "no edge lies between rated cells"
    assert inflation([], 0.5) is None


@given(SEEDS)
def test_inflation_equals_loops(seed):
    m = random_map(seed)
    unsafe = m.rated & (m.label < 0.5)
    area, sides = 0, 0
    H, W = m.score.shape
    cells = [(i, j) for i in range(H) for j in range(W) if m.rated[i, j]]
    for i, j in cells:
        if not unsafe[i, j] and m.score[i, j] < 0.5:
            area += any(unsafe[k, n] and math.hypot(i - k, j - n) <= 5 + 1e-9 for k, n in cells)
        for k, n in ((i + 1, j), (i, j + 1)):
            sides += (k, n) in cells and unsafe[i, j] != unsafe[k, n]
    assert inflation([m], 0.5) == pytest.approx(100 * area * 0.01 / (math.pi / 4 * sides * 0.1))


def test_the_edge_of_a_disc_is_its_circumference():
    x = np.arange(-50, 50) + 0.5
    label = (np.hypot(x[:, None], x) < 40).astype(float)
    m = RatedMap(label, label, np.ones_like(label, bool), 0.01)
    assert edge_length(m) == pytest.approx(2 * math.pi * 0.4, rel=0.01)


def test_intersection_over_nothing_is_none():
    nothing = np.zeros(3, bool)
    assert intersection_over_union(nothing, nothing) is None
