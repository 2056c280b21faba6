"""Layers of filters in C: those of Python, and its sentences for what is refused."""

import dataclasses
import json
import threading

import numpy as np
import pytest
import torch

import torchelev as te
from tests.helpers import pose
from tests.runtime.test_maps import GRID, instants, numpy, update
from torchelev.runtime.library import CMap, LibraryError

FILTERS = {
    "gaussian": {"filter": "gaussian"},
    "wide": {"filter": "gaussian", "sigma": 0.4},
    "narrow": {"filter": "gaussian", "sigma": 0.01},
    "none": {"filter": "gaussian", "sigma": 1e-170},
    "box_as_is": {"filter": "box"},
    "median_as_is": {"filter": "median"},
    "diffusion_as_is": {"filter": "inpaint_diffusion"},
    "box": {"filter": "box", "radius": 0.15, "inputs": "variance"},
    "median": {"filter": "median", "radius": 0.1},
    "minimum": {"filter": "inpaint_minimum"},
    "minimum_near": {"filter": "inpaint_minimum", "iterations": 3},
    "nearest": {"filter": "inpaint_nearest"},
    "diffusion": {"filter": "inpaint_diffusion", "tolerance": 1e-4},
    "from_bound": {"filter": "fill_from", "inputs": ["elevation", "upper_bound"]},
    "smoothed": {"filter": "gaussian", "inputs": ["nearest"]},
    "of_mask": {"filter": "box", "inputs": ["validity"]},
}
ENTRIES = [{"layer": name, **entry} for name, entry in FILTERS.items()]
CFG = te.ElevationMapConfig.from_dict({"grid": dataclasses.asdict(GRID), "filters": ENTRIES})


LARGE = {"resolution": 0.1, "radius": 1e9}
TOLERANCES = {"diffusion": 5e-4, "diffusion_as_is": 5e-3}  # [m]


def both(library, scans):
    emap, found = te.ElevationMap(CFG), CMap(library, json.dumps(CFG.to_dict()))
    for scan in scans:
        update(emap, *scan)
        found.update(*numpy(*scan))
    return emap, found


def sparse(seed, number):
    """A scan of few points far from each other, which leaves holes of all sizes."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (1, number, 3)) * [1, 1, 0.2]
    points[..., 0] = np.where(points[..., 1] > 0.5, np.nan, points[..., 0])  # a hole up to the rim
    T = pose((0.0, 0.0, 0.0)).double()
    return torch.from_numpy(points).float(), T, T[0], 0.1


@pytest.fixture(scope="module", params=["walk", "sparse", "few", "none"])
def filtered(library, request):
    scans = {
        "walk": list(instants(1, 5)),
        "sparse": [sparse(0, 3000)],
        "few": [sparse(1, 6)],
        "none": [(torch.full((1, 5, 3), torch.nan), *sparse(0, 1)[1:])],
    }
    return both(library, scans[request.param])


@pytest.mark.parametrize("name", FILTERS)
def test_layers_of_filters_are_those_of_python(filtered, name):
    emap, found = filtered
    wanted, mine = emap.layer(name)[0].numpy(), found.layer(name)
    assert np.array_equal(np.isfinite(wanted), np.isfinite(mine))
    np.testing.assert_allclose(mine, wanted, atol=TOLERANCES.get(name, 2e-6))
    xy = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 2))
    values, known = emap.sample(torch.from_numpy(xy)[None], name)
    mine, mine_known = found.sample(name, xy)
    assert np.array_equal(mine_known, known[0].numpy())
    np.testing.assert_allclose(mine, values[0].numpy(), atol=TOLERANCES.get(name, 2e-6))


def test_they_follow_the_map(library):
    emap, found = both(library, list(instants(1, 2)))
    before = found.layer("gaussian")
    for scan in list(instants(1, 4))[2:]:
        update(emap, *scan)
        found.update(*numpy(*scan))
    assert not np.array_equal(before, found.layer("gaussian"), equal_nan=True)
    np.testing.assert_allclose(found.layer("gaussian"), emap.layer("gaussian")[0].numpy(), atol=1e-6)
    found.reset()
    assert np.isnan(found.layer("gaussian")).all() and np.isnan(found.layer("nearest")).all()


def test_saved_maps_have_them_again(library, tmp_path):
    _, found = both(library, list(instants(1, 2)))
    found.save(tmp_path / "map.safetensors")
    other = CMap(library, json.dumps(CFG.to_dict()))
    assert np.isnan(other.layer("box")).all()
    other.load(tmp_path / "map.safetensors")
    assert np.array_equal(other.layer("box"), found.layer("box"), equal_nan=True)


def test_threads_read_the_same(library):
    _, found = both(library, [sparse(0, 3000)])
    wanted = {name: found.layer(name) for name in FILTERS}
    _, found = both(library, [sparse(0, 3000)])
    layers: list[dict] = [{} for _ in range(4)]

    def read(k):
        layers[k].update({name: found.layer(name) for name in FILTERS})

    threads = [threading.Thread(target=read, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for layer in layers:
        assert all(np.array_equal(layer[name], wanted[name], equal_nan=True) for name in FILTERS)


BAD = [
    {"filter": "gaussian", "sigmaa": 1},
    {"filter": "gaussian", "sigma": -1.0},
    {"filter": "gaussian", "sigma": "a"},
    {"filter": "gaussian", "sigma": 1e9},
    {"filter": "box", "radius": 0},
    {"filter": "inpaint_minimum", "iterations": 0},
    {"filter": "inpaint_minimum", "iterations": 1.5},
    {"filter": "inpaint_diffusion", "tolerance": 0},
    {"filter": "inpaint_nearest", "radius": 1.0},
    {"filter": "fill_from"},
    {"filter": "gaussian", "inputs": "foo"},
    {"filter": "gaussian", "inputs": ["elevation", "variance"]},
    {"filter": "gaussian", "inputs": ["elevation", "variance"], "sigma": -1},
    {"filter": "gausian"},
    {"filter": "gaussian", "layer": "elevation"},
    {"filter": "gaussian", "layer": "a b"},
]


@pytest.mark.parametrize("entry", BAD, ids=json.dumps)
def test_bad_filters_are_refused_in_pythons_words(library, entry):
    values = {"filters": [{"layer": "smooth", **entry}]}
    with pytest.raises((ValueError, TypeError)) as python:
        te.ElevationMap(te.ElevationMapConfig.from_dict(values))
    with pytest.raises(LibraryError) as c:
        CMap(library, json.dumps(values))
    # Other tests may have registered filters of their own, which Python lists too.
    assert str(c.value).partition("; there are")[0] == str(python.value).partition("; there are")[0]


@pytest.mark.parametrize("name", ["inpaint_telea", "expression", "slope"])
def test_other_filters_are_refused_by_name(library, name):
    with pytest.raises(LibraryError, match=f"filters.layer: filter: needs Python.* got '{name}'") as error:
        CMap(library, json.dumps({"filters": [{"layer": "layer", "filter": name}]}))
    assert error.value.status == 3


@pytest.mark.parametrize("filters", [{}, 3, [1], [{"layer": "a"}]])
def test_what_is_no_list_of_filters_is_refused(library, filters):
    with pytest.raises(LibraryError, match="write one as"):
        CMap(library, json.dumps({"filters": filters}))


def test_filters_of_python_have_a_largest_radius():
    layer = torch.zeros(1, 4, 4), torch.ones(1, 4, 4, dtype=torch.bool)
    for words, call in {
        "^radius: must be at most 100 m, a window of 1000 cells, got": lambda: te.filters.box(layer, **LARGE),
        "^sigma: must be at most 33.3333 m, a window of 1000 cells, got": lambda: te.filters.gaussian(
            layer, resolution=0.1, sigma=100.0
        ),
        "^dilation_radius: must be at most 100 m": lambda: te.filters.virtual_floor(
            layer, resolution=0.1, dilation_radius=1e4
        ),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
