"""Settings of scans: values, and what is refused."""

import copy
import dataclasses
import math
import pickle

import pytest
import torch

from tests.helpers import pose
from tests.observations.maps import BASE, flat, ground_map
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage


def test_scans_are_values():
    scan = HeightScan.isaac_lab()
    scan(ground_map(flat), pose(BASE))
    assert scan == HeightScan.isaac_lab() == pickle.loads(pickle.dumps(scan)) == copy.deepcopy(scan)
    assert dataclasses.replace(scan, fill="base") == HeightScan.isaac_lab(fill="base") != scan
    with pytest.raises(dataclasses.FrozenInstanceError):
        scan.fill = "base"


GOOD = dict(xy=[(0.0, 0.1)])


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: HeightScan.preset("isaac"), "preset: must be one of isaac_lab, mjlab, legged_gym, got 'isaac'; use"),
        (lambda: HeightScan.points(**GOOD, alignment="body"), "alignment: must be one of yaw, base, world, got 'body'"),
        (lambda: HeightScan.points(**GOOD, mode="linear"), "mode: must be one of bilinear, nearest, minimum, got"),
        (lambda: HeightScan.points(**GOOD, fill="zero"), "fill: must be a number or one of ground, base, lowest"),
        (lambda: HeightScan.points(**GOOD, fill=None), "fill: must be a number or one of ground, base, lowest"),
        (lambda: HeightScan.points(**GOOD, fill=math.inf), "fill: must be finite without a clip, got inf"),
        (lambda: HeightScan.points(**GOOD, fill=math.nan, clip=1.0), "fill: must be finite"),
        (lambda: HeightScan.points(**GOOD, original="original"), "original: must be a number or one of ground, base"),
        (lambda: HeightScan.points(**GOOD, standing_height=math.nan), "standing_height: must be a finite number"),
        (lambda: HeightScan.points(**GOOD, clip=0.0), "clip: must be a positive number, got 0.0"),
        (lambda: HeightScan.points(**GOOD, noise=-0.1), "noise: must be a finite number of at least 0, got -0.1"),
        (lambda: HeightScan.points(**GOOD, scale=math.nan), "scale: must be a finite number, got nan"),
        (lambda: HeightScan.points(**GOOD, inpaint_rings=1.5), "inpaint_rings: must be an int of at least 0"),
        (lambda: HeightScan.points([]), "pattern: must be one or more points"),
        (lambda: HeightScan.points(torch.zeros(4, 3)), "pattern: must be one or more points"),
        (lambda: HeightScan.points([(0.0, math.nan)]), "pattern: must be finite"),
        (lambda: HeightScan.feet(num_feet=0), "num_feet: must be positive"),
        (lambda: HeightScan.feet(rings=[]), "pattern: must be one or more points"),
        (lambda: HeightScan.grid(resolution=0.3), "length_x: must be a whole number of times 0.3 m, got 5.33333"),
        (lambda: HeightScan.isaac_lab(resolution=0.0), "resolution: must be a positive number"),
        (lambda: MapImage(layers=("elevation", "height")), "layers: must be some of elevation, validity"),
        (lambda: MapImage(layers=()), "layers: must be some of"),
        (lambda: MapImage(length_y=0.13), "length_y: must be a whole number of times 0.05 m"),
        (lambda: MapImage(mode="cubic"), "mode: must be one of"),
        (lambda: MapImage(alignment="map"), "alignment: must be one of"),
    ],
)
def test_bad_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
