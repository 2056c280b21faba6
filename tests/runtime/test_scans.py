"""Height scans of the C library: the same bits as `HeightScan`."""

import json
import math

import numpy as np
import pytest
import torch

import torchelev as te
from tests.helpers import pose, random_clouds
from torchelev import HeightScan
from torchelev.observations.scan.presets import PRESETS
from torchelev.observations.scan_layout import scan_layout
from torchelev.runtime.library import CMap, LibraryError

POINTS = [(0.3, 0.2), (-0.4, 0.1), (0.0, 0.0), (0.9, -0.5)]
FILLS = ["ground", "base", "lowest", "upper_bound", "inpaint", 0.25]
LAYOUTS = {
    **{f"fill {fill}": HeightScan.points(POINTS, fill=fill) for fill in FILLS},
    "original": HeightScan.points(POINTS, fill="original", original="lowest"),
    "nearest": HeightScan.points(POINTS, mode="nearest", alignment="world", scale=2.0),
    "minimum": HeightScan.points(POINTS, mode="minimum", alignment="base", clip=0.1, nominal_height=0.4),
    "standing": HeightScan.points(POINTS, fill="base", standing_height=0.7, nominal_height=0.2),
    "isaac_lab original": HeightScan.isaac_lab(fill="original"),
    "legged_gym": HeightScan.legged_gym(),
    "rings": HeightScan.feet(num_feet=2, reach=0.4),
}


@pytest.fixture(scope="module")
def maps(library):
    """A map with gaps, and the same in C."""
    cfg = te.ElevationMapConfig(grid=te.GridConfig(resolution=0.05, length_x=3.2, length_y=3.2))
    emap, found = te.ElevationMap(cfg), CMap(library, json.dumps(cfg.to_dict()))
    for k in range(3):
        T = pose((0.1 * k, 0.0, 0.8), yaw=0.4 * k)
        points = random_clouds(np.random.default_rng(k), T, 500)
        emap.update(points, T, T, 0.1)
        found.update(points.numpy(), T.numpy(), T[0].numpy(), 0.1)
    return emap, found


POSES = [pose((0.1, 0.2, 0.6), yaw=1.0, pitch=0.2, roll=-0.1), pose((-0.3, 0.1, 0.5), pitch=-1.55)]


def assert_equal(scan, c_scan, maps, feet=None):
    for T in POSES:
        values, known = scan(maps[0], T, feet)
        found, found_known = c_scan(T[0].numpy(), None if feet is None else feet[0].numpy())
        assert np.array_equal(found, values[0].numpy()) and np.array_equal(found_known, known[0].numpy())
    assert len(known[0]) == len(found)


@pytest.mark.parametrize("name", PRESETS)
def test_presets(maps, name):
    assert_equal(HeightScan.preset(name), maps[1].scan(name), maps)


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts(maps, name):
    scan = LAYOUTS[name]
    layout = scan_layout(scan)
    scan = HeightScan(**{**vars_of(scan), "pattern": layout["pattern"]})  # rounded, as a layout holds it
    feet = torch.tensor([[[0.2, 0.2, 0.1], [-0.3, 0.1, 0.0]]]) if scan.num_feet else None
    assert_equal(scan, maps[1].scan(json.dumps(layout | {"reach": scan.reach})), maps, feet)


def vars_of(scan):
    return {name: value for name, value in vars(scan).items() if name != "placement"}


def test_an_empty_map_reads_flat_ground(library):
    found = CMap(library, "{}")
    values, known = found.scan("mjlab")(np.eye(4))
    assert not known.any() and np.allclose(values, 0.1)


@pytest.mark.parametrize(
    "layout, words",
    [
        ("isaac", "layout: must be one of isaac_lab, mjlab, legged_gym, or JSON, got 'isaac'"),
        ("{}", "layout.pattern: must be one or more points"),
        ('{"pattern": [[1]]}', "layout.pattern: must be one or more points"),
        ('{"pattern": [[0, 0]], "fil": 1}', "layout.fil: must be one of pattern"),
        ('{"pattern": [[0, 0]], "channels": ["rgb"]}', "layout.channels: needs Python"),
        ('{"pattern": [[0, 0]], "fill": "inf"}', "layout.fill: must be finite without a clip"),
        ('{"pattern": [[0, 0]], "mode": "cubic"}', "layout.mode: must be one of"),
        ('{"pattern": [[0, 0]], "scale": "one"}', "layout.scale: must be a finite number"),
        ('{"pattern": [[0, 0]], "num_feet": 1.5}', "layout.num_feet: must be an int"),
        ('{"pattern": [[0, 9]]}', "pattern: must lie in the map at any heading, which takes 18.1 x 18.1 m"),
        ('{"pattern": [[0, 0]]', "cannot be read as JSON"),
    ],
)
def test_bad_layouts_are_refused(maps, layout, words):
    with pytest.raises(LibraryError) as error:
        maps[1].scan(layout)
    assert words in str(error.value)


def test_the_window_is_named_as_python_names_it(maps):
    scan = HeightScan.points([(0.0, 9.0)])
    with pytest.raises(ValueError) as python:
        scan(maps[0], POSES[0])
    with pytest.raises(LibraryError) as c:
        maps[1].scan(json.dumps(scan_layout(scan)))
    assert str(c.value) == str(python.value)


def test_bad_arguments_are_refused(library, maps):
    found = maps[1]
    around, feet = found.scan("mjlab"), found.scan(json.dumps(scan_layout(LAYOUTS["rings"]) | {"reach": 0.2}))
    for call, words in [
        (lambda: around(np.eye(4) * math.nan), "T_map_base: must be finite"),
        (lambda: around(np.eye(4), np.zeros((2, 3))), "feet: must be left out"),
        (lambda: feet(np.eye(4)), "feet: must be given"),
        (lambda: feet(np.eye(4), np.full((2, 3), np.inf)), "feet: must be finite"),
    ]:
        with pytest.raises(LibraryError, match=words):
            call()
    around._emap = CMap(library, "{}")
    with pytest.raises(LibraryError, match="map: must have the grid that the scan was created for"):
        around(np.eye(4))
