"""Two maps are compared: which cells they know, and their heights."""

import copy

import pytest

from benchmarks.gpu import agreement


def test_gpu_comparison():
    first = agreement.driven("cpu", compiled=False, robots=1, updates=2)
    assert set(agreement.compare(first, first).values()) == {0.0}
    other = copy.deepcopy(first)
    other.elevation += 0.5
    other.validity[:, 0] = ~other.validity[:, 0]
    result = agreement.compare(first, other)
    assert result["median_difference_m"] == pytest.approx(0.5)
    assert result["cells_known_by_one_alone"] == pytest.approx(1 / 64)
