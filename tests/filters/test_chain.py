"""Filters by name, chains of them, and the layers that a map makes with them."""

import copy
import dataclasses
import inspect

import numpy as np
import pytest
import torch

from tests.helpers import mapped, scan, small_config
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.errors import require_positive
from torchelev.filters import FILTERS, Filter, FilterChain, FilterConfig, as_layer, as_nan, register, registry
from torchelev.filters.registry import radius_cells

CALLS = []


def parameters_of(name):
    return inspect.signature(FILTERS[name]).parameters.values()


@register
def counted_offset(layer, *, by: float = 1.0):
    CALLS.append(by)
    return layer[0] + by, layer[1]


@register
def difference(a, b):
    return a[0] - b[0], a[1] & b[1]


@register
def in_cells(layer, *, resolution, length: float):
    require_positive(length=length)
    return torch.full_like(layer[0], length / resolution), layer[1]


def step(layer, filter, inputs=(), **settings):
    return FilterConfig(layer=layer, filter=filter, inputs=inputs, settings=settings)


def filtered(*filters, num_envs=2):
    cfg = dataclasses.replace(small_config(), filters=filters)
    emap = ElevationMap(cfg, num_envs)
    cloud, T = scan(0, num_envs)
    emap.update(cloud, T, T, 0.3)
    return emap


def test_a_filter_gets_and_gives_zero_where_nothing_is_known():
    values = torch.tensor([[[1.0, torch.nan]]])
    known = torch.tensor([[[True, False]]])
    out, still = FILTERS["counted_offset"]((values, known), by=2.0)
    assert out.tolist() == [[[3.0, 0.0]]] and torch.equal(still, known)


@register
def logarithm(layer):
    return layer[0].log(), layer[1]


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


def test_many_maps_are_filtered_in_parts(monkeypatch):
    layer = as_layer(torch.randn(7, 3, 5, generator=torch.Generator().manual_seed(0)))
    whole = FILTERS["counted_offset"](layer)
    calls = len(CALLS)
    monkeypatch.setattr(registry, "CPU_CELLS", 31)
    parts = FILTERS["counted_offset"](layer)
    assert len(CALLS) - calls == 4, "two maps of 15 cells at a time"
    assert torch.equal(whole[0], parts[0]) and torch.equal(whole[1], parts[1])
    assert FILTERS["counted_offset"](as_layer(torch.zeros(0, 3, 5)))[0].shape == (0, 3, 5)


def test_layers_from_and_to_values_with_nan():
    values = torch.tensor([[[1.0, torch.nan, torch.inf]]])
    layer = as_layer(values)
    assert layer[0].tolist() == [[[1.0, 0.0, 0.0]]] and layer[1].tolist() == [[[True, False, False]]]
    torch.testing.assert_close(as_nan(layer), torch.tensor([[[1.0, torch.nan, torch.nan]]]), equal_nan=True)


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


def test_windows_in_cells():
    assert [radius_cells(0.1, r) for r in (0.02, 0.04, 0.08, 0.5)] == [5, 2, 1, 1]
    with pytest.raises(ValueError, match="radius: must be a positive number"):
        radius_cells(0.0, 0.1)


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


def test_a_name_is_registered_once(monkeypatch):
    monkeypatch.setattr("torchelev.filters.registry.FILTERS", dict(FILTERS))

    def difference(a):
        return a

    with pytest.raises(ValueError, match="must have a name of its own, got 'difference'"):
        register(difference)
    difference.__qualname__ = "difference"
    register(difference)  # a function defined again, as in a notebook, replaces itself


def test_a_setting_must_not_be_named_as_a_key():
    def keyed(a, *, inputs: int = 1):
        return a

    with pytest.raises(ValueError, match="keyed: must have no setting named layer, filter, inputs, got inputs"):
        register(keyed)


def test_a_formula_names_its_inputs():
    formula = "elevation - variance"
    assert step("a", "expression", formula=formula).inputs == ("elevation", "variance")
    assert step("a", "expression", ("elevation", "variance"), formula=formula).inputs == ("elevation", "variance")
    with pytest.raises(ValueError, match="filters.a: reads elevation, variance, got .*slope.*leave inputs out"):
        step("a", "expression", "slope", formula=formula)
    with pytest.raises(TypeError, match="filters.layer: must be a name, got 1"):
        step(1, "expression")


def test_a_chain_makes_its_layers_in_order():
    chain = FilterChain([step("b", "counted_offset", by=2.0), step("c", "difference", ("b", "elevation"))], 0.1)
    layer = torch.ones(1, 2, 2), torch.tensor([[[True, False], [True, True]]])
    made = chain({"elevation": layer})
    assert list(made) == ["b", "c"]
    assert made["b"][0].tolist() == [[[3.0, 0.0], [3.0, 3.0]]] and made["c"][0].tolist() == [[[2.0, 0.0], [2.0, 2.0]]]


@pytest.mark.parametrize(
    "filters, message",
    [
        ([step("b", "counted_offset", "c"), step("c", "counted_offset")], "filters.b: must read layers that are made"),
        (
            [step("b", "counted_offset", "b")],
            "filters.b: must read layers that are made before it, got b; there are ele",
        ),
        ([step("elevation", "counted_offset")], "filters.elevation: must be a name of its own"),
        ([step("b c", "counted_offset")], "filters.b c: must be a name of its own, of letters"),
        ([step("b", "counted_offset"), step("b", "counted_offset")], "filters.b: must be a name of its own"),
        ([step("b", "nothing")], "filters.b: filter: must be a filter's name"),
        ([step("b", "difference")], "filter difference: takes 2 layers"),
        ([step("b", "in_cells", length="far")], "length"),
    ],
)
def test_a_chain_that_cannot_run_is_refused_when_built(filters, message):
    with pytest.raises((ValueError, TypeError), match=message):
        FilterChain(filters, 0.1)


def test_a_chain_from_yaml():
    yaml = pytest.importorskip("yaml")
    text = """
        filters:
          - {layer: raised, filter: counted_offset, by: 0.5}
          - {layer: gap, filter: difference, inputs: [raised, elevation]}
          - {layer: again, filter: counted_offset, inputs: raised}
        grid: {resolution: 0.1, length_x: 1.0, length_y: 1.0}
    """
    cfg = ElevationMapConfig.from_dict(yaml.safe_load(text))
    assert [f.inputs for f in cfg.filters] == [("elevation",), ("raised", "elevation"), ("raised",)]
    assert cfg.filters[0].settings == (("by", 0.5),)
    assert ElevationMapConfig.from_dict(cfg.to_dict()) == cfg and hash(cfg) == hash(copy.deepcopy(cfg))
    assert ElevationMapConfig.from_dict(yaml.safe_load(yaml.safe_dump(cfg.to_dict()))) == cfg


@pytest.mark.parametrize(
    "values, message",
    [
        ({"filters": {"a": "gaussian"}}, "config.filters: must be a list, got dict"),
        ({"filters": ["gaussian"]}, r"config.filters\[0\]: must name its layer and its filter, got 'gaussian'"),
        ({"filters": [{"layer": "a"}]}, r"config.filters\[0\]: must name its layer and its filter"),
        ({"filter": {}}, "config.filter: is not a setting.*filters"),
    ],
)
def test_filters_that_yaml_gets_wrong(values, message):
    with pytest.raises(ValueError, match=message):
        ElevationMapConfig.from_dict(values)


def test_filters_of_a_config_are_checked():
    with pytest.raises(TypeError, match="cfg.filters: must be a tuple of FilterConfig"):
        ElevationMapConfig(filters=["gaussian"])
    assert ElevationMapConfig(filters=[step("b", "counted_offset")]).filters == (step("b", "counted_offset"),)


def test_settings_of_numpy_and_lists_become_plain():
    cfg = step("b", "counted_offset", by=np.float32(0.5), more=[1, 2])
    assert dict(cfg.settings) == {"by": 0.5, "more": (1, 2)} and type(dict(cfg.settings)["by"]) is float


def test_what_a_filter_returns_is_checked(monkeypatch):
    monkeypatch.setattr(registry, "FILTERS", dict(FILTERS))
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


def test_a_tensor_is_no_layer():
    with pytest.raises(TypeError, match="gaussian, layer 0: must be a layer .*got Tensor; make one .*as_layer"):
        FILTERS["gaussian"](torch.zeros(2, 3, 3), resolution=0.1)


def test_a_map_reads_the_layers_of_its_filters():
    emap = filtered(step("b", "counted_offset", by=2.0), step("c", "difference", ("b", "elevation")))
    assert emap.layers[-2:] == ("b", "c")
    elevation, raised = emap.layer("elevation"), emap.layer("b")
    torch.testing.assert_close(raised, elevation + 2.0, equal_nan=True)
    assert bool(elevation.isnan().any()) and bool(elevation.isfinite().any())
    known = emap.layer("c")
    torch.testing.assert_close(known, torch.where(elevation.isnan(), torch.nan, 2.0), equal_nan=True)
    xy = emap.cell_centers().flatten(1, 2)
    values, valid = emap.sample(xy, "b", "nearest")
    torch.testing.assert_close(values[valid], raised.flatten(1)[valid])
    with pytest.raises(KeyError, match="there are elevation.*b, c"):
        emap.layer("d")


def test_a_filter_runs_once_until_something_is_stored():
    emap = filtered(step("b", "counted_offset", by=7.0), step("c", "difference", ("b", "elevation")))
    before = CALLS.count(7.0)

    def runs():
        emap.layer("c"), emap.layer("b"), emap.sample(torch.zeros(2, 1, 2), "b")
        return CALLS.count(7.0) - before

    assert (runs(), runs()) == (1, 1)
    first = emap.layer("b")
    first.zero_()
    assert bool(emap.layer("b").nan_to_num().any()), "a fresh tensor"
    cloud, T = scan(1, 2)
    emap.update(cloud, T, T, 0.3)
    assert runs() == 2
    emap.reset(mask=torch.tensor([True, False]))
    assert runs() == 3 and bool(emap.layer("b")[0].isnan().all())
    emap.reset(torch.tensor([1]))
    assert runs() == 4
    emap.initialize(torch.zeros(2, 3, 3), "nearest")
    assert runs() == 5 and bool(emap.layer("b").isfinite().all())
    emap.load_state_dict(emap.state_dict())
    assert runs() == 6
    emap.double()
    assert runs() == 7 and emap.layer("b").dtype == torch.float64


def test_a_layer_made_in_inference_mode_can_be_read_outside():
    emap = filtered(step("b", "counted_offset"))
    with torch.inference_mode():
        emap.layer("b")
    assert not emap.read_layer("b")[0].is_inference()
    xy = torch.zeros(2, 1, 2, requires_grad=True)
    emap.sample(xy, "b")[0].sum().backward()
    assert xy.grad.isfinite().all()


def test_a_state_is_filtered_as_given_with_gradients():
    emap = filtered(step("b", "counted_offset"))
    elevation = emap.elevation.clone().requires_grad_()
    emap.layer("b", state=emap.state._replace(elevation=elevation)).nansum().backward()
    assert torch.equal(elevation.grad, emap.validity.float())
    emap.layer("b")
    other = emap.state._replace(elevation=emap.elevation + 1)
    torch.testing.assert_close(emap.layer("b", state=other), emap.layer("b") + 1, equal_nan=True)


def test_other_filters_load_the_same_state():
    emap, other = filtered(step("b", "counted_offset")), mapped(2)
    other.load_state_dict(emap.state_dict())
    assert torch.equal(other.elevation, emap.elevation)


def test_a_copy_has_its_own_layers():
    emap = filtered(step("b", "counted_offset"))
    emap.layer("b")
    twin = copy.deepcopy(emap)
    emap.reset()
    assert bool(emap.layer("b").isnan().all()) and bool(twin.layer("b").isfinite().any())
