"""Filters by name: what `register` wraps around a function, and the module with settings."""

import inspect

import pytest
import torch

from tests.filters import registered
from tests.filters.registered import CALLS
from torchelev.filters import FILTERS, Filter, as_layer, register
from torchelev.filters.registry import MAX_CPU_CELLS


@pytest.fixture
def registered_for_now():
    """What the test registers is forgotten after it."""
    before = dict(FILTERS)
    yield
    FILTERS.clear()
    FILTERS.update(before)


def parameters_of(name):
    return inspect.signature(FILTERS[name]).parameters.values()


def test_a_filter_gets_and_gives_zero_where_nothing_is_known():
    values = torch.tensor([[[1.0, torch.nan]]])
    known = torch.tensor([[[True, False]]])
    out, still = FILTERS["counted_offset"]((values, known), by=2.0)
    assert out.tolist() == [[[3.0, 0.0]]] and torch.equal(still, known)


def test_what_is_not_finite_is_unknown():
    values, known = FILTERS["logarithm"](as_layer(torch.tensor([[[0.0, 1.0, -1.0]]])))
    assert values.tolist() == [[[0.0, 0.0, 0.0]]] and known.tolist() == [[[False, True, False]]]
    marked = torch.tensor([[[5.0, torch.nan, 5.0]]]), torch.ones(1, 1, 3, dtype=torch.bool)
    values, known = FILTERS["box"](marked, resolution=0.1, radius=0.1)
    assert values.tolist() == [[[5.0, 0.0, 5.0]]] and known.tolist() == [[[True, False, True]]]


SINGLE = sorted(
    name
    for name in FILTERS
    if sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters_of(name)) == 1 and name != "in_cells"
)


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(name, dtype):
    values = torch.rand(2, 9, 8, generator=torch.Generator().manual_seed(1)).to(dtype)
    values[0, 2:5, 3:5] = torch.nan
    step = Filter(name)
    half, known = step(as_layer(values), resolution=0.05)
    full, expected = step(as_layer(values.float()), resolution=0.05)
    assert half.dtype == dtype and torch.equal(known, expected)
    torch.testing.assert_close(half, full.to(dtype))


@pytest.mark.parametrize("name", SINGLE)
def test_no_map_at_all(name):
    values, known = Filter(name)(as_layer(torch.zeros(0, 3, 5)), resolution=0.05)
    assert values.shape == known.shape == (0, 3, 5)


def test_many_maps_are_filtered_in_parts():
    width = MAX_CPU_CELLS // 2
    values, known = as_layer(torch.arange(7.0)[:, None, None].expand(7, 1, width))
    calls = len(CALLS)
    parts = FILTERS["counted_offset"]((values, known))
    assert len(CALLS) - calls == 4, "two maps at a time"
    assert torch.equal(parts[0], values + 1) and torch.equal(parts[1], known)
    assert FILTERS["counted_offset"](as_layer(torch.zeros(0, 3, 5)))[0].shape == (0, 3, 5)


def test_gradients_pass_a_filter_and_stop_where_nothing_is_known():
    values = torch.tensor([[[1.0, torch.nan]]], requires_grad=True)
    out, _ = FILTERS["counted_offset"]((values, torch.tensor([[[True, False]]])))
    out.sum().backward()
    assert values.grad.tolist() == [[[1.0, 0.0]]]


def test_a_module_gives_the_resolution_to_those_that_ask():
    layer = as_layer(torch.zeros(1, 2, 2))
    assert Filter("in_cells", length=1.0)(layer, resolution=0.25)[0].unique().tolist() == [4.0]
    assert Filter("counted_offset", by=3.0)(layer, resolution=0.25)[0].unique().tolist() == [3.0]
    assert repr(Filter("counted_offset", by=3.0)) == "Filter(counted_offset, by=3.0)"


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: Filter("no_such"), "filter: must be a filter's name, got 'no_such'; there are .*counted_offset"),
        (lambda: Filter("counted_offset", to=1.0), "filter counted_offset: must be given settings .*to; it takes by"),
        (lambda: Filter("in_cells"), "filter in_cells: needs length"),
        (lambda: Filter("difference").try_out(1, 0.1), "filter difference: takes 2 layers, got 1 inputs"),
        (lambda: FILTERS["difference"]((torch.zeros(1, 2, 2), torch.ones(1, 2, 2))), "known must be bool"),
        (lambda: FILTERS["difference"](), "expected one or more layers of one shape"),
        (lambda: FILTERS["difference"](as_layer(torch.zeros(1, 2, 2)), as_layer(torch.zeros(1, 3, 2))), "of one shape"),
        (lambda: FILTERS["difference"](as_layer(torch.zeros(2, 2))), r"expected values \(B, H, W\)"),
    ],
)
def test_what_does_not_fit_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_name_is_registered_once(registered_for_now):
    def difference(a):
        return a

    with pytest.raises(ValueError, match="must have a name of its own, got 'difference'"):
        register(difference)
    difference.__qualname__, difference.__module__ = "difference", registered.__name__
    register(difference)  # a function defined again, as in a notebook, replaces itself


def test_a_setting_must_not_be_named_as_a_key():
    def keyed(a, *, inputs: int = 1):
        return a

    with pytest.raises(ValueError, match="keyed: must have no setting named layer, filter, inputs, got inputs"):
        register(keyed)


def test_what_a_filter_returns_is_checked(registered_for_now):
    wrong = {
        "alone": lambda layer: layer[0],
        "nothing": lambda layer: None,
        "numpy_pair": lambda layer: (layer[0].numpy(), layer[1].numpy()),
        "float_mask": lambda layer: (layer[0], layer[0]),
        "cropped": lambda layer: (layer[0][:, 1:], layer[1][:, 1:]),
    }
    for name, function in wrong.items():
        function.__name__ = name
        with pytest.raises((TypeError, ValueError), match=f"filter {name}"):
            register(function)(as_layer(torch.zeros(1, 3, 3)))
