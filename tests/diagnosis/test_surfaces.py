"""A hillside that the exclusion ramp cuts off is named with the setting that cures it; vegetation blames no pose."""

import re

import numpy as np
import pytest
import torch

from torchelev import ElevationMap, ElevationMapConfig, ExclusionConfig, GridConfig, SensorConfig

GRID = GridConfig(resolution=0.1, length_x=8, length_y=8)


def climb(degrees, **exclusion):
    """A robot that walks up a hill, its sensor 0.5 m above the ground."""
    rng, slope = np.random.default_rng(0), np.tan(np.radians(degrees))
    emap = ElevationMap(ElevationMapConfig(grid=GRID, sensor=SensorConfig(exclusion=ExclusionConfig(**exclusion))))
    for k in range(12):
        T = np.eye(4)
        angle = np.radians(degrees)
        T[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        T[:3, 3] = 0.05 * k, 0.0, slope * 0.05 * k + 0.5
        xy = rng.uniform(-4, 4, (6000, 2)) + [0.05 * k, 0]
        own = (np.column_stack([xy, slope * xy[:, 0]]) - T[:3, 3]) @ T[:3, :3]
        at = torch.from_numpy(T)[None]
        emap.update(torch.from_numpy(own.astype(np.float32))[None], at, at, dt=0.1)
    return emap


@pytest.mark.slow(1)
@pytest.mark.parametrize("degrees", [30, 35])
def test_a_hillside_that_is_cut_off_is_named_with_its_cure(degrees):
    (sentence,) = climb(degrees).diagnose()
    assert f"rises at {degrees} deg, above the exclusion ramp" in sentence
    slope, height = map(float, re.findall(r"exclusion.slope to ([\d.]+) .*exclusion.height to ([\d.]+) m", sentence)[0])
    cured = climb(degrees, slope=slope, height=height)
    assert cured.diagnose() == [] and int(cured.statistics.rejected_overhang) == 0


def test_a_gentle_hill_is_passed_over():
    assert climb(15).diagnose() == []


@pytest.mark.slow(1)
def test_vegetation_blames_no_pose():
    """Blades up to 0.3 m high: heights differ within one scan."""
    emap, rng = ElevationMap(ElevationMapConfig(grid=GRID)), np.random.default_rng(0)
    for k in range(20):
        xy = rng.uniform(-3, 3, (6000, 2))
        points = np.column_stack([xy, rng.uniform(0, 0.3, 6000) - 0.6])
        T = torch.eye(4, dtype=torch.float64)[None].clone()
        T[0, 0, 3] = 0.1 * k
        emap.update(torch.from_numpy(points.astype(np.float32))[None], T, T, dt=0.1)
    assert [text for text in emap.diagnose() if text.startswith("poses")] == []
