"""Filters by name, chains of them, and the layers that a map makes with them."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from tests.filters.registered import CALLS
from tests.helpers import mapped, scan, small_config
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.filters import FilterChain, FilterConfig


def step(layer, filter, inputs=(), **settings):
    return FilterConfig(layer=layer, filter=filter, inputs=inputs, settings=settings)


def filtered(*filters, num_envs=2):
    cfg = dataclasses.replace(small_config(), filters=filters)
    emap = ElevationMap(cfg, num_envs)
    cloud, T = scan(0, num_envs)
    emap.update(cloud, T, T, 0.3)
    return emap


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
