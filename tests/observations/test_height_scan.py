"""What a policy reads: presets by hand-worked numbers, patterns, alignment, fills, images."""

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests import reference
from tests.helpers import pose, random_state, rotation, small_map
from torchelev import ElevationMap, checks
from torchelev.layers import LAYERS
from torchelev.observations.fill import FILLS, MODES, inpaint
from torchelev.observations.height_scan import PRESETS, HeightScan
from torchelev.observations.map_image import CHANNELS, MapImage
from torchelev.observations.patterns import ALIGNMENTS, heading, steps

SEEDS = st.integers(0, 10_000)
BASE = (0.3, -0.2, 0.7)
CORNER = (-12, -17)  # the window's, 30 x 30 cells of 0.1 m, around the base
ONE = HeightScan.points([(0.0, 0.0)])  # right below the base


def ground_map(height, num_envs=1, corner=CORNER, cells=(30, 30), dtype=torch.float64, **layers):
    """A map of 0.1 m cells that knows `height(x, y)` [m] everywhere, with its corner at these cell numbers."""
    emap = small_map(num_envs, cells, dtype=dtype)
    emap.corner.copy_(torch.tensor(corner))
    x, y = emap.cell_centers().unbind(-1)
    emap.elevation.copy_(height(x, y))
    for mask in (emap.validity, emap.has_normal, emap.rated):
        mask.fill_(True)
    for name, value in layers.items():
        getattr(emap, name).copy_(value)
    return emap


def plane(x, y):
    """Rises to the front and more to the left."""
    return 0.1 * x + 0.2 * y


def flat(x, y):
    return torch.zeros_like(x)


def near(*values):
    return pytest.approx(values, abs=1e-9)


def at(values, *index):
    return tuple(float(values[0, i]) for i in index)


# The presets, worked out by hand: the base at (0.3, -0.2, 0.7) looks along +y, so that the pattern's point (x, y) lies
# at (0.3 - y, -0.2 + x). Ground 0.1 x + 0.2 y:
#   (-0.8, -0.5) -> (0.8, -1.0): -0.12    (-0.7, -0.5) -> (0.8, -0.9): -0.10
#   (-0.8, -0.4) -> (0.7, -1.0): -0.13    ( 0.8,  0.5) -> (-0.2, 0.6):  0.10


def test_isaac_lab_on_a_tilted_plane():
    scan = HeightScan.isaac_lab()
    values, valid = scan(ground_map(plane), pose(BASE, yaw=math.pi / 2))
    assert scan.num_points == 187 and values.shape == valid.shape == (1, 187) and valid.all()
    assert at(values, 0, 1, 17, 186) == near(0.7 + 0.12 - 0.5, 0.30, 0.33, 0.10)


def test_mjlab_on_a_tilted_plane():
    values, _ = HeightScan.mjlab()(ground_map(plane), pose(BASE, yaw=math.pi / 2))
    assert at(values, 0, 1, 17, 186) == near((0.7 + 0.12) / 5, 0.160, 0.166, 0.120)


def test_legged_gym_on_a_tilted_plane():
    emap, T = ground_map(plane), pose(BASE, yaw=math.pi / 2)
    values, _ = HeightScan.legged_gym(mode="bilinear")(emap, T)
    assert at(values, 0, 1, 11, 186) == near(5 * (0.7 + 0.12 - 0.5), 1.65, 1.50, 0.50)
    # The lowest cell around (0.8, -1.0) has its centre at (0.75, -1.05): 0.075 - 0.21 = -0.135.
    assert at(HeightScan.legged_gym()(emap, T)[0], 0) == near(5 * (0.7 + 0.135 - 0.5))


@pytest.mark.parametrize(
    "height, lowest", [(lambda x, y: -0.1 * x, -0.085), (lambda x, y: -0.1 * y, 0.095), (lambda x, y: 0 * x, 0.0)]
)
def test_minimum_looks_one_cell_ahead(height, lowest):
    """At (0.8, -1.0) the cells' centres are 0.75 and 0.85, -1.05 and -0.95."""
    scan = HeightScan.points([(0.5, -0.8)], mode="minimum", alignment="world")
    assert at(scan(ground_map(height), pose(BASE))[0], 0) == near(0.7 - lowest)


def test_minimum_leaves_out_the_fourth_cell_and_unknown_ones():
    emap = ground_map(flat)
    scan = HeightScan.points([(0.5, -0.8)], mode="minimum", alignment="world")
    i, j = 19, 6  # the cell with its centre at (0.75, -1.05)
    emap.elevation[0, i + 1, j + 1] = -9.0
    emap.elevation[0, i, j], emap.elevation[0, i + 1, j], emap.elevation[0, i, j + 1] = 0.3, 0.2, 0.1
    assert at(scan(emap, pose(BASE))[0], 0) == near(0.6)
    emap.validity[0, i, j + 1] = False
    assert at(scan(emap, pose(BASE))[0], 0) == near(0.5)
    emap.validity[0, i : i + 2, j] = False
    values, valid = scan(emap, pose(BASE))
    assert not valid.any() and at(dataclasses.replace(scan, fill="base")(emap, pose(BASE))[0], 0) == near(0.0)


def test_legged_gym_is_isaac_lab_transposed():
    rng = np.random.default_rng(0)
    emap = ground_map(lambda x, y: torch.from_numpy(rng.uniform(-0.3, 0.3, x.shape)))
    T = pose(BASE, yaw=0.7, pitch=0.2, roll=-0.1)
    isaac, legged = HeightScan.isaac_lab()(emap, T)[0], HeightScan.legged_gym(mode="bilinear")(emap, T)[0]
    torch.testing.assert_close(legged.view(17, 11).T / 5, isaac.view(11, 17))
    assert (isaac.view(11, 17)[0] - isaac.view(11, 17)[1]).abs().min() > 1e-6


def test_grids_end_as_the_originals_do():
    """Isaac Lab: all steps up to the border. mjlab: up to half a step beyond it."""
    for resolution, isaac, mjlab in ((0.04, 28, 29), (0.08, 14, 15), (0.1, 12, 12)):
        size = dict(length_x=1.1, length_y=1.1, resolution=resolution)
        assert HeightScan.isaac_lab(**size).num_points == isaac**2
        assert HeightScan.mjlab(**size).num_points == mjlab**2
    assert steps(1.1, 0.04, 1e-9)[-1] == pytest.approx(0.53)
    assert steps(1.1, 0.04, 0.02)[-1] == pytest.approx(0.57)
    other = HeightScan.mjlab(length_x=0.4, length_y=0.2, resolution=0.2).pattern
    assert np.allclose(other, [(-0.2, -0.1), (0.0, -0.1), (0.2, -0.1), (-0.2, 0.1), (0.0, 0.1), (0.2, 0.1)])


@given(st.integers(1, 300), st.sampled_from([0.02, 0.03, 0.04, 0.05, 0.07, 0.08, 0.1, 0.15, 0.25]))
def test_steps_are_those_of_arange(centimetres, resolution):
    length = centimetres / 100
    isaac = torch.arange(start=-length / 2, end=length / 2 + 1.0e-9, step=resolution)
    mjlab = torch.arange(-length / 2, length / 2 + resolution * 0.5, resolution, dtype=torch.float32)
    for beyond, theirs in ((1e-9, isaac), (resolution * 0.5, mjlab)):
        mine = steps(length, resolution, beyond)
        assert len(mine) == len(theirs) and np.allclose(mine, theirs, atol=1e-6)


def test_presets_clip_before_or_after_the_scale():
    """Base 3 m over the ground: Isaac Lab clips 2.5 to 1, mjlab has no clip, legged_gym clips, then scales."""
    emap, T = ground_map(flat), pose((0.3, -0.2, 3.0))
    assert [float(HeightScan.preset(name)(emap, T)[0][0, 5]) for name in PRESETS] == [1.0, pytest.approx(0.6), 5.0]
    T = pose((0.3, -0.2, -3.0))
    assert [float(HeightScan.preset(name)(emap, T)[0][0, 5]) for name in PRESETS] == [-1.0, pytest.approx(-0.6), -5.0]


def test_presets_can_read_what_their_originals_read_of_a_miss():
    """Isaac Lab clips -inf to -1, mjlab reads 5 m / 5; legged_gym never misses, so flat ground."""
    emap = ground_map(flat, validity=False)
    for name, miss in zip(PRESETS, (-1.0, 1.0, 0.0), strict=True):
        values, valid = HeightScan.preset(name, fill="original")(emap, pose(BASE))
        assert (values == miss).all() and not valid.any()


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("standing", [None, 0.3, 0.8])
def test_an_empty_map_reads_as_flat_ground_under_a_standing_robot(name, standing):
    settings = {} if standing is None else dict(standing_height=standing)
    height = 0.5 if standing is None else standing
    scan, T = HeightScan.preset(name, **settings), pose((0.3, -0.2, height))
    values, valid = scan(ground_map(flat, validity=False), T)
    torch.testing.assert_close(values, scan(ground_map(flat), T)[0])
    assert not valid.any() and values[0, 0] == values[0, 5]
    # Higher up nothing says where the ground is: as of a robot that stands.
    torch.testing.assert_close(scan(ground_map(flat, validity=False), pose((0.3, -0.2, 7.0)))[0], values)


@pytest.mark.parametrize("scan", [*(HeightScan.preset(name) for name in PRESETS), HeightScan.grid()])
@pytest.mark.parametrize("altitude", [0.0, -300.0])
def test_flat_ground_continues_over_all_that_is_unknown(scan, altitude):
    """Only ground 0.5 m ahead is known, at any height: all of the pattern reads as there, the blind spot too."""
    emap = ground_map(lambda x, y: torch.full_like(x, altitude))
    expected = scan(emap, pose((0.3, -0.2, altitude + 0.62)))[0]
    emap.validity[:, :20] = emap.validity[:, 22:] = False
    values, valid = scan(emap, pose((0.3, -0.2, altitude + 0.62)))
    assert 0 < valid.sum() < 60
    torch.testing.assert_close(values, expected, atol=1e-9, rtol=0)


def test_far_from_what_is_known_the_ground_is_that_under_the_base():
    """Ground at 0 around the base, a step of 0.4 m far ahead; behind, it is as under the base and not a mean of all."""
    emap = ground_map(lambda x, y: 0.4 * (x > 0.9).double(), corner=(-97, -97), cells=(200, 200))
    emap.validity[:, :95] = False
    values, valid = HeightScan.points([(-6.0, 0.0), (-0.6, 0.0), (3.0, 0.0)], alignment="world")(emap, pose(BASE))
    assert valid.tolist() == [[False, False, True]] and at(values, 0, 1, 2) == near(0.7, 0.7, 0.3)


def test_what_lies_above_the_base_is_not_the_ground_under_it():
    """All that is known is a wall, higher than the base, 0.5 m away."""
    emap = ground_map(lambda x, y: torch.full_like(x, 1.5))
    emap.validity[:, :20] = emap.validity[:, 21:] = False
    values, valid = HeightScan.isaac_lab(alignment="world", standing_height=0.6)(emap, pose((0.3, -0.2, 0.7)))
    behind = values.view(11, 17)[:, 0]
    torch.testing.assert_close(behind, torch.full_like(behind, 0.1))


def test_noise_comes_where_the_originals_have_it():
    """Draws of 0 and 1 are -0.1 and +0.1 m."""
    low, high = torch.zeros(1, 187), torch.ones(1, 187)
    emap, T = ground_map(flat), pose(BASE)
    read = {name: HeightScan.preset(name) for name in PRESETS}
    for u, error in ((low, -0.1), (high, 0.1)):
        assert at(read["isaac_lab"](emap, T, noise=u)[0], 3) == near(0.2 + error)
        assert at(read["mjlab"](emap, T, noise=u)[0], 3) == near((0.7 + error) / 5)
        assert at(read["legged_gym"](emap, T, noise=u)[0], 3) == near(5 * (0.2 + error))
    above = pose((0.3, -0.2, 3.0))
    assert at(read["isaac_lab"](emap, above, noise=high)[0], 3) == near(1.0)
    assert at(read["legged_gym"](emap, above, noise=high)[0], 3) == near(5.5)
    blank = ground_map(flat, validity=False)
    assert [at(read[n](blank, T, noise=high)[0], 3)[0] for n in PRESETS] == pytest.approx([0.1, 0.12, 0.5])


def test_noise_is_off_unless_asked_for():
    emap, T, scan = ground_map(flat), pose(BASE), HeightScan.isaac_lab()
    assert torch.equal(scan(emap, T)[0], scan(emap, T)[0])
    torch.manual_seed(0)
    error = scan(emap, T, noise=True)[0] - scan(emap, T)[0]
    assert error.abs().max() <= 0.1 and error.max() > 0.08 and error.min() < -0.08 and len(error.unique()) > 150
    torch.manual_seed(0)
    assert torch.equal(scan(emap, T, noise=True)[0] - scan(emap, T)[0], error)


# Patterns and alignment -----------------------------------------------------------------------------------------------


def test_a_grid_counts_like_a_layer():
    pattern = HeightScan.grid(length_x=0.2, length_y=0.1, resolution=0.1, offset=(1.0, 0.5)).pattern
    assert np.allclose(pattern, [(0.9, 0.45), (0.9, 0.55), (1.0, 0.45), (1.0, 0.55), (1.1, 0.45), (1.1, 0.55)])
    assert HeightScan.grid().num_points == 187


def test_rings_are_those_of_the_paper():
    pattern = np.array(HeightScan.feet().pattern)
    radius = np.hypot(*pattern.T)
    for r, count in ((0.08, 6), (0.16, 8), (0.26, 10), (0.36, 12), (0.48, 16)):
        assert np.isclose(radius, r).sum() == count
    assert HeightScan.feet().num_points == 4 * 52 and HeightScan.feet(num_feet=2).num_points == 104
    x, y = pattern[[0, 1, 6, 8, 51]].T  # ahead, 60 degrees to the left, ahead, left, 22.5 degrees to the right
    assert np.allclose(x, [0.08, 0.04, 0.16, 0.0, 0.48 * math.cos(math.pi / 8)])
    assert np.allclose(y, [0.0, 0.08 * math.sqrt(0.75), 0.0, 0.16, -0.48 * math.sin(math.pi / 8)])


def test_feet_on_a_tilted_plane():
    """The second foot at (0.5, 0.1, 0.4): its first point lies 8 cm ahead, along +y: h = 0.05 + 0.2 * 0.18."""
    feet = torch.tensor([[[0.1, -0.4, 0.2], [0.5, 0.1, 0.4]]], dtype=torch.float64)
    scan = HeightScan.feet(num_feet=2, reach=0.5)
    values, valid = scan(ground_map(plane), pose(BASE, yaw=math.pi / 2), feet)
    assert values.shape == (1, 104) and valid.all()
    # Of the second ring, the third point is 16 cm to the left: x = 0.34.
    assert at(values, 52, 52 + 8) == near(0.4 - 0.086, 0.4 - 0.034 - 0.02)
    assert at(values, 0) == near(0.2 - 0.01 + 0.2 * 0.32)


def test_any_points_keep_their_order():
    xy = [(0.3, 0.1), (-0.2, 0.4), (0.3, 0.1)]
    given_as = [xy, np.array(xy), torch.tensor(xy, dtype=torch.float64)]
    scans = [HeightScan.points(points, alignment="world") for points in given_as]
    assert scans[0] == scans[1] == scans[2] and len({*scans}) == 1
    values, _ = scans[0](ground_map(plane), pose(BASE))
    # At (0.6, -0.1) and (0.1, 0.2).
    assert at(values, 0, 1, 2) == near(0.7 - 0.04, 0.7 - 0.05, 0.7 - 0.04)


def test_alignments_by_hand():
    """Nose down by 60 degrees and looking along +y: a point 0.8 m ahead, on ground that rises along +y."""
    emap, T = ground_map(lambda x, y: y), pose(BASE, yaw=math.pi / 2, pitch=math.pi / 3)
    heights = {name: float(HeightScan.points([(0.8, 0.0)], alignment=name)(emap, T)[0]) for name in ALIGNMENTS}
    assert heights["yaw"] == pytest.approx(0.7 + 0.2 - 0.8)
    assert heights["base"] == pytest.approx(0.7 + 0.2 - 0.4)
    assert heights["world"] == pytest.approx(0.7 + 0.2)


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-1.4, 1.4))
def test_the_heading_is_yaw_whatever_the_tilt(yaw, pitch, roll):
    expected = torch.tensor([[math.cos(yaw), math.sin(yaw)]], dtype=torch.float64)
    torch.testing.assert_close(heading(pose(yaw=yaw, pitch=pitch, roll=roll)), expected)


def test_straight_up_the_y_axis_says_where_left_is():
    """x up, y to (-0.6, 0.8): ahead is (0.8, 0.6), although the x axis leans to (-0.05, 0) by rounding."""
    T = torch.eye(4)[None].clone()
    T[0, :3, 0], T[0, :3, 1], T[0, :3, 2] = torch.tensor([[0.0, 0, 1], [-0.6, 0.8, 0], [-0.8, -0.6, 0]])
    torch.testing.assert_close(heading(T), torch.tensor([[0.8, 0.6]]))
    T[0, 0, 0] = -0.05
    torch.testing.assert_close(heading(T), torch.tensor([[0.8, 0.6]]))


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 0.05, -math.pi / 2 + 0.05])
def test_a_base_that_points_straight_up_has_a_heading(pitch):
    """The y axis, turned right, takes over: without roll it says the same."""
    T = pose(yaw=0.7, pitch=pitch).requires_grad_()
    ahead = heading(T)
    torch.testing.assert_close(ahead, torch.tensor([[math.cos(0.7), math.sin(0.7)]], dtype=torch.float64))
    ahead.sum().backward()
    assert T.grad.isfinite().all()


# Against slow loops ---------------------------------------------------------------------------------------------------


def loop_sample(layer, known, x, y, corner, mode):
    if mode != "minimum":
        return reference.sample(layer, known, x, y, corner, 0.1, mode)
    found = []
    i, j = math.floor(x / 0.1 - 0.5) - corner[0], math.floor(y / 0.1 - 0.5) - corner[1]
    for a, b in ((i, j), (i + 1, j), (i, j + 1)):
        if 0 <= a < layer.shape[0] and 0 <= b < layer.shape[1] and known[a, b]:
            found.append(layer[a, b])
    return (min(found), True) if found else (0.0, False)


def loop_turn(point, R, alignment):
    if alignment == "world":
        return point
    if alignment == "base":
        return tuple((R @ [*point, 0.0])[:2])
    yaw = math.atan2(R[1, 0], R[0, 0])
    return tuple((rotation(yaw) @ [*point, 0.0])[:2])


def loop_inpaint(layer, known, rings):
    layer, known = np.where(known, layer, 0.0), known.copy()
    for _ in range(rings):
        before, seen = layer.copy(), known.copy()
        for i in range(layer.shape[0]):
            for j in range(layer.shape[1]):
                window = np.s_[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2]
                if not seen[i, j] and seen[window].any():
                    layer[i, j], known[i, j] = before[window][seen[window]].mean(), True
    return layer, known


def loop_levels(layer, known, u, v):
    """What a place, in cells from the corner, reads of blocks of 1, 2, 4, ... cells a side, None where nothing."""
    read = []
    while True:
        value, good = reference.sample(layer, known, u, v, (0, 0), 1.0, "bilinear")
        read.append(value if good else None)
        if max(layer.shape) == 1:
            return read
        u, v, size = u / 2, v / 2, [(n + 1) // 2 for n in layer.shape]
        blocks, some = np.zeros(size), np.zeros(size, bool)
        for i in range(size[0]):
            for j in range(size[1]):
                window = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
                some[i, j] = known[window].any()
                blocks[i, j] = layer[window][known[window]].mean() if some[i, j] else 0.0
        layer, known = blocks, some


def loop_ground(layer, known, x, y, base, corner, half):
    """The ground at a place, continued from what is known of 0.1 m cells; None on an empty map."""
    rows, columns = (max(0, n // 2 - cells - 5) for n, cells in zip(layer.shape, half, strict=True))
    part = np.s_[rows : layer.shape[0] - rows, columns : layer.shape[1] - columns]
    layer, known, corner = layer[part], known[part], (corner[0] + rows, corner[1] + columns)
    near = loop_levels(layer, known, x / 0.1 - corner[0], y / 0.1 - corner[1])[:4]  # up to 0.8 m
    under = loop_levels(layer, known, base[0] / 0.1 - corner[0], base[1] / 0.1 - corner[1])
    under = [value for value in under if value is not None and value < base[2]]
    return next((value for value in [*near, *under] if value is not None), None)


def loop_scan(scan, emap, T, feet, b):
    """One environment's values, point by point."""
    corner, layers = emap.corner[b].tolist(), {n: v[b].numpy() for n, v in emap.state._asdict().items() if n in KEPT}
    h, known = layers["elevation"], layers["validity"]
    bound = np.where(known, h, layers["upper_bound"])
    filled = loop_inpaint(h, known, scan.inpaint_rings)
    places = []
    for middle in [T[b, :3, 3]] if feet is None else feet[b]:
        for point in scan.pattern:
            dx, dy = loop_turn(point, T[b, :3, :3].numpy(), scan.alignment)
            places.append((float(middle[0]) + dx, float(middle[1]) + dy, float(middle[2])))
    read = [loop_sample(h, known, x, y, corner, scan.mode) for x, y, _ in places]
    lowest = min((value for value, good in read if good), default=None)
    values = []
    for (x, y, z), (ground, good) in zip(places, read, strict=True):
        if not good and scan.fill == "lowest" and lowest is not None:
            ground, good = lowest, True
        if not good and scan.fill == "upper_bound":
            ground, good = loop_sample(bound, known | layers["bounded"], x, y, corner, scan.mode)
        if not good and scan.fill == "ground":
            half = scan._pattern.cells(emap.cfg.grid)
            value = loop_ground(h, known, x, y, T[b, :3, 3].tolist(), corner, half)
            ground, good = (0.0, False) if value is None else (value, True)
        if not good and scan.fill == "inpaint":
            ground, good = loop_sample(*filled, x, y, corner, scan.mode)
        value = z - ground - scan.nominal_height if good else 0.2 if isinstance(scan.fill, str) else scan.fill
        values.append(value if scan.clip is None else min(max(value, -scan.clip), scan.clip))
    return np.array(values) * scan.scale, np.array([good for _, good in read])


KEPT = ("elevation", "validity", "upper_bound", "bounded")


def random_map(seed, num_envs=2, known=0.6, cells=(20, 18), dtype=torch.float64):
    """Holes larger than a cell, too; unknown cells hold NaN."""
    rng = np.random.default_rng(seed)
    emap = small_map(num_envs, cells, dtype=dtype)
    state = random_state(rng, emap.cfg.grid, num_envs, known, dtype)
    validity = state.validity & ~torch.nn.functional.max_pool2d((state.time < 0.03).float(), 5, 1, 2).bool()
    bounded = state.bounded & (state.support < 12)
    elevation = torch.where(validity, state.elevation, torch.nan)
    upper_bound = torch.where(bounded, state.upper_bound, torch.nan)
    corner = torch.tensor([[-10, -9], [70, -33]])[:num_envs]
    layers = dict(elevation=elevation, validity=validity, upper_bound=upper_bound, bounded=bounded)
    emap._store(state._replace(corner=corner, **layers))
    return emap, rng


def random_base(emap, rng, tilt=0.4):
    half = emap.cfg.grid.resolution / 2
    poses = []
    for center in emap.center.tolist():
        place = (center[0] + rng.uniform(-half, half), center[1] + rng.uniform(-half, half), rng.uniform(0.3, 1.2))
        poses.append(pose(place, rng.uniform(-3, 3), *rng.uniform(-tilt, tilt, 2)))
    return torch.cat(poses)


@given(SEEDS, st.sampled_from(ALIGNMENTS), st.sampled_from(MODES), st.sampled_from([*FILLS, 0.35]), st.booleans())
def test_scans_agree_with_loops(seed, alignment, mode, fill, at_feet):
    emap, rng = random_map(seed)
    T = random_base(emap, rng)
    settings = dict(alignment=alignment, mode=mode, fill=fill, nominal_height=0.4, inpaint_rings=2, scale=2.0, clip=0.5)
    settings |= dict(standing_height=0.6)
    feet = None
    if at_feet:
        scan = HeightScan.feet(num_feet=2, rings=[(0.0, 1), (0.15, 5)], reach=0.3, **settings)
        feet = T[:, None, :3, 3] + torch.from_numpy(rng.uniform(-0.2, 0.2, (2, 2, 3)))
    else:
        scan = HeightScan.points(rng.uniform(-0.5, 0.5, (40, 2)), **settings)
    values, valid = scan(emap, T, feet)
    for b in range(2):
        expected, known = loop_scan(scan, emap, T, feet, b)
        assert np.array_equal(valid[b].numpy(), known)
        np.testing.assert_allclose(values[b].numpy(), expected, atol=1e-9)


def test_the_random_maps_have_every_kind_of_cell():
    emap, rng = random_map(0)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (200, 2)), nominal_height=0.4)
    T = random_base(emap, rng)
    reads = {fill: dataclasses.replace(scan, fill=fill, inpaint_rings=1)(emap, T) for fill in FILLS}
    valid = reads["base"][1]
    assert 0.3 < valid.double().mean() < 0.8 and all(torch.equal(valid, v) for _, v in reads.values())
    for fill in set(FILLS) - {"base"}:
        differs = reads[fill][0] != reads["base"][0]
        assert differs.any() and not (differs & valid).any()
    assert (reads["upper_bound"][0] == 0).any() and (reads["inpaint"][0] == 0).any(), "some have no answer"


# What is not known ----------------------------------------------------------------------------------------------------


def test_fills_by_hand():
    """Right of x = 0.3 nothing is known, the ground rises along +y, and rays bound one row of what is unknown."""
    emap = ground_map(lambda x, y: 0.1 * y)
    emap.validity[:, 15:] = False
    emap.upper_bound[:, 15], emap.bounded[:, 15] = 0.25, True
    # Cell centres: (0.15, 0.05) known, (0.35, 0.05) bounded, (0.45, 0.05) and (0.95, 0.05) not.
    xy = [(-0.15, 0.25), (0.05, 0.25), (0.15, 0.25), (0.65, 0.25)]
    expected = {
        "ground": (0.195, 0.195, 0.22),  # the last: as under the base, at y = -0.2
        "base": (0.0, 0.0, 0.0),
        "lowest": (0.195,) * 3,
        "upper_bound": (-0.05, 0.0, 0.0),
        "inpaint": (0.195, 0.195, 0.0),
        -0.3: (-0.3, -0.3, -0.3),
    }
    for fill, unknown in expected.items():
        scan = HeightScan.points(xy, alignment="world", fill=fill, nominal_height=0.5, mode="nearest")
        values, valid = scan(emap, pose(BASE))
        assert valid.tolist() == [[True, False, False, False]]
        assert at(values, 0, 1, 2, 3) == near(0.195, *unknown)


def test_inpainting_fills_a_ring_at_a_time():
    known = torch.zeros(1, 7, 7, dtype=torch.bool)
    known[0, 3, 3] = known[0, 3, 5] = True
    heights = torch.full((1, 7, 7), torch.nan).masked_fill(known, 1.0)
    heights[0, 3, 5] = 2.0
    values, found = inpaint((heights, known), (4, 4), 1)
    assert found[0].int().tolist()[2:5] == [[0, 0, 1, 1, 1, 1, 1]] * 3 and found.sum() == 15
    assert values[0, 2, 2:].tolist() == [1.0, 1.0, 1.5, 2.0, 2.0] and values[0, 3, 3] == 1.0
    assert inpaint((heights, known), (4, 4), 3)[1].all() and torch.equal(inpaint((heights, known), (4, 4), 0)[1], known)
    # Only one cell from the centre, and one more for the ring: the corners are left out.
    assert inpaint((torch.ones(1, 8, 8), torch.ones(1, 8, 8, dtype=torch.bool)), (1, 2), 1)[1].sum() == 4 * 6


@given(SEEDS, st.integers(0, 4))
def test_inpainting_agrees_with_loops(seed, rings):
    emap, _ = random_map(seed, 1, known=0.2)
    values, found = inpaint((emap.elevation, emap.validity), (10, 9), rings)
    expected, known = loop_inpaint(emap.elevation[0].numpy(), emap.validity[0].numpy(), rings)
    assert np.array_equal(found[0].numpy(), known)
    np.testing.assert_allclose(values[0].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("fill", [*FILLS, 1.5])
@pytest.mark.parametrize("known", [0.0, 0.5, 1.0])
def test_values_are_never_nan(fill, known, monkeypatch):
    emap, rng = random_map(3, known=known, dtype=torch.float32)
    T, image = random_base(emap, rng), MapImage(length_x=0.8, length_y=0.8, layers=CHANNELS)
    scan = HeightScan.isaac_lab(length_x=1.0, length_y=0.8, fill=fill)
    monkeypatch.setattr(checks, "readable", lambda *_: False)  # as on a GPU, where nobody looks at poses
    for place in ((slice(None), 2, 3), (0, 0, 3), (1, slice(0, 3), slice(0, 3))):
        broken = T.clone()
        broken[place] = torch.nan
        for bad in (T, broken, torch.where(broken.isnan(), torch.inf, broken)):
            values, valid = scan(emap, bad)
            assert values.isfinite().all() and image(emap, bad).isfinite().all()
        assert not valid[1 if place[0] == 1 else 0].any()
        assert not image(emap, broken)[1 if place[0] == 1 else 0].any()


def test_a_nan_foot_reads_nothing():
    emap, T = ground_map(flat), pose(BASE)
    feet = T[:, None, :3, 3].repeat(1, 2, 1)
    feet[0, 1] = torch.nan
    values, valid = HeightScan.feet(num_feet=2)(emap, T, feet)
    assert valid[:, :52].all() and not valid[:, 52:].any() and not values[:, 52:].any()


def test_observations_are_fresh():
    """A policy keeps what it saw while the map goes on."""
    emap, rng = random_map(1, dtype=torch.float32)
    T = random_base(emap, rng)
    before = {name: value.clone() for name, value in emap.state_dict().items() if isinstance(value, torch.Tensor)}
    for scan in (HeightScan.points([(0.1, 0.2)], fill=fill, mode=mode) for fill in FILLS for mode in MODES):
        for tensor in scan(emap, T):
            tensor.fill_(1)
    for layer in CHANNELS:
        MapImage(length_x=0.4, length_y=0.4, layers=(layer,))(emap, T).fill_(7.0)
    now = emap.state_dict()
    assert all(torch.equal(value.nan_to_num(), now[name].nan_to_num()) for name, value in before.items())


# Precision, gradients, modes of running -------------------------------------------------------------------------------


def test_scans_are_right_100_km_from_the_origin():
    emap, rng = random_map(5, 1, dtype=torch.float32)
    T = random_base(emap, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (60, 2)))
    readers = scan, dataclasses.replace(scan, mode="nearest"), MapImage(length_x=0.8, length_y=0.8)
    expected = [reader(emap, T) for reader in readers]
    emap.corner += torch.tensor([1_000_000, -1_000_000])
    T[:, :2, 3] += torch.tensor([100_000.0, -100_000.0], dtype=torch.float64)
    torch.testing.assert_close([reader(emap, T) for reader in readers], expected, atol=2e-5, rtol=0)


def test_a_batch_reads_as_single_maps():
    emap, rng = random_map(6)
    T = random_base(emap, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill="lowest")
    for b in range(2):
        single = small_map(1, (20, 18), dtype=torch.float64)
        single._store(type(emap.state)(*(v[b : b + 1] for v in emap.state[:-1]), single.statistics))
        assert torch.equal(scan(single, T[b : b + 1])[0], scan(emap, T)[0][b : b + 1])


def test_readers_take_a_state():
    (one, rng), (other, _) = random_map(1), random_map(2)
    T = random_base(one, rng)
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill="upper_bound")
    image = MapImage(length_x=0.8, length_y=0.8)
    torch.testing.assert_close(scan(one, T, state=other.state), scan(other, T))
    assert torch.equal(image(one, T, state=other.state), image(other, T))
    assert not torch.equal(scan(one, T)[0], scan(other, T)[0])


def turned(T, position, angle):
    """A pose moved by `position` (B, 3) and turned by `angle` (B,) about the vertical, both differentiable."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    R = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).view(-1, 3, 3)
    top = torch.cat([R @ T[:, :3, :3], (T[:, :3, 3] + position)[..., None]], -1)
    return torch.cat([top, T[:, 3:]], 1)


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("fill", FILLS)
def test_gradcheck_of_map_and_pose(alignment, fill):
    emap, rng = random_map(8)
    T, state = random_base(emap, rng), emap.state
    scan = HeightScan.points(rng.uniform(-0.5, 0.5, (12, 2)), alignment=alignment, fill=fill, scale=3.0)
    inputs = state.elevation.nan_to_num(), torch.zeros(2, 3).double(), torch.zeros(2).double()
    inputs = tuple(value.clone().requires_grad_() for value in inputs)

    def read(elevation, position, angle):
        return scan(emap, turned(T, position, angle), state=state._replace(elevation=elevation))[0]

    assert torch.autograd.gradcheck(read, inputs, eps=1e-7, atol=1e-5, fast_mode=True)
    grads = torch.autograd.grad(read(*inputs).square().sum(), inputs, allow_unused=True)
    assert grads[0].abs().sum() > 0 and (grads[1].abs() > 0).all()
    assert (grads[2] is None or not grads[2].any()) == (alignment == "world")
    assert not grads[0][~emap.validity].any(), "unknown cells have no say"


def test_gradients_of_feet_and_images():
    emap, rng = random_map(9)
    T = random_base(emap, rng).requires_grad_()
    feet = (T.detach()[:, None, :3, 3] + torch.from_numpy(rng.uniform(-0.1, 0.1, (2, 2, 3)))).requires_grad_()
    HeightScan.feet(num_feet=2, rings=[(0.1, 4)], reach=0.3)(emap, T, feet)[0].square().sum().backward()
    assert (feet.grad != 0).all() and T.grad.isfinite().all() and T.grad[:, :2, 0].any()
    elevation = emap.elevation.nan_to_num().requires_grad_()
    image = MapImage(length_x=0.8, length_y=0.8)
    image(emap, T.detach(), state=emap.state._replace(elevation=elevation))[:, 0].sum().backward()
    assert elevation.grad.isfinite().all() and elevation.grad.any()


def test_a_pattern_first_read_in_inference_mode_can_be_trained_through():
    scan, emap = HeightScan.points([(0.1, 0.2)]), ground_map(plane)
    with torch.inference_mode():
        values, valid = scan(emap, pose(BASE))
        MapImage()(emap, pose(BASE))
    assert values.is_inference() and valid.all()
    T = pose(BASE).requires_grad_()
    scan(emap, T)[0].sum().backward()
    assert T.grad[0, 2, 3] == 1 and T.grad[0, 0, 3] == pytest.approx(-0.1)


@pytest.mark.compiles
@pytest.mark.slow(4)
@pytest.mark.parametrize("warm", [True, False])
def test_scans_compile_as_one_graph(warm):
    """Also a scan whose pattern has not been on the device before."""
    emap, rng = random_map(4, dtype=torch.float32)
    T, u = random_base(emap, rng), torch.rand(2, 30)
    scans = [HeightScan.points(rng.uniform(-0.5, 0.5, (30, 2)), fill=fill, noise=0.1) for fill in (*FILLS, 0.5)]
    images = [MapImage(length_x=0.8, length_y=0.8, mode=mode) for mode in MODES]
    feet = HeightScan.feet(num_feet=2, rings=[(0.1, 3)], reach=0.4)

    def read(T, u, scans, images, feet):
        middles = T[:, None, :3, 3].repeat(1, 2, 1)
        read = [scan(emap, T, noise=u) for scan in scans]
        return read, [image(emap, T) for image in images], feet(emap, T, middles)

    expected = read(T, u, *copy.deepcopy((scans, images, feet)))
    if warm:
        read(T, u, scans, images, feet)
    compiled = torch.compile(read, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(T, u, scans, images, feet), expected)


def test_nothing_waits_for_the_device():
    with FakeTensorMode():
        emap, T = ElevationMap(num_envs=2), torch.zeros(2, 4, 4, dtype=torch.float64)
        for mode in MODES:
            for fill in (*FILLS, 0.5):
                scan = HeightScan.grid(mode=mode, fill=fill, noise=0.1, clip=1.0)
                assert scan(emap, T, noise=True)[0].shape == (2, 187)
            for alignment in ALIGNMENTS:
                assert MapImage(alignment=alignment, mode=mode)(emap, T).shape == (2, 4, 32, 32)
        assert HeightScan.feet()(emap, T, torch.zeros(2, 4, 3))[0].shape == (2, 208)


def test_a_pattern_is_copied_to_a_device_once(monkeypatch):
    scan, emap = HeightScan.isaac_lab(), ElevationMap(num_envs=1, device="meta")
    T = torch.empty(1, 4, 4, device="meta")
    scan(emap, T)
    for constructor in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, constructor, None)
    assert scan(emap, T)[0].device.type == "meta"


def test_scans_are_values():
    scan = HeightScan.isaac_lab()
    scan(ground_map(flat), pose(BASE))
    assert scan == HeightScan.isaac_lab() == pickle.loads(pickle.dumps(scan)) == copy.deepcopy(scan)
    assert dataclasses.replace(scan, fill="base") == HeightScan.isaac_lab(fill="base") != scan
    with pytest.raises(dataclasses.FrozenInstanceError):
        scan.fill = "base"


# Images ---------------------------------------------------------------------------------------------------------------


def test_an_image_by_hand():
    """Base at (0.3, -0.2, 0.7), looking along +y: pixel [0, 0] of 4 x 2 of 0.1 m lies at (-0.15, -0.05) from it."""
    emap = ground_map(plane, variance=0.04, traversability=0.6, upper_bound=0.3)
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, layers=CHANNELS)
    assert image.shape == (5, 4, 2)
    T = pose(BASE, yaw=math.pi / 2)
    elevation, validity, variance, bound, traversability = image(emap, T)[0]
    # (-0.15, -0.05) -> (0.35, -0.35): -0.035; one more i: y + 0.1; one more j: x - 0.1.
    assert elevation[0, 0] == pytest.approx(-0.035 - 0.7) and elevation[1, 0] == pytest.approx(-0.015 - 0.7)
    assert elevation[0, 1] == pytest.approx(-0.045 - 0.7) and torch.equal(bound, elevation)
    assert (validity == 1).all()
    assert variance.numpy() == pytest.approx(0.04) and traversability.numpy() == pytest.approx(0.6)
    offset = dataclasses.replace(image, offset=(0.1, 0.1), nominal_height=0.5)(emap, T)[0, 0]
    assert offset[0, 0] == pytest.approx(-0.035 + 0.02 - 0.01 - 0.7 + 0.5)


def test_what_an_image_does_not_know_is_0():
    emap = ground_map(plane, variance=0.04, traversability=0.6, upper_bound=0.3)
    emap.validity[:, :15] = False
    emap.bounded[:, 13] = True
    image = MapImage(length_x=0.6, length_y=0.2, resolution=0.1, layers=CHANNELS, mode="nearest")
    channels = image(emap, pose(BASE))[0]
    assert not channels[:, :1].any() and not channels[[0, 1, 2, 4], :3].any()
    assert channels[3, 1].numpy() == pytest.approx(0.3 - 0.7) and not channels[3, 2].any()
    assert (channels[:, 3:] != 0).all()


def test_an_image_shows_ratings_where_they_are_known(monkeypatch):
    """Elevations may be known where ratings are not."""
    emap = ground_map(plane, traversability=0.6)
    rated = emap.cell_centers()[..., 0] > 0.3
    monkeypatch.setitem(LAYERS, "traversability", lambda state: (state.traversability, rated))
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, alignment="world", mode="nearest")(emap, pose(BASE))
    assert image.shape == (1, 4, 4, 2) and (image[0, 1] == 1).all()
    expected = torch.tensor([0.0, 0.0, 0.6, 0.6], dtype=torch.float64)[:, None].expand(4, 2)
    torch.testing.assert_close(image[0, 3], expected)


@pytest.mark.parametrize("mode", MODES)
def test_images_are_scans_of_a_grid(mode):
    emap, rng = random_map(7)
    T = random_base(emap, rng)
    pixels = HeightScan.grid(length_x=0.5, length_y=0.3, resolution=0.1, mode=mode, fill="base")
    image = MapImage(length_x=0.6, length_y=0.4, resolution=0.1, layers=("validity", "elevation"), mode=mode)
    channels = image(emap, T)
    values, valid = pixels(emap, T)
    torch.testing.assert_close(channels[:, 1].flatten(1), -values)
    assert torch.equal(channels[:, 0].flatten(1), valid.double())


# What is refused ------------------------------------------------------------------------------------------------------


def test_windows_that_are_too_small_are_refused_before_anything_else():
    """187 points reach hypot(0.8, 0.5) = 0.943 m; with a cell of 0.1 m on each side that takes 2.09 m."""
    scan, T = HeightScan.isaac_lab(), pose()
    assert scan(small_map(1, (21, 21)), T)[0].shape == (1, 187)
    for cells in ((20, 21), (21, 20)):
        with pytest.raises(ValueError, match=r"pattern: must lie in the map .* takes 2.09 x 2.09 m, got a window of 2"):
            scan(small_map(1, cells), "no pose")
    world = HeightScan.isaac_lab(alignment="world")
    assert world(small_map(1, (18, 12)), T)[0].shape == (1, 187)
    with pytest.raises(ValueError, match="takes 1.8 x 1.2 m, got a window of 1.8 x 1.1 m; enlarge length_x"):
        world(small_map(1, (18, 11)), T)
    with pytest.raises(ValueError, match=r"takes 2.36 x 2.36 m"):
        HeightScan.feet(reach=0.6)(small_map(1, (23, 23)), T, torch.zeros(1, 4, 3))
    with pytest.raises(ValueError, match="pattern: must lie in the map"):
        MapImage()(small_map(1, (20, 20)), T)


def test_no_point_leaves_a_window_that_is_large_enough():
    """At every heading, with the base half a cell off the centre."""
    emap = ground_map(flat, corner=(-10, -11), cells=(21, 21))
    scan = HeightScan.isaac_lab(mode="bilinear")
    for yaw in np.linspace(-3.1, 3.1, 50):
        for dx, dy in ((0.049, 0.049), (-0.049, 0.049)):
            assert scan(emap, pose((0.05 + dx, -0.05 + dy, 0.5), yaw=yaw))[1].all()


GOOD = dict(xy=[(0.0, 0.1)])


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: HeightScan.preset("isaac"), "preset: must be one of isaac_lab, mjlab, legged_gym, got 'isaac'; use"),
        (lambda: HeightScan.points(**GOOD, alignment="body"), "alignment: must be one of yaw, base, world, got 'body'"),
        (lambda: HeightScan.points(**GOOD, mode="linear"), "mode: must be one of bilinear, nearest, minimum, got"),
        (lambda: HeightScan.points(**GOOD, fill="zero"), "fill: must be a number or one of ground, base, lowest"),
        (lambda: HeightScan.points(**GOOD, fill=None), "fill: must be a number or one of ground, base, lowest"),
        (lambda: HeightScan.points(**GOOD, fill=math.inf), "fill: must be finite where nothing clips, got inf"),
        (lambda: HeightScan.points(**GOOD, fill=math.nan, clip=1.0), "fill: must be finite"),
        (lambda: HeightScan.points(**GOOD, original="original"), "original: must be a number or one of ground, base"),
        (lambda: HeightScan.points(**GOOD, standing_height=math.nan), "standing_height: must be a finite number"),
        (lambda: HeightScan.points(**GOOD, clip=0.0), "clip: must be a positive number, got 0.0"),
        (lambda: HeightScan.points(**GOOD, noise=-0.1), "noise: must be a finite, not negative number, got -0.1"),
        (lambda: HeightScan.points(**GOOD, scale=math.nan), "scale: must be a finite number, got nan"),
        (lambda: HeightScan.points(**GOOD, inpaint_rings=1.5), "inpaint_rings: must be a finite, not negative int"),
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


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda e, T: ONE(e, T[0]), r"T_map_base: expected \(2, 4, 4\) on cpu, got \(4, 4\)"),
        (lambda e, T: ONE(e, T.int()), "T_map_base: must be float32, float64"),
        (lambda e, T: ONE(e, T * 2), "T_map_base: must be rigid"),
        (lambda e, T: MapImage(length_x=0.4, length_y=0.4)(e, T[:1]), r"T_map_base: expected \(2, 4, 4\)"),
        (lambda e, T: ONE(e, T, torch.zeros(2, 4, 3)), "feet: must be left out, got feet for a scan around the base"),
        (lambda e, T: HeightScan.feet(reach=0.3)(e, T), r"feet: expected \(2, 4, 3\), got None"),
        (lambda e, T: HeightScan.feet(reach=0.3)(e, T, T[:, :3, :3]), r"feet: expected \(2, 4, 3\), got \(2, 3, 3\)"),
        (lambda e, T: ONE(e, T, noise=True), "noise: must be off, as this scan has none, got on; build"),
        (lambda e, T: dataclasses.replace(ONE, noise=0.1)(e, T, noise=torch.rand(2)), r"noise: expected \(2, 1\)"),
    ],
)
def test_bad_inputs_are_refused(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call(small_map(2, (20, 20)), pose(num_envs=2))


def test_where_an_images_pixels_lie():
    image = MapImage(length_x=0.4, length_y=0.2, resolution=0.1, offset=(1.0, 0.0))
    left = torch.tensor([[[0.0, -1, 0, 3], [1, 0, 0, 5], [0, 0, 1, 7], [0, 0, 0, 1]]], dtype=torch.float64)
    xy = image.xy(left)[0]  # the base at (3, 5) looks along +y: ahead is +y, left is -x
    assert xy.shape == (8, 2)
    torch.testing.assert_close(xy[0], torch.tensor([3.05, 5.85], dtype=torch.float64))
    torch.testing.assert_close(xy[1], torch.tensor([2.95, 5.85], dtype=torch.float64))
    torch.testing.assert_close(xy[7], torch.tensor([2.95, 6.15], dtype=torch.float64))


@pytest.mark.parametrize("rings", [(0.1, 8), [(0.1, 8, 1)], [(8, 0.1)], [(-0.1, 8)], [(0.1, 0)]])
def test_rings_that_are_none_are_refused(rings):
    with pytest.raises(ValueError, match="rings: must be pairs of a radius and a number of points"):
        HeightScan.feet(rings=rings)


def test_a_scan_around_feet_asks_for_them():
    with pytest.raises(ValueError, match=r"feet: expected \(1, 4, 3\), got None; give the feet's positions"):
        HeightScan.feet()(small_map(1, (30, 30)), pose())
