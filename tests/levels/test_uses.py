"""What reads levels: observations, planning, files and the command line."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch

from tests.levels.walks import GRID, at, line, look, make_map, walk
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, LevelsConfig, MapImage, SensorConfig
from torchelev.io.export import load_map, load_npz, save_map, save_npz, take
from torchelev.io.grid_map import from_grid_map, to_grid_map
from torchelev.observations import VoxelCrop
from torchelev.observations.scan_layout import scan_layout
from torchelev.planning.footprint import FootprintConfig, check_footprint
from torchelev.planning.limits import Limit
from torchelev.planning.path_check import check_path
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost
from torchelev.runtime.bundle.groups import require_heights
from torchelev.sim.exact import covered_scenes
from torchelev.sim.exact.scenes import Box, Scene, block
from torchelev.viz.live.snapshot import take_snapshot
from torchelev.viz.live.surface import ceiling_sheet

TABLE = covered_scenes.table(0.6)


@pytest.fixture(scope="module")
def under():
    """Return a map, and the pose of a robot that stands below a table of 0.6 m."""
    emap = make_map()
    walk(emap, TABLE, line((-0.5, 0.0, 0.0), (2.0, 0.0, 0.0), 10))
    return emap, look(TABLE, 2.0, 0.0)[2]


def test_a_scan_reads_the_ceiling_above_the_base(under):
    values, valid = HeightScan.points([(0.0, 0.0), (0.3, 0.2)], surface="ceiling")(*under)
    assert valid.all()
    torch.testing.assert_close(values, torch.full_like(values, 0.6 - 0.45), rtol=0, atol=0.02)


def test_a_scan_of_open_sky_reads_no_ceiling(under):
    emap, T_map_base = under
    scan = HeightScan.points([(-1.8, 0.0), (0.0, 0.0)], surface="ceiling", no_ceiling=1.5, scale=2.0)
    values, valid = scan(emap, T_map_base)
    assert values[0, 0] == 3.0
    assert valid[0, 0]
    blank = make_map()
    values, valid = scan(blank, T_map_base)
    assert (values == 3.0).all()
    assert not valid.any()


def test_a_scan_of_the_ceiling_needs_levels(under):
    plain = ElevationMap(ElevationMapConfig(grid=GRID))
    with pytest.raises(ValueError, match="surface: needs a map with levels.*LevelsConfig"):
        HeightScan.grid(surface="ceiling")(plain, under[1])
    with pytest.raises(ValueError, match="must be one of ground, ceiling"):
        HeightScan.grid(surface="sky")


def test_an_image_shows_the_clearance(under):
    image = MapImage(length_x=3.0, length_y=1.0, resolution=0.1, layers=("elevation", "clearance"), max_clearance=1.2)
    pixels = image(*under)
    assert pixels.shape == (1, 2, 30, 10)
    assert pixels[0, 1, 15, 5] == pytest.approx(0.6, abs=0.03)
    assert pixels[0, 1].max() == pytest.approx(1.2)


def test_voxels_between_floor_and_table(under):
    crop = VoxelCrop(length_x=0.4, length_y=0.4, length_z=1.0, resolution=0.1, offset=(0.0, 0.0, -0.05))
    voxels = crop(*under)
    assert voxels.shape == (1, *crop.shape) == (1, 4, 4, 10)
    assert voxels.dtype == torch.uint8
    # The crop spans -0.1 to 0.9 m: a voxel of ground, six of air, the table top, and what nobody saw above it.
    assert voxels[0, 2, 2].tolist() == [1, 0, 0, 0, 0, 0, 0, 1, 2, 2] or voxels[0, 2, 2].tolist()[:7] == [
        *(1, 0, 0, 0, 0, 0, 1)
    ]


@pytest.mark.parametrize("alignment", ["yaw", "world"])
def test_voxels_by_tensors_and_in_cpp_are_equal(under, alignment):
    emap, T_map_base = under
    T_map_base = look(TABLE, 2.03, -0.11, yaw=0.7)[2]
    crop = VoxelCrop(resolution=0.05, length_z=1.5, offset=(0.2, -0.1, 0.13), alignment=alignment)
    own, given = crop(emap, T_map_base), crop(emap, T_map_base, state=emap.state)
    assert torch.equal(own, given)
    assert len(own.unique()) == 3


def test_voxels_turn_with_the_robot(under):
    emap, _ = under
    crop = VoxelCrop(length_x=1.6, length_y=1.6, length_z=0.8, resolution=0.1)
    ahead, turned = (crop(emap, look(TABLE, 2.0, 0.0, yaw=yaw)[2]) for yaw in (0.0, math.pi / 2))
    same = ahead.flip(2).transpose(1, 2) == turned
    assert same.float().mean() > 0.9


def test_distances_to_what_is_occupied(under):
    states, distances = (
        VoxelCrop(length_x=0.8, length_y=0.8, length_z=1.0, resolution=0.1, values=values, max_distance=0.3)(*under)
        for values in ("states", "distances")
    )
    assert distances.dtype == torch.float32
    assert ((distances < 0) == (states == 1)).all()
    assert distances.abs().max() == pytest.approx(0.3)
    expected = brute_force(states[0] == 1, 0.1).clamp(-0.3, 0.3)
    torch.testing.assert_close(distances[0], expected, rtol=0, atol=1e-5)


def brute_force(occupied, step):
    places = torch.stack(torch.meshgrid(*(torch.arange(n) for n in occupied.shape), indexing="ij"), -1).flatten(0, 2)
    mask = occupied.flatten()
    away = torch.cdist(places.float(), places.float())
    to_occupied, to_other = (away[:, m].amin(1) for m in (mask, ~mask))
    return (torch.where(mask, -to_other, to_occupied) * step).view(occupied.shape)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"resolution": 0.07}, "length_x"),
        ({"values": "colours"}, "states, distances"),
        ({"alignment": "base"}, "yaw or world"),
        ({"offset": (0.0, 0.0)}, "three finite numbers"),
        ({"max_distance": 0.0}, "max_distance"),
    ],
)
def test_bad_crops_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        VoxelCrop(**settings)


def test_voxels_need_levels_and_a_window(under):
    plain = ElevationMap(ElevationMapConfig(grid=GRID))
    with pytest.raises(ValueError, match="must be maps with levels"):
        VoxelCrop()(plain, under[1])
    with pytest.raises(ValueError, match="must lie in the map"):
        VoxelCrop(length_x=9.0)(*under)


def test_a_robot_of_half_a_metre_fits_under_a_table_of_60_cm_and_a_taller_one_does_not(under):
    emap, _ = under
    square = torch.tensor([[[[1.8, -0.2], [2.2, -0.2], [2.2, 0.2], [1.8, 0.2]]]])
    low, tall = (check_footprint(emap, square, FootprintConfig(height=h)) for h in (0.5, 0.7))
    assert low.safe.all()
    assert not tall.safe.any()
    assert (low.limit.item(), tall.limit.item()) == (Limit.NONE, Limit.CEILING)
    assert tall.ceiling.item() == pytest.approx(0.6, abs=0.03)
    poses = torch.tensor([[[1.6, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    (sentence,) = check_path(
        emap, poses, square[0, 0] - torch.tensor([2.0, 0.0]), FootprintConfig(height=0.7)
    ).explain()
    assert re.search(r"what hangs 0\.(59|60) m above the ground is lower than the robot's 0\.70 m", sentence)
    for height, passes in ((0.5, True), (0.7, False)):
        cost = traversal_cost(emap, TraversalCostConfig(height=height))
        x, y = emap.cell_centers()[0].unbind(-1)
        inner = ((x - 2.0).abs() < 0.4) & (y.abs() < 0.2)
        assert torch.isfinite(cost[0][inner]).all() == passes


def test_a_plan_that_fails_below_a_ceiling_says_so():
    emap = make_map()
    walls = (block(-4.0, 5.0, y, y + 0.3, 1.2) for y in (-1.3, 1.0))
    low = Scene(boxes=(Box(low=(1.0, -1.0, 0.6), high=(1.6, 1.0, 0.7)), *walls))
    walk(emap, low, line((-1.0, 0.0, 0.0), (1.3, 0.0, 0.0), 12))
    start, goal = torch.tensor([[0.0, 0.0]]), torch.tensor([[2.4, 0.0]])
    assert plan(emap, start, goal, TraversalCostConfig(height=0.5)).reached.all()
    assert not plan(emap, start, goal, TraversalCostConfig(height=0.8)).reached.any()
    path = plan(emap, start, torch.tensor([[1.3, 0.0]]), TraversalCostConfig(height=0.8))
    assert "lower than the robot is high" in path.explain()[0]


def test_a_height_needs_levels():
    plain = ElevationMap(ElevationMapConfig(grid=GRID))
    with pytest.raises(ValueError, match="needs a map with levels"):
        traversal_cost(plain, TraversalCostConfig(height=0.5))
    square = torch.tensor([[[[0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]]]])
    with pytest.raises(ValueError, match="needs a map with levels"):
        check_footprint(plain, square, FootprintConfig(height=0.5))
    assert torch.isinf(check_footprint(plain, square).ceiling).all()
    with pytest.raises(ValueError, match="height"):
        FootprintConfig(height=-1.0)


def test_a_saved_map_keeps_its_levels(under, tmp_path):
    emap, _ = under
    save_map(tmp_path / "map.safetensors", emap)
    loaded = load_map(tmp_path / "map.safetensors")
    assert torch.equal(loaded.layer("ceiling").nan_to_num(-1), emap.layer("ceiling").nan_to_num(-1))
    save_npz(tmp_path / "map.npz", emap)
    assert load_npz(tmp_path / "map.npz").layers["clearance"].shape == (60, 60)
    again = load_map(tmp_path / "map.npz")
    assert at(again, "ceiling", 2.0, 0.0) == pytest.approx(0.6, abs=0.02)


def test_a_grid_map_has_ground_and_ceiling(under):
    emap, _ = under
    layers = from_grid_map(to_grid_map(emap, layers=("elevation", "ceiling"))).layers
    assert not np.isinf(layers["ceiling"]).any()
    assert np.nanmin(layers["ceiling"]) == pytest.approx(0.6, abs=0.1)


def test_the_live_view_draws_ceilings(under):
    emap, T_map_base = under
    snapshot = take_snapshot(emap, T_map_base)
    assert "ceiling" in snapshot.parts
    vertices, triangles = ceiling_sheet(snapshot.map, np.zeros(3))
    assert len(triangles) > 20
    assert np.isfinite(vertices).all()
    plain = take_snapshot(ElevationMap(ElevationMapConfig(grid=GRID)), T_map_base)
    assert "ceiling" not in plain.parts
    assert not len(ceiling_sheet(plain.map, np.zeros(3))[1])


def test_one_of_several_maps_can_be_taken(under):
    emap = make_map(2)
    points, *poses = look(TABLE, 1.0, 0.0)
    emap.update(points.repeat(2, 1, 1), *(pose.repeat(2, 1, 1) for pose in poses), dt=0.1)
    assert set(take(emap, 1).layers) == set(emap.layers)
    with pytest.raises(ValueError, match="must be of all 2 maps"):
        emap.layer("ceiling", state=type(emap.state)(*(v[:1] for v in emap.state[:-1]), emap.state.statistics))


def test_what_the_robot_carries_is_no_ceiling():
    from torchelev import BodyConfig

    emap = make_map(sensor=SensorConfig(body=BodyConfig(lower=(-0.5, -0.5, -0.5), upper=(0.5, 0.5, 2.0))))
    walk(emap, Scene(boxes=(Box(low=(-0.2, -0.2, 1.0), high=(0.2, 0.2, 1.1)),)), [(0.0, 0.0, 0.0)] * 3)
    assert not emap.levels.support.any()


def test_settings_reach_the_map():
    levels = LevelsConfig(max_levels=5, min_gap=1.0)
    cfg = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=2.0, length_y=2.0), levels=levels)
    emap = ElevationMap(cfg)
    assert emap.levels.lower.shape == (1, 4, 20, 20)
    assert dataclasses.replace(cfg, levels=None).levels is None


def test_bundles_refuse_what_the_c_library_lacks():
    scan = HeightScan.grid(surface="ceiling")
    with pytest.raises(ValueError, match="no ceilings"):
        require_heights({"above": scan})
    require_heights({"above": MapImage(layers=("clearance",))})
    assert "surface" in scan_layout(scan)
    assert "surface" not in scan_layout(HeightScan.grid())


@pytest.mark.parametrize("height", [None, 0.2])
def test_a_space_between_half_and_all_of_the_gap_is_told_and_too_low(height):
    emap = make_map(levels=LevelsConfig(min_gap=0.4))
    ones = torch.ones_like(emap.elevation)
    state = emap.state._replace(
        validity=ones > 0, rated=ones > 0, has_normal=ones > 0, traversability=ones, support=10 * ones
    )
    levels = emap.levels.in_windows(state)
    support = torch.zeros_like(levels.support)
    support[:, 0, 28:32, 28:32] = 10.0
    emap.load_state(state, levels._replace(lower=levels.lower + 0.3, upper=levels.upper + 0.3, support=support))
    assert at(emap, "clearance", 0.05, 0.05) == pytest.approx(0.3)
    cost = traversal_cost(emap, TraversalCostConfig(height=height))
    assert torch.isinf(cost[0, 28:32, 28:32]).all()
    assert torch.isfinite(cost).sum() == cost.numel() - 16
    square = torch.tensor([[[[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]]])
    assert check_footprint(emap, square, FootprintConfig(height=height)).limit.item() == Limit.CEILING
