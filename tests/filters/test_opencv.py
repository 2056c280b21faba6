"""What OpenCV does on a CPU is what tensor operations do elsewhere."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.filter_cases import SEEDS, SHARES, assert_batch_is_single, no_opencv, random_layer
from torchelev import filters
from torchelev.filters import opencv
from torchelev.filters.layer_tools import zero_unknown

SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 12), st.integers(1, 11))
SERVED = {
    "gaussian": dict(sigma=0.15),
    "box": dict(radius=0.2),
    "dilation": dict(radius=0.2),
    "erosion": dict(radius=0.2),
    "opening": dict(radius=0.1),
    "closing": dict(radius=0.1),
    "step_height": dict(radius=0.2),
    "standard_deviation": dict(radius=0.2),
    "signed_distance": dict(step=0.5),
    "signed_distance of obstacles": dict(step=0.5, below=-0.3, above=0.9),
    "signed_distance, unknown left out": dict(step=0.5, unknown=False),
    "signed_distance of obstacles alone": dict(step=None, below=-0.3, unknown=False),
    "signed_distance, bounded": dict(step=0.5, above=0.9, max_distance=0.2),
    "inpaint_minimum": {},
}


def filtered(name, layer):
    return filters.Filter(name.split()[0].strip(","), **SERVED[name])(layer, resolution=0.1)


def by_tensors(name, layer):
    with no_opencv():
        return filtered(name, layer)


@pytest.mark.parametrize("name", SERVED)
@given(SEEDS, SHAPES, SHARES, st.sampled_from([0.0, 300.0]))
def test_the_same_as_tensor_operations(name, seed, shape, share, altitude):
    values, known = random_layer(seed, shape, share, torch.float32)
    layer = values + altitude, known
    assert opencv.is_usable(layer[0])
    got, expected = filtered(name, layer), by_tensors(name, layer)
    assert torch.equal(got[1], expected[1])
    torch.testing.assert_close(got[0], expected[0], atol=2e-6 if altitude == 0 else 1e-4, rtol=1e-5)


@pytest.mark.parametrize("name", SERVED)
def test_maps_below_one_another_do_not_touch(name):
    layer = random_layer(1, (5, 9, 8), 0.8, torch.float32)
    assert_batch_is_single(lambda layer: filtered(name, layer), layer)


@pytest.mark.parametrize("name", SERVED)
def test_slices_are_filtered_as_copies(name):
    """Of maps that lie otherwise in memory."""
    values, known = random_layer(2, (2, 9, 8), 0.8, torch.float32)
    whole = filtered(name, (values.mT.contiguous(), known.mT.contiguous()))
    turned = filtered(name, (values.mT, known.mT))
    assert torch.equal(whole[0], turned[0]) and torch.equal(whole[1], turned[1])


def test_the_arguments_stay_as_they_are():
    values, known = torch.full((1, 5, 5), 2.0), torch.ones(1, 5, 5, dtype=torch.bool)
    values[0, 2, 2] = np.inf
    for name in SERVED:
        smooth, there = filtered(name, (values, known))
        filled = name == "inpaint_minimum"
        assert known.all() and values[0, 2, 2] == np.inf and there[0, 2, 2] == filled and there.sum() == 24 + filled
        assert smooth.isfinite().all()


def test_results_are_no_views_of_the_arguments():
    """Of a map whose cells are all finite, which needs no mask of its own."""
    values, known = random_layer(4, (1, 6, 5), 0.8, torch.float32)
    for name in SERVED:
        smooth, there = filtered(name, (values, known))
        memory = {part.data_ptr() for part in (values, known, smooth, there)}
        assert len(memory) == 4


NOT_FINITE = [[np.nan], [np.inf], [-np.inf], [np.inf, -np.inf], [-np.inf, np.nan, np.inf]]


@pytest.mark.parametrize("bad", NOT_FINITE)
@pytest.mark.parametrize("B", [1, 3])
def test_known_heights_that_are_not_finite_count_as_unknown(bad, B):
    values, known = random_layer(5, (B, 7, 6), 0.8, torch.float32)
    known[-1, 2, 1 : 1 + len(bad)] = True
    values[-1, 2, 1 : 1 + len(bad)] = torch.tensor(bad)
    kept, there = opencv.zero_unknown(values, known)
    assert torch.equal(there, known & values.isfinite()) and not there[-1, 2, 1]
    assert torch.equal(kept, torch.where(there, values, 0.0))


def test_heights_whose_sum_float32_does_not_hold_stay_known():
    values, known = torch.full((1, 9, 8), 3e38), torch.ones(1, 9, 8, dtype=torch.bool)
    kept, there = opencv.zero_unknown(values, known)
    assert there.all() and torch.equal(kept, values)


@pytest.mark.parametrize("name", SERVED)
@pytest.mark.parametrize("B", [1, 3])
@pytest.mark.filterwarnings("error")
def test_far_within_the_unknown_nothing_divides_by_zero(name, B):
    values, known = random_layer(6, (B, 30, 28), 1.0, torch.float32)
    known[:, 4:, 3:] = False
    smooth, there = filtered(name, (values + 300, known))
    assert smooth.isfinite().all() and (smooth[~there] == 0).all()
    assert there.all() if name == "inpaint_minimum" else torch.equal(there, known)


@pytest.mark.parametrize("shape", [(0, 4, 4), (1, 0, 4), (1, 4, 0)])
def test_serves_no_empty_images(shape):
    assert not opencv.is_usable(torch.zeros(shape))
    kept, there = zero_unknown((torch.zeros(shape), torch.zeros(shape, dtype=torch.bool)))
    assert kept.shape == there.shape == shape


def test_serves_plain_float32_on_a_cpu_without_gradient():
    values = torch.zeros(1, 3, 3)
    assert opencv.is_usable(values)
    assert not opencv.is_usable(values.double()) and not opencv.is_usable(values.to("meta"))
    learns = values.clone().requires_grad_()
    assert not opencv.is_usable(learns)
    with torch.no_grad():
        assert opencv.is_usable(learns)
        smooth, _ = filtered("gaussian", (learns, torch.ones(1, 3, 3, dtype=torch.bool)))
    assert not smooth.requires_grad


@pytest.mark.skipif(torch.__version__ < "2.10", reason="older torch cannot map a view of bytes over a batch")
def test_serves_no_tensors_of_functorch():
    values, known = random_layer(3, (2, 7, 6), 0.8, torch.float32)
    values = values.nan_to_num()
    for function in (filters.gaussian, filters.signed_distance):
        each = torch.func.vmap(lambda v, k, f=function: f((v[None], k[None]), resolution=0.1)[0][0])(values, known)
        torch.testing.assert_close(each, function((values, known), resolution=0.1)[0])


def test_an_opencv_that_does_not_load_counts_as_none():
    with no_opencv():
        assert not opencv.is_usable(torch.zeros(1, 3, 3))
    assert opencv.is_usable(torch.zeros(1, 3, 3))
