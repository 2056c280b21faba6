"""Which surface is the ground, and what hangs above it, in scenes of known shape."""

import math

import pytest
import torch

from tests.levels.walks import at, line, make_map, walk
from torchelev import LevelsConfig, SensorConfig
from torchelev.observations import VoxelCrop
from torchelev.sim.exact import covered_scenes
from torchelev.sim.exact.covered_scenes import RISE, RUN
from torchelev.sim.exact.scenes import Box, Scene, block, boxes, flat
from torchelev.sim.exact.sensors import Lidar
from torchelev.sim.poses import pose


@pytest.fixture(scope="module")
def table():
    emap, scene = make_map(), covered_scenes.table()
    walk(emap, scene, line((-1.0, 0.0, 0.0), (2.0, 0.0, 0.0), 12))
    return emap


def test_the_floor_below_a_table_is_the_ground(table):
    for x, y in ((1.6, 0.0), (2.0, 0.2), (2.4, -0.2)):
        assert at(table, "elevation", x, y) == pytest.approx(0.0, abs=0.02)
        assert at(table, "ceiling", x, y) == pytest.approx(0.74, abs=0.02)
        assert at(table, "clearance", x, y) == pytest.approx(0.74, abs=0.03)


def test_levels_are_counted_from_below(table):
    assert at(table, "elevation", 2.0, 0.0, level=0) == pytest.approx(0.0, abs=0.02)
    assert at(table, "elevation", 2.0, 0.0, level=1) == pytest.approx(0.76, abs=0.04)
    assert at(table, "underside", 2.0, 0.0, level=1) == pytest.approx(0.74, abs=0.02)
    assert math.isnan(at(table, "elevation", 2.0, 0.0, level=2))
    assert at(table, "validity", 2.0, 0.0, level=1) == 1
    assert at(table, "validity", 2.0, 0.0, level=2) == 0
    assert at(table, "time", 2.0, 0.0, level=1) < 0.5
    assert 0 < at(table, "variance", 2.0, 0.0, level=1) < 1e-3
    assert math.isnan(at(table, "underside", 2.0, 0.0, level=0))


def test_nothing_hangs_beside_the_table(table):
    assert at(table, "ceiling", 0.5, 1.5) == math.inf
    assert at(table, "clearance", 0.5, 1.5) == math.inf


def test_a_map_without_levels_takes_the_table_for_ground():
    emap = make_map(levels=LevelsConfig(max_levels=1))
    walk(emap, covered_scenes.table(), line((-1.5, 0.0, 0.0), (0.2, 0.0, 0.0), 8))
    other = make_map()
    walk(other, covered_scenes.table(), line((-1.5, 0.0, 0.0), (0.2, 0.0, 0.0), 8))
    x, y = emap.cell_centers()[0].unbind(-1)
    inner = (x > 1.35) & (x < 2.65) & (y.abs() < 0.3)
    one, several = (int((m.layer("elevation")[0][inner] > 0.6).sum()) for m in (emap, other))
    assert one > 5
    assert several == 0


def test_an_empty_map_knows_no_ceiling():
    emap = make_map()
    assert emap.layer("ceiling").isnan().all()
    assert emap.layer("clearance").isnan().all()
    assert emap.layer("elevation", level=0).isnan().all()


def test_the_road_below_a_bridge_is_the_ground_and_the_deck_its_ceiling():
    emap, deck = make_map(), 12 * RISE
    walk(emap, covered_scenes.bridge(), line((0.0, -2.5, 0.0), (0.0, 1.5, 0.0), 14))
    assert at(emap, "elevation", 0.0, 0.0) == pytest.approx(0.0, abs=0.02)
    assert at(emap, "ceiling", 0.0, 0.0) == pytest.approx(deck - 0.25, abs=0.03)


def test_the_deck_is_the_ground_of_a_robot_that_walks_up():
    emap, deck, count = make_map(), 12 * RISE, 12
    scene, start = covered_scenes.bridge(), -2.013 - count * RUN
    walk(emap, scene, line((start - 0.5, 0.0, 0.0), (start, 0.0, 0.0), 4))
    walk(emap, scene, [(start + (k + 0.5) * RUN, 0.0, (k + 1) * RISE) for k in range(count)])
    walk(emap, scene, line((-2.0, 0.0, deck), (0.0, 0.0, deck), 8))
    assert at(emap, "elevation", 0.5, 0.0) == pytest.approx(deck, abs=0.02)


def two_storeys():
    """Return a slab at 2.5 m over flat ground, with a hole at y > 1 m through which a robot cannot climb."""
    slab = Box(low=(-5.0, -5.0, 2.3), high=(5.0, 1.0, 2.5), grounded=True)
    return Scene(name="storeys", boxes=(slab,))


def test_a_robot_that_was_carried_upstairs_keeps_the_floor_below():
    emap, scene = make_map(), two_storeys()
    walk(emap, scene, line((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 5))
    assert at(emap, "elevation", 1.0, 0.0) == pytest.approx(0.0, abs=0.02)
    assert at(emap, "ceiling", 1.0, 0.0) == pytest.approx(2.3, abs=0.03)
    walk(emap, scene, line((0.0, 0.0, 2.5), (0.5, 0.0, 2.5), 5))
    assert at(emap, "elevation", 1.0, 0.0) == pytest.approx(2.5, abs=0.03)
    assert at(emap, "elevation", 1.0, 0.0, level=0) == pytest.approx(0.0, abs=0.03)
    walk(emap, scene, line((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), 5))
    assert at(emap, "elevation", 1.0, 0.0) == pytest.approx(0.0, abs=0.03)


def test_a_ceiling_that_left_is_cleared():
    emap = make_map()
    ceiling = Scene(boxes=(Box(low=(-4.0, -4.0, 1.6), high=(4.0, 4.0, 1.8), until=1.0),))
    tall = Scene(boxes=(Box(low=(-9.0, -9.0, 4.0), high=(9.0, 9.0, 4.2)),))
    walk(emap, ceiling, line((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 4))
    near = [(0.6, 0.5), (0.9, -0.6), (-0.2, -0.5)]
    assert all(at(emap, "ceiling", *place) == pytest.approx(1.6, abs=0.03) for place in near)
    walk(emap, tall, [(0.3, 0.0, 0.0)] * 12)
    assert all(at(emap, "ceiling", *place) > 3.5 for place in near)


def test_boxes_and_walls_stay_ground():
    for scene in (boxes(), Scene(boxes=(block(1.5, 1.7, -3.0, 3.0, 1.0),)), flat()):
        one, several = make_map(levels=LevelsConfig(max_levels=1)), make_map()
        for emap in (one, several):
            walk(emap, scene, line((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 8))
        elevations = one.layer("elevation"), several.layer("elevation")
        both = elevations[0].isfinite() & elevations[1].isfinite()
        assert both.sum() >= 0.99 * elevations[0].isfinite().sum()
        differs = (elevations[0] - elevations[1]).abs()[both] > 0.05
        assert differs.float().mean() < 0.01  # coarse rings leave holes in the far ends of the wall


def test_what_is_lower_than_half_the_gap_is_solid():
    low = Scene(boxes=(Box(low=(1.0, -2.0, 0.15), high=(3.0, 2.0, 0.2)),))
    emap = make_map()
    walk(emap, low, line((-1.0, 0.0, 0.0), (0.3, 0.0, 0.0), 8))
    assert not (emap.layer("clearance") < 0.2).any()  # half of the gap


@pytest.mark.parametrize(("separation", "expected"), [("gap", 0.9), ("rays", math.nan)])
def test_the_gap_alone_separates_where_it_is_asked_to(separation, expected):
    points = torch.tensor([[[1.05, 0.05, 0.0], [1.05, 0.05, 0.9]]]).repeat(1, 4, 1)
    T = torch.eye(4).expand(1, 4, 4).clone()
    T[:, 2, 3] = 0.8
    sensor = SensorConfig(exclusion=None)
    emap = make_map(levels=LevelsConfig(separation=separation), sensor=sensor)
    emap.update(points - torch.tensor([0.0, 0.0, 0.8]), T, T, dt=0.1)
    assert at(emap, "elevation", 1.05, 0.05, level=1) == pytest.approx(expected, abs=1e-3, nan_ok=True)


def test_rays_over_a_beam_do_not_make_the_space_within_free():
    emap = make_map()
    beam = Box(low=(1.0, -3.0, 0.9), high=(1.6, 3.0, 1.3))
    wall = block(2.6, 2.8, -3.0, 3.0, 3.0)
    walk(emap, Scene(boxes=(beam, wall)), line((-1.6, 0.0, 0.0), (-1.2, 0.0, 0.0), 6))
    crop = VoxelCrop(length_x=0.1, length_y=0.1, resolution=0.1, offset=(1.3, 0.0, 0.5))
    T = torch.eye(4)[None]
    states = crop(emap, T)[0, 0, 0].tolist()  # from 0.5 m below the ground to 1.5 m above it
    assert states[7:11] == [0, 0, 0, 0], "below the beam rays passed"
    assert 0 not in states[15:17], "rays over the beam say nothing of what is below them"


def test_a_ceiling_over_unseen_floor_is_no_ground():
    emap = make_map()
    hall = Scene(boxes=(Box(low=(-9.0, -9.0, 2.5), high=(9.0, 9.0, 2.7)),))
    lidar = Lidar(rings=48, azimuths=256, fov_low_deg=-15.0, fov_high_deg=80.0, max_range=12.0)
    T = pose(torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64), 0.0)
    for k in range(6):
        points = lidar.cast(hall, T)
        points = points + 0.02 * torch.randn(points.shape, generator=torch.Generator().manual_seed(k))
        emap.update(points[None].float(), T[None], dt=0.2)
    near = emap.cell_centers()[0].norm(dim=-1) < 1.5
    assert int(torch.isfinite(emap.layer("elevation", level=0)[0][near]).sum()) > 100, "the ceiling was seen"
    assert not torch.isfinite(emap.layer("elevation")[0][near]).any(), "and the floor was not"
