"""Filters give what OpenCV and SciPy give, and their times are tabulated."""

import numpy as np
import pytest

from benchmarks.speed.postprocessing import __main__ as postprocessing


@pytest.mark.parametrize("name", [name for name, case in postprocessing.cases().items() if case.same])
def test_filters_give_what_opencv_and_scipy_give(name):
    ours, peer, _ = postprocessing.cases()[name]
    layer = postprocessing.ground(2, 40)
    values, known = ours(layer)
    expected = np.stack([peer(*arrays) for arrays in zip(layer[0].numpy(), layer[1].numpy(), strict=True)])
    assert bool(known.any())
    np.testing.assert_allclose(
        values[known], expected[known.numpy()], atol=2e-3 if name == "standard_deviation" else 1e-4
    )


@pytest.mark.slow(1)
def test_postprocessing_is_measured_and_tabulated():
    sizes = (1, 20), (2, 16)
    rows = postprocessing.measure(0.0, sizes)
    text = postprocessing.table(rows, sizes)
    assert all(f"| {name} |" in text for name in postprocessing.cases())
